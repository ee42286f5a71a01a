"""Success rates over levels: of one training run, of several, and of two kinds of them.

Rates vary over training runs, over levels (the same ones for every run) and over repeats. For n
runs on L levels let s_r^2 be the variance of the runs' means, s_l^2 that of the levels' means, and
s_e^2 that of what is left, which holds the repeats' noise:

    Var(mean) = s_r^2 / n + s_l^2 / L - s_e^2 / (n L)

This is what resampling runs, then levels, comes to as the resamples grow many (Owen, 2007), without
its noise, with n - 1 where resampling has n, and without the repeats' noise counted a second time:
a level brings its repeats with it. The interval is Student's with n - 1 degrees of freedom.

Where neither runs nor levels differ, that variance is 0, and Student's p would be 0 too, however
few the runs. What n equal gains show is that n signs agree, so the sign-flip test has the say
there: its p is 2 / 2^n, and 5 runs have no interval.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from harness.statistics.families import ALPHA
from harness.statistics.intervals import Estimate
from harness.statistics.signflips import (
    POWER,
    detectable_difference,
    sign_flip_interval,
    sign_flip_test,
)

MIN_TRAINING_RUNS = 5  # below, an interval says how the rate varies over levels and no more
FLAT = 1e-9  # a standard error up to which rates differ by rounding only


class Success(NamedTuple):
    """Mean rates, or differences of rates, and how sure they are."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray
    """two-sided, of the hypothesis that the mean is 0; NaN below 5 training runs"""
    detectable: np.ndarray
    """what would have been found with 80% power; NaN below 5 training runs"""


def success_matrix(episodes: pd.DataFrame) -> np.ndarray:
    """Successes `[levels, repeats]` of episodes that each name their level and repeat."""
    return episodes.pivot(index="level", columns="repeat", values="success").to_numpy(float)


def compare_success(rates: np.ndarray, share: float = 1.0) -> Success:
    """Mean of `rates`, `[..., runs, levels]`, or of paired differences of them.

    From 5 runs on the interval is over training runs and levels; below, over levels only.

    Args:
        rates: Each run's rate on each level, its mean over repeats.
        share: The share of 5% that the test has, for what it could have found.
    """
    runs, levels = rates.shape[-2:]
    mean = rates.mean(axis=(-2, -1))
    of_runs = rates.mean(axis=-1)
    of_levels = rates.mean(axis=-2)
    if levels > 1:
        variance = of_levels.var(axis=-1, ddof=1) / levels
    else:
        variance = np.full(mean.shape, np.nan)
    degrees = levels - 1
    if runs >= MIN_TRAINING_RUNS:
        left = rates - of_runs[..., None] - of_levels[..., None, :] + mean[..., None, None]
        noise = (left**2).sum(axis=(-2, -1)) / max((runs - 1) * (levels - 1), 1)
        shared = np.nan_to_num(np.maximum(variance - noise / (runs * levels), 0.0))
        variance = of_runs.var(axis=-1, ddof=1) / runs + shared
        degrees = runs - 1

    error = np.sqrt(variance)
    reach = stats.t.ppf(1 - ALPHA / 2, max(degrees, 1)) * error
    none = np.full(mean.shape, np.nan)
    found = Success(mean, mean - reach, mean + reach, none, none)
    if runs < MIN_TRAINING_RUNS:
        return found

    flat = error <= FLAT
    p = 2 * stats.t.sf(np.abs(mean) / np.where(flat, 1.0, error), degrees)
    needed = stats.t.ppf(1 - ALPHA * share / 2, degrees) + stats.t.ppf(POWER, degrees)
    found = found._replace(p=p, detectable=error * needed)
    return _with_flat(found, flat, of_runs, share) if flat.any() else found


def _with_flat(found: Success, flat: np.ndarray, of_runs: np.ndarray, share: float) -> Success:
    """With the sign-flip test's numbers where rates differ by rounding only."""
    values = np.where(np.abs(of_runs) <= FLAT, 0.0, of_runs)
    low, high = sign_flip_interval(values)
    p = sign_flip_test(values)
    detectable = detectable_difference(np.zeros(p.shape), np.array(values.shape[-1]), share)
    replaced = {"low": low, "high": high, "p": p, "detectable": detectable}
    return found._replace(
        **{name: np.where(flat, new, getattr(found, name)) for name, new in replaced.items()}
    )


def estimate_success(agents: list[np.ndarray]) -> Estimate:
    """Success rate over agents' `[levels, repeats]`, every level counted equally.

    Below 5 agents the interval says how the rate may vary over levels, not over training runs.
    """
    if not agents:
        return Estimate(np.nan, np.nan, np.nan, 0)
    rates = np.array([matrix.mean(axis=1) for matrix in agents])
    found = compare_success(rates)
    low, high = np.clip([found.low, found.high], 0.0, 1.0)
    return Estimate(float(found.mean), float(low), float(high), len(agents))
