"""OpenAI's own Procgen, for comparison: a program for an environment that has procgen-mirror.

It reads from standard input which runs are wanted, and writes what the engine answers. Neither our
packages nor theirs can be imported beside the other's, so it needs NumPy and procgen alone.
"""

from __future__ import annotations

import json
import os
import sys
import zlib
from typing import Any

import numpy as np

# the engine reports them as any other end; 1000 steps in the other games
TIME_LIMITS = {"bigfish": 6000, "bossfight": 4000, "leaper": 500, "maze": 500, "plunder": 4000}


class OriginalProcgen:
    """The step that ends an episode returns the next one's first frame, never the last one's."""

    def __init__(self, game: str, mode: str, num_envs: int, seed: int, options: dict) -> None:
        from procgen import ProcgenGym3Env

        self.env = ProcgenGym3Env(
            num=num_envs,
            env_name=game,
            distribution_mode=mode,
            rand_seed=seed,
            num_threads=os.cpu_count(),
            **options,
        )
        self.steps = np.zeros(num_envs, np.int64)
        self.time_limit = TIME_LIMITS.get(game, 1000)

    def frames(self) -> np.ndarray:
        return self.env.observe()[1]["rgb"].transpose(0, 3, 1, 2).copy()

    def step(self, actions: np.ndarray) -> dict[str, np.ndarray]:
        self.env.act(actions)
        rewards, _, done = self.env.observe()
        self.steps += 1
        late = done & (self.steps >= self.time_limit)
        self.steps[done] = 0

        said = self.env.get_info()
        return {
            "rewards": rewards.copy(),
            "terminations": done & ~late,
            "truncations": late,
            "success": np.array([info["prev_level_complete"] != 0 for info in said]),
            "level_seed": np.array([info["prev_level_seed"] for info in said]),
        }


def digest(frames: np.ndarray) -> np.ndarray:
    """A number for each frame."""
    return np.array([zlib.crc32(frame.tobytes()) for frame in frames])


def record(run: dict[str, Any]) -> None:
    """Answers to a run's actions, `[T, N]`, digests of its T + 1 frames, and the first `keep`."""
    env = OriginalProcgen(**run["engine"])
    digests = [digest(env.frames())]
    kept = [env.frames()]
    answers = []
    for actions in np.load(run["actions"]):
        answers.append(env.step(actions))
        digests.append(digest(env.frames()))
        if len(kept) < run["keep"]:
            kept.append(env.frames())
    env.env.close()

    columns = {name: np.array([answer[name] for answer in answers]) for name in answers[0]}
    np.savez(run["out"], digests=np.array(digests), first=np.array(kept), **columns)


if __name__ == "__main__":
    for wanted in json.loads(sys.stdin.read()):
        record(wanted)
