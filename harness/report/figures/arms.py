"""Arms of an ablation: each against its plain algorithm, and sweeps of one parameter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from harness.report.figures.style import COLORS, save, tidy
from harness.report.results import Results
from harness.report.tables.arms import BASE, Arm
from harness.statistics import Estimate, estimate_mean


def draw_arms(arms: Sequence[Arm], path: Path) -> None:
    """Two rows of panels, a column for each task: differences of both scores, and psi."""
    tasks = list(dict.fromkeys(arm.task for arm in arms))
    names = list(dict.fromkeys(arm.arm for arm in arms))
    places = {name: len(names) - 1 - i for i, name in enumerate(names)}
    height = 0.8 + 0.3 * len(names)
    figure, axes = plt.subplots(
        2, len(tasks), figsize=(3.4 * len(tasks) + 1.6, 2 * height), squeeze=False, sharey=True,
        layout="constrained",
    )  # fmt: skip
    for column, task in enumerate(tasks):
        top, bottom = axes[:, column]
        for arm in (arm for arm in arms if arm.task == task):
            y = places[arm.arm]
            _draw(top, arm.reward, y + 0.15, COLORS[0], "training score")
            _draw(top, arm.final, y - 0.15, COLORS[1], "final policy")
            _draw(bottom, arm.psi, y, COLORS[2], "psi by the yardstick")
            bottom.plot(arm.plain_psi, y, "|", color="black", markersize=10, label="psi, plain")
        top.axvline(0, color="black", linewidth=0.8)
        top.set_title(task, fontsize=11)
        top.set_xlabel("difference of the score")
        bottom.set_xlabel("psi, late")
    for axis in axes.flat:
        tidy(axis)
        axis.locator_params(axis="x", nbins=5)
        axis.set_yticks(list(places.values()), list(places), fontsize=8)
        axis.set_ylim(-0.6, len(names) - 0.4)
    save(figure, path)


def _draw(axis: Axes, estimate: Estimate, y: float, color: str, label: str) -> None:
    mean, low, high, n = estimate
    if not n:
        return
    axis.plot(mean, y, "o", color=color, markersize=4, label=label)
    if not np.isnan(low):
        axis.plot([low, high], [y, y], color=color, linewidth=1.8)


def sweep(results: Results, agents: pd.DataFrame, name: str, path: Path) -> bool:
    """Training score and psi against the values of a parameter, a column for each task.

    Returns whether there was any to draw.
    """
    values = results.suite.sweeps[name]
    swept = agents[agents["algorithm"].isin(values.values())].dropna(subset=["reward"])
    tasks = [task for task in results.suite.environments if task in set(swept["environment"])]
    if not tasks:
        return False
    figure, axes = plt.subplots(
        2, len(tasks), figsize=(max(3.4 * len(tasks), 5), 4.4), squeeze=False, sharex=True,
        layout="constrained",
    )  # fmt: skip
    measures = {"reward": "training score", "psi": "psi"}
    for column, task in enumerate(tasks):
        for axis, (measure, label) in zip(axes[:, column], measures.items(), strict=True):
            tidy(axis)
            _sweep_panel(axis, agents[agents["environment"] == task], measure, values)
            axis.set_ylabel(label if column == 0 else "")
        axes[0, column].set_title(task, fontsize=11)
        axes[1, column].set_xlabel(name)
    save(figure, path)
    return True


def _sweep_panel(axis: Axes, agents: pd.DataFrame, measure: str, values: dict[Any, str]) -> None:
    for x, algorithm in enumerate(values.values()):
        found = agents.loc[agents["algorithm"] == algorithm, measure].dropna().to_numpy()
        mean, low, high, n = estimate_mean(found)
        if not n:
            continue
        axis.plot([x] * n, found, "o", color=COLORS[0], markersize=3, alpha=0.4)
        axis.plot([x - 0.25, x + 0.25], [mean, mean], color=COLORS[0], linewidth=2)
        if not np.isnan(low):
            axis.plot([x, x], [low, high], color="black", linewidth=1.5)
    plain = agents.loc[agents["algorithm"] == BASE, measure].dropna().to_numpy()
    if len(plain):
        axis.axhline(plain.mean(), color="gray", linestyle="--", linewidth=0.8, label=BASE)
    axis.set_xticks(range(len(values)), [str(value) for value in values])
    axis.set_xlim(-0.6, len(values) - 0.4)
