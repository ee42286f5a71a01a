"""TRPO with the conditioning penalty for N agents at once, each as trpo_reg.py would train it.

    python trpo_reg_population.py --env-id HopperBulletEnv-v0 --seed 1 --num-agents 10

Agent i has the initial weights, seeds, noise, statistics and files of `trpo_reg.py --agent i`, and
either program resumes the other's runs. Stacked is the arithmetic: one call acts for all agents,
one conjugate gradient and one line search, agent by agent in what they decide, step them all.

Lines marked so are the penalty (Asadulaev et al., arXiv 1906.05437):  # condwrap
Needs trpo_reg.py and population.py, beside this file or in the package `baselines`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from condwrap.functional import clamping_penalty, conditioning_quotient  # condwrap

if __package__:
    from baselines import population, trpo_reg
else:  # run as a file, the others beside it
    import population
    import trpo_reg


@dataclasses.dataclass(frozen=True)
class Args(population.PopulationArgs, trpo_reg.Args):
    """Those of trpo_reg.py, and the number of agents."""

    single = trpo_reg


# --- TRPO -----------------------------------------------------------------------------------------


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance: float = 1e-10
) -> tuple[Tensor, Tensor]:
    """The single file's for each row of b, `[N, P]`, which ends by itself: x, and the residuals."""
    x, residual, direction = torch.zeros_like(b), b.clone(), b.clone()
    squared = start = b.square().sum(1)
    going = torch.ones(len(b), dtype=torch.bool)
    for _ in range(steps):
        going = going & ~(squared <= tolerance * start)
        if not going.any():
            break
        image = product(direction)
        curvature = (direction * image).sum(1)
        going = going & (curvature > 0)  # not where it is NaN
        on, size = going[:, None], (squared / curvature)[:, None]
        x = torch.where(on, x + size * direction, x)
        residual = torch.where(on, residual - size * image, residual)
        before, squared = squared, torch.where(going, residual.square().sum(1), squared)
        direction = torch.where(on, residual + (squared / before)[:, None] * direction, direction)
    return x, torch.where(start == 0, 0, (squared / start).sqrt())


