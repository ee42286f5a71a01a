"""Attacks that descend a value: of the state that is shown, or of the action that follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from condwrap.attacks.ascent import Objective, answer, attack
from condwrap.attacks.ball import Ball, Norm
from condwrap.observation import States
from condwrap.policy import Policy, Select, check_select, flat_output, untouched

Critic = Callable[[Any], Any]  # obs -> V(s), [B] or [B, 1]
ActionValue = Callable[..., Any]  # obs, actions [B, m] -> Q(s, a), [B] or [B, 1]


def critic(
    value: Critic,
    obs: Any,
    radius: float,
    norm: Norm = "linf",
    *,
    steps: int = 10,
    restarts: int = 5,
    generator: torch.Generator | None = None,
) -> Any:
    """Descend a critic: delta makes V(s + delta) small, as Zhang et al. (2020) attack PPO.

    The agent is shown the state that its critic thinks worst, whatever it does there, so this is
    often no stronger than noise.

    Args:
        value: The critic, a callable obs -> V, `[B]` or `[B, 1]`.
        obs: As for `mad`.
        radius: As for `mad`.
        norm: As for `mad`.
        steps: As for `mad`.
        restarts: As for `mad`.
        generator: As for `mad`.

    Returns:
        delta in the structure of obs, None where an integer leaf passes through.

    Raises:
        TypeError, ValueError: As for `mad`, or values that are not one number for each state.

    Example:
        >>> value = torch.nn.Linear(3, 1)
        >>> value.weight.data = torch.tensor([[1.0, -2.0, 0.5]])
        >>> critic(value, torch.zeros(1, 3), radius=0.5).tolist()
        [[-0.5, 0.5, -0.5]]
    """

    def loss(states: States) -> Objective:
        return lambda delta: -_one_each("value", answer(value, states, delta), states)

    return attack(loss, obs, Ball(radius, norm), steps, restarts, generator)


def robust_sarsa(
    policy: Policy,
    obs: Any,
    radius: float,
    norm: Norm = "linf",
    *,
    action_value: ActionValue,
    select: Select = "mean",
    steps: int = 10,
    restarts: int = 5,
    generator: torch.Generator | None = None,
) -> Any:
    """Robust Sarsa (Zhang et al., 2020): Q(s, pi(s + delta)) is made small.

    The value is of the true state s, so this looks for the worst action there.

    Args:
        policy: As for `mad`, with continuous actions.
        obs: As for `mad`.
        radius: As for `mad`.
        norm: As for `mad`.
        action_value: Q of the policy, a callable (obs, actions) -> `[B]` or `[B, 1]`, such as
            `fit_action_value` trains.
        select: What of the output is the action: by default a tensor, or a distribution's mean.
        steps: As for `mad`.
        restarts: As for `mad`.
        generator: As for `mad`.

    Returns:
        delta in the structure of obs, None where an integer leaf passes through.

    Raises:
        TypeError, ValueError: As for `mad`, or values that are not one number for each state.

    Example:
        >>> policy = torch.nn.Identity()
        >>> q = lambda obs, action: -(action - obs - 1.0).square().sum(-1)  # best is obs + 1
        >>> robust_sarsa(policy, torch.zeros(1, 2), radius=0.5, action_value=q).tolist()
        [[-0.5, -0.5]]
    """
    check_select(select)

    def loss(states: States) -> Objective:
        clean = states.obs(states.perturbed)

        def objective(delta: Tensor) -> Tensor:
            action = flat_output(answer(policy, states, delta), select, states.batch)
            with untouched(action_value, states.device):
                values = action_value(clean, action)
            return -_one_each("action_value", values, states)

        return objective

    return attack(loss, obs, Ball(radius, norm), steps, restarts, generator)


def _one_each(name: str, values: Any, states: States) -> Tensor:
    flat = flat_output(values, "default", states.batch)
    if flat.shape[-1] != 1:
        raise ValueError(
            f"{name} must return one number for each state, got {flat.shape[-1]} for each"
        )
    return flat[:, 0]
