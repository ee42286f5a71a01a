"""The actors of Stable-Baselines3 and sb3-contrib as modules, from observation to what counts.

SB3 calls an actor's stages one after another. A hook on the first stage tells the observation, and
a hook on the last stage tells when the output is there.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor, nn
from torch.utils import _pytree as pytree

Stage = Callable[[Any], Any]
Count = Callable[[Tensor, Any], Any]  # the last stage's output and the observation -> what counts


def find_actor(model: BaseAlgorithm) -> Actor:
    """The actor of a model, by the name of its algorithm or of one that it is derived from."""
    for name in names_of(model):
        if name in _MAKERS:
            return _MAKERS[name](model)
    reason = ": it learns without gradients" if "ARS" in names_of(model) else ""
    raise TypeError(
        f"model must be one of {', '.join(_MAKERS)}, got {type(model).__name__}{reason}. "
        "condwrap.attach(module, penalty) takes any network"
    )


def names_of(model: BaseAlgorithm) -> list[str]:
    """Of a model's class and those that it is derived from."""
    return [base.__name__ for base in type(model).__mro__]


class Actor(nn.Module):
    """An actor as one module: preprocessed observation -> output of the last stage.

    `enter` and `leave` are called when SB3 has reached the first and the last stage.
    """

    takes_any_states = True
    """whether it can be evaluated on some of a batch's states"""

    def __init__(
        self, owner: nn.Module, stages: Sequence[Stage], count: Count | None = None
    ) -> None:
        super().__init__()
        self.owner = owner  # for its parameters
        self.stages = stages
        self.count = count or _as_it_is
        # batch renormalization: the loss saw this batch's statistics, the penalty the running ones
        self.takes_output = not any(hasattr(module, "ra_mean") for module in owner.modules())
        self._obs: Any = None

    @property
    def first(self) -> Any:
        return self.stages[0]

    @property
    def last(self) -> Any:
        return self.stages[-1]

    def forward(self, obs: Any, *context: Any) -> Tensor:
        value = obs
        for stage in self.stages:
            value = stage(value)
        return value  # type: ignore[no-any-return]

    def enter(self, obs: Any) -> None:
        """The first stage is given an observation."""
        self._obs = obs

    def leave(self) -> tuple[Any, ...] | None:
        """The last stage has an output: the arguments that led to it, or None if unknown."""
        obs = self._obs
        self._obs = None
        return None if obs is None else (obs,)

    def hold(self) -> None:
        """Change what is needed beside the hooks."""

    def release(self) -> None:
        """Undo what `hold` did."""


class Masked(NamedTuple):
    """An observation with the actions that are allowed in it, `[B, number of logits]`."""

    obs: Any
    allowed: Tensor


class MaskedActor(Actor):
    """Of MaskablePPO: the mask comes with the observation, so that a penalty may take some rows."""

    def __init__(self, policy: Any, stages: Sequence[Stage], count: Count) -> None:
        super().__init__(policy, stages, count)
        self.arguments = Recorded(policy, "evaluate_actions")

    def forward(self, obs: Any, *context: Any) -> Tensor:
        return super().forward(obs.obs if isinstance(obs, Masked) else obs)

    def leave(self) -> tuple[Any, ...] | None:
        args = super().leave()
        given = self.arguments.given
        if args is None or given is None:
            return None
        masks = given.get("action_masks")
        if masks is None:
            return args
        rows = len(pytree.tree_leaves(args)[0])
        return (Masked(args[0], torch.as_tensor(masks, dtype=torch.bool).reshape(rows, -1)),)

    def hold(self) -> None:
        self.arguments.install()

    def release(self) -> None:
        self.arguments.remove()


class RecurrentActor(Actor):
    """Of RecurrentPPO: takes the rows of a padded minibatch of sequences that are no padding."""

    takes_any_states = False

    def __init__(self, model: Any, stages: Sequence[Stage], count: Count | None) -> None:
        super().__init__(model.policy, stages, count)
        self.takes_output = False  # it has the padded rows
        self.arguments = Recorded(model.policy, "evaluate_actions")
        self.batches = RecordedBatches(model.rollout_buffer)

    def forward(self, obs: Any, *context: Any) -> Tensor:
        states, starts, real = context
        policy: Any = self.owner
        features = self.first(pytree.tree_map(lambda x: _pad(x, real), obs))
        latent, _ = policy._process_sequence(features, states, starts, policy.lstm_actor)
        for stage in self.stages[1:]:
            latent = stage(latent)
        return latent[real]  # type: ignore[no-any-return]

    def leave(self) -> tuple[Any, ...] | None:
        args = super().leave()
        given = self.arguments.given
        if args is None or given is None:
            return None
        starts = given["episode_starts"]
        real = self.batches.real
        if real is None or len(real) != len(starts):  # not called by the model's own update
            real = torch.ones_like(starts, dtype=torch.bool)
        obs = pytree.tree_map(lambda x: x[real], args[0])
        return obs, given["lstm_states"].pi, starts, real

    def hold(self) -> None:
        self.arguments.install()
        self.batches.install()

    def release(self) -> None:
        self.arguments.remove()
        self.batches.remove()


