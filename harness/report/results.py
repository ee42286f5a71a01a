"""What a suite's runs have left so far, read once for all reports."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pandas as pd

from harness.store import Store, read_json
from harness.suite import Suite

TIMED = "cost.csv"  # in the results' folder


@dataclasses.dataclass(frozen=True)
class Results:
    """The metrics of each run that has any, by run id."""

    suite: Suite
    metrics: dict[str, pd.DataFrame]
    changed: list[str]
    """ids of runs that were made by another configuration: left out"""
    done: list[str]
    """ids of runs that are complete"""
    evaluations: dict[str, pd.DataFrame]
    """episodes of the final policy, by run id, of the runs that were evaluated: on seen and unseen
    levels, or on a control task"""
    folders: dict[str, Path]
    """where each run's files are, by run id"""
    diverged: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    """what became non-finite, and when, by run id: an outcome, no missing run"""
    specs: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    """what each run says of itself: its implementation and its machine among it"""
    timed: pd.DataFrame | None = None
    """what `python -m harness cost` has measured, if it has"""

    def part(self, evaluated: bool) -> Results:
        """The runs that are evaluated on levels, or the others: the control tasks."""
        runs = [run for run in self.suite.runs if ("levels" in run.evaluation) == evaluated]
        named = {run.algorithm for run in runs}
        tasks = {run.environment for run in runs}
        suite = dataclasses.replace(
            self.suite,
            runs=runs,
            algorithms=[name for name in self.suite.algorithms if name in named],
            environments=[task for task in self.suite.environments if task in tasks],
        )
        ids = {run.run_id for run in runs}
        evaluations = {run_id: x for run_id, x in self.evaluations.items() if run_id in ids}
        return dataclasses.replace(self, suite=suite, evaluations=evaluations)

    def evaluations_of(self, environment: str, algorithm: str) -> dict[str, pd.DataFrame]:
        """The evaluated episodes of one algorithm's agents, by run id."""
        return {
            run.run_id: self.evaluations[run.run_id]
            for run in self.suite.runs
            if (run.environment, run.algorithm) == (environment, algorithm)
            and run.run_id in self.evaluations
        }

    def pairs(self, environment: str, algorithm: str) -> dict[tuple[int, int], pd.DataFrame]:
        """The same, by (seed, agent)."""
        key = {run.run_id: (run.args["seed"], run.args["agent"]) for run in self.suite.runs}
        found = self.evaluations_of(environment, algorithm)
        return {key[run_id]: episodes for run_id, episodes in found.items()}

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
    metrics = {}
    evaluations = {}
    diverged = {}
    specs = {}
    changed = []
    done = []
    for run in suite.runs:
        if store.changes(run):
            changed.append(run.run_id)
            continue
        specs[run.run_id] = read_json(store.path(run, "spec.json")) or {}
        if (failure := read_json(store.path(run, "diverged.json"))) is not None:
            diverged[run.run_id] = failure
        if (found := store.metrics(run)) is None:
            continue
        metrics[run.run_id] = found
        if store.is_done(run):
            done.append(run.run_id)
            if (path := store.path(run, "evaluation.csv")).exists():
                evaluations[run.run_id] = pd.read_csv(path)
    folders = {run.run_id: store.path(run) for run in suite.runs}
    timed = pd.read_csv(path) if (path := store.root / TIMED).exists() else None
    return Results(suite, metrics, changed, done, evaluations, folders, diverged, specs, timed)
