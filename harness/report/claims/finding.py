"""What a claim rests on: findings, and the words that they allow."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd

from harness.statistics import Estimate

SUPPORTED = "supported"
CONTRADICTED = "contradicted"
UNDECIDED = "undecided"
NO_EFFECT = "no effect"
WIN = "win"
LOSS = "loss"
NEGLIGIBLE = "negligible"
REPORTED = "reported"  # a number beside the verdict that no test stands behind
WORDS = {1: SUPPORTED, 0: UNDECIDED, -1: CONTRADICTED}


@dataclasses.dataclass(frozen=True)
class Finding:
    """One number behind a verdict."""

    about: str
    """what was measured, such as "PPO reg - PPO: reward" """
    task: str
    """a task, or "all" """
    estimate: Estimate
    """the mean, its 95% interval, and over how many pairs or agents"""
    verdict: str
    """a word of this module; "reported" where the number belongs to no test"""
    failed: int = 0
    """runs among them whose own numbers became non-finite"""
    detectable: float = np.nan
    """the effect that would have been found with 80% power; NaN if n is too small for any"""
    p: float = np.nan
    """raw, as the test gave it: two-sided, but for claim (a), whose p is of the side judged"""
    p_holm: float = np.nan
    """adjusted over the claim's family; the verdict rests on it. NaN where none is adjusted"""
    without_failed: str = ""
    """the verdict without the failed runs; empty if there are none"""
    note: str = ""
    """what a reader must know, such as the fewest pairs that could decide"""


@dataclasses.dataclass(frozen=True)
class Claim:
    """A claim of the paper, what was found, and the verdict that the findings allow."""

    letter: str
    statement: str
    verdict: str
    findings: list[Finding]
    basis: str = ""
    """the steps that the verdict rests on, such as "at 2% of the paper's length" """
    failed: int = 0
    """runs whose own numbers became non-finite"""
    without_failed: str = ""
    """the verdict without the failed runs; empty if there are none"""
    notes: tuple[str, ...] = ()
    """what the verdict's word leaves out: wins and losses, missing tasks, the final policies"""


def agreed(verdicts: Sequence[str]) -> str:
    """The verdict on a claim of several parts: theirs if they agree."""
    return verdicts[0] if len(set(verdicts)) == 1 else UNDECIDED


def basis_of(steps: Iterable[float], paper: int) -> str:
    """The length of the runs as a share of the paper's."""
    done = sorted({int(step) for step in steps})
    if not done:
        return ""
    shares = list(dict.fromkeys(f"{100 * step / paper:.2g}%" for step in (done[0], done[-1])))
    counts = list(dict.fromkeys(f"{step:,}" for step in (done[0], done[-1])))
    return f"at {' to '.join(shares)} of the paper's length ({' to '.join(counts)} steps)"


def with_kept(findings: list[Finding], kept: list[Finding]) -> list[Finding]:
    """Findings with the verdicts that the same findings have without the failed runs."""
    words = {(finding.about, finding.task): finding.verdict for finding in kept}
    return [
        dataclasses.replace(f, without_failed=words.get((f.about, f.task), UNDECIDED))
        for f in findings
    ]


def to_frame(claims: list[Claim]) -> pd.DataFrame:
    """A row for each finding, for CSV."""
    rows = []
    for claim in claims:
        for finding in claim.findings:
            fields = dataclasses.asdict(finding)
            fields.pop("estimate")
            rows.append({"claim": claim.letter, **fields, **finding.estimate._asdict()})
    order = ["claim", "about", "task", "mean", "low", "high", "n", "failed", "detectable", "p"]
    order += ["p_holm", "verdict", "without_failed", "note"]
    return pd.DataFrame(rows, columns=order)
