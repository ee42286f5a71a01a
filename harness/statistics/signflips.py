"""Sign-flip tests of paired differences, and the intervals that invert them.

Under the hypothesis that the two arms are alike, each difference could as well have had the other
sign. Flipping a set of differences lowers their sum by twice the sum of the set, so only the sums
of subsets matter. SciPy's `permutation_test` says the same of one data set (a test compares them).
Here the subsets are the rows of one matrix: a product with it serves thousands of data sets, and
the means of the subsets are the ends of the interval.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from harness.statistics.families import ALPHA

EXACT = 12  # pairs up to which every subset is taken
SUBSETS = 2**EXACT
POWER = 0.8
CHUNK = 2**23  # numbers at a time


@functools.cache
def subsets(n: int) -> np.ndarray:
    """Subsets of n pairs, `[subsets, n]` of 0 and 1: all of them to n = 12, then 4096 at random.

    The first is the empty one: the data as they are.
    """
    if n <= EXACT:
        return (np.arange(2**n)[:, None] >> np.arange(n) & 1).astype(np.float64)
    drawn = np.random.default_rng(n).integers(2, size=(SUBSETS, n)).astype(np.float64)
    drawn[0] = 0.0
    return drawn


def sign_flip_test(differences: np.ndarray) -> np.ndarray:
    """Two-sided p of the hypothesis that differences `[..., n]` are symmetric around 0: `[...]`.

    Exact to n = 12. NaN entries are pairs that do not exist. NaN where no pair does.
    """
    rows, shape = _rows(differences)
    flips = subsets(rows.shape[1])
    p = np.empty(len(rows))
    for part in _chunks(len(rows), len(flips)):
        sums = np.nan_to_num(rows[part]) @ flips.T
        slack = 1e-9 * np.nansum(np.abs(rows[part]), axis=1, keepdims=True)
        at_least = np.count_nonzero(sums <= slack, axis=1)  # flipping them leaves no smaller mean
        at_most = np.count_nonzero(sums >= -slack, axis=1)
        p[part] = 2 * np.minimum(at_least, at_most) / len(flips)
    p[np.isnan(rows).all(axis=1)] = np.nan
    return np.minimum(p, 1.0).reshape(shape)


def sign_flip_interval(
    differences: np.ndarray, alpha: float = ALPHA
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of differences `[..., n]` that the test does not reject at `alpha`: low and high.

    A shift is rejected where too few subsets have a smaller mean, or a larger one, so the ends are
    order statistics of the subsets' means. NaN where n is too small to reject any shift.
    """
    rows, shape = _rows(differences)
    low, high = np.empty(len(rows)), np.empty(len(rows))
    for part in _chunks(len(rows), len(subsets(rows.shape[1]))):
        means, rank = _subset_means(rows[part], alpha)
        low[part] = _order_statistic(means, rank)
        high[part] = -_order_statistic(-means, rank)
    return low.reshape(shape), high.reshape(shape)


def _subset_means(rows: np.ndarray, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Means of the subsets, NaN for those without a pair, and the rank of the interval's ends."""
    flips = subsets(rows.shape[1])
    sizes = (~np.isnan(rows)).astype(np.float64) @ flips.T
    with np.errstate(invalid="ignore"):
        means = np.nan_to_num(rows) @ flips.T / sizes
    empty = np.count_nonzero(sizes == 0, axis=1)
    rank = np.floor(alpha / 2 * len(flips) + 1e-9).astype(int) - empty
    return means, rank


def _order_statistic(means: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """The entry of this rank, from 0, in each row of means; NaN where the rank is negative."""
    ranks = np.unique(np.maximum(rank, 0))
    ordered = np.partition(means, ranks, axis=1)  # NaN comes last
    found = np.take_along_axis(ordered, np.maximum(rank, 0)[:, None], axis=1)[:, 0]
    return np.where(rank < 0, np.nan, found)


def smallest_n(share: float = 1.0, alpha: float = ALPHA) -> int:
    """The fewest pairs that could reach `alpha` where a test has this share of it.

    The smallest two-sided p of n pairs is 2 / 2^n: 6 pairs for one test at 5%, 10 for one of 16.
    """
    return int(np.ceil(1 - np.log2(alpha * share)))


def detectable_difference(
    spread: np.ndarray, n: np.ndarray, share: np.ndarray | float = 1.0
) -> np.ndarray:
    """The mean difference that n pairs of this spread would have shown with 80% power.

    Args:
        spread: Standard deviation of the differences.
        n: How many there are.
        share: The share of `ALPHA` that the test has.

    Returns:
        The difference; NaN where n is too small to reach the level at all.
    """
    return spread * np.vectorize(_detectable_unit, otypes=[float])(n, ALPHA * np.asarray(share))


@functools.cache
def _detectable_unit(n: int, alpha: float) -> float:
    """The same for differences of deviation 1, normally distributed.

    A shift is found where the interval's lower end, shifted with it, is above 0. So it is the 80%
    quantile of how far below 0 that end lies without a shift. Student's formula promises too much:
    at a level that only the smallest p reaches, all signs must agree.
    """
    if n < 2 or 2.0 ** (1 - n) > alpha * (1 + 1e-9):
        return np.nan
    drawn = np.random.default_rng(n).normal(size=(2000, n))
    low, _ = sign_flip_interval(drawn, alpha)
    return float(np.quantile(-low, POWER))


def _rows(differences: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    values = np.asarray(differences, dtype=np.float64)
    return values.reshape(-1, values.shape[-1]), values.shape[:-1]


def _chunks(rows: int, width: int) -> Iterator[slice]:
    size = max(1, CHUNK // width)
    return (slice(start, start + size) for start in range(0, rows, size))
