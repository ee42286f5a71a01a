"""The PPO baseline: its mathematics, and the promises that its docstring makes."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import os
import runpy
import signal
import sys
import types
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.utils import RunningMeanStd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines import ppo_reg
from baselines.ppo_reg import (
    Args,
    DivergedError,
    NormalizeObservation,
    Rollout,
    RunError,
    RunningMoments,
    actor_loss,
    gae,
    train,
)
from tests.baselines.helpers import interrupted, pendulum, read_metrics, weights, without_speed


class Count(gym.Env):
    """Shows how many steps have been taken; ends in the ways it is told to.

    `reward` maps the count to a reward, and `actions` lists what was executed.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(
        self, terminate_at: float = math.inf, truncate_at: float = math.inf, reward=lambda n: 1.0
    ) -> None:
        self.terminate_at = terminate_at
        self.truncate_at = truncate_at
        self.reward = reward
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._obs(), {}

    def step(self, action):
        self.count += 1
        self.actions.append(action.copy())
        ended = self.count >= self.terminate_at, self.count >= self.truncate_at
        return self._obs(), self.reward(self.count), *ended, {}

    def _obs(self):
        return np.array([self.count], np.float32)


def make_rollout(rewards, values, next_values, dones) -> Rollout:
    columns = [torch.tensor(x, dtype=torch.float32)[:, None] for x in (rewards, dones)]
    values, next_values = (
        torch.tensor(x, dtype=torch.float32)[:, None] for x in (values, next_values)
    )
    return Rollout(None, None, None, *columns, values, next_values, None, [], [], None)


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


class Fixed(torch.nn.Module):
    """A policy of mean w · obs and one log-std."""

    def __init__(self, weight: float = 2.0, log_std: float = 0.5) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor(weight))
        self.log_std = torch.nn.Parameter(torch.tensor([log_std]))

    def mean(self, obs):
        return self.weight * obs

    def forward(self, obs):
        return ppo_reg.Actor.forward(self, obs)


def fixed_learner(args: Args, **changes) -> ppo_reg.Learner:
    """A learner of Count's numbers: mean 2 · obs, log-std 0.5, value 3 · obs."""
    learner = ppo_reg.Learner(dataclasses.replace(args, env_id="MountainCarContinuous-v0"))
    learner.actor = Fixed(**changes)
    learner.critic = torch.nn.Linear(1, 1, bias=False)
    learner.critic.weight.data.fill_(3.0)
    return learner


def normal_logprob(action: float, mean: float, log_std: float) -> float:
    scaled = (action - mean) / math.exp(log_std)
    return -0.5 * scaled**2 - log_std - 0.5 * math.log(2 * math.pi)


def test_actor_loss_by_hand():
    # advantages [1, -1] are normalized to ±1/√2; ratios 1.5 and 0.5, clipped to 1.2 and 0.8
    args = Args(ent_coef=0.1)
    obs = torch.tensor([[1.0], [2.0]])
    actions = torch.tensor([[1.0], [6.0]])
    logprobs = [normal_logprob(1.0, 2.0, 0.5), normal_logprob(6.0, 4.0, 0.5)]
    old = torch.tensor(logprobs) - torch.tensor([1.5, 0.5]).log()
    loss, logs = actor_loss(args, fixed_learner(args), obs, actions, old, torch.tensor([1.0, -1.0]))
    pg_loss = -(1.2 - 0.8) / math.sqrt(2) / 2
    entropy = 0.5 * math.log(2 * math.pi * math.e) + 0.5
    kl = -(math.log(1.5) + math.log(0.5)) / 2
    assert logs.tolist() == pytest.approx([pg_loss, entropy, kl, 1.0], rel=1e-5)
    assert loss.item() == pytest.approx(pg_loss - 0.1 * entropy, rel=1e-5)


def test_the_penalty_is_added_to_the_actor_loss():
    """The slope is 2 and lambda_max 1.5, so psi is 0.25 in every state."""
    args = Args(coefficient=3.0, lambda_min=0.0, lambda_max=1.5)
    learner = fixed_learner(args)
    batch = (torch.ones(2, 1), torch.ones(2, 1), torch.zeros(2), torch.tensor([1.0, 2.0]))
    plain, _ = actor_loss(args, learner, *batch)
    penalized, _ = actor_loss(args, learner, *batch, torch.ones(2, 1))
    assert (penalized - plain).item() == pytest.approx(3.0 * 0.25, rel=1e-5)


def test_the_penalty_is_taken_at_the_delta_that_is_given():
    """Where delta is 0 so is J, whatever the slope: psi is 0.25, and no noise is drawn."""
    args = Args(coefficient=3.0, lambda_min=0.5)
    learner = fixed_learner(args)
    batch = (torch.ones(2, 1), torch.ones(2, 1), torch.zeros(2), torch.tensor([1.0, 2.0]))
    state = learner.regularizer.generator.get_state()
    plain, _ = actor_loss(args, learner, *batch)
    penalized, _ = actor_loss(args, learner, *batch, torch.zeros(2, 1))
    assert (penalized - plain).item() == pytest.approx(3.0 * 0.25, rel=1e-5)
    assert torch.equal(learner.regularizer.generator.get_state(), state)


def test_the_loss_is_compiled_where_asked(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: (function, "compiled"))
    args = Args(env_id="Pendulum-v1")
    assert ppo_reg.Learner(args).actor_loss is actor_loss
    compiled = ppo_reg.Learner(dataclasses.replace(args, compile=True))
    assert compiled.actor_loss == (actor_loss, "compiled")


