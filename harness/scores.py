"""The exact numbers of a finished run that tables and claims rest on.

They are computed from every row of the metrics, once, and travel with an archive, whose curves are
thinned.
"""

from __future__ import annotations

import pandas as pd

from harness.statistics.scores import (
    PSI,
    early_psi,
    last_psi,
    moved_together,
    training_psi,
    training_score,
    window_of,
)

VERSION = 1  # raised when a score's definition changes: archives keep scores, not every row
SPEED = "charts/SPS"  # columns that begin so differ each time that a run is run


def exact_scores(metrics: pd.DataFrame, total_timesteps: int) -> dict[str, float]:
    """All of a run's scores, by name.

    `final/<column>` is the mean over the rows of the training score's window; of a speed, which
    counts from the start, it is the last row.
    """
    found = {
        "steps": float(metrics["global_step"].iloc[-1]),
        "updates": float(len(metrics)),
        "training_score": training_score(metrics, total_timesteps),
    }
    for name, values in metrics[_in_window(metrics, total_timesteps)].items():
        speed = str(name).startswith(SPEED)
        found[f"final/{name}"] = float(values.iloc[-1] if speed else values.mean())

    if PSI in metrics:
        found["psi"] = training_psi(metrics, total_timesteps)
        found["last_psi"] = last_psi(metrics)
        found["early_psi"] = early_psi(metrics, total_timesteps)
        found["together"] = moved_together(metrics)
    return found


def _in_window(metrics: pd.DataFrame, total_timesteps: int) -> pd.Series:
    """Which rows are of the training score's window."""
    steps = metrics["global_step"]
    return steps > steps.iloc[-1] - window_of(total_timesteps)
