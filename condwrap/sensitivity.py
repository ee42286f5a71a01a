"""What a policy's output is sensitive to: singular values, and each observed value's share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from condwrap.jacobian import jacobians, pullback, read_states
from condwrap.observation import States
from condwrap.policy import Policy, Select
from condwrap.spectrum import largest_singular_value, singular_values

EXACT_OUTPUTS = 64  # a Jacobian takes a vector-Jacobian product for each output
HELD = 2**24  # numbers of Jacobians that are held at a time
PROBES = 64  # of the estimate without Jacobians


@dataclasses.dataclass(frozen=True)
class Spectrum:
    """Of the Jacobian d output / d observation over a batch of states."""

    outputs: int
    """numbers of the output that count, m"""
    column_norms: Tensor
    """root mean square over the states of each column's length, `[n]`, float64"""
    largest: float
    """median over the states of the largest singular value"""
    root_mean_square: float
    """√(mean ‖Jacobian‖²_F / min(m, n))"""
    smallest: float = math.nan
    """median of the smallest singular value; NaN where it is not exact"""
    condition_number: float = math.nan
    """median of largest over smallest; NaN where it is not exact"""
    exact: bool = False
    """whether the Jacobians were computed, or estimated without holding them"""


@torch.no_grad()
def measure_spectrum(policy: Policy, obs: Any, select: Select) -> Spectrum:
    """Singular values and column norms: exact up to 64 outputs, otherwise estimated."""
    states = read_states(obs, select)
    output, product = pullback(policy, states, select)
    outputs, inputs = output.shape[-1], sum(states.sizes)
    if outputs > EXACT_OUTPUTS:
        squares = _estimate_squares(output, product)
        return Spectrum(
            outputs=outputs,
            column_norms=squares.sqrt(),
            largest=largest_singular_value(policy, obs, select=select).median().item(),
            root_mean_square=(squares.sum() / min(outputs, inputs)).sqrt().item(),
        )

    squares = torch.zeros(inputs, dtype=torch.float64, device=output.device)
    values: list[Tensor] = []
    for part in jacobians(policy, states, select, max(1, HELD // (outputs * inputs))):
        squares += part.double().square().sum((0, 1)) / len(output)
        values.append(singular_values(part))
    found = torch.cat(values)
    return Spectrum(
        outputs=outputs,
        column_norms=squares.sqrt(),
        largest=found[:, 0].median().item(),
        root_mean_square=(squares.sum() / min(outputs, inputs)).sqrt().item(),
        smallest=found[:, -1].median().item(),
        condition_number=(found[:, 0] / found[:, -1]).median().item(),
        exact=True,
    )


def _estimate_squares(output: Tensor, product: Callable[[Tensor], Tensor]) -> Tensor:
    """Mean squared lengths of the Jacobian's columns, `[n]`: E (Jᵀ w)_i² for w of random signs."""
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros((), dtype=torch.float64, device=output.device)
    for _ in range(PROBES):
        w = torch.randn(output.shape, generator=generator).sign().to(output)
        total = total + product(w).double().square().mean(0)
    return total / PROBES


def name_values(states: States) -> list[str]:
    """A name for each perturbed number of an observation, such as [3] or ['position'][0, 2]."""
    paths, _ = pytree.tree_flatten_with_path(states.obs(states.perturbed))
    names = []
    for (path, _), leaf in zip(paths, states.leaves, strict=True):
        if leaf.scale:
            shape = leaf.tensor.shape[states.batch_ndim :]
            indices = torch.cartesian_prod(*map(torch.arange, shape)).reshape(-1, len(shape))
            prefix = pytree.keystr(path)
            names += [f"{prefix}{index}" for index in indices.tolist()]
    return names
