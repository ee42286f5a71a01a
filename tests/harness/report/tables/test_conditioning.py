"""J at the end of training."""

from __future__ import annotations

import numpy as np
import pytest

from harness.report.results import load_results
from harness.report.tables.conditioning import conditioning_table, to_rows
from tests.harness.conftest import write_run

Q50, BELOW, SHARE = (
    f"conditioning/{name}" for name in ("quotient_q50", "fraction_below", "gradient_share")
)


def test_a_row_is_the_mean_over_agents_at_the_end(store, suite):
    """The window of 200 steps is the last 20: the last update of 100."""
    for spec in suite.runs:
        if spec.environment == "Reacher" and spec.algorithm == "PPO reg":
            last = 1.0 + spec.args["agent"]
            logged = {Q50: [9.0, last], BELOW: [0.0, 0.25], SHARE: [np.nan, np.nan]}
            write_run(store, spec, [1.0, 2.0], [5.0, 0.5], columns=logged)
    table = conditioning_table(load_results(suite, store))
    assert list(table.columns) == ["task", "algorithm", "n", "psi", "J, median", "below 1"]
    (row,) = table.to_dict("records")
    assert row == {"task": "Reacher", "algorithm": "PPO reg", "n": 4, "psi": 0.5,
                   "J, median": 1.5, "below 1": 0.25}  # fmt: skip
    header, rows = to_rows(table)
    assert header == list(table.columns)
    assert rows == [["Reacher", "PPO reg", "4", "0.500", "1.50", "25%"]]


def test_rows_come_in_the_suites_order_and_gaps_are_dashes(store, suite):
    for spec in reversed(suite.runs):
        if spec.args["agent"] == 0 and spec.args["seed"] == 1:
            share = 0.0123 if spec.algorithm == "PPO reg" else np.nan
            write_run(store, spec, [1.0], columns={SHARE: [share]})
    _, rows = to_rows(conditioning_table(load_results(suite, store)))
    assert [row[:2] for row in rows] == [
        ["Hopper", "PPO"], ["Hopper", "PPO reg"], ["Reacher", "PPO"], ["Reacher", "PPO reg"],
    ]  # fmt: skip
    assert [row[-1] for row in rows] == ["–", "1.2%"] * 2


@pytest.mark.parametrize("runs", [0])
def test_without_runs_there_are_no_rows(store, suite, runs):
    assert len(conditioning_table(load_results(suite, store))) == runs
