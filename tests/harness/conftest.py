"""A suite of real but tiny runs: Pendulum for a few hundred steps."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from baselines import ppo_reg_coinrun
from harness import cli
from harness.evaluation.control import COLUMNS
from harness.store import Store, write_json
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
def run_cli(monkeypatch, capsys, tmp_path):
    """Run a command in this process, away from the checkout's results and archives.

    Gives its exit status and output.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "ARCHIVES", tmp_path / "archives")

    def run(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["harness", *map(str, words)])
        monkeypatch.setattr(cli.console, "width", 200)
        status = 0
        try:
            cli.main()
        except SystemExit as stopped:
            status = stopped.code if isinstance(stopped.code, int) else 1
            message = "" if isinstance(stopped.code, int) else str(stopped.code)
        else:
            message = ""
        captured = capsys.readouterr()
        return status, captured.out + captured.err + message

    return run


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
    episodes: pd.DataFrame | None = None,
    done: bool = True,
    diverged: bool = False,
) -> None:
    """What a run leaves behind, with these mean returns and psi of its updates.

    Args:
        store: Where it goes.
        spec: The run.
        returns: Mean return of each update; NaN where no episode ended.
        psi: The same for psi, or one value for all.
        columns: More columns of its metrics.
        episodes: What its evaluation found, if it has one: see `make_episodes`. By default that of
            a control agent is two episodes of each policy, whose returns are the last of `returns`.
        done: Whether it came to its end.
        diverged: Whether its numbers became non-finite, which is an end too.
    """
    store.start(spec, ["true"], [spec])
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
    if episodes is None and "episodes" in spec.evaluation:
        episodes = make_control_episodes([returns[-1]] * 2, [returns[-1]] * 2)
    if episodes is not None:
        episodes.to_csv(store.path(spec, "evaluation.csv"), index=False)
    if diverged:
        failure = {"update": len(returns), "what": "loss", "message": "loss is NaN"}
        write_json(store.path(spec, "diverged.json"), failure)
    if done:
        store.finish(spec, returncode=0, seconds=1.0)


def make_episodes(**successes: Sequence[Sequence[float]]) -> pd.DataFrame:
    """Episodes with these successes, `[levels, repeats]`, each named like seen_sampled."""
    rows = []
    for name, matrix in successes.items():
        split, policy = name.split("_")
        first = 0 if split == "seen" else 500
        rows += [
            (split, first + level, policy, repeat, int(success), 10.0 * success, 100)
            for level, row in enumerate(matrix)
            for repeat, success in enumerate(row)
        ]
    columns = ["split", "level", "policy", "repeat", "success", "return", "length"]
    return pd.DataFrame(rows, columns=columns)


def make_control_episodes(deterministic: Sequence[float], sampled: Sequence[float]) -> pd.DataFrame:
    """The evaluation of a control agent with these returns."""
    rows = [
        (policy, episode, value, 100, 0.5, 0.001)
        for policy, returns in (("deterministic", deterministic), ("sampled", sampled))
        for episode, value in enumerate(returns)
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


COINRUN = """
title = "Toy CoinRun"
seeds = [1]
agents = 1

[args]
total_timesteps = 16
num_envs = 2
num_steps = 8
num_minibatches = 2
update_epochs = 1
eval_interval = 0
device = "cpu"

[evaluation]
levels = 1
repeats = 1

[[algorithms]]
name = "PPO"
baseline = "ppo_reg_coinrun"
args = { coefficient = 0.0, dropout = 0.5 }

[environments]
CoinRun = "coinrun"
"""


@pytest.fixture(scope="session")
def coinrun_run(tmp_path_factory) -> tuple[Path, RunSpec]:
    """A real CoinRun agent after its one update, and what it is in a suite."""
    folder = tmp_path_factory.mktemp("coinrun")
    (folder / "toy.toml").write_text(COINRUN)
    spec = load_suite(str(folder / "toy.toml")).runs[0]
    ppo_reg_coinrun.train(ppo_reg_coinrun.Args(**spec.args, run_dir=folder / "run", num_threads=1))
    return folder / "run", spec
