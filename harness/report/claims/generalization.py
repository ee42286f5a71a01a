"""Claim (d): the regularizer improves all four CoinRun agents, on seen and on unseen levels."""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
import pandas as pd

from harness.report.claims.finding import (
    UNDECIDED,
    WORDS,
    Claim,
    Finding,
    agreed,
    basis_of,
    with_kept,
)
from harness.report.published import paper_numbers
from harness.report.results import Results
from harness.statistics import (
    ALPHA,
    MIN_TRAINING_RUNS,
    Estimate,
    compare_success,
    holm,
    shares_left,
)

SPLITS = ("seen", "unseen")
Key = tuple[int, int]  # seed and agent
STATEMENT = "The regularizer improves all four CoinRun agents, on seen and on unseen levels."


class Column(NamedTuple):
    """One agent on one kind of levels."""

    game: str
    plain: str
    """the algorithm without the penalty"""
    split: str


def generalization_claim(results: Results) -> Claim:
    """Claim (d): for each agent and kind of levels, reg minus plain, paired by seed and agent.

    From 5 training runs on, the test knows how much training runs and levels vary. Fewer say
    nothing of another training run, and the verdict is how many there were.
    """
    findings = judge(results, failures=True)
    failed = sum(finding.failed for finding in findings if finding.about == findings[0].about)
    without = ""
    if failed:
        kept = judge(results, failures=False)
        findings = with_kept(findings, kept)
        without = _overall(kept)

    steps = [
        results.metrics[run.run_id]["global_step"].iloc[-1]
        for run in results.suite.runs
        if run.run_id in results.evaluations and run.run_id not in results.diverged
    ]
    return Claim(
        "d", STATEMENT, _overall(findings) if findings else UNDECIDED, findings,
        basis_of(steps, paper_numbers("table2")["timesteps"]), failed, without,
    )  # fmt: skip


def judge(results: Results, failures: bool) -> list[Finding]:
    """A finding for each column.

    Args:
        results: What the runs have left.
        failures: Whether runs that failed count, with the rates of the worst run.
    """
    games = results.suite.environments
    product = itertools.product(games, plain_agents(results), splits(results))
    columns = [Column(*names) for names in product]
    gains = [_gains(results, column, failures) for column in columns]
    p = np.array([float(compare_success(gain).p) if gain.size else np.nan for gain in gains])
    corrected = holm(p)
    shares = shares_left(corrected, np.ones(len(p)))

    findings = []
    for i, column in enumerate(columns):
        agent = column.plain if len(games) == 1 else f"{column.game}: {column.plain}"
        about = f"reg - plain: success, {column.split} levels"
        failed = len(_lost(results, column.game, column.plain))
        failed += len(_lost(results, column.game, f"{column.plain} reg"))
        if not gains[i].size:
            none = Estimate(np.nan, np.nan, np.nan, 0)
            finding = Finding(about, agent, none, UNDECIDED, failed, note="no pair yet")
        else:
            finding = _finding(about, agent, gains[i], float(corrected[i]), float(shares[i]))
            finding = dataclasses.replace(finding, failed=failed)
        findings.append(finding)
    return findings


def _finding(about: str, agent: str, gains: np.ndarray, corrected: float, share: float) -> Finding:
    runs = len(gains)
    found = compare_success(gains, share)
    return Finding(
        about, agent, Estimate(float(found.mean), float(found.low), float(found.high), runs),
        _word(float(found.mean), runs, corrected),
        detectable=float(found.detectable), p=float(found.p), p_holm=corrected, note=_kind(runs),
    )  # fmt: skip


def _word(gain: float, runs: int, corrected: float) -> str:
    if runs < MIN_TRAINING_RUNS:
        return training_runs(runs)
    return WORDS[int(np.sign(gain))] if corrected <= ALPHA else UNDECIDED


def _overall(findings: list[Finding]) -> str:
    """All columns must agree; below 5 training runs the word is how few there were."""
    runs = min(finding.estimate.n for finding in findings)
    if 0 < runs < MIN_TRAINING_RUNS:
        return training_runs(runs)
    return agreed([finding.verdict for finding in findings])


def training_runs(runs: int) -> str:
    """A verdict's place where too few runs were trained to have one."""
    return "one training run" if runs == 1 else f"{runs} training runs"


def _kind(runs: int) -> str:
    return (
        "interval over training runs and levels"
        if runs >= MIN_TRAINING_RUNS
        else "interval over levels only"
    )


def splits(results: Results) -> tuple[str, ...]:
    """Kinds of levels that the suite's agents are evaluated on."""
    asked = {run.evaluation["unseen"] for run in results.suite.runs}
    return (*SPLITS, "themes") if "themes" in asked else SPLITS


def plain_agents(results: Results) -> list[str]:
    """The suite's algorithms that have a regularized twin."""
    names = results.suite.algorithms
    return [name for name in names if f"{name} reg" in names]


def _gains(results: Results, column: Column, failures: bool) -> np.ndarray:
    """Success with the penalty less without it, `[training runs, levels]`, of sampled actions."""
    game, plain, split = column
    without = _rates(results, game, plain, split)
    penalized = _rates(results, game, f"{plain} reg", split)
    if failures:
        worst = _worst(results, game, split)
        without.update(dict.fromkeys(_lost(results, game, plain), worst))
        penalized.update(dict.fromkeys(_lost(results, game, f"{plain} reg"), worst))

    both = sorted(without.keys() & penalized.keys())
    if not both:
        return np.empty((0, 0))
    frame = pd.DataFrame({key: penalized[key] - without[key] for key in both})
    return frame.dropna().to_numpy().T


def _rates(results: Results, game: str, name: str, split: str) -> dict[Key, pd.Series]:
    """Success rates on each level, of the runs that did not fail."""
    lost = _lost(results, game, name)
    pairs = results.pairs(game, name)
    return {key: level_rates(e, split) for key, e in pairs.items() if key not in lost}


def _worst(results: Results, game: str, split: str) -> pd.Series:
    """The rates of the worst single run among all arms; 0 where there is none."""
    arms = [name for plain in plain_agents(results) for name in (plain, f"{plain} reg")]
    runs = [rates for name in arms for rates in _rates(results, game, name, split).values()]
    runs = [rates for rates in runs if len(rates)]
    return min(runs, key=lambda rates: float(rates.mean()), default=pd.Series([0.0]))


def level_rates(episodes: pd.DataFrame, split: str, policy: str = "sampled") -> pd.Series:
    """Success rate on each level of a kind, by level."""
    chosen = (episodes["split"] == split) & (episodes["policy"] == policy)
    return episodes[chosen].groupby("level")["success"].mean()


def _lost(results: Results, game: str, name: str) -> set[Key]:
    """The runs of an algorithm whose own numbers became non-finite."""
    return {
        (run.args["seed"], run.args["agent"])
        for run in results.suite.runs
        if (run.environment, run.algorithm) == (game, name) and run.run_id in results.diverged
    }
