"""PPO on CoinRun: its mathematics, its networks, and the promises that its docstring makes."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import types

import numpy as np
import pytest
import torch
from torch import nn

from baselines import ppo_reg_coinrun
from baselines.ppo_reg_coinrun import (
    Agent,
    Args,
    DivergedError,
    Learner,
    Rollout,
    RunError,
    gae,
    play,
    rollout,
    total_loss,
    train,
    update,
)
from tests.baselines.helpers import (
    Scripted,
    check_refusal,
    coinrun,
    flat,
    read_metrics,
    weights,
    without_speed,
)

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
    learner.draw_masks()
    envs, frames = ppo_reg_coinrun.make_envs(args, 0)
    data = rollout(args, learner, envs, frames)
    for env in envs:
        env.close()
    return args, learner, data


def batch_of(data: Rollout) -> dict[str, torch.Tensor]:
    """The whole rollout as a minibatch, with advantages of its own."""
    return {
        "obs": data.obs.flatten(0, 1),
        "actions": data.actions.flatten(),
        "old_logprobs": data.logprobs.flatten(),
        "advantages": torch.randn(data.rewards.numel(), generator=seeded(1)),
        "targets": data.values.flatten() + 1,
    }


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
    assert data.lengths == [3, 2]
    assert data.returns == [10, 0]
    assert data.successes == [True, False]


class Cut(Scripted):
    """Its episodes are cut by a time limit."""

    def step_wait(self):
        frames, rewards, ends, cuts, info = super().step_wait()
        return frames, rewards, cuts, ends, info


def test_a_time_limit_is_an_end():
    args = make_args(num_envs=1, num_groups=1, num_steps=5, num_minibatches=1)
    learner = Learner(args)
    learner.agent = ShowsStep()
    envs = [Cut([[3]])]
    data = rollout(args, learner, envs, [envs[0].reset()[0]])
    assert data.dones.flatten().tolist() == [0, 0, 1, 0, 0]
    assert data.next_values.flatten().tolist() == [1, 2, 0, 0, 1]


def test_the_states_that_count_leave_out_the_resets():
    """psi is measured on them: the frame that a reset step saw is the last of an episode."""
    data = scripted_rollout([3, 2], [], num_steps=7)
    shown = data.states[:, 0, 0, 0]
    assert shown.tolist() == [0, 0, 1, 1, 2, 2, 3, 0, 4, 1, 5, 6]


def test_groups_change_nothing_but_the_order_of_waiting():
    lengths = [3, 2], [5, 1, 1], [], [4]
    whole, parts = (scripted_rollout(*lengths, num_steps=9, groups=n) for n in (1, 4))
    for name, column in whole._asdict().items():
        if isinstance(column, list):
            assert sorted(column) == sorted(getattr(parts, name)), name
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
        counts=None, returns=[], lengths=[], successes=[],
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


def seen_by_updates(data: Rollout, **changes) -> list[list[int]]:
    """Numbers of the steps in each minibatch of an update, [T · N], which log-probs carry."""
    seen = []
    steps, num_envs = data.counts.shape
    args = make_args(num_envs=num_envs, num_groups=1, num_steps=steps, **changes)
    learner = Learner(args)

    def spy(args, learner, clip_coef, obs, actions, old_logprobs, advantages, targets, delta):
        seen.append((-old_logprobs).int().tolist())
        return learner.agent.value.weight.sum(), torch.zeros(5)

    learner.total_loss = spy
    learner.update = 1
    numbers = -torch.arange(float(steps * num_envs)).view(steps, num_envs)
    update(args, learner, data._replace(logprobs=numbers))
    return seen


def empty_rollout(counts: torch.Tensor) -> Rollout:
    zeros = torch.zeros(counts.shape)
    return Rollout(
        obs=torch.zeros((*counts.shape, 3, 64, 64), dtype=torch.uint8), actions=zeros.long(),
        logprobs=zeros, rewards=zeros, dones=zeros, values=zeros, next_values=zeros, counts=counts,
        returns=[], lengths=[], successes=[],
    )  # fmt: skip


def test_an_epoch_holds_every_counting_step_and_no_other():
    counts = torch.rand(16, 12, generator=seeded()) > 0.1
    data = empty_rollout(counts)
    changes = {"num_minibatches": 4, "update_epochs": 2, "total_timesteps": 192}
    parts = seen_by_updates(data, **changes)
    assert [len(part) for part in parts] == [48] * 8
    counting = counts.flatten().nonzero().flatten().tolist()
    for epoch in (parts[:4], parts[4:]):
        order = torch.tensor(epoch).flatten()
        assert sorted(set(order.tolist())) == counting
        assert order.bincount(minlength=192).max() == 2  # as few come twice as can
    assert parts[:4] != parts[4:]
    assert parts[0] != sorted(parts[0])


def test_minibatches_are_whole_even_if_few_steps_count():
    counts = torch.zeros(4, 6, dtype=torch.bool)
    counts[1, 2:4] = True
    changes = {"num_minibatches": 3, "update_epochs": 1, "total_timesteps": 24}
    parts = seen_by_updates(empty_rollout(counts), **changes)
    assert [sorted(part) for part in parts] == [[8] * 4 + [9] * 4] * 3


@pytest.mark.parametrize("network", ["nature", "impala"])
@pytest.mark.parametrize("dropout", [0.0, 0.5])
def test_the_first_ratios_are_1(network, dropout):
    """Also under dropout, since rollout and update share a mask."""
    args, learner, data = real_rollout(network=network, dropout=dropout)
    batch = batch_of(data)
    logprobs, values = learner.agent(batch["obs"])
    taken = logprobs.gather(-1, batch["actions"][:, None])[:, 0]
    torch.testing.assert_close(taken, batch["old_logprobs"], atol=1e-5, rtol=0)
    torch.testing.assert_close(values, data.values.flatten(), atol=1e-4, rtol=1e-5)
    _, parts = total_loss(args, learner, torch.tensor(0.2), **batch)
    assert abs(parts[2]) < 1e-6  # the KL estimate
    assert parts[3] == 0  # clipped


def test_resets_reach_no_loss_and_no_log():
    """With the reset transitions' columns spoiled, the update is the same."""
    learners = []
    logs = []
    for spoiled in (0.0, 1e6):
        changes = {"num_minibatches": 1, "anneal": False, "probe_fraction": 1.0}
        args = make_args(num_envs=2, num_groups=1, num_steps=12, **changes)
        learner, envs = Learner(args), scripted([3, 2], [4, 1])
        data = rollout(args, learner, envs, [envs[0].reset()[0]])
        assert not data.counts.all()
        for column in (data.rewards, data.values, data.logprobs):
            column[~data.counts] += spoiled
        data.obs[~data.counts] += int(spoiled > 0) * 100
        learner.update = 25  # so that the gradient share is due
        logs.append(update(args, learner, data))
        learners.append(learner)
    assert torch.equal(*[flat(learner.agent) for learner in learners])
    assert logs[0] == logs[1]
    assert 0 < logs[0]["conditioning/gradient_share"] < 1


