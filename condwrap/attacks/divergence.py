"""How far one answer of a policy is from another, state by state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch import distributions as td

from condwrap.policy import Select, flat_output

Answer = Tensor | td.Distribution
_FULL = (td.MultivariateNormal, td.LowRankMultivariateNormal)
_CATEGORICAL = (td.Categorical, td.OneHotCategorical)


def choose(output: Any, select: Select, batch: torch.Size) -> Answer:
    """The tensor, `[B, m]`, or the distribution that the policy's output means.

    A distribution counts alone, whatever tensors stand beside it, such as a value. Of several
    tensors none is preferred.

    Raises:
        TypeError: The output cannot be read.
        ValueError: It holds several tensors or distributions, or none.
    """
    if callable(select):
        output = select(output)
        select = "default"
    found = list(_members(output))
    distributions = [x for x in found if isinstance(x, td.Distribution)]
    candidates = distributions or found
    if len(candidates) != 1:
        kinds = ", ".join(type(x).__name__ for x in candidates) or "nothing"
        raise ValueError(
            f"the policy's output must hold one tensor or distribution, got {kinds}: "
            "pass select=lambda output: ... to choose"
        )

    (chosen,) = candidates
    if not isinstance(chosen, td.Distribution) or select != "default":
        return flat_output(chosen, select, batch)
    shape = chosen.batch_shape + chosen.event_shape
    if shape[: len(batch)] != batch:
        raise ValueError(
            f"the policy's distribution must begin with the batch axes {tuple(batch)} of the "
            f"observations, got shape {tuple(shape)}"
        )
    return chosen


def divergence(clean: Answer, moved: Answer) -> Tensor:
    """What `mad` maximizes, `[B]`: 0 where the answers are equal.

    ‖moved - clean‖² of tensors. For Gaussians ½ Σ ((mu' - mu) / sigma)² with the clean answer's
    sigma, the KL divergence at equal sigma (Zhang et al., 2020). For other distributions
    KL(clean ‖ moved).

    Raises:
        TypeError: PyTorch knows no KL divergence of these distributions.
    """
    if isinstance(clean, Tensor) and isinstance(moved, Tensor):
        return (moved - clean).square().sum(-1)

    p, q = _base(clean), _base(moved)
    if isinstance(p, td.Normal) and isinstance(q, td.Normal):
        change = (q.mean - p.mean) / p.stddev
        return _of_each_state(0.5 * change.square())
    if isinstance(p, _FULL) and isinstance(q, _FULL):
        root = torch.linalg.cholesky(p.covariance_matrix)
        change = torch.linalg.solve_triangular(root, (q.mean - p.mean)[..., None], upper=False)
        return _of_each_state(0.5 * change.square())
    if isinstance(p, _CATEGORICAL) and isinstance(q, _CATEGORICAL):
        return _of_each_state(_categorical(p.probs, p.logits, q.logits))

    try:
        return _of_each_state(td.kl_divergence(p, q))
    except NotImplementedError as error:
        raise TypeError(
            f"PyTorch knows no KL divergence of {type(p).__name__}: "
            "pass select=lambda output: ... to choose a tensor"
        ) from error


def _categorical(probs: Tensor, logits: Tensor, moved: Tensor) -> Tensor:
    """Terms of the KL divergence. A masked action has probability 0 and counts for nothing."""
    possible = probs > 0
    change = torch.where(possible, logits, 0.0) - torch.where(possible, moved, 0.0)
    return probs * change


def _of_each_state(terms: Tensor) -> Tensor:
    return terms.flatten(1).sum(-1) if terms.ndim > 1 else terms


def _base(distribution: Any) -> Any:
    return distribution.base_dist if isinstance(distribution, td.Independent) else distribution


def _members(output: Any) -> Iterator[Any]:
    if isinstance(output, Mapping):
        output = list(output.values())
    if isinstance(output, tuple | list):
        for value in output:
            yield from _members(value)
    else:
        yield output
