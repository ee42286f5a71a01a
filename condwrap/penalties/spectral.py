"""A penalty on any function of the singular values of the policy's Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from condwrap.penalties.checks import check_count, check_weight
from condwrap.penalties.noise import Noise
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.policy import Policy, Select, check_select
from condwrap.spectrum import jacobian_singular_values, largest_singular_value

Values = Literal["all", "largest"]


def isometry(values: Tensor) -> Tensor:
    """Mean of (value - 1)² over the singular values, `[B, r]` to `[B]`.

    Example:
        >>> isometry(torch.tensor([[3.0, 1.0]])).tolist()
        [2.0]
    """
    return (values - 1).square().mean(-1)


class SpectralPenalty(Noise):
    """coefficient · mean of function(singular values of the state's Jacobian).

    By default the function is `isometry`, the distance from dynamical isometry: all singular
    values 1, which Pennington, Schoenholz and Ganguli, "Resurrecting the sigmoid in deep learning
    through dynamical isometry" (2017, arXiv 1711.04735) reach by initialization. They train with
    no such penalty; its form and weight are this library's.

    Args:
        coefficient: At least 0. With 0 it is measured and nothing reaches the loss.
        function: Differentiable, `[B, r]`, largest first, to `[B]`.
        values: "all", exactly, by m vector-Jacobian products and a decomposition, r = min(m, n);
            or "largest", r = 1, by Lanczos iterations, for images and wide outputs.
        iterations: Of these, at least 1.
        select: Which tensor of the policy's output counts, as for `ConditioningRegularizer`.
        seed: Of the penalty's own generator, on the CPU; "largest" alone draws from it.
        generator: A generator to use instead.

    A call needs the policy and the observations only. Its metrics are `spectral`, the mean of the
    function, and `spectral_largest`, the mean of the largest singular value.

    Raises:
        TypeError, ValueError: An argument outside what is stated above, a function that returns
            another shape, or at a call what `ConditioningRegularizer` refuses.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> SpectralPenalty()(policy, torch.ones(5, 3)).metrics()
        {'penalty/spectral': 2.5, 'penalty/spectral_largest': 3.0}
        >>> log_condition = lambda values: (values[:, 0] / values[:, -1]).log()
        >>> penalty = SpectralPenalty(function=log_condition)
    """

    needs: tuple[str, ...] = ()

    def __init__(
        self,
        coefficient: float = 1e-3,
        function: Callable[[Tensor], Tensor] = isometry,
        *,
        values: Values = "all",
        iterations: int = 20,
        select: Select = "default",
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(seed, generator)
        check_select(select)
        if not callable(function):
            raise TypeError(f"function must be callable, got {type(function).__name__}")
        if values not in get_args(Values):
            raise ValueError(f"values must be one of {list(get_args(Values))}, got {values!r}")
        self.coefficient = check_weight("coefficient", coefficient)
        self.function = function
        self.values = values
        self.iterations = check_count("iterations", iterations)
        self.select = select

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
    ) -> Penalized:
        """The penalty on these observations, `[B, *obs_shape]`; the rest is not looked at."""
        with torch.set_grad_enabled(self.coefficient > 0 and torch.is_grad_enabled()):
            values = self._values(policy, obs)  # [B, r]
            each = self.function(values)
            if not (isinstance(each, Tensor) and each.shape == values.shape[:1]):
                got = tuple(each.shape) if isinstance(each, Tensor) else type(each).__name__
                raise ValueError(
                    f"function must map singular values of shape {tuple(values.shape)} to one "
                    f"number for each state, {tuple(values.shape[:1])}, got {got}"
                )
            terms = {
                "spectral": (self.coefficient, each.mean()),
                "spectral_largest": (0.0, values[:, 0].mean()),
            }
            return penalized(terms)

    def _values(self, policy: Policy, obs: Any) -> Tensor:
        if self.values == "all":
            return jacobian_singular_values(policy, obs, select=self.select)
        largest = largest_singular_value(
            policy,
            obs,
            iterations=self.iterations,
            select=self.select,
            generator=self.generator,
        )
        return largest[:, None]
