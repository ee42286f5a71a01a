"""Policies that lie on disk, and the observations that they meet in their environment."""

from __future__ import annotations

import dataclasses
import importlib
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from condwrap.policy import Policy

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}


class DiskError(ValueError):
    """A policy that cannot be read, and what to do."""


@dataclasses.dataclass(frozen=True)
class Found:
    """A policy from disk."""

    policy: Policy
    """observation as the policy sees it -> output"""
    about: str
    """what it is, in words"""
    normalize: Callable[[Tensor], Tensor] = lambda obs: obs
    """the environment's observation, batched -> the policy's"""
    env_id: str | None = None
    """the environment that it was trained on, where the file tells"""


def read_policy(source: str, trust: bool = False) -> Found:
    """A policy by its source; the kind is told by the file's content.

    - `module:callable`, such as `my_project.agents:policy`: imported, from the working directory
      too. What it names is the policy itself.
    - A checkpoint of condwrap's PPO and TRPO baselines, and of a file copied from them. Its
      normalizer is applied.
    - A TorchScript file.
    - A model of Stable-Baselines3 or sb3-contrib (.zip), and a file of torch.export (.pt2). Both
      can hold pickles, which execute what their author put into them: only with `trust`.

    Raises:
        DiskError: It cannot be read, or would have to be unpickled without `trust`.
    """
    path = Path(source)
    if not path.exists():
        if ":" in source:
            return Found(_import(source), f"the callable {source}")
        raise DiskError(
            f"no file {source}: name a file, or an importable policy such as my_project:policy"
        )
    if path.is_dir():
        path = path / "checkpoint.pt"  # a run's folder
        if not path.exists():
            raise DiskError(f"{source} is a folder without checkpoint.pt: name a file")

    names = _names(path)
    if "data" in names and "policy.pth" in names:
        _refuse_untrusted(path, trust, "a model of Stable-Baselines3")
        return _read_sb3(path)
    if path.suffix == ".pt2":
        _refuse_untrusted(path, trust, "a file of torch.export")
        return Found(torch.export.load(path).module(), f"the exported program {path.name}")
    if any("/code/" in name for name in names):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # files outlive their format
            script = torch.jit.load(path, map_location="cpu")  # type: ignore[no-untyped-call]
        return Found(script, f"the TorchScript module {path.name}")
    return _read_checkpoint(path)


def _names(path: Path) -> list[str]:
    """The members of a ZIP file, which most of these are; none of another file."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.namelist()
    except zipfile.BadZipFile:
        return []


def _refuse_untrusted(path: Path, trust: bool, what: str) -> None:
    if not trust:
        raise DiskError(
            f"{path} is {what}, which can execute code when it is loaded: add --trust if you trust "
            "who made it"
        )


def _import(source: str) -> Policy:
    module, _, name = source.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise DiskError(f"{source} cannot be imported: {error}") from error
    if not callable(found):
        raise DiskError(f"{source} must be callable, got {type(found).__name__}")
    policy: Policy = found
    return policy


def _read_sb3(path: Path) -> Found:
    """A model of Stable-Baselines3 or sb3-contrib: its actor, after SB3's preprocessing."""
    try:
        reader = importlib.import_module("condwrap.integrations.sb3_files")
    except ModuleNotFoundError as error:
        raise DiskError(
            f"{path} needs {error.name}: pip install stable-baselines3 sb3-contrib"
        ) from error
    found: Found = reader.read(path)  # pragma: no cover - in `make integrations`
    return found  # pragma: no cover


def _read_checkpoint(path: Path) -> Found:
    """A checkpoint of ppo_reg or trpo_reg: the actor's mean is a multilayer perceptron."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        args = saved["args"]
        learner = saved["learner"]
        weights = learner["actor"]
        activation = ACTIVATIONS[args["activation"]]
    except Exception as error:  # whatever a torn or foreign file makes the reader stumble over
        raise DiskError(
            f"{path} is no checkpoint of ppo_reg or trpo_reg that can be read ({error!r}): pass "
            "my_module:policy for a policy of your own"
        ) from error

    mean = _make_mlp(weights, "mean.", activation)
    env_id = args["env_id"]
    about = f"an agent of {env_id}, trained for {args['total_timesteps']:,} steps"
    if "Bullet" in env_id and ":" not in env_id:
        env_id = f"pybullet_envs_gymnasium:{env_id}"  # as the baselines read it
    if not args["norm_obs"]:
        return Found(mean, about, env_id=env_id)

    center = learner["obs_rms"]["mean"]
    scale = (learner["obs_rms"]["var"] + 1e-8).sqrt()

    def normalize(obs: Tensor) -> Tensor:
        scaled: Tensor = (obs - center) / scale
        return scaled.clamp(-10.0, 10.0).float()

    return Found(mean, about, normalize, env_id)


def _make_mlp(weights: dict[str, Tensor], prefix: str, activation: type[nn.Module]) -> nn.Module:
    """Linear layers of these weights, an activation between them."""
    layers: list[nn.Module] = []
    names = [name for name in weights if name.startswith(prefix) and name.endswith("weight")]
    for name in names:
        outputs, inputs = weights[name].shape
        linear = nn.Linear(inputs, outputs)
        linear.load_state_dict(
            {"weight": weights[name], "bias": weights[f"{name.removesuffix('weight')}bias"]}
        )
        layers += [linear, activation()]
    return nn.Sequential(*layers[:-1])
