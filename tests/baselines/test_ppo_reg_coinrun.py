"""PPO on CoinRun: its mathematics, its networks, and the promises that its docstring makes."""

from __future__ import annotations

import copy
import dataclasses
import math
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import NormalizeReward
from torch import nn

from baselines import ppo_reg_coinrun
from baselines.ppo_reg_coinrun import (
    Agent,
    Args,
    Batch,
    Learner,
    Rollout,
    gae,
    minibatches,
    play,
    rollout,
    total_loss,
    train,
    update,
)
from tests.baselines.helpers import Scripted, check_refusal, coinrun, flat, read_metrics, weights

SMALL = {"num_envs": 4, "num_groups": 2, "num_steps": 16, "num_minibatches": 2, "num_levels": 8}
SMALL |= {"total_timesteps": 64, "distribution_mode": "easy", "eval_interval": 0}


def make_args(**changes) -> Args:
    return Args(**{**SMALL, **changes})


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scripted(*lengths: list[int], groups: int = 1) -> list[Scripted]:
    size = len(lengths) // groups
    return [Scripted(list(lengths[i : i + size])) for i in range(0, len(lengths), size)]


class ShowsStep(nn.Module):
    """Its value is the step that the frame of a Scripted environment shows."""

    def forward(self, frames):
        logprobs = torch.full((len(frames), 15), -math.log(15))
        return logprobs, frames[:, 0, 0, 0].float()


def scripted_rollout(*lengths: list[int], num_steps: int, groups: int = 1, **changes) -> Rollout:
    shape = {"num_envs": len(lengths), "num_groups": groups, "num_steps": num_steps}
    total = len(lengths) * num_steps
    args = make_args(**shape, num_minibatches=1, total_timesteps=total, **changes)
    learner, envs = Learner(args), scripted(*lengths, groups=groups)
    learner.agent = ShowsStep()
    return rollout(args, learner, envs, [env.reset()[0] for env in envs])


def real_rollout(**changes) -> tuple[Args, Learner, Rollout]:
    """On CoinRun, with the dropout mask of a first update."""
    args = make_args(**changes)
    learner = Learner(args)
    learner.draw_mask(args)
    envs, frames = ppo_reg_coinrun.make_envs(args, 0)
    data = rollout(args, learner, envs, frames)
    for env in envs:
        env.close()
    return args, learner, data


def batch_of(data: Rollout, delta=None) -> Batch:
    columns = (data.obs, data.actions, data.logprobs, data.rewards, data.values)
    batch = Batch(*(x.flatten(0, 1) for x in columns), delta)
    advantages = torch.randn(len(batch.advantages), generator=seeded(1))
    return batch._replace(advantages=advantages, targets=batch.targets + 1)


# --- rollouts ------------------------------------------------------------------------------------


def test_a_rollout_by_hand():
    """An episode of 3 steps, a reset, and an episode of 2; beside it one that goes on."""
    data = scripted_rollout([3, 2], [], num_steps=7)
    assert data.counts[:, 0].tolist() == [True, True, True, False, True, True, False]
    assert data.counts[:, 1].all()
    assert data.obs[:, 0, 0, 0, 0].tolist() == [0, 1, 2, 3, 0, 1, 2]
    assert data.values[:, 0].tolist() == [0, 1, 2, 3, 0, 1, 2]
    assert data.dones[:, 0].tolist() == [0, 0, 1, 0, 0, 1, 0]
    assert data.rewards[:, 0].tolist() == [0, 0, 10, 0, 0, 0, 0]
    assert data.next_values[:, 0].tolist() == [1, 2, 0, 0, 1, 0, 0]
    assert data.next_values[:, 1].tolist() == [1, 2, 3, 4, 5, 6, 7]
    assert data.episodes["episodic_length"] == [3, 2]
    assert data.episodes["episodic_return"] == [10, 0]
    assert data.episodes["success_rate"] == [True, False]


def test_groups_change_nothing_but_the_order_of_waiting():
    lengths = [3, 2], [5, 1, 1], [], [4]
    whole, parts = (scripted_rollout(*lengths, num_steps=9, groups=n) for n in (1, 4))
    for name, column in whole._asdict().items():
        if name == "episodes":
            assert {k: sorted(v) for k, v in column.items()} == {
                k: sorted(v) for k, v in parts.episodes.items()
            }
        else:
            assert torch.equal(column, getattr(parts, name)), name


