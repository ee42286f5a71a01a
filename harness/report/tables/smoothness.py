"""How smooth the actions of final policies are, beside what the policies return."""

from __future__ import annotations

import pandas as pd

from harness.report.results import Results
from harness.report.tables.text import number

MEASURES = {"|Δa|": "action_change", "Sm": "smoothness"}
NOTES = (
    "Of the deterministic, executed actions: the mean of |a_{t+1} − a_t|, and Sm of Mysore et al. "
    "(2021), 2 / (n f_s) Σ M_i f_i over the single-sided amplitude spectrum of each action. "
    "Smaller is smoother. Means over episodes, then over agents. Sm of a sine halves where an "
    "episode is twice as long, so compare it between policies of equal returns.",
)


def smoothness_table(results: Results, algorithms: list[str]) -> pd.DataFrame:
    """A row for each task, a column for each algorithm and measure; NaN where none was played."""
    rows = []
    for run in results.suite.runs:
        episodes = results.evaluations.get(run.run_id)
        if run.algorithm in algorithms and episodes is not None and "smoothness" in episodes:
            played = episodes[episodes["policy"] == "deterministic"]
            own = {name: played[column].mean() for name, column in MEASURES.items()}
            rows.append({"task": run.environment, "algorithm": run.algorithm, **own})
    frame = pd.DataFrame(rows, columns=["task", "algorithm", *MEASURES])
    means = frame.groupby(["task", "algorithm"]).mean().unstack("algorithm")
    means.columns = pd.Index([f"{algorithm}, {name}" for name, algorithm in means.columns])
    columns = [f"{algorithm}, {name}" for algorithm in algorithms for name in MEASURES]
    tasks = [task for task in results.suite.environments if task in means.index]
    return means.reindex(tasks, columns=[c for c in columns if c in means]).reset_index()


def to_rows(table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each task."""
    rows = [
        [value if isinstance(value, str) else number(value) for value in row]
        for row in table.to_numpy().tolist()
    ]
    return list(table.columns), rows