def jvp(
    layers: list[Tensor], tangents: list[Tensor], inputs: list[Tensor], activation: str
) -> Tensor:
    """Change of the output along a change of the layers, from what `forward` gave them."""
    change = torch.baddbmm(tangents[1][:, None], inputs[0], tangents[0].mT)
    for i in range(2, len(layers), 2):
        x = inputs[i // 2]
        change = change.addcmul_(change * x, x, value=-1) if activation == "tanh" else (
            change * (x > 0)
        )  # fmt: skip
        direct = torch.baddbmm(tangents[i + 1][:, None], x, tangents[i].mT)
        change = torch.baddbmm(direct, change, layers[i].mT)
    return change


class Problem:
    """What each agent maximizes, E[ratio · A] - c1 · mean(psi), and its bound, around its policy.

    delta is held fixed; psi is taken over the whole rollout.
    """

    def __init__(
        self, args: Args, actor: population.Stack, obs: Tensor, actions: Tensor,
        advantages: Tensor, delta: Tensor | None,
    ) -> None:  # fmt: skip
        self.args, self.actor, self.actions, self.delta = args, actor, actions, delta
        std, mean = torch.std_mean(advantages, 1, keepdim=True)
        self.advantages, self.size = (advantages - mean) / (std + 1e-8), obs.shape[1]
        self.states = obs
        if delta is not None:  # condwrap
            self.states = torch.cat([obs, obs + delta], 1)  # condwrap
        log_std, *layers = actor.leaves
        *self.inputs, self.output = population.forward(layers, self.states, args.activation)
        self.means, self.log_std = self.output[:, : self.size], log_std.clone()
        self.logprobs, self.scaled = population.log_prob(self.means, log_std, actions)

    def gradient(self) -> Tensor:
        """Of the objective at the old policy, where every ratio is 1: `[N, P]`."""
        slopes = self.advantages[..., None] / self.size
        grad = slopes * self.scaled * (-self.log_std).exp()[:, None]
        log_std_grad = self.actor.gradients[0]
        torch.sum(slopes * (self.scaled.square() - 1), 1, out=log_std_grad)
        if self.delta is not None:  # condwrap
            slope = population.penalty_slope(self.args, self.output, self.delta)  # condwrap
            grad = torch.cat([grad - slope, slope], 1)  # condwrap
        population.backward(self.actor, self.inputs, grad, self.args.activation)
        return self.actor.grads.clone()

    def fisher_product(self, v: Tensor) -> Tensor:
        """(F + damping · I) v for each agent, F the Hessian of its mean KL divergence.

        At the old policy that is Jᵀ D J: J the Jacobian of means and log-stds, D the Hessian of a
        Gaussian's divergence in these, 1 / variance and 2.
        """
        log_std_part, *tangents = self.actor.parts(v)
        inputs = [x[:, : self.size] for x in self.inputs]
        change = jvp(self.actor.leaves[1:], tangents, inputs, self.args.activation)
        grad = change * (-2 * self.log_std).exp()[:, None] / self.size
        population.backward(self.actor, inputs, grad, self.args.activation)
        self.actor.gradients[0].copy_(2 * log_std_part)
        return self.actor.grads + self.args.cg_damping * v

    def evaluate(self, agents: Tensor) -> tuple[Tensor, Tensor]:
        """Objective and mean KL divergence of these agents' present parameters."""
        log_std, *layers = (leaf[agents] for leaf in self.actor.leaves)
        output = population.forward(layers, self.states[agents], self.args.activation)[-1]
        return self.measure(output, log_std, agents)

    def measure(self, output: Tensor, log_std: Tensor, agents: Any) -> tuple[Tensor, Tensor]:
        means = output[:, : self.size]
        logprobs, _ = population.log_prob(means, log_std, self.actions[agents])
        ratio = (logprobs - self.logprobs[agents]).exp()
        objective = (ratio * self.advantages[agents]).mean(1)
        if self.delta is not None:  # condwrap
            outputs = means, output[:, self.size :]  # condwrap
            j = conditioning_quotient(*outputs, self.delta[agents], batch_ndim=2)  # condwrap
            psi = clamping_penalty(j, self.args.lambda_min, self.args.lambda_max)  # condwrap
            objective = objective - self.args.coefficient * psi.mean(1)  # condwrap
        squares = ((self.means[agents] - means) * (-log_std).exp()[:, None]).square()
        log_ratio = 2 * (self.log_std[agents] - log_std)[:, None]
        kl = 0.5 * (log_ratio.exp() + squares - 1 - log_ratio).sum(-1)
        return objective, kl.mean(1)


def natural_step(
    args: Args, actor: population.Stack, problem: Problem
) -> tuple[dict[str, Tensor], list[str]]:
    """The single file's step of each agent, or none: logs, `[N]`, and why an agent stays."""
    old, gradient = actor.rows.clone(), problem.gradient()
    before, _ = problem.measure(problem.output, problem.log_std, slice(None))
    names = ("kl", "step_fraction", "cg_residual", "accepted")
    names += ("expected_improvement", "actual_improvement")
    logs = {name: torch.zeros_like(before) for name in names}
    zero, moves = ~gradient.any(1), gradient.isfinite().all(1) & gradient.any(1)
    direction, residual = conjugate_gradient(problem.fisher_product, gradient, args.cg_steps)
    logs["cg_residual"][moves] = residual[moves]
    curvature = (direction * problem.fisher_product(direction)).sum(1)
    full_step = (2 * args.target_kl / curvature).sqrt()[:, None] * direction
    bent = moves & full_step.isfinite().all(1)
    logs["expected_improvement"][bent] = (gradient * full_step).sum(1)[bent]
    searches = bent.clone()
    for i in range(args.line_search_steps):
        if not searches.any():
            break
        agents, fraction = searches.nonzero().flatten(), args.line_search_shrink**i
        actor.rows[agents] = old[agents] + fraction * full_step[agents]
        objective, kl = problem.evaluate(agents)
        gain = objective - before[agents]
        good = (kl <= args.target_kl) & (gain > 0) & (gain < math.inf)
        accepted = agents[good]
        logs["kl"][accepted], logs["actual_improvement"][accepted] = kl[good], gain[good]
        logs["step_fraction"][accepted], logs["accepted"][accepted] = fraction, 1
        searches[accepted] = False
    actor.rows[searches] = old[searches]
    return logs, [
        f"the gradient is {'0' if zero[i] else 'not finite'}" if not moves[i]
        else "no positive curvature" if not bent[i]
        else "no fraction of it improves the objective within the KL bound" if searches[i]
        else ""
        for i in range(args.num_agents)
    ]  # fmt: skip


@torch.no_grad()
def update(args: Args, learners: list[Any], rollouts: list[Any]) -> list[dict[str, float]]:
    """What the single file's update does to each agent with its own rollout."""
    actor = population.Stack([x.actor for x in learners])
    critic = population.AdamStack(
        [x.critic for x in learners], [x.critic_optimizer for x in learners]
    )
    obs, actions, advantages, targets, explained = population.flatten(args, rollouts)
    entropies = (0.5 + 0.5 * math.log(2 * math.pi) + actor.leaves[0]).sum(1)
    delta = None
    if args.coefficient > 0:  # condwrap
        everyone = np.ones(args.num_agents, bool)  # condwrap
        delta = population.draw_delta(learners, obs, everyone)  # condwrap
    problem = Problem(args, actor, obs, actions, advantages, delta)
    logs, rejections = natural_step(args, actor, problem)
    for learner_args, reason in zip(args.runs, rejections, strict=True):
        if reason:
            print(f"agent {learner_args.agent}: step rejected: {reason}")
    value_losses = []
    for _ in range(args.vf_epochs):
        order = population.shuffled(args, learners)
        for part in zip(obs.flatten(0, 1)[order], targets.flatten()[order], strict=True):
            value_losses.append(population.value_step(args, critic, *part))
    actor.store()
    critic.store()
    logs["value_loss"] = torch.stack(value_losses).mean(0)
    logs |= {"entropy": entropies, "explained_variance": explained}
    return [{f"losses/{k}": x[i].item() for k, x in logs.items()} for i in range(args.num_agents)]


def train(args: Args) -> list[Any]:
    """Train, or continue to train, every agent until `total_timesteps`."""
    return population.train(args, update)


def main() -> None:
    population.run(Args, train, __doc__)


if __name__ == "__main__":
    main()
