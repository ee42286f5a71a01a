"""Errors that the penalties share."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from condwrap.observation import States


def require(penalty: str, reason: str, **given: Any) -> None:
    """Raise a ValueError that names what a penalty was not given, and why it needs it."""
    missing = [name for name, x in given.items() if x is None]
    if missing:
        raise ValueError(f"{penalty} needs {' and '.join(missing)}: {reason}")


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