def test_one_update_by_hand():
    """One step of plain gradient descent on one minibatch, against float64 written out here."""
    settings = {"update_epochs": 1, "vf_epochs": 1, "ent_coef": 0.2, "vf_coef": 0.7}
    args = Args(
        num_steps=4,
        num_minibatches=1,
        coefficient=0.9,
        lambda_min=2.5,
        max_grad_norm=1e9,
        gamma=0.9,
        gae_lambda=0.8,
        **settings,
    )
    learner = fixed_learner(args)
    learner.actor_optimizer = torch.optim.SGD(learner.actor.parameters(), 0.01)
    learner.critic_optimizer = torch.optim.SGD(learner.critic.parameters(), 0.01)
    obs = torch.tensor([0.0, 1.0, 2.0, -1.0])
    actions = torch.tensor([0.5, 1.0, 6.0, -1.0])
    rewards = torch.tensor([1.0, -2.0, 0.5, 4.0])
    values = 3 * obs
    next_values = torch.tensor([3.0, 6.0, 0.0, 7.0])
    dones = torch.tensor([0.0, 0.0, 1.0, 0.0])
    columns = [x[:, None] for x in (rewards, dones, values, next_values)]
    data = Rollout(obs[:, None, None], None, actions[:, None, None], *columns, None, [], [], None)

    learner.update = 1
    logs = ppo_reg.update(args, learner, data)

    errors = (rewards + 0.9 * next_values - values).double().tolist()
    advantages = [0.0] * 4
    following = 0.0
    for t in (3, 2, 1, 0):
        following = errors[t] + 0.9 * 0.8 * (1 - dones[t].item()) * following
        advantages[t] = following
    raw = np.array(advantages)
    scaled = (raw - raw.mean()) / raw.std(ddof=1)
    x = obs.double().numpy()
    noise = (actions.double().numpy() - 2 * x) / math.exp(0.5)  # in standard deviations
    # d log pi / d w = noise · x / std and d log pi / d log_std = noise² - 1; ratios are 1
    weight_grad = -(scaled * noise * x / math.exp(0.5)).mean()
    weight_grad += 0.9 * 2 * (2.0 - 2.5)  # c1 · d (J - 2.5)² / dw with J = w = 2
    log_std_grad = -(scaled * (noise**2 - 1)).mean() - 0.2
    critic_grad = 0.7 * (2 * (3 * x - (raw + 3 * x)) * x).mean()
    assert learner.actor.weight.item() == pytest.approx(2.0 - 0.01 * weight_grad, rel=1e-5)
    assert learner.actor.log_std.item() == pytest.approx(0.5 - 0.01 * log_std_grad, rel=1e-5)
    assert learner.critic.weight.item() == pytest.approx(3.0 - 0.01 * critic_grad, rel=1e-5)
    assert logs["losses/value_loss"] == pytest.approx((raw**2).mean(), rel=1e-5)
    targets = raw + 3 * x
    explained = 1 - raw.var() / targets.var()
    assert logs["losses/explained_variance"] == pytest.approx(explained, rel=1e-4)
    # before the first step the share compares the penalty's gradient with the rest's
    assert math.isnan(logs["conditioning/gradient_share"])
    again = fixed_learner(args)
    again.update = 25
    logs = ppo_reg.update(args, again, data)
    rest = math.hypot(weight_grad + 0.9, log_std_grad)
    assert logs["conditioning/gradient_share"] == pytest.approx(0.9 / rest, rel=1e-4)


def test_gradients_are_clipped_to_the_given_length():
    args = Args(num_steps=4, num_minibatches=1, update_epochs=1, vf_epochs=1, max_grad_norm=0.25)
    learner = fixed_learner(args)
    learner.actor_optimizer = torch.optim.SGD(learner.actor.parameters(), 1.0)
    learner.critic_optimizer = torch.optim.SGD(learner.critic.parameters(), 1.0)
    columns = [torch.tensor(x)[:, None] for x in ([9.0, 0.0, -9.0, 5.0], [0.0] * 4)]
    obs = torch.tensor([0.0, 1.0, 2.0, -1.0])[:, None]
    data = Rollout(
        obs[..., None], None, 2 * obs[..., None] + 3, *columns, 3 * obs, obs, None, [], [], None
    )
    before = [3.0, 2.0, 0.5]
    ppo_reg.update(args, learner, data)
    assert abs(learner.critic.weight.item() - before[0]) == pytest.approx(0.25, rel=1e-4)
    moved = [learner.actor.weight.item() - before[1], learner.actor.log_std.item() - before[2]]
    assert math.hypot(*moved) == pytest.approx(0.25, rel=1e-4)


@pytest.mark.parametrize(
    ("update_epochs", "vf_epochs", "target_kl", "steps"),
    [(3, 1, None, (12, 4)), (1, 3, None, (4, 12)), (3, 2, 1e9, (12, 8)), (3, 2, 1e-9, (4, 8))],
)
@pytest.mark.parametrize("coefficient", [0.0, 0.5])
def test_every_epoch_takes_each_state_once(
    monkeypatch, update_epochs, vf_epochs, target_kl, steps, coefficient
):
    """4 minibatches of 4 states; the policy stops for good once an epoch's KL is too large."""
    args = Args(
        num_steps=16,
        num_minibatches=4,
        update_epochs=update_epochs,
        vf_epochs=vf_epochs,
        target_kl=target_kl,
        coefficient=coefficient,
    )
    learner = fixed_learner(args)
    learner.update = 1
    learner.actor_optimizer = torch.optim.SGD(learner.actor.parameters(), 0.01)
    learner.critic_optimizer = torch.optim.SGD(learner.critic.parameters(), 0.01)
    taken = []
    deltas = []
    optimizers = []

    def spy(args, learner, obs, actions, logprobs, advantages, delta=None):
        taken.append(obs.flatten().tolist())
        assert (delta is None) == (coefficient == 0)
        assert torch.equal(actions, obs + 0.5)
        return actor_loss(args, learner, obs, actions, logprobs, advantages, delta)

    learner.actor_loss = spy
    step = ppo_reg.step
    monkeypatch.setattr(ppo_reg, "step", lambda *x: (optimizers.append(x[0]), step(*x)))
    sample_delta = learner.regularizer.sample_delta
    learner.regularizer.sample_delta = lambda x: deltas.append(len(x)) or sample_delta(x)
    obs = torch.arange(16.0)[:, None]
    data = Rollout(
        obs[..., None],
        None,
        obs[..., None] + 0.5,
        obs,
        0 * obs,
        0 * obs,
        0 * obs,
        None,
        [],
        [],
        None,
    )
    logs = ppo_reg.update(args, learner, data)
    # what is logged is a mean over the minibatches: log-std begins at 0.5 and moves by little
    entropy = 0.5 * math.log(2 * math.pi * math.e) + 0.5
    assert logs["losses/entropy"] == pytest.approx(entropy, abs=0.1)
    of_policy = sum(x is learner.actor_optimizer for x in optimizers)
    assert (of_policy, len(optimizers) - of_policy) == steps
    epochs = np.reshape(taken, (-1, 16)).tolist()
    assert all(sorted(epoch) == obs.flatten().tolist() for epoch in epochs)
    assert all(len(minibatch) == 4 for minibatch in taken)
    assert len({tuple(epoch) for epoch in epochs}) == len(epochs) == steps[0] / 4
    assert deltas == [16] * (len(epochs) if coefficient else 0)


