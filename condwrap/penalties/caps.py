"""CAPS: actions that change little from one state to the next, and near each state."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from condwrap.functional import safe_norm
from condwrap.jacobian import read_states, zero_delta
from condwrap.penalties.checks import check_length, check_weight, require
from condwrap.penalties.evaluation import clean_output, evaluate, masked_mean, successors
from condwrap.penalties.noise import Noise
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.policy import Policy, Select, check_select, flat_output


class CAPS(Noise):
    """temporal · mean ‖μ(s) - μ(s')‖ + spatial · mean ‖μ(s) - μ(s + std·ε)‖, ε standard normal.

    From Mysore, Mabsout, Mancuso and Saenko, "Regularizing Action Policies for Smooth Control with
    Reinforcement Learning" (2021, arXiv 2012.06644): Conditioning for Action Policy Smoothness,
    with Euclidean distances. Public ports often square them, and pair a state with the row below
    it in a shuffled batch; here s' comes from `next_obs`, and where `dones` is set the pair does
    not count. The gradient of a distance is 0 where it is 0. The weights depend on the task.

    Args:
        temporal: λ_T, at least 0; 0 leaves the term out.
        spatial: λ_S, at least 0; 0 leaves the term out.
        std: σ of the nearby states, above 0, in units of the policy's observation.
        select: Which tensor of the policy's output is μ(s), as for `ConditioningRegularizer`.
        seed: Of the penalty's own generator, on the CPU.
        generator: A generator to use instead.

    A call needs `next_obs`, in the structure of `obs`, and `dones`, `[B]`, unless temporal is 0,
    and uses `output`. Its metrics are `caps_temporal` and `caps_spatial`, the two means.

    Raises:
        TypeError, ValueError: An argument outside what is stated above or missing, or at a call
            what `ConditioningRegularizer` refuses.

    Example:
        >>> policy = torch.nn.Linear(2, 1, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0]])
        >>> obs, next_obs = torch.zeros(2, 2), torch.ones(2, 2)
        >>> penalty = CAPS(spatial=0.0)
        >>> penalty(policy, obs, next_obs=next_obs, dones=torch.tensor([0, 1])).metrics()
        {'penalty/caps_temporal': 3.0}
    """

    def __init__(
        self,
        temporal: float = 0.1,
        spatial: float = 0.5,
        *,
        std: float = 0.2,
        select: Select = "default",
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(seed, generator)
        check_select(select)
        self.temporal = check_weight("temporal", temporal)
        self.spatial = check_weight("spatial", spatial)
        self.std = check_length("std", std)
        self.select = select

    @property
    def needs(self) -> tuple[str, ...]:
        return ("next_obs", "dones") if self.temporal else ()

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
        states = read_states(obs, self.select)
        mean = clean_output(policy, states, output, self.select)  # [B, m]
        terms = {}
        if self.temporal:
            reason = "its temporal term compares each state with its successor; or set temporal=0"
            require("CAPS", reason, next_obs=next_obs, dones=dones)
            following, valid = successors(states, next_obs, dones)
            next_mean = flat_output(evaluate(policy, following), self.select, states.batch)
            terms["caps_temporal"] = (
                self.temporal,
                masked_mean(safe_norm(mean - next_mean), valid),
            )
        if self.spatial:
            at = zero_delta(states)
            nearby = evaluate(policy, states, self.std * self.normal(tuple(at.shape), at))
            change = mean - flat_output(nearby, self.select, states.batch)
            terms["caps_spatial"] = (self.spatial, safe_norm(change).mean())
        return penalized(terms)
