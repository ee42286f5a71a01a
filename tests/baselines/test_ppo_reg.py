"""The PPO baseline: its mathematics, and the promises that its docstring makes."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.utils import RunningMeanStd

from baselines import ppo_reg
from baselines.ppo_reg import (
    Args,
    NormalizeObservation,
    Rollout,
    RunningMoments,
    gae,
    policy_loss,
    train,
)
from tests.baselines.helpers import pendulum, read_metrics, weights


class Count(gym.Env):
    """Shows how many steps have been taken; ends in the ways it is told to."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, terminate_at: float = math.inf, truncate_at: float = math.inf) -> None:
        self.terminate_at, self.truncate_at = terminate_at, truncate_at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._obs(), {}

    def step(self, action):
        self.count += 1
        ended = self.count >= self.terminate_at, self.count >= self.truncate_at
        return self._obs(), 1.0, *ended, {}

    def _obs(self):
        return np.array([self.count], np.float32)


def make_rollout(rewards, values, next_values, dones) -> Rollout:
    columns = [torch.tensor(x, dtype=torch.float32)[:, None] for x in (rewards, dones)]
    values, next_values = (
        torch.tensor(x, dtype=torch.float32)[:, None] for x in (values, next_values)
    )
    return Rollout(None, None, *columns, values, next_values, None, [], [])


# --- mathematics ---------------------------------------------------------------------------------


def test_gae_by_hand():
    # gamma = lambda = 0.5; the second step ends the episode, so nothing flows back over it
    data = make_rollout([1.0, 2.0, 3.0], [0.5, 1.0, 1.5], [1.0, 0.0, 4.0], [0.0, 1.0, 0.0])
    # d = [1 + 0.5 - 0.5, 2 + 0 - 1, 3 + 2 - 1.5] = [1, 1, 3.5]; A_0 = 1 + 0.25 · 1
    assert gae(data, 0.5, 0.5).flatten().tolist() == [1.25, 1.0, 3.5]


def test_gae_with_lambda_1_is_the_discounted_return_minus_the_value():
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=20), rng.normal(size=21)
    data = make_rollout(rewards, values[:-1], values[1:], np.zeros(20))
    returns = [
        sum(0.9 ** (k - t) * rewards[k] for k in range(t, 20)) + 0.9 ** (20 - t) * values[20]
        for t in range(20)
    ]
    expected = torch.tensor(np.array(returns) - values[:-1])
    torch.testing.assert_close(gae(data, 0.9, 1.0).flatten().double(), expected, atol=1e-5, rtol=0)


def test_policy_loss_by_hand():
    # advantages [1, -1] are normalized to ±1/√2; ratios 1.5 and 0.5, clipped to 1.2 and 0.8
    logratio, advantages = torch.tensor([1.5, 0.5]).log(), torch.tensor([1.0, -1.0])
    loss, kl, clipfrac = policy_loss(logratio, advantages, 0.2)
    assert loss.item() == pytest.approx(-(1.2 - 0.8) / math.sqrt(2) / 2, rel=1e-6)
    assert kl.item() == pytest.approx(-(math.log(1.5) + math.log(0.5)) / 2, rel=1e-6)
    assert clipfrac.item() == 1.0


def test_policy_gradient_at_ratio_1_is_that_of_the_plain_objective():
    logratio = torch.zeros(8, requires_grad=True)
    advantages = torch.randn(8, generator=torch.Generator().manual_seed(0))
    policy_loss(logratio, advantages, 0.2)[0].backward()
    normalized = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    torch.testing.assert_close(logratio.grad, -normalized / 8)


# --- environments --------------------------------------------------------------------------------


