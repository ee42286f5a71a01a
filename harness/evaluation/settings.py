"""What an evaluation asks for, and which baselines take what of it."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

CONTROL = ("episodes",)
LEVELS = ("levels", "repeats", "unseen")
Unseen = Literal["next", "unbounded", "themes"]
"""what CoinRun levels are that an agent never saw: harness.evaluation.levels says more"""


class EvaluationError(RuntimeError):
    """A run that cannot be evaluated, and why."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """What an evaluation asks for; a run takes what is for its kind."""

    episodes: int = 20
    """control: episodes with the policy's mean, and as many with sampled actions"""
    levels: int = 500
    """CoinRun: levels of each kind"""
    repeats: int = 20
    """CoinRun: episodes with sampled actions on each level"""
    unseen: Unseen = "next"
    """CoinRun: what the levels are that the agent never saw"""
    device: str = "auto"
    """CoinRun: where the network is; a control agent's is on the CPU"""

    def __post_init__(self) -> None:
        for name in ("episodes", "levels", "repeats"):
            if getattr(self, name) < 1:
                raise EvaluationError(f"{name} must be at least 1, got {getattr(self, name)}")


def names_for(baseline: str) -> tuple[str, ...]:
    """The settings that decide the evaluation of this baseline's agents."""
    return LEVELS if baseline == "ppo_reg_coinrun" else CONTROL


def resolve(baseline: str, given: dict[str, Any]) -> dict[str, Any]:
    """All that a suite's evaluation asks for, defaults included; empty where there is none."""
    if not given:
        return {}
    settings = Settings(**given)
    return {name: getattr(settings, name) for name in names_for(baseline)}


def answers(found: dict[str, Any], asked: dict[str, Any]) -> bool:
    """Whether an evaluation by the settings `found` is the one that is asked for.

    What an older one does not name had its default.
    """
    if not found:
        return not asked
    defaults = dataclasses.asdict(Settings())
    return all(found.get(name, defaults[name]) == value for name, value in asked.items())
