"""What 500 random steps of each PyBullet task cost, stock and fast, with their episodes' resets.

Groups are one task each, so that ratios are read off one run.
"""

from __future__ import annotations

import time

import gymnasium as gym
import numpy as np
import pytest

from harness.envs import fast_bullet

STEPS = 500


@pytest.mark.benchmark(timer=time.process_time)  # other jobs of the machine disturb it less
@pytest.mark.parametrize("kind", ["stock", "fast"])
@pytest.mark.parametrize("name", fast_bullet.NAMES)
def test_environment(benchmark, name, kind):
    env = gym.make(f"{'Fast' if kind == 'fast' else ''}{name}BulletEnv-v0")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (STEPS, *env.action_space.shape)).astype(np.float32)

    def play():
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    benchmark.group = f"{STEPS} random steps, {name}"
    goal = 1.3 if name in ("Reacher", "InvertedDoublePendulum") else 1.8
    benchmark.extra_info.update({"peer": True} if kind == "stock" else {"goal": goal}, steps=STEPS)
    benchmark.pedantic(play, rounds=11, warmup_rounds=1)
    assert env.unwrapped.physicsClientId >= 0
    env.close()
