"""Numbers of a short run of each baseline, pinned: they change only with the baseline's version.

    python -m tests.baselines.pinned --write

does this again for every baseline, and belongs in the commit that raises a VERSION. The runs have
the baselines' own defaults, but for their size and for a penalty that is large enough to be seen.
"""

from __future__ import annotations

import csv
import json
import math
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from baselines import ppo_reg, ppo_reg_coinrun, ppo_reg_population, trpo_reg, trpo_reg_population

PINNED = Path(__file__).with_name("pinned.json")
# Processors add numbers in other orders. Between the instruction sets of one processor the metrics
# of these runs differed by at most a third of this.
RELATIVE, ABSOLUTE = 2e-3, 3e-5

PENDULUM = {"env_id": "Pendulum-v1", "num_steps": 400, "num_minibatches": 8, "coefficient": 1.0,
            "total_timesteps": 1200, "log_spectrum": 1}  # fmt: skip
# Few steps of Adam: it makes a step of full size of what is rounding in a small gradient.
COINRUN = {"num_envs": 2, "num_steps": 32, "num_levels": 8, "num_minibatches": 2,
           "update_epochs": 1, "total_timesteps": 128, "eval_interval": 2, "eval_envs": 2,
           "coefficient": 1.0, "device": "cpu", "num_threads": 1}  # fmt: skip
RUNS: dict[str, tuple[ModuleType, dict[str, Any]]] = {
    "ppo_reg": (ppo_reg, PENDULUM),
    "trpo_reg": (trpo_reg, PENDULUM),
    "ppo_reg_population": (ppo_reg_population, {**PENDULUM, "num_agents": 2}),
    "trpo_reg_population": (trpo_reg_population, {**PENDULUM, "num_agents": 2}),
    "ppo_reg_coinrun": (ppo_reg_coinrun, COINRUN),
}
Columns = dict[str, list[float | None]]


def version_of(name: str) -> int:
    """A population's version is its single file's."""
    module = RUNS[name][0]
    return getattr(getattr(module.Args, "single", module), "VERSION", 1)


def train(name: str, folder: Path, **changes: Any) -> dict[str, Columns]:
    """Metrics of the run of this name, by agent and column; None stands for NaN."""
    module, settings = RUNS[name]
    path = "a{agent}" if "num_agents" in settings else "a0"
    module.train(module.Args(**{**settings, "run_dir": folder / path, **changes}))
    return {path.name: read(path / "metrics.csv") for path in sorted(folder.glob("a*"))}


def read(path: Path) -> Columns:
    """All columns but speeds, to eight digits."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        name: [_number(row[name]) for row in rows]
        for name in rows[0]
        if not name.startswith("charts/SPS")
    }


def _number(text: str) -> float | None:
    value = float(text)
    return None if math.isnan(value) else float(f"{value:.8g}")


def differences(pinned: Columns, found: Columns) -> list[str]:
    """The columns that were pinned and are other now, each with its worst pair."""
    told = []
    for name, expected in pinned.items():
        values = found.get(name)
        if values is None or len(values) != len(expected):
            told.append(f"{name}: {expected} -> {values}")
            continue
        worst = max(zip(expected, values, strict=True), key=lambda pair: excess(*pair))
        if excess(*worst) > 0:
            told.append(f"{name}: {worst[0]} -> {worst[1]}")
    return told


def excess(expected: float | None, value: float | None) -> float:
    """How far a value is beyond what another processor may give; at most 0 if it is not."""
    if expected is None or value is None:
        return 0.0 if expected is value else math.inf
    return abs(value - expected) - ABSOLUTE - RELATIVE * abs(expected)


def write() -> None:
    """Pin what the baselines compute now."""
    content = {}
    for name in RUNS:
        with tempfile.TemporaryDirectory() as folder:
            metrics = train(name, Path(folder))
        content[name] = {"version": version_of(name), "metrics": metrics}
    lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in content.items()]
    PINNED.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit(__doc__)
    write()
