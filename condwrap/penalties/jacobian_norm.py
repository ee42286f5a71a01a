"""Jacobian regularization: the squared Frobenius norm of the policy's Jacobian."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.func import vmap

from condwrap.functional import safe_norm
from condwrap.jacobian import jacobians, pullback, read_states
from condwrap.observation import States
from condwrap.penalties.checks import check_count, check_weight
from condwrap.penalties.noise import Noise
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.policy import Policy, Select, check_select


class JacobianNorm(Noise):
    """coefficient · mean ½‖Jacobian‖_F², the Jacobian of the output by the observation.

    From Hoffman, Roberts and Yaida, "Robust Learning with Jacobian Regularization" (2019, arXiv
    1908.02729), whose loss adds λ/2 ‖Jacobian‖_F², λ = 0.01. ‖Jacobian‖_F² = m E‖vᵀ Jacobian‖²
    for v uniform on the unit sphere of the m outputs; one v for each state estimates it, without
    bias. Their code does the same. Each projection costs a vector-Jacobian product.

    Args:
        coefficient: λ, at least 0. With 0 the norm is measured and nothing reaches the loss.
        projections: Number of v for each state, at least 1.
        exact: Take the whole Jacobian instead, by m products.
        select: Which tensor of the policy's output counts, as for `ConditioningRegularizer`.
        seed: Of the penalty's own generator, on the CPU.
        generator: A generator to use instead.

    A call needs the policy and the observations only. Its metric is `jacobian_norm`,
    the mean of ½‖Jacobian‖_F².

    Raises:
        TypeError, ValueError: An argument outside what is stated above, or at a call what
            `ConditioningRegularizer` refuses.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> JacobianNorm(exact=True)(policy, torch.ones(5, 3)).metrics()
        {'penalty/jacobian_norm': 6.5}
    """

    needs: tuple[str, ...] = ()

    def __init__(
        self,
        coefficient: float = 0.01,
        *,
        projections: int = 1,
        exact: bool = False,
        select: Select = "default",
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(seed, generator)
        check_select(select)
        self.coefficient = check_weight("coefficient", coefficient)
        self.projections = check_count("projections", projections)
        self.exact = exact
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
        states = read_states(obs, self.select)
        with torch.set_grad_enabled(self.coefficient > 0 and torch.is_grad_enabled()):
            squares = self._exact(policy, states) if self.exact else self._drawn(policy, states)
            return penalized({"jacobian_norm": (self.coefficient, squares.mean() / 2)})

    def _exact(self, policy: Policy, states: States) -> Tensor:
        (jacobian,) = jacobians(policy, states, self.select, len(states.tensors[0]))  # [B, m, n]
        return jacobian.square().sum((1, 2))

    def _drawn(self, policy: Policy, states: States) -> Tensor:
        output, product = pullback(policy, states, self.select)
        noise = self.normal((self.projections, *output.shape), output)
        v = noise / safe_norm(noise)[..., None]  # [projections, B, m]
        products: Tensor = vmap(product)(v)  # [projections, B, n]
        return output.shape[-1] * products.square().sum(-1).mean(0)
