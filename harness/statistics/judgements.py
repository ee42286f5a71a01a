"""The tests behind the claims. Every function takes leading axes: a data set, or thousands of them.

A claim's tests are one family. Its headlines, which look at all tasks together, share four fifths
of the 5%, and its single tasks the rest. By Holm's correction a test that is decided passes its
share on. So where nothing of a claim is true, the chance of a false word anywhere in it is at most
5%.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from harness.statistics.correlation import (
    Correlation,
    permutations,
    permuted_correlations,
    summarize,
)
from harness.statistics.families import ALPHA, holm, shares_left
from harness.statistics.signflips import (
    POWER,
    detectable_difference,
    sign_flip_interval,
    sign_flip_test,
)

HEADLINES = 0.8  # of the 5%, to a claim's headlines together
CLAIMED = 0.8  # of a one-sided test's level; the rest can contradict the claim
NEGLIGIBLE = 0.5  # of the plain arm's standard deviation


class Judged(NamedTuple):
    """Tests of one kind: arrays with an entry for each."""

    mean: np.ndarray
    low: np.ndarray
    """95% interval, not corrected"""
    high: np.ndarray
    n: np.ndarray
    p: np.ndarray
    """as the test gives it, of one side where the test has one"""
    corrected: np.ndarray
    """p after Holm's correction over the claim's family; before it, what is to be corrected"""
    share: np.ndarray
    """of the 5%, once the tests of the family that were decided have passed theirs on"""
    word: np.ndarray
    """1 for what the claim says, -1 for its opposite, 0 for undecided"""
    detectable: np.ndarray
    """the effect that would have been found with 80% power at that share; NaN for none"""


class Comparison(NamedTuple):
    """Two arms over several tasks, for each contrast of a claim."""

    headline: Judged
    """`[..., contrasts]`: the mean over tasks, in standard deviations"""
    tasks: Judged
    """`[..., contrasts, tasks]`: in units of the score"""
    negligible: np.ndarray
    """`[..., contrasts, tasks]`: the interval is within half of the first arm's deviation"""
    standard: np.ndarray
    """`[..., contrasts, tasks, n]`: differences in standard deviations"""
    deviation: np.ndarray
    """`[..., contrasts, tasks]`: of both arms together; 1 where all scores are equal"""


def compare_arms(first: np.ndarray, second: np.ndarray) -> Comparison:
    """Second minus first arm, paired: each task by itself, and all tasks together.

    A difference is measured in the standard deviation of both arms' scores on its task taken
    together, which does not change if the two agents of a pair change places. The headline's test
    flips the signs of all tasks of a (seed, agent) at once.

    Args:
        first: Scores `[..., contrasts, tasks, n]`; NaN where there is no such agent.
        second: The same of the other arm; the last axis is the same (seed, agent) in both.
    """
    differences = second - first
    present = ~np.isnan(differences)
    counts = present.sum(axis=-1)
    deviation = _deviation_of_both(first, second, present)
    standard = differences / deviation[..., None]

    heads = _over_tasks(standard, counts)
    together = _flipped(heads)
    single = _flipped(differences)
    headline, tasks = _correct(together, single)

    found = detectable_difference(_deviation(heads), headline.n, headline.share)
    headline = headline._replace(detectable=found)
    found = detectable_difference(_deviation(differences), counts, tasks.share)
    tasks = tasks._replace(detectable=found)

    bound = NEGLIGIBLE * _deviation(np.where(present, first, np.nan))
    negligible = (tasks.low >= -bound) & (tasks.high <= bound) & (bound > 0)
    return Comparison(headline, tasks, negligible, standard, deviation)


