"""The exact numbers of a finished run that tables and claims rest on.

They are computed from every row of the metrics, once, and travel with an archive, whose curves are
thinned.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import stats

RETURN, PSI, EPISODES = "charts/episodic_return", "conditioning/psi", "charts/episodes"
SPEED = "charts/SPS"  # columns that begin so differ each time that a run is run
WINDOW = 200_000  # steps: the last 100 updates of the paper's runs
EARLY = 0.1  # share of the steps that count as "from the first steps"


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
        found["early_psi"] = early_psi(metrics, total_timesteps)
        found["together"] = moved_together(metrics)
    return found


def training_score(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean return of the episodes that ended in the window, or in the last row with any."""
    ended = metrics[RETURN].notna()
    inside = ended & _in_window(metrics, total_timesteps)
    rows = metrics[inside] if inside.any() else metrics[ended].tail(1)
    if not len(rows):
        return np.nan

    weights = rows[EPISODES].to_numpy(float) if EPISODES in rows else np.ones(len(rows))
    return float(np.average(rows[RETURN].to_numpy(float), weights=weights))


def training_psi(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean of the finite psi in the window, or the last finite one."""
    finite = np.isfinite(metrics[PSI])
    inside = finite & _in_window(metrics, total_timesteps)
    rows = metrics[inside] if inside.any() else metrics[finite].tail(1)
    return float(rows[PSI].mean())


def early_psi(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean psi over the first tenth of the steps, or of the first update."""
    finite = metrics[np.isfinite(metrics[PSI])]
    inside = finite[finite["global_step"] <= EARLY * total_timesteps]
    rows = inside if len(inside) else finite.head(1)
    return float(rows[PSI].mean())


def moved_together(metrics: pd.DataFrame) -> float:
    """Spearman's correlation of the changes of psi and return from update to update."""
    changes = np.diff(metrics[[PSI, RETURN]].dropna().to_numpy(float), axis=0)
    if len(changes) < 3 or (np.ptp(changes, axis=0) == 0).any():
        return np.nan
    return float(stats.spearmanr(changes[:, 0], changes[:, 1]).statistic)


def _in_window(metrics: pd.DataFrame, total_timesteps: int) -> np.ndarray:
    """Which rows are of the last window: 200,000 steps, or a tenth of a shorter run."""
    steps = metrics["global_step"].to_numpy()
    return steps > steps[-1] - min(WINDOW, total_timesteps / 10)
