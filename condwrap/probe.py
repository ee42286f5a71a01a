"""What a training loop logs of its policy's conditioning: one yardstick in every run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from condwrap.observation import take_evenly
from condwrap.policy import Policy, flat_output
from condwrap.regularizer import ConditioningRegularizer
from condwrap.spectrum import jacobian_singular_values

SHARE_INTERVAL = 25  # updates between two measurements of the gradient share

# what makes J and psi in the paper: the yardstick
PAPER: dict[str, Any] = {
    "lambda_min": 1.0,
    "lambda_max": 20.0,
    "reduction": "sample",
    "perturbation": "sphere",
    "radius": 1.0,
}

SPECTRUM = (
    "conditioning/singular_value_max",
    "conditioning/singular_value_mean",
    "conditioning/frobenius_squared_per_input",  # E[J²] for small delta: ‖Jacobian‖_F² / n
    "conditioning/condition_number",
)


class ConditioningProbe:
    """Measures a policy while it is trained, without a trace in it or in the training's noise.

    Every run is measured by one yardstick, whatever it trains with: J and psi under the paper's
    settings (range 1 to 20, delta of length 1, one J for each state). What the run's own settings
    give is logged beside it. `ConditioningArgs.make_probe` makes a probe from a run's flags.

    Args:
        own: A regularizer with the run's own settings, which the probe alone uses.
        own_is_paper: Whether these settings are the paper's, so that nothing is measured twice.
        seed: Of the yardstick's noise.
        device: Where that noise is drawn.
        fraction: Share of the observations to measure on, in (0, 1]: evenly spaced.
        log_spectrum: Updates between two measurements of the singular values; 0: never.
        action_bounds: Lowest and highest action that the environment executes, `[action_dim]`
            each. With them J of the clipped output is logged too.

    Example:
        >>> own = ConditioningRegularizer(lambda_min=0.0)
        >>> probe = ConditioningProbe(own, own_is_paper=False, seed=0)
        >>> policy = torch.nn.Linear(1, 1, bias=False)
        >>> policy.weight.data = torch.tensor([[0.5]])
        >>> metrics = probe.measure(update=1, policy=policy, obs=torch.ones(8, 1))
        >>> metrics["conditioning/psi"], metrics["conditioning/own_psi"]
        (0.25, 0.0)
    """

    def __init__(
        self,
        own: ConditioningRegularizer,
        *,
        own_is_paper: bool,
        seed: int,
        device: torch.device | str = "cpu",
        fraction: float = 1.0,
        log_spectrum: int = 0,
        action_bounds: tuple[Any, Any] | None = None,
    ) -> None:
        generator = torch.Generator(device).manual_seed(seed)
        self.yardstick = ConditioningRegularizer(0.0, **PAPER, generator=generator)
        self.own = own
        self.own_is_paper = own_is_paper
        self.fraction = fraction
        self.log_spectrum = log_spectrum
        self.action_bounds = action_bounds and tuple(map(torch.as_tensor, action_bounds))

    @torch.no_grad()
    def measure(self, update: int, policy: Policy, obs: Tensor) -> dict[str, float]:
        """The numbers to log after an update, under names that begin with "conditioning/".

        Args:
            update: Number of the update, which says when the singular values are due.
            policy: As for `ConditioningRegularizer`.
            obs: Clean observations, `[B, *obs_shape]`, as the policy sees them.

        Returns:
            `psi`, quantiles of J, the mean of J² and the fractions below and above the range by the
            yardstick; the same as `own_*` by the run's own settings; with `action_bounds`
            `quotient_executed`, the median J of the executed action; with `log_spectrum` the
            singular values. What is not due is NaN, so that each update has the same names. With
            `reduction="batch"` the own J is one for all the observations, not for a minibatch.
        """
        states = take_evenly(obs, self.fraction)
        delta = self.yardstick.sample_delta(states)
        measured = self.yardstick(policy, states, delta=delta)
        own = measured if self.own_is_paper else self.own(policy, states)

        metrics = measured.metrics("conditioning/")
        metrics |= own.metrics("conditioning/own_")

        if self.action_bounds is not None:
            executed = self.yardstick(self._executed(policy), states, delta=delta)
            metrics["conditioning/quotient_executed"] = executed.quotient.median().item()
        if self.log_spectrum:
            due = update % self.log_spectrum == 0
            metrics |= self._spectrum(policy, states) if due else dict.fromkeys(SPECTRUM, math.nan)
        return metrics

    def gradient_share(
        self,
        update: int,
        policy: Any,
        obs: Tensor,
        rest: Callable[[], Tensor],
        parameters: Iterable[Tensor] | None = None,
    ) -> dict[str, float]:
        """‖gradient of the penalty‖ / ‖gradient of the rest of the loss‖, every 25th update.

        Args:
            update: Number of the update; at those between the share is NaN.
            policy: The policy that the penalty is taken on.
            obs: What it is taken on, `[B, *obs_shape]`.
            rest: Computes the loss without the penalty, `[]`; called only when the share is due.
            parameters: What both are differentiated in; by default those of `policy`, a module.
        """
        share = math.nan
        if update % SHARE_INTERVAL == 0:
            share = 0.0
            if self.own.coefficient > 0:
                shared = list(policy.parameters() if parameters is None else parameters)
                penalty = self.own(policy, take_evenly(obs, self.fraction)).penalty
                share = (_gradient_norm(penalty, shared) / _gradient_norm(rest(), shared)).item()
        return {"conditioning/gradient_share": share}

    def state_dict(self) -> dict[str, Any]:
        """The generators' states, so that a resumed run measures with the same noise."""
        return {"yardstick": self.yardstick.state_dict(), "own": self.own.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.yardstick.load_state_dict(state_dict["yardstick"])
        self.own.load_state_dict(state_dict["own"])

    def _executed(self, policy: Policy) -> Policy:
        """The policy's output, clipped as the environment clips an action."""
        low, high = self.action_bounds  # type: ignore[misc]

        def act(obs: Tensor) -> Tensor:
            action = flat_output(policy(obs), "default", obs.shape[:1])
            return action.clamp(low.flatten(), high.flatten())

        return act

    def _spectrum(self, policy: Policy, obs: Tensor) -> dict[str, float]:
        """Means over the states, but for the condition number, whose median is taken."""
        values = jacobian_singular_values(policy, obs)  # [B, min(m, n)]
        inputs = obs[0].numel()
        numbers = (
            values[:, 0].mean(),
            values.mean(),
            values.square().sum(-1).mean() / inputs,
            (values[:, 0] / values[:, -1]).median(),
        )
        return dict(zip(SPECTRUM, torch.stack(numbers).tolist(), strict=True))


def _gradient_norm(loss: Tensor, parameters: list[Tensor]) -> Tensor:
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    norm: Tensor = torch.cat([g.flatten() for g in gradients if g is not None]).norm()
    return norm
