"""What run-all --dry-run says: extrapolated from real, short runs that leave nothing behind."""

from __future__ import annotations

import pytest
from rich.console import Console

from harness.estimate import Cost, EstimateError, measure
from harness.launchers.groups import make_groups
from harness.suite import load_suite

SUITE = """
title = "Tiny"
seeds = [1, 2]
agents = 2
[args]
total_timesteps = 6_400
num_steps = 64
num_minibatches = 2
update_epochs = 1
vf_epochs = 1
[[algorithms]]
name = "PPO"
baseline = "ppo_reg"
[environments]
Pendulum = "{env_id}"
"""


def costs(tmp_path, store, env_id="Pendulum-v1"):
    path = tmp_path / "tiny.toml"
    path.write_text(SUITE.replace("{env_id}", env_id))
    groups = make_groups(load_suite(str(path)).runs, store, jobs=1)
    return measure(groups, 1, Console(quiet=True))


def test_a_cost_by_hand():
    assert Cost("PPO", "Hopper", 2, 7_200_000, 1000.0, 5).hours == 2.0


def test_runs_are_measured_and_leave_nothing(tmp_path, store):
    (cost,) = costs(tmp_path, store)
    assert (cost.algorithm, cost.environment, cost.runs) == ("PPO", "Pendulum", 4)
    assert cost.steps == 4 * 6_400
    assert 100 < cost.speed < 1e6
    least = 4 * 2 * 60_000  # two checkpoints of some 18,000 numbers, Adam's moments included
    assert least < cost.bytes < 10 * least
    assert not store.root.exists()


def test_a_run_that_fails_is_told_with_its_log(tmp_path, store, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "sitecustomize.py").write_text("raise SystemExit('this machine is broken')")
    with pytest.raises(EstimateError, match="ppo__Pendulum__s1__a0 failed"):
        costs(tmp_path, store)
