"""A suite of real but tiny runs: Pendulum for a few hundred steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.store import Store
from harness.suite import RunSpec, Suite, load_suite

TINY = """
title = "Tiny"
seeds = [1, 2]
agents = 2

[args]
total_timesteps = 200
num_steps = 100
num_minibatches = 2
update_epochs = 1
vf_epochs = 1
checkpoint_interval = 1

[[algorithms]]
name = "PPO"
baseline = "ppo_reg"
args = { coefficient = 0.0 }

[[algorithms]]
name = "PPO reg"
baseline = "ppo_reg"

[environments]
Hopper = "Pendulum-v1"
Reacher = "MountainCarContinuous-v0"
"""


@pytest.fixture
def suite_file(tmp_path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


@pytest.fixture
def suite(suite_file) -> Suite:
    return load_suite(str(suite_file))


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "results")


def write_run(
    store: Store,
    spec: RunSpec,
    returns: Sequence[float],
    psi: float | Sequence[float] = 0.5,
    *,
    columns: dict[str, Sequence[float]] | None = None,
    done: bool = True,
) -> None:
    """What a run leaves behind, with these mean returns and psi of its updates.

    Args:
        store: Where it goes.
        spec: The run.
        returns: Mean return of each update; NaN where no episode ended.
        psi: The same for psi, or one value for all.
        columns: More columns of its metrics.
        done: Whether it came to its end.
    """
    store.start(spec, ["true"])
    steps = np.arange(1, len(returns) + 1) * 100
    metrics = pd.DataFrame(
        {
            "global_step": steps,
            "charts/episodic_return": returns,
            "charts/SPS": 1000.0,
            "conditioning/psi": psi,
            **(columns or {}),
        }
    )
    metrics.to_csv(store.path(spec, "metrics.csv"), index=False)
    store.path(spec, "checkpoint.pt").write_bytes(b"weights")
    if done:
        store.finish(spec, returncode=0, seconds=1.0)
