"""Returns of agents trained in populations beside those of agents trained alone.

    run="python -m harness run-all --suite tests/baselines/agreement.toml"
    $run --results-dir results/together
    $run --results-dir results/alone --plain
    python -m tests.baselines.agreement results/together results/alone

A trajectory's last bits differ between the two, and soon all of it, so that only distributions can
be compared: by Kolmogorov and Smirnov's test for two samples, a small p-value saying they differ.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import ks_2samp

SHARES = (0.1, 0.25, 0.5, 1.0)  # of the training, at which the returns are compared
UPDATES = 5  # whose episodes make one agent's return


def returns(folder: Path, kind: str) -> dict[float, np.ndarray]:
    """What each agent of a kind of run returned up to each share of its training, `[agents]`."""
    runs = [pd.read_csv(path) for path in sorted(folder.glob(f"*/{kind}__s*/metrics.csv"))]
    if len({len(run) for run in runs}) != 1:
        raise SystemExit(f"{folder}: no runs of {kind}, or some that are not finished")
    ends = {share: round(share * len(runs[0])) for share in SHARES}
    columns = [run["charts/episodic_return"] for run in runs]
    return {
        share: np.array([x[max(0, end - UPDATES) : end].mean() for x in columns])
        for share, end in ends.items()
    }


def compare(together: Path, alone: Path) -> pd.DataFrame:
    """A row for each algorithm, task and share of the training."""
    kinds = sorted({path.name.split("__s")[0] for path in together.glob("*/*__s*")})
    rows = []
    for kind in kinds:
        both = returns(together, kind), returns(alone, kind)
        for share in SHARES:
            samples = [each[share] for each in both]
            shown = [f"{x.mean():.1f} ± {x.std(ddof=1):.1f} ({len(x)})" for x in samples]
            p = float(ks_2samp(*samples).pvalue)
            rows.append((*kind.split("__"), f"{share:.0%}", *shown, p))
    names = ["algorithm", "task", "of training", "together", "alone", "p"]
    return pd.DataFrame(rows, columns=names)


if __name__ == "__main__":
    table = compare(Path(sys.argv[1]), Path(sys.argv[2]))
    print("|" + "|".join(table) + "|\n|---|---|--:|--:|--:|--:|")
    for row in table.itertuples(index=False):
        print(f"|{'|'.join(row[:-1])}|{row[-1]:.2f}|")