def count_rollout(num_steps: int = 5, **ends) -> Rollout:
    """A rollout of one Count environment under a critic that says: the value is the count."""
    envs = SyncVectorEnv([lambda: Count(**ends)], autoreset_mode=AutoresetMode.SAME_STEP)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    args = Args(env_id="Pendulum-v1", num_steps=num_steps, num_minibatches=1)
    learner = ppo_reg.Learner(Args(env_id="MountainCarContinuous-v0"))
    learner.actor = ppo_reg.Actor(args, 1, 1, torch.Generator())
    learner.critic = torch.nn.Linear(1, 1, bias=False)
    torch.nn.init.ones_(learner.critic.weight)
    next_obs, _ = envs.reset(seed=0)
    return ppo_reg.rollout(args, learner, envs, next_obs)


def test_a_truncated_episode_bootstraps_from_its_final_observation():
    data = count_rollout(truncate_at=3)
    assert data.obs.flatten().tolist() == [0, 1, 2, 0, 1]
    assert data.dones.flatten().tolist() == [0, 0, 1, 0, 0]
    assert data.next_values.flatten().tolist() == [1, 2, 3, 1, 2]


def test_a_terminated_episode_does_not_bootstrap():
    data = count_rollout(terminate_at=3)
    assert data.next_values.flatten().tolist() == [1, 2, 0, 1, 2]
    assert data.returns == [3.0]
    assert data.lengths == [3]


def test_termination_wins_over_truncation():
    data = count_rollout(terminate_at=3, truncate_at=3)
    assert data.next_values.flatten().tolist() == [1, 2, 0, 1, 2]


def normalized_counts(update: bool = True) -> tuple[NormalizeObservation, RunningMeanStd]:
    envs = SyncVectorEnv(
        [lambda: Count(truncate_at=3), lambda: Count()], autoreset_mode=AutoresetMode.SAME_STEP
    )
    rms = RunningMeanStd(shape=(1,))
    return NormalizeObservation(envs, rms, update=update), rms


def test_normalization_is_by_the_mean_and_variance_of_all_that_was_shown():
    envs, rms = normalized_counts()
    seen = [np.zeros((2, 1))]
    envs.reset(seed=0)
    for _ in range(5):
        obs, *_ = envs.step(np.zeros((2, 1), np.float32))
        raw = obs * np.sqrt(rms.var + 1e-8) + rms.mean
        seen.append(raw)
    everything = np.concatenate(seen)
    np.testing.assert_allclose(rms.mean, everything.mean(0), rtol=1e-3)
    np.testing.assert_allclose(rms.var, everything.var(0), rtol=1e-3)
    assert obs.dtype == np.float32


def test_normalization_maps_final_obs():
    envs, rms = normalized_counts(update=False)
    rms.mean[:], rms.var[:] = 1.0, 4.0
    envs.reset(seed=0)
    for _ in range(3):
        obs, *_, info = envs.step(np.zeros((2, 1), np.float32))
    assert info["final_obs"][0].item() == pytest.approx((3 - 1) / 2)
    assert obs.flatten().tolist() == pytest.approx([(0 - 1) / 2, (3 - 1) / 2])


def test_frozen_statistics_stay():
    envs, rms = normalized_counts(update=False)
    envs.reset(seed=0)
    envs.step(np.zeros((2, 1), np.float32))
    assert (rms.mean.item(), rms.var.item()) == (0.0, 1.0)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_running_moments_are_gymnasiums_bit_for_bit(num_envs):
    ours, theirs = RunningMoments(shape=(4,)), RunningMeanStd(shape=(4,))
    for x in np.random.default_rng(0).normal(2.0, 3.0, (50, num_envs, 4)):
        ours.update(x)
        theirs.update(x)
    np.testing.assert_array_equal([ours.mean, ours.var], [theirs.mean, theirs.var])
    assert ours.count == theirs.count


def test_observations_are_clipped():
    envs, _ = normalized_counts(update=False)
    assert envs.normalize(np.array([[1e6]])).item() == 10.0


