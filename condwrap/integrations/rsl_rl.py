"""rsl-rl's PPO with a conditioning penalty, chosen by `class_name` as rsl-rl's own classes are."""

from __future__ import annotations

from typing import Any

from rsl_rl.algorithms import PPO as PlainPPO  # noqa: N811
from rsl_rl.models import MLPModel

from condwrap import ConditioningRegularizer, attach


class PPO(PlainPPO):  # type: ignore[misc]
    """rsl-rl's PPO; `conditioning_cfg` holds the arguments of a `ConditioningRegularizer`.

    The penalty sees the mean of the action as a function of what the actor's MLP gets: the
    observation groups, joined and normalized. Its metrics are among the losses that rsl-rl logs, as
    `Loss/conditioning/psi`. Without `conditioning_cfg` this is rsl-rl's own class.

    With several GPUs each rank draws its own noise. The mirror loss of rsl-rl's symmetry calls the
    actor once more, and so it is penalized once more. Saving, loading and exporting are as without
    the penalty, which is attached for the time of an update.

    Args:
        conditioning_cfg: For example `{"coefficient": 1e-2}`. By default `select` is the mean and
            `seed` the rank.

    Raises:
        ValueError: The actor computes a latent before its MLP, by an RNN or a CNN, or rsl-rl is to
            compile its models.

    Example:
        cfg["algorithm"]["class_name"] = "condwrap.integrations.rsl_rl:PPO"
        cfg["algorithm"]["conditioning_cfg"] = {"coefficient": 1e-2}
    """

    def __init__(
        self, *args: Any, conditioning_cfg: dict[str, Any] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.penalty: ConditioningRegularizer | None = None
        if conditioning_cfg is None:
            return
        if type(self.actor).get_latent is not MLPModel.get_latent:
            raise ValueError(
                f"the actor must be an MLPModel, got {type(self.actor).__name__}, whose MLP sees a "
                "latent and not the observation: leave conditioning_cfg out"
            )
        select = self.actor.distribution.deterministic_output
        own = {"select": select, "seed": self.gpu_global_rank}
        self.penalty = ConditioningRegularizer(**(own | conditioning_cfg))

    def update(self) -> dict[str, float]:
        """One update of rsl-rl; the penalty's metrics are among the losses."""
        if self.penalty is None:
            return super().update()  # type: ignore[no-any-return]
        with attach(self.actor.mlp, self.penalty) as handle:
            losses: dict[str, float] = super().update()
            return losses | handle.metrics()

    def compile(self, mode: str | None = None) -> None:
        """Refused with a penalty: compiled code would not notice what an update attaches."""
        if mode is not None and self.penalty is not None:
            raise ValueError(
                f"torch_compile_mode={mode!r} does not go with conditioning_cfg: leave out one"
            )
        super().compile(mode)
