"""The Q that the robust Sarsa attack descends, learnt from an agent's own episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from condwrap.attacks import Transitions, fit_action_value
from harness.evaluation.checkpoint import Checkpoint
from harness.evaluation.control import Episode, make_env

STREAM = 0x73617273  # "sars"; these episodes are none of the evaluation's
EPISODES = 10
UPDATES = 2000
NEAR = 0.05  # of the actions' range, in which Q is to change little (Zhang et al., 2020, 3.5)


class ActionValue(nn.Module):
    """Q(s, a), a network of the size of the agent's critic."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, obs: Tensor, actions: Tensor) -> Tensor:
        return self.net(torch.cat([obs, actions], -1))


def learn_action_value(checkpoint: Checkpoint, learner: Any) -> ActionValue:
    """Q of the policy, from episodes with sampled actions; the largest return counts as 1.

    The actions are those that the policy gives. Their clipping is a part of the task, so Q learns
    that it makes no difference how far beyond its box an action is.
    """
    args = checkpoint.args
    episodes = [play(checkpoint, learner, number) for number in range(EPISODES)]
    largest = max(abs(discounted(part.rewards, args.gamma)).max() for part in episodes)
    fields = [field.name for field in dataclasses.fields(Transitions)]
    data = Transitions(**{x: torch.cat([getattr(part, x) for part in episodes]) for x in fields})
    scaled = dataclasses.replace(data, rewards=data.rewards / max(largest, 1e-8))
    reach = float((data.actions.amax(0) - data.actions.amin(0)).max())

    rng = torch.Generator().manual_seed(_seeds(args, EPISODES)[0])
    inputs = data.obs.shape[1] + data.actions.shape[1]
    q = ActionValue(checkpoint.module.make_mlp(args, inputs, 1, 1.0, rng))
    fit_action_value(
        q, scaled, gamma=args.gamma, action_radius=NEAR * reach, updates=UPDATES, generator=rng
    )
    return q


@torch.no_grad()
def play(checkpoint: Checkpoint, learner: Any, number: int) -> Transitions:
    """The steps of one episode with sampled actions; at its last state there is an action too."""
    env_seed, noise_seed = _seeds(checkpoint.args, number)
    noise = torch.Generator().manual_seed(noise_seed)
    env = make_env(checkpoint.module, checkpoint.args, learner.stats)
    observations: list[Tensor] = []
    actions: list[Tensor] = []
    try:
        episode = Episode(env, env_seed)
        while True:
            obs = torch.as_tensor(episode.obs, dtype=torch.float32)
            policy = learner.actor(obs)
            action = policy.mean + policy.stddev * torch.randn(policy.mean.shape, generator=noise)
            observations.append(obs)
            actions.append(action)
            if episode.over:
                break
            episode.step(action)
    finally:
        env.close()

    ends = torch.zeros(len(episode.rewards), dtype=torch.bool)
    ends[-1] = episode.terminated
    return Transitions(
        obs=torch.cat(observations[:-1]),
        actions=torch.cat(actions[:-1]),
        rewards=torch.tensor(episode.rewards),
        next_obs=torch.cat(observations[1:]),
        next_actions=torch.cat(actions[1:]),
        terminations=ends,
    )


def discounted(rewards: Tensor, gamma: float) -> np.ndarray:
    """The discounted sum of the rewards from each step on."""
    sums = np.zeros(len(rewards) + 1)
    for t in reversed(range(len(rewards))):
        sums[t] = float(rewards[t]) + gamma * sums[t + 1]
    return sums[:-1]


def _seeds(args: Any, number: int) -> list[int]:
    """Of an episode's start, and of its action noise."""
    sequence = np.random.SeedSequence((args.seed, args.agent), spawn_key=(STREAM, number))
    return sequence.generate_state(2).tolist()
