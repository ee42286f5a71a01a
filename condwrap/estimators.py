"""The two ways to estimate J: by a finite difference, and by its limit for a vanishing delta."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from condwrap.observation import States
from condwrap.policy import Policy, untouched

Respond = Callable[[Any], Tensor]  # obs -> the output that counts, [*batch, m]
Estimator = Callable[[Policy, Respond, States, Tensor, Tensor | None], tuple[Tensor, Tensor]]


def difference(
    policy: Policy, respond: Respond, states: States, delta: Tensor, known: Tensor | None
) -> tuple[Tensor, Tensor]:
    """pi(S), which may be known already, and pi(S + delta), both with the same dropout masks.

    Two evaluations from one state of the global generators share their masks whatever the policy
    is made of; in a compiled region, which cannot rewind them, one vmapped evaluation does.
    """
    clean = states.perturbed
    moved = [x + shift for x, shift in zip(clean, states.displacement(delta), strict=True)]
    if known is not None:
        with untouched(policy, states.device):
            return known, respond(states.obs(moved))
    if torch.compiler.is_compiling():
        pair = [torch.stack(both) for both in zip(clean, moved, strict=True)]
        with untouched(policy, states.device):
            output, perturbed_output = torch.func.vmap(
                lambda *leaves: respond(states.obs(leaves)), randomness="same"
            )(*pair)
        return output, perturbed_output
    with untouched(policy, states.device):
        output = respond(states.obs(clean))
    with untouched(policy, states.device):
        perturbed_output = respond(states.obs(moved))
    return output, perturbed_output


def jvp(
    policy: Policy, respond: Respond, states: States, delta: Tensor, known: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Jacobian · delta by forward-mode differentiation, and 0: the difference in the limit."""
    if known is not None:
        raise ValueError("output is of use to estimator='difference' only")
    try:
        with untouched(policy, states.device):
            change = torch.func.jvp(
                lambda *leaves: respond(states.obs(leaves)),
                tuple(states.perturbed),
                tuple(states.displacement(delta)),
            )[1]
    except NotImplementedError as error:
        raise NotImplementedError(
            f"estimator='jvp' needs forward-mode differentiation, which the policy lacks: {error}. "
            "For attention use torch.nn.attention.sdpa_kernel(SDPBackend.MATH), for anything else "
            "estimator='difference'"
        ) from error
    return change, torch.zeros_like(change)


ESTIMATORS: dict[str, Estimator] = {"difference": difference, "jvp": jvp}
