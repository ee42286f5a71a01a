"""Figures behind the claims: psi and reward over agents, and every finding with its interval."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from harness.report.claims import Claim, Finding, setting_means
from harness.report.figures.style import COLORS, colors_of, make_panels, save, tidy

VERDICTS = {
    "supported": COLORS[2], "win": COLORS[2], "contradicted": COLORS[1], "loss": COLORS[1],
}  # fmt: skip


def psi_and_reward(agents: pd.DataFrame, path: Path) -> bool:
    """Claim (a): plain agents are dots, means of their settings diamonds, a panel for each task.

    Returns whether there was any to draw.
    """
    agents = agents[agents["plain"]].dropna(subset=["reward", "psi"])
    if agents.empty:
        return False
    settings = setting_means(agents)
    colors = colors_of(list(agents["algorithm"].unique()))
    _, axes = make_panels(list(agents["environment"].unique()))
    for task, axis in axes.items():
        for algorithm, color in colors.items():
            own = agents[(agents["environment"] == task) & (agents["algorithm"] == algorithm)]
            means = settings[
                (settings["environment"] == task) & (settings["algorithm"] == algorithm)
            ]
            if len(own):
                axis.scatter(own["psi"], own["reward"], color=color, s=16, alpha=0.6)
                axis.scatter(
                    means["psi"], means["reward"], color=color, marker="D", s=55,
                    edgecolor="black", linewidth=0.8, label=algorithm, zorder=3,
                )  # fmt: skip
        axis.set_xlabel("psi, late")
        axis.set_ylabel("training score")
        axis.locator_params(axis="x", nbins=5)
    save(plt.gcf(), path)
    return True


def findings(claim: Claim, path: Path) -> None:
    """A claim's estimates with their 95% intervals, a panel for each kind of number.

    Kinds that have one number each, such as the probability of improvement of each pair of
    algorithms, share a panel. Differences of rewards are left out: the scales of the tasks differ
    by thousands, and the page lists them.
    """
    shown = [finding for finding in claim.findings if not finding.about.endswith(": reward")]
    counts = Counter(finding.about for finding in shown)
    panels: dict[str, dict[str, Finding]] = {}
    for finding in shown:
        title, label = finding.about, finding.task
        if counts[finding.about] == 1 and finding.task == "all" and ": " in finding.about:
            label, title = finding.about.split(": ", 1)
        panels.setdefault(title, {})[label] = finding

    ordered = sorted(panels.items(), key=lambda panel: -len(panel[1]))  # equals share a row
    heights = [0.8 + 0.28 * len(found) for _, found in ordered[::2]]
    columns = min(2, len(ordered))
    figure, axes = plt.subplots(
        len(heights), columns, squeeze=False, layout="constrained",
        figsize=(5.5 * columns, sum(heights)), height_ratios=heights,
    )  # fmt: skip
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (title, found) in zip(axes.flat, ordered, strict=False):
        _draw_findings(axis, title, found)
    save(figure, path)


def _draw_findings(axis: Axes, title: str, found: dict[str, Finding]) -> None:
    tidy(axis)
    for y, finding in enumerate(reversed(found.values())):
        mean, low, high, n = finding.estimate
        color = VERDICTS.get(finding.verdict, "gray")
        if not np.isnan(low):
            axis.plot([low, high], [y, y], color=color, linewidth=2)
        axis.plot(mean, y, "o", color=color, markersize=5)
        axis.annotate(
            f" n={n}", (1, y), xycoords=("axes fraction", "data"), fontsize=7, va="center",
            color="gray",
        )  # fmt: skip
    axis.axvline(0.5 if "probability" in title else 0, color="black", linewidth=0.8)
    axis.locator_params(axis="x", nbins=6)
    axis.set_yticks(range(len(found)), list(reversed(found)), fontsize=8)
    axis.set_ylim(-0.6, len(found) - 0.4)
    axis.set_title(title, fontsize=9)
