"""LCP: a bound on how fast the log-probability of what was done changes with the state."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch import distributions as td

from condwrap.jacobian import read_states, zero_delta
from condwrap.penalties.checks import check_weight, require
from condwrap.penalties.distributions import find_distribution, per_state
from condwrap.penalties.evaluation import evaluate
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.policy import Policy


class LipschitzPolicy:
    """coefficient · mean ‖∇_s log π(a | s)‖², a the action that was done at s.

    From Chen et al., "Learning Smooth Humanoid Locomotion through Lipschitz-Constrained Policies"
    (2024, arXiv 2410.11825): LCP. Their code takes the same squared Euclidean norm and 0.002.
    Forks that sum absolute values, or differentiate the mean in place of the log-probability, do
    something else. The gradient of the penalty takes a second differentiation.

    Args:
        coefficient: λ_gp, at least 0. With 0 it is measured and nothing reaches the loss.

    A call needs `actions`, `[B, *action_shape]`, and a policy that returns a distribution, alone
    or beside tensors. Its metric is `lcp_gradient_squared`, the mean. Nothing is drawn.

    Raises:
        TypeError, ValueError: An argument outside what is stated above or missing, or at a call
            what `ConditioningRegularizer` or the distribution's `log_prob` refuses.

    Example:
        >>> mean = torch.nn.Linear(2, 1, bias=False)
        >>> mean.weight.data = torch.tensor([[3.0, 4.0]])
        >>> penalty, obs = LipschitzPolicy(), torch.zeros(1, 2)
        >>> policy = lambda obs: torch.distributions.Normal(mean(obs), 1.0)
        >>> penalty(policy, obs, actions=torch.tensor([[2.0]])).metrics()
        {'penalty/lcp_gradient_squared': 100.0}
    """

    needs: tuple[str, ...] = ("actions",)

    def __init__(self, coefficient: float = 0.002) -> None:
        self.coefficient = check_weight("coefficient", coefficient)

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
        """The penalty on these observations, `[B, *obs_shape]`; the class says what it needs."""
        reason = "it differentiates the log-probability of what was done at each observation"
        require("LipschitzPolicy", reason, actions=actions)
        states = read_states(obs, "default")
        learns = self.coefficient > 0 and torch.is_grad_enabled()
        with torch.enable_grad():
            delta = zero_delta(states).requires_grad_()
            output = evaluate(policy, states, delta)
            distribution = find_distribution(output, states, "LipschitzPolicy")
            logprob = per_state(distribution.log_prob(check_actions(actions, distribution)))
            # 0 · delta: a policy that ignores its observations has the gradient 0
            anchored = logprob.sum() + 0.0 * delta.sum()
            with torch.autocast(states.device.type, enabled=False):  # backward heeds it too
                (gradient,) = torch.autograd.grad(anchored, delta, create_graph=learns)  # [B, n]
        with torch.set_grad_enabled(learns):
            square = gradient.square().sum(-1).mean()
            return penalized({"lcp_gradient_squared": (self.coefficient, square)})


def check_actions(actions: Any, distribution: td.Distribution) -> Tensor:
    """Return the actions, or raise: of another shape they would broadcast against each other."""
    want = distribution.batch_shape + distribution.event_shape
    if isinstance(actions, Tensor) and actions.shape == want:
        return actions
    got = tuple(actions.shape) if isinstance(actions, Tensor) else type(actions).__name__
    raise ValueError(f"actions must be a tensor of the policy's shape {tuple(want)}, got {got}")
