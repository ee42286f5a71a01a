"""SA-PPO's regularizer: the largest change of the policy that a bounded adversary can cause."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from condwrap.jacobian import read_states, zero_delta
from condwrap.observation import States
from condwrap.penalties.checks import check_count, check_length, check_weight
from condwrap.penalties.distributions import gaussian
from condwrap.penalties.evaluation import evaluate
from condwrap.penalties.noise import Noise
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.policy import Policy, check_reusable

TEMPERATURE = 1e-5  # of the Langevin dynamics, as in the authors' code


class StateAdversarial(Noise):
    """coefficient · mean over s of max over ‖δ‖∞ ≤ radius of ½ Σ ((μ(s + δ) - μ(s)) / σ)².

    From Zhang et al., "Robust Deep Reinforcement Learning against Adversarial Perturbations on
    State Observations" (2020, arXiv 2003.08938): the KL divergence of two Gaussians that share σ.
    The maximum is sought by stochastic gradient Langevin dynamics, whose steps are signs, from
    random signs, since the gradient at δ = 0 is 0. It is a lower bound.

    The authors' code leaves out the ½, so its κ is half of this coefficient, and holds μ(s)
    constant. Here, as in the formula, the gradient reaches both means and σ. Its steps of radius /
    steps end at 0.9 radius where the start pointed the other way; these are 1 + 1/steps times as
    long, and reach every corner. Its settings, κ without the ½: Hopper radius 0.075, κ 1;
    Walker2d 0.05, 0.1; Humanoid 0.075, 0.01, the radius growing from 0 over the first three
    quarters of training (set `radius` between calls).

    Args:
        coefficient: κ, at least 0. With 0 it is measured and nothing reaches the loss.
        radius: ε, above 0, in units of the policy's observation.
        steps: Of the search, at least 1; each costs a forward and a backward pass.
        seed: Of the penalty's own generator, on the CPU.
        generator: A generator to use instead.

    A call needs a policy that returns a Normal, also within Independent or beside tensors, and
    uses `output`. Its metric is `sa_divergence`, the mean.

    Raises:
        TypeError, ValueError: An argument outside what is stated above, or at a call what
            `ConditioningRegularizer` refuses.

    Example:
        >>> mean = torch.nn.Linear(2, 1, bias=False)
        >>> mean.weight.data = torch.tensor([[3.0, -1.0]])
        >>> policy = lambda obs: torch.distributions.Normal(mean(obs), 2.0)
        >>> penalty = StateAdversarial(radius=0.5)
        >>> penalty(policy, torch.zeros(4, 2)).metrics()  # ½ (0.5 · (3 + 1) / 2)²
        {'penalty/sa_divergence': 0.5}
    """

    needs: tuple[str, ...] = ()

    def __init__(
        self,
        coefficient: float = 1.0,
        radius: float = 0.075,
        *,
        steps: int = 10,
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(seed, generator)
        self.coefficient = check_weight("coefficient", coefficient)
        self.radius = check_length("radius", radius)
        self.steps = check_count("steps", steps)

    def __call__(
        self,
        policy: Policy,
        obs: Any,
        *,
        output: Any = None,
        next_obs: Any = None,
        dones: Tensor | None = None,
        actions: Tensor | None = None,
        value: Any = None,
    ) -> Penalized:
        """The penalty on these observations, `[B, *obs_shape]`; the class says what it needs."""
        states = read_states(obs, "default")
        with torch.set_grad_enabled(self.coefficient > 0 and torch.is_grad_enabled()):
            if output is None:
                output = evaluate(policy, states)
            else:
                check_reusable(policy)
            mean, std = gaussian(output, states)
            delta = self._search(policy, states, mean.detach(), std.detach())
            moved, _ = gaussian(evaluate(policy, states, delta), states)
            divergence = ((moved - mean) / std).square().sum(-1).mean() / 2
            return penalized({"sa_divergence": (self.coefficient, divergence)})

    @torch.enable_grad()
    def _search(self, policy: Policy, states: States, mean: Tensor, std: Tensor) -> Tensor:
        at = zero_delta(states)
        shape = tuple(at.shape)
        start = self.radius / self.steps
        step = start * (1 + 1 / self.steps)
        delta = start * self.normal(shape, at).sign()
        for k in range(self.steps):
            delta.requires_grad_()
            moved, _ = gaussian(evaluate(policy, states, delta), states)
            divergence = ((moved - mean) / std).square().sum() / 2
            # 0 · delta: a policy that ignores its observations has the gradient 0
            anchored = divergence + 0.0 * delta.sum()
            with torch.autocast(states.device.type, enabled=False):  # backward heeds it too
                (gradient,) = torch.autograd.grad(anchored, delta)
            scale = math.sqrt(2 * step * TEMPERATURE) / (k + 2)
            ascent = (gradient + scale * self.normal(shape, at)).sign()
            delta = (delta.detach() + step * ascent).clamp(-self.radius, self.radius)
        return delta