def test_a_reset_that_a_rollout_begins_with_is_known():
    """The episode ended with the last step of the rollout before."""
    args = make_args(num_envs=1, num_groups=1, num_steps=3, num_minibatches=1)
    learner, envs = Learner(args), scripted([3])
    learner.agent, frames = ShowsStep(), [envs[0].reset()[0]]
    counts = [rollout(args, learner, envs, frames).counts.flatten().tolist() for _ in range(2)]
    assert counts == [[True] * 3, [False, True, True]]


def test_global_step_counts_no_resets(tmp_path, monkeypatch):
    """A real run: the engine's own info says how many of the steps were resets."""
    resets, steps = [], []
    wait = ppo_reg_coinrun.Procgen.step_wait

    def spy(env):
        answer = wait(env)
        resets.append(answer[-1]["reset"].sum())
        steps.append(len(answer[-1]["reset"]))
        return answer

    monkeypatch.setattr(ppo_reg_coinrun.Procgen, "step_wait", spy)
    monkeypatch.setattr(ppo_reg_coinrun, "update", lambda *_: {})  # acting is what matters
    changes = {"num_steps": 128, "num_envs": 8, "num_groups": 2, "distribution_mode": "hard"}
    args = make_args(**changes, run_dir=tmp_path, total_timesteps=3072, probe_fraction=0.01)
    learner = train(args)
    assert sum(steps) == 3072
    assert sum(resets) > 0
    assert learner.global_step == 3072 - sum(resets)
    assert [int(row["global_step"]) for row in read_metrics(tmp_path)][-1] == learner.global_step


def test_gae_by_hand_and_nothing_flows_over_an_end():
    # gamma = lambda = 0.5; d = r + 0.5 · next - V; the fourth step is a reset, whose d is not used
    columns = {"rewards": [1.0, 2.0, 0.0, 3.0], "values": [0.5, 1.0, 99.0, 1.5]}
    columns |= {"next_values": [1.0, 0.0, 1.5, 4.0], "dones": [0.0, 1.0, 0.0, 0.0]}
    data = Rollout(
        *[None] * 3, **{k: torch.tensor(v)[:, None] for k, v in columns.items()},
        counts=None, episodes={},
    )  # fmt: skip
    advantages = gae(data, 0.5, 0.5).flatten()
    assert advantages[[0, 1, 3]].tolist() == [1 + 0.25, 1.0, 3.5]


@pytest.mark.parametrize("lengths", [([3, 2, 4],), ([1, 1, 1, 1, 1],), ([6], [2, 2])])
def test_advantages_are_those_of_each_episode_alone(lengths):
    data = scripted_rollout(*lengths, num_steps=12)
    advantages = gae(data, 0.9, 0.8)
    for i, own in enumerate(lengths):
        begin = 0
        for length in own:
            at = slice(begin, begin + length)
            alone = data._replace(
                rewards=data.rewards[at, i : i + 1], values=data.values[at, i : i + 1],
                next_values=data.next_values[at, i : i + 1], dones=data.dones[at, i : i + 1],
            )  # fmt: skip
            torch.testing.assert_close(gae(alone, 0.9, 0.8), advantages[at, i : i + 1])
            begin += length + 1  # the reset


# --- minibatches and the first ratio -------------------------------------------------------------


def test_minibatches_hold_every_counting_step_and_no_other():
    counts = torch.rand(16, 12, generator=seeded()) > 0.1
    parts = list(minibatches(counts, 48, seeded()))
    assert [len(part) for part in parts] == [48] * 4
    order = torch.cat(parts)
    assert set(order.tolist()) == set(counts.flatten().nonzero().flatten().tolist())
    assert order.bincount(minlength=192).max() == 2  # as few come twice as can


def test_minibatches_are_a_plain_permutation_if_all_steps_count():
    parts = list(minibatches(torch.ones(4, 6, dtype=torch.bool), 8, seeded(3)))
    assert torch.equal(torch.cat(parts), torch.randperm(24, generator=seeded(3)))


def test_minibatches_are_whole_even_if_few_steps_count():
    counts = torch.zeros(4, 6, dtype=torch.bool)
    counts[1, 2] = True
    assert [part.tolist() for part in minibatches(counts, 8, seeded())] == [[8] * 8] * 3


