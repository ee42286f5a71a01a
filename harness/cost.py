"""What the penalty costs, measured in turn: plain and regularized runs alternate on one machine.

Runs of a suite that ran side by side, or on different days, share their machine unequally. Here one
run of each arm follows the other, the arms change who goes first, and each repetition is a pair.
Each says by which commit, on which machine and when it was measured.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from harness.provenance import ROOT, commit_of, here, machine_of, now
from harness.suite import SuiteError

ALGORITHMS = {"PPO": "ppo_reg", "TRPO": "trpo_reg"}
IMPLEMENTATIONS = {
    "single file": ("", []),
    "compiled": ("", ["--compile"]),
    "population": ("_population", ["--num-agents", "10"]),
}
ARMS = {"plain": ["--coefficient", "0.0"], "reg": []}
ORIGIN = ["commit", "machine", "date"]
COLUMNS = ["algorithm", "implementation", "environment", "repetition", "plain", "reg", *ORIGIN]


class CostError(RuntimeError):
    """A run that was to be timed and failed, with its log's end; or a cost.csv that is too old."""


def measure_in_turn(
    environments: dict[str, str],
    implementations: list[str],
    repetitions: int,
    updates: int,
    say: Callable[[str], None] = print,
) -> pd.DataFrame:
    """Seconds of a step of plain and of regularized runs, a row for each repetition.

    Args:
        environments: Ids of environments, by the names that the tables use.
        implementations: Of `IMPLEMENTATIONS`; TRPO is not compiled.
        repetitions: Pairs of runs; from 6 on their interval exists.
        updates: Of each run, at least 3; the first is left out.
        say: Gets a line for each pair.
    """
    if repetitions < 1 or updates < 3:
        needed = "repetitions must be at least 1 and updates at least 3"
        raise SuiteError(f"{needed}, got {repetitions} and {updates}")
    rows = []
    for repetition in range(repetitions):
        for algorithm, implementation, name in _kinds(environments, implementations):
            origin = _origin()
            order = list(ARMS) if repetition % 2 == 0 else list(ARMS)[::-1]
            times = {
                arm: _seconds(algorithm, implementation, environments[name], arm, updates)
                for arm in order
            }
            row = [algorithm, implementation, name, repetition, times["plain"], times["reg"]]
            rows.append([*row, *origin])
            added = times["reg"] / times["plain"] - 1
            say(f"{algorithm}, {implementation}, {name}, {repetition}: {100 * added:+.1f}%")
    return pd.DataFrame(rows, columns=COLUMNS)


def check_timed(timed: pd.DataFrame) -> None:
    """Refuse measurements that don't say what they come from."""
    missing = [name for name in ORIGIN if name not in timed]
    if missing:
        raise CostError(
            f"cost.csv has no {', '.join(missing)}: an earlier version measured it, and nothing "
            "says where. Measure again with python -m harness cost, or delete it"
        )


def _origin() -> list[str]:
    """The commit, the machine and the date, as they are now."""
    found = here()
    return [commit_of(found), machine_of({**found, "device": "cpu"}), now()]


def _kinds(environments: dict[str, str], implementations: list[str]) -> list[tuple[str, str, str]]:
    return [
        (algorithm, implementation, name)
        for algorithm in ALGORITHMS
        for implementation in implementations
        if (algorithm, implementation) != ("TRPO", "compiled")
        for name in environments
    ]


def _seconds(algorithm: str, implementation: str, env_id: str, arm: str, updates: int) -> float:
    """Seconds of a step over a short run's updates, the first one left out."""
    suffix, flags = IMPLEMENTATIONS[implementation]
    baseline = ALGORITHMS[algorithm]
    with tempfile.TemporaryDirectory() as folder:
        run_dir = f"{folder}/{{agent}}" if suffix else f"{folder}/0"
        command = [
            sys.executable, "-m", f"baselines.{baseline}{suffix}", "--env-id", env_id,
            "--total-timesteps", str(2000 * updates), "--run-dir", run_dir, *ARMS[arm], *flags,
        ]  # fmt: skip
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        ended = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
        )
        if ended.returncode:
            raise CostError(f"{' '.join(command)} failed:\n{ended.stderr[-2000:]}")
        metrics = pd.read_csv(Path(folder) / "0" / "metrics.csv")
    # speeds are means since the start, so these are the seconds at the end of each update
    seconds = metrics["global_step"] / metrics["charts/SPS"]
    steps = metrics["global_step"].iloc[-1] - metrics["global_step"].iloc[0]
    return float((seconds.iloc[-1] - seconds.iloc[0]) / steps)
