"""Table 1: cells, notes and formats, from results with known numbers."""

from __future__ import annotations

import numpy as np
import pytest
from rich.console import Console

from harness.report.paper import paper_numbers
from harness.report.results import load_results
from harness.report.table1 import (
    make_cells,
    notes,
    to_frame,
    to_markdown,
    to_rich,
)
from harness.suite import load_suite
from tests.harness.conftest import write_run


@pytest.fixture
def results(cells, store, suite):
    return load_results(suite, store)


@pytest.fixture
def cells(store, suite):
    """PPO on Hopper is complete; PPO reg on Hopper has one agent; nothing ran on Reacher."""
    for spec in suite.runs:
        if spec.environment == "Hopper" and spec.algorithm == "PPO":
            write_run(store, spec, [0.0, 10.0 * spec.args["seed"]])
        if spec.run_id == "ppo-reg__Hopper__s1__a0":
            write_run(store, spec, [7.0, np.nan, 9.0])
    return make_cells(load_results(suite, store))


def test_a_cell_is_the_mean_over_agents_of_their_final_score(cells):
    cell = cells[0]
    assert (cell.algorithm, cell.environment) == ("PPO", "Hopper")
    # two agents of seed 1 score 5, two of seed 2 score 10
    assert cell.estimate.mean == 7.5
    assert 5.0 <= cell.estimate.low < 7.5 < cell.estimate.high <= 10.0
    assert (cell.seeds, cell.agents, cell.planned, cell.steps, cell.updates) == (2, 4, 4, 200, 2)
    assert cell.paper == 106.8


def test_one_agent_has_a_mean_and_no_interval(cells):
    assert cells[1].text == "8.0"
    assert (cells[1].seeds, cells[1].agents, cells[1].planned) == (1, 1, 4)


def test_missing_cells_are_missing(cells, results):
    assert [c.text for c in cells[2:]] == ["–", "–"]
    said = "\n".join(notes(results, cells))
    assert "Missing (–): PPO on Reacher, PPO reg on Reacher." in said
    assert "Incomplete: PPO reg on Hopper (1 of 4)." in said


def test_the_notes_say_how_much_shorter_the_runs_are(cells, results):
    said = "\n".join(notes(results, cells))
    assert "Steps done: 200 to 300; the paper's runs have 5,000,000." in said
    assert "fewer than 100: 2 to 3 here" in said


def test_one_short_cell_among_long_ones_is_told(store, suite):
    for spec in suite.runs:
        write_run(store, spec, [1.0] * (2 if spec.environment == "Hopper" else 60_000))
    results = load_results(suite, store)
    said = "\n".join(notes(results, make_cells(results)))
    assert "Steps done: 200 to 6,000,000" in said
    assert "2 to 100 here" in said


def test_runs_of_another_configuration_are_left_out_and_named(store, suite, suite_file):
    for spec in suite.runs:
        write_run(store, spec, [1.0])
    results = load_results(load_suite(str(suite_file), total_timesteps=300), store)
    cells = make_cells(results)
    assert all(c.agents == 0 for c in cells)
    assert (
        "Left out, since run with other settings: ppo__Hopper__s1__a0" in notes(results, cells)[-1]
    )


def test_smoke_says_what_it_is_not():
    suite = load_suite("smoke")
    assert "shorter than the paper's" in suite.note


def test_markdown_is_a_table_beside_the_papers_numbers(cells, results):
    lines = to_markdown(results, cells).splitlines()
    assert "| task | PPO | PPO, paper | PPO reg | PPO reg, paper |" in lines
    hopper = next(line for line in lines if line.startswith("| Hopper"))
    assert hopper.startswith("| Hopper | 7.5 [")
    assert hopper.endswith("] | 106.8 | 8.0 | 18.6 |")
    assert "| Reacher | – | -13.5 | – | -7.4 |" in lines
    assert "| Hopper | PPO | 4 of 4 | 2 | 200 | 2 |" in lines
    assert "| Reacher | PPO | 0 of 4 | 0 | 0 | 0 |" in lines


def test_the_frame_has_a_row_for_each_cell(cells):
    frame = to_frame(cells)
    assert list(frame["mean"].dropna()) == [7.5, 8.0]
    assert {"low", "high", "seeds", "agents", "steps", "paper"} <= set(frame.columns)


def test_the_terminal_shows_every_task(cells, results):
    console = Console(record=True, width=120)
    console.print(to_rich(results, cells))
    text = console.export_text()
    assert "Hopper" in text
    assert "106.8" in text


def test_every_number_of_the_paper_is_there():
    paper = paper_numbers("table1")
    tasks = set(load_suite("table1").environments)
    for algorithm in ("PPO", "PPO reg", "TRPO", "TRPO reg"):
        assert set(paper[algorithm]) == tasks
