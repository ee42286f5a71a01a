"""What robust Sarsa learns from: a toy's transitions by hand, and a Q that ranks its actions."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
import torch

from baselines import ppo_reg
from harness.evaluation import sarsa
from harness.evaluation.checkpoint import read_checkpoint
from harness.evaluation.control import episode_seeds, load_learner
from harness.evaluation.sarsa import discounted, learn_action_value, play
from tests.harness.evaluation.toy import DEVIATION, LIMIT, MEAN, SLOPE, Toy, write_checkpoint


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A toy's agent, and the environments that its episodes are played in."""
    monkeypatch.setattr(Toy, "made", [])
    write_checkpoint(tmp_path, log_std=-1.0, gamma=0.5)
    checkpoint = read_checkpoint(tmp_path)
    return checkpoint, load_learner(checkpoint)


def test_transitions_by_hand(toy):
    data = play(*toy, number=0)
    env = Toy.made[-1]
    normalized = (np.array(env.seen) - MEAN) / DEVIATION
    np.testing.assert_allclose(data.obs[:, 0], normalized[:4], atol=1e-5)
    np.testing.assert_allclose(data.next_obs[:, 0], normalized[1:], atol=1e-5)
    assert torch.equal(data.next_actions[:-1], data.actions[1:])
    clipped = data.actions[:, 0].clamp(-LIMIT, LIMIT)
    np.testing.assert_allclose(clipped, env.actions, atol=1e-6)
    np.testing.assert_allclose(data.rewards, 10 * np.array(env.actions), rtol=1e-6)
    assert data.terminations.tolist() == [False, False, False, True]
    actions = torch.cat([data.actions, data.next_actions[-1:]])[:, 0].numpy()
    noise = np.abs(actions - SLOPE * normalized) * math.e  # in deviations of the policy
    assert 0 < noise.min() < noise.max() < 5
    assert env.closed


def test_a_time_limit_is_no_end(toy, monkeypatch):
    checkpoint, learner = toy
    make = sarsa.make_env

    class Limited(gym.Wrapper):
        def step(self, action):
            obs, reward, terminated, _, info = self.env.step(action)
            return obs, reward, False, terminated, info

    monkeypatch.setattr(ppo_reg, "make_env", lambda args: Limited(gym.make(args.env_id)))
    monkeypatch.setattr(sarsa, "make_env", make)
    assert not play(checkpoint, learner, number=0).terminations.any()


def test_episodes_differ_and_are_not_the_evaluations(toy):
    checkpoint, learner = toy
    for number in (0, 1, 0):
        play(checkpoint, learner, number)
    first, second, again = (env.seeds[0] for env in Toy.made[-3:])
    assert first == again != second
    assert not {first, second} & {episode_seeds(checkpoint.args, i)[0] for i in range(20)}


def test_discounted_sums_by_hand():
    found = discounted(torch.tensor([1.0, 2.0, 4.0]), 0.5)
    np.testing.assert_array_equal(found, [1 + 1 + 1, 2 + 2, 4])


def test_q_ranks_actions_by_what_they_pay(toy, monkeypatch):
    """The toy pays 10 times the action and goes on whatever it is."""
    monkeypatch.setattr(sarsa, "UPDATES", 400)
    state = torch.get_rng_state()
    q = learn_action_value(*toy)
    obs = play(*toy, number=0).obs
    low, high = (q(obs, torch.full((4, 1), x)) for x in (-0.4, 0.4))
    assert (low < high).all()
    assert torch.equal(learn_action_value(*toy)(obs, obs), q(obs, obs))
    assert torch.equal(torch.get_rng_state(), state)
    assert q(obs, obs).abs().max() < 3  # of the scale of the largest return, 1
