"""Claims (b), the regularizer wins on most of the tasks, and (c), TRPO beats PPO."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from harness.report.claims.agents import fill_failed
from harness.report.claims.finding import (
    LOSS,
    NEGLIGIBLE,
    NO_EFFECT,
    REPORTED,
    UNDECIDED,
    WIN,
    WORDS,
    Claim,
    Finding,
    agreed,
    basis_of,
    with_kept,
)
from harness.report.published import paper_numbers
from harness.statistics import (
    Estimate,
    interquartile_mean,
    probability_of_improvement,
    smallest_n,
)
from harness.statistics.judgements import Comparison, Judged, compare_arms

CONTRASTS = {
    "b": (("PPO", "PPO reg"), ("TRPO", "TRPO reg")),
    "c": (("PPO", "TRPO"), ("PPO reg", "TRPO reg")),
}
STATEMENTS = {
    "b": "The regularizer wins on most of the tasks.",
    "c": "TRPO beats PPO.",
}
OUTCOMES = {"reward": "", "final": "final policies, "}
STANDARD = "in standard deviations"


class Arms(NamedTuple):
    """Scores of a claim's arms, side by side: `[contrasts, tasks, n]`, NaN where there is none."""

    contrasts: list[tuple[str, str]]
    tasks: list[str]
    first: np.ndarray
    second: np.ndarray
    failed: np.ndarray
    """runs of both arms that failed, `[contrasts, tasks]`"""


class Part(NamedTuple):
    """What one outcome, such as the training score, says of a claim."""

    findings: list[Finding]
    verdicts: list[str]
    """of each contrast"""
    notes: list[str]


def comparison_claim(agents: pd.DataFrame, letter: str, planned: set[tuple[str, str]]) -> Claim:
    """Claim (b) or (c): second minus first arm, paired by task, seed and agent.

    The verdict is of the training score, the paper's measure; what the final policies say stands
    beside it. A planned (task, algorithm) that `agents` has not leaves the claim undecided.
    """
    named = {name for contrast in CONTRASTS[letter] for name in contrast}
    compared = agents[agents["algorithm"].isin(named)]
    failed = int(compared["failed"].sum())
    part, without = _with_and_without(compared, letter, planned, "reward")
    findings = list(part.findings)
    notes = list(part.notes)
    if part.findings and compared["final"].notna().any():
        final, kept = _with_and_without(compared, letter, planned, "final")
        findings += final.findings
        notes += final.notes
        beside = f"; without the failed runs: {kept}" if kept else ""
        notes.append(f"By the final policies: {agreed(final.verdicts)}{beside}.")

    steps = compared.loc[~compared["failed"], "steps"]
    return Claim(
        letter, STATEMENTS[letter], agreed(part.verdicts), findings,
        basis=basis_of(steps, paper_numbers("table1")["timesteps"]),
        failed=failed, without_failed=without, notes=tuple(notes),
    )  # fmt: skip


def _with_and_without(
    compared: pd.DataFrame, letter: str, planned: set[tuple[str, str]], column: str
) -> tuple[Part, str]:
    """What an outcome says, and its verdict without the failed runs; empty if there are none."""
    part = judge(compared, letter, planned, column)
    if not part.findings or not compared["failed"].any():
        return part, ""
    kept = judge(compared[~compared["failed"]], letter, planned, column)
    return part._replace(findings=with_kept(part.findings, kept.findings)), agreed(kept.verdicts)


def judge(agents: pd.DataFrame, letter: str, planned: set[tuple[str, str]], column: str) -> Part:
    """All tests of a claim on one outcome."""
    arms = make_arms(agents, CONTRASTS[letter], column)
    if not arms.contrasts:
        return Part([], [UNDECIDED], [])
    compared = compare_arms(arms.first, arms.second)
    findings: list[Finding] = []
    verdicts = []
    notes = []
    for number, (first, second) in enumerate(arms.contrasts):
        about = f"{OUTCOMES[column]}{second} - {first}"
        words = _words(compared, number)
        missing = _missing(arms, number, planned)
        verdict = _overall(int(compared.headline.word[number]), words, missing)
        verdicts.append(verdict)
        findings += _findings(arms, compared, number, about, words, verdict)
        notes.append(_summary(about, words, missing))

    skipped = _untried(arms, letter, planned)
    if skipped:
        verdicts.append(UNDECIDED)
        notes.append(f"No pairs yet: {', '.join(skipped)}.")
    return Part(findings, verdicts, notes)


def make_arms(agents: pd.DataFrame, contrasts: tuple[tuple[str, str], ...], column: str) -> Arms:
    """The scores of contrasts that have any pair; failed runs have their task's worst score."""
    tasks = list(agents["environment"].unique())
    keys = pd.MultiIndex.from_frame(agents[["seed", "agent"]].drop_duplicates()).sort_values()
    filled = fill_failed(agents, column)

    def scores(name: str) -> np.ndarray:
        own = filled[filled["algorithm"] == name].set_index(["environment", "seed", "agent"])
        return np.array([own[column].get(task, _none()).reindex(keys) for task in tasks])

    found = []
    for first, second in contrasts:
        pair = (scores(first), scores(second))
        if tasks and not np.isnan(pair[0] - pair[1]).all():
            found.append(((first, second), *pair))
    failures = agents[agents["failed"]].groupby(["environment", "algorithm"]).size()
    failed = [
        [sum(failures.get((task, name), 0) for name in names) for task in tasks]
        for names, _, _ in found
    ]
    return Arms(
        [names for names, _, _ in found], tasks,
        np.array([first for _, first, _ in found]), np.array([second for _, _, second in found]),
        np.array(failed),
    )  # fmt: skip


