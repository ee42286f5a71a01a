"""Table 1: cells, notes and formats, from results with known numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rich.console import Console

from harness.report.results import load_results
from harness.report.tables.table1 import (
    make_cells,
    notes,
    to_frame,
    to_markdown,
    to_rich,
    to_rows,
)
from harness.statistics import detectable_difference, estimate_mean
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
            write_run(store, spec, [0.0, 10.0 * spec.args["seed"] + spec.args["agent"]])
        if spec.run_id == "ppo-reg__Hopper__s1__a0":
            write_run(store, spec, [7.0, np.nan, 8.0])
    return make_cells(load_results(suite, store))


def test_a_cell_is_the_mean_over_agents_of_their_training_score(cells):
    cell = cells[0]
    assert (cell.algorithm, cell.environment) == ("PPO", "Hopper")
    assert cell.scores == (10.0, 11.0, 20.0, 21.0)
    assert cell.estimate.mean == 15.5
    assert (cell.seeds, cell.agents, cell.planned, cell.failed) == (2, 4, 4, 0)
    assert (cell.steps, cell.window) == (200, 20)
    assert cell.paper == 106.8


def test_a_cell_cannot_be_changed(cells):
    with pytest.raises(dataclasses.FrozenInstanceError):
        cells[0].failed = 1


def test_two_agents_have_a_range_too(study):
    cell = make_cells(study(lambda _, __, agent: 1.0 * agent, agents=2))[0]
    assert cell.text == "0.5 {0.0 to 1.0} (n 2, 0 failed, finds –)"


def test_steps_are_of_the_agent_that_has_done_the_fewest(store, suite):
    updates = {("PPO", 1, 0): 3, ("PPO", 1, 1): 2, ("PPO", 2, 0): 4}
    for spec in suite.runs:
        key = (spec.algorithm, spec.args["seed"], spec.args["agent"])
        if spec.environment == "Hopper" and key in updates:
            write_run(store, spec, [1.0] * updates[key])
    assert make_cells(load_results(suite, store))[0].steps == 200


def test_the_window_is_a_tenth_of_the_longest_run_of_the_cell(results):
    lengths = {"ppo__Hopper__s1__a0": 400, "ppo-reg__Hopper__s1__a0": 1000}
    runs = [
        run.with_args(total_timesteps=lengths.get(run.run_id, 200)) for run in results.suite.runs
    ]
    assert [run.run_id for run in runs] == [run.run_id for run in results.suite.runs]
    suite = dataclasses.replace(results.suite, runs=runs)
    cells = make_cells(dataclasses.replace(results, suite=suite))
    found = {(c.environment, c.algorithm): c.window for c in cells}
    assert found == {
        ("Hopper", "PPO"): 40, ("Hopper", "PPO reg"): 100,
        ("Reacher", "PPO"): 20, ("Reacher", "PPO reg"): 20,
    }  # fmt: skip


def test_few_agents_have_a_range_and_no_interval(cells):
    assert np.isnan(cells[0].estimate.low)
    assert cells[0].text == "15.5 {10.0 to 21.0} (n 4, 0 failed, finds –)"
    assert cells[1].text == "8.0 (n 1, 0 failed, finds –)"
    assert (cells[1].seeds, cells[1].agents, cells[1].planned) == (1, 1, 4)


def test_ten_agents_have_an_interval_and_what_they_could_have_found(study):
    cell = make_cells(study(lambda _, __, agent: 1.0 * agent))[0]
    spread = np.sqrt(2) * np.std(range(10), ddof=1)
    assert cell.detectable == pytest.approx(float(detectable_difference(spread, 10)))
    estimate = estimate_mean(np.arange(10.0))
    ends = f"[{estimate.low:.1f}, {estimate.high:.1f}]"
    assert cell.text == f"4.5 {ends} (n 10, 0 failed, finds {cell.detectable:.1f})"


def test_a_tenth_of_successes_anywhere_on_the_task_leaves_ranges(study):
    """PPO has no success among ten, PPO reg has one."""

    def reward(_task, name, agent):
        return 500.0 if (name, agent) == ("PPO reg", 4) else 1.0 * (agent % 2)

    cells = make_cells(study(reward))
    assert [c.text.split(" (")[0] for c in cells] == ["0.5 {0.0 to 1.0}", "50.5 {0.0 to 500.0}"]


def test_a_skewed_cell_beside_a_wide_one_has_no_interval(study):
    """Taken together the two do not look skewed: the wide one drowns the other."""

    def reward(_task, name, agent):
        return 1000.0 * agent if name == "PPO reg" else 50.0 - 40.0 * (agent == 0)

    cells = make_cells(study(reward))
    assert cells[0].text.startswith("46.0 {10.0 to 50.0}")
    assert cells[1].text.startswith("4500.0 [")


def test_two_valued_scores_have_an_interval_near_their_range(study):
    """Two values and a grain of noise: 900 for seven agents, 0 for three."""
    cell = make_cells(study(lambda _, __, agent: 900.0 * (agent < 7) + 0.01 * agent))[0]
    assert cell.text.startswith("630.0 [")
    assert -100.0 < cell.estimate.low < 400.0
    assert 800.0 < cell.estimate.high < 1000.0


def test_equal_scores_have_no_interval(study):
    cell = make_cells(study(lambda *_: 3.0))[0]
    assert cell.text.startswith("3.0 {3.0 to 3.0} (n 10")


def test_failed_agents_count_with_the_worst_of_their_task(study):
    results = study(
        lambda _, name, agent: agent - 20.0 * (name == "PPO reg"),
        diverged=lambda _, name, agent: (name, agent) == ("PPO", 9),
    )
    plain = make_cells(results)[0]
    assert (plain.agents, plain.failed) == (10, 1)
    assert plain.estimate.mean == pytest.approx((sum(range(9)) - 20) / 10)
    assert "1 failed" in plain.text
    failure = (
        "A failed run's numbers became non-finite. It counts with the worst score of its task."
    )
    assert failure in notes(results, make_cells(results))


def test_missing_cells_are_missing(cells, results):
    assert [c.text for c in cells[2:]] == ["–", "–"]
    assert notes(results, cells)[-2:] == [
        "Missing (–): PPO on Reacher, PPO reg on Reacher.",
        "Incomplete: PPO reg on Hopper (1 of 4).",
    ]
    half = [dataclasses.replace(cell, agents=2) for cell in cells]
    assert notes(results, half)[-1] == (
        "Incomplete: PPO on Hopper (2 of 4), PPO reg on Hopper (2 of 4), PPO on Reacher (2 of 4), "
        "PPO reg on Reacher (2 of 4)."
    )


def test_the_notes_say_how_much_shorter_the_runs_are(cells, results):
    assert notes(results, cells)[:3] == [
        "Steps done: 200 to 300; the paper's runs have 5,000,000. Shorter runs can neither confirm "
        "nor refute it.",
        "Training scores are over the last 20 steps; the paper's are over its last 100 updates, "
        "200,000 steps.",
        "Agents in a cell: 1 to 4; seeds: 1 to 2. The paper has 10 agents for each of 3 seeds.",
    ]


def test_one_short_cell_among_full_ones_is_told(cells, results):
    full = [dataclasses.replace(cell, agents=4, steps=5_000_000) for cell in cells]
    assert not any("Steps done" in line for line in notes(results, full))
    short = [dataclasses.replace(full[0], steps=4_999_999), *full[1:]]
    assert notes(results, short)[0].startswith("Steps done: 4,999,999 to 5,000,000; ")


def test_the_notes_begin_with_the_suites_own(cells, results):
    suite = dataclasses.replace(results.suite, note="Mind this.")
    assert notes(dataclasses.replace(results, suite=suite), cells)[0] == "Mind this."


EXPLAINED = [
    "[Brackets] hold the 95% interval of the mean over agents, Student's with a correction for "
    "skewness. {Braces} hold the smallest and the largest score, where there are fewer than 5 "
    "agents, or fewer than 30 with skewed scores, or where all scores are equal: no interval can "
    "be trusted there.",
    "In parentheses: agents, failed ones among them, and the difference to an arm of the same "
    "spread that would have been found with 80% power at 5%.",
]


@pytest.mark.parametrize(("agents", "explained"), [((1, 1), []), ((1, 2), EXPLAINED)])
def test_what_a_cell_holds_is_explained_if_any_has_two_agents(cells, results, agents, explained):
    some = [dataclasses.replace(c, agents=n) for c, n in zip(cells[:2], agents, strict=True)]
    said = notes(results, some)
    assert [line for line in said if line.startswith(("[Brackets]", "In parentheses"))] == explained


def test_full_runs_are_not_called_short(store, suite_file):
    suite_file.write_text(suite_file.read_text().replace("= 200", "= 5_000_000"))
    suite = load_suite(str(suite_file))
    for spec in suite.runs:
        write_run(store, spec, [1.0], columns={"global_step": [5_000_000]})
    results = load_results(suite, store)
    said = "\n".join(notes(results, make_cells(results)))
    assert "Steps done" not in said
    assert "over the last 200,000 steps" in said
    assert not {"Missing", "Incomplete", "failed run"} & set(said.split())


def test_runs_of_another_configuration_are_left_out_and_named(store, suite, suite_file):
    for spec in suite.runs:
        write_run(store, spec, [1.0])
    results = load_results(load_suite(str(suite_file), total_timesteps=300), store)
    cells = make_cells(results)
    assert all(c.agents == 0 for c in cells)
    left_out = ", ".join(spec.run_id for spec in suite.runs)
    assert notes(results, cells)[-1] == f"Left out, since run with other settings: {left_out}."


def test_smoke_says_what_it_is_not():
    suite = load_suite("smoke")
    assert "shorter than the paper's" in suite.note


def test_markdown_is_a_table_beside_the_papers_numbers(cells, results):
    lines = to_markdown(results, cells).splitlines()
    assert "| task | PPO | PPO, paper | PPO reg | PPO reg, paper |" in lines
    assert "What each cell rests on:" in lines
    assert "| task | algorithm | agents | failed | seeds | steps | window |" in lines
    hopper = next(line for line in lines if line.startswith("| Hopper"))
    assert hopper.startswith("| Hopper | 15.5 {")
    assert hopper.endswith(") | 106.8 | 8.0 (n 1, 0 failed, finds –) | 18.6 |")
    assert "| Reacher | – | -13.5 | – | -7.4 |" in lines
    assert "| Hopper | PPO | 4 of 4 | 0 | 2 | 200 | 20 |" in lines
    assert "| Reacher | PPO | 0 of 4 | 0 | 0 | 0 | 20 |" in lines
    assert lines[2] == (
        "Training score: mean return of the episodes that ended in the last tenth of the run, at "
        "most 200,000 steps."
    )
    assert lines[1] == ""
    assert to_markdown(results, cells).endswith("| 20 |\n")


def test_a_column_is_there_if_any_cell_is_and_a_cell_if_it_is_planned(cells, results):
    header, _ = to_rows(results.suite, [c for c in cells if c.algorithm == "PPO"])
    assert header == ["task", "PPO", "PPO, paper"]

    runs = [
        run for run in results.suite.runs if (run.environment, run.algorithm) != ("Hopper", "PPO")
    ]
    suite = dataclasses.replace(results.suite, runs=runs)
    planned = make_cells(dataclasses.replace(results, suite=suite))
    assert [(c.environment, c.algorithm) for c in planned] == [
        ("Hopper", "PPO reg"), ("Reacher", "PPO"), ("Reacher", "PPO reg"),
    ]  # fmt: skip
    assert to_rows(suite, planned)[1] == [
        ["Hopper", "", "", "8.0 (n 1, 0 failed, finds –)", "18.6"],
        ["Reacher", "–", "-13.5", "–", "-7.4"],
    ]


def test_a_task_that_the_paper_has_not_has_no_number_of_its(study):
    results = study(lambda *_: None, tasks=("Hopper", "Pendulum"))
    cells = make_cells(results)
    assert to_rows(results.suite, cells)[1][1] == ["Pendulum", "–", "", "–", ""]
    table = to_rich(results, cells)
    assert list(table.columns[1].cells)[1] == "–\n[dim]paper –[/]"


def test_the_frame_has_a_row_for_each_cell(cells):
    frame = to_frame(cells)
    assert list(frame["mean"].dropna()) == [15.5, 8.0]
    columns = {"low", "high", "seeds", "agents", "failed", "steps", "window", "detectable", "paper"}
    assert columns <= set(frame.columns)


def test_the_terminal_shows_every_task_with_the_papers_number_below(cells, results):
    console = Console(record=True, width=160)
    console.print(to_rich(results, cells))
    lines = console.export_text().splitlines()
    hopper = next(i for i, line in enumerate(lines) if "Hopper" in line)
    assert "15.5 {10.0 to 21.0}" in lines[hopper]
    assert "(n 4, 0 failed, finds –)" in lines[hopper + 1]
    assert "paper 106.8" in lines[hopper + 2]
    assert "paper 18.6" in lines[hopper + 2]
    reacher = next(i for i, line in enumerate(lines) if "Reacher" in line)
    assert "paper -13.5" in lines[reacher + 1]


def test_the_terminal_sets_numbers_to_the_right_and_what_was_published_below(cells, results):
    table = to_rich(results, cells)
    assert table.title == "tiny: training score"
    assert table.show_lines
    assert [column.header for column in table.columns] == ["task", "PPO", "PPO reg"]
    assert [column.justify for column in table.columns] == ["left", "right", "right"]
    assert [list(column.cells) for column in table.columns] == [
        ["Hopper", "Reacher"],
        ["15.5 {10.0 to 21.0}\n(n 4, 0 failed, finds –)\n[dim]paper 106.8[/]",
         "–\n[dim]paper -13.5[/]"],
        ["8.0\n(n 1, 0 failed, finds –)\n[dim]paper 18.6[/]", "–\n[dim]paper -7.4[/]"],
    ]  # fmt: skip


def test_names_with_brackets_and_commas_are_shown_as_they_are(cells, results):
    names = {"environments": ["Hopper [bold]"], "algorithms": ["PPO, big"]}
    suite = dataclasses.replace(results.suite, **names)
    cell = dataclasses.replace(cells[0], environment="Hopper [bold]", algorithm="PPO, big")
    table = to_rich(dataclasses.replace(results, suite=suite), [cell])
    assert [column.header for column in table.columns] == ["task", "PPO, big"]
    console = Console(record=True, width=160)
    console.print(table)
    assert "Hopper [bold]" in console.export_text()
    (shown,) = table.columns[1].cells
    assert shown.startswith("15.5 {10.0 to 21.0}")


def test_the_terminal_shows_intervals_in_their_brackets(study):
    results = study(lambda _, __, agent: 1.0 * agent)
    console = Console(record=True, width=160)
    console.print(to_rich(results, make_cells(results)))
    score, _, rests_on = make_cells(results)[0].text.partition(" (")
    text = console.export_text()
    assert score in text
    assert f"({rests_on}" in text


# --- final policies -------------------------------------------------------------------------------


def test_the_final_table_is_of_deterministic_episodes_alone(study):
    results = study(lambda *_: 1.0, final=lambda _, __, agent: 100.0 + agent)
    cells = make_cells(results, "final")
    assert [c.estimate.mean for c in cells] == [104.5, 104.5]
    header, rows = to_rows(results.suite, cells)
    assert header == ["task", "PPO", "PPO reg"]
    assert len(rows[0]) == 3
    about = "Final policy: mean return of its deterministic actions over the evaluation."
    assert to_markdown(results, cells, "final").splitlines()[2] == about
    assert to_rich(results, cells, "final").title == "synthetic: final policy"


def test_without_evaluations_the_final_table_is_empty(study):
    cells = make_cells(study(lambda *_: 1.0), "final")
    assert [c.agents for c in cells] == [0, 0]


def test_the_zoos_agents_stand_beside_strongs_final_policies(store):
    results = load_results(load_suite("strong"), store)
    cells = make_cells(results, "final")
    header, rows = to_rows(results.suite, cells)
    assert header == ["task", "PPO", "PPO, zoo", "PPO reg", "TRPO", "TRPO, zoo", "TRPO reg"]
    found = {row[0]: (row[2], row[5]) for row in rows}
    assert found["Hopper"] == ("2575 ± 223", "2565 ± 410")
    assert found["Reacher"] == ("17.1 ± 11", "14.7 ± 11.6")
    assert found["Humanoid"] == ("", "")
    assert not any(c.zoo for c in make_cells(results))
    table = to_rich(results, cells)
    assert [column.header for column in table.columns] == ["task", "PPO", "PPO reg", "TRPO",
                                                           "TRPO reg"]  # fmt: skip
    ppo = dict(zip(table.columns[0].cells, table.columns[1].cells, strict=True))
    assert ppo["Hopper"] == "–\n[dim]zoo 2575 ± 223[/]"
    assert ppo["Humanoid"] == "–\n[dim]zoo –[/]"
