"""A run's last checkpoint, read without executing anything in it, and whose it is."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import io
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from harness.evaluation.settings import EvaluationError

BASELINES = ("ppo_reg", "trpo_reg", "ppo_reg_coinrun")
"""whose checkpoints can be evaluated; a population's are its single file's"""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A trained agent, as its run left it."""

    path: Path
    """the run's folder"""
    baseline: str
    """module in baselines/ that wrote it"""
    args: Any
    """the baseline's own Args: what the agent was trained with"""
    learner: dict[str, Any]
    """what the baseline's Learner takes in load_state_dict"""
    sha256: str
    """of the file"""

    @property
    def module(self) -> ModuleType:
        return importlib.import_module(f"baselines.{self.baseline}")


def read_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint of the run in this folder.

    Raises:
        EvaluationError: There is none, it cannot be read, or no baseline of ours wrote it.
    """
    file = path / "checkpoint.pt"
    try:
        content = file.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise EvaluationError(f"{path} holds no checkpoint.pt: train it first") from None

    try:
        saved = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        settings, learner = saved["args"], saved["learner"]
    except Exception as error:  # whatever a torn or foreign file makes the reader stumble over
        raise EvaluationError(f"{file} cannot be read: {error!r}") from error

    baseline = find_baseline(settings)
    if baseline is None:
        known = ", ".join(BASELINES)
        raise EvaluationError(f"{file} is not of a baseline that can be evaluated: {known}")
    try:
        args = importlib.import_module(f"baselines.{baseline}").Args(**settings)
    except ValueError as error:
        raise EvaluationError(f"{file} has settings that {baseline} refuses: {error}") from error
    return Checkpoint(path, baseline, args, learner, hashlib.sha256(content).hexdigest())


def find_baseline(settings: dict[str, Any]) -> str | None:
    """The one baseline whose Args have fields of all these names; None if none, or several, do."""
    fitting = []
    for name in BASELINES:
        args = importlib.import_module(f"baselines.{name}").Args
        if set(settings) <= {field.name for field in dataclasses.fields(args)}:
            fitting.append(name)
    return fitting[0] if len(fitting) == 1 else None
