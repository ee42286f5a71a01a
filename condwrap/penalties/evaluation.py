"""How the penalties read observations and evaluate a policy: as `ConditioningRegularizer` does."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch import distributions as td
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


def find_distribution(output: Any, states: States, penalty: str) -> td.Distribution:
    """The distribution that a policy returned, alone or beside tensors.

    Raises:
        TypeError: There is none, or there are several.
        ValueError: It lost the batch axis.
    """
    found = [x for x in pytree.tree_leaves(output) if isinstance(x, td.Distribution)]
    if len(found) != 1:
        raise TypeError(
            f"{penalty} needs a policy that returns one torch.distributions.Distribution, got "
            f"{len(found)} in a {type(output).__name__}: wrap the policy, such as "
            "lambda obs: torch.distributions.Normal(mean(obs), std)"
        )
    distribution: td.Distribution = found[0]
    if distribution.batch_shape[:1] != states.batch:
        raise ValueError(
            f"the policy's distribution must begin with the batch axis {tuple(states.batch)} of "
            f"the observations, got batch shape {tuple(distribution.batch_shape)}"
        )
    return distribution


def per_state(x: Tensor) -> Tensor:
    """Sum over all axes but the first, `[B, ...]` to `[B]`: of log-probabilities and of KL."""
    return x.reshape(len(x), -1).sum(-1)


def read_value(output: Any, states: States, source: str) -> Tensor:
    """V of each state, `[B]`, from what a critic returned: `[B]` or `[B, 1]`.

    Raises:
        ValueError: It is something else.
    """
    batch = tuple(states.batch)
    if isinstance(output, Tensor) and output.shape in (batch, (*batch, 1)):
        return output.reshape(batch)
    got = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
    raise ValueError(f"{source} must be a tensor of shape {batch} or {(*batch, 1)}, got {got}")


def require(penalty: str, reason: str, **given: Any) -> None:
    """Raise a ValueError that names what a penalty was not given, and why it needs it."""
    missing = [name for name, x in given.items() if x is None]
    if missing:
        raise ValueError(f"{penalty} needs {' and '.join(missing)}: {reason}")


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


def check_weight(name: str, weight: float) -> float:
    """Return a weight, or raise a ValueError unless it is finite and at least 0."""
    if not (weight >= 0 and math.isfinite(weight)):
        raise ValueError(f"{name} must be finite and at least 0, got {weight}")
    return weight


def check_length(name: str, length: float) -> float:
    """Return a length, or raise a ValueError unless it is finite and above 0."""
    if not (length > 0 and math.isfinite(length)):
        raise ValueError(f"{name} must be finite and above 0, got {length}")
    return length


def check_count(name: str, count: int) -> int:
    """Return a count, or raise a ValueError unless it is at least 1."""
    if count < 1:
        raise ValueError(f"{name} must be at least 1, got {count}")
    return count
