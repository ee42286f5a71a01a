"""What a suite's runs have left so far, read once for all reports."""

from __future__ import annotations

import dataclasses

import pandas as pd

from harness.store import Store
from harness.suite import Suite


@dataclasses.dataclass(frozen=True)
class Results:
    """The metrics of each run that has any, by run id."""

    suite: Suite
    metrics: dict[str, pd.DataFrame]
    changed: list[str]
    """ids of runs that were made by another configuration: left out"""
    done: list[str]
    """ids of runs that are complete"""

    def of(self, environment: str, algorithm: str) -> dict[str, pd.DataFrame]:
        """The metrics of one algorithm's agents on one environment, by run id."""
        return {
            run.run_id: self.metrics[run.run_id]
            for run in self.suite.runs
            if (run.environment, run.algorithm) == (environment, algorithm)
            and run.run_id in self.metrics
        }

    def curves(self, environment: str, algorithm: str, measure: str) -> pd.DataFrame:
        """One measure against environment steps: a row for each step count, a column an agent."""
        found = self.of(environment, algorithm)
        return pd.DataFrame({k: m.set_index("global_step")[measure] for k, m in found.items()})


def load_results(suite: Suite, store: Store) -> Results:
    """Read what there is; runs may be unfinished, or still be running."""
    metrics, changed, done = {}, [], []
    for run in suite.runs:
        if store.changes(run):
            changed.append(run.run_id)
        elif (found := store.metrics(run)) is not None:
            metrics[run.run_id] = found
            done += [run.run_id] if store.is_done(run) else []
    return Results(suite, metrics, changed, done)
