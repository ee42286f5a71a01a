"""Learning curves: reward and psi against environment steps, a panel for each task."""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from harness.report.results import Results
from harness.statistics import interval_of_means

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito's
COLUMNS = 4
POINTS = 100  # of a curve, at most
MEASURES = (("charts/episodic_return", "reward"), ("conditioning/psi", "psi"))


def learning_curves(results: Results, algorithms: list[str], path: Path) -> None:
    """Mean over agents with its 95% interval, as a PNG.

    A panel for each task that the suite plans for all of these algorithms and that has runs.
    """
    planned = results.suite.planned
    tasks = [
        task
        for task in results.suite.environments
        if all((task, algorithm) in planned for algorithm in algorithms)
        and any(results.of(task, algorithm) for algorithm in algorithms)
    ]
    columns = max(1, min(COLUMNS, len(tasks)))
    blocks = max(1, -(-len(tasks) // columns))
    figure, axes = plt.subplots(
        2 * blocks, columns, figsize=(max(3.4 * columns, 5), 4.2 * blocks),
        squeeze=False, sharex=True, layout="constrained",
    )  # fmt: skip
    for axis in axes.flat:
        axis.set_visible(False)
    if not tasks:
        figure.text(0.5, 0.5, "no runs yet", ha="center")
    for i, task in enumerate(tasks):
        block, column = divmod(i, columns)
        for j, (measure, label) in enumerate(MEASURES):
            axis = axes[2 * block + j, column]
            axis.set_visible(True)
            tidy(axis)
            for algorithm, color in zip(algorithms, itertools.cycle(COLORS), strict=False):
                draw_curves(axis, results.curves(task, algorithm, measure), algorithm, color)
            axis.set_ylabel(label if column == 0 else "")
            axis.set_title(task if j == 0 else "", fontsize=11)
            axis.set_xlabel("environment steps" if j and i + columns >= len(tasks) else "")
            axis.tick_params(labelbottom=True)
    save(figure, path)


def draw_curves(axis: Axes, curves: pd.DataFrame, label: str, color: str, style: str = "-") -> None:
    """The mean over agents, and its interval where there are several."""
    if curves.empty:
        return
    every = -(-len(curves) // POINTS)  # a point is the mean of so many updates
    curves = curves.groupby(np.arange(len(curves)) // every).mean().set_index(
        curves.index[every - 1 :: every].append(curves.index[-1:])[: -(-len(curves) // every)]
    )  # fmt: skip
    mean = curves.mean(axis=1)
    marker = "o" if len(curves) <= 20 else ""
    look = {"color": color, "lw": 1.6, "ls": style, "marker": marker, "markersize": 3}
    axis.plot(mean.index, mean, label=label, **look)
    if curves.shape[1] > 1:
        low, high = interval_of_means(curves.to_numpy())
        axis.fill_between(mean.index, low, high, color=color, alpha=0.2, linewidth=0)


def tidy(axis: Axes) -> None:
    """The look that all figures share."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)


def save(figure: Figure, path: Path) -> None:
    """Write the figure, with one legend for all of its axes above it."""
    named = {}
    for axis in figure.axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    if named:
        figure.legend(
            named.values(), named.keys(), loc="outside upper center", ncols=4, frameon=False
        )
    figure.savefig(path, dpi=110)
    plt.close(figure)
