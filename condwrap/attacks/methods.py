"""Attacks that need the policy alone, or not even that."""

from __future__ import annotations

from typing import Any

import torch

from condwrap.attacks.ascent import Objective, answer, attack, fresh_generator, read_states
from condwrap.attacks.ball import Ball, Norm
from condwrap.attacks.divergence import choose, divergence
from condwrap.observation import States
from condwrap.policy import Policy, Select, check_select


def random(
    policy: Policy | None,
    obs: Any,
    radius: float,
    norm: Norm = "linf",
    *,
    generator: torch.Generator | None = None,
) -> Any:
    """Noise that knows nothing: delta is uniform over the ball.

    Args:
        policy: Not looked at.
        obs: `[B, *obs_shape]`, floating or uint8 (in units of 255), or a dict of these.
        radius: Length of the longest delta, at least 0, in the units of the observation.
        norm: "linf" bounds each number by itself, "l2" the Euclidean length of the whole delta.
        generator: Draws delta; by default a new one that the operating system seeds.

    Returns:
        delta in the structure of obs, None where an integer leaf passes through.

    Raises:
        TypeError, ValueError: A bad argument.

    Example:
        >>> import torch
        >>> bool(random(None, torch.zeros(4, 3), radius=0.1).abs().max() <= 0.1)
        True
    """
    states = read_states(obs)
    ball = Ball(radius, norm)
    shape = states.batch[0], sum(states.sizes)
    like = torch.empty(0, dtype=states.dtype, device=states.device)
    generator = generator or fresh_generator()
    return states.unflatten(ball.draw(shape, like, generator))


def mad(
    policy: Policy,
    obs: Any,
    radius: float,
    norm: Norm = "linf",
    *,
    select: Select = "default",
    steps: int = 10,
    restarts: int = 20,
    generator: torch.Generator | None = None,
) -> Any:
    """Maximal action difference (Zhang et al., 2020, arXiv 2003.08938): pi changes the most.

    delta maximizes ½ Σ ((mu(s + delta) - mu(s)) / sigma)² of a Gaussian policy, the KL divergence
    of a categorical one, and ‖pi(s + delta) - pi(s)‖² of a tensor. The gradient at delta = 0 is 0,
    so every start is a random one. What is found is a local maximum: of 1,000 random linear
    policies with 12 inputs and 6 outputs, one start missed the best corner of the l∞ ball in 75%,
    5 missed it in 36%, 20 in 6% and 64 in 0.4%. With 20 starts the mean loss was 0.1% of the
    maximum, and the largest 7%.

    Args:
        policy: Any callable obs -> tensor, distribution, or a tuple or dict that holds one. It is
            called on `restarts` · B observations at a time.
        obs: `[B, *obs_shape]`, floating or uint8 (in units of 255), or a dict of these.
        radius: Length of the longest delta, at least 0, in the units of the observation.
        norm: "linf" bounds each number by itself, "l2" the Euclidean length of the whole delta.
        select: Which part of the output counts, as for `ConditioningRegularizer`; "mean", "logits"
            and "probs" make it a tensor, compared as such.
        steps: Gradients taken from each start, at least 1.
        restarts: Random starts of each state, at least 1.
        generator: Draws them; by default a new one that the operating system seeds.

    Returns:
        delta in the structure of obs, None where an integer leaf passes through.

    Raises:
        TypeError, ValueError: A bad argument, or an output that cannot be compared, is not finite
            or has no gradient.

    Example:
        >>> policy = torch.nn.Linear(3, 1)
        >>> policy.weight.data = torch.tensor([[1.0, -2.0, 0.5]])
        >>> delta = mad(policy, torch.zeros(1, 3), radius=0.5)  # the weights' signs, or minus them
        >>> (delta * delta[0, 0].sign()).tolist()
        [[0.5, -0.5, 0.5]]
    """
    check_select(select)

    def change(states: States) -> Objective:
        with torch.no_grad():
            clean = choose(answer(policy, states), select, states.batch)
        return lambda delta: divergence(
            clean, choose(answer(policy, states, delta), select, states.batch)
        )

    return attack(change, obs, Ball(radius, norm), steps, restarts, generator)
