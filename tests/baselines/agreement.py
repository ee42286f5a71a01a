"""Returns of agents trained in populations beside those of agents trained alone.

    run="python -m harness run-all --suite tests/baselines/agreement.toml"
    $run --results-dir results/together
    $run --results-dir results/alone --plain
    python -m tests.baselines.agreement results/together results/alone

An agent begins with the same weights, seeds and noise in both. Rounding parts its trajectories
within a few updates, so that only distributions can be compared later: by Kolmogorov and Smirnov's
test for two samples, where a small p says that they differ. r is the correlation of the agents'
two returns, which falls from 1 to about 0 as they part.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import ks_2samp

SHARES = (0.1, 0.25, 0.5, 1.0)  # of the training, at which the returns are compared
UPDATES = 5  # whose means make one agent's return


def curves(folder: Path, kind: str) -> np.ndarray:
    """Mean return of the episodes of each update, `[agents, updates]`."""
    runs = [pd.read_csv(path) for path in sorted(folder.glob(f"*/{kind}__s*/metrics.csv"))]
    if len({len(run) for run in runs}) != 1:
        raise SystemExit(f"{folder}: no runs of {kind}, or some that are not finished")
    return np.array([run["charts/episodic_return"] for run in runs])


def returns(curves: np.ndarray, share: float) -> np.ndarray:
    """What each agent returned at a share of its training, `[agents]`."""
    end = round(share * curves.shape[1])
    return np.nanmean(curves[:, max(0, end - UPDATES) : end], axis=1)


def compare(together: Path, alone: Path) -> pd.DataFrame:
    """A row for each algorithm, task and share of the training."""
    kinds = sorted({path.name.split("__s")[0] for path in together.glob("*/*__s*")})
    rows = []
    for kind in kinds:
        both = [curves(folder, kind) for folder in (together, alone)]
        if both[0].shape != both[1].shape:
            shapes = [" of ".join(map(str, x.shape)) for x in both]
            raise SystemExit(f"{kind}: agents of updates, {shapes[0]} together, {shapes[1]} alone")
        for share in SHARES:
            samples = [returns(each, share) for each in both]
            shown = [f"{x.mean():.1f} ± {x.std(ddof=1):.1f}" for x in samples]
            p, r = float(ks_2samp(*samples).pvalue), float(np.corrcoef(samples)[0, 1])
            rows.append((*kind.split("__"), len(samples[0]), f"{share:.0%}", *shown, p, r))
    names = ["algorithm", "task", "agents", "of training", "together", "alone", "p", "r"]
    return pd.DataFrame(rows, columns=names)


if __name__ == "__main__":
    table = compare(Path(sys.argv[1]), Path(sys.argv[2]))
    print("| " + " | ".join(table) + " |\n|---|---|--:|--:|--:|--:|--:|--:|")
    for *row, p, r in table.itertuples(index=False):
        print(f"| {' | '.join(map(str, row))} | {p:.2f} | {r:.2f} |")
