"""A finished run as reports read it: exact scores, curves, evaluation and where it comes from."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from harness.identity import Changes, compare, make_args
from harness.scores import SPEED, VERSION
from harness.statistics.scores import EPISODES
from harness.suite import RunSpec

POINTS = 100  # that a curve is thinned to, at most
OF_EPISODES = ("charts/episodic_return", "charts/episodic_length", "charts/success_rate")
"""columns that are means over the episodes that ended in an update"""


@dataclasses.dataclass(frozen=True)
class Record:
    """A finished run of a certain length, from its folder or from an archive."""

    place: Path
    """the folder or the archive"""
    run_id: str
    spec: dict[str, Any]
    """content of spec.json"""
    done: dict[str, Any]
    """content of done.json"""
    scores: dict[str, float]
    """exact numbers, from every row of the metrics"""
    updates: int
    """neighbouring updates that make one row of the curves"""
    curves: pd.DataFrame
    """metrics.csv: as it is, or thinned"""
    evaluation: pd.DataFrame | None
    """evaluation.csv: every row"""
    asked: dict[str, Any] | None = None
    """evaluation.json: what the evaluation was asked for"""
    scores_version: int = VERSION
    """of the definitions that the scores were computed by"""

    @property
    def total_timesteps(self) -> int:
        return self.spec["args"]["total_timesteps"]

    @property
    def state(self) -> str:
        """Done, or diverged: where the run's own numbers became non-finite."""
        return self.done.get("state", "done")

    @property
    def files(self) -> dict[str, str]:
        """Checksums of the files that the run left."""
        return self.done["sha256"]

    def changes(self, spec: RunSpec) -> Changes:
        """How it differs from a run that is asked for."""
        return compare(self.spec, spec.identity)

    def same(self, other: Record) -> bool:
        """Whether the other is the same run with the same outcome, whatever its speed."""
        if self.files == other.files:
            return True
        if self.state != other.state or not _equal(self.scores, other.scores):
            return False
        tables = self.evaluation, other.evaluation
        if tables[0] is None or tables[1] is None:
            return tables[0] is tables[1]
        return tables[0].equals(tables[1])


def _equal(scores: dict[str, float], others: dict[str, float]) -> bool:
    """Whether all but the speeds are equal, NaN to NaN."""

    def plain(found: dict[str, float]) -> dict[str, float | None]:
        known = {k: v for k, v in found.items() if SPEED not in k}
        return {k: None if math.isnan(v) else v for k, v in known.items()}

    return plain(scores) == plain(others)


def block_of(spec: dict[str, Any]) -> int:
    """Neighbouring updates that make one point of the run's thinned curve."""
    updates = int(make_args(spec["baseline"], spec["args"]).num_updates)
    return max(1, math.ceil(updates / POINTS))


def thin(metrics: pd.DataFrame, updates: int) -> pd.DataFrame:
    """A row for each block of so many updates, with the last row's step.

    Means over episodes are weighted by the episodes that ended in each update, which are summed;
    all else is the mean of the rows that have a number.
    """
    if updates == 1:
        return metrics

    block = np.arange(len(metrics)) // updates
    weights = _weights(metrics)
    columns: dict[str, pd.Series] = {}
    for name, values in metrics.items():
        if name == "global_step":
            columns[name] = values.groupby(block).last()
        elif name == EPISODES:
            columns[name] = values.groupby(block).sum()
        elif name in OF_EPISODES:
            weighed = weights.where(values.notna(), 0.0)
            total = (values.fillna(0.0) * weighed).groupby(block).sum()
            counts = weighed.groupby(block).sum()
            columns[name] = total / counts.where(counts > 0)  # NaN where no episode ended
        else:
            columns[str(name)] = values.groupby(block).mean()
    return pd.DataFrame(columns).reset_index(drop=True)


def _weights(metrics: pd.DataFrame) -> pd.Series:
    """Episodes that ended in each update; 1 each where that was not logged."""
    if EPISODES in metrics:
        return metrics[EPISODES].astype(float)
    return pd.Series(1.0, index=metrics.index)
