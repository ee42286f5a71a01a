"""TRPO with the conditioning penalty for N agents at once, each as trpo_reg.py would train it.

    python trpo_reg_population.py --env-id HopperBulletEnv-v0 --seed 1 --num-agents 10

Agent i has the initial weights, seeds, noise, statistics and files of `trpo_reg.py --agent i`, and
either program resumes the other's runs. One call acts for all agents, and one conjugate gradient
finds the steps of all. Each agent has a line search of its own.

The lines marked as condwrap's add the penalty of Asadulaev et al. (arXiv 1906.05437). The file
needs trpo_reg.py and population.py, beside it or in the package `baselines`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import kl_divergence

if __package__:
    from baselines import population, trpo_reg
else:  # run as a file, the others beside it
    import population
    import trpo_reg

VERSION = trpo_reg.VERSION


@dataclasses.dataclass(frozen=True)
class Args(population.PopulationArgs, trpo_reg.Args):
    """Those of trpo_reg.py, and the number of agents."""

    single = trpo_reg


# --- TRPO -----------------------------------------------------------------------------------------


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance: float = 1e-10
) -> tuple[Tensor, Tensor]:
    """The single file's for each row of b, `[N, P]`, which ends by itself: x, and the residuals."""
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    start = b.square().sum(1)
    squared = start
    going = torch.ones(len(b), dtype=torch.bool)
    for _ in range(steps):
        going = going & ~(squared <= tolerance * start)
        if not going.any():
            break

        # x += alpha · p, with alpha = rᵀ r / pᵀ A p
        image = product(direction)
        curvature = (direction * image).sum(1)
        going = going & (curvature > 0)  # not where it is NaN
        rows = going[:, None]
        alpha = (squared / curvature)[:, None]
        x = torch.where(rows, x + alpha * direction, x)
        residual = torch.where(rows, residual - alpha * image, residual)

        # p = r + beta · p, with beta = new rᵀ r / old rᵀ r
        before = squared
        squared = torch.where(going, residual.square().sum(1), squared)
        beta = (squared / before)[:, None]
        direction = torch.where(rows, residual + beta * direction, direction)

    return x, torch.where(start == 0, 0, (squared / start).sqrt())