def test_each_rollout_has_masks_of_its_own(tmp_path):
    args = coinrun(tmp_path, dropout=0.5, total_timesteps=128)
    learner = train(args)
    again = Learner(args)
    masks = []
    for _ in range(2):
        again.draw_masks()
        masks.append(again.agent.network[-1].mask.clone())
    assert not torch.equal(*masks)
    assert torch.equal(learner.agent.network[-1].mask, masks[1])


# --- the loss ------------------------------------------------------------------------------------


def loss_of(args: Args, learner: Learner, batch: dict, **more) -> torch.Tensor:
    return total_loss(args, learner, torch.tensor(0.2), **batch, **more)[0].detach()


class Tiny(nn.Module):
    """Of a frame that shows x: logits (w · x, 0, ..., 0) and a value of v · x."""

    device = torch.device("cpu")

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.tensor(0.3))
        self.v = nn.Parameter(torch.tensor(2.0))

    def forward(self, frames):
        x = frames[:, 0, 0, 0].float()
        logits = torch.cat([(self.w * x)[:, None], torch.zeros(len(x), 14)], 1)
        return logits.log_softmax(-1), self.v * x

    def logprobs(self, frames):
        return self(frames)[0]


def tiny_rollout() -> Rollout:
    """Two environments of 3 steps; the second one's episode ends with its second step."""
    shown = torch.tensor([[1, 4], [2, 5], [3, 0]], dtype=torch.uint8)
    actions = torch.tensor([[0, 3], [7, 0], [0, 14]])
    logits = 0.3 * shown
    logprobs = torch.where(actions == 0, logits, 0.0) - (logits.exp() + 14).log()
    return Rollout(
        obs=shown[..., None, None, None].expand(3, 2, 3, 64, 64).contiguous(),
        actions=actions,
        logprobs=logprobs,
        rewards=torch.tensor([[1.0, -2.0], [0.5, 3.0], [0.0, 1.0]]),
        dones=torch.tensor([[0.0, 0.0], [0.0, 1.0], [0.0, 0.0]]),
        values=2.0 * shown,
        next_values=torch.tensor([[4.0, 10.0], [6.0, 0.0], [8.0, 5.0]]),
        counts=torch.ones(3, 2, dtype=torch.bool),
        returns=[],
        lengths=[],
        successes=[],
    )


