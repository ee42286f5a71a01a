"""Table 1: cells, notes and formats, from results with known numbers."""

from __future__ import annotations

import numpy as np
import pytest
from rich.console import Console

from harness.report.table1 import (
    make_cells,
    notes,
    paper_numbers,
    to_frame,
    to_markdown,
    to_rich,
)
from harness.suite import load_suite
from tests.harness.conftest import write_run


@pytest.fixture
def cells(store, suite):
    """PPO on Hopper is complete; PPO reg on Hopper has one agent; nothing ran on Reacher."""
    for spec in suite.runs:
        if spec.environment == "Hopper" and spec.algorithm == "PPO":
            write_run(store, spec, [0.0, 10.0 * spec.args["seed"]])
        if spec.run_id == "ppo-reg__Hopper__s1__a0":
            write_run(store, spec, [7.0, np.nan, 9.0])
    return make_cells(suite, store)


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


def test_missing_cells_are_missing(cells, suite):
    assert [c.text for c in cells[2:]] == ["–", "–"]
    said = "\n".join(notes(suite, cells))
    assert "Missing (–): PPO on Reacher, PPO reg on Reacher." in said
    assert "Agents so far: PPO reg on Hopper (1/4)." in said


def test_the_notes_say_how_much_shorter_the_runs_are(cells, suite):
    said = "\n".join(notes(suite, cells))
    assert "Steps done: 0 to 300, against the paper's 5,000,000" in said
    assert "at most 3: fewer than the paper's 100" in said


def test_smoke_says_what_it_is_not():
    suite = load_suite("smoke")
    assert "shorter than the paper's" in suite.note


def test_markdown_is_a_table_beside_the_papers_numbers(cells, suite):
    lines = to_markdown(suite, cells).splitlines()
    assert "| task | PPO | PPO, paper | PPO reg | PPO reg, paper |" in lines
    hopper = next(line for line in lines if line.startswith("| Hopper"))
    assert hopper.startswith("| Hopper | 7.5 [")
    assert hopper.endswith("] | 106.8 | 8.0 | 18.6 |")
    assert "| Reacher | – | -13.5 | – | -7.4 |" in lines


def test_the_frame_has_a_row_for_each_cell(cells):
    frame = to_frame(cells)
    assert list(frame["mean"].dropna()) == [7.5, 8.0]
    assert {"low", "high", "seeds", "agents", "steps", "paper"} <= set(frame.columns)


def test_the_terminal_shows_every_task(cells, suite):
    console = Console(record=True, width=120)
    console.print(to_rich(suite, cells))
    text = console.export_text()
    assert "Hopper" in text
    assert "106.8" in text


def test_every_number_of_the_paper_is_there():
    paper = paper_numbers()
    tasks = set(load_suite("table1").environments)
    for algorithm in ("PPO", "PPO reg", "TRPO", "TRPO reg"):
        assert set(paper[algorithm]) == tasks
