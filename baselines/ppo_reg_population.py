"""PPO with the conditioning penalty for N agents at once, each as ppo_reg.py would train it.

    python ppo_reg_population.py --env-id HopperBulletEnv-v0 --seed 1 --num-agents 10

Agent i has the initial weights, seeds, noise, statistics and files of `ppo_reg.py --agent i`, and
either program resumes the other's runs. One call acts for all agents, and one call updates them
all. In live runs an agent parts in time from the one trained alone, since the last bit of an action
moves the physics.

The lines marked as condwrap's add the penalty of Asadulaev et al. (arXiv 1906.05437). The file
needs ppo_reg.py and population.py, beside it or in the package `baselines`.
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

VERSION = ppo_reg.VERSION


@dataclasses.dataclass(frozen=True)
class Args(population.PopulationArgs, ppo_reg.Args):
    """Those of ppo_reg.py, and the number of agents."""

    single = ppo_reg


# --- PPO ------------------------------------------------------------------------------------------


class Batch(NamedTuple):
    """What an update learns from, all of it `[N, B, ...]` or a minibatch."""

    obs: Tensor
    actions: Tensor
    logprobs: Tensor  # of the actions, under the policy that took them
    advantages: Tensor
    targets: Tensor  # of the critic


class PolicyLogs(NamedTuple):
    """Means over an epoch, `[N]` each."""

    policy_loss: Tensor
    entropy: Tensor
    approx_kl: Tensor
    clipfrac: Tensor


def minibatches(batch: Batch, order: Tensor) -> Batch:
    """An epoch: `[minibatches, N, b, ...]`, advantages normalized."""
    epoch = Batch(*[x.flatten(0, 1)[order] for x in batch])
    std, mean = torch.std_mean(epoch.advantages, -1, keepdim=True)
    return epoch._replace(advantages=(epoch.advantages - mean) / (std + 1e-8))


def policy_step(
    args: Args, actor: population.AdamStack, part: Batch, delta: Tensor | None
) -> tuple[Tensor, Tensor]:
    """One step down each agent's loss, the single file's; the log-ratios and log-stds before it."""
    log_std, *layers = actor.leaves
    before = log_std.clone()
    size = part.obs.shape[1]
    states = part.obs
    if delta is not None:  # condwrap
        states = torch.cat([states, states + delta], 1)  # condwrap
    *inputs, output = population.forward(layers, states, args.activation)

    # the slope of -min(A · r, A · clip(r)) in log r is -A · r where that is the smaller, else 0
    logprob, scaled = population.log_prob(output[:, :size], log_std, part.actions)
    logratio = logprob - part.logprobs
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    gains = part.advantages * ratio
    acts = gains <= part.advantages * clipped
    slopes = (gains * acts * (-1 / size))[..., None]

    # d log r / d mean = z / std, and d log r / d log_std = z² - 1, where z = (a - mean) / std
    grad = slopes * scaled * (-log_std).exp()[:, None]
    log_std_grad = actor.gradients[0]
    torch.sum(slopes * (scaled.square() - 1), 1, out=log_std_grad)
    log_std_grad -= args.ent_coef  # of - c3 · entropy, which is the sum of log_std and a constant
    if delta is not None:  # condwrap
        slope = population.penalty_slope(args, output, delta)  # condwrap
        grad = torch.cat([grad + slope, -slope], 1)  # condwrap

    population.backward(actor, inputs, grad, args.activation)
    actor.step(args.max_grad_norm)
    return logratio, before


def policy_logs(args: Args, advantages: Tensor, seen: list[tuple[Tensor, Tensor]]) -> PolicyLogs:
    """The means over an epoch's minibatches of what the single file logs."""
    logratio = torch.stack([each[0] for each in seen])  # [minibatches, N, b]
    log_std = torch.stack([each[1] for each in seen])  # [minibatches, N, action_dim]
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    entropies = (0.5 + 0.5 * math.log(2 * math.pi) + log_std).sum(-1)
    return PolicyLogs(
        policy_loss=-torch.min(advantages * ratio, advantages * clipped).mean((0, 2)),
        entropy=entropies.mean(0),
        approx_kl=(ratio - 1 - logratio).mean((0, 2)),
        clipfrac=(ratio != clipped).to(ratio.dtype).mean((0, 2)),
    )