def _none() -> pd.Series:
    index = pd.MultiIndex.from_tuples([], names=["seed", "agent"])
    return pd.Series([], index=index, dtype=float)


def _words(compared: Comparison, number: int) -> list[str]:
    """The word on each task; empty where it has no pair."""
    words = []
    for task, count in enumerate(compared.tasks.n[number]):
        called = compared.tasks.word[number, task]
        word = NEGLIGIBLE if compared.negligible[number, task] else UNDECIDED
        word = {1: WIN, -1: LOSS}.get(called, word)
        words.append(word if count else "")
    return words


def _overall(called: int, words: list[str], missing: list[str]) -> str:
    """The verdict on a contrast: its headline's word, or none where tasks are missing.

    "No effect" where more than half of the tasks are negligible: a mean that a few tasks carry
    does not say "on most".
    """
    if missing:
        return UNDECIDED
    if 2 * words.count(NEGLIGIBLE) > len([word for word in words if word]):
        return NO_EFFECT
    return WORDS[called]


def _missing(arms: Arms, number: int, planned: set[tuple[str, str]]) -> list[str]:
    """Tasks that are planned for both arms and have no pair."""
    first, second = arms.contrasts[number]
    pairs = ~np.isnan(arms.first[number] - arms.second[number])
    there = {task for task, any_pair in zip(arms.tasks, pairs.any(axis=1), strict=True) if any_pair}
    both = {task for task, name in planned if name == first and (task, second) in planned}
    return sorted(both - there)


def _untried(arms: Arms, letter: str, planned: set[tuple[str, str]]) -> list[str]:
    """Contrasts that are planned and have no pair on any task."""
    return [
        f"{second} - {first}"
        for first, second in CONTRASTS[letter]
        if (first, second) not in arms.contrasts
        and any((task, second) in planned for task, name in planned if name == first)
    ]


def _summary(about: str, words: list[str], missing: list[str]) -> str:
    tasks = len([word for word in words if word])
    wins = words.count(WIN)
    most = ", on most tasks" if 2 * wins > tasks else ""
    losses = words.count(LOSS)
    text = f"{about}: {wins} wins and {losses} losses on {tasks} tasks{most}."
    return f"{text} Not yet run: {', '.join(missing)}." if missing else text


def _findings(
    arms: Arms, compared: Comparison, number: int, about: str, words: list[str], verdict: str
) -> list[Finding]:
    """A contrast's findings: the headline, each task in two units, and what stands beside."""
    failed = arms.failed[number]
    headline = _finding(
        f"{about}: {STANDARD}", "all", compared.headline, (number,), verdict,
        int(failed.sum()),
    )  # fmt: skip
    raw, standard = [], []
    for task, word in enumerate(words):
        if not word:
            continue
        place = (number, task)
        found = _finding(
            f"{about}: reward", arms.tasks[task], compared.tasks, place, word,
            int(failed[task]),
        )  # fmt: skip
        raw.append(found)
        standard.append(_in_deviations(found, f"{about}: {STANDARD}", compared, place))

    beside = _beside(arms, compared, number, about, int(failed.sum()))
    return [headline, *raw, *standard, *beside]


def _finding(
    about: str, task: str, tests: Judged, place: tuple[int, ...], word: str, failed: int
) -> Finding:
    n = int(tests.n[place])
    needed = smallest_n(float(tests.share[place]))
    return Finding(
        about, task,
        Estimate(*(float(values[place]) for values in (tests.mean, tests.low, tests.high)), n),
        word, failed,
        detectable=float(tests.detectable[place]),
        p=float(tests.p[place]),
        p_holm=float(tests.corrected[place]),
        note=f"{needed} pairs could decide" if n < needed else "",
    )  # fmt: skip


def _in_deviations(
    found: Finding, about: str, compared: Comparison, place: tuple[int, ...]
) -> Finding:
    """The same finding in standard deviations, so that tasks can be drawn beside each other."""
    unit = float(compared.deviation[place])
    mean, low, high, n = found.estimate
    estimate = Estimate(mean / unit, low / unit, high / unit, n)
    return Finding(
        about, found.task, estimate, found.verdict, found.failed, found.detectable / unit, found.p,
        found.p_holm, note=found.note,
    )  # fmt: skip


def _beside(
    arms: Arms, compared: Comparison, number: int, about: str, failed: int
) -> list[Finding]:
    """Interquartile mean and probability of improvement: reported, without a test."""
    present = ~np.isnan(compared.standard[number])
    standard = [
        values[there] for values, there in zip(compared.standard[number], present, strict=True)
    ]
    pairs = [
        (first[there], second[there])
        for first, second, there in zip(
            arms.first[number], arms.second[number], present, strict=True
        )
    ]
    middle = interquartile_mean(standard)
    chance = probability_of_improvement(pairs)
    return [
        Finding(f"{about}: interquartile mean, {STANDARD}", "all", middle, REPORTED, failed),
        Finding(f"{about}: probability of improvement", "all", chance, REPORTED, failed),
    ]
