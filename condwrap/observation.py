"""A batch of observations as the regularizer sees it: which leaves move, and how far."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

IMAGE_SCALE = 255.0  # uint8 observations are images, which policies divide by 255


@dataclasses.dataclass(frozen=True)
class States:
    """A batch of observations, a tensor or a dict of tensors, taken apart.

    Floating leaves are perturbed as they are, uint8 leaves in units of 255; beside these, other
    integer and boolean leaves (a Discrete space, a mask) pass through. Below, "perturbed leaves"
    are those with a scale, in the observation's order.
    """

    leaves: list[Tensor]
    scales: list[float | None]  # what a unit of delta is in the leaf's own units; None passes
    spec: Any
    batch_ndim: int

    @classmethod
    def read(cls, obs: Any, obs_scale: float | None, batch_ndim: int) -> States:
        """Take an observation apart and check it."""
        leaves, spec = pytree.tree_flatten(obs)
        for leaf in leaves:
            if not isinstance(leaf, Tensor):
                raise TypeError(
                    f"obs must be a Tensor or a dict of Tensors, got {type(leaf).__name__}"
                )
        if leaves and torch.is_autocast_enabled(leaves[0].device.type):  # J is taken in float32
            half = (torch.bfloat16, torch.float16)
            leaves = [leaf.float() if leaf.dtype in half else leaf for leaf in leaves]
        scales = [_scale(leaf.dtype, obs_scale) for leaf in leaves]
        if not any(scales):
            kinds = ", ".join(str(leaf.dtype) for leaf in leaves) or "no tensor"
            raise TypeError(
                f"obs must be floating or uint8, got {kinds}: for integers that the policy "
                "divides, pass obs_scale=<the divisor>"
            )
        shapes = [tuple(leaf.shape) for leaf in leaves]
        batch = shapes[0][:batch_ndim]
        if any(len(s) < batch_ndim or s[:batch_ndim] != batch for s in shapes):
            raise ValueError(
                f"obs needs batch_ndim={batch_ndim} leading axes that its leaves share, "
                f"got shapes {shapes}"
            )
        if math.prod(batch) == 0:
            raise ValueError(f"obs must not be empty, got shapes {shapes}")
        floating = [leaf for leaf in leaves if leaf.is_floating_point()]
        compiling = torch.compiler.is_compiling()  # a graph holds no branch on data
        if not (compiling or all(_is_finite(leaf) for leaf in floating)):
            raise ValueError("obs must be finite, got NaN or infinity")
        return cls(leaves, scales, spec, batch_ndim)

    @property
    def batch(self) -> torch.Size:
        return self.leaves[0].shape[: self.batch_ndim]

    @property
    def device(self) -> torch.device:
        return self.leaves[0].device

    @property
    def dtype(self) -> torch.dtype:
        """Of delta: float64 for float64 observations, float32 otherwise."""
        wide = any(leaf.dtype == torch.float64 for leaf in self.leaves)
        return torch.float64 if wide else torch.float32

    @property
    def perturbed(self) -> list[Tensor]:
        """The perturbed leaves, made floating."""
        leaves = zip(self.leaves, self.scales, strict=True)
        return [x if x.is_floating_point() else x.float() for x, scale in leaves if scale]

    @property
    def sizes(self) -> list[int]:
        """Coordinates of each perturbed leaf in one state."""
        leaves = zip(self.leaves, self.scales, strict=True)
        return [math.prod(x.shape[self.batch_ndim :]) for x, scale in leaves if scale]

    def subset(self, fraction: float) -> States:
        """ceil(fraction · B) states, evenly spaced along the first axis."""
        size = self.leaves[0].shape[0]
        count = math.ceil(fraction * size - 1e-9)  # 0.55 · 100 is 55.00000000000001
        if count == size:
            return self
        index = torch.arange(count, device=self.device) * size // count
        return dataclasses.replace(self, leaves=[leaf[index] for leaf in self.leaves])

    def chunks(self, size: int) -> list[States]:
        """The same states, at most `size` at a time along the first axis."""
        parts = zip(*(torch.split(leaf, size) for leaf in self.leaves), strict=True)
        return [dataclasses.replace(self, leaves=list(leaves)) for leaves in parts]

    def obs(self, perturbed: Sequence[Tensor]) -> Any:
        """The observation, in its structure, with these perturbed leaves."""
        new = iter(perturbed)
        leaves = zip(self.leaves, self.scales, strict=True)
        return pytree.tree_unflatten([next(new) if scale else x for x, scale in leaves], self.spec)

    def displacement(self, delta: Tensor) -> list[Tensor]:
        """What a flat delta, `[*batch, n]`, adds to each perturbed leaf, in that leaf's units."""
        parts = iter(torch.split(delta, self.sizes, -1))
        leaves = zip(self.leaves, self.scales, strict=True)
        shifts = [(x, next(parts).reshape(x.shape), scale) for x, scale in leaves if scale]
        # the scale of a floating leaf is 1
        return [s.to(x.dtype) if x.is_floating_point() else s.float() * k for x, s, k in shifts]

    def unflatten(self, delta: Tensor) -> Any:
        """A flat delta, `[*batch, n]`, in the observation's structure; None where a leaf passes."""
        parts = iter(torch.split(delta, self.sizes, -1))
        leaves = zip(self.leaves, self.scales, strict=True)
        tree = [next(parts).reshape(x.shape) if scale else None for x, scale in leaves]
        return pytree.tree_unflatten(tree, self.spec)

    def flatten(self, delta: Any) -> Tensor:
        """A delta in the observation's structure, checked, as `[*batch, n]`."""
        try:
            leaves = self.spec.flatten_up_to(delta)  # a dict by its keys, not by their order
        except ValueError:
            leaves = pytree.tree_leaves(delta)
        got = [_shape(x) for x in leaves]
        perturbed = zip(self.leaves, self.scales, strict=True)
        want = [tuple(x.shape) if scale else None for x, scale in perturbed]
        if got != want:
            raise ValueError(
                f"delta must match the perturbed states, leaves of shape {want}, got {got}: "
                "sample_delta(obs) draws one that does"
            )
        parts = [x.reshape(*self.batch, -1) for x in leaves if x is not None]
        if not all(x.is_floating_point() for x in parts):
            raise TypeError(f"delta must be floating, got {[str(x.dtype) for x in parts]}")
        return torch.cat(parts, -1)


def _scale(dtype: torch.dtype, obs_scale: float | None) -> float | None:
    if dtype.is_floating_point:
        return 1.0
    if dtype == torch.bool:
        return None
    return IMAGE_SCALE if dtype == torch.uint8 and obs_scale is None else obs_scale


def _is_finite(x: Tensor) -> bool:
    # a finite sum, which costs less, has finite terms; of large ones it may overflow
    return math.isfinite(x.detach().sum()) or bool(torch.isfinite(x).all())


def _shape(x: Any) -> tuple[int, ...] | str | None:
    if isinstance(x, Tensor):
        return tuple(x.shape)
    return None if x is None else type(x).__name__
