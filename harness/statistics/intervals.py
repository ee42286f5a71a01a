"""Intervals of a mean over agents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

RESAMPLES = 10_000
MANY = 30  # agents from which on the interval of a skewed cell can be trusted
SKEWED = 1.0  # of the third standardized moment


class Estimate(NamedTuple):
    """A mean over n agents, and its 95% interval where n allows one."""

    mean: float
    low: float
    high: float
    n: int


def estimate_mean(values: np.ndarray, skewed: bool | None = None, seed: int = 0) -> Estimate:
    """Mean of `values`, `[n]`, with a 95% studentized bootstrap interval.

    Means of resamples are measured in their own standard errors, which keeps the interval honest
    for ten agents (Efron and Tibshirani, 1993, chapter 12; SciPy has no such method). Below 30
    agents skewed values have no interval: where a tenth of the agents succeed, ten of them often
    hold no success at all. Nor have fewer than 5 agents.

    Args:
        values: One number for each agent.
        skewed: Whether the values come from a skewed distribution; by default they say it.
        seed: Of the resampling.
    """
    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    mean = float(values.mean()) if n else np.nan
    if n < 5 or (n < MANY and (is_skewed([values]) if skewed is None else skewed)):
        return Estimate(mean, np.nan, np.nan, n)

    error = values.std(ddof=1) / np.sqrt(n)
    picked = values[np.random.default_rng(seed).integers(n, size=(RESAMPLES, n))]
    errors = picked.std(axis=1, ddof=1) / np.sqrt(n)
    varied = errors > 0
    if not varied.any():
        return Estimate(mean, mean, mean, n)
    scaled = (picked.mean(axis=1)[varied] - mean) / errors[varied]
    below, above = np.percentile(scaled, (2.5, 97.5))
    return Estimate(mean, float(mean - above * error), float(mean - below * error), n)


def is_skewed(arms: Sequence[np.ndarray]) -> bool:
    """Whether the arms of a task look skewed, their runs taken together around their own means.

    Together, since ten agents of one arm may hold no success where every tenth succeeds.
    """
    around = np.concatenate([np.empty(0), *(arm - np.mean(arm) for arm in arms if len(arm))])
    if not len(around) or np.ptp(around) == 0:
        return False
    return bool(abs(stats.skew(around)) > SKEWED)


def interval_of_means(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """95% Student interval of the mean of each row of `values`, `[rows, agents]`.

    NaN entries (no episode ended) do not count; NaN for rows of fewer than two.
    """
    present = ~np.isnan(values)
    counts = present.sum(axis=1)
    filled = np.where(present, values, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = filled.sum(axis=1) / counts
        squares = np.where(present, (values - means[:, None]) ** 2, 0.0).sum(axis=1)
        reach = half_width(np.sqrt(squares / (counts - 1)), counts)
    reach = np.where(counts > 1, reach, np.nan)
    return means - reach, means + reach


def half_width(spread: np.ndarray, n: np.ndarray, level: float = 0.95) -> np.ndarray:
    """Half of Student's interval of a mean of n values with this standard deviation."""
    degrees = np.maximum(np.asarray(n) - 1, 1)
    return stats.t.ppf((1 + level) / 2, degrees) * spread / np.sqrt(n)
