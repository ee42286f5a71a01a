"""The ball of perturbations that an attack may choose from, and what an attack does with it."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Literal, get_args

import torch
from torch import Tensor

from condwrap.functional import safe_norm

Norm = Literal["linf", "l2"]


@dataclasses.dataclass(frozen=True)
class Ball:
    """{delta : ‖delta‖ <= radius}, one for each row of a `[B, n]` tensor."""

    radius: float
    """length of the longest perturbation, at least 0, in the units of the observation"""
    norm: Norm
    """"linf" bounds each number by itself, "l2" the Euclidean length over all of them"""

    def __post_init__(self) -> None:
        if isinstance(self.radius, bool) or not isinstance(self.radius, int | float):
            raise TypeError(f"radius must be a number, got {type(self.radius).__name__}")
        if not (self.radius >= 0 and math.isfinite(self.radius)):
            raise ValueError(f"radius must be finite and at least 0, got {self.radius}")
        if self.norm not in get_args(Norm):
            raise ValueError(f"norm must be one of {list(get_args(Norm))}, got {self.norm!r}")

    def draw(self, shape: tuple[int, int], like: Tensor, generator: torch.Generator) -> Tensor:
        """Uniform over the ball, `[rows, n]`, of the dtype and on the device of `like`."""
        new = functools.partial(torch.empty, dtype=like.dtype, device=generator.device)
        if self.norm == "linf":
            uniform = new(shape).uniform_(-1, 1, generator=generator)
            return self.project(self.radius * uniform.to(like.device))

        # a uniform direction, at a distance whose n-th power is uniform
        rows, size = shape
        direction = _polar(new(shape).normal_(generator=generator))[1]
        distance = new((rows, 1)).uniform_(generator=generator) ** (1 / size)
        return self.project(self.radius * (distance * direction).to(like.device))

    def steepest(self, gradient: Tensor) -> Tensor:
        """The direction of norm 1 along which a function of this gradient grows fastest."""
        return gradient.sign() if self.norm == "linf" else _polar(gradient)[1]

    def project(self, delta: Tensor) -> Tensor:
        """The nearest point of the ball, row by row."""
        if self.norm == "linf":
            return delta.clamp(-self.radius, self.radius)
        length, direction = _polar(delta)
        return torch.where(length > self.radius, self.radius * direction, delta)


def _polar(x: Tensor) -> tuple[Tensor, Tensor]:
    """Length of each row, `[rows, 1]`, and its direction; rows of zeros have the direction 0.

    Rows are scaled first: float32 cannot hold the square of 1e-30.
    """
    largest = x.abs().amax(-1, keepdim=True)
    scaled = x / torch.where(largest > 0, largest, 1.0)
    length = safe_norm(scaled)[:, None]
    return largest * length, scaled / torch.where(length > 0, length, 1.0)