@pytest.mark.parametrize(("number", "left"), [(1, 1.0), (2, 0.8), (5, 0.2)])
def test_step_sizes_fall_linearly_to_0(tmp_path, number, left):
    args = pendulum(ppo_reg, tmp_path, anneal_lr=True, learning_rate=0.01, vf_learning_rate=0.04)
    train(args)
    logged = float(read_metrics(tmp_path)[number - 1]["charts/learning_rate"])
    assert logged == pytest.approx(0.01 * left)
    if number == 5:
        saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["learner"]
        group = saved["critic_optimizer"]["param_groups"][0]
        assert group["lr"] == pytest.approx(0.04 * left)


# --- settings ------------------------------------------------------------------------------------


STANDARD = {
    "env_id": "HopperBulletEnv-v0",
    "seed": 1,
    "agent": 0,
    "total_timesteps": 5_000_000,
    "num_envs": 1,
    "num_steps": 2000,
    "num_minibatches": 40,
    "update_epochs": 10,
    "learning_rate": 3e-4,
    "vf_epochs": 10,
    "vf_learning_rate": 3e-4,
    "vf_coef": 0.5,
    "anneal_lr": False,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_coef": 0.2,
    "ent_coef": 0.0,
    "max_grad_norm": 0.5,
    "target_kl": None,
    "hidden_sizes": (64, 64),
    "activation": "tanh",
    "output_gain": 0.01,
    "log_std_init": 0.0,
    "norm_obs": True,
    "norm_reward": True,
    "reward_clip": 10.0,
    "run_dir": None,
    "resume": False,
    "extend": False,
    "checkpoint_interval": 50,
    "compile": False,
    "track": False,
}


def test_the_defaults_are_the_standard_setting():
    settings = dataclasses.asdict(Args())
    conditioning = {"coefficient", "lambda_min", "lambda_max", "reduction", "perturbation"}
    conditioning |= {"radius", "printed_sign", "probe_fraction", "log_spectrum", "perturb_obs"}
    conditioning |= {"penalty"}
    assert {k: v for k, v in settings.items() if k not in conditioning} == STANDARD
    assert conditioning <= settings.keys()


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("num_envs", [0], [1]),
        ("num_steps", [0], [2000]),
        ("num_minibatches", [0, 3, 2000], [1, 1000]),
        ("update_epochs", [0], [1]),
        ("vf_epochs", [0], [1]),
        ("checkpoint_interval", [0], [1]),
        ("seed", [-1], [0]),
        ("agent", [-1], [0]),
        ("reward_clip", [-0.1, math.nan], [0.0]),
        ("hidden_sizes", [(0,), (8, 0)], [(1,), ()]),
        ("learning_rate", [0.0, -1.0, math.inf, math.nan], [0.5]),
        ("vf_learning_rate", [0.0, -1.0, math.inf, math.nan], [0.5]),
        ("clip_coef", [0.0, math.inf], [0.5]),
        ("max_grad_norm", [0.0, math.inf], [0.5]),
        ("output_gain", [0.0, math.inf], [0.5]),
        ("gamma", [-0.1, 1.1, math.nan], [0.0, 1.0]),
        ("gae_lambda", [-0.1, 1.1, math.nan], [0.0, 1.0]),
        ("total_timesteps", [1999], [2000]),
        ("lambda_min", [-1.0], [0.0]),
    ],
)
def test_each_setting_has_its_range(name, refused, taken):
    for value in refused:
        with pytest.raises(ValueError, match=f"^{name} must|the range needs 0 <= {name}"):
            Args(**{name: value})
    for value in taken:
        assert getattr(Args(**{name: value}), name) == value


def test_an_error_tells_the_value_and_what_is_needed():
    with pytest.raises(ValueError, match=r"^num_envs must be at least 1, got 0$"):
        Args(num_envs=0)
    message = r"num_envs \* num_steps = 4000 into parts of 2 or more, got 4000$"
    with pytest.raises(ValueError, match=message):
        Args(num_envs=2, num_minibatches=4000)


def test_a_run_has_whole_updates_and_a_folder_that_names_it():
    args = Args(env_id="a_module:Task-v0", num_envs=3, num_steps=4, num_minibatches=2, seed=7)
    args = dataclasses.replace(args, agent=9, total_timesteps=12 * 5 + 11)
    assert args.batch_size == 12
    assert args.num_updates == 5
    assert args.path == Path("runs/Task-v0__ppo_reg__s7__a9")
    assert dataclasses.replace(args, run_dir=Path("here")).path == Path("here")


@pytest.mark.parametrize(("activation", "kind"), [("tanh", "Tanh"), ("relu", "ReLU")])
def test_layers_have_the_sizes_and_the_activation_that_are_asked_for(activation, kind):
    args = Args(env_id="Pendulum-v1", activation=activation, hidden_sizes=(5, 7))
    learner = ppo_reg.Learner(args)
    for net, outputs in ((learner.actor.mean, 1), (learner.critic, 1)):
        kinds = [type(layer).__name__ for layer in net]
        assert kinds == ["Linear", kind, "Linear", kind, "Linear"]
        assert [(x.in_features, x.out_features) for x in net[::2]] == [(3, 5), (5, 7), (7, outputs)]


