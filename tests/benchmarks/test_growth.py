"""How cost grows: with the batch, the observations, the agents of a population, and run-all's jobs.

`tests.benchmarks.figure` draws what is measured here, a panel for each of the four.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from harness.provenance import cores
from tests.benchmarks.test_penalty import (
    exact_svd,
    jacobian_regularization,
    no_penalty,
    step,
    with_answer,
)
from tests.benchmarks.test_training import population_iteration, run

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
BATCHES = (16, 64, 256, 1024, 4096)
SIZES = (8, 32, 128, 512, 2048)  # of an observation
AGENTS = (1, 2, 5, 10, 20, 40)
JOBS = [jobs for jobs in (1, 2, 4) if jobs <= cores()]
PENALTIES = {
    "no penalty": no_penalty,
    "conditioning penalty": with_answer,
    "Jacobian regularization": jacobian_regularization,
    "exact SVD": exact_svd,
}
SUITE = """
title = "As many populations of 10 as jobs"
seeds = {seeds}
agents = 10
args = {{ total_timesteps = 40_000 }}
algorithms = [{{ name = "PPO reg", baseline = "ppo_reg" }}]
environments = {{ Hopper = "harness.envs.fast_bullet:FastHopperBulletEnv-v0" }}
"""


def measure_penalty(benchmark, penalty, batch: int, n_in: int) -> None:
    torch.set_num_threads(1)
    policy = nn.Sequential(
        nn.Linear(n_in, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 17)
    )
    obs = torch.randn(batch, n_in)
    benchmark.extra_info.update(series=penalty)
    benchmark(step, policy, obs, PENALTIES[penalty])
    assert all(p.grad.isfinite().all() for p in policy.parameters())


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("penalty", PENALTIES)
def test_batch(benchmark, penalty, batch):
    benchmark.extra_info.update(panel="states in a batch, of 44 numbers each", x=batch)
    measure_penalty(benchmark, penalty, batch, 44)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("penalty", PENALTIES)
def test_observation_size(benchmark, penalty, size):
    benchmark.extra_info.update(panel="numbers in an observation, 64 to a batch", x=size)
    measure_penalty(benchmark, penalty, 64, size)


@pytest.mark.parametrize("agents", AGENTS)
@pytest.mark.parametrize("algorithm", ["PPO", "TRPO"])
def test_agents(benchmark, algorithm, agents):
    benchmark.extra_info.update(panel="agents in a population, Hopper", x=agents)
    benchmark.extra_info.update(series=f"{algorithm} with the penalty")
    with population_iteration(algorithm, "Hopper", 1e-3, agents) as (iterate, steps):
        run(benchmark, algorithm, "Hopper", iterate, steps)


@pytest.mark.parametrize("jobs", JOBS)
def test_jobs(benchmark, jobs, tmp_path):
    if not benchmark.enabled:
        pytest.skip("minutes, and tests/harness tests run-all")
    suite = tmp_path / "jobs.toml"
    suite.write_text(SUITE.format(seeds=list(range(1, max(JOBS) + 1))))
    command = [sys.executable, "-m", "harness", "run-all", "--suite", str(suite)]
    command += ["--jobs", str(jobs), "--results-dir", str(tmp_path / "results")]

    def run_all():
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)

    benchmark.group = f"run-all, {max(JOBS)} populations of 10, Hopper"
    goal = {"peer": True} if jobs == 1 else {"goal": 0.95 * jobs}
    steps = 40_000 * 10 * max(JOBS)
    benchmark.extra_info.update(panel="jobs of run-all", x=jobs, series="PPO with the penalty")
    benchmark.extra_info.update(steps=steps, **goal)
    benchmark.pedantic(run_all, rounds=1)  # a second would find all of it done
