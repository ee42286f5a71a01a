"""Attach a penalty to an actor of Tianshou, which is called with NumPy observations."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from condwrap.attach import Attachable, Attached
from condwrap.attach import attach as attach_to_module


def attach(actor: nn.Module, penalty: Attachable) -> Attached:
    """Add a penalty's gradient to the loss of Tianshou's policy.

    Args:
        actor: The network whose first argument is the observation, such as `policy.actor` of PPO
            or SAC. From now on it gets a NumPy observation as a tensor on its own device.
        penalty: It sees what the actor returns. In Tianshou that is `((mean, std), state)` for a
            Gaussian: `select=lambda output: output[0][0]`.

    Returns:
        The handle; see `condwrap.attach`.

    Example:
        handle = attach(policy.actor, penalty)
        OnPolicyTrainerParams(training_fn=lambda epoch, step: logger.write(
            "training/env_step", step, handle.metrics()))
    """
    handle = attach_to_module(actor, penalty)
    actor.register_forward_pre_hook(_with_tensor)
    return handle


def _with_tensor(actor: nn.Module, args: tuple[Any, ...]) -> tuple[Any, ...] | None:
    """The arguments, the observation as a tensor of the dtype that it has."""
    if not (args and isinstance(args[0], np.ndarray)):
        return None
    device = next((x.device for x in actor.parameters()), torch.device("cpu"))
    return torch.as_tensor(args[0], device=device), *args[1:]
