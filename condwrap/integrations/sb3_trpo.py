"""sb3-contrib's TRPO with a line search that sees an attached penalty."""

from __future__ import annotations

from typing import Any

import torch
from sb3_contrib import TRPO as PlainTRPO  # noqa: N811
from torch import Tensor, nn

from condwrap.attach import Attachable
from condwrap.integrations.sb3 import AttachedModel
from condwrap.integrations.sb3_actors import Actor
from condwrap.policy import is_measuring


class TRPO(PlainTRPO):  # type: ignore[misc]
    """sb3-contrib's TRPO, to which `condwrap.integrations.sb3.attach` can attach a penalty.

    A step maximizes surrogate - penalty within the bound on the KL divergence, and the line search
    accepts a step that improves this difference. delta is the same in both, as in
    `baselines/trpo_reg.py`. Products with the Fisher matrix are of the KL divergence alone. Without
    a penalty it is `sb3_contrib.TRPO`.

    Example:
        >>> from condwrap import ConditioningRegularizer
        >>> from condwrap.integrations.sb3 import attach
        >>> model = TRPO("MlpPolicy", "Pendulum-v1", n_steps=64, batch_size=64)
        >>> handle = attach(model, ConditioningRegularizer(coefficient=0.1))
        >>> _ = model.learn(64)
        >>> handle.metrics()["attach/backwards"]
        1.0
    """

    _attached: AttachedTRPO | None = None

    def train(self) -> None:
        super().train()
        if self._attached is not None:
            self._attached.finish()

    def _compute_actor_grad(self, kl_div: Tensor, policy_objective: Tensor) -> Any:
        if self._attached is not None:
            policy_objective = self._attached.start(policy_objective)
        return super()._compute_actor_grad(kl_div, policy_objective)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_attached"]


class AttachedTRPO(AttachedModel):
    """The handle of a penalty that is attached to a `TRPO`.

    sb3-contrib's line search accepts new_objective > old_objective. Both hold the surrogate only,
    so before each comparison the old one is set to surrogate_old - penalty_old + penalty_new.
    """

    def __init__(self, model: Any, penalty: Attachable, actor: Actor) -> None:
        if not isinstance(model, TRPO):
            raise TypeError(
                f"the line search of {type(model).__module__}.{type(model).__name__} would not see "
                "the penalty: use condwrap.integrations.sb3_trpo.TRPO, which is derived from it"
            )
        super().__init__(model, penalty, actor)
        self._call: Any = None  # the observation, and the output with its graph
        self._old: Tensor | None = None  # during the line search
        self._noise: Tensor | None = None
        model._attached = self

    def remove(self) -> None:
        super().remove()
        self.model._attached = None

    def start(self, objective: Tensor) -> Tensor:
        """The objective with the penalty, at the parameters before the step."""
        generator = getattr(self.penalty, "generator", None)
        self._noise = None if generator is None else generator.get_state()
        obs, output = self._call
        self._old = None
        penalty = self._measure(self.actor, obs, output)

        self._forwards += 1
        self._old = objective
        self._surrogate = objective.item()
        self._penalty = penalty.item()
        # a constant with coefficient 0, which must not touch a bit
        return objective - penalty if penalty.requires_grad else objective

    def finish(self) -> None:
        """The line search is over."""
        logger = self.model.logger
        if not logger.name_to_value["train/is_line_search_success"]:
            logger.record("train/policy_objective", self._surrogate)  # not what it was set to
        self._old = None
        self._call = None

    def _leave(self, last: nn.Module, args: tuple[Any, ...], output: Tensor) -> Any:
        if is_measuring():
            return
        call = self.actor.leave()
        if call is None or not last.training:
            return
        if torch.is_grad_enabled():
            self._call = (call[0], output)
        elif self._old is not None:
            self._set_old(call[0], output)

    def _set_old(self, obs: Any, output: Tensor) -> None:
        """Let the comparison that comes next see the penalty of the parameters that it tries."""
        if self._noise is not None:
            self.penalty.generator.set_state(self._noise)  # type: ignore[attr-defined]
        penalty = self._measure(self.actor, obs, output).item()
        self._old.data.fill_(self._surrogate - self._penalty + penalty)  # type: ignore[union-attr]

    def _record(self, metrics: dict[str, float]) -> None:
        if self._old is None:  # once for each update, not at each step of the line search
            super()._record(metrics)
