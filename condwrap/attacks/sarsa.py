"""Learn the Q that `robust_sarsa` descends: from the policy's own transitions, and smooth in a."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor, nn

from condwrap.attacks.ball import Ball


@dataclasses.dataclass(frozen=True)
class Transitions:
    """Steps of the policy under attack, `[N, ...]` each."""

    obs: Tensor
    """s, `[N, *obs_shape]`, as the policy sees it"""
    actions: Tensor
    """a, `[N, m]`"""
    rewards: Tensor
    """r, `[N]`"""
    next_obs: Tensor
    """s', `[N, *obs_shape]`"""
    next_actions: Tensor
    """a', `[N, m]`: what the policy does at s'"""
    terminations: Tensor
    """`[N]`, true where s' is terminal, so that nothing follows it; a time limit is no such end"""

    def __post_init__(self) -> None:
        counts = {field.name: len(getattr(self, field.name)) for field in dataclasses.fields(self)}
        if len(set(counts.values())) > 1 or not counts["obs"]:
            raise ValueError(f"transitions must have one row for each step, got {counts}")
        if self.actions.ndim != 2 or self.next_actions.shape != self.actions.shape:
            raise ValueError(
                "actions and next_actions must have one shape, [N, m], got "
                f"{tuple(self.actions.shape)} and {tuple(self.next_actions.shape)}"
            )

    def take(self, rows: Tensor) -> Transitions:
        """Some of the steps."""
        parts = {f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)}
        return Transitions(**parts)


def fit_action_value(
    action_value: nn.Module,
    transitions: Transitions,
    *,
    gamma: float = 0.99,
    action_radius: float = 0.05,
    robustness: float = 0.3,
    updates: int = 2000,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Fit Q(s, a) in place by Sarsa, with a bound on its change over small changes of the action.

    (r + gamma Q(s', a') - Q(s, a))² + robustness · max over ‖a^ - a‖∞ <= epsilon of
    (Q(s, a^) - Q(s, a))², Zhang et al. (2020), equation in 3.5. epsilon grows from 0 to
    `action_radius` over the first half of the updates, as theirs grows. They bound the maximum from
    above by a convex relaxation; here one signed step from a random point finds it from below,
    which needs no more of Q than a gradient.

    Args:
        action_value: A module (obs, actions) -> Q, `[B]` or `[B, 1]`; its parameters are trained.
        transitions: Steps of the policy.
        gamma: Discount, in [0, 1].
        action_radius: epsilon, at least 0, in units of the action.
        robustness: Weight of the second term, at least 0.
        updates: Steps of Adam.
        batch_size: Transitions in each.
        learning_rate: Adam's step size.
        generator: Draws batches and points; by default a new one of seed 0.

    Returns:
        The squared TD error of each update, `[updates]`.

    Raises:
        ValueError: A bad argument.
    """
    _check(gamma, action_radius, robustness, updates, batch_size)
    generator = generator or torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(action_value.parameters(), learning_rate)
    errors = []
    with torch.enable_grad():
        for k in range(updates):
            draw = torch.randint(len(transitions.obs), (batch_size,), generator=generator)
            batch = transitions.take(draw.to(transitions.obs.device))
            ball = Ball(action_radius * min(1.0, 2 * k / updates), "linf")

            q = _values(action_value, batch.obs, batch.actions)
            error = (_target(action_value, batch, gamma) - q).square().mean()
            moved = _worst_actions(action_value, batch, ball, generator)
            change = (_values(action_value, batch.obs, moved) - q).square().mean()

            optimizer.zero_grad()
            (error + robustness * change).backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            errors.append(error.detach())
    return torch.stack(errors)


@torch.no_grad()
def _target(action_value: nn.Module, batch: Transitions, gamma: float) -> Tensor:
    """TD target: r + gamma Q(s', a'), and r alone where the episode ended there."""
    following = _values(action_value, batch.next_obs, batch.next_actions)
    return batch.rewards + gamma * torch.where(batch.terminations.bool(), 0.0, following)


def _worst_actions(
    action_value: nn.Module, batch: Transitions, ball: Ball, generator: torch.Generator
) -> Tensor:
    """Actions in the ball around a, where Q differs from Q(s, a): a signed step across it."""
    shape = len(batch.actions), batch.actions.shape[1]
    delta = ball.draw(shape, batch.actions, generator).requires_grad_()
    before = _values(action_value, batch.obs, batch.actions).detach()
    change = (_values(action_value, batch.obs, batch.actions + delta) - before).square()
    (gradient,) = torch.autograd.grad(change.sum(), delta, materialize_grads=True)
    return batch.actions + ball.project(delta.detach() + 2 * ball.radius * gradient.sign())


def _values(action_value: nn.Module, obs: Tensor, actions: Tensor) -> Tensor:
    values: Tensor = action_value(obs, actions)
    if values.numel() != len(actions):
        raise ValueError(
            f"action_value must return one number for each of {len(actions)} states, got shape "
            f"{tuple(values.shape)}"
        )
    return values.flatten()


def _check(
    gamma: float, action_radius: float, robustness: float, updates: int, batch_size: int
) -> None:
    if not 0 <= gamma <= 1:
        raise ValueError(f"gamma must be in [0, 1], got {gamma}")
    for name, size in (("action_radius", action_radius), ("robustness", robustness)):
        if not 0 <= size < math.inf:
            raise ValueError(f"{name} must be finite and at least 0, got {size}")
    for name, count in (("updates", updates), ("batch_size", batch_size)):
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
