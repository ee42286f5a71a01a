"""Rank correlation of two numbers of each agent, and the permutation test that settings share."""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy import sparse, stats

from harness.statistics.intervals import Estimate

PERMUTATIONS = 4096


class Correlation(NamedTuple):
    """Rank correlations and the chance of a smaller or larger one without any."""

    mean: np.ndarray
    """Spearman's correlation, averaged over settings"""
    below: np.ndarray
    """share of the permutations whose correlation is at most this one"""
    above: np.ndarray
    """share of the permutations whose correlation is at least this one"""
    deviation: np.ndarray
    """standard deviation over the permutations"""


def spearman(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Spearman's correlation of x and y over their last axis; NaN where one of them is flat."""
    return (_standard_ranks(x) * _standard_ranks(y)).sum(axis=-1)


def rank_correlation(x: np.ndarray, y: np.ndarray) -> Estimate:
    """Spearman's correlation of x and y, `[settings, n]`, within settings, then averaged.

    The interval is Student's with the jackknife's standard error, agents left out one by one in all
    settings at once. Settings in which one side is flat tell nothing and are left out.
    """
    n = x.shape[-1] if len(x) else 0
    mean = _mean_correlation(x, y)
    if n < 4 or np.isnan(mean):
        return Estimate(mean, np.nan, np.nan, n)

    without = np.array(
        [_mean_correlation(np.delete(x, i, -1), np.delete(y, i, -1)) for i in range(n)]
    )
    error = np.sqrt((n - 1) * np.nanvar(without))
    reach = stats.t.ppf(0.975, n - 1) * error
    return Estimate(mean, max(-1.0, mean - reach), min(1.0, mean + reach), n)


def _mean_correlation(x: np.ndarray, y: np.ndarray) -> float:
    found = spearman(x, y) if x.shape[-1] > 2 else np.empty(0)
    found = found[~np.isnan(found)]
    return float(found.mean()) if len(found) else np.nan


@functools.cache
def permutations(n: int) -> np.ndarray:
    """Permutations of n agents, `[permutations, n]`: all to n = 6, then 4096 drawn at random.

    The first leaves everything in its place.
    """
    if math.factorial(n) <= PERMUTATIONS:
        return np.array(list(itertools.permutations(range(n))))
    rng = np.random.default_rng(n)
    drawn = rng.permuted(np.tile(np.arange(n), (PERMUTATIONS, 1)), axis=1)
    drawn[0] = np.arange(n)
    return drawn


def permuted_correlations(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum over settings of the correlation of x and permuted y: `[..., permutations]`.

    Args:
        x: One number of each agent, `[..., settings, n]`.
        y: The other. The agents of all settings are permuted alike, since settings share seeds.

    Returns:
        The sums, the first of which is that of the data, and how many settings each is over: those
        in which one side is flat tell nothing and are left out.
    """
    first, second = _standard_ranks(x), _standard_ranks(y)
    told = ~(np.isnan(first[..., 0]) | np.isnan(second[..., 0]))
    first = np.where(told[..., None], first, 0.0)
    second = np.where(told[..., None], second, 0.0)

    # products[i, j]: agent i's rank of x with agent j's rank of y, summed over settings
    products = np.einsum("...si,...sj->...ij", first, second, optimize=True)
    n = products.shape[-1]
    moves = permutations(n)
    picked = (np.arange(n) * n + moves).ravel()
    ends = np.arange(0, len(picked) + 1, n)
    chosen = sparse.csr_array((np.ones(len(picked)), picked, ends), shape=(len(moves), n * n))
    sums = (chosen @ products.reshape(-1, n * n).T).T
    return sums.reshape(*products.shape[:-2], len(moves)), told.sum(axis=-1)


def summarize(sums: np.ndarray, settings: np.ndarray) -> Correlation:
    """Mean correlation over `settings` and its place among the permutations, the last axis."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums[..., 0] / settings
        deviation = sums.std(axis=-1) / settings
    observed = sums[..., :1]
    below = np.count_nonzero(sums <= observed + 1e-9, axis=-1) / sums.shape[-1]
    above = np.count_nonzero(sums >= observed - 1e-9, axis=-1) / sums.shape[-1]
    none = settings == 0
    below = np.where(none, np.nan, below)
    above = np.where(none, np.nan, above)
    return Correlation(mean, below, above, deviation)


def _standard_ranks(values: np.ndarray) -> np.ndarray:
    """Ranks over the last axis, centred and of length 1; NaN where all are equal."""
    ranks = stats.rankdata(values, axis=-1)
    ranks = ranks - ranks.mean(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return ranks / np.sqrt((ranks**2).sum(axis=-1, keepdims=True))
