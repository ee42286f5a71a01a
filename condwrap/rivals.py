"""Any penalty of `condwrap.penalties` in a training loop on minibatches, chosen by a flag."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

from torch import Tensor

from condwrap.penalties import PENALTIES
from condwrap.probe import ConditioningProbe
from condwrap.settings import ConditioningArgs, Device

Name = Literal["conditioning", "jacobian", "caps", "lcp", "l2c2", "sa", "spectral"]
CAPS_TEMPORAL = 0.2  # of the spatial weight, as 0.1 is of 0.5 in Mysore et al. (2021)


@dataclasses.dataclass(frozen=True)
class RivalArgs(ConditioningArgs):
    """`ConditioningArgs`, and a flag that chooses another penalty.

    `--coefficient` weighs whichever it is; CAPS's temporal term has a fifth of it. Every other
    setting of a rival is its default. psi and J are logged by the paper's settings all the same,
    and the share of the gradient for the conditioning penalty only: 0 for a rival.

    Example:
        >>> args = RivalArgs(penalty="jacobian", coefficient=0.1)
        >>> args.make_penalty(seed=0).coefficient
        0.1
    """

    penalty: Name = "conditioning"
    """what coefficient weighs: the paper's penalty, or a rival of condwrap.penalties"""

    def check_conditioning(self) -> None:
        """Raise ValueError for a setting outside its range."""
        super().check_conditioning()

        if self.penalty == "conditioning":
            return
        if self.penalty not in PENALTIES:
            raise ValueError(f"penalty must be one of {', '.join(PENALTIES)}, got {self.penalty}")
        if self.printed_sign:
            raise ValueError("printed_sign is of the conditioning penalty: leave it out")
        if getattr(self, "compile", False):
            raise ValueError(f"compile must be False with the penalty {self.penalty}, got True")

    def make_penalty(self, seed: int) -> Any:
        """The penalty that was chosen, with a generator of its own if it draws."""
        if self.penalty == "conditioning":
            return self.make_regularizer(seed)
        if self.penalty == "caps":
            temporal = CAPS_TEMPORAL * self.coefficient
            return PENALTIES["caps"](temporal=temporal, spatial=self.coefficient, seed=seed)
        if self.penalty == "lcp":
            return PENALTIES["lcp"](coefficient=self.coefficient)  # it draws nothing
        return PENALTIES[self.penalty](coefficient=self.coefficient, seed=seed)

    def make_probe(
        self, seed: int, device: Device = "cpu", action_space: Any = None
    ) -> ConditioningProbe:
        """What logs the policy's conditioning: see `PenaltyArgs.make_probe`."""
        probe = super().make_probe(seed, device, action_space)
        if self.penalty != "conditioning":
            probe.own.coefficient = 0.0
        return probe

    def draw(self, learner: Any, data: Any) -> list[Tensor]:
        """What the penalty needs of a rollout besides states and actions, a row for each state.

        Args:
            learner: Has the penalty as `regularizer`.
            data: The rollout: `obs`, `after` (what each step led to) and `dones`, `[T, N, ...]`.
        """
        if self.penalty == "conditioning":
            return [learner.regularizer.sample_delta(data.obs.flatten(0, 1))]
        return [data.after.flatten(0, 1), data.dones.flatten()]

    def penalize(
        self, learner: Any, obs: Tensor, actions: Tensor, output: Any, drawn: Sequence[Tensor]
    ) -> Tensor:
        """The weighted penalty on a minibatch, `[]`: add it to the loss.

        Args:
            learner: Has `actor`, `critic` and, as `regularizer`, the penalty.
            obs: `[B, *obs_shape]`.
            actions: `[B, action_dim]`.
            output: `actor(obs)`.
            drawn: The minibatch's rows of what `draw` returned.
        """
        penalty = learner.regularizer
        if self.penalty == "conditioning":
            found = penalty(learner.actor, obs, delta=drawn[0], output=output)
        else:
            after, dones = drawn
            found = penalty(
                learner.actor,
                obs,
                output=output,
                next_obs=after,
                dones=dones,
                actions=actions,
                value=learner.critic,
            )
        weighted: Tensor = found.penalty
        return weighted
