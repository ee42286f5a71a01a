"""PPO with the conditioning penalty for N agents at once, each as ppo_reg.py would train it.

    python ppo_reg_population.py --env-id HopperBulletEnv-v0 --seed 1 --num-agents 10

Agent i has the initial weights, seeds, noise, statistics and files of `ppo_reg.py --agent i`, and
either program resumes the other's runs. Stacked is the arithmetic: one call acts for all agents,
one updates all. Live runs of the two part in time, as the last bit of an action moves the physics.

Lines marked so are the penalty (Asadulaev et al., arXiv 1906.05437):  # condwrap
Needs ppo_reg.py and population.py, beside this file or in the package `baselines`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

if __package__:
    from baselines import population, ppo_reg
else:  # run as a file, the others beside it
    import population
    import ppo_reg


@dataclasses.dataclass(frozen=True)
class Args(population.PopulationArgs, ppo_reg.Args):
    """Those of ppo_reg.py, and the number of agents."""

    single = ppo_reg


class Batch(NamedTuple):
    """What an update learns from, all of it `[N, B, ...]` or a minibatch."""

    obs: Tensor
    actions: Tensor
    logprobs: Tensor  # of the actions, under the policy that took them
    advantages: Tensor
    targets: Tensor  # of the critic


def minibatches(batch: Batch, order: Tensor) -> Batch:
    """An epoch: `[minibatches, N, b, ...]`, advantages normalized."""
    epoch = Batch(*[x.flatten(0, 1)[order] for x in batch])
    std, mean = torch.std_mean(epoch.advantages, -1, keepdim=True)
    return epoch._replace(advantages=(epoch.advantages - mean) / (std + 1e-8))


def policy_step(
    args: Args, actor: population.AdamStack, part: Batch, delta: Tensor | None
) -> tuple[Tensor, Tensor]:
    """One step down each agent's loss, the single file's; the log-ratios and log-stds before it.

    Of -min(A r, A clip(r)) the slope in log r is -A r where that is the smaller one, else 0.
    """
    (log_std, *layers), states, size = actor.leaves, part.obs, part.obs.shape[1]
    if delta is not None:  # condwrap
        states = torch.cat([states, states + delta], 1)  # condwrap
    *inputs, output = population.forward(layers, states, args.activation)
    logprob, scaled = population.log_prob(output[:, :size], log_std, part.actions)
    logratio = logprob - part.logprobs
    ratio = logratio.exp()
    gains = part.advantages * ratio
    unclipped = gains <= part.advantages * ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    slopes = (gains * unclipped * (-1 / size))[..., None]
    grad = slopes * scaled * (-log_std).exp()[:, None]
    torch.sum(slopes * (scaled.square() - 1), 1, out=actor.gradients[0]).sub_(args.ent_coef)
    if delta is not None:  # condwrap
        slope = population.penalty_slope(args, output, delta)  # condwrap
        grad = torch.cat([grad + slope, -slope], 1)  # condwrap
    before = logratio, log_std.clone()
    population.backward(actor, inputs, grad, args.activation)
    actor.step(args.max_grad_norm)
    return before


def policy_logs(args: Args, advantages: Tensor, seen: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Loss, entropy, KL estimate and share of clipped samples in an epoch: `[4, N]`."""
    logratio, log_std = (torch.stack(x) for x in zip(*seen, strict=True))
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    losses = -torch.min(advantages * ratio, advantages * clipped)
    entropies = (0.5 + 0.5 * math.log(2 * math.pi) + log_std).sum(-1, keepdim=True)
    logs = (losses, entropies, ratio - 1 - logratio, (ratio != clipped).to(ratio.dtype))
    return torch.stack([x.mean((0, 2)) for x in logs])


@torch.no_grad()
def update(args: Args, learners: list[Any], rollouts: list[Any]) -> list[dict[str, float]]:
    """What the single file's update does to each agent with its own rollout."""
    if args.anneal_lr:
        left = 1 - learners[0].update / args.num_updates
        for learner in learners:
            learner.actor_optimizer.param_groups[0]["lr"] = left * args.learning_rate
            learner.critic_optimizer.param_groups[0]["lr"] = left * args.vf_learning_rate
    actor = population.AdamStack([x.actor for x in learners], [x.actor_optimizer for x in learners])
    critic = population.AdamStack(
        [x.critic for x in learners], [x.critic_optimizer for x in learners]
    )
    obs, actions, *rest, explained = population.flatten(args, rollouts)
    log_std, *layers = actor.leaves
    means = population.forward(layers, obs, args.activation)[-1]
    batch = Batch(obs, actions, population.log_prob(means, log_std, actions)[0], *rest)
    learns, epochs = np.ones(args.num_agents, bool), np.zeros(args.num_agents, int)
    logs, value_losses = [], []
    for epoch in range(max(args.update_epochs, args.vf_epochs)):
        order, seen = population.shuffled(args, learners), []
        parts = minibatches(batch, order)
        learns = learns & (epoch < args.update_epochs)
        actor.learn(learns)
        deltas = [None] * args.num_minibatches
        if args.coefficient > 0 and learns.any():  # condwrap
            delta = population.draw_delta(learners, obs, learns)  # condwrap
            deltas = delta.flatten(0, 1)[order]  # condwrap
        for *columns, delta in zip(*parts, deltas, strict=True):
            part = Batch(*columns)
            if learns.any():
                seen.append(policy_step(args, actor, part, delta))
            if epoch < args.vf_epochs:
                value_losses.append(population.value_step(args, critic, part.obs, part.targets))
        if learns.any():
            epochs += learns
            logs.append(policy_logs(args, parts.advantages, seen))
            if args.target_kl is not None:
                learns = learns & (logs[-1][2] <= args.target_kl).numpy()
    actor.store()
    critic.store()
    names = ("policy_loss", "entropy", "approx_kl", "clipfrac", "value_loss", "explained_variance")
    policy, value = torch.stack(logs), torch.stack(value_losses).mean(0)  # [epochs, 4, N], [N]
    rows = []
    for i, count in enumerate(epochs):
        means = [*policy[:count, :, i].mean(0), value[i], explained[i]]
        losses = {f"losses/{name}": x.item() for name, x in zip(names, means, strict=True)}
        rate = learners[i].actor_optimizer.param_groups[0]["lr"]
        rows.append({"charts/learning_rate": rate, **losses})
    return rows


def train(args: Args) -> list[Any]:
    """Train, or continue to train, every agent until `total_timesteps`."""
    return population.train(args, update)


def main() -> None:
    population.run(Args, train, __doc__)


if __name__ == "__main__":
    main()
