"""J by the yardstick at the end of training: its quantiles, what lies outside the range, its share.

Every number is the mean over agents of the mean over the training score's window.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from harness.report.results import Results
from harness.report.tables.text import number

COLUMNS = {
    "psi": "conditioning/psi",
    "J, 5%": "conditioning/quotient_q05",
    "J, median": "conditioning/quotient_q50",
    "J, 95%": "conditioning/quotient_q95",
    "J, executed": "conditioning/quotient_executed",
    "below 1": "conditioning/fraction_below",
    "above 20": "conditioning/fraction_above",
    "own psi": "conditioning/own_psi",
    "gradient share": "conditioning/gradient_share",
}
PERCENT = ("below 1", "above 20", "gradient share")
NOTES = (
    "J and psi are those of the paper's settings in every run, whatever it trains with: range 1 to "
    "20, delta of length 1, clean observations, the policy's mean. Own psi is what the run's own "
    "settings give. J, executed is the median J of the action after it is clipped to its box.",
    "Below 1 and above 20 are shares of the states. Gradient share is ‖gradient of the penalty‖ / "
    "‖gradient of the rest of the policy's loss‖, measured every 25 updates.",
)


def conditioning_table(results: Results) -> pd.DataFrame:
    """A row for each task and algorithm that has run; columns that no run has logged are left out.

    Where no update of the window measured a number, it is NaN.
    """
    rows = []
    for run in results.suite.runs:
        scores = results.scores.get(run.run_id)
        if scores:
            own = {name: scores.get(f"final/{column}", np.nan) for name, column in COLUMNS.items()}
            rows.append({"task": run.environment, "algorithm": run.algorithm, **own})
    frame = pd.DataFrame(rows, columns=["task", "algorithm", *COLUMNS])
    keys = ["task", "algorithm"]
    means = frame.groupby(keys, sort=False).mean().dropna(axis="columns", how="all")
    means.insert(0, "n", frame.groupby(keys, sort=False).size())
    order = [
        (task, name)
        for task in results.suite.environments
        for name in results.suite.algorithms
        if (task, name) in means.index
    ]
    return means.loc[order].reset_index()


def to_rows(table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each task and algorithm."""
    rows = [
        [_cell(name, value) for name, value in row.items()]
        for row in table.to_dict("records")
    ]  # fmt: skip
    return list(table.columns), rows


def _cell(name: str, value: str | float) -> str:
    if isinstance(value, str) or name == "n":
        return str(value)
    if name in PERCENT:
        return "–" if np.isnan(value) else f"{number(100 * value, 2)}%"
    return number(value)
