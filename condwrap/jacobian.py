"""A policy as a function of delta alone, and its Jacobian there, one chunk of states at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.func import vjp, vmap

from condwrap.observation import States
from condwrap.policy import Policy, Select, check_select, flat_output, untouched


def read_states(obs: Any, select: Select) -> States:
    """The observations, `[B, *obs_shape]` or a dict of such, checked as the regularizer does."""
    check_select(select)
    return States.read(obs, obs_scale=None, batch_ndim=1)


def response(policy: Policy, states: States, select: Select) -> Callable[[Tensor], Tensor]:
    """The map from delta, `[B, n]`, to the output that counts, `[B, m]`."""

    def respond(delta: Tensor) -> Tensor:
        shifts = states.displacement(delta)
        moved = [x + shift for x, shift in zip(states.perturbed, shifts, strict=True)]
        with untouched(policy, states.device), torch.autocast(states.device.type, enabled=False):
            return flat_output(policy(states.obs(moved)), select, states.batch)

    return respond


def zero_delta(states: States) -> Tensor:
    """Where the Jacobian is taken, `[B, n]`."""
    return torch.zeros(*states.batch, sum(states.sizes), dtype=states.dtype, device=states.device)


def pullback(
    policy: Policy, states: States, select: Select
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """The output, `[B, m]`, and the map from w, `[B, m]`, to Jᵀ w, `[B, n]`."""
    output, pull = vjp(response(policy, states, select), zero_delta(states))[:2]

    def product(w: Tensor) -> Tensor:
        with torch.autocast(states.device.type, enabled=False):  # the backward pass heeds it too
            transposed: Tensor = pull(w)[0]
            return transposed

    return output, product


def jacobians(policy: Policy, states: States, select: Select, chunk_size: int) -> Iterator[Tensor]:
    """Jacobians of the states, `[chunk, m, n]`, by m vector-Jacobian products for each chunk."""
    for chunk in states.chunks(chunk_size):
        output, product = pullback(policy, chunk, select)
        m = output.shape[-1]
        rows = torch.eye(m, dtype=output.dtype, device=output.device)
        cotangents = rows[:, None].expand(m, *output.shape)  # output k of every state at once
        yield vmap(product)(cotangents).movedim(0, 1)