def test_the_critic_and_the_policy_see_perturbed_observations_and_the_statistics_clean_ones(
    tmp_path,
):
    stats_plain, stats_perturbed = {}, {}
    args = pendulum(ppo_reg, tmp_path)
    plain = ppo_reg.make_envs(args, 0, stats_plain)
    perturbed = ppo_reg.make_envs(pendulum(ppo_reg, tmp_path, perturb_obs=True), 0, stats_perturbed)
    seeds = ppo_reg.env_seeds(args, 0)
    obs, _ = plain.reset(seed=seeds)
    noisy, info = perturbed.reset(seed=seeds)
    np.testing.assert_array_equal(info["clean_obs"], obs)
    assert 0 < np.linalg.norm(noisy - obs) <= 1 + 1e-6
    np.testing.assert_array_equal(stats_plain["obs_rms"].mean, stats_perturbed["obs_rms"].mean)


def test_actions_of_any_shape_are_taken(tmp_path):
    class Square(Count):
        action_space = gym.spaces.Box(-1.0, 1.0, (2, 2), np.float32)

        def step(self, action):
            assert action.shape == (2, 2)
            return super().step(action)

    gym.register("test/Square-v0", Square)
    learner = train(pendulum(ppo_reg, tmp_path, env_id="test/Square-v0", total_timesteps=64))
    assert learner.actor.log_std.shape == (4,)


def test_observations_of_any_shape_are_flattened(tmp_path):
    gym.register(
        "test/Image-v0", lambda: gym.wrappers.ReshapeObservation(Count(truncate_at=9), (1, 1))
    )
    train(pendulum(ppo_reg, tmp_path, env_id="test/Image-v0", total_timesteps=64))
    assert len(read_metrics(tmp_path)) == 1


# --- the regularizer -----------------------------------------------------------------------------


def test_a_strong_penalty_brings_the_policy_into_range(tmp_path):
    psi = {}
    for coefficient in (0.0, 10.0):
        path = tmp_path / str(coefficient)
        train(
            pendulum(ppo_reg, path, coefficient=coefficient, update_epochs=20, learning_rate=3e-3)
        )
        psi[coefficient] = float(read_metrics(path)[-1]["conditioning/psi"])
    assert psi[10.0] < psi[0.0] / 4


def test_target_kl_ends_the_policys_epochs(tmp_path):
    one_epoch = train(pendulum(ppo_reg, tmp_path / "a", update_epochs=1))
    stopped = train(pendulum(ppo_reg, tmp_path / "b", update_epochs=2, target_kl=1e-9))
    assert torch.equal(weights(one_epoch), weights(stopped))


@pytest.mark.slow
@pytest.mark.parametrize("coefficient", [0.0, 0.1])
def test_compiled_losses_are_those_of_eager_code(tmp_path, coefficient):
    rows = []
    for compiled in (False, True):
        torch.compiler.reset()
        folder = tmp_path / f"compiled_{compiled}"
        args = pendulum(ppo_reg, folder, coefficient=coefficient, compile=compiled)
        learner = train(args)
        assert (learner.actor_loss is ppo_reg.actor_loss) == (not compiled)
        rows.append(read_metrics(folder))
    for eager, compiled in zip(*rows, strict=True):
        for column in ("losses/policy_loss", "losses/approx_kl", "conditioning/psi"):
            close = pytest.approx(float(eager[column]), rel=1e-3, abs=1e-4)
            assert float(compiled[column]) == close


@pytest.mark.slow
def test_it_learns(tmp_path):
    """An inverted pendulum is balanced for most of its 1000 steps; a random policy holds it ~30."""
    train(Args(env_id="InvertedPendulumBulletEnv-v0", total_timesteps=60_000, run_dir=tmp_path))
    rows = read_metrics(tmp_path)
    assert float(rows[0]["charts/episodic_return"]) < 100
    assert float(rows[-1]["charts/episodic_return"]) > 500


@pytest.mark.slow
def test_videos_are_recorded(tmp_path):
    changes = {"env_id": "ReacherBulletEnv-v0", "num_steps": 200, "total_timesteps": 200}
    train(pendulum(ppo_reg, tmp_path, **changes, capture_video=True))
    assert any(v.stat().st_size > 1000 for v in (tmp_path / "videos").glob("*.mp4"))
