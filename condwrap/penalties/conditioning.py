"""The seed paper's penalty, called as the others are."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from condwrap.policy import Policy
from condwrap.regularizer import Conditioning, ConditioningRegularizer


class ConditioningPenalty:
    """A `ConditioningRegularizer` that can be passed all that a training loop has.

    Args:
        regularizer: By default one with its defaults.

    A call needs the policy and the observations only. It uses `output` where the regularizer's
    estimator does. It returns a `Conditioning`, whose metrics begin with "conditioning/".

    Example:
        >>> import torch
        >>> penalty = ConditioningPenalty(ConditioningRegularizer(coefficient=1e-2))
        >>> penalty(torch.nn.Linear(4, 2), torch.ones(8, 4), actions=torch.ones(8, 2)).psi.shape
        torch.Size([8])
    """

    needs: tuple[str, ...] = ()

    def __init__(self, regularizer: ConditioningRegularizer | None = None) -> None:
        self.regularizer = regularizer or ConditioningRegularizer()

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
    ) -> Conditioning:
        """The penalty on these observations; all but `output` is not looked at."""
        known = output if self.regularizer.estimator == "difference" else None
        return self.regularizer(policy, obs, output=known)

    def state_dict(self) -> dict[str, Tensor]:
        """The regularizer's."""
        return self.regularizer.state_dict()

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self.regularizer.load_state_dict(state_dict)
