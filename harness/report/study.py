"""Figures behind the claims: psi and reward, paired differences, ablations, J and the spectrum."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from harness.report.claims import Claim, Finding
from harness.report.figures import COLORS, COLUMNS, save, tidy
from harness.report.results import Results
from harness.statistics import estimate_mean, spearman

VERDICTS = {
    "supported": COLORS[2], "win": COLORS[2], "contradicted": COLORS[1], "loss": COLORS[1],
}  # fmt: skip


def psi_and_reward(agents: pd.DataFrame, path: Path) -> None:
    """Claim (a): an agent is a point, final psi against final reward, a panel for each task."""
    agents = agents[agents["plain"]].dropna(subset=["reward"])
    algorithms = list(agents["algorithm"].unique())
    figure, axes = _panels(list(agents["environment"].unique()))
    for task, axis in axes.items():
        for algorithm, color in zip(algorithms, itertools.cycle(COLORS), strict=False):
            of = agents[(agents["environment"] == task) & (agents["algorithm"] == algorithm)]
            if len(of):
                axis.scatter(of["psi"], of["reward"], color=color, s=16, alpha=0.7, label=algorithm)
        axis.set_xlabel("final psi")
        axis.set_ylabel("final reward")
    save(figure, path)


def findings(claim: Claim, path: Path) -> None:
    """A claim's estimates with their 95% intervals, a panel for each kind of number."""
    kinds: dict[str, list[Finding]] = {}
    for finding in claim.findings:
        if finding.about.endswith(": reward"):
            continue  # the scales of the tasks differ by thousands: the page lists these
        kinds.setdefault(finding.about, []).append(finding)
    ordered = sorted(kinds.items(), key=lambda kind: -len(kind[1]))  # equals share a row
    heights = [1 + 0.32 * len(found) for _, found in ordered[::2]]
    figure, axes = plt.subplots(
        len(heights), 2, squeeze=False, layout="constrained", figsize=(11, sum(heights)),
        height_ratios=heights,
    )  # fmt: skip
    for axis in axes.flat[len(kinds) :]:
        axis.set_visible(False)
    for axis, (about, found) in zip(axes.flat, ordered, strict=False):
        tidy(axis)
        for y, finding in enumerate(reversed(found)):
            mean, low, high, n = finding.estimate
            color = VERDICTS.get(finding.verdict, "gray")
            if not np.isnan(low):
                axis.plot([low, high], [y, y], color=color, linewidth=2)
            axis.plot(mean, y, "o", color=color, markersize=5)
            axis.annotate(f" n={n}", (1, y), xycoords=("axes fraction", "data"), fontsize=7,
                          va="center", color="gray")  # fmt: skip
        axis.axvline(0.5 if "probability" in about else 0, color="black", linewidth=0.8)
        axis.locator_params(axis="x", nbins=6)
        axis.set_yticks(range(len(found)), [f.task for f in reversed(found)])
        axis.set_ylim(-0.6, len(found) - 0.4)
        axis.set_title(about, fontsize=10)
    save(figure, path)


def quotient_and_spectrum(results: Results, path: Path) -> bool:
    """What J is worth: its median against the exact mean singular value, a point a measurement.

    Returns whether any run has logged its spectrum (`--log-spectrum`).
    """
    columns = ["global_step", "conditioning/quotient_q50", "conditioning/singular_value_mean"]
    columns.append("conditioning/squared_singular_value")
    parts: dict[str, list[pd.DataFrame]] = {}
    for run in results.suite.runs:
        metrics = results.metrics.get(run.run_id)
        if metrics is not None and columns[-1] in metrics:
            parts.setdefault(run.environment, []).append(metrics[columns].dropna())
    tasks = {task: pd.concat(found) for task, found in parts.items()}
    tasks = {task: found for task, found in tasks.items() if len(found)}
    if not tasks:
        return False
    figure, axes = _panels(list(tasks))
    for task, axis in axes.items():
        steps, quotient, exact, _ = (tasks[task][c] for c in columns)
        axis.scatter(exact, quotient, c=steps, cmap="viridis", s=10)
        end = max(exact.max(), quotient.max())
        axis.plot([0, end], [0, end], color="gray", linewidth=0.8, linestyle="--")
        rank = spearman(exact.to_numpy(), quotient.to_numpy()) if len(exact) > 2 else np.nan
        axis.set_title(f"{task}: rank correlation {rank:.2f}", fontsize=10)
        axis.set_xlabel("mean singular value")
        axis.set_ylabel("median J")
    save(figure, path)
    return True


def sweep(results: Results, agents: pd.DataFrame, name: str, path: Path) -> None:
    """An ablation: final reward and psi against the parameter's value, tasks side by side."""
    values = results.suite.sweeps[name]
    tasks = results.suite.environments
    figure, axes = plt.subplots(
        2, len(tasks), figsize=(4.2 * len(tasks), 5), squeeze=False, layout="constrained"
    )
    for column, task in enumerate(tasks):
        for axis, measure in zip(axes[:, column], ("reward", "psi"), strict=True):
            tidy(axis)
            _sweep_panel(axis, agents[agents["environment"] == task], measure, values)
            axis.set_ylabel(measure)
        axes[0, column].set_title(task, fontsize=11)
        axes[1, column].set_xlabel(name)
    save(figure, path)


def _sweep_panel(axis: Axes, agents: pd.DataFrame, measure: str, values: dict[Any, str]) -> None:
    for x, algorithm in enumerate(values.values()):
        mean, low, high, n = estimate_mean(
            agents.loc[agents["algorithm"] == algorithm, measure].dropna().to_numpy()
        )
        if n:
            axis.plot(x, mean, "o", color=COLORS[0])
            axis.plot([x, x], [low, high], color=COLORS[0], linewidth=2)
    plain = estimate_mean(agents.loc[agents["algorithm"] == "PPO", measure].dropna().to_numpy())
    if plain.n:
        axis.axhline(plain.mean, color="gray", linestyle="--", linewidth=0.8, label="PPO")
    axis.set_xticks(range(len(values)), [str(value) for value in values])


def _panels(names: list[str]) -> tuple[Any, dict[str, Axes]]:
    """A figure with a titled panel for each name."""
    columns = max(1, min(COLUMNS, len(names)))
    rows = max(1, -(-len(names) // columns))
    figure, axes = plt.subplots(
        rows, columns, figsize=(max(3.4 * columns, 5), 2.9 * rows + 0.4), squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    named = dict(zip(names, axes.flat, strict=False))
    for name, axis in named.items():
        tidy(axis)
        axis.set_title(name, fontsize=11)
    return figure, named