class Recorded:
    """Stands for a method of an object, and keeps its arguments while it runs."""

    def __init__(self, owner: Any, name: str) -> None:
        self.owner = owner
        self.name = name
        self.method = getattr(owner, name)
        self.given: dict[str, Any] | None = None

    def install(self) -> None:
        setattr(self.owner, self.name, self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.given = inspect.signature(self.method).bind(*args, **kwargs).arguments
        try:
            return self.method(*args, **kwargs)
        finally:
            self.given = None

    def remove(self) -> None:
        delattr(self.owner, self.name)


class RecordedBatches:
    """Stands for `get` of a buffer of sequences, and keeps which rows are real."""

    def __init__(self, buffer: Any) -> None:
        self.buffer = buffer
        self.method = buffer.get
        self.real: Tensor | None = None

    def install(self) -> None:
        self.buffer.get = self

    def __call__(self, batch_size: int | None = None) -> Iterator[Any]:
        for samples in self.method(batch_size):
            self.real = samples.mask > 0
            yield samples
        self.real = None

    def remove(self) -> None:
        del self.buffer.get


# --- the actor of each algorithm -----------------------------------------------------------------


def _make_actor_critic(model: Any) -> Actor:
    policy = model.policy
    return Actor(policy, _stages_of_policy(policy), _count_actions(model.action_space))


def _make_masked(model: Any) -> Actor:
    space = model.action_space
    if isinstance(space, spaces.MultiBinary):  # two logits for each, as MaskablePPO has them
        space = spaces.MultiDiscrete([2] * space.n)  # type: ignore[operator]
    count = _count_actions(space)
    return MaskedActor(model.policy, _stages_of_policy(model.policy), count or _as_it_is)


def _make_recurrent(model: Any) -> Actor:
    return RecurrentActor(
        model, _stages_of_policy(model.policy), _count_actions(model.action_space)
    )


def _make_gaussian(model: Any) -> Actor:
    return Actor(model.actor, _parts(model.actor, "features_extractor", "latent_pi", "mu"))


def _make_deterministic(model: Any) -> Actor:
    return Actor(model.actor, _parts(model.actor, "features_extractor", "mu"))


def _make_q(model: Any) -> Actor:
    return Actor(model.q_net, _parts(model.q_net, "features_extractor", "q_net"))


def _make_quantiles(model: Any) -> Actor:
    net = model.quantile_net
    stages = _parts(net, "features_extractor", "quantile_net")

    def mean(quantiles: Tensor, _: Any) -> Tensor:
        return quantiles.view(len(quantiles), net.n_quantiles, -1).mean(1)

    return Actor(net, stages, mean)


_MAKERS: dict[str, Callable[[Any], Actor]] = {
    "PPO": _make_actor_critic,
    "A2C": _make_actor_critic,
    "SAC": _make_gaussian,
    "TD3": _make_deterministic,
    "DDPG": _make_deterministic,
    "DQN": _make_q,
    "TQC": _make_gaussian,
    "QRDQN": _make_quantiles,
    "CrossQ": _make_gaussian,
    "MaskablePPO": _make_masked,
    "RecurrentPPO": _make_recurrent,
    "TRPO": _make_actor_critic,
}


def _stages_of_policy(policy: Any) -> list[Stage]:
    features, hidden, output = _parts(
        policy, "pi_features_extractor", "mlp_extractor", "action_net"
    )
    return [features, hidden.forward_actor, output]


def _parts(owner: nn.Module, *names: str) -> list[Any]:
    for name in names:
        if not isinstance(getattr(owner, name, None), nn.Module):
            raise TypeError(
                f"the model's {type(owner).__name__} must have the parts of SB3's own, "
                f"{', '.join(names)}, but has no module {name}: "
                "condwrap.attach(module, penalty) takes any network"
            )
    return [getattr(owner, name) for name in names]


# --- what counts of the output -------------------------------------------------------------------


def _as_it_is(output: Tensor, _: Any) -> Tensor:
    return output


def _count_actions(space: spaces.Space[Any]) -> Count | None:
    """Log-probabilities for discrete actions, `[B, number of logits]`; otherwise the output."""
    if isinstance(space, spaces.Discrete):
        sizes = [int(space.n)]
    elif isinstance(space, spaces.MultiDiscrete):
        sizes = [int(n) for n in space.nvec]
    else:
        return None

    def count(logits: Tensor, obs: Any) -> Tensor:
        allowed = obs.allowed if isinstance(obs, Masked) else torch.ones_like(logits).bool()
        return log_probabilities(logits, allowed, sizes)

    return count


def log_probabilities(logits: Tensor, allowed: Tensor, sizes: Sequence[int]) -> Tensor:
    """Of the allowed actions, which they are normalized over; 0 for the others.

    Args:
        logits: `[B, sum of sizes]`.
        allowed: bool, `[B, sum of sizes]`.
        sizes: Number of logits of each action.

    Returns:
        `[B, sum of sizes]`.
    """
    lowest = torch.finfo(logits.dtype).min  # finite: where nothing is allowed, -inf would be NaN
    parts = torch.split(logits.masked_fill(~allowed, lowest), list(sizes), -1)
    normalized = torch.cat([part.log_softmax(-1) for part in parts], -1)
    return normalized.masked_fill(~allowed, 0.0)


def _pad(x: Tensor, real: Tensor) -> Tensor:
    """Rows of x where `real` holds, zeros elsewhere."""
    padded = x.new_zeros(len(real), *x.shape[1:])
    padded[real] = x
    return padded
