"""A batch of observations as the regularizer sees it: which leaves move, and how far."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

IMAGE_SCALE = 255.0  # uint8 observations are images, which policies divide by 255


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One tensor of an observation, and what a unit of delta is in its own units."""

    tensor: Tensor
    scale: float
    """1 for floating tensors, the divisor of integer ones, 0 for a leaf that passes through"""

    @property
    def floating(self) -> Tensor:
        return self.tensor if self.tensor.is_floating_point() else self.tensor.float()

    def displacement(self, part: Tensor) -> Tensor:
        """What its part of a flat delta adds to `floating`."""
        shift = part.reshape(self.tensor.shape)
        if self.tensor.is_floating_point():
            return shift.to(self.tensor.dtype)  # its scale is 1
        return shift.float() * self.scale


@dataclasses.dataclass(frozen=True)
class States:
    """A batch of observations, a tensor or a dict of tensors, taken apart.

    Floating leaves are perturbed as they are, uint8 leaves in units of 255; beside these, other
    integer and boolean leaves (a Discrete space, a mask) pass through. Below, "perturbed leaves"
    are those with a scale, in the observation's order.
    """

    leaves: list[Leaf]
    spec: Any
    batch_ndim: int

    @classmethod
    def read(cls, obs: Any, obs_scale: float | None, batch_ndim: int) -> States:
        """Take an observation apart and check it."""
        tensors, spec = pytree.tree_flatten(obs)
        for x in tensors:
            if not isinstance(x, Tensor):
                raise TypeError(
                    f"obs must be a Tensor or a dict of Tensors, got {type(x).__name__}"
                )
        if tensors and torch.is_autocast_enabled(tensors[0].device.type):
            tensors = [_at_least_float32(x) for x in tensors]

        leaves = [Leaf(x, _scale(x.dtype, obs_scale)) for x in tensors]
        if not any(leaf.scale for leaf in leaves):
            kinds = ", ".join(str(x.dtype) for x in tensors) or "no tensor"
            raise TypeError(
                f"obs must be floating or uint8, got {kinds}: for integers that the policy "
                "divides, pass obs_scale=<the divisor>"
            )

        _check_shapes([tuple(x.shape) for x in tensors], batch_ndim)
        floating = [x for x in tensors if x.is_floating_point()]
        compiling = torch.compiler.is_compiling()  # a graph holds no branch on data
        if not (compiling or all(_is_finite(x) for x in floating)):
            raise ValueError("obs must be finite, got NaN or infinity")
        return cls(leaves, spec, batch_ndim)

    @property
    def tensors(self) -> list[Tensor]:
        return [leaf.tensor for leaf in self.leaves]

    @property
    def batch(self) -> torch.Size:
        return self.tensors[0].shape[: self.batch_ndim]

    @property
    def device(self) -> torch.device:
        return self.tensors[0].device

    @property
    def dtype(self) -> torch.dtype:
        """Of delta: float64 for float64 observations, float32 otherwise."""
        wide = any(x.dtype == torch.float64 for x in self.tensors)
        return torch.float64 if wide else torch.float32

    @property
    def moving(self) -> list[Leaf]:
        """The perturbed leaves."""
        return [leaf for leaf in self.leaves if leaf.scale]

    @property
    def perturbed(self) -> list[Tensor]:
        """The perturbed leaves' tensors, made floating."""
        return [leaf.floating for leaf in self.moving]

    @property
    def sizes(self) -> list[int]:
        """Coordinates of each perturbed leaf in one state."""
        return [math.prod(leaf.tensor.shape[self.batch_ndim :]) for leaf in self.moving]

    def with_tensors(self, tensors: Iterable[Tensor]) -> States:
        """The same leaves with other tensors, such as some of the states."""
        pairs = zip(self.leaves, tensors, strict=True)
        return dataclasses.replace(self, leaves=[Leaf(x, leaf.scale) for leaf, x in pairs])

    def subset(self, fraction: float) -> States:
        """ceil(fraction · B) states, evenly spaced along the first axis."""
        if fraction == 1:
            return self
        return self.with_tensors(take_evenly(x, fraction) for x in self.tensors)

    def chunks(self, size: int) -> list[States]:
        """The same states, at most `size` at a time along the first axis."""
        parts = zip(*(torch.split(x, size) for x in self.tensors), strict=True)
        return [self.with_tensors(tensors) for tensors in parts]

    def obs(self, perturbed: Sequence[Tensor]) -> Any:
        """The observation, in its structure, with these perturbed leaves."""
        new = iter(perturbed)
        tensors = [next(new) if leaf.scale else leaf.tensor for leaf in self.leaves]
        return pytree.tree_unflatten(tensors, self.spec)

    def displacement(self, delta: Tensor) -> list[Tensor]:
        """What a flat delta, `[*batch, n]`, adds to each perturbed leaf, in that leaf's units."""
        parts = torch.split(delta, self.sizes, -1)
        pairs = zip(self.moving, parts, strict=True)
        return [leaf.displacement(part) for leaf, part in pairs]

    def unflatten(self, delta: Tensor) -> Any:
        """A flat delta, `[*batch, n]`, in the observation's structure; None where a leaf passes."""
        parts = iter(torch.split(delta, self.sizes, -1))
        tree = [
            next(parts).reshape(leaf.tensor.shape) if leaf.scale else None for leaf in self.leaves
        ]
        return pytree.tree_unflatten(tree, self.spec)

    def flatten(self, delta: Any) -> Tensor:
        """A delta in the observation's structure, checked, as `[*batch, n]`."""
        try:
            given = self.spec.flatten_up_to(delta)  # a dict by its keys, not by their order
        except ValueError:
            given = pytree.tree_leaves(delta)

        got = [_shape(x) for x in given]
        want = [tuple(leaf.tensor.shape) if leaf.scale else None for leaf in self.leaves]
        if got != want:
            raise ValueError(
                f"delta must match the perturbed states, leaves of shape {want}, got {got}: "
                "sample_delta(obs) draws one that does"
            )
        parts = [x.reshape(*self.batch, -1) for x in given if x is not None]
        if not all(x.is_floating_point() for x in parts):
            raise TypeError(f"delta must be floating, got {[str(x.dtype) for x in parts]}")
        return torch.cat(parts, -1)


