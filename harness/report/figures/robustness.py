"""Return against the radius of the strongest attack: every agent, and the median of each arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from harness.report.figures.style import colors_of, make_panels, save
from harness.report.results import Results
from harness.report.tables.robustness import NORMS, strongest


def return_against_radius(results: Results, frame: pd.DataFrame, path: Path) -> bool:
    """A panel for each task and norm. Agents are dots; a line joins their medians.

    Args:
        results: The suite, for the order of its tasks and algorithms.
        frame: What `robustness_frame` gives.
        path: Of the PNG file.

    Returns whether any agent was attacked with a radius above 0.
    """
    worst = strongest(frame)
    attacked = worst[worst["radius"] > 0]
    panels = {
        f"{task} ({NORMS[norm]})": worst[(worst["task"] == task) & (worst["norm"] == norm)]
        for task in results.suite.environments
        for norm in NORMS
        if ((attacked["task"] == task) & (attacked["norm"] == norm)).any()
    }
    if not panels:
        return False

    algorithms = [name for name in results.suite.algorithms if name in set(worst["algorithm"])]
    colors = colors_of(algorithms)
    figure, axes = make_panels(list(panels), height=3.1)
    for title, found in panels.items():
        radii = np.sort(found["radius"].unique())
        gap = np.diff(radii).min() if len(radii) > 1 else 1.0
        for place, name in enumerate(algorithms):
            own = found[found["algorithm"] == name]
            if not len(own):
                continue
            # side by side, so that dots of two arms do not hide each other
            shift = 0.1 * gap * (place - (len(algorithms) - 1) / 2)
            axes[title].plot(
                own["radius"] + shift, own["return"], "o", color=colors[name], markersize=3,
                alpha=0.5,
            )  # fmt: skip
            medians = own.groupby("radius")["return"].median()
            axes[title].plot(
                medians.index + shift, medians, color=colors[name], linewidth=1.8, label=name
            )
        axes[title].set_xticks(radii, [f"{radius:g}" for radius in radii])
        axes[title].set_xlabel("radius of the strongest attack")
        axes[title].set_ylabel("return")
    save(figure, path)
    return True
