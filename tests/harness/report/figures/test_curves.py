"""Curves against steps: that a picture comes out, with what belongs in it and no empty panel."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from harness.report.figures import curves
from harness.report.figures.curves import (
    CONDITIONING,
    LEARNING,
    Measure,
    block_means,
    draw_measures,
)
from harness.report.figures.style import COLORS
from harness.report.results import load_results
from harness.suite import load_suite
from tests.harness.conftest import write_run

J, LOW, HIGH, SHARE = (
    f"conditioning/{name}" for name in ("quotient_q50", "quotient_q05", "quotient_q95",
                                        "gradient_share")
)  # fmt: skip


def panels(figure) -> list[tuple[str, str]]:
    """Title and label of each visible panel, row by row."""
    return [(a.get_title(), a.get_ylabel()) for a in figure.axes if a.get_visible()]


@pytest.mark.parametrize("runs", [1, 16])
def test_a_picture_is_written_for_any_number_of_runs(store, suite, tmp_path, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 5.0, 2.0])
    path = tmp_path / "curves.png"
    assert draw_measures(load_results(suite, store), suite.algorithms, LEARNING, path)
    picture = matplotlib.image.imread(path)
    assert picture.shape[0] > 300
    assert picture.shape[1] > 500
    assert picture.std() > 0.01


def test_without_runs_there_is_no_picture(store, suite, tmp_path):
    path = tmp_path / "curves.png"
    assert not draw_measures(load_results(suite, store), suite.algorithms, LEARNING, path)
    assert not path.exists()


def test_only_tasks_with_runs_have_panels(store, suite, tmp_path, drawn):
    for spec in suite.runs:
        if spec.environment == "Reacher":
            write_run(store, spec, [1.0, 2.0])
    draw_measures(load_results(suite, store), suite.algorithms, LEARNING, tmp_path / "c.png")
    assert [text.get_text() for text in drawn().legends[0].get_texts()] == ["PPO", "PPO reg"]
    assert panels(drawn()) == [("Reacher", "reward"), ("", "psi")]


def test_a_measure_without_a_number_has_no_panel(store, suite, tmp_path, drawn):
    for spec in suite.runs:
        logged = {J: [0.5, 0.6], LOW: [0.1, 0.2], HIGH: [1.0, 2.0], SHARE: [np.nan, np.nan]}
        write_run(store, spec, [np.nan, np.nan], columns=logged)
    results = load_results(suite, store)
    draw_measures(results, suite.algorithms, LEARNING, tmp_path / "learning.png")
    assert panels(drawn()) == [("Hopper", "psi"), ("Reacher", "")]
    draw_measures(results, suite.algorithms, CONDITIONING, tmp_path / "conditioning.png")
    assert panels(drawn()) == [("Hopper", "J: median, 5% and 95%"), ("Reacher", "")]


def test_the_quantiles_of_j_are_dotted_and_the_range_is_marked(store, suite, tmp_path, drawn):
    logged = {J: [0.5, 2.0], LOW: [0.25, 0.5], HIGH: [1.0, 8.0]}
    for spec in suite.runs:
        if spec.environment == "Hopper" and spec.algorithm == "PPO":
            write_run(store, spec, [1.0, 2.0], columns=logged)
    draw_measures(load_results(suite, store), ["PPO"], CONDITIONING, tmp_path / "c.png")
    (axis,) = (a for a in drawn().axes if a.get_visible())
    lines = {line.get_linestyle(): [] for line in axis.get_lines()}
    for line in axis.get_lines():
        lines[line.get_linestyle()].append(list(line.get_ydata()))
    assert lines == {"-": [[0.5, 2.0], [1.0, 1.0]], ":": [[0.25, 0.5], [1.0, 8.0]]}
    assert axis.get_yscale() == "log"
    assert len(axis.collections) == 1  # one interval, of the median


def test_zeros_are_left_out_of_a_logarithmic_panel(store, suite, tmp_path, drawn):
    """The gradient share of a run without a penalty is 0, and measured every 25 updates."""
    for spec in suite.runs:
        share = 0.0 if spec.algorithm == "PPO" else 0.01
        write_run(store, spec, [1.0] * 3, columns={SHARE: [np.nan, share, np.nan]})
    draw_measures(load_results(suite, store), suite.algorithms, CONDITIONING, tmp_path / "c.png")
    for axis in drawn().axes:
        (line,) = axis.get_lines()
        assert line.get_color() == COLORS[1]
        assert (list(line.get_xdata()), list(line.get_ydata())) == ([200], [0.01])


def test_a_task_is_left_out_that_not_all_algorithms_are_planned_for(study, tmp_path, drawn):
    results = study(lambda *_: 1.0, tasks=("Hopper", "Ant"), agents=2, updates=2)
    runs = [r for r in results.suite.runs if (r.environment, r.algorithm) != ("Ant", "PPO reg")]
    results.suite.runs[:] = runs
    draw_measures(results, ["PPO", "PPO reg"], LEARNING, tmp_path / "c.png")
    assert panels(drawn()) == [("Hopper", "reward"), ("", "psi")]


def test_a_long_curve_is_drawn_by_means_of_neighbours(store, suite, tmp_path, drawn, monkeypatch):
    monkeypatch.setattr(curves, "POINTS", 3)
    write_run(store, suite.runs[0], [0.0, 2.0, 4.0, 6.0, 10.0])
    draw_measures(load_results(suite, store), ["PPO"], LEARNING, tmp_path / "curves.png")
    (line,) = drawn().axes[0].get_lines()
    np.testing.assert_allclose(line.get_xdata(), [200, 400, 500])
    np.testing.assert_allclose(line.get_ydata(), [1.0, 5.0, 10.0])


def test_block_means_leave_out_what_is_missing():
    frame = pd.DataFrame({"a": [1.0, 3.0, np.nan], "b": [2.0, np.nan, np.nan]}, [10, 20, 30])
    means = block_means(frame, 2)
    assert means.index.tolist() == [20, 30]
    assert means["a"].tolist()[0] == 2.0
    assert means["b"].tolist()[0] == 2.0
    assert means.loc[30].isna().all()
    pd.testing.assert_frame_equal(block_means(frame, 1), frame, check_index_type=False)


def test_no_curve_is_left_out_for_want_of_colours(store, suite_file, drawn, tmp_path):
    many = len(COLORS) + 1
    sweep = '[[sweeps]]\nname = "size"\nbaseline = "ppo_reg"\nparameter = "radius"\n'
    sweep += f"values = {list(range(1, many + 1))}\n\n[environments]"
    suite_file.write_text(suite_file.read_text().replace("[environments]", sweep))
    suite = load_suite(str(suite_file))
    names = list(suite.sweeps["size"].values())
    for spec in suite.runs:
        if spec.algorithm in names and spec.args["agent"] == 0:
            write_run(store, spec, [1.0, 2.0])
    draw_measures(load_results(suite, store), names, LEARNING, tmp_path / "figure.png")
    assert len(drawn().axes[0].get_lines()) == many


def test_a_column_that_some_runs_lack_is_drawn_of_the_others(store, suite, drawn, tmp_path):
    hopper = [spec for spec in suite.runs if spec.environment == "Hopper"]
    write_run(store, hopper[0], [1.0, 2.0])
    write_run(store, hopper[1], [1.0, 2.0], columns={J: [3.0, 4.0]})
    measure = Measure("J", {J: "-"})
    draw_measures(load_results(suite, store), ["PPO"], (measure,), tmp_path / "figure.png")
    (line,) = drawn().axes[0].get_lines()
    assert list(line.get_ydata()) == [3.0, 4.0]
