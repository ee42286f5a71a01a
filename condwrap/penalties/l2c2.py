"""L2C2: actions, and values, that change no faster than the state between a state and the next."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from condwrap.jacobian import read_states
from condwrap.observation import States
from condwrap.penalties.checks import check_weight, read_value, require
from condwrap.penalties.evaluation import clean_output, evaluate, masked_mean, successors
from condwrap.penalties.noise import Noise
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.policy import Policy, Select, check_select, flat_output


class L2C2(Noise):
    """coefficient · mean (μ(s̃) - μ(s))² / mean (s̃ - s)², s̃ = s + u (s' - s), u uniform.

    And critic_coefficient times the same of V. The means are over states and coordinates, the
    divisor is a constant for the gradient, and pairs that end an episode do not count.

    After Kobayashi, "L2C2: Locally Lipschitz Continuous Constraint towards Stable and Smooth
    Reinforcement Learning" (2022, arXiv 2202.07152), in the form of public code. The paper takes
    Hellinger distances of the distributions and bounds the weight of each pair from both sides.
    Of the ports, ProtoMotions' has this ratio, between noisy and clean observations, times 0.1 or
    1. WBC-AGILE's has the numerator alone, u in [0, 1], times 1, and 0.1 for V. HoST's has it with
    u in [-1, 1], times λ_up λ_low / (λ_up - λ_low), λ = 0.1 and 1, and a tenth of that for V.

    Args:
        coefficient: Weight of the policy's term, at least 0; 0 leaves the term out.
        critic_coefficient: Weight of the critic's term, at least 0; 0 leaves the term out.
        u_min: Lower end of u, in [-1, 1); the upper end is 1.
        select: Which tensor of the policy's output is μ(s), as for `ConditioningRegularizer`.
        seed: Of the penalty's own generator, on the CPU.
        generator: A generator to use instead.

    A call needs `next_obs`, in the structure of `obs`, and `dones`, `[B]`; with a critic term also
    `value`, a callable obs -> `[B]` or `[B, 1]`. It uses `output`. Its metrics are `l2c2_policy`
    and `l2c2_critic`, the two ratios.

    Raises:
        TypeError, ValueError: An argument outside what is stated above or missing, or at a call
            what `ConditioningRegularizer` refuses.

    Example:
        >>> policy = torch.nn.Linear(1, 1, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0]])
        >>> obs, next_obs = torch.zeros(2, 1), torch.ones(2, 1)
        >>> result = L2C2()(policy, obs, next_obs=next_obs, dones=torch.tensor([0, 1]))
        >>> round(result.metrics()["penalty/l2c2_policy"], 4)
        9.0
    """

    def __init__(
        self,
        coefficient: float = 1.0,
        critic_coefficient: float = 0.0,
        *,
        u_min: float = 0.0,
        select: Select = "default",
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(seed, generator)
        check_select(select)
        self.coefficient = check_weight("coefficient", coefficient)
        self.critic_coefficient = check_weight("critic_coefficient", critic_coefficient)
        if not -1 <= u_min < 1:
            raise ValueError(f"u_min must be in [-1, 1), got {u_min}")
        self.u_min = u_min
        self.select = select

    @property
    def needs(self) -> tuple[str, ...]:
        return ("next_obs", "dones", "value") if self.critic_coefficient else ("next_obs", "dones")

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
        require(
            "L2C2", "it looks between each state and its successor", next_obs=next_obs, dones=dones
        )
        states = read_states(obs, self.select)
        following, valid = successors(states, next_obs, dones)
        step = difference(states, following)  # [B, n]
        u = self.u_min + (1 - self.u_min) * self.uniform((len(step), 1), step)
        delta = u * step
        distance = masked_mean(delta.detach().square(), valid)
        divisor = torch.where(distance > 0, distance, 1.0)  # nothing moved: the ratio is 0

        terms = {}
        if self.coefficient:
            mean = clean_output(policy, states, output, self.select)  # [B, m]
            between = flat_output(evaluate(policy, states, delta), self.select, states.batch)
            ratio = masked_mean((between - mean).square(), valid) / divisor
            terms["l2c2_policy"] = (self.coefficient, ratio)
        if self.critic_coefficient:
            require("L2C2", "its critic term evaluates V between two states", value=value)
            if not callable(value):
                kind = type(value).__name__
                raise TypeError(f"L2C2 evaluates value at new states: pass a callable, got {kind}")
            here, there = (
                read_value(evaluate(value, states, at), states, "value(obs)")
                for at in (None, delta)
            )
            ratio = masked_mean((there - here).square(), valid) / divisor
            terms["l2c2_critic"] = (self.critic_coefficient, ratio)
        return penalized(terms)


def difference(states: States, following: States) -> Tensor:
    """What leads from one state to the other, `[B, n]`, in units of delta."""
    pairs = zip(states.moving, following.moving, strict=True)
    parts = [(there.floating - here.floating) / here.scale for here, there in pairs]
    return torch.cat([part.reshape(len(part), -1) for part in parts], -1)
