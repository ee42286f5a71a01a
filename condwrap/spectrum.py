"""Singular values of a policy's input-output Jacobian: exactly, and without holding the Jacobian.

The Jacobian of a state is d output / d delta at delta = 0, `[m, n]` for m outputs and n observed
numbers: the limit of what equation (1) of the paper estimates along one direction. For delta
uniform on a small sphere, E[J²] = ‖Jacobian‖_F² / n. Every function takes a policy, observations
and an output as `ConditioningRegularizer` does, leaves the policy and the global random state as
they were, and can be differentiated, so that each can serve as a penalty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.func import jvp, vmap

from condwrap.functional import safe_norm
from condwrap.jacobian import jacobians, pullback, read_states, response, zero_delta
from condwrap.policy import Policy, Select

Product = Callable[[Tensor], Tensor]


def jacobian_singular_values(
    policy: Policy, obs: Any, *, select: Select = "default", chunk_size: int | None = None
) -> Tensor:
    """All singular values of each state's Jacobian, largest first, `[B, min(m, n)]`.

    The Jacobian takes m vector-Jacobian products. If it is float32 and at least twice as long as
    wide, the eigenvalues of its smaller Gram matrix follow in float64, which took a third to all of
    the time of an SVD in float32; otherwise an SVD. Either way the error is about 1e-7 of the
    largest singular value in float32, 1e-16 in float64.

    Args:
        policy: Any callable obs -> tensor, distribution, or tuple or dict of them.
        obs: `[B, *obs_shape]`, floating or uint8 (in units of 255), or a dict of these.
        select: Which tensor of the policy's output counts.
        chunk_size: States whose Jacobians are held at a time, at least 1; by default all.

    Raises:
        TypeError, ValueError: As for `ConditioningRegularizer`, or a chunk_size below 1.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> jacobian_singular_values(policy, torch.ones(1, 3)).tolist()
        [[3.0, 2.0]]
    """
    parts = _jacobians(policy, obs, select, chunk_size)
    return torch.cat(list(map(singular_values, parts)))  # a loop's name would hold a second chunk


def condition_number(
    policy: Policy, obs: Any, *, select: Select = "default", chunk_size: int | None = None
) -> Tensor:
    """Largest over smallest singular value of each state's Jacobian, `[B]`, in [1, infinity].

    Args, errors and accuracy are those of `jacobian_singular_values`. For the logits or
    probabilities of a Categorical, which have one output too many, it is infinite up to rounding.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> condition_number(policy, torch.ones(1, 3)).tolist()
        [1.5]
    """
    values = jacobian_singular_values(policy, obs, select=select, chunk_size=chunk_size)
    zero = values[:, -1] == 0
    return (values[:, 0] / values[:, -1].masked_fill(zero, 1.0)).masked_fill(zero, torch.inf)


def mean_squared_singular_value(
    policy: Policy, obs: Any, *, select: Select = "default", chunk_size: int | None = None
) -> Tensor:
    """Mean squared singular value of each state's Jacobian, `[B]`: ‖Jacobian‖_F² / min(m, n).

    Dynamical isometry asks that it be of order 1 (Pennington et al., 2017, arXiv 1711.04735). Needs
    no decomposition. Args and errors are those of `jacobian_singular_values`.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> mean_squared_singular_value(policy, torch.ones(1, 3)).tolist()
        [6.5]
    """
    parts = _jacobians(policy, obs, select, chunk_size)
    return torch.cat(list(map(_mean_square, parts)))


def largest_singular_value(
    policy: Policy,
    obs: Any,
    *,
    iterations: int = 20,
    select: Select = "default",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Largest singular value of each state's Jacobian without holding it, `[B]`, from below.

    Lanczos bidiagonalization (Golub and Kahan, 1965) with full reorthogonalization: V spans the
    iterates, U their images, and v is the direction that Uᵀ J V stretches most. The result is
    ‖J v‖, with v detached: where v has converged, the gradient is exact. Each iteration costs a
    forward-mode and a reverse-mode product, as one of power iteration does, and memory for m + n
    numbers a state. After min(m, n) iterations, where it stops, the result is exact.

    Args:
        policy: As for `jacobian_singular_values`; its operations need a forward mode.
        obs: As for `jacobian_singular_values`.
        iterations: The largest number of them, at least 1.
        select: Which tensor of the policy's output counts.
        generator: Draws the first v; by default a new one of seed 0.

    Raises:
        TypeError, ValueError: As for `ConditioningRegularizer`, or iterations below 1.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> round(largest_singular_value(policy, torch.ones(1, 3)).item(), 4)
        3.0
    """
    _at_least_1("iterations", iterations)
    states = read_states(obs, select)
    respond, at = response(policy, states, select), zero_delta(states)
    first = _normalize(_noise(at.shape, at, generator))
    with torch.no_grad(), torch.autocast(states.device.type, enabled=False):
        output, transposed_product = pullback(policy, states, select)
        v = _stretched_most(
            lambda v: jvp(respond, (at,), (v,))[1],
            transposed_product,
            first,
            min(iterations, output.shape[-1], at.shape[-1]),
        )
    largest: Tensor = safe_norm(jvp(respond, (at,), (v,))[1])
    return largest


