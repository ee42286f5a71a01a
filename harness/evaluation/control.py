"""Evaluation of an agent on its control task: the final policy's episodes, each a row.

Every episode is a function of the checkpoint and its own number alone. It has an environment of its
own, since a simulator that is reset is not bit for bit a new one, and seeds that training does not
use. They are those of the run's seed and agent, so both arms of a pair start from the same states.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor, nn

from harness.evaluation.checkpoint import Checkpoint
from harness.evaluation.settings import EvaluationError
from harness.evaluation.smoothness import action_change, smoothness

POLICIES = ("deterministic", "sampled")
COLUMNS = ["policy", "episode", "return", "length", "action_change", "smoothness"]
STREAM = 0x6576616C  # "eval"; training spawns its streams from 0 on


def evaluate(checkpoint: Checkpoint, episodes: int) -> Iterator[pd.DataFrame]:
    """So many episodes with the policy's mean, and as many with sampled actions, one at a time.

    Returns are of raw rewards. Observations are clean, whatever the agent was trained on, and
    normalized by the statistics that training ended with. Actions are clipped to their box, and the
    measures of smoothness are of the clipped ones.
    """
    module, args = checkpoint.module, checkpoint.args
    learner = load_learner(checkpoint)
    for policy in POLICIES:
        for episode in range(episodes):
            env_seed, noise_seed = episode_seeds(args, episode)
            noise = torch.Generator().manual_seed(noise_seed) if policy == "sampled" else None
            env = make_env(module, args, learner.stats)
            try:
                found = play(learner.actor, env, env_seed, noise)
            except EvaluationError as error:
                raise EvaluationError(f"{checkpoint.path}: {error}") from None
            finally:
                env.close()
            row = {"policy": policy, "episode": episode, **found}
            yield pd.DataFrame([row], columns=COLUMNS)


def load_learner(checkpoint: Checkpoint) -> Any:
    """The baseline's Learner as its run left it: actor, critic and the statistics of observations.

    Raises:
        EvaluationError: Its task is not installed here, or its weights are of another version.
    """
    module = checkpoint.module
    try:
        learner = module.Learner(checkpoint.args)
        learner.load_state_dict(checkpoint.learner)
    except (gym.error.Error, ModuleNotFoundError, module.RunError) as error:
        raise EvaluationError(f"{checkpoint.path}: {error}") from error
    except (KeyError, RuntimeError, ValueError) as error:  # weights of another shape or version
        what = f"weights that today's {checkpoint.baseline} does not take"
        raise EvaluationError(f"{checkpoint.path} holds {what}: {error!r}") from error
    return learner


def episode_seeds(args: Any, episode: int) -> list[int]:
    """Of an episode's start, and of its action noise."""
    entropy = (args.seed, args.agent)
    sequence = np.random.SeedSequence(entropy, spawn_key=(STREAM, episode))
    return sequence.generate_state(2).tolist()


def make_env(module: Any, args: Any, stats: dict[str, Any]) -> VectorEnv:
    """One clean environment, its observations normalized by frozen statistics."""
    maker = functools.partial(module.make_env, args)
    env: VectorEnv = SyncVectorEnv([maker], autoreset_mode=AutoresetMode.DISABLED)
    if args.norm_obs:
        env = module.NormalizeObservation(env, stats["obs_rms"], update=False)
    return env


class Episode:
    """An episode under way: what the policy sees next, and what was done and earned so far."""

    def __init__(self, env: VectorEnv, seed: int) -> None:
        self.env = env
        self.obs: np.ndarray = env.reset(seed=seed)[0]
        """normalized, `[1, n]`"""
        self.rewards: list[float] = []
        self.actions: list[np.ndarray] = []
        self.over = False
        self.terminated = False
        """over for good, not by a time limit"""

    def step(self, action: Tensor) -> None:
        """Execute an action, `[1, m]`, clipped to its box."""
        space = self.env.single_action_space
        executed = action.numpy().reshape(1, *space.shape).clip(space.low, space.high)
        if not np.isfinite(executed).all():
            raise EvaluationError("its policy gives actions that are not finite: train it anew")

        self.obs, reward, terminated, truncated, _ = self.env.step(executed)
        self.rewards.append(float(reward[0]))
        self.actions.append(executed.ravel())
        self.terminated = bool(terminated[0])
        self.over = bool(terminated[0] or truncated[0])

    def measures(self) -> dict[str, float]:
        """What a row of the evaluation tells of it."""
        taken = np.array(self.actions)
        rate = 1 / time_step(self.env.unwrapped.envs[0])
        return {
            "return": sum(self.rewards),
            "length": len(self.rewards),
            "action_change": action_change(taken),
            "smoothness": smoothness(taken, rate),
        }


@torch.no_grad()
def play(
    actor: nn.Module, env: VectorEnv, seed: int, noise: torch.Generator | None
) -> dict[str, float]:
    """One episode, with the policy's mean or, given a generator, with sampled actions."""
    episode = Episode(env, seed)
    while not episode.over:
        policy = actor(torch.as_tensor(episode.obs, dtype=torch.float32))
        action = policy.mean
        if noise is not None:
            action = action + policy.stddev * torch.randn(action.shape, generator=noise)
        episode.step(action)
    return episode.measures()


def time_step(env: gym.Env) -> float:
    """Seconds between two actions by the task's own `dt`, which Bullet's tasks have in a scene.

    1 where the task does not say: smoothness does not depend on it.
    """
    task = env.unwrapped
    return float(getattr(getattr(task, "scene", task), "dt", 1.0))
