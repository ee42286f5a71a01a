"""The exact numbers of a finished run that tables and claims rest on.

They are computed from every row of the metrics, once, and travel with an archive, whose curves are
thinned.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from harness.statistics import spearman

RETURN, PSI, EPISODES = "charts/episodic_return", "conditioning/psi", "charts/episodes"
SPEED = "charts/SPS"  # columns that begin so differ each time that a run is run
WINDOW = 200_000  # steps: the last 100 updates of the paper's runs
EARLY = 0.1  # share of the updates that count as "from the first steps"


def exact_scores(metrics: pd.DataFrame, total_timesteps: int) -> dict[str, float]:
    """All of a run's scores, by name.

    `final/<column>` is the mean over the rows of the last window, and for a speed the last row.
    """
    last = metrics[in_window(metrics, total_timesteps)]
    found = {
        "steps": float(metrics["global_step"].iloc[-1]),
        "updates": float(len(metrics)),
        "training_score": training_score(metrics, total_timesteps),
    }
    for name, values in last.items():
        speed = str(name).startswith(SPEED)
        found[f"final/{name}"] = float(values.iloc[-1] if speed else values.mean())

    if PSI in metrics:
        early = max(1, round(EARLY * len(metrics)))
        found["early_psi"] = float(metrics[PSI].head(early).mean())
        found["together"] = correlation_of_steps(metrics)
    return found


def in_window(metrics: pd.DataFrame, total_timesteps: int) -> np.ndarray:
    """Which rows are of the last window: 200,000 steps, or a tenth of a shorter run."""
    steps = metrics["global_step"].to_numpy()
    return steps > steps[-1] - min(WINDOW, total_timesteps / 10)


def training_score(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean return over the episodes that ended in the window, or in the last row with any."""
    returns = metrics[RETURN]
    ended = metrics[EPISODES] if EPISODES in metrics else returns.notna().astype(float)
    counts = ended.where(returns.notna(), 0.0).to_numpy(float)

    chosen = in_window(metrics, total_timesteps) & (counts > 0)
    if not chosen.any():
        chosen = np.arange(len(metrics)) == np.max(np.flatnonzero(counts), initial=-1)
    if not chosen.any():
        return np.nan
    return float(np.average(returns[chosen], weights=counts[chosen]))


def correlation_of_steps(metrics: pd.DataFrame) -> float:
    """Spearman's correlation of the first differences of psi and return within a run."""
    both = metrics.loc[metrics[RETURN].notna(), [PSI, RETURN]].to_numpy(float)
    steps = np.diff(both, axis=0)
    return float(spearman(steps[None])[0]) if len(steps) > 2 else np.nan
