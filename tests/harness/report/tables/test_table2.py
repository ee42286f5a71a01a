"""Table 2, from episodes with known rates."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy import stats

from harness.report.results import load_results
from harness.report.tables.table2 import (
    THEMES,
    make_cells,
    notes,
    to_frame,
    to_markdown,
    to_rich,
    to_rows,
)
from harness.suite import load_suite
from tests.harness.conftest import make_episodes, write_run
from tests.harness.report.conftest import make_games

SEEN, UNSEEN = [[1, 1], [1, 0]], [[0, 1], [0, 0]]  # rates 3/4 and 1/4
HALF = [[1], [0]]
SURE = "100.0 [100.0, 100.0] (n 1, 0 failed, finds –)"
EVEN = "50.0 [0.0, 100.0] (n 1, 0 failed, finds –)"


def episodes(seen=SEEN, unseen=UNSEEN, seen_greedy=HALF, unseen_greedy=HALF) -> pd.DataFrame:
    return make_episodes(
        seen_sampled=seen, unseen_sampled=unseen, seen_greedy=seen_greedy,
        unseen_greedy=unseen_greedy,
    )  # fmt: skip


@pytest.fixture
def results(store):
    """Of the eight agents PPO is always right, PPO reg has three of four, PPO-l2 still learns."""
    suite = load_suite("table2")
    runs = {run.algorithm: run for run in suite.runs}
    sure = [[1, 1], [1, 1]]
    write_run(store, runs["PPO"], [1.0] * 3, episodes=episodes(sure, sure))
    write_run(store, runs["PPO reg"], [1.0] * 4, episodes=episodes())
    write_run(store, runs["PPO-l2"], [1.0] * 9, episodes=episodes(), done=False)
    return load_results(suite, store)


@pytest.fixture
def cells(results):
    return {(c.algorithm, c.split, c.policy): c for c in make_cells(results)}


def test_every_agent_has_a_cell_for_each_kind_of_levels_and_actions(results, cells):
    kinds = itertools.product(results.suite.algorithms, ("seen", "unseen"), ("sampled", "greedy"))
    assert set(cells) == set(kinds)


def test_a_cell_is_the_success_rate_over_levels(cells):
    cell = cells["PPO reg", "seen", "sampled"]
    assert cell.estimate.mean == 0.75
    assert cells["PPO reg", "unseen", "sampled"].estimate.mean == 0.25
    assert cells["PPO reg", "unseen", "greedy"].estimate.mean == 0.5
    assert (cell.estimate.n, cell.planned, cell.levels, cell.repeats) == (1, 1, 2, 2)
    greedy = cells["PPO reg", "seen", "greedy"]
    assert (greedy.levels, greedy.repeats) == (2, 1)
    assert (cell.steps, cells["PPO", "seen", "sampled"].steps) == (400, 300)


def test_a_cell_says_percent_with_its_interval(cells):
    assert cells["PPO", "seen", "sampled"].text == SURE
    # two levels, won and lost: Student's interval with one degree of freedom is all there is
    assert cells["PPO", "seen", "greedy"].text == EVEN
    assert cells["PPO reg", "seen", "sampled"].text.startswith("75.0 [")


def test_an_agent_that_is_not_done_has_no_cell_yet(cells):
    assert cells["PPO-l2", "seen", "sampled"].text == "–"
    learning, waiting = cells["PPO-l2", "seen", "sampled"], cells["PPO-D", "seen", "sampled"]
    assert (learning.levels, learning.repeats, learning.steps) == (0, 0, 900)
    assert (waiting.levels, waiting.repeats, waiting.steps) == (0, 0, 0)


def test_a_cell_is_as_long_as_its_shortest_run_and_the_notes_name_the_fullest_cell(store):
    """PPO has runs of 3, 2 and 4 updates of 100 steps, PPO reg one of 5."""
    suite = load_suite("table2", seeds=3)
    updates = {("PPO", 1): 3, ("PPO", 2): 2, ("PPO", 3): 4, ("PPO reg", 1): 5}
    for run in suite.runs:
        if length := updates.get((run.algorithm, run.args["seed"])):
            write_run(store, run, [1.0] * length, episodes=episodes())
    results = load_results(suite, store)
    cells = make_cells(results)
    assert {c.steps for c in cells if c.algorithm == "PPO"} == {200}
    said = notes(results, cells)
    assert "at most 3; the paper has 1" in said[1]
    assert said[2].startswith("Steps done: 200;")


def test_the_papers_numbers_stand_beside_the_sampled_actions(results, cells):
    algorithms = results.suite.algorithms
    seen = [cells[a, "seen", "sampled"].paper for a in algorithms]
    unseen = [cells[a, "unseen", "sampled"].paper for a in algorithms]
    assert seen == [55, 60.7, 57.2, 61, 54.5, 60.2, 59, 68.2]
    assert unseen == [14, 20, 18.5, 30.5, 19.2, 20, 26, 32.8]
    assert {c.paper for c in cells.values() if c.policy == "greedy"} == {None}


def test_the_notes_say_what_the_cells_rest_on(results, cells):
    said = notes(results, list(cells.values()))
    assert said[0].startswith("2 seen and 2 unseen levels, 2 repeats")
    assert said[0].endswith("The paper: 500 training levels, 20 repeats.")
    assert said[1] == (
        "Training runs in a cell: at most 1; the paper has 1. Brackets hold the 95% interval over "
        "levels; from 5 runs on over training runs and levels. Fewer runs say nothing of another "
        "training run."
    )
    assert said[2] == (
        "Steps done: 300; the paper's runs have 50,000,000. Shorter runs can neither confirm nor "
        "refute it."
    )
    others = "PPO-D, PPO-D reg, PPO-IMP, PPO-IMP reg, PPO-l2, PPO-l2 reg"
    assert said[3] == f"Not all evaluated yet: {others}."
    assert len(said) == 5
    assert "Ours are the levels that follow the training set, with" in said[4]


@pytest.mark.parametrize(("steps", "short"), [(47_499_999, True), (47_500_000, False)])
def test_runs_below_95_percent_of_the_papers_length_are_short(results, cells, steps, short):
    same = [dataclasses.replace(cell, steps=steps) for cell in cells.values()]
    assert any("Steps done" in line for line in notes(results, same)) == short


def test_a_cell_cannot_be_changed(cells):
    with pytest.raises(dataclasses.FrozenInstanceError):
        cells["PPO", "seen", "sampled"].failed = 1


def test_full_runs_that_are_all_there_are_not_called_short_or_missing(store):
    suite = load_suite("table2")
    for run in suite.runs:
        write_run(store, run, [1.0], columns={"global_step": [49_000_000]}, episodes=episodes())
    results = load_results(suite, store)
    said = notes(results, make_cells(results))
    assert len(said) == 3


def test_without_runs_there_are_the_papers_numbers(store):
    results = load_results(load_suite("table2"), store)
    cells = make_cells(results)
    said = notes(results, cells)
    assert said[0].startswith("Not all evaluated yet: PPO, ")
    assert len(said) == 2
    _, rows = to_rows(results, cells)
    assert rows[0][:3] == ["PPO", "–", "55.0"]


@pytest.mark.parametrize(
    ("unseen", "words"),
    [
        ("next", "Ours are the levels that follow the training set, with the themes"),
        ("unbounded", "Ours are levels drawn without bound, with the themes"),
        ("themes", "Ours are the levels that follow the training set, with the themes"),
    ],
)
def test_what_the_unseen_levels_are_is_said(tmp_path, unseen, words):
    results = games_of(tmp_path, ["PPO"], {"CoinRun": "coinrun"})
    runs = [
        dataclasses.replace(run, evaluation={**run.evaluation, "unseen": unseen})
        for run in results.suite.runs
    ]
    suite = dataclasses.replace(results.suite, runs=runs)
    said = notes(dataclasses.replace(results, suite=suite), make_cells(results))
    note = next(line for line in said if line.startswith("The paper's unseen levels are new in"))
    assert words in note
    assert "other levels, themes that training never showed, and difficulty 3 only, where" in note
    assert note.endswith("So the two unseen columns are not of the same test.")


def test_rows_are_agents_and_columns_kinds_of_levels_beside_the_paper(results, cells):
    header, rows = to_rows(results, list(cells.values()))
    assert header == [
        "agent", "seen", "seen, paper", "unseen", "unseen, paper", "seen, greedy", "unseen, greedy",
    ]  # fmt: skip
    assert [row[0] for row in rows] == results.suite.algorithms
    assert {len(row) for row in rows} == {7}
    assert rows[0][1:] == [SURE, "55.0", SURE, "14.0", EVEN, EVEN]
    assert rows[2][1:] == ["–", "57.2", "–", "18.5", "–", "–"]


def test_markdown_has_the_table_and_the_notes(results, cells):
    lines = to_markdown(results, list(cells.values())).splitlines()
    assert lines[0] == f"# {results.suite.title}"
    row = next(line for line in lines if line.startswith("| PPO |"))
    assert row.startswith(f"| PPO | {SURE} | 55.0 | {SURE} |")
    assert [line for line in lines if line.startswith("- ")][-1].endswith("not of the same test.")


def test_an_agent_has_no_row_in_a_game_that_it_is_not_planned_for(tmp_path):
    results = games_of(tmp_path, ["PPO", "PPO reg"], {"CoinRun": "coinrun", "Maze": "maze"})
    runs = [
        run for run in results.suite.runs if (run.environment, run.algorithm) != ("Maze", "PPO")
    ]
    results = dataclasses.replace(results, suite=dataclasses.replace(results.suite, runs=runs))
    cells = make_cells(results)
    assert len(cells) == 3 * 2 * 2  # agents, kinds of levels, kinds of actions
    _, rows = to_rows(results, cells)
    assert [row[0] for row in rows] == ["CoinRun: PPO", "CoinRun: PPO reg", "Maze: PPO reg"]


def test_the_frame_has_a_row_for_each_cell(cells):
    frame = to_frame(list(cells.values()))
    assert len(frame) == 8 * 4
    columns = {"algorithm", "split", "policy", "mean", "low", "high", "n", "paper", "steps"}
    assert columns <= set(frame.columns)
    assert frame["mean"].dropna().tolist() == [1.0, 1.0, 0.5, 0.5, 0.75, 0.25, 0.5, 0.5]


def test_the_terminal_shows_an_agent_to_a_line(results, cells):
    console = Console(record=True, width=140)
    console.print(to_rich(results, list(cells.values())))
    text = console.export_text()
    line = next(line for line in text.splitlines() if "PPO reg" in line)
    assert "75.0 [" in line
    assert "100.0 [100.0, 100.0]" in text
    assert "32.8" in text


def test_the_terminal_sets_numbers_to_the_right_and_what_they_rest_on_below(results, cells):
    table = to_rich(results, list(cells.values()))
    assert [column.justify for column in table.columns] == ["left", *["right"] * 6]
    assert table.title == "table2: success rate on CoinRun levels, %"
    first = [next(iter(column.cells)) for column in table.columns]
    assert first[:3] == ["PPO", "100.0 \\[100.0, 100.0]\n(n 1, 0 failed, finds –)", "55.0"]


def test_a_cell_of_five_runs_says_what_it_could_have_found(store):
    suite = load_suite("table2", seeds=5)
    for run in suite.runs:
        if run.algorithm == "PPO":
            seen = [[1, 1], [1, 1]] if run.args["seed"] % 2 else [[1, 0], [1, 0]]
            write_run(store, run, [0.0], episodes=episodes(seen=seen), diverged=False)
    cell = make_cells(load_results(suite, store))[0]
    error = np.std([1, 0.5, 1, 0.5, 1], ddof=1) / np.sqrt(5)
    reach = stats.t.ppf(0.975, 4) + stats.t.ppf(0.8, 4)
    assert cell.detectable == pytest.approx(np.sqrt(2) * error * reach)
    assert cell.text.endswith(f"(n 5, 0 failed, finds {100 * cell.detectable:.1f})")


def test_failed_runs_are_counted(store):
    suite = load_suite("table2")
    write_run(store, suite.runs[0], [0.0], episodes=episodes(), diverged=True)
    cells = make_cells(load_results(suite, store))
    assert [cell.failed for cell in cells] == [1] * 4 + [0] * 28
    assert "1 failed" in cells[0].text


def games_of(folder, algorithms, games):
    return make_games(folder, lambda game, *_: episodes([[game == "Maze"] * 2]), algorithms, games)


def test_each_game_has_its_rows_and_only_coinrun_the_papers_numbers(tmp_path):
    results = games_of(tmp_path, ["PPO", "PPO reg"], {"CoinRun": "coinrun", "Maze": "maze"})
    _, rows = to_rows(results, make_cells(results))
    assert [row[:3] for row in rows[::2]] == [
        ["CoinRun: PPO", "0.0 (n 1, 0 failed, finds –)", "55.0"],
        ["Maze: PPO", "100.0 (n 1, 0 failed, finds –)", ""],
    ]


# --- unseen themes --------------------------------------------------------------------------------


@pytest.fixture
def themed(store):
    """PPO is right in a half of the levels with all themes, PPO reg in three of four."""
    suite = load_suite("themes", seeds=1)
    for run in suite.runs:
        in_all_themes = SEEN if run.algorithm == "PPO reg" else [[1, 0], [0, 1]]
        found = [episodes(), make_episodes(themes_sampled=in_all_themes, themes_greedy=HALF)]
        write_run(store, run, [1.0] * 3, episodes=pd.concat(found))
    return load_results(suite, store)


def test_themes_are_a_third_kind_of_levels_without_a_number_of_the_papers(themed):
    cells = make_cells(themed)
    found = {(c.algorithm, c.split): c for c in cells if c.policy == "sampled"}
    assert found["PPO", "themes"].estimate.mean == 0.5
    assert found["PPO reg", "themes"].estimate.mean == 0.75
    assert found["PPO", "themes"].paper is None
    assert found["PPO", "unseen"].paper == 14
    header, rows = to_rows(themed, cells)
    assert header == ["agent", "seen", "seen, paper", "unseen", "unseen, paper", "themes",
                      "seen, greedy", "unseen, greedy", "themes, greedy"]  # fmt: skip
    assert [len(row) for row in rows] == [len(header)] * 2
    assert rows[0][5].startswith("50.0 [")
    assert rows[0][4] == "14.0"


def test_what_the_themes_are_is_said_where_there_are_any(themed, results):
    said = notes(themed, make_cells(themed))
    assert said.count(THEMES) == 1
    assert THEMES not in notes(results, make_cells(results))
    assert THEMES.startswith("These agents trained with one theme each of the player, the ground, ")
    assert (
        "the enemies. Themes are the unseen levels once more, in all themes: nearest to" in THEMES
    )
    assert "the paper's unseen levels, which have other themes than training throughout" in THEMES
    assert THEMES.endswith("are unbounded in number, and are all of difficulty 3.")