@pytest.mark.parametrize("network", ["nature", "impala"])
@pytest.mark.parametrize("dropout", [0.0, 0.5])
def test_the_first_ratios_are_1(network, dropout):
    """Also under dropout, since rollout and update share a mask."""
    args, learner, data = real_rollout(network=network, dropout=dropout)
    batch = batch_of(data)
    logprobs, values = learner.agent(batch.obs)
    taken = logprobs.gather(-1, batch.actions[:, None])[:, 0]
    torch.testing.assert_close(taken, batch.old_logprobs, atol=1e-5, rtol=0)
    torch.testing.assert_close(values, data.values.flatten(), atol=1e-4, rtol=1e-5)
    _, parts = total_loss(args, learner, batch, torch.tensor(0.2))
    assert abs(parts[2]) < 1e-6  # the KL estimate
    assert parts[3] == 0  # clipped


def test_resets_reach_no_loss(monkeypatch):
    """With the reset transitions' columns spoiled, the update is the same."""
    learners = []
    for spoiled in (0.0, 1e6):
        args = make_args(num_envs=2, num_groups=1, num_steps=12, num_minibatches=1)
        learner, envs = Learner(args), scripted([3, 2], [4, 1])
        data = rollout(args, learner, envs, [envs[0].reset()[0]])
        assert not data.counts.all()
        for column in (data.rewards, data.values, data.logprobs):
            column[~data.counts] += spoiled
        update(args, learner, data)
        learners.append(learner)
    assert torch.equal(*[flat(learner.agent) for learner in learners])


# --- the loss ------------------------------------------------------------------------------------


def loss_of(args: Args, learner: Learner, batch: Batch) -> torch.Tensor:
    return total_loss(args, learner, batch, torch.tensor(0.2))[0].detach()