def tiny_learner(args: Args) -> Learner:
    """It learns by plain gradient descent."""
    learner = Learner(args)
    learner.agent = Tiny()
    learner.optimizer = torch.optim.SGD(learner.agent.parameters(), args.learning_rate)
    return learner


TINY = {
    "num_envs": 2, "num_groups": 1, "num_steps": 3, "num_minibatches": 1, "update_epochs": 1,
    "total_timesteps": 6, "gamma": 0.9, "gae_lambda": 0.8, "ent_coef": 0.2, "vf_coef": 0.7,
    "learning_rate": 0.01, "max_grad_norm": 1e9, "coefficient": 0.0,
}  # fmt: skip


def tiny_advantages() -> np.ndarray:
    """In the order of the rollout's steps; d_t + 0.9 · 0.8 · A_{t+1}, but not over the end."""
    first = [1 + 0.9 * 4 - 2, 0.5 + 0.9 * 6 - 4, 0 + 0.9 * 8 - 6]
    second = [-2 + 0.9 * 10 - 8, 3 + 0.9 * 0 - 10, 1 + 0.9 * 5 - 0]
    first[1] += 0.72 * first[2]
    first[0] += 0.72 * first[1]
    second[0] += 0.72 * second[1]
    return np.array([first, second]).T.flatten()


def tiny_gradients() -> tuple[float, float]:
    """Of the loss in w and v, in float64 by the derivatives written out."""
    raw = tiny_advantages()
    adv = (raw - raw.mean()) / raw.std(ddof=1)
    x = np.array([1.0, 4.0, 2.0, 5.0, 3.0, 0.0])
    chose_0 = np.array([1.0, 0.0, 0.0, 1.0, 1.0, 0.0])
    p = np.exp(0.3 * x) / (np.exp(0.3 * x) + 14)
    q = (1 - p) / 14

    # the ratios are 1, so that d ratio / dw = d log pi / dw
    policy = -(adv * x * (chose_0 - p)).mean()
    # H = -p log p - 14 q log q, so that dH / dp = log q - log p; and dp / dw = x p (1 - p)
    entropy = ((np.log(q) - np.log(p)) * x * p * (1 - p)).mean()
    # half the squared error of v · x from the target 2 · x + A
    value = ((2 * x - (2 * x + raw)) * x).mean()
    return policy - 0.2 * entropy, 0.7 * value


def test_one_update_by_hand():
    learner = tiny_learner(make_args(**TINY))
    learner.update = 1
    logs = update(make_args(**TINY), learner, tiny_rollout())
    w_gradient, v_gradient = tiny_gradients()
    assert learner.agent.w.item() == pytest.approx(0.3 - 0.01 * w_gradient, rel=1e-5)
    assert learner.agent.v.item() == pytest.approx(2.0 - 0.01 * v_gradient, rel=1e-5)

    raw = tiny_advantages()
    x = np.array([1.0, 4.0, 2.0, 5.0, 3.0, 0.0])
    explained = 1 - raw.var() / (2 * x + raw).var()
    assert logs["losses/value_loss"] == pytest.approx((raw**2).mean() / 2, rel=1e-5)
    assert logs["losses/explained_variance"] == pytest.approx(explained, rel=1e-4)
    assert logs["losses/policy_loss"] == pytest.approx(0.0, abs=1e-6)
    assert logs["charts/learning_rate"] == 0.01


