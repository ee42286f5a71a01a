"""What the tests of populations share: agents by the population and by the single file."""

from __future__ import annotations

from types import ModuleType

import gymnasium as gym
import numpy as np
import torch

from baselines import ppo_reg_population, trpo_reg_population
from tests.baselines.helpers import SMALL

POPULATIONS = (ppo_reg_population, trpo_reg_population)


def single_of(module: ModuleType) -> ModuleType:
    return module.Args.single


def arguments(module: ModuleType, folder=None, **changes):
    """Arguments of a run of 3 agents and 5 short updates."""
    settings = {"env_id": "Pendulum-v1", "total_timesteps": 320, "num_agents": 3}
    path = folder and folder / "a{agent}"
    return module.Args(**{**settings, **SMALL[single_of(module)], "run_dir": path, **changes})


def seeds_of(args, checkpoint: int = 0) -> list[int]:
    return [seed for run in args.runs for seed in args.single.env_seeds(run, checkpoint)]


def learners_of(args) -> list:
    return [args.single.Learner(run) for run in args.runs]


def recorded(args, dtype: torch.dtype = torch.float32) -> tuple[list, list]:
    """Each agent's learner and a rollout of its own, by the single file."""
    single, learners, rollouts = args.single, learners_of(args), []
    for run, learner in zip(args.runs, learners, strict=True):
        envs = single.make_envs(run, learner.stats)
        next_obs, _ = envs.reset(seed=single.env_seeds(run, 0))
        data = single.rollout(run, learner, envs, next_obs)
        envs.close()
        columns = {k: x.to(dtype) for k, x in data._asdict().items() if torch.is_tensor(x)}
        rollouts.append(data._replace(**columns))
        learner.actor.to(dtype), learner.critic.to(dtype)
    return learners, rollouts


def state_of(learner) -> dict[str, torch.Tensor]:
    """All that a checkpoint holds of a learner, or what was read from one, by name."""
    found = {}

    def walk(name, value) -> None:
        if isinstance(value, dict | list):
            pairs = value.items() if isinstance(value, dict) else enumerate(value)
            for key, x in pairs:
                walk(f"{name}.{key}", x)
        else:
            found[name] = value

    walk("", learner if isinstance(learner, dict) else learner.state_dict())
    return found


def check_close(learner, other, tolerance: float) -> None:
    ours, theirs = state_of(learner), state_of(other)
    assert list(ours) == list(theirs)
    for name, value in theirs.items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            torch.testing.assert_close(
                ours[name], value, rtol=0, atol=tolerance, msg=lambda m, n=name: f"{n}: {m}"
            )
        elif isinstance(value, torch.Tensor):
            assert torch.equal(ours[name], value), name
        else:
            assert ours[name] == value, name


class Drift(gym.Env):
    """Random observations of every size, and episodes that end, are cut, or both at once."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.draw(), {}

    def step(self, action):
        ended, cut = (self.np_random.random(2) < 0.1).tolist()
        return self.draw(), self.np_random.normal() + float(action.sum()), ended, cut, {"x": 1}

    def draw(self):
        scale = 10.0 ** np.arange(-3, 2)
        return (scale * self.np_random.normal(size=5)).astype(np.float32)


class Wide(Drift):
    """One observation, and it is float64."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def draw(self):
        return self.np_random.normal(size=1)


class Square(Drift):
    """Observations and actions that are no vectors."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2, 3), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2, 2), np.float32)

    def draw(self):
        return self.np_random.uniform(size=(2, 3)).astype(np.float32)

    def step(self, action):
        assert action.shape == (2, 2)
        return super().step(action)


for name, env in (("Drift", Drift), ("Wide", Wide), ("DriftingSquare", Square)):
    gym.register(f"test/{name}-v0", env, max_episode_steps=30)
