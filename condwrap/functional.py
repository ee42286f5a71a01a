"""Equations (1) and (2) of the paper as pure functions on any Array API namespace.

The paper is Asadulaev et al., "Conditioning of Reinforcement Learning Agents and its Policy
Regularization Application" (arXiv 1906.05437); the method is Jacobian Clamping (Odena et al.,
2018, arXiv 1802.08768). NumPy, PyTorch, JAX and CuPy arrays work, on any device; PyTorch and JAX
differentiate through both functions, and `torch.compile(fullgraph=True)` and `jax.jit` trace them.
"""

from __future__ import annotations

import math
from typing import Any

import array_api_compat
import array_api_compat.torch
import torch

Array = Any  # an array of any Array API namespace; the standard has no common base class


def conditioning_quotient(
    output: Array, perturbed_output: Array, delta: Array, *, batch_ndim: int = 1
) -> Array:
    """Sensitivity of a policy to a perturbation of its observations, equation (1).

    J = ‖output - perturbed_output‖ / ‖delta‖, Euclidean norms over all axes but the first
    `batch_ndim`. Where delta is exactly 0 the divisor is taken as 1, so J is 0 there for a
    deterministic policy. The gradient is 0, not NaN, where the two outputs are equal.

    Args:
        output: pi(S), `[*batch, *out_shape]`, floating.
        perturbed_output: pi(S + delta), same shape and namespace.
        delta: The perturbation, `[*batch, *obs_shape]`, floating.
        batch_ndim: Number of leading axes that index states; 0 gives one J for the whole batch.

    Returns:
        J, `[*batch]`, at least 0, in the inputs' (promoted) dtype.

    Raises:
        TypeError: An input is no array, is not floating, or the inputs' namespaces differ.
        ValueError: Shapes do not fit together, or `batch_ndim` is not in [0, ndim].

    Example:
        >>> import numpy as np
        >>> mean, perturbed_mean = np.array([[0.0, 0.0]]), np.array([[3.0, 4.0]])
        >>> conditioning_quotient(mean, perturbed_mean, delta=np.array([[0.0, 0.0, 2.0]]))
        array([2.5])
    """
    xp = namespace(output=output, perturbed_output=perturbed_output, delta=delta)
    if output.shape != perturbed_output.shape:
        raise ValueError(
            f"output and perturbed_output need the same shape, got {tuple(output.shape)} "
            f"and {tuple(perturbed_output.shape)}"
        )
    most = min(output.ndim, delta.ndim)
    if not 0 <= batch_ndim <= most:
        raise ValueError(
            f"batch_ndim must be in [0, {most}] for an output of shape {tuple(output.shape)} "
            f"and a delta of shape {tuple(delta.shape)}, got {batch_ndim}"
        )
    if output.shape[:batch_ndim] != delta.shape[:batch_ndim]:
        raise ValueError(
            f"output and delta need the same {batch_ndim} leading axes, got shapes "
            f"{tuple(output.shape)} and {tuple(delta.shape)}"
        )
    change = safe_norm(_flatten(xp, output - perturbed_output, batch_ndim))
    length = safe_norm(_flatten(xp, delta, batch_ndim))
    return change / xp.where(length > 0, length, xp.ones_like(length))


def clamping_penalty(quotient: Array, lambda_min: float = 1.0, lambda_max: float = 20.0) -> Array:
    """Squared distance of J from the range [lambda_min, lambda_max], equations (2a) to (2c).

    psi = (max(J, lambda_max) - lambda_max)² + (min(J, lambda_min) - lambda_min)²

    At most one term is not 0, so psi is computed as (J - clip(J, lambda_min, lambda_max))².

    Args:
        quotient: J, any shape, floating.
        lambda_min: Lower end of the range, at least 0; 0 switches the lower clamp off.
        lambda_max: Upper end, at least `lambda_min`; infinity switches the upper clamp off.

    Returns:
        psi, the shape and dtype of `quotient`.

    Raises:
        TypeError: `quotient` is no array or not floating.
        ValueError: Not 0 <= lambda_min <= lambda_max.

    Example:
        >>> import numpy as np
        >>> clamping_penalty(np.array([0.5, 1.0, 7.0, 20.0, 23.0]))
        array([0.25, 0.  , 0.  , 0.  , 9.  ])
    """
    xp = namespace(quotient=quotient)
    check_range(lambda_min, lambda_max)
    return (quotient - xp.clip(quotient, lambda_min, lambda_max)) ** 2


def check_range(lambda_min: float, lambda_max: float) -> None:
    """Raise ValueError unless 0 <= lambda_min <= lambda_max and lambda_min is finite."""
    if not (0 <= lambda_min <= lambda_max and math.isfinite(lambda_min)):
        raise ValueError(
            "the range needs 0 <= lambda_min <= lambda_max with lambda_min finite, "
            f"got lambda_min={lambda_min} and lambda_max={lambda_max}"
        )


def safe_norm(x: Array) -> Array:
    """Euclidean norm over the last axis, `[..., n]` to `[...]`, with gradient 0 at 0."""
    xp = namespace(x=x)
    squares = xp.sum(x * x, axis=-1)
    zero = squares == 0  # not squares > 0: a NaN stays one
    # Two `where`s: with one alone, JAX multiplies the infinite slope of sqrt at 0 by 0.
    root = xp.sqrt(xp.where(zero, xp.ones_like(squares), squares))
    return xp.where(zero, xp.zeros_like(squares), root)


def _flatten(xp: Any, x: Array, batch_ndim: int) -> Array:
    # [*batch, *shape] -> [*batch, n]; -1 would be ambiguous for an empty batch
    return xp.reshape(x, (*x.shape[:batch_ndim], math.prod(x.shape[batch_ndim:])))


def namespace(**arrays: Array) -> Any:
    """The Array API namespace that all the named arrays share, their dtypes checked."""
    if all(isinstance(x, torch.Tensor) for x in arrays.values()):
        xp = array_api_compat.torch  # found without the look-up, which dynamo traces with warnings
    else:
        for name, x in arrays.items():
            if not array_api_compat.is_array_api_obj(x):
                raise TypeError(f"{name} must be an array, got {type(x).__name__}")
        try:
            xp = array_api_compat.array_namespace(*arrays.values())
        except TypeError as error:
            kinds = ", ".join(f"{name} {type(x).__name__}" for name, x in arrays.items())
            raise TypeError(f"arrays of one library are needed, got {kinds}") from error
    for name, x in arrays.items():
        if not xp.isdtype(x.dtype, "real floating"):
            raise TypeError(f"{name} must be floating, got {x.dtype}")
    return xp