def test_the_gradient_is_clipped_to_the_given_length():
    args = make_args(**{**TINY, "max_grad_norm": 0.25, "learning_rate": 1.0})
    learner = tiny_learner(args)
    learner.update = 1
    update(args, learner, tiny_rollout())
    w_gradient, v_gradient = tiny_gradients()
    length = math.hypot(w_gradient, v_gradient)
    assert length > 0.25
    assert learner.agent.w.item() == pytest.approx(0.3 - 0.25 * w_gradient / length, rel=1e-4)
    assert learner.agent.v.item() == pytest.approx(2.0 - 0.25 * v_gradient / length, rel=1e-4)


class SlopeOf3:
    """Stands in for a penalty: 3 · w."""

    coefficient = 1.0

    def __call__(self, policy, obs):
        self.obs = obs
        return types.SimpleNamespace(penalty=3 * policy.__self__.w)


@pytest.mark.parametrize("number", [24, 25])
def test_the_gradient_share_compares_the_penalty_with_the_whole_rest(number):
    args = make_args(**{**TINY, "probe_fraction": 1.0, "anneal": False})
    learner = tiny_learner(args)
    learner.probe.own = SlopeOf3()
    learner.update = number
    share = update(args, learner, tiny_rollout())["conditioning/gradient_share"]
    if number == 24:
        assert math.isnan(share)
    else:
        assert share == pytest.approx(3 / math.hypot(*tiny_gradients()), rel=1e-4)
        assert learner.probe.own.obs[:, 0, 0, 0].tolist() == [1, 4, 2, 5, 3, 0]


def test_without_a_penalty_its_gradient_share_is_0():
    learner = tiny_learner(make_args(**TINY))
    learner.update = 25
    logs = update(make_args(**TINY, anneal=False), learner, tiny_rollout())
    assert logs["conditioning/gradient_share"] == 0.0


