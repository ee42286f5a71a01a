"""Table 1 as a picture."""

from __future__ import annotations

import numpy as np

from harness.report.figures.scores import score_cells
from harness.report.tables.table1 import make_cells
from harness.statistics import estimate_mean


def test_a_cell_is_its_agents_its_mean_and_its_interval(study, drawn, tmp_path):
    results = study(lambda _, name, agent: agent + 10.0 * (name == "PPO reg"), agents=6)
    assert score_cells(make_cells(results), tmp_path / "figure.png")
    (axis,) = drawn().axes
    dots = [sorted(x.get_ydata()) for x in axis.get_lines() if x.get_marker() == "o"]
    assert dots == [[0, 1, 2, 3, 4, 5], [10, 11, 12, 13, 14, 15]]
    bars = [list(x.get_ydata()) for x in axis.get_lines() if x.get_linewidth() == 2]
    assert bars == [[2.5, 2.5], [12.5, 12.5]]
    spans = [list(x.get_ydata()) for x in axis.get_lines() if x.get_color() == "black"]
    _, low, high, _ = estimate_mean(np.arange(6.0))
    np.testing.assert_allclose(spans[0], [low, high])
    assert [x.get_text() for x in axis.get_xticklabels()] == ["PPO", "PPO reg"]


def test_a_skewed_cell_shows_its_points_and_no_interval(study, drawn, tmp_path):
    results = study(lambda _, __, agent: 500.0 * (agent == 0))
    score_cells(make_cells(results), tmp_path / "figure.png")
    (axis,) = drawn().axes
    assert not [x for x in axis.get_lines() if x.get_color() == "black"]
    assert [len(x.get_ydata()) for x in axis.get_lines() if x.get_marker() == "o"] == [10, 10]


def test_without_agents_there_is_no_picture(study, tmp_path):
    results = study(lambda *_: None)
    assert not score_cells(make_cells(results), tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()


def test_a_task_without_agents_has_no_panel(study, drawn, tmp_path):
    results = study(lambda task, *_: 1.0 if task == "Ant" else None, tasks=("Hopper", "Ant"))
    score_cells(make_cells(results), tmp_path / "figure.png")
    assert [axis.get_title() for axis in drawn().axes] == ["Ant"]