def _stretched_most(
    product: Product, transposed_product: Product, first: Tensor, iterations: int
) -> Tensor:
    """The unit vector v, `[B, n]`, that Uᵀ J V stretches most; V and U hold Lanczos vectors."""
    rights = first[:, None]  # v_1 to v_k, [B, k, n]
    lefts = first.new_zeros(len(first), 0, 0)  # u_1 to u_k, [B, k, m]
    diagonal: list[Tensor] = []
    above: list[Tensor] = []  # J V = U (bidiagonal matrix)
    for k in range(iterations):
        # alpha u_k = J v_k - beta u_{k-1}
        left = product(rights[:, k])
        if k:
            left = _orthogonal_to(lefts, left)
        diagonal.append(safe_norm(left))
        left = _normalize(left)[:, None]
        lefts = torch.cat([lefts, left], 1) if k else left

        # beta v_{k+1} = Jᵀ u_k - alpha v_k
        right = _orthogonal_to(rights, transposed_product(lefts[:, k]))
        above.append(safe_norm(right))
        rights = torch.cat([rights, _normalize(right)[:, None]], 1)

    # Uᵀ J V, upper bidiagonal, [B, k, k + 1]
    matrix = torch.diag_embed(torch.stack(diagonal, -1))
    matrix = torch.nn.functional.pad(matrix, (0, 1))
    matrix = matrix + torch.diag_embed(torch.stack(above, -1), offset=1)[:, :-1]
    values = torch.linalg.svd(matrix.nan_to_num())  # of a NaN, LAPACK makes an error
    return _normalize(torch.einsum("bk,bkn->bn", values.Vh[:, 0], rights))


def _orthogonal_to(basis: Tensor, x: Tensor) -> Tensor:
    """x, `[B, n]`, without its part in the span of the basis, `[B, k, n]`, whose rows are units.

    Twice is enough (Giraud et al., 2005).
    """
    for _ in range(2):
        x = x - torch.einsum("bk,bkn->bn", torch.einsum("bkn,bn->bk", basis, x), basis)
    return x


def squared_frobenius_norm(
    policy: Policy,
    obs: Any,
    *,
    probes: int = 1,
    select: Select = "default",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Unbiased estimate of ‖Jacobian‖_F² of each state, `[B]`: the mean of ‖Jᵀ w‖² (Hutchinson).

    w has independent entries of ±1. Each probe costs a vector-Jacobian product, and the Jacobian is
    never held.

    Args:
        policy: As for `jacobian_singular_values`.
        obs: As for `jacobian_singular_values`.
        probes: Number of w, at least 1; the estimate's standard deviation falls as 1/√probes.
        select: Which tensor of the policy's output counts.
        generator: Draws w; by default a new one of seed 0.

    Raises:
        TypeError, ValueError: As for `ConditioningRegularizer`, or probes below 1.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> round(squared_frobenius_norm(policy, torch.ones(1, 3)).item(), 4)
        13.0
    """
    _at_least_1("probes", probes)
    states = read_states(obs, select)
    output, product = pullback(policy, states, select)
    w = _noise((probes, *output.shape), output, generator).sign()
    products: Tensor = vmap(product)(w)
    return products.square().sum(-1).mean(0)


def _jacobians(
    policy: Policy, obs: Any, select: Select, chunk_size: int | None
) -> Iterator[Tensor]:
    states = read_states(obs, select)
    if chunk_size is not None:
        _at_least_1("chunk_size", chunk_size)
    return jacobians(policy, states, select, chunk_size or states.batch[0])


def _mean_square(jacobian: Tensor) -> Tensor:
    return jacobian.square().sum((1, 2)) / min(jacobian.shape[1:])


def singular_values(jacobian: Tensor) -> Tensor:
    """Of Jacobians that are held, `[B, m, n]`: `[B, min(m, n)]`, largest first; NaN where it is.

    Example:
        >>> singular_values(torch.diag(torch.tensor([2.0, 3.0]))[None]).tolist()
        [[3.0, 2.0]]
    """
    # of a NaN, LAPACK makes zeros or an error
    finite = jacobian.isfinite().flatten(1).all(1)[:, None]
    values = _finite_singular_values(torch.where(finite[..., None], jacobian, 0.0))
    return torch.where(finite, values, torch.nan)


def _finite_singular_values(jacobian: Tensor) -> Tensor:
    short, long = sorted(jacobian.shape[1:])
    if jacobian.dtype == torch.float64 or long < 2 * short:
        values: Tensor = torch.linalg.svdvals(jacobian)
        return values
    wide = jacobian.double() if jacobian.shape[1] == short else jacobian.double().mT
    squares = torch.linalg.eigvalsh(wide @ wide.mT).flip(-1)
    # the slope of the root is infinite at 0, and of any size where rounding is all there is
    positive = squares > short * torch.finfo(squares.dtype).eps * squares[:, :1]
    roots = torch.where(positive, squares, 1.0).sqrt()
    return torch.where(positive, roots, 0.0).to(jacobian.dtype)


def _noise(shape: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
    generator = generator or torch.Generator().manual_seed(0)
    noise = torch.randn(shape, generator=generator, device=generator.device, dtype=like.dtype)
    return noise.to(like.device)


def _normalize(x: Tensor) -> Tensor:
    length = safe_norm(x)[:, None]
    return x / torch.where(length > 0, length, torch.ones_like(length))


def _at_least_1(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name} must be at least 1, got {value}")