def test_the_loss_in_float64_by_the_papers_formula():
    args, learner, data = real_rollout(vf_coef=0.7, ent_coef=0.03)
    batch = batch_of(data)
    batch["old_logprobs"] += 0.3 * batch["advantages"]
    loss, parts = total_loss(args, learner, torch.tensor(0.2), **batch)

    logprobs, values = (x.detach().double() for x in learner.agent(batch["obs"]))
    adv = batch["advantages"].double()
    adv = (adv - adv.mean()) / adv.std()
    taken = logprobs[torch.arange(64), batch["actions"]]
    ratio = (taken - batch["old_logprobs"].double()).exp()
    clip = -torch.min(adv * ratio, adv * ratio.clamp(0.8, 1.2)).mean()
    entropy = torch.distributions.Categorical(logits=logprobs).entropy().mean()
    value = 0.5 * ((values - batch["targets"].double()) ** 2).mean()
    clipped = ((ratio - 1).abs() > 0.2).double().mean()
    expected = torch.stack([clip, entropy, (ratio - 1 - ratio.log()).mean(), clipped, value])
    assert 0 < clipped < 1
    torch.testing.assert_close(parts.double(), expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(loss.double(), clip + 0.7 * value - 0.03 * entropy)


def test_l2_is_half_the_squared_weights_without_biases():
    args, learner, data = real_rollout()
    batch, agent = batch_of(data), learner.agent
    for name, p in agent.named_parameters():
        if name.endswith("bias"):
            nn.init.ones_(p)  # their squares would make up a third
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
    delta = learner.regularizer.sample_delta(batch["obs"])
    penalty = learner.regularizer(learner.agent.logprobs, batch["obs"], delta=delta).penalty
    added = loss_of(args, learner, batch, delta=delta) - loss_of(args, learner, batch)
    assert penalty > 0
    torch.testing.assert_close(added, penalty, atol=1e-5, rtol=1e-4)


def test_the_printed_sign_subtracts_the_penalty():
    added = []
    for printed_sign in (False, True):
        args, learner, data = real_rollout(coefficient=0.3, printed_sign=printed_sign)
        batch = batch_of(data)
        delta = learner.regularizer.sample_delta(batch["obs"])
        added.append(loss_of(args, learner, batch, delta=delta) - loss_of(args, learner, batch))
    assert added[0] > 0.1
    torch.testing.assert_close(added[1], -added[0])


def test_one_quotient_for_the_minibatch_is_penalized_as_one():
    """J of the batch is a root mean square of the states', since all deltas have length 1."""
    args, learner, data = real_rollout(coefficient=1.0, reduction="batch", lambda_min=2.0)
    nn.init.normal_(learner.agent.policy.weight, std=0.01, generator=seeded())
    batch = batch_of(data)
    delta = learner.regularizer.sample_delta(batch["obs"])
    with torch.no_grad():
        moved = learner.agent.logprobs(batch["obs"] + 255 * delta)
        moved = moved - learner.agent.logprobs(batch["obs"])
    quotient = moved.square().sum(-1).mean().sqrt()
    expected = (quotient.clamp(max=2.0) - 2.0).square()
    added = loss_of(args, learner, batch, delta=delta) - loss_of(args, learner, batch)
    assert expected > 0
    torch.testing.assert_close(added, expected, atol=1e-4, rtol=1e-3)


def test_in_bfloat16_the_loss_is_finite_and_the_penalty_that_of_float32():
    args, learner, data = real_rollout(coefficient=1.0)
    nn.init.normal_(learner.agent.policy.weight, generator=seeded())  # a policy that reacts
    batch = batch_of(data)
    delta = learner.regularizer.sample_delta(batch["obs"])
    half = dataclasses.replace(args, bf16=True)
    penalties = []
    for precision in (args, half):
        with_penalty = loss_of(precision, learner, batch, delta=delta)
        without = loss_of(precision, learner, batch)
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


# --- schedules -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "left"),
    [
        ({}, [1.0, 0.8, 0.6, 0.4, 0.2]),
        ({"anneal_timesteps": 640}, [1.0, 0.9, 0.8, 0.7, 0.6]),
        ({"anneal_timesteps": 320}, [1.0, 0.8, 0.6, 0.4, 0.2]),
        ({"anneal": False}, [1.0] * 5),
        ({"anneal": False, "anneal_timesteps": 640}, [1.0] * 5),
    ],
)
def test_the_step_size_and_the_clip_range_fall_linearly(tmp_path, monkeypatch, changes, left):
    seen = []
    loss = ppo_reg_coinrun.total_loss

    def spy(args, learner, clip_coef, *columns):
        seen.append((learner.optimizer.param_groups[0]["lr"], clip_coef.item()))
        return loss(args, learner, clip_coef, *columns)

    monkeypatch.setattr(ppo_reg_coinrun, "total_loss", spy)
    train(coinrun(tmp_path, learning_rate=1e-3, update_epochs=1, num_minibatches=1, **changes))
    expected = [(1e-3 * x, 0.2 * x) for x in left]
    assert np.array(seen) == pytest.approx(np.array(expected))
    logged = [float(row["charts/learning_rate"]) for row in read_metrics(tmp_path)]
    assert logged == pytest.approx([rate for rate, _ in expected])


def test_lee_et_als_step_size_stands_at_80_percent_at_50_million_steps():
    args = Args(anneal_timesteps=256_000_000)
    learner = Learner(args)
    learner.update = args.num_updates
    counts = torch.ones(4, 2, dtype=torch.bool)
    learner.total_loss = lambda *_: (learner.agent.value.weight.sum(), torch.zeros(5))
    logs = update(dataclasses.replace(args, coefficient=0.0), learner, empty_rollout(counts))
    assert logs["charts/learning_rate"] == pytest.approx(5e-4 * (1 - 50 / 256), rel=1e-3)


# --- what is logged ------------------------------------------------------------------------------


def test_rows_count_the_episodes_that_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(ppo_reg_coinrun, "make_env", lambda *_: Scripted([[3, 2, 90]]))
    train(coinrun(tmp_path, total_timesteps=128))
    names = ("episodes", "episodic_return", "episodic_length", "success_rate")
    rows = [[row[f"charts/{name}"] for name in names] for row in read_metrics(tmp_path)]
    assert rows == [["2", "5.0", "2.5", "0.5"], ["1", "0.0", "90.0", "0.0"]]


