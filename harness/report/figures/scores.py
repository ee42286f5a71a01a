"""Table 1 as a picture: every agent's score, and the mean with its interval."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from harness.report.figures.style import colors_of, make_panels, save
from harness.report.tables.table1 import Cell


def score_cells(cells: Sequence[Cell], path: Path) -> bool:
    """Agents are dots; a cell's mean is a bar, with its 95% interval where it has one.

    Returns whether there was any to draw.
    """
    run = [cell for cell in cells if cell.agents]
    if not run:
        return False
    algorithms = list(dict.fromkeys(cell.algorithm for cell in run))
    colors = colors_of(algorithms)
    figure, axes = make_panels(list(dict.fromkeys(cell.environment for cell in run)))
    for cell in run:
        axis = axes[cell.environment]
        color = colors[cell.algorithm]
        x = algorithms.index(cell.algorithm)
        spread = np.linspace(-0.25, 0.25, cell.agents) if cell.agents > 1 else [0.0]
        axis.plot(x + np.asarray(spread), cell.scores, "o", color=color, markersize=3, alpha=0.5)
        mean, low, high, _ = cell.estimate
        axis.plot([x - 0.3, x + 0.3], [mean, mean], color=color, linewidth=2)
        if not np.isnan(low):
            axis.plot([x, x], [low, high], color="black", linewidth=1.5)
    for axis in axes.values():
        axis.set_xticks(range(len(algorithms)), algorithms, fontsize=8)
        axis.set_xlim(-0.6, len(algorithms) - 0.4)
        axis.grid(axis="x", visible=False)
    save(figure, path)
    return True
