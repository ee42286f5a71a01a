"""Several tests that stand for one claim: how their p-values are corrected."""

from __future__ import annotations

import numpy as np

ALPHA = 0.05


def shares_left(corrected: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The share of `ALPHA` that each test has once decided ones have passed theirs on.

    That is its weight over the weights of all undecided tests and itself. What a test of this share
    calls is what `holm` calls, as the other tests have turned out.

    Args:
        corrected: What `holm` gives, `[..., tests]`; NaN for a test that was not made.
        weights: A weight for each test.
    """
    made = ~np.isnan(corrected)
    weights = np.where(made, weights, 0.0)
    decided = made & (corrected <= ALPHA)
    undecided = np.where(decided, 0.0, weights).sum(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        share = weights / (undecided + np.where(decided, weights, 0.0))
    return np.where(made, share, np.nan)


def holm(p: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Holm's correction of the p-values `p`, `[..., tests]`, with a weight for each test.

    Sorted by p / weight, the j-th smallest becomes p * (weights of it and of all behind it) /
    (its own weight), and never less than the one before it. What is at most `ALPHA` is called at
    that level: the chance of any false call in the family is at most `ALPHA` (Holm, 1979). Equal
    weights give the usual correction. A NaN is a test that was not made; it has no weight.
    """
    p = np.asarray(p, dtype=np.float64)
    shares = np.broadcast_to(1.0 if weights is None else weights, p.shape)
    made = ~np.isnan(p)
    shares = np.where(made, shares, 0.0)

    with np.errstate(invalid="ignore", divide="ignore"):
        order = np.argsort(np.where(made, p / shares, np.inf), axis=-1, kind="stable")
        ordered = np.take_along_axis(p, order, axis=-1)
        own = np.take_along_axis(shares, order, axis=-1)
        remaining = np.cumsum(own[..., ::-1], axis=-1)[..., ::-1]
        corrected = np.maximum.accumulate(ordered * remaining / own, axis=-1)

    result = np.empty_like(p)
    np.put_along_axis(result, order, np.minimum(corrected, 1.0), axis=-1)
    return np.where(made, result, np.nan)
