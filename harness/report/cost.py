"""Claim (e): what the penalty costs, from the speeds that the suite's own runs logged."""

from __future__ import annotations

import numpy as np

from harness.report.claims import MIN_UPDATES, Claim, Finding, agreed, without_verdict
from harness.report.results import Results
from harness.statistics import Estimate, estimate_mean, verdict

LIMIT = 0.1  # of the time for a step; what "inexpensive" is taken to mean
STATEMENT = (
    "The regularizer is computationally inexpensive: it adds at most a tenth to the time that a "
    "step takes, the rest of the run included."
)


def cost_claim(results: Results) -> Claim:
    """Claim (e): for each algorithm, time for a step with the penalty over without it, less 1.

    A pair is a task and a seed: the agents of a seed may have shared one process, so their mean
    counts once. The runs must have shared their machine alike for this to mean anything.
    """
    findings, parts = [], {"control": results.part(False), "CoinRun": results.part(True)}
    pairs = [
        (kind, part, name)
        for kind, part in parts.items()
        for name in part.suite.algorithms
        if f"{name} reg" in part.suite.algorithms
    ]
    for kind, part, plain in pairs:
        times, dear = _times(part, plain), _times(part, f"{plain} reg")
        if not times.keys() & dear.keys():
            continue
        added = np.array([dear[key] / times[key] - 1 for key in sorted(times.keys() & dear.keys())])
        mean, low, high, n = estimate_mean(added)
        judged = verdict(Estimate(mean - LIMIT, low - LIMIT, high - LIMIT, n), -1)
        about = f"reg / plain - 1: time for a step, {kind}"
        findings.append(Finding(about, plain, Estimate(mean, low, high, n), judged))
    claim = Claim("e", STATEMENT, agreed([f.verdict for f in findings]), findings)
    short = any(len(results.metrics[run_id]) < MIN_UPDATES for run_id in results.done)
    return without_verdict(claim) if short else claim


def _times(results: Results, algorithm: str) -> dict[tuple[str, int], float]:
    """Mean seconds of a step over the finished agents of each (task, seed)."""
    found: dict[tuple[str, int], list[float]] = {}
    for run in results.suite.runs:
        if run.algorithm == algorithm and run.run_id in results.done:
            speed = float(results.metrics[run.run_id]["charts/SPS"].iloc[-1])
            found.setdefault((run.environment, run.args["seed"]), []).append(1 / speed)
    return {key: float(np.mean(times)) for key, times in found.items()}