@pytest.mark.parametrize("own", [{}, {"lambda_min": 0.0, "radius": 0.5}])
def test_psi_is_measured_by_the_yardstick_on_the_steps_that_count(tmp_path, monkeypatch, own):
    """J and psi of the final weights on these states, computed here from the probe's own noise."""
    monkeypatch.setattr(ppo_reg_coinrun, "make_env", lambda *_: Scripted([[3, 2, 90]]))
    args = coinrun(tmp_path, total_timesteps=64, probe_fraction=1.0, **own)
    learner = train(args)
    shown = [0, 1, 2, 0, 1, *range(57)]  # without the frames that the two resets saw
    states = torch.tensor(shown, dtype=torch.uint8).view(-1, 1, 1, 1).expand(-1, 3, 64, 64)
    rng = Learner(args).probe.yardstick.generator
    noise = torch.randn(len(states), 3 * 64 * 64, generator=rng)
    delta = (noise / noise.norm(dim=-1, keepdim=True)).view(-1, 3, 64, 64)
    with torch.no_grad():
        before = learner.agent.logprobs(states)
        quotient = (learner.agent.logprobs(states + 255 * delta) - before).norm(dim=-1)

    row = {name: float(x) for name, x in read_metrics(tmp_path)[0].items()}
    assert row["global_step"] == 62
    assert (quotient < 1).all()
    expected = {
        "psi": (1 - quotient).square().mean(),
        "quotient_q05": quotient.quantile(0.05),
        "quotient_q50": quotient.quantile(0.5),
        "quotient_q95": quotient.quantile(0.95),
        "quotient_squared": quotient.square().mean(),
    }
    for name, value in expected.items():
        rel = 1e-6 if name == "psi" else 1e-3
        assert row[f"conditioning/{name}"] == pytest.approx(value.item(), rel=rel), name
    assert row["conditioning/fraction_below"] == 1.0
    assert row["conditioning/own_psi"] == (0.0 if own else row["conditioning/psi"])


def test_psi_is_measured_on_a_fraction_of_the_states(tmp_path, monkeypatch):
    args = coinrun(tmp_path, total_timesteps=64, probe_fraction=0.25)
    learner = Learner(args)
    measured = []

    def policy(obs):
        measured.append(len(obs))
        return obs.flatten(1)[:, :15]

    learner.probe.measure(1, policy, torch.zeros(64, 3, 64, 64, dtype=torch.uint8))
    assert set(measured) <= {16, 32}  # S and S + delta, apart or together


def test_log_spectrum_logs_what_j_squared_tends_to(tmp_path):
    """E[J²] = ‖Jacobian‖_F² / n for small delta, which a length of 1 over 12,288 pixels is."""
    train(coinrun(tmp_path, total_timesteps=128, log_spectrum=2, probe_fraction=1.0))
    names = ("frobenius_squared_per_input", "singular_value_max", "singular_value_mean")
    first, second = (
        [float(row[f"conditioning/{name}"]) for name in (*names, "quotient_squared")]
        for row in read_metrics(tmp_path)
    )
    assert all(math.isnan(x) for x in first[:3])
    assert second[0] == pytest.approx(second[3], rel=0.3)
    assert 0 < second[2] < second[1]


# --- outcomes ------------------------------------------------------------------------------------


def break_weights(monkeypatch, at_update: int) -> None:
    """Let the weights become infinite in this update."""

    def spoil(args, learner, data):
        losses = update(args, learner, data)
        if learner.update == at_update:
            learner.agent.value.bias.data.fill_(math.inf)
        return losses

    monkeypatch.setattr(ppo_reg_coinrun, "update", spoil)


def test_a_run_that_diverges_says_so_and_keeps_its_last_checkpoint(tmp_path, monkeypatch):
    break_weights(monkeypatch, at_update=4)
    with pytest.raises(DivergedError, match="the loss became non-finite in update 4"):
        train(coinrun(tmp_path, checkpoint_interval=2))
    said = json.loads((tmp_path / "diverged.json").read_text())
    message = "the loss became non-finite in update 4"
    assert said == {"update": 4, "what": "loss", "message": message}
    assert len(read_metrics(tmp_path)) == 3
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["learner"]
    assert saved["update"] == 2
    assert all(x.isfinite().all() for x in saved["agent"].values())


