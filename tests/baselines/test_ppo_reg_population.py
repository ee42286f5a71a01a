"""The PPO population: an update is that of the single file, for each agent by itself."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from baselines import population, ppo_reg, ppo_reg_population
from tests.baselines.helpers import read_metrics
from tests.baselines.population_helpers import arguments, check_close, learners_of, recorded

# --- an update -----------------------------------------------------------------------------------

CASES = {
    "plain": {"coefficient": 0.0},
    "penalty": {"coefficient": 0.5},
    "wide range": {"coefficient": 1e-3, "lambda_min": 0.0, "lambda_max": 0.01, "radius": 0.1},
    "gaussian": {"coefficient": 0.1, "perturbation": "gaussian"},
    "printed sign": {"coefficient": 0.5, "printed_sign": True},
    "one J a batch": {"coefficient": 0.5, "reduction": "batch"},
    "above the range": {"coefficient": 0.5, "reduction": "batch", "lambda_min": 0.0,
                        "lambda_max": 0.01, "output_gain": 1.0},
    "more of the policy": {"update_epochs": 4, "vf_epochs": 1, "ent_coef": 0.01},
    "more of the critic": {"update_epochs": 1, "vf_epochs": 4, "vf_coef": 1.0},
    "relu": {"hidden_sizes": (33, 17, 8), "activation": "relu", "log_std_init": -1.0},
    "environments": {"num_envs": 3, "total_timesteps": 960, "max_grad_norm": 0.05},
    "annealed": {"anneal_lr": True, "num_agents": 2},
    "one": {"num_agents": 1, "agent": 4, "seed": 7},
    "bullet": {"env_id": "HopperBulletEnv-v0"},
}  # fmt: skip


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_two_updates_are_those_of_the_single_file(changes, dtype, tolerance):
    args = arguments(ppo_reg_population, **changes)
    learners, rollouts = recorded(args, dtype)
    alone = copy.deepcopy(learners)
    for number in range(2):  # the second begins with Adam's moments
        ours = ppo_reg_population.update(args, learners, rollouts)
        for i, run in enumerate(args.runs):
            theirs = ppo_reg.update(run, alone[i], rollouts[i])
            assert ours[i] == pytest.approx(theirs, abs=10 * tolerance, nan_ok=True)
            assert list(ours[i]) == list(theirs)
            learners[i].update = alone[i].update = number + 1
            check_close(learners[i], alone[i], tolerance)


def test_each_agent_stops_at_its_own_kl():
    """Of three agents at one target, some stop early and some do not; all are as they are alone."""
    changes = {"coefficient": 0.1, "update_epochs": 6, "vf_epochs": 3}
    learners, rollouts = recorded(arguments(ppo_reg_population, **changes))
    epochs = []
    args = arguments(ppo_reg_population, **changes, target_kl=1e-4)
    alone = copy.deepcopy(learners)
    ppo_reg_population.update(args, learners, rollouts)
    for i, run in enumerate(args.runs):
        ppo_reg.update(run, alone[i], rollouts[i])
        check_close(learners[i], alone[i], 1e-5)
        steps = alone[i].actor_optimizer.state_dict()["state"][0]["step"].item()
        epochs.append(steps / args.num_minibatches)
    assert len(set(epochs)) > 1
    assert min(epochs) < 6


def test_delta_is_what_each_agents_regularizer_would_draw():
    args = arguments(ppo_reg_population, coefficient=0.1)
    learners, alone = learners_of(args), learners_of(args)
    for size in (1, 7, 16, 50):  # randn fills in blocks of 16
        obs = torch.zeros(3, size, 3)
        delta = population.draw_delta(learners, obs, np.array([True, False, True]))
        for i in (0, 2):
            assert torch.equal(delta[i], alone[i].regularizer.sample_delta(obs[i]))
    # and the idle one drew nothing
    states = [[x.regularizer.generator.get_state() for x in each] for each in (learners, alone)]
    assert all(torch.equal(*pair) for pair in zip(*states, strict=True))


@pytest.mark.slow
def test_the_default_update_is_that_of_the_single_file():
    """400 steps of each network on 2000 states: what rounding makes of it stays below 1e-5."""
    args = ppo_reg_population.Args(num_agents=3)
    learners, rollouts = recorded(args)
    alone = copy.deepcopy(learners)
    ppo_reg_population.update(args, learners, rollouts)
    for i, run in enumerate(args.runs):
        ppo_reg.update(run, alone[i], rollouts[i])
        check_close(learners[i], alone[i], 1e-5)


@pytest.mark.slow
def test_it_learns(tmp_path):
    """An inverted pendulum is balanced for most of its 1000 steps; a random policy holds it ~30."""
    env_id, path = "InvertedPendulumBulletEnv-v0", tmp_path / "a{agent}"
    ppo_reg_population.train(
        ppo_reg_population.Args(env_id=env_id, total_timesteps=60_000, num_agents=3, run_dir=path)
    )
    for agent in range(3):
        rows = read_metrics(tmp_path / f"a{agent}")
        assert float(rows[0]["charts/episodic_return"]) < 100
        assert float(rows[-1]["charts/episodic_return"]) > 500
