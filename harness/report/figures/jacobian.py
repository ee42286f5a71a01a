"""What J is worth: mean J² against ‖Jacobian‖²_F / n, to which it tends for small delta."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from harness.report.figures.style import make_panels, save
from harness.report.results import Results

SQUARED = "conditioning/quotient_squared"
EXACT = "conditioning/frobenius_squared_per_input"


def squares(results: Results, path: Path) -> bool:
    """A point for each measurement, coloured by the step, and the line y = x, on logarithmic axes.

    Returns whether any run has logged its spectrum (`--log-spectrum`).
    """
    parts: dict[str, list[pd.DataFrame]] = {}
    for run in results.suite.runs:
        metrics = results.metrics.get(run.run_id)
        if metrics is not None and {SQUARED, EXACT} <= set(metrics):
            found = metrics[["global_step", SQUARED, EXACT]].dropna()
            parts.setdefault(run.environment, []).append(found[(found > 0).all(axis=1)])
    tasks = {task: pd.concat(found) for task, found in parts.items()}
    tasks = {task: found for task, found in tasks.items() if len(found)}
    if not tasks:
        return False

    figure, axes = make_panels(list(tasks), height=3.1)
    for task, axis in axes.items():
        steps, squared, exact = (tasks[task][name] for name in ("global_step", SQUARED, EXACT))
        axis.scatter(exact, squared, c=steps, cmap="viridis", s=10)
        ends = [min(exact.min(), squared.min()), max(exact.max(), squared.max())]
        axis.plot(ends, ends, color="gray", linewidth=0.8, linestyle="--")
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_title(f"{task}: median ratio {np.median(squared / exact):.2f}", fontsize=10)
        axis.set_xlabel("‖Jacobian‖²_F / n")
        axis.set_ylabel("mean J²")
    save(figure, path)
    return True
