"""Climb a function of delta within a ball, from several random starts, every state by itself."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from condwrap.attacks.ball import Ball
from condwrap.observation import States
from condwrap.policy import Policy, untouched

Objective = Callable[[Tensor], Tensor]  # delta [B, n] -> what is to be made large, [B]


def read_states(obs: Any) -> States:
    """The observations, checked, without their graph and usable where gradients are taken."""
    states = States.read(obs, obs_scale=None, batch_ndim=1)
    tensors = [x.clone() if x.is_inference() else x.detach() for x in states.tensors]
    return states.with_tensors(tensors)


@contextlib.contextmanager
def differentiable(states: States) -> Iterator[None]:
    """Gradients are on, whatever the caller's mode, and in full precision."""
    with (
        torch.inference_mode(False),
        torch.enable_grad(),
        torch.autocast(states.device.type, enabled=False),
    ):
        yield


def answer(policy: Policy, states: States, delta: Tensor | None = None) -> Any:
    """What the policy says of the states moved by delta, `[B, n]`, or of the states as they are."""
    moved = states.perturbed
    if delta is not None:
        shifts = states.displacement(delta)
        moved = [x + shift for x, shift in zip(moved, shifts, strict=True)]
    with untouched(policy, states.device):
        return policy(states.obs(moved))


def attack(
    make_objective: Callable[[States], Objective],
    obs: Any,
    ball: Ball,
    steps: int,
    restarts: int,
    generator: torch.Generator | None,
) -> Any:
    """The best delta that is found, in the structure of obs, after a look at the arguments."""
    for name, count in (("steps", steps), ("restarts", restarts)):
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
    states = read_states(obs)
    with differentiable(states):
        delta = climb(make_objective, states, ball, steps, restarts, generator)
    return states.unflatten(delta)


def climb(
    make_objective: Callable[[States], Objective],
    states: States,
    ball: Ball,
    steps: int,
    restarts: int,
    generator: torch.Generator | None,
) -> Tensor:
    """The best delta that projected steepest ascent meets, `[B, n]`.

    A step goes along the gradient's sign (l∞) or direction (l2), then back into the ball. Steps
    shrink from the ball's diameter to 0. So the first ones cross the ball, which on a linear policy
    is the iteration whose fixed points are its local maxima, and the last ones settle.

    Args:
        make_objective: Gives the function to climb for these states, `restarts` copies of each.
        states: B of them.
        ball: Where delta must stay.
        steps: Gradients taken from each start.
        restarts: Random starts of each state.
        generator: Draws them.
    """
    count = states.batch[0]
    size = sum(states.sizes)
    if ball.radius == 0:
        return torch.zeros(count, size, dtype=states.dtype, device=states.device)

    copies = states.with_tensors(x.repeat(restarts, *[1] * (x.ndim - 1)) for x in states.tensors)
    like = torch.empty(0, dtype=states.dtype, device=states.device)
    start = ball.draw((restarts * count, size), like, generator or fresh_generator())
    best, highest = _ascend(make_objective(copies), start, ball, steps)

    winner = highest.view(restarts, count).argmax(0)
    rows = torch.arange(count, device=winner.device)
    return best.view(restarts, count, size)[winner, rows]


def _ascend(objective: Objective, delta: Tensor, ball: Ball, steps: int) -> tuple[Tensor, Tensor]:
    """The best point on each row's way, `[B, n]`, and its height, `[B]`."""
    best = delta
    highest = torch.full_like(delta[:, 0], -torch.inf)
    for k in range(steps):
        value, gradient = _differentiate(objective, delta)
        better = value > highest
        best = torch.where(better[:, None], delta, best)
        highest = torch.where(better, value, highest)

        step_size = 2 * ball.radius * (1 - k / steps)
        delta = ball.project(delta + step_size * ball.steepest(gradient))

    with torch.no_grad():
        value = _finite(objective(delta))
    better = value > highest
    best = torch.where(better[:, None], delta, best)
    return best, torch.where(better, value, highest)


def _differentiate(objective: Objective, delta: Tensor) -> tuple[Tensor, Tensor]:
    """The objective of each row, `[B]`, and its gradient, `[B, n]`: no row feels another's."""
    delta = delta.detach().requires_grad_()
    value = _finite(objective(delta))
    gradient = None
    if value.requires_grad:
        (gradient,) = torch.autograd.grad(value.sum(), delta, allow_unused=True)
    if gradient is None:
        raise ValueError(
            "the policy's output has no gradient with respect to its observations: check that it "
            "neither detaches them nor turns them into NumPy arrays"
        )
    return value.detach(), gradient


def _finite(value: Tensor) -> Tensor:
    if not torch.isfinite(value).all():
        raise ValueError("the policy's output must be finite in the ball, got NaN or infinity")
    return value


def fresh_generator() -> torch.Generator:
    """One that the operating system seeds: the global one is left alone."""
    generator = torch.Generator()
    generator.seed()
    return generator
