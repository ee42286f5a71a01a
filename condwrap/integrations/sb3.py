"""Regularize an agent of Stable-Baselines3 or sb3-contrib by one line.

    attach(model, ConditioningRegularizer(coefficient=1e-3))
    model.learn(100_000)

SB3 calls the parts of its actor one after another: features extractor, hidden layers, output. The
penalty's policy is all of them together. Its observation is what the features extractor is given,
after SB3's preprocessing (images in [0, 1], one-hot integers) and after VecNormalize.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor, nn

from condwrap.attach import Attachable, Attached, Hook
from condwrap.integrations.sb3_actors import Actor, find_actor, names_of
from condwrap.policy import is_measuring


def attach(model: BaseAlgorithm, penalty: Attachable) -> AttachedModel:
    """Add a penalty's gradient to every update of a model's actor, and log its metrics.

    `model.learn`, `save` and `load` are used as before. Whatever `condwrap.attach` says of the
    gradient holds here too. A loaded model is without the penalty: attach it again.

    What counts of the output:

    - PPO, A2C, RecurrentPPO: the mean of a Gaussian, before clipping; for discrete actions the
      log-probabilities, for MultiBinary ones the logits.
    - MaskablePPO: the log-probabilities of the actions that the mask allows.
    - SAC, TQC, CrossQ: the mean before the tanh. TD3, DDPG: the action.
    - DQN, QRDQN: the value of each action, for QRDQN the mean of its quantiles.
    - TRPO: as PPO, of `condwrap.integrations.sb3_trpo.TRPO`, whose line search sees the penalty.

    RecurrentPPO is evaluated on the sequences of the minibatch, without their padding. Each step
    of a sequence is perturbed, so what reaches an output through the hidden state counts as well.

    Args:
        model: Any of these algorithms, or of a class derived from one.
        penalty: Such as a `ConditioningRegularizer`. Its metrics go to `model.logger`, averaged
            over the updates since the last dump.

    Returns:
        A handle as `condwrap.attach` returns it: `metrics()`, `scale`, `remove()`.

    Raises:
        TypeError: An algorithm that is not in the list, or a policy without SB3's parts.
        ValueError: A penalty that needs more than observations and output, or a fraction of the
            states for RecurrentPPO.

    Example:
        >>> from stable_baselines3 import PPO
        >>> from condwrap import ConditioningRegularizer
        >>> model = PPO("MlpPolicy", "Pendulum-v1", n_steps=64, n_epochs=1)
        >>> handle = attach(model, ConditioningRegularizer(coefficient=0.1))
        >>> _ = model.learn(64)
        >>> handle.metrics()["attach/backwards"]
        1.0
    """
    actor = find_actor(model)
    fraction = getattr(penalty, "fraction", 1.0)
    if fraction != 1 and not actor.takes_any_states:
        raise ValueError(
            f"fraction must be 1 for {type(model).__name__}, got {fraction}: a sequence without "
            "some of its steps would be another sequence"
        )
    if "TRPO" in names_of(model):
        from condwrap.integrations.sb3_trpo import AttachedTRPO  # needs sb3-contrib

        return AttachedTRPO(model, penalty, actor)
    return AttachedModel(model, penalty, actor)


class AttachedModel(Attached):
    """The handle of a penalty that is attached to a model; see `attach`."""

    def __init__(self, model: BaseAlgorithm, penalty: Attachable, actor: Actor) -> None:
        super().__init__(actor, penalty)
        self.model = model
        self.actor = actor
        actor.hold()
        self._stage_hooks = [
            actor.first.register_forward_pre_hook(Hook(self._enter)),
            actor.last.register_forward_hook(Hook(self._leave)),
        ]

    def remove(self) -> None:
        super().remove()
        for hook in self._stage_hooks:
            hook.remove()
        self.actor.release()

    def _enter(self, first: nn.Module, args: tuple[Any, ...]) -> None:
        if not is_measuring():
            self.actor.enter(args[0])

    def _leave(self, last: nn.Module, args: tuple[Any, ...], output: Tensor) -> Any:
        """The last stage's output, carried."""
        if is_measuring():
            return None
        call = self.actor.leave()
        if call is None:
            return None
        self.actor.training = last.training  # its own flag, which SB3 does not set
        return self._carry(call, {}, output)

    def _measure(self, policy: Callable[[Any], Any], obs: Any, output: Any) -> Tensor:
        actor = self.actor
        known = None
        if output is not None and actor.takes_output:
            known = actor.count(output, obs)
        return super()._measure(lambda obs: actor.count(policy(obs), obs), obs, known)

    def _record(self, metrics: dict[str, float]) -> None:
        super()._record(metrics)
        if hasattr(self.model, "_logger"):  # which `learn` makes
            for name, value in metrics.items():
                self.model.logger.record_mean(name, value)
