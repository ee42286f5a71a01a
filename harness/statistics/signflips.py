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

    NaN entries are pairs that do not exist. The test is exact to 12 pairs that do. NaN where no
    pair does.
    """
    rows, shape = _rows(differences)
    p = np.full(len(rows), np.nan)
    for places, pairs in _by_pairs(rows):
        flips = subsets(pairs.shape[1])
        sums = pairs @ flips.T
        slack = 1e-9 * np.abs(pairs).sum(axis=1, keepdims=True)
        at_least = np.count_nonzero(sums <= slack, axis=1)  # flipping them leaves no smaller mean
        at_most = np.count_nonzero(sums >= -slack, axis=1)
        p[places] = 2 * np.minimum(at_least, at_most) / len(flips)
    return np.minimum(p, 1.0).reshape(shape)


def sign_flip_interval(
    differences: np.ndarray, alpha: float = ALPHA
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of differences `[..., n]` that the test does not reject at `alpha`: low and high.

    A shift is rejected where too few subsets have a smaller mean, or a larger one, so the ends are
    order statistics of the subsets' means. NaN where too few pairs exist to reject any shift.
    """
    rows, shape = _rows(differences)
    low = np.full(len(rows), np.nan)
    high = np.full(len(rows), np.nan)
    for places, pairs in _by_pairs(rows):
        flips = subsets(pairs.shape[1])
        sizes = flips.sum(axis=1)
        means = pairs @ flips[sizes > 0].T / sizes[sizes > 0]
        rank = _tail(pairs.shape[1], alpha) - np.count_nonzero(sizes == 0)
        if rank >= 0:
            low[places] = np.partition(means, rank, axis=1)[:, rank]
            high[places] = -np.partition(-means, rank, axis=1)[:, rank]
    return low.reshape(shape), high.reshape(shape)


def _tail(n: int, alpha: float) -> int:
    """Subsets of n pairs that make up half of `alpha`."""
    return int(np.floor(alpha / 2 * len(subsets(n)) + 1e-9))


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
        The difference; NaN where n is too small to reach the level at all, or there is no test.
    """
    unit = np.vectorize(_detectable_at, otypes=[float])
    return spread * unit(n, ALPHA * np.asarray(share))


def _detectable_at(n: int, alpha: float) -> float:
    """The same for differences of deviation 1; NaN where there is no such test."""
    return np.nan if np.isnan(alpha) else _detectable_unit(int(n), _tail(int(n), alpha))


@functools.cache
def _detectable_unit(n: int, tail: int) -> float:
    """The same for normal differences of deviation 1 and a test that rejects `tail` subsets a side.

    A shift is found where the interval's lower end, shifted with it, is above 0. So it is the 80%
    quantile of how far below 0 that end lies without a shift. Student's formula promises too much:
    at a level that only the smallest p reaches, all signs must agree.
    """
    if n < 2 or tail < 1:
        return np.nan
    drawn = np.random.default_rng(n).normal(size=(2000, n))
    low, _ = sign_flip_interval(drawn, 2 * tail / len(subsets(n)))
    return float(np.quantile(-low, POWER))


def _rows(differences: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    values = np.asarray(differences, dtype=np.float64)
    return values.reshape(-1, values.shape[-1]), values.shape[:-1]


def _by_pairs(rows: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows with equally many pairs, a chunk at a time: their places, and pairs `[rows, k]`."""
    present = ~np.isnan(rows)
    counts = present.sum(axis=1)
    for count in np.unique(counts[counts > 0]):
        places = np.flatnonzero(counts == count)
        pairs = rows[places][present[places]].reshape(-1, count)
        size = max(1, CHUNK // len(subsets(int(count))))
        for start in range(0, len(places), size):
            yield places[start : start + size], pairs[start : start + size]
