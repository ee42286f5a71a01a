"""Learning curves: reward and psi against environment steps, a panel for each task."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from harness.store import Store
from harness.suite import Suite

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # Okabe and Ito's, told apart by all
COLUMNS = 4
MEASURES = (("charts/episodic_return", "reward"), ("conditioning/psi", "psi"))


def learning_curves(suite: Suite, store: Store, path: Path) -> None:
    """Mean over agents, each agent as a thin line behind it, written as a PNG."""
    blocks = -(-len(suite.environments) // COLUMNS)
    columns = min(COLUMNS, len(suite.environments))
    figure, axes = plt.subplots(
        2 * blocks, columns, figsize=(3.4 * columns, 4.2 * blocks),
        squeeze=False, sharex=True, layout="constrained",
    )  # fmt: skip
    for axis in axes.flat:
        axis.set_visible(False)
    for i, environment in enumerate(suite.environments):
        block, column = divmod(i, columns)
        for j, (measure, label) in enumerate(MEASURES):
            axis = axes[2 * block + j, column]
            axis.set_visible(True)
            for algorithm, color in zip(suite.algorithms, COLORS, strict=False):
                _draw(
                    axis,
                    agent_curves(suite, store, environment, algorithm, measure),
                    algorithm,
                    color,
                )
            axis.spines[["top", "right"]].set_visible(False)
            axis.grid(alpha=0.25)
            if column == 0:
                axis.set_ylabel(label)
            if j == 0:
                axis.set_title(environment, fontsize=11)
            if block == blocks - 1 and j == 1:
                axis.set_xlabel("environment steps")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def agent_curves(
    suite: Suite, store: Store, environment: str, algorithm: str, measure: str
) -> pd.DataFrame:
    """A row for each step count, a column for each agent."""
    columns = {}
    for spec in suite.runs:
        if (spec.environment, spec.algorithm) == (environment, algorithm):
            metrics = store.metrics(spec)
            if metrics is not None:
                columns[spec.run_id] = metrics.set_index("global_step")[measure]
    return pd.DataFrame(columns)


def _draw(axis: Axes, curves: pd.DataFrame, label: str, color: str) -> None:
    if curves.empty:
        return
    if curves.shape[1] > 1:
        axis.plot(curves.index, curves.to_numpy(), color=color, linewidth=0.5, alpha=0.3)
    mean = curves.mean(axis=1)
    few = np.count_nonzero(mean.notna()) <= 20
    axis.plot(mean.index, mean, color=color, linewidth=1.6, label=label, marker="o" if few else "",
              markersize=3)  # fmt: skip
