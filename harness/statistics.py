"""Aggregates over agents, with their uncertainty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

RESAMPLES = 10_000


class Estimate(NamedTuple):
    """A mean over n agents, and its 95% interval where n allows one."""

    mean: float
    low: float
    high: float
    n: int


def final_score(metrics: pd.DataFrame, updates: int = 100) -> float:
    """Mean reward of one agent over its last updates: Table 1's measure.

    An update's value is the mean return of the episodes that ended in it; updates in which none
    ended do not count. NaN if none ended in any.
    """
    return float(metrics["charts/episodic_return"].tail(updates).mean())


def estimate_mean(values: np.ndarray, seed: int = 0) -> Estimate:
    """Mean with a 95% percentile-bootstrap interval over `values`, `[n]`.

    The interval is NaN for n < 2: one agent tells nothing of the spread between agents.
    """
    values = np.asarray(values, dtype=np.float64)
    if len(values) < 2:
        mean = float(values[0]) if len(values) else np.nan
        return Estimate(mean, np.nan, np.nan, len(values))
    result = stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, method="percentile",
        rng=np.random.default_rng(seed), batch=1000,
    )  # fmt: skip
    low, high = result.confidence_interval
    return Estimate(float(values.mean()), float(low), float(high), len(values))


def interval_of_means(values: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """95% percentile-bootstrap interval of the mean of each row of `values`, `[rows, agents]`.

    Agents are resampled, the same ones for all rows. NaN entries (no episode ended) do not count.
    """
    rng, (rows, agents) = np.random.default_rng(seed), values.shape
    counts = rng.multinomial(
        agents, np.full(agents, 1 / agents), size=1000
    ).T  # [agents, resamples]
    present = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        means = np.nan_to_num(values) @ counts / (present @ counts)  # [rows, resamples]
    low, high = np.full(rows, np.nan), np.full(rows, np.nan)
    some = present.any(axis=1)
    low[some], high[some] = np.nanpercentile(means[some], (2.5, 97.5), axis=1)
    return low, high
