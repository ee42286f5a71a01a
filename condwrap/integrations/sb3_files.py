"""Models of Stable-Baselines3 and sb3-contrib from their ZIP files, for `python -m condwrap`."""

from __future__ import annotations

import importlib
import json
import zipfile
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import Tensor

from condwrap.disk import DiskError, Found
from condwrap.integrations.sb3_actors import find_actor

ALGORITHMS = {
    "stable_baselines3.sac.policies": "stable_baselines3:SAC",
    "stable_baselines3.td3.policies": "stable_baselines3:TD3",  # DDPG's is TD3's
    "stable_baselines3.dqn.policies": "stable_baselines3:DQN",
    "sb3_contrib.tqc.policies": "sb3_contrib:TQC",
    "sb3_contrib.qrdqn.policies": "sb3_contrib:QRDQN",
    "sb3_contrib.crossq.policies": "sb3_contrib:CrossQ",
}
"""by the module of the policy's class, which the file names in plain text"""


def read(path: Path) -> Found:
    """The model's actor as a policy, after SB3's preprocessing. It unpickles parts of the file.

    Raises:
        DiskError: The policy is recurrent, masked, or of a class that SB3 does not have.
    """
    with zipfile.ZipFile(path) as file:
        data = json.loads(file.read("data"))
    module, _, name = _algorithm(path, data).partition(":")
    model = getattr(importlib.import_module(module), name).load(path, device="cpu")
    model.policy.set_training_mode(False)
    actor = find_actor(model)

    def policy(obs: Tensor) -> Any:
        return actor.count(actor(obs), obs)

    def normalize(obs: Tensor) -> Tensor:
        prepared, _ = model.policy.obs_to_tensor(obs.numpy())
        processed = preprocess_obs(
            prepared, model.observation_space, normalize_images=model.policy.normalize_images
        )
        if not isinstance(processed, torch.Tensor):
            raise DiskError(f"{path} has observations of several parts: pass my_module:policy")
        return processed

    return Found(policy, f"a model of {name}, {model.num_timesteps:,} steps", normalize)


def _algorithm(path: Path, data: dict[str, Any]) -> str:
    """What loads the model, as module:class."""
    module = data.get("policy_class", {}).get("__module__", "nothing")
    if module == "stable_baselines3.common.policies":
        return "stable_baselines3:PPO" if "clip_range" in data else "stable_baselines3:A2C"
    if module not in ALGORITHMS:
        raise DiskError(
            f"{path} has a policy of {module}, which is none of SB3's own, or recurrent or masked: "
            "load it yourself, and pass my_module:policy"
        )
    return ALGORITHMS[module]