def jvp(
    layers: list[Tensor], tangents: list[Tensor], inputs: list[Tensor], activation: str
) -> Tensor:
    """Change of the output along a change of the layers, from what `forward` gave them."""
    change = torch.baddbmm(tangents[1][:, None], inputs[0], tangents[0].mT)
    for i in range(2, len(layers), 2):
        x = inputs[i // 2]
        change = population.through_activation(change, x, activation)

        # y = W x + b, so dy = W dx + dW x + db
        direct = torch.baddbmm(tangents[i + 1][:, None], x, tangents[i].mT)
        change = torch.baddbmm(direct, change, layers[i].mT)
    return change


class Problem:
    """What each agent maximizes, E[ratio · A] - c1 · mean(psi), and its bound, at its old policy.

    psi is taken over the whole rollout.
    """

    def __init__(
        self,
        args: Args,
        actor: population.Stack,
        obs: Tensor,
        actions: Tensor,
        advantages: Tensor,
        delta: Tensor | None = None,  # condwrap
    ) -> None:
        self.args = args
        self.actor = actor
        self.advantages = advantages
        self.delta = delta  # condwrap
        self.size = obs.shape[1]
        states = obs
        if delta is not None:  # condwrap
            states = torch.cat([obs, obs + delta], 1)  # condwrap

        self.log_std, *layers = actor.leaves
        *self.inputs, self.output = population.forward(layers, states, args.activation)
        _, self.scaled = population.log_prob(self.output[:, : self.size], self.log_std, actions)

    def gradient(self) -> Tensor:
        """Of the objective, where every ratio is 1: `[N, P]`."""
        # d log r / d mean = z / std, and d log r / d log_std = z² - 1, where z = (a - mean) / std
        slopes = self.advantages[..., None] / self.size
        grad = slopes * self.scaled * (-self.log_std).exp()[:, None]
        torch.sum(slopes * (self.scaled.square() - 1), 1, out=self.actor.gradients[0])
        if self.delta is not None:  # condwrap
            slope = population.penalty_slope(self.args, self.output, self.delta)  # condwrap
            grad = torch.cat([grad - slope, slope], 1)  # condwrap

        population.backward(self.actor, self.inputs, grad, self.args.activation)
        return self.actor.grads.clone()

    def fisher_product(self, v: Tensor) -> Tensor:
        """(F + damping · I) v for each agent, F the Hessian of its mean KL divergence.

        F = Jᵀ D J: J is the Jacobian of means and log-stds, D the Hessian of a Gaussian's
        divergence in these, 1 / variance and 2.
        """
        # J v
        log_std_part, *tangents = self.actor.parts(v)
        inputs = [x[:, : self.size] for x in self.inputs]
        change = jvp(self.actor.leaves[1:], tangents, inputs, self.args.activation)

        # Jᵀ D (J v), the mean over the states
        grad = change * (-2 * self.log_std).exp()[:, None] / self.size
        population.backward(self.actor, inputs, grad, self.args.activation)
        self.actor.gradients[0].copy_(2 * log_std_part)
        return self.actor.grads + self.args.cg_damping * v


def full_steps(args: Args, problem: Problem) -> tuple[Tensor, list[dict[str, float]], list[str]]:
    """The single file's full step of each agent, `[N, P]`; what is logged, and why an agent stays.

    The reason is empty where there is a step.
    """
    # x = F⁻¹ g, and the full step sqrt(2 · delta_kl / xᵀ F x) · x
    gradients = problem.gradient()
    x, residuals = conjugate_gradient(problem.fisher_product, gradients, args.cg_steps)
    curvatures = (x * problem.fisher_product(x)).sum(1)
    steps = (2 * args.target_kl / curvatures).sqrt()[:, None] * x

    names = ("kl", "step_fraction", "cg_residual", "accepted")
    nothing = dict.fromkeys((*names, "expected_improvement", "actual_improvement"), 0.0)
    logs = []
    reasons = []
    for gradient, residual, step in zip(gradients, residuals, steps, strict=True):
        found = dict(nothing)
        reason = ""
        if not gradient.isfinite().all() or not gradient.any():
            reason = f"the gradient is {'not finite' if gradient.any() else '0'}"
        else:
            found["cg_residual"] = residual.item()
            if step.isfinite().all():
                found["expected_improvement"] = (gradient @ step).item()
            else:
                reason = "no positive curvature"
        logs.append(found)
        reasons.append(reason)

    return steps, logs, reasons


def line_search(
    args: Args,
    learner: Any,
    full_step: Tensor,
    obs: Tensor,
    actions: Tensor,
    advantages: Tensor,
    *delta: Tensor,
) -> dict[str, float]:
    """The single file's, on the learner's own actor, which it steps; delta if there is one."""
    old_policy = learner.actor(obs)
    batch = (obs, actions, old_policy.log_prob(actions), advantages, *delta)
    objective = functools.partial(trpo_reg.surrogate, learner, *batch)

    def mean_kl() -> Tensor:
        return kl_divergence(old_policy, learner.actor(obs)).mean()

    parameters = list(learner.actor.parameters())
    return trpo_reg.line_search(args, parameters, full_step, objective(), objective, mean_kl)


def gradient_share(learner: Any, *batch: Tensor) -> dict[str, float]:  # condwrap
    obs, actions, advantages = batch  # condwrap

    def plain() -> Tensor:  # condwrap
        logprobs = learner.actor(obs).log_prob(actions).detach()  # condwrap
        return trpo_reg.surrogate(learner, obs, actions, logprobs, advantages)  # condwrap

    with torch.enable_grad():  # condwrap
        return learner.probe.gradient_share(learner.update, learner.actor, obs, plain)  # condwrap


@torch.no_grad()
def update(args: Args, learners: list[Any], rollouts: list[Any]) -> list[dict[str, float]]:
    """What the single file's update does to each agent with its own rollout."""
    actor = population.Stack([x.actor for x in learners])
    critic = population.AdamStack(
        [x.critic for x in learners], [x.critic_optimizer for x in learners]
    )
    obs, actions, advantages, targets, explained = population.flatten(args, rollouts)
    std, mean = torch.std_mean(advantages, 1, keepdim=True)
    advantages = (advantages - mean) / (std + 1e-8)
    entropies = (0.5 + 0.5 * math.log(2 * math.pi) + actor.leaves[0]).sum(1)

    batch = [obs, actions, advantages]
    each = zip(learners, *batch, strict=True)  # condwrap
    shares = [gradient_share(*columns) for columns in each]  # condwrap
    if args.coefficient > 0:  # condwrap
        everyone = np.ones(args.num_agents, bool)  # condwrap
        batch.append(population.draw_delta(learners, obs, everyone))  # condwrap

    # the steps of all are found together, and each agent searches along its own
    steps, logs, reasons = full_steps(args, Problem(args, actor, *batch))
    for i, learner in enumerate(learners):
        reason = reasons[i]
        if not reason:
            accepted = line_search(args, learner, steps[i], *[x[i] for x in batch])
            logs[i].update(accepted)
            if not accepted:
                reason = "no fraction of it improves the objective within the KL bound"
        if reason and not population.is_frozen(learner):
            print(f"agent {args.agent + i}: step rejected: {reason}")

    value_losses: list[Tensor] = []
    for _ in range(args.vf_epochs):
        order = population.shuffled(args, learners)
        for part in zip(obs.flatten(0, 1)[order], targets.flatten()[order], strict=True):
            value_losses.append(population.value_step(args, critic, *part))

    critic.store()
    value_loss = torch.stack(value_losses).mean(0)
    return [
        {
            **{f"losses/{name}": x for name, x in logs[i].items()},
            "losses/value_loss": value_loss[i].item(),
            "losses/entropy": entropies[i].item(),
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
