"""What the tests of the baselines share: short runs, what they left behind, and the program."""

from __future__ import annotations

import csv
import importlib.util
import itertools
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch

from baselines import ppo_reg, ppo_reg_coinrun, trpo_reg

BASELINES = (ppo_reg, trpo_reg)
ALL = (*BASELINES, ppo_reg_coinrun)
SMALL = {
    ppo_reg: {"num_steps": 64, "num_minibatches": 4, "update_epochs": 2, "vf_epochs": 2},
    trpo_reg: {"num_steps": 64, "num_minibatches": 4, "vf_epochs": 2},
}
FLAGS = ["--num-steps=64", "--num-minibatches=4", "--checkpoint-interval=2"]
OWN_FLAGS = {
    ppo_reg: ["--env-id=Pendulum-v1"],
    trpo_reg: ["--env-id=Pendulum-v1"],
    ppo_reg_coinrun: ["--num-envs=1", "--num-groups=1", "--num-levels=8", "--update-epochs=1"],
}


def name(baseline: ModuleType) -> str:
    return Path(baseline.__file__).stem


def pendulum(baseline: ModuleType, path: Path, **changes):
    """Arguments of a run of 5 short updates."""
    settings = {"env_id": "Pendulum-v1", "total_timesteps": 320, "run_dir": path}
    return baseline.Args(**{**settings, **SMALL[baseline], **changes})


def coinrun(path: Path, **changes):
    """Arguments of a run of 5 short updates on CoinRun."""
    settings = {"num_envs": 1, "num_groups": 1, "num_levels": 8, "distribution_mode": "easy"}
    settings |= {"num_minibatches": 4, "update_epochs": 2, "eval_interval": 0, "run_dir": path}
    settings |= {"num_steps": 64, "total_timesteps": 320}
    return ppo_reg_coinrun.Args(**{**settings, **changes})


def short_run(baseline: ModuleType, path: Path, **changes):
    """Arguments of a run of 5 updates of 64 steps."""
    if baseline is ppo_reg_coinrun:
        return coinrun(path, **changes)
    return pendulum(baseline, path, **changes)


def read_metrics(path: Path) -> list[dict[str, str]]:
    with open(path / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def without_speed(path: Path) -> list[dict[str, str]]:
    return [
        {k: v for k, v in row.items() if not k.startswith("charts/SPS")}
        for row in read_metrics(path)
    ]


def flat(module: torch.nn.Module) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in module.parameters()])


def weights(learner) -> torch.Tensor:
    if hasattr(learner, "agent"):
        return flat(learner.agent)
    return torch.cat([flat(learner.actor), flat(learner.critic)])


def load_module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def interrupted(baseline: ModuleType, args, monkeypatch, at_update: int) -> None:
    """Train until Ctrl-C comes in the middle of an update."""
    update = baseline.update
    calls = itertools.count()

    def stop(args, learner, data):
        if next(calls) == at_update:
            raise KeyboardInterrupt
        return update(args, learner, data)

    with monkeypatch.context() as patch:
        patch.setattr(baseline, "update", stop)
        with pytest.raises(KeyboardInterrupt):
            baseline.train(args)


class Scripted:
    """Stands in for Procgen: each environment's episodes have the lengths listed for it.

    The frame shows the step of the episode, the return is 10 if the length is odd, and the level
    seed is 100 · environment + episode. A step after an end is a reset, as with EnvPool.
    """

    def __init__(self, lengths: list[list[int]], *, spends_a_step: bool = True) -> None:
        self.num_envs, self.lengths, self.spends_a_step = len(lengths), lengths, spends_a_step

    def reset(self, *, seed: int | None = None):
        self.episode, self.t = np.zeros(self.num_envs, int), np.zeros(self.num_envs, int)
        self.ended = np.zeros(self.num_envs, bool)
        return self._frames(), {}

    def step_async(self, actions: np.ndarray) -> None:
        assert actions.shape == (self.num_envs,)

    def step_wait(self):
        reset = self.ended & self.spends_a_step
        self.episode += self.ended
        self.t = np.where(self.ended, 0, self.t) + ~reset
        ends = zip(self.lengths, self.episode, self.t, strict=True)
        self.ended = np.array([n < len(e) and t == e[n] for e, n, t in ends])
        rewards = np.where(self.ended & (self.t % 2 == 1), 10.0, 0.0)
        info = {"reset": reset}
        if self.ended.any():
            seeds = 100 * np.arange(self.num_envs) + self.episode
            info |= {"episode": {"r": rewards, "l": self.t}, "_episode": self.ended}
            info |= {"success": rewards > 0, "level_seed": seeds}
        return self._frames(), rewards, self.ended, np.zeros(self.num_envs, bool), info

    def step(self, actions: np.ndarray):
        self.step_async(actions)
        return self.step_wait()

    def close(self) -> None:
        pass

    def _frames(self) -> np.ndarray:
        shape = (self.num_envs, 3, 64, 64)
        return np.broadcast_to(self.t[:, None, None, None], shape).astype(np.uint8)


class Program:
    """A copy of the file, run alone in a folder, its output in a log."""

    def __init__(self, baseline: ModuleType, folder: Path, *flags: str, **kwargs) -> None:
        copy = shutil.copy(baseline.__file__, folder)
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        self.log = folder / "log.txt"
        with open(self.log, "w") as log:
            self.process = subprocess.Popen(
                [sys.executable, copy, *FLAGS, *OWN_FLAGS[baseline], *flags],
                cwd=folder, env=environment, stdout=log, stderr=log, **kwargs,
            )  # fmt: skip

    def wait(self) -> str:
        self.process.wait()
        return self.log.read_text()

    def kill_after_checkpoint(self, run: Path, kill: int) -> str:
        while not (run / "checkpoint.pt").exists():
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.02)
        self.process.send_signal(kill)
        return self.wait()


def check_refusal(baseline: ModuleType, flags, message, monkeypatch, capsys, folder: Path) -> None:
    """The program ends with an error that holds the message."""
    monkeypatch.setattr(sys, "argv", [f"{name(baseline)}.py", *flags])
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as stopped:
        baseline.main()
    captured = capsys.readouterr()
    said = " ".join(f"{captured.out} {captured.err} {stopped.value}".replace("│", " ").split())
    assert message in said
    assert stopped.value.code != 0


class Breaking(gym.Env):
    """Random observations, rewards and ends; something is no number from a step on.

    `breaks` holds that step for the environments that break, by the seed of their first reset.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    breaks: ClassVar[dict[int, int]] = {}

    def __init__(self, what: str, number: float) -> None:
        self.what = what
        self.number = number
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.breaks_at = self.breaks.get(seed, np.inf)
        return self.draw(), {}

    def step(self, action):
        self.steps += 1
        broken = self.steps >= self.breaks_at
        obs = self.draw()
        reward = self.np_random.normal() + float(action.sum())
        if broken and self.what == "reward":
            reward = self.number
        elif broken:
            obs[1] = self.number
        return obs, reward, bool(self.np_random.random() < 0.05), False, {}

    def draw(self):
        return self.np_random.normal(size=3).astype(np.float32)


NUMBERS = {"nan": np.nan, "inf": np.inf}
for what in ("reward", "observation"):
    for label, number in NUMBERS.items():
        env_id = f"test/Breaking-{what}-{label}-v0"
        gym.register(env_id, Breaking, kwargs={"what": what, "number": number})
