"""Aggregates over tasks of Agarwal et al. (2021): agents are resampled within tasks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

from harness.statistics.intervals import Estimate

RESAMPLES = 2000


def interquartile_mean(groups: list[np.ndarray], seed: int = 0) -> Estimate:
    """Mean of the middle half of all values; it hides up to a quarter of broken agents."""
    groups = [group for group in groups if len(group)]

    def middle(picks: list[np.ndarray]) -> np.ndarray:
        chosen = [group[pick] for group, pick in zip(groups, picks, strict=True)]
        return stats.trim_mean(np.concatenate(chosen, axis=1), 0.25, axis=1)

    return _estimate(middle, [len(group) for group in groups], seed)


def probability_of_improvement(
    pairs: list[tuple[np.ndarray, np.ndarray]], seed: int = 0
) -> Estimate:
    """Chance that an agent of the second arm beats one of the first, averaged over tasks.

    Every agent of one arm meets every agent of the other; a tie counts half. The two arms of a
    task are paired and of equal length, and pairs are resampled.
    """
    pairs = [pair for pair in pairs if len(pair[0])]

    def improvement(picks: list[np.ndarray]) -> np.ndarray:
        chances = [
            np.heaviside(second[pick][:, :, None] - first[pick][:, None, :], 0.5).mean(axis=(1, 2))
            for (first, second), pick in zip(pairs, picks, strict=True)
        ]
        return np.mean(chances, axis=0)

    return _estimate(improvement, [len(first) for first, _ in pairs], seed)


def _estimate(
    statistic: Callable[[list[np.ndarray]], np.ndarray], sizes: list[int], seed: int
) -> Estimate:
    """The statistic of the agents as they are, and its percentiles over resampled ones."""
    n = sum(sizes)
    if not n:
        return Estimate(np.nan, np.nan, np.nan, 0)
    value = float(statistic([np.arange(size)[None] for size in sizes])[0])
    if min(sizes) < 2:
        return Estimate(value, np.nan, np.nan, n)

    rng = np.random.default_rng(seed)
    resampled = statistic([rng.integers(size, size=(RESAMPLES, size)) for size in sizes])
    low, high = np.percentile(resampled, (2.5, 97.5))
    return Estimate(value, float(low), float(high), n)