def test_each_use_of_randomness_has_a_stream_of_its_own():
    chosen = ({"seed": 1}, {"agent": 1}, {"seed": 1, "agent": 1}, {"seed": 0})
    args = [Args(env_id="Pendulum-v1", **{"seed": 0, **changes}) for changes in chosen]
    seeds = []
    for learner in map(ppo_reg.Learner, args):
        assert list(learner.generators) == ["init", "action", "minibatch"]
        generators = list(learner.generators.values())
        generators += [learner.regularizer.generator, learner.probe.yardstick.generator]
        seeds += [generator.initial_seed() for generator in generators]
    assert len(set(seeds)) == len(seeds) == 20
    of_envs = [
        tuple(ppo_reg.env_seeds(dataclasses.replace(a, num_envs=2), checkpoint))
        for a in args
        for checkpoint in (0, 1)
    ]
    assert len({seed for pair in of_envs for seed in pair}) == 16
    # the streams stay what they are, so that a run can be repeated
    expected = np.random.SeedSequence((0, 1, 1)).generate_state(2).tolist()
    assert list(of_envs[3]) == expected


@pytest.mark.parametrize("output_gain", [0.01, 1.0])
def test_networks_begin_orthogonal(output_gain):
    learner = ppo_reg.Learner(
        Args(env_id="Pendulum-v1", output_gain=output_gain, log_std_init=-1.0)
    )
    gains = {"actor": output_gain, "critic": 1.0}
    for name, head_gain in gains.items():
        layers = [m for m in getattr(learner, name).modules() if isinstance(m, torch.nn.Linear)]
        assert len(layers) == 3
        for layer, gain in zip(layers, (2**0.5, 2**0.5, head_gain), strict=True):
            values = torch.linalg.svdvals(layer.weight)
            torch.testing.assert_close(values, torch.full_like(values, gain))
            assert not layer.bias.any()
    assert learner.actor.log_std.tolist() == [-1.0]
    for optimizer in (learner.actor_optimizer, learner.critic_optimizer):
        assert optimizer.param_groups[0]["eps"] == 1e-5
        assert optimizer.param_groups[0]["betas"] == (0.9, 0.999)


# --- environments --------------------------------------------------------------------------------


def count_rollout(num_steps: int = 5, **ends) -> Rollout:
    """A rollout of one Count environment under a critic that says: the value is the count."""
    envs = SyncVectorEnv([lambda: Count(**ends)], autoreset_mode=AutoresetMode.SAME_STEP)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    args = Args(env_id="Pendulum-v1", num_steps=num_steps, num_minibatches=1)
    learner = fixed_learner(args)
    learner.critic.weight.data.fill_(1.0)
    next_obs, _ = envs.reset(seed=0)
    return ppo_reg.rollout(args, learner, envs, next_obs)


def test_actions_are_mean_and_scaled_noise_and_executed_clipped():
    env = Count()
    envs = SyncVectorEnv([lambda: env], autoreset_mode=AutoresetMode.SAME_STEP)
    args = Args(env_id="Pendulum-v1", num_steps=6, num_minibatches=1)
    learner = fixed_learner(args, log_std=1.5)
    noise = torch.randn(6, generator=learner.generators["action"].clone_state())
    next_obs, _ = envs.reset(seed=0)
    data = ppo_reg.rollout(args, learner, envs, next_obs)
    expected = 2 * torch.arange(6.0) + math.exp(1.5) * noise
    torch.testing.assert_close(data.actions.flatten(), expected)
    executed = np.concatenate(env.actions)
    np.testing.assert_allclose(executed, expected.clamp(-1, 1), rtol=1e-6)
    assert (np.abs(executed) < 1).any() or (np.abs(executed) == 1).all()
    assert data.values.flatten().tolist() == [0, 3, 6, 9, 12, 15]


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