def test_a_reward_that_is_not_finite_is_an_outcome(tmp_path, monkeypatch):
    def broken(*args):
        data = rollout(*args)
        data.rewards[5] = math.nan
        return data

    monkeypatch.setattr(ppo_reg_coinrun, "rollout", broken)
    with pytest.raises(DivergedError, match="the reward became non-finite in update 1"):
        train(coinrun(tmp_path))


def test_the_program_ends_with_3_where_a_run_diverged(tmp_path, monkeypatch, capsys):
    break_weights(monkeypatch, at_update=1)
    flags = ["--num-envs=1", "--num-groups=1", "--num-steps=64", "--total-timesteps=64"]
    monkeypatch.setattr("sys.argv", ["ppo_reg_coinrun.py", *flags, f"--run-dir={tmp_path}"])
    with pytest.raises(SystemExit) as stopped:
        ppo_reg_coinrun.main()
    assert stopped.value.code == 3
    assert "the loss became non-finite in update 1" in capsys.readouterr().out


@pytest.mark.parametrize("changes", [{"anneal": False}, {"anneal_timesteps": 6400}])
def test_an_extended_run_is_the_longer_run_bit_for_bit(tmp_path, changes):
    settings = {"checkpoint_interval": 2, "dropout": 0.2, **changes}
    longer = train(coinrun(tmp_path / "longer", total_timesteps=384, **settings))
    train(coinrun(tmp_path / "extended", total_timesteps=256, **settings))
    settings.update(resume=True, extend=True)
    extended = train(coinrun(tmp_path / "extended", total_timesteps=384, **settings))
    assert torch.equal(weights(extended), weights(longer))
    assert without_speed(tmp_path / "extended") == without_speed(tmp_path / "longer")


@pytest.mark.parametrize(
    ("begun", "changes", "message"),
    [
        ({"anneal": False}, {}, "was run with total_timesteps=64, not 128"),
        ({"anneal": False, "checkpoint_interval": 2}, {"extend": True},
         "its 1 updates are not a multiple of checkpoint_interval=2"),
    ],
)  # fmt: skip
def test_what_cannot_be_extended_is_refused(tmp_path, begun, changes, message):
    begun = {"checkpoint_interval": 1, **begun}
    train(coinrun(tmp_path, total_timesteps=64, **begun))
    with pytest.raises(RunError, match=message):
        train(coinrun(tmp_path, total_timesteps=128, resume=True, **begun, **changes))


# --- evaluation ----------------------------------------------------------------------------------


def test_evaluation_is_on_disjoint_levels_and_only_when_it_is_due(tmp_path, monkeypatch):
    asked, made = [], []
    make_env = ppo_reg_coinrun.make_env

    def spy(args, num_envs, start_level):
        made.append(make_env(args, num_envs, start_level))
        return made[-1]

    def play(agent, env, seed, rng):
        torch.rand(3, generator=rng)
        asked.append((env.num_envs, env.options, seed))
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


def test_of_an_unlimited_set_no_level_is_unseen(tmp_path, monkeypatch):
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


# Lee et al. (2020) beside what the paper says of the penalty, and what is ours
DEFAULTS = {
    "env_id": "coinrun", "seed": 1, "agent": 0, "total_timesteps": 50_000_000, "num_levels": 500,
    "start_level": 0, "distribution_mode": "hard", "paint_vel_info": True, "restrict_themes": False,
    "num_envs": 32, "num_groups": 2, "num_threads": 0, "num_steps": 256, "num_minibatches": 8,
    "update_epochs": 3, "learning_rate": 5e-4, "anneal": True, "anneal_timesteps": 0,
    "gamma": 0.999, "gae_lambda": 0.95, "clip_coef": 0.2, "ent_coef": 0.01, "vf_coef": 0.5,
    "max_grad_norm": 0.5, "network": "nature", "l2": 0.0, "dropout": 0.0, "eval_dropout": False,
    "eval_interval": 100, "eval_envs": 64, "device": "auto", "bf16": False, "compile": False,
    "run_dir": None, "resume": False, "extend": False, "checkpoint_interval": 50, "track": False,
    "coefficient": 1e-3, "lambda_min": 1.0, "lambda_max": 20.0, "reduction": "sample",
    "perturbation": "sphere", "radius": 1.0, "printed_sign": False, "probe_fraction": 0.125,
    "log_spectrum": 0,
}  # fmt: skip


