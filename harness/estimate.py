"""What a suite will take on this machine, extrapolated from two updates of each kind of run."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

from rich.console import Console

from harness.identity import make_args
from harness.launchers.groups import Group
from harness.launchers.local import LocalLauncher
from harness.progress import Progress
from harness.scheduler import run_groups
from harness.store import Store
from harness.suite import RunSpec

UPDATES = 2  # that are measured


class EstimateError(RuntimeError):
    """A measurement that failed, and its log's end."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """What one algorithm's runs on one task take, training alone."""

    algorithm: str
    environment: str
    runs: int
    steps: int
    speed: float
    """environment steps a second, in one process beside the others"""
    bytes: int

    @property
    def hours(self) -> float:
        """Hours of one process."""
        return self.steps / self.speed / 3600


def measure(groups: list[Group], jobs: int, console: Console) -> list[Cost]:
    """Run the first group of each algorithm and task for two updates, in a temporary folder."""
    kinds: dict[tuple[str, str], list[Group]] = {}
    for group in groups:
        kinds.setdefault((group[0].algorithm, group[0].environment), []).append(group)
    samples = {kind: [_shortened(run) for run in found[0]] for kind, found in kinds.items()}
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        runs = [run for group in samples.values() for run in group]
        with Progress(console, store, runs) as progress:
            outcome = run_groups(list(samples.values()), store, LocalLauncher(jobs), progress)
        for run in outcome.failed:
            raise EstimateError(f"{run.run_id} failed:\n{store.log_tail(run)}")
        return [_cost(kind, found, samples[kind][0], store) for kind, found in kinds.items()]


def _updates(run: RunSpec) -> int:
    return int(make_args(run.baseline, run.args).num_updates)


def _shortened(run: RunSpec) -> RunSpec:
    two = UPDATES * make_args(run.baseline, run.args).batch_size
    short = run.with_args(total_timesteps=min(two, run.args["total_timesteps"]))
    return dataclasses.replace(short, evaluation={})


def _cost(kind: tuple[str, str], groups: list[Group], sample: RunSpec, store: Store) -> Cost:
    metrics, path = store.metrics(sample), store.path(sample)
    if metrics is None:
        raise EstimateError(f"{sample.run_id} wrote no metrics")
    grows = [path / "metrics.csv", *path.glob("events*")]
    row = sum(file.stat().st_size for file in grows) / len(metrics)
    checkpoints = 2 * (path / "checkpoint.pt").stat().st_size  # the last and the one before
    runs = [run for group in groups for run in group]
    return Cost(
        *kind, len(runs), sum(run.args["total_timesteps"] for run in runs),
        float(metrics["charts/SPS"].iloc[-1]),
        round(sum(row * _updates(run) + checkpoints for run in runs)),
    )  # fmt: skip