def gradient_share(args: Args, learner: Any, *batch: Tensor) -> dict[str, float]:  # condwrap
    """As the single file measures it: by its own loss, on the learner's own actor."""  # condwrap
    obs = batch[0]  # condwrap

    def plain() -> Tensor:  # condwrap
        return ppo_reg.actor_loss(args, learner, *batch)[0]  # condwrap

    with torch.enable_grad():  # condwrap
        return learner.probe.gradient_share(learner.update, learner.actor, obs, plain)  # condwrap


@torch.no_grad()
def update(args: Args, learners: list[Any], rollouts: list[Any]) -> list[dict[str, float]]:
    """What the single file's update does to each agent with its own rollout."""
    if args.anneal_lr:
        left = 1 - (learners[0].update - 1) / args.num_updates
        for learner in learners:
            learner.actor_optimizer.param_groups[0]["lr"] = left * args.learning_rate
            learner.critic_optimizer.param_groups[0]["lr"] = left * args.vf_learning_rate

    actor = population.AdamStack(
        [x.actor for x in learners],
        [x.actor_optimizer for x in learners],
        together=args.target_kl is None,
    )
    critic = population.AdamStack(
        [x.critic for x in learners], [x.critic_optimizer for x in learners]
    )
    obs, actions, advantages, targets, explained = population.flatten(args, rollouts)
    log_std, *layers = actor.leaves
    means = population.forward(layers, obs, args.activation)[-1]
    logprobs, _ = population.log_prob(means, log_std, actions)
    batch = Batch(obs, actions, logprobs, advantages, targets)
    each = zip(learners, *batch[:4], strict=True)  # condwrap
    shares = [gradient_share(args, *columns) for columns in each]  # condwrap

    learns = np.ones(args.num_agents, bool)
    epochs = np.zeros(args.num_agents, int)
    logs: list[PolicyLogs] = []
    value_losses: list[Tensor] = []
    for epoch in range(max(args.update_epochs, args.vf_epochs)):
        order = population.shuffled(args, learners)
        parts = minibatches(batch, order)
        learns = learns & (epoch < args.update_epochs)
        actor.learn(learns)
        deltas = [None] * args.num_minibatches
        if args.coefficient > 0 and learns.any():  # condwrap
            deltas = population.draw_delta(learners, obs, learns).flatten(0, 1)[order]  # condwrap

        seen: list[tuple[Tensor, Tensor]] = []
        for *columns, delta in zip(*parts, deltas, strict=True):
            part = Batch(*columns)
            if learns.any():
                seen.append(policy_step(args, actor, part, delta))
            if epoch < args.vf_epochs:
                value_losses.append(population.value_step(args, critic, part.obs, part.targets))

        # each agent stops its policy once that has moved too far from the one that acted
        if learns.any():
            epochs += learns
            logs.append(policy_logs(args, parts.advantages, seen))
            if args.target_kl is not None:
                learns = learns & (logs[-1].approx_kl <= args.target_kl).numpy()

    actor.store()
    critic.store()
    value_loss = torch.stack(value_losses).mean(0)
    policy = {name: torch.stack([getattr(x, name) for x in logs]) for name in PolicyLogs._fields}
    return [
        {
            "charts/learning_rate": learners[i].actor_optimizer.param_groups[0]["lr"],
            **{f"losses/{name}": x[: epochs[i], i].mean().item() for name, x in policy.items()},
            "losses/value_loss": value_loss[i].item(),
            "losses/explained_variance": explained[i].item(),
            **shares[i],  # condwrap
        }
        for i in range(args.num_agents)
    ]


def train(args: Args) -> list[Any]:
    """Train, or continue to train, every agent until `total_timesteps`."""
    return population.train(args, update)


def main() -> None:
    population.run(Args, train, __doc__)


if __name__ == "__main__":
    main()
