"""Results of studies that never ran: curves with known statistics, as a store holds them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from harness.report.results import Results, load_results
from harness.store import Store
from harness.suite import load_suite
from tests.harness.conftest import make_control_episodes, write_run

ARGS = {
    "PPO": 'baseline = "ppo_reg"\nargs = { coefficient = 0.0 }',
    "PPO reg": 'baseline = "ppo_reg"',
    "TRPO": 'baseline = "trpo_reg"\nargs = { coefficient = 0.0 }',
    "TRPO reg": 'baseline = "trpo_reg"',
    "PPO setting 2": 'baseline = "ppo_reg"\nargs = { coefficient = 0.0, gamma = 0.9 }',
    "PPO noise": 'baseline = "ppo_reg"\nargs = { coefficient = 0.0, perturb_obs = true }',
}
COMMON = """
title = "Synthetic"
seeds = [1, 2]
agents = {agents}

[args]
total_timesteps = 4000
num_steps = 100
num_minibatches = 2
"""
Curve = float | Sequence[float] | None
UPDATES = 40  # of a synthetic run


def make_study(
    folder: Path,
    reward: Callable[[str, str, int], Curve],
    psi: Callable[[str, str, int], Curve] = lambda *_: 0.5,
    *,
    algorithms: Sequence[str] = ("PPO", "PPO reg"),
    tasks: Sequence[str] = ("Hopper",),
    agents: int = 10,
    updates: int = UPDATES,
    unfinished: Callable[[str, str, int], bool] = lambda *_: False,
    diverged: Callable[[str, str, int], bool] = lambda *_: False,
    final: Callable[[str, str, int], float | None] = lambda *_: None,
    more: str = "",
) -> Results:
    """Make results out of a function for the reward and one for psi.

    Each is called with task, algorithm and the number of the agent among all of both seeds, and
    gives a curve, or one value for all updates, or None where there is no such run. An update is
    100 of 4000 steps, so training scores are over the last 4 of 40. `final` gives the return of
    the final policy.
    """
    text = COMMON.format(agents=agents // 2) + more
    text += "".join(f'\n[[algorithms]]\nname = "{a}"\n{ARGS[a]}\n' for a in algorithms)
    text += "\n[environments]\n" + "".join(f'"{task}" = "Pendulum-v1"\n' for task in tasks)
    path, store = folder / "synthetic.toml", Store(folder / "results")
    path.write_text(text)
    suite = load_suite(str(path))
    for run in suite.runs:
        number = (run.args["seed"] - 1) * (agents // 2) + run.args["agent"]
        key = (run.environment, run.algorithm, number)
        if (curve := reward(*key)) is not None:
            returns = np.broadcast_to(curve, updates)
            last = final(*key)
            played = None if last is None else make_control_episodes([last], [last - 1])
            write_run(
                store, run, returns, psi(*key), episodes=played, done=not unfinished(*key),
                diverged=diverged(*key),
            )  # fmt: skip
    return load_results(suite, store)


@pytest.fixture
def study(tmp_path) -> Callable[..., Results]:
    """`make_study` in this test's folder; a second study takes the place of the first."""
    return functools.partial(make_study, tmp_path)


@pytest.fixture
def drawn(monkeypatch) -> Iterator[Callable[[], Figure]]:
    """Gives the last figure, which is kept open for it."""
    with monkeypatch.context() as patch:
        patch.setattr(plt, "close", lambda figure: None)
        yield plt.gcf
    plt.close("all")


def make_games(
    folder: Path,
    episodes: Callable[[str, str, int], pd.DataFrame],
    algorithms: Sequence[str],
    games: dict[str, str],
    *,
    updates: int = 3,
    seeds: Sequence[int] = (1,),
    gifs: bool = False,
    own: str = "",
) -> Results:
    """Results of agents that were evaluated on levels: `make_study` for games.

    `episodes` is called with game, algorithm and seed. A name that ends in " reg" is regularized.
    """
    text = f'title = "Games"\nseeds = {list(seeds)}\nagents = 1\n{own}\n'
    text += "[args]\ntotal_timesteps = 8192\n[evaluation]\nlevels = 2\nrepeats = 2\n"
    for name in algorithms:
        rate = 1e-3 if name.endswith(" reg") else 0.0
        text += f'[[algorithms]]\nname = "{name}"\nbaseline = "ppo_reg_coinrun"\n'
        text += f"args = {{ coefficient = {rate} }}\n"
    text += "[environments]\n" + "".join(f'"{k}" = "{v}"\n' for k, v in games.items())
    path, store = folder / "games.toml", Store(folder / "results")
    path.write_text(text)
    suite = load_suite(str(path))
    rates = np.linspace(0.1, 0.3, updates)
    columns = {"eval/success_seen": rates, "eval/success_unseen": rates / 2}
    for run in suite.runs:
        found = episodes(run.environment, run.algorithm, run.args["seed"])
        write_run(store, run, np.zeros(updates), columns=columns, episodes=found)
        for split in ("seen", "unseen") if gifs else ():
            store.path(run, f"{split}.gif").write_bytes(b"GIF89a")
    return load_results(suite, store)