def test_the_loss_in_float64_by_the_papers_formula():
    args, learner, data = real_rollout(vf_coef=0.7, ent_coef=0.03)
    batch = batch_of(data)
    batch = batch._replace(old_logprobs=batch.old_logprobs + 0.3 * batch.advantages)
    loss, parts = total_loss(args, learner, batch, torch.tensor(0.2))
    logprobs, values = (x.detach().double() for x in learner.agent(batch.obs))
    adv = batch.advantages.double()
    adv = (adv - adv.mean()) / adv.std()
    ratio = (logprobs[torch.arange(64), batch.actions] - batch.old_logprobs.double()).exp()
    clip = -torch.min(adv * ratio, adv * ratio.clamp(0.8, 1.2)).mean()
    entropy = torch.distributions.Categorical(logits=logprobs).entropy().mean()
    value = 0.5 * ((values - batch.targets.double()) ** 2).mean()
    clipped = ((ratio - 1).abs() > 0.2).double().mean()
    expected = torch.stack([clip, entropy, (ratio - 1 - ratio.log()).mean(), clipped, value])
    torch.testing.assert_close(parts.double(), expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(loss.double(), clip + 0.7 * value - 0.03 * entropy)


def test_l2_is_half_the_squared_weights_without_biases():
    args, learner, data = real_rollout()
    batch, agent = batch_of(data), learner.agent
    for name, p in agent.named_parameters():
        if name.endswith("bias"):
            nn.init.constant_(p, 0.01)
    plain = loss_of(args, learner, batch)
    heavy = loss_of(dataclasses.replace(args, l2=0.1), learner, batch)
    kernels = [m.weight for m in agent.modules() if isinstance(m, nn.Conv2d | nn.Linear)]
    squares = sum(w.double().square().sum() for w in kernels)
    assert (heavy - plain).item() == pytest.approx(0.05 * squares.item(), rel=1e-4)


@pytest.mark.parametrize("network", ["nature", "impala"])
@pytest.mark.parametrize("dropout", [0.0, 0.5])
def test_the_penalty_is_the_regularizers_own(network, dropout):
    args, learner, data = real_rollout(coefficient=0.3, network=network, dropout=dropout)
    batch = batch_of(data)
    delta = learner.regularizer.sample_delta(batch.obs)
    penalty = learner.regularizer(learner.agent.logprobs, batch.obs, delta=delta).penalty
    added = loss_of(args, learner, batch._replace(delta=delta)) - loss_of(args, learner, batch)
    assert penalty > 0
    torch.testing.assert_close(added, penalty, atol=1e-5, rtol=1e-4)


def test_in_bfloat16_the_loss_is_finite_and_the_penalty_that_of_float32():
    args, learner, data = real_rollout(coefficient=1.0)
    nn.init.normal_(learner.agent.policy.weight, generator=seeded())  # a policy that reacts
    batch = batch_of(data)
    batch = batch._replace(delta=learner.regularizer.sample_delta(batch.obs))
    half = dataclasses.replace(args, bf16=True)
    penalties = []
    for precision in (args, half):
        with_penalty = loss_of(precision, learner, batch)
        without = loss_of(precision, learner, batch._replace(delta=None))
        penalties.append((with_penalty - without).item())
    assert math.isfinite(loss_of(half, learner, batch))
    assert penalties[1] == pytest.approx(penalties[0], rel=1e-3, abs=1e-3)
    assert loss_of(args, learner, batch) != loss_of(half, learner, batch)


def test_a_run_in_bfloat16_is_finite_and_its_weights_float32(tmp_path):
    learner = train(coinrun(tmp_path, bf16=True, total_timesteps=128, coefficient=0.1))
    assert {p.dtype for p in learner.agent.parameters()} == {torch.float32}
    for row in read_metrics(tmp_path):
        assert math.isfinite(float(row["losses/policy_loss"]))
        assert math.isfinite(float(row["conditioning/psi"]))


# --- schedules and reward scales -----------------------------------------------------------------


@pytest.mark.parametrize("anneal", [True, False])
def test_the_step_size_and_the_clip_range_fall_linearly(tmp_path, monkeypatch, anneal):
    seen = []
    loss = ppo_reg_coinrun.total_loss

    def spy(args, learner, batch, clip_coef):
        seen.append((learner.optimizer.param_groups[0]["lr"], clip_coef.item()))
        return loss(args, learner, batch, clip_coef)

    monkeypatch.setattr(ppo_reg_coinrun, "total_loss", spy)
    args = coinrun(tmp_path, anneal=anneal, learning_rate=1e-3, update_epochs=1, num_minibatches=1)
    train(args)
    left = [1.0, 0.8, 0.6, 0.4, 0.2] if anneal else [1.0] * 5
    expected = [(1e-3 * x, 0.2 * x) for x in left]
    assert np.array(seen) == pytest.approx(np.array(expected))
    logged = [float(row["charts/learning_rate"]) for row in read_metrics(tmp_path)]
    assert logged == pytest.approx([rate for rate, _ in expected])


class Recorded(VectorEnv):
    """Gives the rewards and truncations that were recorded, `[T, N]`."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    single_action_space = action_space = gym.spaces.Discrete(2)
    single_observation_space = observation_space = gym.spaces.Discrete(2)

    def __init__(self, rewards, truncations) -> None:
        self.num_envs, self.rows = rewards.shape[1], zip(rewards, truncations, strict=True)

    def step(self, actions):
        rewards, truncations = next(self.rows)
        return None, rewards, np.zeros_like(truncations), truncations, {}


def recorded(ends: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return 10.0 * (rng.random((200, 4)) < 0.1), rng.random((200, 4)) < ends


def test_scaled_rewards_are_those_of_gymnasiums_normalize_reward():
    rewards, dones = recorded()
    wrapper = NormalizeReward(Recorded(rewards, dones), gamma=0.9)
    expected = [wrapper.step(None)[1].copy() for _ in range(200)]
    args = make_args(norm_reward=True, gamma=0.9)
    learner, scaled = Learner(args), rewards.copy()
    for part in (slice(0, 120), slice(120, 200)):  # the statistics go on from one rollout
        counts = np.ones_like(dones[part])
        learner.scale_rewards(args, scaled[part], dones[part], counts)
    np.testing.assert_allclose(scaled, expected, rtol=1e-6)  # Gymnasium sums in float32
    assert 0 < scaled.max() < 10


def test_resets_do_not_count_as_returns_of_0():
    rewards, dones = (x[:, :1].copy() for x in recorded(ends=0.3))
    counts = np.ones_like(dones)
    counts[1:] = ~dones[:-1]  # a reset follows each end
    rewards[~counts], dones[~counts] = 0, False
    counts[1:] = ~dones[:-1]
    args = make_args(norm_reward=True, num_envs=1, num_groups=1, num_steps=64)
    with_resets, without = Learner(args), Learner(args)
    kept = [x[counts][:, None].copy() for x in (rewards, dones, counts)]
    with_resets.scale_rewards(args, rewards, dones, counts)
    without.scale_rewards(args, *kept)
    np.testing.assert_array_equal(rewards[counts], kept[0][:, 0])
    assert not counts.all()


def test_rewards_are_logged_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(ppo_reg_coinrun, "make_env", lambda *_: Scripted([[3, 3, 5, 3]]))
    train(coinrun(tmp_path, norm_reward=True, total_timesteps=64, num_envs=1))
    assert read_metrics(tmp_path)[0]["charts/episodic_return"] == "10.0"


# --- evaluation ----------------------------------------------------------------------------------


def test_evaluation_is_on_disjoint_levels_and_only_when_it_is_due(tmp_path, monkeypatch):
    asked, made = [], []
    make_env = ppo_reg_coinrun.make_env

    def spy(args, num_envs, start_level):
        made.append(make_env(args, num_envs, start_level))
        return made[-1]

    def play(agent, env, seed, rng):
        torch.rand(3, generator=rng)
        asked.append((env.num_envs, env.make_engine.args[-1], seed))
        return {"success": np.array([len(asked) % 2, 0])}

    monkeypatch.setattr(ppo_reg_coinrun, "make_env", spy)
    monkeypatch.setattr(ppo_reg_coinrun, "play", play)
    changes = {"eval_interval": 2, "eval_envs": 2, "num_levels": 7, "start_level": 30}
    train(coinrun(tmp_path, **changes))
    rows = read_metrics(tmp_path)
    evaluated = [(row["eval/success_seen"], row["eval/success_unseen"]) for row in rows]
    assert evaluated == [("nan", "nan"), ("0.5", "0.0")] * 2 + [("nan", "nan")]
    assert [num_envs for num_envs, *_ in asked] == [2] * 4
    starts = [levels["start_level"] for _, levels, _ in asked]
    assert starts == [30, 37, 30, 37]
    assert {levels["num_levels"] for _, levels, _ in asked} == {7}
    assert len({seed for *_, seed in asked}) == 4


def test_where_levels_have_no_bound_none_is_unseen(tmp_path, monkeypatch):
    monkeypatch.setattr(
        ppo_reg_coinrun, "play", lambda *_: {"success": np.array([True])}
    )  # fmt: skip
    train(coinrun(tmp_path, num_levels=0, eval_interval=1, eval_envs=1, total_timesteps=64))
    row = read_metrics(tmp_path)[0]
    assert (row["eval/success_seen"], row["eval/success_unseen"]) == ("1.0", "nan")


def test_evaluation_changes_nothing_in_training(tmp_path):
    changes = {"total_timesteps": 128, "dropout": 0.1}
    plain = train(coinrun(tmp_path / "a", **changes))
    evaluated = train(coinrun(tmp_path / "b", **changes, eval_interval=2, eval_envs=1))
    assert torch.equal(weights(plain), weights(evaluated))
    assert float(read_metrics(tmp_path / "b")[1]["eval/success_seen"]) in (0.0, 1.0)


# --- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_groups": 3}, "num_groups must divide num_envs = 4, got 3"),
        ({"env_id": "mario"}, "env_id must be one of bigfish, .*, got 'mario'"),
        ({"num_minibatches": 7}, r"num_envs \* num_steps = 64 into parts of 2 or more, got 7"),
        ({"num_minibatches": 64}, "into parts of 2 or more, got 64"),
        ({"total_timesteps": 63}, r"must be at least num_envs \* num_steps = 64, got 63"),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), got 1.0"),
        ({"dropout": -0.1}, r"dropout must be in \[0, 1\), got -0.1"),
        ({"l2": -1e-4}, "l2 must be at least 0"),
        ({"l2": math.nan}, "l2 must be"),
        ({"num_levels": -1}, "num_levels must be at least 0, got -1"),
        ({"start_level": -1}, "start_level must be at least 0"),
        ({"gamma": math.nan}, r"gamma must be in \[0, 1\], got nan"),
        ({"clip_coef": 0.0}, "clip_coef must be finite and above 0"),
        ({"learning_rate": math.inf}, "learning_rate must be finite"),
        ({"coefficient": -1.0}, "coefficient must be finite and at least 0"),
        ({"lambda_min": 30.0}, "lambda_min=30.0"),
        ({"perturbation": "cube"}, "perturbation must be one of"),
        ({"probe_fraction": 0.0}, r"fraction must be in \(0, 1\], got 0.0"),
    ],
)
def test_bad_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        make_args(**changes)


@pytest.mark.parametrize("num_groups", [1, 2, 4])
def test_any_number_of_groups_trains(tmp_path, num_groups):
    train(coinrun(tmp_path, num_envs=4, num_groups=num_groups, num_steps=16, total_timesteps=128))
    rows = read_metrics(tmp_path)
    assert [int(row["global_step"]) for row in rows] == [64, 128]


def test_groups_play_different_levels():
    args = make_args(num_envs=8, num_levels=500, total_timesteps=128)
    envs, frames = ppo_reg_coinrun.make_envs(args, 0)
    assert (frames[0] != frames[1]).any()
    for env in envs:
        env.close()


def test_a_strong_penalty_brings_the_policy_into_range(tmp_path):
    psi = {}
    for coefficient in (0.0, 10.0):
        path = tmp_path / str(coefficient)
        train(coinrun(path, coefficient=coefficient, update_epochs=4, learning_rate=3e-3))
        rows = read_metrics(path)
        psi[coefficient] = [float(row["conditioning/psi"]) for row in rows]
    assert psi[10.0][-1] < psi[0.0][-1] / 2


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env-id", "mario"], "env_id must be one of bigfish"),
        (["--distribution-mode", "extreme"], "extreme"),
        (["--num-groups", "5"], "num_groups must divide num_envs = 32, got 5"),
        (["--probe-fraction", "2"], "fraction must be in (0, 1], got 2.0"),
        (["--backend", "procgen"], "error: backend procgen needs OpenAI's engine: pip install"),
    ],
)
def test_the_program_refuses_with_what_to_do(monkeypatch, capsys, tmp_path, flags, message):
    monkeypatch.setitem(sys.modules, "procgen", None)
    check_refusal(ppo_reg_coinrun, flags, message, monkeypatch, capsys, tmp_path)


def test_a_resumed_run_may_change_device_and_threads_alone(tmp_path):
    train(coinrun(tmp_path, device="cpu", total_timesteps=64))
    train(coinrun(tmp_path, device="auto", num_threads=1, total_timesteps=64, resume=True))
    for changes in ({"num_groups": 2, "num_envs": 2}, {"bf16": True}, {"backend": "procgen"}):
        with pytest.raises(ppo_reg_coinrun.RunError, match="was run with"):
            train(coinrun(tmp_path, **{"total_timesteps": 128, **changes}, resume=True))


# --- minutes -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"network": "impala", "dropout": 0.5, "l2": 1e-4}])
def test_compiled_losses_are_those_of_eager_code(tmp_path, changes):
    rows = []
    for name in ("eager", "compiled"):
        torch.compiler.reset()
        args = coinrun(
            tmp_path / name, num_envs=4, num_steps=32, num_minibatches=2, total_timesteps=256,
            coefficient=0.1, compile=name == "compiled", **changes,
        )  # fmt: skip
        learner = train(args)
        rows.append(read_metrics(args.path))
    assert learner.total_loss is not ppo_reg_coinrun.total_loss
    for eager, compiled in zip(*rows, strict=True):
        for column in ("policy_loss", "entropy", "value_loss", "approx_kl"):
            close = pytest.approx(float(eager[f"losses/{column}"]), rel=1e-3, abs=1e-4)
            assert float(compiled[f"losses/{column}"]) == close


@pytest.mark.slow
def test_it_learns(tmp_path):
    """Of three easy levels a random policy solves one in half of its episodes, the others never."""
    levels = {"num_levels": 3, "start_level": 6, "distribution_mode": "easy"}
    args = Args(
        **levels, num_steps=128, num_minibatches=4, update_epochs=2, total_timesteps=150_000,
        probe_fraction=0.01, eval_interval=0, run_dir=tmp_path,
    )  # fmt: skip

    def success_rate(agent: Agent) -> float:
        env = ppo_reg_coinrun.make_env(args, 48, args.start_level)
        found = play(agent, env, 0, seeded())
        env.close()
        return found["success"].mean()

    untrained = success_rate(Learner(args).agent)
    assert untrained < 0.25
    assert success_rate(train(args).agent) > untrained + 0.3


def test_adams_moments_follow_the_weights_memory_format(tmp_path):
    """A GPU keeps channels_last, and fused Adam pairs weights and moments in memory order."""
    learner = train(coinrun(tmp_path, total_timesteps=64))
    state = copy.deepcopy(learner.state_dict())
    for moments in state["optimizer"]["state"].values():
        if moments["exp_avg"].ndim == 4:
            for key in ("exp_avg", "exp_avg_sq"):
                moments[key] = moments[key].contiguous(memory_format=torch.channels_last)
    resumed = ppo_reg_coinrun.Learner(coinrun(tmp_path, total_timesteps=64))
    resumed.load_state_dict(state)
    for each in (learner, resumed):
        for weights_ in each.agent.parameters():
            weights_.grad = torch.ones_like(weights_)
        each.optimizer.step()
    assert torch.equal(weights(learner), weights(resumed))
