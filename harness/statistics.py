"""Aggregates over agents, with their uncertainty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

RESAMPLES = 10_000
LAST_UPDATES = 100  # that the paper's Table 1 is a mean over
MIN_AGENTS = 10  # below, bootstrap intervals are too narrow to rest a verdict on
TOO_FEW = "too few runs to tell"


class Estimate(NamedTuple):
    """A mean over n agents, and its 95% interval where n allows one."""

    mean: float
    low: float
    high: float
    n: int


def final_score(metrics: pd.DataFrame, updates: int = LAST_UPDATES) -> float:
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


def rank_correlation(groups: list[np.ndarray], seed: int = 0) -> Estimate:
    """Spearman's rank correlation of pairs, `[n, 2]` in each group, averaged over groups.

    Groups, such as tasks, are weighted by their size; the interval resamples pairs within groups.
    Groups of fewer than 3 pairs, or in which one side does not vary, tell nothing and are left out;
    a resample in which one side does not vary counts as no correlation.
    """
    groups = [g for g in groups if len(g) > 2 and np.ptp(g[:, 0]) > 0 and np.ptp(g[:, 1]) > 0]
    n = sum(map(len, groups))
    if not groups:
        return Estimate(np.nan, np.nan, np.nan, 0)
    rng, total, resampled = np.random.default_rng(seed), 0.0, np.zeros(2000)
    for group in groups:
        weight = len(group) / n
        total += weight * spearman(group[None])[0]
        picks = rng.integers(len(group), size=(2000, len(group)))
        resampled += weight * np.nan_to_num(spearman(group[picks]))
    low, high = np.percentile(resampled, (2.5, 97.5))
    return Estimate(float(total), float(low), float(high), n)


def spearman(pairs: np.ndarray) -> np.ndarray:
    """Spearman's correlation of each set of pairs, `[sets, n, 2]`; NaN if a side is flat."""
    ranks = stats.rankdata(pairs, axis=1)
    ranks -= ranks.mean(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        products = (ranks[..., 0] * ranks[..., 1]).sum(1)
        return products / np.sqrt((ranks**2).sum(1).prod(-1))


def interquartile_mean(groups: list[np.ndarray], seed: int = 0) -> Estimate:
    """Mean of the middle half of all values, resampled within groups (Agarwal et al., 2021)."""
    groups = [g for g in groups if len(g)]
    n = sum(map(len, groups))
    if not groups:
        return Estimate(np.nan, np.nan, np.nan, 0)
    mean = float(stats.trim_mean(np.concatenate(groups), 0.25))
    if min(map(len, groups)) < 2:
        return Estimate(mean, np.nan, np.nan, n)
    rng = np.random.default_rng(seed)
    picks = [g[rng.integers(len(g), size=(2000, len(g)))] for g in groups]
    means = stats.trim_mean(np.concatenate(picks, axis=1), 0.25, axis=1)
    return Estimate(mean, *map(float, np.percentile(means, (2.5, 97.5))), n)


def verdict(estimate: Estimate, sign: int) -> str:
    """What an estimate says of the claim that its true value has this sign.

    "supported" or "contradicted" where the whole 95% interval is on one side of 0, "not supported"
    where it holds 0, and "too few runs to tell" below MIN_AGENTS values.
    """
    if estimate.n < MIN_AGENTS or np.isnan(estimate.low):
        return TOO_FEW
    if estimate.low <= 0 <= estimate.high:
        return "not supported"
    return "supported" if (estimate.low > 0) == (sign > 0) else "contradicted"


def success_matrix(episodes: pd.DataFrame) -> np.ndarray:
    """Successes `[levels, repeats]` of episodes that each name their level and repeat."""
    return episodes.pivot(index="level", columns="repeat", values="success").to_numpy(float)


def estimate_success(agents: list[np.ndarray], seed: int = 0) -> Estimate:
    """Success rate over agents' `[levels, repeats]`, every level counted equally.

    The interval resamples agents, then levels (the same for all agents), then the repeats of each.
    With one agent it says how the rate may vary over levels, not over training runs. `n` is the
    number of agents.
    """
    rates = np.array([matrix.mean(axis=1) for matrix in agents])  # [agents, levels]
    if not len(rates):
        return Estimate(np.nan, np.nan, np.nan, 0)
    rng, (count, levels) = np.random.default_rng(seed), rates.shape
    repeats, means = agents[0].shape[1], np.empty(2000)
    for i in range(len(means)):
        picked = rates[rng.integers(count, size=count)][:, rng.integers(levels, size=levels)]
        means[i] = rng.binomial(repeats, picked).mean() / repeats
    low, high = np.percentile(means, (2.5, 97.5))
    return Estimate(float(rates.mean()), float(low), float(high), count)
