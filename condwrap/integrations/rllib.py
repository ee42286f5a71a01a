"""RLlib's PPO learner (new API stack) with a conditioning penalty in its loss."""

from __future__ import annotations

from typing import Any

from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner as PlainLearner
from torch import Tensor, distributions
from torch.utils import _pytree as pytree

from condwrap import ConditioningRegularizer


class PPOTorchLearner(PlainLearner):  # type: ignore[misc]
    """RLlib's `PPOTorchLearner`, whose loss contains a conditioning penalty.

    `learner_config_dict["conditioning"]` holds the arguments of a `ConditioningRegularizer`.
    Without it this is RLlib's own class. Each module has a penalty of its own, and each learner
    draws its own noise. Rows that RLlib masks do not count. psi is among the learner's results, as
    `result["learners"]["default_policy"]["conditioning/psi"]`.

    Raises:
        ValueError: In the loss, for a module with a recurrent state, and for an action distribution
            that is neither Gaussian nor Categorical.

    Example:
        config.learners(
            learner_class=PPOTorchLearner,
            learner_config_dict={"conditioning": {"coefficient": 1e-2}},
        )
    """

    def compute_loss_for_module(
        self, *, module_id: str, config: Any, batch: dict[str, Any], fwd_out: dict[str, Any]
    ) -> Tensor:
        """RLlib's loss + the penalty."""
        loss: Tensor = super().compute_loss_for_module(
            module_id=module_id, config=config, batch=batch, fwd_out=fwd_out
        )
        settings = config.learner_config_dict.get("conditioning")
        if settings is None:
            return loss

        module = self.module[module_id].unwrapped()
        if module.is_stateful():
            raise ValueError(
                f"module {module_id!r} has a recurrent state, whose padded steps would count: "
                "leave learner_config_dict['conditioning'] out"
            )
        obs = batch["obs"]
        if "loss_mask" in batch:  # false in the steps that RLlib adds to bootstrap values
            obs = pytree.tree_map(lambda x: x[batch["loss_mask"]], obs)

        def policy(obs: Any) -> distributions.Distribution:
            outputs = module.forward_train({"obs": obs})
            found = module.get_train_action_dist_cls().from_logits(outputs["action_dist_inputs"])
            return _torch_distribution(found)

        conditioning = self._penalty(module_id, settings)(policy, obs)
        self.metrics.log_dict(conditioning.metrics(), key=module_id, window=1)
        return loss + conditioning.penalty

    def _penalty(self, module_id: str, settings: dict[str, Any]) -> ConditioningRegularizer:
        """The module's own, made at the first use."""
        made: dict[str, ConditioningRegularizer] = self.__dict__.setdefault("_penalties", {})
        if module_id not in made:
            made[module_id] = ConditioningRegularizer(**({"seed": self._learner_index} | settings))
        return made[module_id]


def _torch_distribution(found: Any) -> distributions.Distribution:
    """PyTorch's distribution in one of RLlib's."""
    inner = getattr(found, "_dist", None)
    if not isinstance(inner, distributions.Distribution):
        raise ValueError(
            f"no mean or logits are known of RLlib's {type(found).__name__}: leave "
            "learner_config_dict['conditioning'] out"
        )
    return inner