def test_the_defaults_are_lee_et_als():
    assert dataclasses.asdict(Args()) == DEFAULTS


def test_adam_is_lee_et_als():
    (group,) = Learner(Args()).optimizer.param_groups
    assert (group["eps"], group["betas"], group["weight_decay"]) == (1e-5, (0.9, 0.999), 0)


def test_help_names_every_flag_and_no_marker(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["ppo_reg_coinrun.py", "--help"])
    with pytest.raises(SystemExit):
        ppo_reg_coinrun.main()
    said = capsys.readouterr().out
    assert "# condwrap" not in said
    missing = {name for name in DEFAULTS if "--" + name.replace("_", "-") not in said}
    assert not missing


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_groups": 3}, "num_groups must divide num_envs = 4, got 3"),
        ({"env_id": "mario"}, "env_id must be one of bigfish, .*, got 'mario'"),
        ({"num_minibatches": 7}, r"num_envs \* num_steps = 64 into parts of 2 or more, got 7"),
        ({"num_minibatches": 64}, "into parts of 2 or more, got 64"),
        ({"total_timesteps": 63}, r"must be at least num_envs \* num_steps = 64, got 63"),
        ({"extend": True}, "extend must be False, .* anneals over its own length depends on it"),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), got 1.0"),
        ({"dropout": -0.1}, r"dropout must be in \[0, 1\), got -0.1"),
        ({"l2": -1e-4}, "l2 must be at least 0"),
        ({"l2": math.nan}, "l2 must be"),
        ({"anneal_timesteps": 63}, "must be 0 or at least total_timesteps = 64, got 63"),
        ({"anneal_timesteps": -1}, "anneal_timesteps must be at least 0, got -1"),
        ({"distribution_mode": "extreme"}, "must be easy or hard, got 'extreme'"),
        ({"num_threads": -2}, "num_threads must be at least 0, got -2"),
        ({"reduction": "mean"}, "reduction must be"),
        ({"log_spectrum": -1}, "log_spectrum must be at least 0"),
        ({"num_levels": -1}, "num_levels must be at least 0, got -1"),
        ({"start_level": -1}, "start_level must be at least 0"),
        ({"gamma": math.nan}, r"gamma must be in \[0, 1\], got nan"),
        ({"clip_coef": 0.0}, "clip_coef must be finite and above 0"),
        ({"learning_rate": math.inf}, "learning_rate must be finite"),
        ({"coefficient": -1.0}, "coefficient must be finite and at least 0"),
        ({"lambda_min": 30.0}, "lambda_min=30.0"),
        ({"perturbation": "cube"}, "perturbation must be one of"),
        ({"probe_fraction": 0.0}, r"probe_fraction must be in \(0, 1\], got 0.0"),
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


def test_environments_are_rebuilt_with_other_seeds_at_each_checkpoint(tmp_path, monkeypatch):
    seeds = []
    reset = ppo_reg_coinrun.Procgen.reset

    def spy(env, seed):
        seeds.append(seed)
        return reset(env, seed=seed)

    monkeypatch.setattr(ppo_reg_coinrun.Procgen, "reset", spy)
    args = coinrun(tmp_path, checkpoint_interval=2)
    train(args)
    assert seeds == [ppo_reg_coinrun.env_seeds(args, checkpoint)[0] for checkpoint in range(3)]
    assert len(set(seeds)) == 3


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
        (["--extend", "--anneal-timesteps", "5"], "anneal_timesteps must be 0 or at least"),
    ],
)
def test_the_program_refuses_with_what_to_do(monkeypatch, capsys, tmp_path, flags, message):
    check_refusal(ppo_reg_coinrun, flags, message, monkeypatch, capsys, tmp_path)


def test_a_resumed_run_may_change_device_and_threads_alone(tmp_path):
    train(coinrun(tmp_path, device="cpu", total_timesteps=64))
    train(coinrun(tmp_path, device="auto", num_threads=1, total_timesteps=64, resume=True))
    for changes in ({"num_groups": 2, "num_envs": 2}, {"bf16": True}, {"dropout": 0.1}):
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


def test_weights_are_checked_in_any_memory_format():
    learner = Learner(make_args())
    before = learner.weights
    learner.agent.to(memory_format=torch.channels_last)
    assert torch.equal(learner.weights, before)
