"""Pure maps from standard-normal noise to a perturbation delta.

Each takes noise `[..., n]`, one row for each state with all of its observation flattened, and
returns delta `[..., n]` in the same dtype. `radius` is the root-mean-square length of delta in all
three, E[‖delta‖²] = radius², so kinds of delta can be compared at one radius. The maps hold no
randomness: whoever draws the noise owns the generator. NumPy arrays and PyTorch tensors work in all
three, as does any other Array API array in `sphere` and `gaussian`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import array_api_compat
import torch

from condwrap.functional import Array, namespace, safe_norm

Perturbation = Callable[[Any], Any]  # noise [..., n] -> delta [..., n]


def sphere(noise: Array, radius: float = 1.0) -> Array:
    """Uniform direction, fixed length: delta = radius · noise / ‖noise‖. The default.

    Odena et al. (2018) perturb a generator's input so; it makes the divisor of equation (1) a
    constant.

    Args:
        noise: Standard-normal noise, `[..., n]`, floating.
        radius: ‖delta‖, above 0, in the units of the observation.

    Returns:
        delta, `[..., n]`, of length `radius` along the last axis.

    Raises:
        ValueError: `radius` is not a finite number above 0.

    Example:
        >>> import numpy as np
        >>> sphere(np.array([[3.0, 4.0]]), radius=2.0)
        array([[1.2, 1.6]])
    """
    check_radius(radius)
    namespace(noise=noise)
    return noise * (radius / safe_norm(noise))[..., None]


def gaussian(noise: Array, radius: float = 1.0) -> Array:
    """Independent normal coordinates: delta = radius / √n · noise.

    For a standard deviation s of each coordinate pass radius = s · √n.

    Args:
        noise: Standard-normal noise, `[..., n]`, floating.
        radius: Root-mean-square length of delta, above 0, in the units of the observation.

    Returns:
        delta, `[..., n]`.

    Raises:
        ValueError: `radius` is not a finite number above 0.

    Example:
        >>> import numpy as np
        >>> gaussian(np.array([[1.0, 2.0, 2.0, 0.0]]), radius=0.5)
        array([[0.25, 0.5 , 0.5 , 0.  ]])
    """
    check_radius(radius)
    namespace(noise=noise)
    return noise * (radius / math.sqrt(noise.shape[-1]))


def uniform(noise: Array, radius: float = 1.0) -> Array:
    """Independent uniform coordinates: delta = radius · √(3 / n) · erf(noise / √2).

    2·Phi(z) - 1 = erf(z / √2) maps a standard-normal z to the uniform distribution on (-1, 1),
    whose mean square is 1/3. For coordinates in (-a, a) pass radius = a · √(n / 3).

    Args:
        noise: Standard-normal noise, `[..., n]`, floating, a NumPy array or PyTorch tensor.
        radius: Root-mean-square length of delta, above 0, in the units of the observation.

    Returns:
        delta, `[..., n]`.

    Raises:
        TypeError: `noise` is neither a NumPy array nor a PyTorch tensor.
        ValueError: `radius` is not a finite number above 0.

    Example:
        >>> import numpy as np
        >>> uniform(np.array([[0.0, 0.0, 100.0]]), radius=2.0)
        array([[0., 0., 2.]])
    """
    check_radius(radius)
    namespace(noise=noise)
    half_width = radius * math.sqrt(3 / noise.shape[-1])
    if isinstance(noise, torch.Tensor):
        return half_width * torch.erf(noise / math.sqrt(2))
    if array_api_compat.is_numpy_array(noise):  # NumPy has no erf
        return half_width * torch.erf(torch.from_numpy(noise / math.sqrt(2))).numpy()
    raise TypeError(f"noise must be a NumPy array or a PyTorch tensor, got {type(noise).__name__}")


_NAMED: dict[str, Callable[..., Any]] = {
    "sphere": sphere,
    "gaussian": gaussian,
    "uniform": uniform,
}


def get_perturbation(perturbation: str | Perturbation, radius: float) -> Perturbation:
    """The map of that name and size; a callable is returned as it is.

    Raises:
        TypeError: `perturbation` is neither a name nor callable.
        ValueError: An unknown name, a radius that is not above 0, or a radius beside a callable.
    """
    check_radius(radius)
    if isinstance(perturbation, str):
        if perturbation not in _NAMED:
            raise ValueError(
                f"perturbation must be one of {sorted(_NAMED)} or a callable noise -> delta, "
                f"got {perturbation!r}"
            )
        return functools.partial(_NAMED[perturbation], radius=radius)
    if not callable(perturbation):
        raise TypeError(
            f"perturbation must be a name or a callable, got {type(perturbation).__name__}"
        )
    if radius != 1.0:
        raise ValueError(
            f"radius={radius} goes with a named perturbation; a callable sets its own size"
        )
    return perturbation


def check_radius(radius: float) -> None:
    """Raise ValueError unless `radius` is a finite number above 0."""
    if not (radius > 0 and math.isfinite(radius)):
        raise ValueError(f"radius must be finite and above 0, got {radius}")