def take_evenly(x: Tensor, fraction: float) -> Tensor:
    """ceil(fraction · B) rows of x, `[B, ...]`, evenly spaced."""
    size = x.shape[0]
    count = math.ceil(fraction * size - 1e-9)  # 0.55 · 100 is 55.00000000000001
    if count == size:
        return x
    return x[torch.arange(count, device=x.device) * size // count]


def _check_shapes(shapes: list[tuple[int, ...]], batch_ndim: int) -> None:
    batch = shapes[0][:batch_ndim]
    if any(len(s) < batch_ndim or s[:batch_ndim] != batch for s in shapes):
        raise ValueError(
            f"obs needs batch_ndim={batch_ndim} leading axes that its leaves share, "
            f"got shapes {shapes}"
        )
    if math.prod(batch) == 0:
        raise ValueError(f"obs must not be empty, got shapes {shapes}")


def _at_least_float32(x: Tensor) -> Tensor:
    return x.float() if x.dtype in (torch.bfloat16, torch.float16) else x


def _scale(dtype: torch.dtype, obs_scale: float | None) -> float:
    if dtype.is_floating_point:
        return 1.0
    if dtype == torch.bool:
        return 0.0
    if obs_scale is None:
        return IMAGE_SCALE if dtype == torch.uint8 else 0.0
    return obs_scale


def _is_finite(x: Tensor) -> bool:
    # a finite sum, which costs less, has finite terms; of large ones it may overflow
    return math.isfinite(x.detach().sum()) or bool(torch.isfinite(x).all())


def _shape(x: Any) -> tuple[int, ...] | str | None:
    if isinstance(x, Tensor):
        return tuple(x.shape)
    return None if x is None else type(x).__name__