def _over_tasks(standard: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Each (seed, agent)'s part of the mean over tasks of the standardized mean difference."""
    present = ~np.isnan(standard)
    somewhere = present.any(axis=-2)
    agents = somewhere.sum(axis=-1)
    tasks = np.maximum((counts > 0).sum(axis=-1), 1)

    weights = agents[..., None] / np.maximum(counts, 1) / tasks[..., None]
    parts = (np.nan_to_num(standard) * weights[..., None]).sum(axis=-2)
    return np.where(somewhere, parts, np.nan)


def _flipped(differences: np.ndarray) -> Judged:
    """Sign-flip test and interval of differences over their last axis."""
    counts = (~np.isnan(differences)).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(differences, axis=-1) / counts
    low, high = sign_flip_interval(differences)
    p = sign_flip_test(differences)
    none = np.full(p.shape, np.nan)
    return Judged(mean, low, high, counts, p, p, none, np.sign(mean), none)


def _correct(headline: Judged, tasks: Judged) -> tuple[Judged, Judged]:
    """Holm's correction over the headlines and all tasks of a claim, and the words that it allows.

    Args:
        headline: Tests `[..., contrasts]`, whose `word` is the direction found.
        tasks: Tests `[..., contrasts, tasks]`.
    """
    shape = tasks.p.shape
    single = tasks.corrected.reshape(*shape[:-2], -1)
    weights = _weights(headline.p, single)
    corrected = holm(np.concatenate([headline.corrected, single], axis=-1), weights)
    shares = shares_left(corrected, weights)

    heads = headline.p.shape[-1]
    return (
        _called(headline, corrected[..., :heads], shares[..., :heads]),
        _called(tasks, corrected[..., heads:].reshape(shape), shares[..., heads:].reshape(shape)),
    )


def _weights(headlines: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """Shares of the level, `[..., headlines + tasks]`, each kind's split evenly."""
    kinds = ((headlines, HEADLINES), (tasks, 1 - HEADLINES))
    shares = [
        np.broadcast_to(share / np.maximum((~np.isnan(p)).sum(axis=-1, keepdims=True), 1), p.shape)
        for p, share in kinds
    ]
    return np.concatenate(shares, axis=-1)


def _called(judged: Judged, corrected: np.ndarray, share: np.ndarray) -> Judged:
    word = np.where(corrected <= ALPHA, judged.word, 0)
    word = np.nan_to_num(word).astype(int)
    return judged._replace(corrected=corrected, share=share, word=word)


def _deviation(values: np.ndarray) -> np.ndarray:
    """Standard deviation of the last axis without NaN entries; NaN for fewer than two."""
    present = ~np.isnan(values)
    counts = present.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(values, axis=-1, keepdims=True) / counts[..., None]
        squares = np.where(present, (values - mean) ** 2, 0.0).sum(axis=-1)
        return np.sqrt(np.where(counts > 1, squares / (counts - 1), np.nan))


def _deviation_of_both(first: np.ndarray, second: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Standard deviation of both arms' scores together; 1 where all are equal."""
    both = np.concatenate([first, second], axis=-1)
    both = np.where(np.concatenate([present, present], axis=-1), both, np.nan)
    deviation = _deviation(both)
    return np.where(deviation > 0, deviation, 1.0)


class Association(NamedTuple):
    """Rank correlations of psi and score, for each part of claim (a)."""

    headline: Judged
    """`[..., parts]`: over all settings"""
    tasks: Judged
    """`[..., parts, tasks]`: over the settings of a task"""


def associate(psi: np.ndarray, score: np.ndarray, tasks: np.ndarray) -> Association:
    """Spearman's correlation of psi and score within settings, averaged over settings.

    The claim says that it is negative. Its test is one-sided but for a fifth of the level, which
    can contradict it. Agents are permuted alike in all settings, since these share seeds.

    Args:
        psi: Numbers of the agents, `[..., parts, settings, n]`; parts are psi late and psi early.
        score: Their scores, `[..., settings, n]`.
        tasks: The task of each setting, `[settings]`: numbers from 0.
    """
    agents = score.shape[-1]
    parts = np.broadcast_to(score[..., None, :, :], psi.shape)
    found = [
        permuted_correlations(psi[..., tasks == task, :], parts[..., tasks == task, :])
        for task in range(max(tasks) + 1)
    ]
    sums = np.stack([total for total, _ in found], axis=-2)
    settings = np.stack([count for _, count in found], axis=-1)

    together = summarize(sums.sum(axis=-2), settings.sum(axis=-1))
    each = summarize(sums, settings)
    headline, single = _correct(_placed(together, agents), _placed(each, agents))
    return Association(
        _with_detectable(headline, together.deviation, agents),
        _with_detectable(single, each.deviation, agents),
    )


def _placed(found: Correlation, agents: int) -> Judged:
    """A correlation's place among its permutations; low and high are left to the report.

    p is that of the side that is nearer to a word. What is to be corrected is p over the side's
    share of the level.
    """
    claimed = found.below / CLAIMED
    opposite = found.above / (1 - CLAIMED)
    weighted = np.minimum(np.minimum(claimed, opposite), 1.0)
    word = np.where(claimed <= opposite, 1, -1)
    p = np.where(word == 1, found.below, found.above)

    none = np.full(p.shape, np.nan)
    n = np.where(np.isnan(p), 0, agents)
    return Judged(found.mean, none, none, n, p, weighted, none, word, none)


def _with_detectable(judged: Judged, deviation: np.ndarray, agents: int) -> Judged:
    """With the size of the negative correlation that would have been found with 80% power.

    By the normal approximation. None where that is above 1, or where the permutations are too few
    for a p at the test's level.
    """
    level = ALPHA * CLAIMED * judged.share
    effect = (stats.norm.ppf(1 - level) + stats.norm.ppf(POWER)) * deviation
    reached = level * len(permutations(agents)) >= 1 - 1e-9
    return judged._replace(detectable=np.where(reached & (effect <= 1), effect, np.nan))
