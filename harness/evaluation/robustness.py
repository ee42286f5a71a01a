"""What a control agent's return is worth where an adversary shows it another state.

The attack adds delta to the normalized observation that the policy sees; the simulator and the
statistics of the normalizer stay clean. Actions are the policy's mean. The episodes are those of
`control`, whatever the attack and its radius, and at radius 0 they are the same number for number.

Episodes are played side by side, so that one call of the attack serves them all. A batch always has
`SLOTS` rows and an episode always has the same one: its numbers are a function of the checkpoint,
the attack and its own number alone, also in the last bit, which depends on a batch's shape.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from condwrap import attacks
from condwrap.attacks.ball import Norm
from harness.evaluation.checkpoint import Checkpoint, read_checkpoint
from harness.evaluation.control import Episode, episode_seeds, load_learner, make_env
from harness.evaluation.runs import Show, ask, keep
from harness.evaluation.sarsa import learn_action_value
from harness.evaluation.settings import CONTROL, EvaluationError, Settings
from harness.files import read_json

ATTACKS = ("random", "mad", "critic", "sarsa")
RADII = (0.0, 0.05, 0.1)
COLUMNS = [
    "attack", "radius", "norm", "episode", "return", "length", "action_change", "smoothness"
]  # fmt: skip
SLOTS = 20  # episodes side by side
STREAM = 0x61747461  # "atta"; the attack's noise is not that of any other use

Attack = Callable[..., Tensor]  # obs [B, n], radius, norm, generator= -> delta [B, n]


@dataclasses.dataclass(frozen=True)
class Threat:
    """The attacks that an agent is to withstand."""

    attacks: tuple[str, ...]
    """names of attacks"""
    radii: tuple[float, ...] = RADII
    """lengths of the longest perturbations, in deviations of the observations; 0 is no attack"""
    norm: Norm = "linf"
    """what length is: of the largest change of a number, or Euclidean"""

    def __post_init__(self) -> None:
        unknown = [name for name in self.attacks if name not in ATTACKS]
        if unknown:
            raise EvaluationError(
                f"attack must be some of {','.join(ATTACKS)}, got {','.join(self.attacks)!r}"
            )
        if not all(0 <= radius < np.inf for radius in self.radii):
            raise EvaluationError(f"radius must be finite and at least 0, got {self.radii}")
        for name, values in (("attack", self.attacks), ("radius", self.radii)):
            if len(set(values)) < len(values):
                raise EvaluationError(f"{name} names one twice: {values}")
        if self.norm not in get_args(Norm):
            raise EvaluationError(f"norm must be one of {get_args(Norm)}, got {self.norm!r}")


def parse_threat(attack: str, radius: str, norm: Norm) -> Threat | None:
    """From flags such as `--attack random,mad --radius 0,0.05,0.1`; None where none is given."""
    if not attack:
        if radius or norm != "linf":
            raise EvaluationError("--radius and --norm need --attack, such as random,mad,critic")
        return None
    names = tuple(word.strip() for word in attack.split(","))
    if not radius:
        return Threat(names, norm=norm)
    try:
        return Threat(names, tuple(float(word) for word in radius.split(",")), norm)
    except ValueError:
        raise EvaluationError(
            f"radius must be numbers with commas between them, got {radius!r}"
        ) from None


def evaluate_robustness(
    path: Path, settings: Settings, threat: Threat, show: Show = lambda parts, total: parts
) -> pd.DataFrame:
    """Attack a run's final policy, once: a row for each episode, kept as robustness.csv.

    Beside it comes robustness.json, which says what was asked and of which checkpoint.

    Args:
        path: The run's folder.
        settings: How many episodes of each attack and radius.
        threat: The attacks.
        show: Passes parts of the work on, and may show how many of the total are done.

    Raises:
        EvaluationError: There is no agent that can be attacked.
    """
    checkpoint = read_checkpoint(path)
    if checkpoint.baseline == "ppo_reg_coinrun":
        raise EvaluationError(
            f"{path} is a run of {checkpoint.baseline}: attacks are for control tasks"
        )
    about = {
        **ask(checkpoint, settings, CONTROL),
        "attacks": list(threat.attacks),
        "radii": list(threat.radii),
        "norm": threat.norm,
        "checkpoint_sha256": checkpoint.sha256,
    }
    if read_json(path / "robustness.json") == about and (path / "robustness.csv").exists():
        return pd.read_csv(path / "robustness.csv")

    parts = evaluate(checkpoint, threat, settings.episodes)
    played = sum(len(threat.attacks) if radius else 1 for radius in threat.radii)
    total = played * len(_groups(settings.episodes))
    found = pd.concat(show(parts, total), ignore_index=True)
    found = found.sort_values(["attack", "radius", "episode"], key=_in_order(threat))
    keep(path, "robustness", found, about)
    return found.reset_index(drop=True)


def evaluate(checkpoint: Checkpoint, threat: Threat, episodes: int) -> Iterator[pd.DataFrame]:
    """The episodes of each radius and attack, some at a time.

    Without a perturbation all attacks are one: they are played once, and each has their rows.
    """
    learner = load_learner(checkpoint)
    makers = {name: make_attack(name, checkpoint, learner) for name in threat.attacks}
    for radius in threat.radii:
        for name in threat.attacks if radius else threat.attacks[:1]:
            attack = functools.partial(makers[name], radius=radius, norm=threat.norm)
            for numbers in _groups(episodes):
                found = play_together(checkpoint, learner, attack, numbers)
                names = [name] if radius else threat.attacks
                rows = [
                    {"attack": n, "radius": radius, "norm": threat.norm, "episode": k, **measures}
                    for n in names
                    for k, measures in zip(numbers, found, strict=True)
                ]
                yield pd.DataFrame(rows, columns=COLUMNS)


def make_attack(name: str, checkpoint: Checkpoint, learner: Any) -> Attack:
    """The attack on this agent, a map from the observations that it would see."""
    if name == "sarsa":
        q = learn_action_value(checkpoint, learner)
        return functools.partial(attacks.robust_sarsa, learner.actor, action_value=q)
    if name == "critic":
        return functools.partial(attacks.critic, learner.critic)
    return functools.partial(getattr(attacks, name), learner.actor)


def play_together(
    checkpoint: Checkpoint, learner: Any, attack: Attack, numbers: Sequence[int]
) -> list[dict[str, float]]:
    """The episodes of these numbers, at most `SLOTS` of which the first begins a group."""
    args = checkpoint.args
    envs = [make_env(checkpoint.module, args, learner.stats) for _ in numbers]
    try:
        episodes = [
            Episode(env, episode_seeds(args, number)[0])
            for env, number in zip(envs, numbers, strict=True)
        ]
        _play(learner.actor, episodes, attack, _noise(args, numbers[0] // SLOTS))
        return [episode.measures() for episode in episodes]
    except EvaluationError as error:
        raise EvaluationError(f"{checkpoint.path}: {error}") from None
    finally:
        for env in envs:
            env.close()


@torch.no_grad()
def _play(
    actor: nn.Module, episodes: list[Episode], attack: Attack, generator: torch.Generator
) -> None:
    shown = torch.zeros(SLOTS, episodes[0].obs.shape[1])
    while not all(episode.over for episode in episodes):
        for row, episode in enumerate(episodes):
            shown[row] = torch.as_tensor(episode.obs[0], dtype=torch.float32)
        seen = shown + attack(shown, generator=generator)
        for row, episode in enumerate(episodes):
            if not episode.over:
                # one by one: of several rows the actions would differ in the last bit
                episode.step(actor(seen[row : row + 1]).mean)


def _groups(episodes: int) -> list[range]:
    """Numbers of the episodes that are played side by side."""
    return [range(first, min(first + SLOTS, episodes)) for first in range(0, episodes, SLOTS)]


def _noise(args: Any, group: int) -> torch.Generator:
    """The same for all attacks and radii, and for both arms of a pair."""
    sequence = np.random.SeedSequence((args.seed, args.agent), spawn_key=(STREAM, group))
    return torch.Generator().manual_seed(int(sequence.generate_state(1)[0]))


def _in_order(threat: Threat) -> Callable[[pd.Series], pd.Series]:
    """Sorts attacks as they were asked for."""
    places = {name: place for place, name in enumerate(threat.attacks)}

    def key(column: pd.Series) -> pd.Series:
        return column.map(places) if column.name == "attack" else column

    return key
