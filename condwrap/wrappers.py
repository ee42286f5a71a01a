"""Gymnasium wrappers that add delta to what the agent sees: noise augmentation, and robustness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from condwrap.observation import IMAGE_SCALE
from condwrap.perturbation import Perturbation, get_perturbation

# Spawned from the reset seed; the environment draws from the seed's own stream, undisturbed.
_SPAWN_KEY = (0x636F6E64,)


class PerturbObservation(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Add delta to every observation; `info["clean_obs"]` keeps what the environment said.

    delta is drawn anew at each step from the wrapper's own generator, which `reset(seed=...)`
    seeds. The perturbed observation is clipped to the bounds of its space and has its dtype. uint8
    leaves are images: delta is in units of 255, and the result is rounded. In a Dict space every
    floating and uint8 Box is perturbed, by one delta over all of them; the rest passes through.

    Args:
        env: The environment, its normalization of observations inside this wrapper.
        perturbation: "sphere", "gaussian" or "uniform", or a map from standard-normal noise `[n]`
            to delta `[n]`.
        radius: Root-mean-square length of a named perturbation, above 0 (see
            `condwrap.perturbation`).

    Raises:
        TypeError: The observation space has no floating or uint8 Box.
        ValueError: An unknown perturbation, or a radius that is not above 0.

    Example:
        >>> import gymnasium as gym, numpy as np
        >>> env = PerturbObservation(gym.make("Pendulum-v1"), radius=0.01)
        >>> obs, info = env.reset(seed=0)
        >>> bool(np.linalg.norm(obs - info["clean_obs"]) <= 0.0101)
        True
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        perturbation: str | Perturbation = "sphere",
        radius: float = 1.0,
    ) -> None:
        RecordConstructorArgs.__init__(self, perturbation=perturbation, radius=radius)
        gym.Wrapper.__init__(self, env)
        _check_space(env.observation_space)
        self._map = get_perturbation(perturbation, radius)
        self._noise_rng = _noise_rng(None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and with a seed the noise too."""
        obs, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._noise_rng = _noise_rng(seed)
        return self._perturb(obs), {**info, "clean_obs": obs}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and perturb what it shows."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._perturb(obs), reward, terminated, truncated, {**info, "clean_obs": obs}

    def _perturb(self, obs: Any) -> Any:
        return _perturb(self.env.observation_space, obs, self._map, self._noise_rng)


class VectorPerturbObservation(VectorWrapper[Any, Any, Any, Any, Any], RecordConstructorArgs):
    """`PerturbObservation` for a vector environment, in every autoreset mode.

    Environment i draws from a generator of its own, seeded as `PerturbObservation` in environment
    i would be, so both give the same observations. `info` has the same keys as well: `clean_obs`
    and, in SAME_STEP mode, a perturbed `final_obs` with `final_info["clean_obs"]` beside it. The
    attribute `clean_obs` holds the clean observations of the last reset or step.

    Args:
        env: The vector environment, its normalization of observations inside this wrapper.
        perturbation: As for `PerturbObservation`.
        radius: As for `PerturbObservation`.

    Raises:
        TypeError: The observation space has no floating or uint8 Box.
        ValueError: An unknown perturbation, or a radius that is not above 0.

    Example:
        >>> import gymnasium as gym
        >>> envs = VectorPerturbObservation(gym.make_vec("Pendulum-v1", 2), radius=0.01)
        >>> obs, info = envs.reset(seed=0)
        >>> obs.shape, info["clean_obs"].shape
        ((2, 3), (2, 3))
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        perturbation: str | Perturbation = "sphere",
        radius: float = 1.0,
    ) -> None:
        RecordConstructorArgs.__init__(self, perturbation=perturbation, radius=radius)
        VectorWrapper.__init__(self, env)
        _check_space(env.single_observation_space)
        self._map = get_perturbation(perturbation, radius)
        self._noise_rngs = [_noise_rng(None) for _ in range(self.num_envs)]
        self._shown: list[Any] = [None] * self.num_envs  # what each environment showed last
        self.clean_obs: Any = None

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environments (with `options["reset_mask"]`, some), and with seeds the noise."""
        everything = np.ones(self.num_envs, dtype=np.bool_)
        mask = (options or {}).get("reset_mask", everything).copy()
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
            for i, own_seed in enumerate(seeds):
                if mask[i] and own_seed is not None:
                    self._noise_rngs[i] = _noise_rng(own_seed)
        self.clean_obs = obs
        return self._show(obs, mask), {**info, "clean_obs": obs, "_clean_obs": mask}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environments and perturb what they show, final observations first."""
        obs, rewards, terminations, truncations, info = self.env.step(actions)
        if "final_obs" in info:
            info = self._perturb_final(info)
        everything = np.ones(self.num_envs, dtype=np.bool_)
        info = {**info, "clean_obs": obs, "_clean_obs": everything}
        self.clean_obs = obs
        return self._show(obs, everything), rewards, terminations, truncations, info

    def _perturb_final(self, info: dict[str, Any]) -> dict[str, Any]:
        done, clean = info["_final_obs"], info["final_obs"]
        perturbed = clean.copy()
        for i in np.flatnonzero(done).tolist():
            perturbed[i] = self._perturb(i, clean[i])
        final_info = {**info.get("final_info", {}), "clean_obs": clean, "_clean_obs": done}
        return {**info, "final_obs": perturbed, "final_info": final_info}

    def _show(self, obs: Any, mask: np.ndarray[Any, np.dtype[np.bool_]]) -> Any:
        space = self.env.single_observation_space
        for i, row in enumerate(iterate(self.env.observation_space, obs)):
            if mask[i]:
                self._shown[i] = self._perturb(i, row)
        shown = create_empty_array(space, self.num_envs)
        return concatenate(space, self._shown, shown)  # type: ignore[arg-type]

    def _perturb(self, i: int, obs: Any) -> Any:
        space = self.env.single_observation_space
        return _perturb(space, obs, self._map, self._noise_rngs[i])


def _noise_rng(seed: int | None) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=_SPAWN_KEY))


def _boxes(space: spaces.Space[Any]) -> list[spaces.Box]:
    """The leaves that are perturbed, in the space's own order."""
    if isinstance(space, spaces.Dict):
        return [box for inner in space.spaces.values() for box in _boxes(inner)]
    if isinstance(space, spaces.Box) and (space.dtype.kind == "f" or space.dtype == np.uint8):
        return [space]
    return []


def _check_space(space: spaces.Space[Any]) -> None:
    if not _boxes(space):
        raise TypeError(
            "the observation space must be a floating or uint8 Box, or a Dict that holds one, "
            f"got {space}: scale integer observations first"
        )


def _perturb(
    space: spaces.Space[Any], obs: Any, perturbation: Perturbation, rng: np.random.Generator
) -> Any:
    """One observation of one environment, perturbed by one delta over all of its boxes."""
    sizes = [int(np.prod(box.shape)) for box in _boxes(space)]
    delta = perturbation(rng.standard_normal(sum(sizes)))
    parts = iter(np.split(delta, np.cumsum(sizes)[:-1]))

    def shift(space: spaces.Space[Any], obs: Any) -> Any:
        if isinstance(space, spaces.Dict):
            return {key: shift(inner, obs[key]) for key, inner in space.spaces.items()}
        if not (isinstance(space, spaces.Box) and _boxes(space)):
            return obs
        part = next(parts).reshape(space.shape)
        image = space.dtype == np.uint8
        moved = np.round(obs + IMAGE_SCALE * part) if image else obs + part
        return np.clip(moved, space.low, space.high).astype(space.dtype)

    return shift(space, obs)
