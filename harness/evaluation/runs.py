"""A run is evaluated once: what was found is kept beside its checkpoint, with what was asked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from harness.evaluation import control, levels
from harness.evaluation.checkpoint import Checkpoint, read_checkpoint
from harness.evaluation.settings import LEVELS, EvaluationError, Settings, names_for
from harness.files import read_json, write_json

Show = Callable[[Iterable[pd.DataFrame], int], Iterable[pd.DataFrame]]


def evaluate_run(
    path: Path, settings: Settings, show: Show = lambda parts, total: parts
) -> pd.DataFrame:
    """Evaluate a run's checkpoint, once: a row for each episode, kept as evaluation.csv.

    Beside it comes evaluation.json, which tells when it is out of date; CoinRun's agents leave a
    GIF for each kind of level too.

    Args:
        path: The run's folder.
        settings: What is asked.
        show: Passes parts of the work on, and may show how many of the total are done.
    """
    checkpoint = read_checkpoint(path)
    names = names_for(checkpoint.baseline)
    asked = ask(checkpoint, settings, names)
    about = {**asked, "checkpoint_sha256": checkpoint.sha256}
    before = read_json(path / "evaluation.json") or {}
    if before == about and (path / "evaluation.csv").exists():
        return pd.read_csv(path / "evaluation.csv")

    known = {name: before.get(name) for name in asked}
    if (path / "done.json").exists() and before and known != asked:
        raise EvaluationError(
            f"{path} is a suite's run, evaluated with {known}: copy it to evaluate it otherwise"
        )
    if names == LEVELS:
        episodes = levels.evaluate(checkpoint, **asked, device=settings.device, show=show)
    else:
        parts = control.evaluate(checkpoint, settings.episodes)
        episodes = pd.concat(show(parts, 2 * settings.episodes), ignore_index=True)
    keep(path, "evaluation", episodes, about)
    return episodes


def ask(checkpoint: Checkpoint, settings: Settings, names: tuple[str, ...]) -> dict[str, Any]:
    """The settings of these names; of the others, which would be ignored, none may be given."""
    own = {*names, "device"} if names == LEVELS else set(names)
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name not in own and value != field.default:
            flags = " and ".join(f"--{name}" for name in sorted(own))
            raise EvaluationError(
                f"{checkpoint.path} is a run of {checkpoint.baseline}, which is evaluated by "
                f"{flags}: leave out --{field.name} {value}"
            )
    return {name: getattr(settings, name) for name in names}


def keep(path: Path, name: str, episodes: pd.DataFrame, about: dict[str, Any]) -> None:
    """Write name.csv and name.json so that the second never tells of another first."""
    (path / f"{name}.json").unlink(missing_ok=True)
    episodes.to_csv(path / f"{name}.csv.tmp", index=False)
    (path / f"{name}.csv.tmp").replace(path / f"{name}.csv")
    write_json(path / f"{name}.json", about)
