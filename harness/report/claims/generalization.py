"""Claim (d): the regularizer improves all four CoinRun agents, on seen and on unseen levels."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd

from harness.report.claims.finding import UNDECIDED, WORDS, Claim, Finding, agreed, basis_of
from harness.report.published import paper_numbers
from harness.report.results import Results
from harness.statistics import ALPHA, MIN_TRAINING_RUNS, Estimate, compare_success, holm

SPLITS = ("seen", "unseen")
STATEMENT = "The regularizer improves all four CoinRun agents, on seen and on unseen levels."


def generalization_claim(results: Results) -> Claim:
    """Claim (d): for each agent and kind of levels, reg minus plain, paired by seed and agent.

    From 5 training runs on, the test knows how much training runs and levels vary. Fewer say
    nothing of another training run, and the verdict is how many there were.
    """
    games = results.suite.environments
    columns = list(itertools.product(games, plain_agents(results), splits(results)))
    gains = [_gains(results, game, plain, split) for game, plain, split in columns]
    share = 1 / max(len(columns), 1)
    found = [compare_success(gain, share) if gain.size else None for gain in gains]
    p = np.array([np.nan if each is None else float(each.p) for each in found])
    corrected = holm(p)

    findings = []
    for i, (game, plain, split) in enumerate(columns):
        agent = plain if len(games) == 1 else f"{game}: {plain}"
        about = f"reg - plain: success, {split} levels"
        each = found[i]
        if each is None:
            none = Estimate(np.nan, np.nan, np.nan, 0)
            findings.append(Finding(about, agent, none, UNDECIDED, note="no pair yet"))
            continue
        runs = len(gains[i])
        estimate = Estimate(float(each.mean), float(each.low), float(each.high), runs)
        word = _word(float(each.mean), runs, float(corrected[i]))
        findings.append(
            Finding(about, agent, estimate, word, _failed(results, game, plain),
                    float(each.detectable), float(p[i]), float(corrected[i]), note=_kind(runs))
        )  # fmt: skip

    steps = [
        results.metrics[run.run_id]["global_step"].iloc[-1]
        for run in results.suite.runs
        if run.run_id in results.evaluations
    ]
    return Claim(
        "d", STATEMENT, _overall(findings) if findings else UNDECIDED, findings,
        basis_of(steps, paper_numbers("table2")["timesteps"]),
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


def _gains(results: Results, game: str, plain: str, split: str) -> np.ndarray:
    """Success with the penalty less without it, `[training runs, levels]`, of sampled actions."""
    rates = [
        {key: level_rates(e, split) for key, e in results.pairs(game, name).items()}
        for name in (plain, f"{plain} reg")
    ]
    both = sorted(rates[0].keys() & rates[1].keys())
    if not both:
        return np.empty((0, 0))
    frame = pd.DataFrame({key: rates[1][key] - rates[0][key] for key in both})
    return frame.dropna().to_numpy().T


def level_rates(episodes: pd.DataFrame, split: str, policy: str = "sampled") -> pd.Series:
    """Success rate on each level of a kind, by level."""
    chosen = (episodes["split"] == split) & (episodes["policy"] == policy)
    return episodes[chosen].groupby("level")["success"].mean()


def _failed(results: Results, game: str, plain: str) -> int:
    names = (plain, f"{plain} reg")
    return sum(
        run.run_id in results.diverged
        for run in results.suite.runs
        if run.environment == game and run.algorithm in names
    )