def test_an_environment_that_ends_leaves_its_neighbour_alone():
    envs = SyncVectorEnv(
        [lambda: Count(truncate_at=2), lambda: Count(), lambda: Count(terminate_at=3)],
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    args = Args(env_id="Pendulum-v1", num_envs=3, num_steps=4, num_minibatches=1)
    learner = fixed_learner(args)
    next_obs, _ = envs.reset(seed=0)
    data = ppo_reg.rollout(args, learner, envs, next_obs)
    assert data.obs[..., 0].T.tolist() == [[0, 1, 0, 1], [0, 1, 2, 3], [0, 1, 2, 0]]
    assert data.dones.T.tolist() == [[0, 1, 0, 1], [0, 0, 0, 0], [0, 0, 1, 0]]
    assert data.next_values.T.tolist() == [[3, 6, 3, 6], [3, 6, 9, 12], [3, 6, 0, 3]]
    assert data.next_obs.flatten().tolist() == [0, 4, 1]
    assert data.returns == [2.0, 3.0, 2.0]
    assert data.lengths == [2, 3, 2]
    assert data.clean_obs.shape == (12, 1)


def test_termination_wins_over_truncation():
    data = count_rollout(terminate_at=3, truncate_at=3)
    assert data.next_values.flatten().tolist() == [1, 2, 0, 1, 2]


def make_count_envs(tmp_path, monkeypatch, reward, **changes):
    args = pendulum(ppo_reg, tmp_path, **changes)
    monkeypatch.setattr(ppo_reg, "make_env", lambda args: Count(truncate_at=4, reward=reward))
    envs = ppo_reg.make_envs(args, {})
    envs.reset(seed=0)
    return envs


def test_rewards_are_divided_by_their_returns_deviation(tmp_path, monkeypatch):
    rewards = [1.0, 5.0, -2.0, 3.0]
    envs = make_count_envs(tmp_path, monkeypatch, lambda n: rewards[n - 1], gamma=0.5)
    got = [envs.step(np.zeros((1, 1), np.float32))[1].item() for _ in rewards]
    # Gymnasium's running moments begin as 1e-4 observations of mean 0 and variance 1
    discounted = 0.0
    mean = 0.0
    squares = 1e-4
    count = 1e-4
    for reward, scaled in zip(rewards, got, strict=True):
        discounted = 0.5 * discounted + reward
        squares += (discounted - mean) ** 2 * count / (count + 1)
        mean += (discounted - mean) / (count + 1)
        count += 1
        expected = reward / math.sqrt(squares / count + 1e-8)
        assert scaled == pytest.approx(min(max(expected, -10), 10), rel=1e-4)


def test_normalized_rewards_are_clipped(tmp_path, monkeypatch):
    """The first discounted return has hardly a variance, so its reward becomes a large number."""

    def first(**changes):
        envs = make_count_envs(tmp_path, monkeypatch, lambda n: -0.5, **changes)
        return envs.step(np.zeros((1, 1), np.float32))[1].item()

    assert first(reward_clip=0) < -30
    assert first() == -10.0
    assert first(reward_clip=2.5) == -2.5
    assert first(norm_reward=False, reward_clip=0.1) == -0.5


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


def test_the_statistics_see_clean_observations(tmp_path):
    stats_plain, stats_perturbed = {}, {}
    args = pendulum(ppo_reg, tmp_path)
    plain = ppo_reg.make_envs(args, stats_plain)
    noisy_args = pendulum(ppo_reg, tmp_path, perturb_obs=True)
    perturbed = noisy_args.perturb(ppo_reg.make_envs(noisy_args, stats_perturbed))
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


def test_a_bullet_task_is_found_by_its_name_alone():
    env = ppo_reg.make_env(Args(env_id="InvertedPendulumBulletEnv-v0"))
    named = ppo_reg.make_env(Args(env_id="pybullet_envs_gymnasium:InvertedPendulumBulletEnv-v0"))
    assert env.spec.id == named.spec.id == "InvertedPendulumBulletEnv-v0"
    with pytest.raises(RunError, match=r"env_id must name a task with a Box .* got Discrete\(2\)"):
        ppo_reg.make_env(Args(env_id="CartPole-v1"))


def test_environments_are_wrapped_as_the_settings_say():
    def wrappers(**changes):
        stats = {}
        env = ppo_reg.make_envs(Args(env_id="Pendulum-v1", num_envs=2, **changes), stats)
        assert env.num_envs == 2
        names = []
        while env is not env.unwrapped:
            names.append(type(env).__name__)
            env = env.env
        assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
        return names, list(stats)

    statistics, observations, rewards, clip = (
        "RecordEpisodeStatistics",
        "NormalizeObservation",
        "NormalizeReward",
        "ClipReward",
    )
    both = ["obs_rms", "return_rms"]
    assert wrappers() == ([clip, rewards, observations, statistics], both)
    assert wrappers(reward_clip=0) == ([rewards, observations, statistics], both)
    assert wrappers(norm_reward=False) == ([observations, statistics], ["obs_rms"])
    assert wrappers(norm_obs=False, norm_reward=False) == ([statistics], [])


def test_statistics_go_on_where_the_environments_are_rebuilt():
    args = Args(env_id="Pendulum-v1", num_envs=2)
    stats = {}
    for seen in (2, 6):  # a reset and a step show two observations each
        envs = ppo_reg.make_envs(args, stats)
        envs.reset(seed=[0, 1])
        assert stats["obs_rms"].count == pytest.approx(seen, abs=1e-3)
        envs.step(np.zeros((2, 1), np.float32))
    assert stats["return_rms"].count == pytest.approx(4, abs=1e-3)


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


# --- what is measured ----------------------------------------------------------------------------


def test_every_row_measures_the_new_policy_on_the_rollouts_clean_observations(
    tmp_path, monkeypatch
):
    """psi of a row is that of the weights after the update, and noise does not enter it."""
    seen = []
    kept = ppo_reg.log_update

    def spy(args, learner, writer, data, numbers):
        probe = args.make_probe(0)
        probe.load_state_dict(learner.probe.state_dict())
        expected = probe.measure(learner.update, learner.actor, data.clean_obs)
        row = kept(args, learner, writer, data, numbers)
        seen.append((data, expected, row))
        return row

    monkeypatch.setattr(ppo_reg, "log_update", spy)
    train(pendulum(ppo_reg, tmp_path, perturb_obs=True, radius=0.5))
    assert len(seen) == 5
    for data, expected, row in seen:
        distance = (data.obs.flatten(0, 1) - data.clean_obs).norm(dim=-1)
        torch.testing.assert_close(distance, torch.full((64,), 0.5))
        assert row["conditioning/psi"] == expected["conditioning/psi"]


def test_clean_observations_are_the_observations_where_nothing_perturbs_them(tmp_path):
    args = pendulum(ppo_reg, tmp_path)
    learner = ppo_reg.Learner(args)
    envs = ppo_reg.make_envs(args, learner.stats)
    next_obs, _ = envs.reset(seed=0)
    data = ppo_reg.rollout(args, learner, envs, next_obs)
    assert torch.equal(data.clean_obs, data.obs.flatten(0, 1))


def test_the_gradient_share_is_logged_every_25th_update(tmp_path):
    settings = {"num_steps": 16, "total_timesteps": 16 * 51, "update_epochs": 1, "vf_epochs": 1}
    train(pendulum(ppo_reg, tmp_path / "reg", coefficient=0.1, **settings))
    train(pendulum(ppo_reg, tmp_path / "plain", coefficient=0.0, **settings))
    for name, wanted in (("reg", lambda x: 0 < x < 100), ("plain", lambda x: x == 0)):
        rows = read_metrics(tmp_path / name)
        shares = [float(row["conditioning/gradient_share"]) for row in rows]
        due = [number for number, x in enumerate(shares, 1) if not math.isnan(x)]
        assert due == [25, 50]
        assert all(wanted(shares[number - 1]) for number in due)


def test_rows_count_the_episodes_that_ended(tmp_path):
    gym.register("test/Short-v0", lambda: Count(truncate_at=10))
    train(pendulum(ppo_reg, tmp_path, env_id="test/Short-v0"))
    # of 64 steps: 6, 12 after 128, 19 after 192, 25 after 256, 32 after 320
    rows = read_metrics(tmp_path)
    assert [int(row["charts/episodes"]) for row in rows] == [6, 6, 7, 6, 7]
    assert {float(row["charts/episodic_return"]) for row in rows} == {10.0}
    assert {float(row["charts/episodic_length"]) for row in rows} == {10.0}


def test_a_row_means_over_episodes_and_is_nan_without_one(tmp_path):
    args = pendulum(ppo_reg, tmp_path)
    learner = ppo_reg.Learner(args)
    learner.update = 3
    data = make_rollout([0.0], [0.0], [0.0], [0.0])
    data = data._replace(clean_obs=torch.randn(8, 3), returns=[1.0, 5.0], lengths=[2, 3])
    writer = ppo_reg.open_logs(args, None)
    numbers = {"charts/SPS": 7.0, "losses/entropy": 0.5}
    row = ppo_reg.log_update(args, learner, writer, data, numbers)
    assert list(row)[:6] == [
        "global_step",
        "charts/episodic_return",
        "charts/episodic_length",
        "charts/episodes",
        "charts/SPS",
        "losses/entropy",
    ]
    assert read_metrics(tmp_path) == [{name: str(x) for name, x in row.items()}]
    assert row["global_step"] == 3 * 64
    assert row["charts/episodic_return"] == 3.0
    assert row["charts/episodic_length"] == 2.5
    assert row["charts/episodes"] == 2
    assert row["charts/SPS"] == 7.0
    assert row["losses/entropy"] == 0.5
    data = data._replace(returns=[], lengths=[])
    empty = ppo_reg.log_update(args, learner, writer, data, numbers)
    assert math.isnan(empty["charts/episodic_return"])
    assert math.isnan(empty["charts/episodic_length"])
    assert empty["charts/episodes"] == 0


def test_the_printed_sign_raises_psi(tmp_path):
    """From an output gain of 1, so that psi can move both ways."""
    settings = {"coefficient": 1.0, "output_gain": 1.0, "learning_rate": 3e-3, "lambda_min": 2.0}
    psi = {}
    for sign in (False, True):
        train(pendulum(ppo_reg, tmp_path / str(sign), printed_sign=sign, **settings))
        psi[sign] = float(read_metrics(tmp_path / str(sign))[-1]["conditioning/own_psi"])
    assert psi[True] > psi[False] + 0.1


def test_one_quotient_for_the_minibatch_trains_otherwise(tmp_path):
    settings = {"coefficient": 1.0}
    by_state = train(pendulum(ppo_reg, tmp_path / "a", **settings))
    by_batch = train(pendulum(ppo_reg, tmp_path / "b", reduction="batch", **settings))
    assert not torch.equal(weights(by_state), weights(by_batch))
    row = read_metrics(tmp_path / "b")[-1]
    assert row["conditioning/own_quotient_q05"] == row["conditioning/own_quotient_q95"]
    assert row["conditioning/quotient_q05"] != row["conditioning/quotient_q95"]


# --- files ---------------------------------------------------------------------------------------


INTERVAL_2 = {"checkpoint_interval": 2, "total_timesteps": 7 * 64}


def stop_at(update: int, args: Args, monkeypatch) -> None:
    interrupted(ppo_reg, args, monkeypatch, at_update=update)


@pytest.mark.parametrize("at_update", [1, 5])
def test_a_resumed_run_ends_as_the_undisturbed_one(tmp_path, monkeypatch, at_update):
    settings = {**INTERVAL_2, "num_envs": 2, "num_steps": 32, "coefficient": 0.5}
    undisturbed = train(pendulum(ppo_reg, tmp_path / "a", **settings))
    stop_at(at_update, pendulum(ppo_reg, tmp_path / "b", **settings), monkeypatch)
    resumed = train(pendulum(ppo_reg, tmp_path / "b", resume=True, **settings))
    assert torch.equal(weights(undisturbed), weights(resumed))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")
    steps = [int(row["global_step"]) for row in read_metrics(tmp_path / "b")]
    assert steps == [64 * (i + 1) for i in range(7)]


def test_a_checkpoint_is_written_at_each_interval_and_the_one_before_is_kept(tmp_path):
    args = pendulum(ppo_reg, tmp_path, **INTERVAL_2)
    learner = train(args)
    files = {path.name for path in tmp_path.iterdir() if not path.name.startswith("events")}
    assert files == {"metrics.csv", "checkpoint.pt", "checkpoint.previous.pt"}
    last, before = (
        torch.load(tmp_path / name, weights_only=True)
        for name in ("checkpoint.pt", "checkpoint.previous.pt")
    )
    assert [last["learner"]["update"], before["learner"]["update"]] == [7, 6]
    kept = dataclasses.asdict(args)
    for name in ("run_dir", "resume", "extend", "track"):
        del kept[name]
    assert last["args"] == kept
    lines = (tmp_path / "metrics.csv").read_bytes().splitlines(keepends=True)
    assert before["metrics_size"] == sum(map(len, lines[:7]))  # the header and six rows
    assert last["metrics_size"] == sum(map(len, lines))
    state = last["learner"]
    assert state["obs_rms"]["mean"].tolist() == learner.stats["obs_rms"].mean.tolist()
    assert state["obs_rms"]["count"].item() == learner.stats["obs_rms"].count
    assert state["obs_rms"]["var"].dtype == torch.float64
    assert set(state["generators"]) == {"init", "action", "minibatch"}


def test_a_checkpoint_is_on_the_disk_before_it_takes_its_name(tmp_path, monkeypatch):
    events = []

    def fsync(number: int) -> None:
        inode = os.fstat(number).st_ino
        name = next(path.name for path in tmp_path.iterdir() if path.stat().st_ino == inode)
        events.append(f"write {name}")

    def replace(path: Path, target: Path) -> None:
        events.append(f"rename {path.name} to {target.name}")
        os.rename(path, target)

    args = pendulum(ppo_reg, tmp_path)
    learner = train(args)
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    ppo_reg.save_checkpoint(args, learner)
    assert events == [
        "write metrics.csv",
        "write checkpoint.tmp",
        "rename checkpoint.pt to checkpoint.previous.pt",
        "rename checkpoint.tmp to checkpoint.pt",
    ]


def test_a_torn_checkpoint_falls_back_on_the_one_before(tmp_path, capsys):
    undisturbed = train(pendulum(ppo_reg, tmp_path / "a", **INTERVAL_2))
    train(pendulum(ppo_reg, tmp_path / "b", **INTERVAL_2))
    (tmp_path / "b" / "checkpoint.pt").write_bytes(b"torn")
    resumed = train(pendulum(ppo_reg, tmp_path / "b", resume=True, **INTERVAL_2))
    assert f"{tmp_path / 'b' / 'checkpoint.pt'} cannot be read: " in capsys.readouterr().out
    assert torch.equal(weights(undisturbed), weights(resumed))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")
    for name in ("checkpoint.pt", "checkpoint.previous.pt"):
        (tmp_path / "b" / name).write_bytes(b"torn")
    with pytest.raises(RunError, match="holds no readable checkpoint: remove it"):
        train(pendulum(ppo_reg, tmp_path / "b", resume=True, **INTERVAL_2))


def test_a_run_is_overwritten_by_no_other(tmp_path, monkeypatch):
    stop_at(1, pendulum(ppo_reg, tmp_path, **INTERVAL_2), monkeypatch)  # before any checkpoint
    with pytest.raises(RunError, match=f"{tmp_path} holds a run: --resume it, or name another"):
        train(pendulum(ppo_reg, tmp_path, **INTERVAL_2))
    train(pendulum(ppo_reg, tmp_path, resume=True, **INTERVAL_2))
    (tmp_path / "metrics.csv").unlink()
    with pytest.raises(RunError, match="holds a run"):
        train(pendulum(ppo_reg, tmp_path, **INTERVAL_2))


@pytest.mark.parametrize(("version", "named"), [(None, 1), (99, 99)])
def test_a_run_of_another_version_is_not_continued(tmp_path, version, named):
    """The first version wrote no number."""
    train(pendulum(ppo_reg, tmp_path))
    path = tmp_path / "checkpoint.pt"
    saved = torch.load(path, weights_only=True)
    assert saved.pop("version") == ppo_reg.VERSION
    torch.save(saved if version is None else {**saved, "version": version}, path)
    message = f"run with VERSION={named}, not {ppo_reg.VERSION}$"
    with pytest.raises(RunError, match=message):
        train(pendulum(ppo_reg, tmp_path, resume=True))


def test_a_malicious_checkpoint_is_not_executed(tmp_path):
    class Exploit:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    torch.save({"args": Exploit()}, tmp_path / "checkpoint.pt")
    with pytest.raises(RunError, match="no readable checkpoint"):
        train(pendulum(ppo_reg, tmp_path, resume=True))
    assert not (tmp_path / "executed").exists()


def test_rows_that_a_checkpoint_counts_must_be_there(tmp_path, monkeypatch):
    stop_at(2, pendulum(ppo_reg, tmp_path, **INTERVAL_2), monkeypatch)
    metrics = tmp_path / "metrics.csv"
    metrics.write_bytes(metrics.read_bytes()[:-200])
    with pytest.raises(RunError, match=r"metrics\.csv lacks rows: remove its folder"):
        train(pendulum(ppo_reg, tmp_path, resume=True, **INTERVAL_2))


def test_a_finished_run_stays_as_it_is(tmp_path, capsys):
    train(pendulum(ppo_reg, tmp_path))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    learner = train(pendulum(ppo_reg, tmp_path, resume=True))
    assert learner.update == 5
    assert capsys.readouterr().out.endswith(f"{tmp_path} is finished\n")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_tensorboard_holds_what_metrics_csv_holds_after_a_resume(tmp_path, monkeypatch):
    stop_at(5, pendulum(ppo_reg, tmp_path, **INTERVAL_2), monkeypatch)
    train(pendulum(ppo_reg, tmp_path, resume=True, **INTERVAL_2))
    events = EventAccumulator(str(tmp_path)).Reload()
    rows = read_metrics(tmp_path)
    for name in ("conditioning/psi", "charts/learning_rate"):
        scalars = events.Scalars(name)
        assert [x.step for x in scalars] == [int(row["global_step"]) for row in rows]
        assert [x.value for x in scalars] == pytest.approx([float(row[name]) for row in rows])
    assert "conditioning/gradient_share" not in events.Tags()["scalars"]  # NaN in all rows
    text = events.Tensors("hyperparameters/text_summary")[0].tensor_proto.string_val[0].decode()
    assert text.startswith("|parameter|value|\n|-|-|\n|")
    assert "|gamma|0.99|" in text


def test_speed_and_progress_by_a_clock_of_a_second_an_update(tmp_path, monkeypatch, capsys):
    """16 steps a second, told at once, whenever more than 10 seconds have passed, and at the end.

    A resumed run counts from where it went on.
    """
    settings = {"num_steps": 16, "checkpoint_interval": 10, "update_epochs": 1, "vf_epochs": 1}
    for updates, told in ((30, ["1/30", "12/30", "23/30", "30/30"]), (32, ["31/32", "32/32"])):
        clock = types.SimpleNamespace(monotonic=itertools.count().__next__)
        monkeypatch.setattr(ppo_reg, "time", clock)
        settings |= {"total_timesteps": 16 * updates, "resume": True, "extend": updates > 30}
        train(pendulum(ppo_reg, tmp_path, **settings))
        lines = [line.split() for line in capsys.readouterr().out.splitlines()]
        assert [words[1] for words in lines] == told
        assert {" ".join(words[2:5]) for words in lines} == {"16 steps/s return"}
    assert {float(row["charts/SPS"]) for row in read_metrics(tmp_path)} == {16.0}


def test_no_global_random_state_is_touched(tmp_path):
    state = torch.get_rng_state()
    train(pendulum(ppo_reg, tmp_path, perturb_obs=True))
    assert torch.equal(torch.get_rng_state(), state)


# --- the program ---------------------------------------------------------------------------------


def run_main(monkeypatch, *flags: str, main=ppo_reg.main) -> None:
    monkeypatch.setattr("sys.argv", ["ppo_reg.py", *flags])
    monkeypatch.setattr("sys.stdout.reconfigure", lambda **options: None, raising=False)
    kept = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        main()
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


SHORT = ["--env-id=Pendulum-v1", "--num-steps=64", "--num-minibatches=4", "--total-timesteps=64"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env-id=CartPole-v1"], "error: env_id must name a task with a Box of actions"),
        (["--env-id=Hoper-v0"], "error: Environment `Hoper` doesn't exist"),
        (["--env-id=no_such_module:Task-v0"], "error: No module named 'no_such_module'"),
    ],
)
def test_an_error_ends_the_program_with_what_to_do(tmp_path, monkeypatch, flags, message):
    with pytest.raises(SystemExit, match=message):
        run_main(monkeypatch, *flags, f"--run-dir={tmp_path}")


