"""Claim (e): what the penalty adds to the time of a step, for each implementation by itself."""

from __future__ import annotations

import numpy as np
import pandas as pd

from harness.cost import check_timed
from harness.provenance import last_session, machine_of
from harness.report.claims.finding import (
    CONTRADICTED,
    SUPPORTED,
    UNDECIDED,
    Claim,
    Finding,
    agreed,
    basis_of,
)
from harness.report.published import paper_numbers
from harness.report.results import Results
from harness.statistics import Estimate, sign_flip_interval, sign_flip_test

LIMIT = 0.1  # of the time for a step; what "inexpensive" is taken to mean
STATEMENT = (
    "The regularizer is computationally inexpensive: it adds at most a tenth to the time that a "
    "step takes, the rest of the run included."
)
UNKNOWN = "unknown"
KEYS = ["kind", "plain", "implementation", "machine", "environment", "seed"]


def cost_claim(results: Results) -> Claim:
    """Claim (e): time for a step with the penalty over without it, less 1, by implementation.

    Where `python -m harness cost` has measured both arms in turn, the verdict is of that. Else it
    is of the suite's own runs, which must have shared their machine alike to mean anything.

    Raises:
        CostError: The measurement does not say what it comes from.
    """
    if results.timed is not None:
        check_timed(results.timed)
    findings = from_runs(results) if results.timed is None else measured_in_turn(results.timed)
    how = "the suite's own runs" if results.timed is None else "both arms in turn, alone"
    named = list(dict.fromkeys(finding.about.rpartition(", ")[2] for finding in findings))
    notes = [f"Implementations: {', '.join(named)}. Measured on {how}."] if named else []
    if named and results.timed is not None:
        notes += measured_by(results.timed, results)
    steps = [
        results.scores[run.run_id]["steps"]
        for run in results.suite.runs
        if run.run_id in results.done and run.run_id in results.scores
    ]
    verdict = agreed([finding.verdict for finding in findings]) if findings else UNDECIDED
    basis = basis_of(steps, paper_numbers("table1")["timesteps"])
    return Claim("e", STATEMENT, verdict, findings, basis, notes=tuple(notes))


def measured_by(timed: pd.DataFrame, results: Results) -> list[str]:
    """What a measurement comes from, and what else the suite's own runs come from."""
    days = sorted({str(date)[:10] for date in timed["date"]})
    span = " to ".join(dict.fromkeys((days[0], days[-1])))
    commits = list(timed["commit"].unique())
    machines = list(timed["machine"].unique())
    lines = [f"Commit {', '.join(commits)}; {', '.join(machines)}; {span}."]

    own = results.origins
    for what, measured, made in (
        ("commit", commits, own.commits), ("machine", machines, own.machines)
    ):  # fmt: skip
        if made and not set(measured) & set(made):
            lines.append(f"The suite's own runs are of another {what}: {', '.join(made)}.")
    return lines


def mixed_measurements(timed: pd.DataFrame | None) -> list[str]:
    """A warning where the measurements of `python -m harness cost` come from several places."""
    found = []
    for column in ("commit", "machine") if timed is not None else ():
        counts = timed[column].value_counts()
        if len(counts) > 1:
            parts = ", ".join(f"{name} ({n})" for name, n in counts.items())
            found.append(f"The measurements of claim (e) mix {column}s: {parts}.")
    return found


def measured_in_turn(timed: pd.DataFrame) -> list[Finding]:
    """A finding for each algorithm, implementation and task, over repetitions."""
    findings = []
    for key, group in timed.groupby(["algorithm", "implementation", "environment"]):
        algorithm, implementation, environment = key
        about = f"reg / plain - 1: time for a step, in turn, {environment}, {implementation}"
        added = group["reg"] / group["plain"] - 1
        findings.append(added_time(about, algorithm, added.to_numpy()))
    return findings


def from_runs(results: Results) -> list[Finding]:
    """A finding for each algorithm and implementation, from the speeds that the runs logged.

    A pair is a task and a seed, both arms trained by one implementation on one machine: the agents
    of a seed may have shared one process, so their mean counts once.
    """
    times = step_times(results)
    if not len(times):
        return []
    wide = times.pivot_table(index=KEYS, columns="arm", values="seconds")
    wide = wide.reindex(columns=["plain", "reg"]).dropna()
    added = wide["reg"] / wide["plain"] - 1
    return [
        added_time(
            f"reg / plain - 1: time for a step, {kind}, {implementation}", plain, group.to_numpy()
        )
        for (kind, plain, implementation), group in added.groupby(KEYS[:3], sort=False)
    ]


def added_time(about: str, algorithm: str, added: np.ndarray) -> Finding:
    """A finding from repetitions: judged by the whole 95% interval, on one side of the limit.

    The interval inverts the sign-flip test, so fewer than 6 repetitions have none. p is of the
    hypothesis that the limit is added; none is adjusted, since all findings must agree.
    """
    low, high = (float(end) for end in sign_flip_interval(added))
    verdict = UNDECIDED
    if high <= LIMIT:
        verdict = SUPPORTED
    elif low > LIMIT:
        verdict = CONTRADICTED
    note = "6 pairs could decide" if np.isnan(low) else ""
    estimate = Estimate(float(added.mean()), low, high, len(added))
    p = float(sign_flip_test(added - LIMIT))
    return Finding(about, algorithm, estimate, verdict, p=p, note=note)


def step_times(results: Results) -> pd.DataFrame:
    """Mean seconds of a step of the finished agents of each pair, from the speeds they logged."""
    names = results.suite.algorithms
    arms = {name: (name, "plain") for name in names if f"{name} reg" in names}
    arms.update({f"{name} reg": (name, "reg") for name in list(arms)})
    rows = []
    for run in results.suite.runs:
        if run.algorithm not in arms or run.run_id not in results.done:
            continue
        if run.run_id not in results.scores:  # it diverged in its first update
            continue
        plain, arm = arms[run.algorithm]
        session = last_session(results.specs.get(run.run_id, {}))
        speed = results.scores[run.run_id]["final/charts/SPS"]
        rows.append(
            {
                "kind": "CoinRun" if "levels" in run.evaluation else "control",
                "plain": plain,
                "arm": arm,
                "implementation": session["implementation"] if session else UNKNOWN,
                "machine": machine_of(session) if session else UNKNOWN,
                "environment": run.environment,
                "seed": run.args["seed"],
                "seconds": 1 / speed,
            }
        )
    return pd.DataFrame(rows, columns=[*KEYS, "arm", "seconds"])
