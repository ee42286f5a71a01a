"""Claim (a): a policy that receives fewer rewards has worse conditioning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from harness.report.claims.agents import fill_failed
from harness.report.claims.finding import (
    REPORTED,
    UNDECIDED,
    WORDS,
    Claim,
    Finding,
    agreed,
    basis_of,
    with_kept,
)
from harness.report.published import paper_numbers
from harness.statistics import Estimate, estimate_mean, rank_correlation, sign_flip_test
from harness.statistics.judgements import Association, Judged, associate

STATEMENT = (
    "A policy that receives fewer rewards has worse conditioning (larger psi), and one that "
    "ends well is better conditioned from the first steps."
)
PARTS = {
    "psi": "over agents: final psi and reward",
    "early_psi": "over agents: early psi and reward",
}
TOGETHER = "over training: changes of psi and reward"
LEAST = 3  # agents of a setting that can have a correlation


class Settings(NamedTuple):
    """Plain agents, a row for each setting and a column for each (seed, agent) that all have."""

    names: list[tuple[str, str]]
    """(task, algorithm) of each row"""
    tasks: list[str]
    numbers: np.ndarray
    """the task of each row, as a number"""
    psi: np.ndarray
    """late and early, `[2, settings, n]`"""
    score: np.ndarray
    """`[settings, n]`"""


def conditioning_claim(agents: pd.DataFrame) -> Claim:
    """Claim (a), over plain agents of every setting: regularized ones have psi moved by design.

    A setting is a task with one set of hyperparameters. Agents are compared within settings only:
    psi and reward differ between settings for reasons of their own, and settings are few.
    """
    plain = agents[agents["plain"]]
    findings, verdict = judge(plain)
    failed = int(plain["failed"].sum())
    without = ""
    if failed and findings:
        kept, without = judge(plain[~plain["failed"]])
        findings = with_kept(findings, kept)
    steps = plain.loc[~plain["failed"], "steps"]
    basis = basis_of(steps, paper_numbers("table1")["timesteps"])
    return Claim(
        "a", STATEMENT, verdict, findings, basis, failed, without,
        notes=("Changes over training are reported; they are no part of the verdict.",),
    )  # fmt: skip


def judge(plain: pd.DataFrame) -> tuple[list[Finding], str]:
    """The findings and the verdict that they allow."""
    settings = make_settings(plain)
    if not settings.names:
        return [], UNDECIDED
    found = associate(settings.psi, settings.score, settings.numbers)
    failed = plain[plain["failed"]].groupby("environment").size()
    findings = []
    for part, about in enumerate(PARTS.values()):
        findings += _of_part(settings, found, part, about, failed)
    findings += _over_training(plain, failed)
    words = [WORDS[int(word)] for word in found.headline.word]
    return findings, agreed(words)


def make_settings(plain: pd.DataFrame) -> Settings:
    """Settings of at least 3 agents, and the agents that all of these have.

    Agents that one of them lacks are left out of all, since agents are permuted in all alike.
    """
    scored = fill_failed(plain, "reward").dropna(subset=["reward", "psi", "early_psi"])
    groups = {
        name: group.set_index(["seed", "agent"])
        for name, group in scored.groupby(["environment", "algorithm"], sort=False)
        if len(group) >= LEAST
    }
    common = None
    for group in groups.values():
        common = group.index if common is None else common.intersection(group.index)
    if common is None or len(common) < LEAST:
        return Settings([], [], np.empty(0, int), np.empty((2, 0, 0)), np.empty((0, 0)))

    names = list(groups)
    tasks = list(dict.fromkeys(task for task, _ in names))
    rows = [group.loc[common.sort_values()] for group in groups.values()]
    return Settings(
        names, tasks, np.array([tasks.index(task) for task, _ in names]),
        np.array([[row[column] for row in rows] for column in PARTS], dtype=float),
        np.array([row["reward"] for row in rows], dtype=float),
    )  # fmt: skip


def _of_part(
    settings: Settings, found: Association, part: int, about: str, failed: pd.Series
) -> list[Finding]:
    findings = [
        _finding(settings, found.headline, (part,), about, "all", int(failed.sum())),
    ]
    for number, task in enumerate(settings.tasks):
        lost = int(failed.get(task, 0))
        findings.append(_finding(settings, found.tasks, (part, number), about, task, lost))
    return findings


def _finding(
    settings: Settings, tests: Judged, place: tuple[int, ...], about: str, task: str, failed: int
) -> Finding:
    rows = slice(None) if task == "all" else settings.numbers == place[1]
    estimate = rank_correlation(settings.psi[place[0]][rows], settings.score[rows])
    word = WORDS[int(tests.word[place])]
    return Finding(
        about, task, estimate, word, failed, float(tests.detectable[place]),
        float(tests.p[place]), float(tests.corrected[place]),
    )  # fmt: skip


def _over_training(plain: pd.DataFrame, failed: pd.Series) -> list[Finding]:
    """How psi and reward change together from update to update, each agent a number."""
    known = plain.dropna(subset=["together"])
    groups = dict(list(known.groupby("environment", sort=False)))
    groups["all"] = known
    findings = []
    for task, group in groups.items():
        # settings share seeds, so one (seed, agent) counts once
        values = group.groupby(["seed", "agent"])["together"].mean().to_numpy()
        if not len(values):
            continue
        estimate: Estimate = estimate_mean(values)
        lost = int(failed.sum() if task == "all" else failed.get(task, 0))
        p = float(sign_flip_test(values))
        findings.append(Finding(TOGETHER, task, estimate, REPORTED, lost, p=p))
    return findings


def setting_means(agents: pd.DataFrame) -> pd.DataFrame:
    """Mean psi and reward of each plain setting, to be drawn: four settings cannot be tested."""
    plain = agents[agents["plain"]]
    columns = ["psi", "early_psi", "reward"]
    return plain.groupby(["environment", "algorithm"], sort=False)[columns].mean().reset_index()