def test_the_file_is_a_program_whose_help_shows_every_flag(monkeypatch, capsys):
    run_file = functools.partial(runpy.run_path, ppo_reg.__file__, run_name="__main__")
    with pytest.raises(SystemExit) as stopped:
        run_main(monkeypatch, "--help", main=run_file)
    said = capsys.readouterr().out
    assert stopped.value.code == 0
    assert all(f"--{name.replace('_', '-')}" in said for name in vars(Args()))
    assert "PPO (Schulman et al., 2017" in said
    assert "# condwrap" not in said


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_program_with_how_to_go_on(tmp_path, monkeypatch, number):
    monkeypatch.setattr(ppo_reg, "update", lambda *args: signal.raise_signal(number))
    with pytest.raises(SystemExit, match="interrupted: --resume continues from the last"):
        run_main(monkeypatch, *SHORT, f"--run-dir={tmp_path}")


def test_the_program_trains_with_one_thread_and_its_flags(tmp_path, monkeypatch):
    threads = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    run_main(monkeypatch, *SHORT, f"--run-dir={tmp_path}", "--coefficient=0.25")
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert saved["args"]["coefficient"] == 0.25
    assert saved["learner"]["update"] == 1
    assert threads == [1]


def test_weights_and_biases_is_asked_for_by_track(tmp_path, monkeypatch):
    asked = []
    fake = types.SimpleNamespace(init=lambda **options: asked.append(options))
    monkeypatch.setitem(sys.modules, "wandb", fake)
    run_main(monkeypatch, *SHORT, f"--run-dir={tmp_path / 'plain'}")
    assert asked == []
    run_main(monkeypatch, *SHORT, f"--run-dir={tmp_path / 'a_name'}", "--track")
    assert [x["name"] for x in asked] == ["a_name"]
    assert asked[0]["config"]["total_timesteps"] == 64
    assert asked[0]["sync_tensorboard"] is True


