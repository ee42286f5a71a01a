"""What one run comes to: its training score, its final policy's score, its psi early and late."""

from __future__ import annotations

import numpy as np
import pandas as pd

from harness.statistics.correlation import spearman

WINDOW = 200_000  # environment steps: the paper's last 100 updates of 2000
EARLY = 0.1  # share of the steps that count as "the first steps"
RETURN, EPISODES, PSI = "charts/episodic_return", "charts/episodes", "conditioning/psi"


def window_of(total_timesteps: int) -> float:
    """Length of the training score's window in steps: min(200,000, total / 10)."""
    return min(WINDOW, total_timesteps / 10)


def training_score(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean return of the episodes that ended in the last `window_of(total_timesteps)` steps.

    A row of `metrics` is an update and holds the mean return of the episodes that ended in it, so
    rows are weighted by their number of episodes. Metrics without that number count a row once.
    If no episode ended in the window, the last row in which one did counts. NaN if none ever did.
    """
    ended = metrics[metrics[RETURN].notna()]
    inside = _last_window(ended, metrics, total_timesteps)
    rows = inside if len(inside) else ended.tail(1)
    if not len(rows):
        return np.nan

    weights = rows[EPISODES].to_numpy(float) if EPISODES in rows else np.ones(len(rows))
    return float(np.average(rows[RETURN].to_numpy(float), weights=weights))


def training_psi(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean psi over the training score's window; the last finite psi where it holds none."""
    finite = metrics[np.isfinite(metrics[PSI])]
    inside = _last_window(finite, metrics, total_timesteps)
    rows = inside if len(inside) else finite.tail(1)
    return float(rows[PSI].mean())


def last_psi(metrics: pd.DataFrame) -> float:
    """The last finite psi: that of a run whose own numbers became non-finite; NaN for none."""
    finite = metrics.loc[np.isfinite(metrics[PSI]), PSI]
    return float(finite.iloc[-1]) if len(finite) else np.nan


def early_psi(metrics: pd.DataFrame, total_timesteps: int) -> float:
    """Mean psi over the first tenth of the steps; of the first update where that ends later."""
    finite = metrics[np.isfinite(metrics[PSI])]
    inside = finite[finite["global_step"] <= EARLY * total_timesteps]
    rows = inside if len(inside) else finite.head(1)
    return float(rows[PSI].mean())


def moved_together(metrics: pd.DataFrame) -> float:
    """Spearman's correlation of the changes of psi and return from update to update.

    Changes, since all that grows in training goes along with psi. Updates in which no episode ended
    are left out. NaN for fewer than 3 changes, or where one side does not change.
    """
    pairs = metrics[[PSI, RETURN]].dropna().to_numpy(float)
    changes = np.diff(pairs, axis=0)
    if len(changes) < 3:
        return np.nan
    return float(spearman(changes[:, 0], changes[:, 1]))


def final_score(episodes: pd.DataFrame, policy: str = "deterministic") -> float:
    """Mean return of the final policy over its evaluation episodes; NaN if there is none."""
    return float(episodes.loc[episodes["policy"] == policy, "return"].mean())


def _last_window(rows: pd.DataFrame, metrics: pd.DataFrame, total_timesteps: int) -> pd.DataFrame:
    end = metrics["global_step"].iloc[-1] if len(metrics) else 0
    return rows[rows["global_step"] > end - window_of(total_timesteps)]
