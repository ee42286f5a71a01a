"""Where numbers come from: the code, the versions and the machine that a run was made with."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]  # the checkout
CODE = ("condwrap", "baselines", "harness")  # folders whose content decides a run's numbers
PACKAGES = {"PyTorch": "torch", "NumPy": "numpy", "Gymnasium": "gymnasium", "pybullet": "pybullet",
            "EnvPool": "envpool", "condwrap": "condwrap"}  # fmt: skip


def now() -> str:
    """The time, UTC, as ISO 8601 writes it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def here() -> dict[str, Any]:
    """The code, the versions and the machine, as they are now: a commit may come at any time."""
    own = Path(_git("rev-parse", "--show-toplevel") or "/") == ROOT  # not a repository around it
    commit = _git("rev-parse", "HEAD") if own else None
    changed = _git("status", "--porcelain", "--", *CODE)
    return {
        "commit": commit or "unknown",
        "clean": changed == "" if commit else None,
        "versions": {"Python": platform.python_version(), **_versions()},
        "processor": processor(),
        "cores": cores(),
    }


def cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def processor() -> str:
    """The processor's name, such as "AMD EPYC 7763"."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # only Linux has it
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def device_of(args: dict[str, Any]) -> str:
    """What computes a run with these arguments: "cpu", or the name of a GPU."""
    import torch

    name = args.get("device", "cpu")
    if name == "cpu" or not torch.cuda.is_available():
        return "cpu"
    return torch.cuda.get_device_name(None if name == "auto" else name)


def implementation_of(args: dict[str, Any], agents: int) -> str:
    """Which program trains so many agents together with these arguments."""
    if agents > 1:
        return "population"
    return "compiled" if args.get("compile") else "single file"


# --- what a set of runs comes from ---------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Origins:
    """What the runs behind some numbers were made with; each maps a name to its number of runs."""

    commits: dict[str, int]
    """abbreviated; with a plus where files of the code had changed since"""
    versions: dict[str, dict[str, int]]
    """of Python and of each package"""
    machines: dict[str, int]
    """processor, cores, and GPU if there was one"""
    implementations: dict[str, int]
    """single file, compiled or population"""
    baselines: dict[str, int]
    """a baseline and its version"""
    warnings: list[str]
    """a sentence for each kind of thing that mixes"""


def find_origins(specs: Iterable[dict[str, Any]]) -> Origins:
    """Read where runs come from out of their spec.json; a run that was continued counts in each.

    Args:
        specs: The content of each run's spec.json. Its `sessions` are the times that it was
            started, and what with.
    """
    specs = list(specs)
    runs = [spec.get("sessions", []) for spec in specs]
    packages = {name: None for sessions in runs for x in sessions for name in x["versions"]}
    origins = Origins(
        commits=_count([[commit_of(x) for x in sessions] for sessions in runs]),
        versions={
            name: _count([[x["versions"].get(name, "none") for x in sessions] for sessions in runs])
            for name in packages
        },
        machines=_count([[machine_of(x) for x in sessions] for sessions in runs]),
        implementations=_count([[x["implementation"] for x in sessions] for sessions in runs]),
        baselines=_count([[f"{x['baseline']} {x.get('version', 1)}"] for x in specs]),
        warnings=[],
    )
    return dataclasses.replace(origins, warnings=_warnings(origins, runs))


def _warnings(origins: Origins, runs: list[list[dict[str, Any]]]) -> list[str]:
    """What a reader must know before trusting a comparison of these runs."""
    found = []
    unknown = sum(not sessions for sessions in runs)
    if unknown:
        found.append(f"{unknown} runs do not say what code and machine made them.")
    if dirty := sum(n for commit, n in origins.commits.items() if commit.endswith("+")):
        found.append(f"{dirty} runs were made by code that no commit holds.")

    mixing = {"commits": origins.commits, "machines": origins.machines,
              "implementations": origins.implementations}  # fmt: skip
    mixing |= {f"versions of {name}": counts for name, counts in origins.versions.items()}
    for what, counts in mixing.items():
        if len(counts) > 1:
            parts = ", ".join(f"{name} ({n})" for name, n in counts.items())
            found.append(f"The runs mix {what}: {parts}.")

    commits = [{commit_of(x) for x in sessions} for sessions in runs]
    if continued := sum(len(of) > 1 for of in commits):
        found.append(f"{continued} runs were continued by another commit than began them.")
    return found


def _count(names: list[list[str]]) -> dict[str, int]:
    """In how many runs each name occurs, most frequent first."""
    counts: dict[str, int] = {}
    for of_run in names:
        for name in dict.fromkeys(of_run):
            counts[name] = counts.get(name, 0) + 1
    return dict(sorted(counts.items(), key=lambda item: -item[1]))


def commit_of(session: dict[str, Any]) -> str:
    """Abbreviated; with a plus where files of the code had changed since."""
    return session["commit"][:10] + ("+" if session["clean"] is False else "")


def last_session(spec: dict[str, Any]) -> dict[str, Any]:
    """What a run was last started with; nothing where it does not say."""
    sessions = spec.get("sessions", [])
    return sessions[-1] if sessions else {}


def machine_of(session: dict[str, Any]) -> str:
    """Processor, cores, and GPU if there was one."""
    name = f"{session['processor']}, {session['cores']} cores"
    return name if session["device"] == "cpu" else f"{name}, {session['device']}"


@functools.cache
def _versions() -> dict[str, str]:
    """Of each package that is installed."""
    found = {}
    for name, package in PACKAGES.items():
        try:
            found[name] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _git(*words: str) -> str | None:
    """What git says, or None where there is no git or no repository."""
    try:
        found = subprocess.run(
            ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()
