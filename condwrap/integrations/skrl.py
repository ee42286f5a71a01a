"""Attach a penalty to the policy of a skrl agent.

A skrl model is not called: its agent calls `model.act`, which calls `model.compute`. The penalty is
carried on what `compute` returns, the mean of a Gaussian or the logits of a Categorical, and psi
goes where the agent writes its own numbers.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from condwrap.attach import Attachable, Attached
from condwrap.attach import attach as attach_to_module


def attach(agent: Any, penalty: Attachable) -> Attached:
    """Add a penalty's gradient to the loss of a skrl agent's policy.

    Observations are perturbed after the agent's preprocessor. With mixed precision the gradient
    has the scale of the agent's GradScaler.

    Args:
        agent: A skrl agent for PyTorch, such as `PPO` or `SAC`, with an attribute `policy`. Its
            `scaler`, where it has one, gives the penalty's scale.
        penalty: It sees the first value that the policy's `compute` returns, a tensor: the mean
            or the logits, not yet normalized.

    Returns:
        The handle; see `condwrap.attach`. Its metrics are those since the agent wrote its data.

    Raises:
        TypeError: `agent` has no policy that is a module.

    Example:
        agent = PPO(models=models, memory=memory, cfg=cfg, ...)
        attach(agent, ConditioningRegularizer(coefficient=1e-2))
    """
    policy: Any = getattr(agent, "policy", None)
    is_module: bool = isinstance(policy, nn.Module)
    if not is_module:
        raise TypeError(
            f"agent must be a skrl agent with a policy, got {type(agent).__name__}: create the "
            "agent first, and attach to each agent of several"
        )
    computing = _Compute(policy)
    handle = attach_to_module(computing, penalty)
    if hasattr(agent, "scaler"):
        handle.scale = agent.scaler.get_scale

    compute = policy.compute
    write = agent.write_tracking_data

    def carried_compute(inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        if role == "value":  # of a model that policy and value share
            return compute(inputs, role)  # type: ignore[no-any-return]
        others: list[dict[str, Any]] = []
        computing.training = policy.training
        return computing(inputs["observations"], inputs, role, others), others[0]

    def write_with_psi(**times: int) -> None:
        for name, value in handle.metrics().items():
            agent.track_data(name, value)
        write(**times)

    policy.compute = carried_compute
    agent.write_tracking_data = write_with_psi
    return handle


class _Compute(nn.Module):
    """The first value of a model's `compute`, as a module that a penalty can be attached to."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy
        self.compute: Any = policy.compute

    def forward(
        self,
        observations: Tensor,
        inputs: dict[str, Any],
        role: str,
        others: list[dict[str, Any]],
    ) -> Tensor:
        """The mean or the logits; the other values are appended to `others`."""
        output, other = self.compute({**inputs, "observations": observations}, role)
        others.append(other)
        return output  # type: ignore[no-any-return]
