"""CoinRun on the CPU: a rollout and its update, against the same algorithm written plainly.

The peer is CleanRL's method: one group of environments stepped synchronously, tensors copied by
PyTorch, default memory format, Adam as it comes.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Categorical

from baselines import ppo_reg_coinrun as ours

pytestmark = pytest.mark.slow

pytest.importorskip("envpool")
SMALL = {"num_envs": 32, "num_steps": 64, "num_minibatches": 2, "update_epochs": 1}
SMALL |= {"total_timesteps": 10_000_000, "eval_interval": 0}


class Plain:
    """PPO on CoinRun as a person would first write it."""

    def __init__(self, args: ours.Args) -> None:
        self.args = args
        self.agent = ours.Agent(args, torch.Generator().manual_seed(1))
        self.agent.forward = self.forward
        self.optimizer = torch.optim.Adam(self.agent.parameters(), args.learning_rate, eps=1e-5)
        self.env = ours.make_env(args, args.num_envs, args.start_level)
        self.obs = torch.tensor(self.env.reset(seed=1)[0])

    def forward(self, frames):
        hidden = self.agent.network(frames.float() / 255)
        return self.agent.policy(hidden), self.agent.value(hidden).squeeze(-1)

    def iterate(self) -> None:
        args, agent = self.args, self.agent
        shape = (args.num_steps, args.num_envs)
        obs = torch.zeros((*shape, 3, 64, 64), dtype=torch.uint8)
        actions, logprobs, rewards, dones, values = (torch.zeros(shape) for _ in range(5))
        for t in range(args.num_steps):
            obs[t] = self.obs
            with torch.no_grad():
                logits, values[t] = agent(self.obs)
                policy = Categorical(logits=logits)
                actions[t] = policy.sample()
                logprobs[t] = policy.log_prob(actions[t])
            frames, reward, ended, cut, _ = self.env.step(actions[t].numpy().astype(int))
            self.obs, rewards[t] = torch.tensor(frames), torch.tensor(reward)
            dones[t] = torch.tensor(np.logical_or(ended, cut), dtype=torch.float32)
        with torch.no_grad():
            next_value = agent(self.obs)[1]
        advantages, advantage = torch.zeros(shape), 0
        for t in reversed(range(args.num_steps)):
            error = rewards[t] + args.gamma * next_value * (1 - dones[t]) - values[t]
            advantage = error + args.gamma * args.gae_lambda * (1 - dones[t]) * advantage
            advantages[t], next_value = advantage, values[t]
        columns = (obs, actions, logprobs, advantages, advantages + values)
        obs, actions, logprobs, advantages, targets = (x.flatten(0, 1) for x in columns)
        for i in torch.randperm(len(obs)).split(len(obs) // args.num_minibatches):
            logits, value = agent(obs[i])
            policy = Categorical(logits=logits)
            ratio = (policy.log_prob(actions[i]) - logprobs[i]).exp()
            gain = (advantages[i] - advantages[i].mean()) / (advantages[i].std() + 1e-8)
            clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
            loss = -torch.min(gain * ratio, gain * clipped).mean()
            loss = loss + args.vf_coef * 0.5 * (value - targets[i]).square().mean()
            loss = loss - args.ent_coef * policy.entropy().mean()
            self.optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            self.optimizer.step()


class Ours:
    """The baseline's own rollout and update."""

    def __init__(self, args: ours.Args) -> None:
        self.args, self.learner = args, ours.Learner(args)
        self.envs, self.frames = ours.make_envs(args, 0)

    def iterate(self) -> None:
        data = ours.rollout(self.args, self.learner, self.envs, self.frames)
        self.learner.update += 1
        losses = ours.update(self.args, self.learner, data)
        assert math.isfinite(losses["losses/value_loss"])


KINDS = {
    "peer: plain": (Plain, {"coefficient": 0.0}),
    "ours": (Ours, {"coefficient": 0.0}),
    "ours, with the penalty": (Ours, {}),
    "ours, one group": (Ours, {"coefficient": 0.0, "num_groups": 1}),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("network", ["nature", "impala"])
@pytest.mark.parametrize("threads", [1, 2])
def test_coinrun(benchmark, threads, network, kind):
    benchmark.group = f"CoinRun PPO, {network}, {threads} threads, 2048 steps"
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    benchmark.extra_info.update(
        {"peer": True} if kind.startswith("peer") else {"goal": 1}, steps=2048
    )
    maker, changes = KINDS[kind]
    loop = maker(ours.Args(**SMALL, network=network, **changes))
    rounds = 3 if network == "nature" else 1
    benchmark.pedantic(loop.iterate, rounds=rounds, warmup_rounds=1)
    torch.set_num_threads(before)
