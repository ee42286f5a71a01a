"""A task and an agent whose episodes can be worked out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch

from baselines import ppo_reg

MEAN, DEVIATION, SLOPE = 2.0, 4.0, 0.5
LIMIT = 0.5  # of the box of actions


class Toy(gym.Env):
    """Begins at a number from the seed, counts up by 1 for 4 steps, pays 10 times the action."""

    metadata: ClassVar[dict] = {"render_modes": []}
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-LIMIT, LIMIT, (1,), np.float32)
    dt = 0.5
    made: ClassVar[list[Toy]] = []
    """every one that was made, in turn"""

    def __init__(self) -> None:
        self.seeds: list[int | None] = []
        self.seen: list[float] = []
        self.actions: list[float] = []
        self.closed = False
        Toy.made.append(self)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.seen.append(float(self.np_random.uniform(0, 6)))
        return self.obs, {}

    @property
    def obs(self) -> np.ndarray:
        return np.array([self.seen[-1]])

    def step(self, action: np.ndarray) -> tuple:
        assert action in self.action_space
        self.actions.append(float(action[0]))
        self.seen.append(self.seen[-1] + 1)
        return self.obs, 10 * self.actions[-1], len(self.actions) == 4, False, {}

    def close(self) -> None:
        self.closed = True


gym.register("Toy-v0", Toy)


def write_checkpoint(path: Path, module: Any = ppo_reg, log_std: float = -3.0, **changes: Any):
    """A run's checkpoint: mean action = SLOPE · (x - MEAN) / DEVIATION. Gives the args."""
    settings = {"env_id": "Toy-v0", "num_steps": 4, "total_timesteps": 4, "num_minibatches": 2}
    settings |= {"hidden_sizes": (1,), "activation": "relu", "run_dir": path}
    args = module.Args(**settings | changes)
    learner = module.Learner(args)
    first, _, last = learner.actor.mean
    with torch.no_grad():
        first.weight.fill_(1.0)
        first.bias.fill_(20.0)  # above 0 for every normalized observation
        last.weight.fill_(SLOPE)
        last.bias.fill_(-20.0 * SLOPE)
        learner.actor.log_std.fill_(log_std)
    if args.norm_obs:
        vars(learner.stats["obs_rms"]).update(
            mean=np.array([MEAN]), var=np.array([DEVIATION**2]), count=100.0
        )
    path.mkdir(parents=True, exist_ok=True)
    (path / "metrics.csv").touch()
    module.save_checkpoint(args, learner)
    return args
