"""Observations that a policy meets in its environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from condwrap.disk import DiskError, Found
from condwrap.policy import flat_output

if TYPE_CHECKING:
    import gymnasium as gym

SPACING = 4  # steps between two observations that are kept


def collect(found: Found, env_id: str, states: int, seed: int = 0) -> tuple[Tensor, str]:
    """Observations `[states, *obs_shape]` as the policy sees them, and how they came about.

    The policy acts by its own output where that is an action: clipped to a Box of its size, or the
    largest of the outputs where actions are discrete. Otherwise actions are random.

    Raises:
        DiskError: Gymnasium is missing, or the environment cannot be made or has other
            observations than an array.
    """
    env = _make(env_id)
    obs, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    own = True
    kept: list[Tensor] = []
    try:
        for step in range(states * SPACING):
            if not isinstance(obs, np.ndarray | np.number | int):
                raise DiskError(f"{env_id} has observations of {type(obs).__name__}: pass --obs")
            seen = found.normalize(torch.as_tensor(np.asarray(obs))[None])
            seen = seen.float() if seen.dtype == torch.float64 else seen
            if step % SPACING == 0:
                kept.append(seen)

            action = _act(found, env.action_space, seen)
            own = own and action is not None
            obs, _, terminated, truncated, _ = env.step(
                env.action_space.sample() if action is None else action
            )
            if terminated or truncated:
                obs, _ = env.reset()
    finally:
        env.close()
    how = "its own actions" if own else "random actions, since its output is not one"
    return torch.cat(kept), f"{states * SPACING} steps of {env_id} with {how}"


def _make(env_id: str) -> gym.Env[Any, Any]:
    try:
        import gymnasium as gym
    except ModuleNotFoundError:
        raise DiskError(
            "--env-id needs Gymnasium: pip install 'condwrap[gymnasium]', or pass --obs"
        ) from None
    try:
        return gym.make(env_id)
    except (gym.error.Error, ModuleNotFoundError) as error:
        raise DiskError(
            f"{env_id} cannot be made: {error}. Name the package that registers it too, as in "
            "pybullet_envs_gymnasium:HopperBulletEnv-v0"
        ) from error


@torch.no_grad()
def _act(found: Found, space: Any, obs: Tensor) -> Any:
    """The policy's own action, or None where its output is none."""
    output = flat_output(found.policy(obs), "default", obs.shape[:1])[0].numpy()
    if hasattr(space, "n"):
        return int(output.argmax()) + int(space.start) if len(output) == space.n else None
    if hasattr(space, "low") and output.size == np.prod(space.shape):
        return output.reshape(space.shape).clip(space.low, space.high).astype(space.dtype)
    return None