# --- outcomes and longer runs --------------------------------------------------------------------


@pytest.mark.parametrize(("broken", "what"), [("reward", "reward"), ("observation", "observation")])
def test_a_run_that_diverges_says_so_and_keeps_its_last_checkpoint(tmp_path, broken, what):
    class Breaking(Count):
        steps = 0

        def step(self, action):
            Breaking.steps += 1
            obs, reward, *rest = super().step(action)
            if Breaking.steps >= 3 * 64 + 10:
                reward = math.inf if broken == "reward" else reward
                obs = obs * math.nan if broken == "observation" else obs
            return obs, reward, *rest

    gym.register(f"test/Breaking-{broken}-v0", Breaking)
    env_id = f"test/Breaking-{broken}-v0"
    args = pendulum(ppo_reg, tmp_path, env_id=env_id, checkpoint_interval=2)
    with np.errstate(invalid="ignore"), pytest.raises(DivergedError, match=f"the {what} became"):
        train(args)
    said = json.loads((tmp_path / "diverged.json").read_text())
    assert said == {
        "update": 4,
        "what": what,
        "message": f"the {what} became non-finite in update 4",
    }
    assert len(read_metrics(tmp_path)) == 3
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert saved["learner"]["update"] == 2


def test_weights_that_become_non_finite_are_an_outcome(tmp_path):
    with pytest.raises(DivergedError, match="the loss became non-finite in update 1"):
        train(pendulum(ppo_reg, tmp_path, vf_coef=math.inf))
    assert read_metrics_or_none(tmp_path) == []


