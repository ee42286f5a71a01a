"""What every penalty of this package is called with, and what it returns."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from condwrap.policy import Policy


class Result(Protocol):
    """What a penalty returns; `condwrap.Conditioning` is one too.

    Example:
        >>> from condwrap import Conditioning
        >>> hasattr(Conditioning, "metrics")
        True
    """

    @property
    def penalty(self) -> Tensor:
        """Add it to the loss, `[]`."""

    def metrics(self) -> dict[str, float]:
        """The numbers to log."""


class Penalty(Protocol):
    """A penalty on a policy: any of this package, or your own.

    A training loop passes all that it has, and each penalty takes what it needs. It raises a
    ValueError that names what it lacks.

    Args of a call:
        policy: Any callable obs -> tensor, distribution, or tuple or dict of them.
        obs: `[B, *obs_shape]`, floating or uint8, or a dict of these.
        output: `policy(obs)`, where the loss has computed it: saves a forward pass for some.
        next_obs: The observations that followed, in the structure of `obs`.
        dones: `[B]`, bool or 0 and 1: whether `next_obs` does not continue the episode of `obs`.
        actions: What was done at `obs`, `[B, *action_shape]`.
        value: The critic, a callable obs -> `[B]` or `[B, 1]`. Some take V(obs) as a tensor.

    Example:
        >>> from condwrap.penalties import CAPS
        >>> penalty: Penalty = CAPS()
        >>> penalty.needs
        ('next_obs', 'dones')
    """

    @property
    def needs(self) -> tuple[str, ...]:
        """The keyword arguments without which a call raises."""

    def __call__(
        self,
        policy: Policy,
        obs: Any,
        *,
        output: Any = None,
        next_obs: Any = None,
        dones: Tensor | None = None,
        actions: Tensor | None = None,
        value: Any = None,
    ) -> Result:
        """The penalty on this batch."""


@dataclasses.dataclass(frozen=True)
class Penalized:
    """What the penalties of this package return.

    Example:
        >>> import torch
        >>> result = Penalized(torch.tensor(0.5), {"caps_spatial": torch.tensor(1.0)})
        >>> result.metrics()
        {'penalty/caps_spatial': 1.0}
    """

    penalty: Tensor
    """Add it to the loss, `[]`. A constant 0 if every weight is 0."""
    terms: Mapping[str, Tensor]
    """Each term before its weight, `[]`, detached."""

    def metrics(self, prefix: str = "penalty/") -> dict[str, float]:
        """The terms as Python floats, under names that begin with `prefix`."""
        if not self.terms:
            return {}
        numbers = torch.stack(list(self.terms.values())).tolist()  # one transfer from a GPU
        return {f"{prefix}{name}": x for name, x in zip(self.terms, numbers, strict=True)}


def penalized(weighted: Mapping[str, tuple[float, Tensor]]) -> Penalized:
    """The weighted sum of the terms, each a pair of its weight and its value, `[]`.

    Raises:
        ValueError: Gradients are on and a term with a weight has none.
    """
    # 0 · infinity is NaN, so a weight of 0 does not multiply
    counted = [weight * term for weight, term in weighted.values() if weight]
    for term in counted:
        if torch.is_grad_enabled() and not term.requires_grad:
            raise ValueError(
                "the policy's output has no gradient: check that its parameters require one and "
                "that it does not detach, or evaluate the penalty under torch.no_grad()"
            )
    penalty = sum(counted[1:], start=counted[0]) if counted else torch.zeros(())
    return Penalized(penalty, {name: term.detach() for name, (_, term) in weighted.items()})
