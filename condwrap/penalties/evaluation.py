"""How the penalties read observations and evaluate a policy: as `ConditioningRegularizer` does."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from condwrap.observation import States
from condwrap.policy import Policy, Select, check_reusable, flat_output, untouched


def evaluate(policy: Policy, states: States, delta: Tensor | None = None) -> Any:
    """policy(states + delta), delta `[B, n]`, without a trace in it and without autocast.

    Two evaluations draw the same dropout masks, as `condwrap.policy.untouched` says.
    """
    moved = states.perturbed
    if delta is not None:
        shifts = states.displacement(delta)
        moved = [x + shift for x, shift in zip(moved, shifts, strict=True)]
    with untouched(policy, states.device), torch.autocast(states.device.type, enabled=False):
        return policy(states.obs(moved))


def clean_output(policy: Policy, states: States, output: Any, select: Select) -> Tensor:
    """The output that counts at the given states, `[B, m]`, from `output` where that is known."""
    if output is None:
        return flat_output(evaluate(policy, states), select, states.batch)
    check_reusable(policy)
    return flat_output(output, select, states.batch, known=True)


def successors(states: States, next_obs: Any, dones: Tensor | None) -> tuple[States, Tensor]:
    """The states that followed, and which of them count, `[B]` bool.

    Where an episode ended, the state follows itself, so that whatever `next_obs` holds there, such
    as the first observation of another episode or NaN, reaches neither the policy nor a gradient.

    Raises:
        TypeError, ValueError: `next_obs` does not match `obs`, or `dones` is not `[B]`.
    """
    leaves, spec = pytree.tree_flatten(next_obs)
    got = [tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__ for x in leaves]
    want = [tuple(x.shape) for x in states.tensors]
    if spec != states.spec or got != want:
        raise ValueError(f"next_obs must match obs, leaves of shape {want}, got {got}")
    if not (isinstance(dones, Tensor) and dones.shape == states.batch):
        shape = tuple(dones.shape) if isinstance(dones, Tensor) else type(dones).__name__
        raise ValueError(
            f"dones must be a tensor of shape {tuple(states.batch)}, one for each state, got "
            f"{shape}: where no episode ends, pass torch.zeros({len(states.tensors[0])})"
        )

    done = dones.bool()
    kept = []
    for here, there in zip(states.tensors, leaves, strict=True):
        ended = done.reshape(-1, *[1] * (here.ndim - 1))  # [B, 1, ..., 1]
        kept.append(torch.where(ended, here, there.to(here.dtype)))
    return States.read(pytree.tree_unflatten(kept, spec), None, 1), ~done


def masked_mean(x: Tensor, valid: Tensor) -> Tensor:
    """Mean of x, `[B, ...]`, over the states that count, `[B]`; 0 if none does."""
    rows = x.reshape(len(x), -1)
    total = torch.where(valid[:, None], rows, 0.0).sum()
    return total / (valid.sum() * rows.shape[1]).clamp(min=1)