def read_metrics_or_none(path):
    return read_metrics(path) if (path / "metrics.csv").stat().st_size else []


def test_the_program_ends_with_3_where_a_run_diverged(tmp_path, monkeypatch, capsys):
    flags = ["--env-id=Pendulum-v1", "--num-steps=64", "--num-minibatches=4", "--vf-coef=inf"]
    flags += ["--total-timesteps=64", f"--run-dir={tmp_path}"]
    monkeypatch.setattr("sys.argv", ["ppo_reg.py", *flags])
    with pytest.raises(SystemExit) as stopped:
        ppo_reg.main()
    assert stopped.value.code == 3
    assert "the loss became non-finite in update 1" in capsys.readouterr().out


def test_an_extended_run_is_the_longer_run_bit_for_bit(tmp_path):
    longer = train(
        pendulum(ppo_reg, tmp_path / "longer", checkpoint_interval=2, total_timesteps=384)
    )
    settings = {"checkpoint_interval": 2, "total_timesteps": 256}
    train(pendulum(ppo_reg, tmp_path / "extended", **settings))
    settings = {"checkpoint_interval": 2, "total_timesteps": 384, "resume": True, "extend": True}
    extended = train(pendulum(ppo_reg, tmp_path / "extended", **settings))
    assert torch.equal(weights(extended), weights(longer))
    assert without_speed(tmp_path / "extended") == without_speed(tmp_path / "longer")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"total_timesteps": 640}, "was run with total_timesteps=320, not 640"),
        ({"total_timesteps": 256, "extend": True}, "was run with total_timesteps=320, not 256"),
        ({"gamma": 0.5, "extend": True}, "was run with gamma=0.99, not 0.5"),
    ],
)
def test_what_cannot_be_extended_is_refused(tmp_path, changes, message):
    train(pendulum(ppo_reg, tmp_path))
    with pytest.raises(RunError, match=message):
        train(pendulum(ppo_reg, tmp_path, resume=True, **changes))


def test_an_annealed_run_cannot_be_extended(tmp_path):
    train(pendulum(ppo_reg, tmp_path, anneal_lr=True))
    longer = {"total_timesteps": 640, "resume": True, "extend": True}
    with pytest.raises(ValueError, match=r"^extend must be False, .* on its length, got"):
        train(pendulum(ppo_reg, tmp_path, anneal_lr=True, **longer))
    with pytest.raises(RunError, match="was run with anneal_lr=True, not False"):
        train(pendulum(ppo_reg, tmp_path, **longer))
