"""What a suite's runs have left so far, read once for all reports."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pandas as pd

from harness.evaluation.settings import answers
from harness.files import StoreError
from harness.provenance import Origins, find_origins
from harness.record import Record, thin
from harness.scores import VERSION, exact_scores
from harness.store import Store
from harness.suite import RunSpec, Suite

TIMED = "cost.csv"  # in the results' folder


@dataclasses.dataclass(frozen=True)
class Results:
    """What each run that has any metrics has left, by run id."""

    suite: Suite
    metrics: dict[str, pd.DataFrame]
    """rows for drawing: all updates, or means over blocks of them"""
    changed: list[str]
    """ids of runs that were made by another configuration: left out"""
    done: list[str]
    """ids of runs that are complete, those that diverged too"""
    evaluations: dict[str, pd.DataFrame]
    """episodes of the final policy, by run id, of the runs that were evaluated: on seen and unseen
    levels, or on a control task"""
    folders: dict[str, Path]
    """where each run's files are, or would be, by run id"""
    diverged: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    """update, what and message of the runs that diverged, by run id"""
    specs: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    """content of each run's spec.json, by run id"""
    scores: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict)
    """exact numbers from every row, as `harness.scores` names them; also of runs under way"""
    warnings: list[str] = dataclasses.field(default_factory=list)
    """sentences about runs that cannot be read or must not be mixed with the others"""
    timed: pd.DataFrame | None = None
    """what `python -m harness cost` has measured, if it has"""

    @property
    def origins(self) -> Origins:
        """The code, versions and machines behind the runs of this part of the suite."""
        runs = [run.run_id for run in self.suite.runs]
        return find_origins(self.specs[run_id] for run_id in runs if run_id in self.specs)

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
        return pd.DataFrame(
            {k: m.set_index("global_step")[measure] for k, m in found.items() if measure in m}
        )


def load_results(suite: Suite, store: Store) -> Results:
    """Read what there is, here and in archives; runs may be unfinished, or still be running.

    A run whose files are damaged is left out and named.

    Raises:
        ArchiveError: An archive is damaged, or holds another outcome of a run than another place.
    """
    records: dict[str, Record] = {}
    damaged: dict[str, str] = {}
    for run in suite.runs:
        try:
            if record := store.record(run):
                records[run.run_id] = record
        except StoreError as error:
            damaged[run.run_id] = f"{error}."
    metrics = {run_id: record.curves for run_id, record in records.items() if len(record.curves)}
    scores = {run_id: records[run_id].scores for run_id in metrics}
    specs = {run_id: record.spec for run_id, record in records.items()}
    changed = []
    for run in suite.runs:
        if run.run_id in records or run.run_id in damaged:
            continue
        if store.changes(run) or (not store.saved(run) and store.archives.others(run)):
            changed.append(run.run_id)
        elif (found := store.metrics(run)) is not None:
            metrics[run.run_id] = found
            scores[run.run_id] = exact_scores(found, run.args["total_timesteps"])
            specs[run.run_id] = store.saved(run) or {}

    diverged = {k: x.done["diverged"] for k, x in records.items() if x.state == "diverged"}
    otherwise = {
        run.run_id for run in suite.runs if run.run_id in records and not _as_asked(run, records)
    }
    evaluations = {
        run_id: record.evaluation
        for run_id, record in records.items()
        if record.evaluation is not None and run_id not in otherwise
    }
    timed = store.root / TIMED
    return Results(
        suite=suite,
        metrics=_alike(suite, metrics, records),
        scores=scores,
        changed=changed,
        done=[run.run_id for run in suite.runs if run.run_id in records],
        diverged=diverged,
        evaluations=evaluations,
        folders={run.run_id: store.path(run) for run in suite.runs},
        specs=specs,
        warnings=[*damaged.values(), *_warnings(records, otherwise)],
        timed=pd.read_csv(timed) if timed.exists() else None,
    )


def _as_asked(run: RunSpec, records: dict[str, Record]) -> bool:
    """Whether a run, which may be archived, was evaluated as the suite asks for now, if it does."""
    return answers(records[run.run_id].spec.get("evaluation", {}), run.evaluation)


def _warnings(records: dict[str, Record], otherwise: set[str]) -> list[str]:
    """What a reader must know of runs whose numbers cannot stand beside the others'."""
    found = []
    if otherwise:
        found.append(
            f"{len(otherwise)} archived runs were evaluated otherwise than the suite asks for now: "
            f"their evaluations are left out ({', '.join(sorted(otherwise))})."
        )
    old = sorted(k for k, record in records.items() if record.scores_version != VERSION)
    if old:
        found.append(
            f"{len(old)} archived runs have scores by other definitions than today's: "
            f"{', '.join(old)}."
        )
    return found


def _alike(
    suite: Suite, metrics: dict[str, pd.DataFrame], records: dict[str, Record]
) -> dict[str, pd.DataFrame]:
    """The metrics, thinned where another run of the same task and algorithm comes thinned."""
    blocks: dict[tuple[str, str], int] = {}
    for run in suite.runs:
        if run.run_id in records:
            key = (run.environment, run.algorithm)
            blocks[key] = max(blocks.get(key, 1), records[run.run_id].updates)

    found = {}
    for run in suite.runs:
        if run.run_id in metrics:
            own = records[run.run_id].updates if run.run_id in records else 1
            block = blocks.get((run.environment, run.algorithm), 1)
            rows = metrics[run.run_id]
            found[run.run_id] = thin(rows, block) if own == 1 else rows
    return found
