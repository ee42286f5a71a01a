"""Figure 4, from curves with known numbers."""

from __future__ import annotations

import matplotlib.image
import numpy as np

from harness.report.figures.success import success_curves
from harness.report.results import load_results
from harness.suite import load_suite
from tests.harness.conftest import make_episodes, write_run
from tests.harness.report.conftest import make_games

EPISODES = make_episodes(seen_sampled=[[1]], unseen_sampled=[[0]])


def write_curves(store, suite, algorithm, seed, steps, seen):
    run = next(r for r in suite.runs if (r.algorithm, r.args["seed"]) == (algorithm, seed))
    columns = {"global_step": steps, "eval/success_seen": seen}
    columns["eval/success_unseen"] = np.array(seen) / 2
    write_run(store, run, [0.0] * len(steps), psi=0.9, columns=columns, done=False)


def test_curves_of_seeds_that_count_their_steps_differently_are_one(store, tmp_path, drawn):
    suite = load_suite("table2", seeds=2)
    write_curves(store, suite, "PPO", 1, [100, 198, 300], [np.nan, 0.2, 0.4])
    write_curves(store, suite, "PPO", 2, [98, 200, 296], [np.nan, 0.4, 0.8])
    success_curves(load_results(suite, store), tmp_path / "figure4.png")
    axes = np.array(drawn().axes).reshape(3, 1)  # the other agents have no column
    assert axes[0, 0].get_title() == "PPO"
    assert [axis.get_ylabel() for axis in axes[:, 0]] == [
        "success, seen", "success, unseen", "psi",
    ]  # fmt: skip
    for axis, x, y in (
        (axes[0, 0], [199, 298], [0.3, 0.6]),
        (axes[1, 0], [199, 298], [0.15, 0.3]),
        (axes[2, 0], [99, 199, 298], [0.9, 0.9, 0.9]),
    ):
        (line,) = axis.get_lines()
        np.testing.assert_allclose(line.get_xdata(), x)
        np.testing.assert_allclose(line.get_ydata(), y)
        assert len(axis.collections) == 1  # the interval over the two


def test_the_legend_tells_plain_from_regularized(store, tmp_path, drawn):
    suite = load_suite("table2")
    for name in ("PPO", "PPO reg"):
        write_curves(store, suite, name, 1, [100, 200], [0.1, 0.2])
    success_curves(load_results(suite, store), tmp_path / "figure4.png")
    assert [text.get_text() for text in drawn().legends[0].get_texts()] == ["plain", "reg"]
    assert matplotlib.image.imread(tmp_path / "figure4.png").std() > 0.01


def test_a_figure_is_drawn_of_runs_that_were_never_evaluated_on_the_way(store, tmp_path, drawn):
    suite = load_suite("table2")
    write_curves(store, suite, "PPO", 1, [100, 200], [np.nan, np.nan])
    success_curves(load_results(suite, store), tmp_path / "figure4.png")
    (axis,) = drawn().axes
    assert axis.get_ylabel() == "psi"


def test_without_runs_there_is_no_picture(store, tmp_path):
    path = tmp_path / "figure4.png"
    assert not success_curves(load_results(load_suite("table2"), store), path)
    assert not path.exists()


def test_each_game_has_its_columns(tmp_path, drawn):
    games = {"CoinRun": "coinrun", "Maze": "maze"}
    results = make_games(tmp_path, lambda *_: EPISODES, ["PPO", "PPO reg"], games)
    success_curves(results, tmp_path / "figure4.png")
    titles = [axis.get_title() for axis in drawn().axes[:2]]
    assert titles == ["CoinRun: PPO", "Maze: PPO"]
