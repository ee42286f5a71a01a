"""What a penalty needs of the distribution that a policy returns."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch import distributions as td
from torch.utils import _pytree as pytree

from condwrap.carry import replace_tensors, tensors_in
from condwrap.observation import States


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


def gaussian(output: Any, states: States) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the Normal that a policy returned, `[B, m]` each."""
    distribution = find_distribution(output, states, "StateAdversarial")
    base = distribution
    while isinstance(base, td.Independent):
        base = base.base_dist
    if not isinstance(base, td.Normal):
        raise TypeError(
            f"StateAdversarial needs a policy that returns a Normal, got {type(base).__name__}: "
            "its formula is the divergence of two Gaussians"
        )
    return base.loc.reshape(len(base.loc), -1), base.scale.reshape(len(base.scale), -1)


def per_state(x: Tensor) -> Tensor:
    """Sum over all axes but the first, `[B, ...]` to `[B]`: of log-probabilities and of KL."""
    return x.reshape(len(x), -1).sum(-1)


def detached(distribution: td.Distribution) -> td.Distribution:
    """The same distribution, its parameters without a gradient."""
    tensors = tensors_in(distribution)
    twin: td.Distribution = replace_tensors(distribution, tensors, [x.detach() for x in tensors])
    return twin
