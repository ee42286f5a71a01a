"""Everything about results/: where a run's files are, what state it is in, when it is complete.

results/<suite>/<run id>/ holds spec.json (written first), log.txt, metrics.csv, checkpoint.pt and,
written last, done.json with the checksums of what the run made. Whoever runs it holds a lock on
the folder, which the operating system drops when the process ends, however it ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from harness.suite import RunSpec

STATES = ("done", "running", "failed", "interrupted", "pending", "changed")


class StoreError(RuntimeError):
    """Results that cannot be used as they are, and what to do."""


class EvaluationError(RuntimeError):
    """A run that cannot be evaluated, and why."""


class Store:
    """The results folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, spec: RunSpec, name: str = "") -> Path:
        return self.root / spec.suite / spec.run_id / name

    def report_path(self, suite: str) -> Path:
        path = self.root / suite / "report"
        path.mkdir(parents=True, exist_ok=True)
        return path

    def state(self, spec: RunSpec) -> str:
        """One of STATES; "changed" where the folder holds a run of another configuration."""
        if not self.path(spec, "spec.json").exists():
            return "pending"
        if self.changes(spec):
            return "changed"
        if self.is_done(spec):
            return "done"
        with self.lock(spec) as lock:
            if lock is None:
                return "running"
        return "failed" if self.path(spec, "failed.json").exists() else "interrupted"

    def is_done(self, spec: RunSpec) -> bool:
        done = read_json(self.path(spec, "done.json"))
        return done is not None and done["hash"] == spec.hash

    def changes(self, spec: RunSpec) -> str:
        """How the configuration that the folder was run with differs; empty if it does not."""
        saved = read_json(self.path(spec, "spec.json"))
        return "" if saved is None or saved["hash"] == spec.hash else _difference(saved, spec)

    def refuse_changed(self, spec: RunSpec) -> None:
        """Raise StoreError if the folder holds a run of another configuration."""
        if changes := self.changes(spec):
            raise StoreError(
                f"{self.path(spec)} was run with another configuration ({changes}): "
                "name another --results-dir, or remove it"
            )

    @contextlib.contextmanager
    def lock(self, spec: RunSpec) -> Iterator[int | None]:
        """Hold the run; yields the lock's file descriptor, or None if another process holds it.

        A child that inherits the descriptor holds the lock too, so a run whose launcher was killed
        is not started a second time beside it.
        """
        self.path(spec).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.path(spec, "lock"), os.O_RDWR | os.O_CREAT)
        try:
            yield descriptor if _flock(descriptor) else None
        finally:
            os.close(descriptor)

    def start(self, spec: RunSpec, command: list[str], group: list[RunSpec]) -> None:
        """Say what is about to run, before it does; of a group, the first has the log."""
        self.path(spec).mkdir(parents=True, exist_ok=True)
        self.path(spec, "failed.json").unlink(missing_ok=True)
        content = {"hash": spec.hash, "baseline": spec.baseline, "args": spec.args}
        content |= {"evaluation": spec.evaluation, "command": command}
        content["agents"] = [run.args["agent"] for run in group]
        write_json(self.path(spec, "spec.json"), content)
        if spec != group[0]:
            about = f"trained together with {group[0].run_id}, whose log.txt has what was said\n"
            self.path(spec, "log.txt").write_text(about)

    def partners(self, spec: RunSpec) -> list[int]:
        """Numbers of the agents that it was begun with, itself included; [] if it never was."""
        saved = read_json(self.path(spec, "spec.json"))
        return [] if saved is None else saved.get("agents", [spec.args["agent"]])

    def finish(self, spec: RunSpec, returncode: int, seconds: float) -> None:
        """Mark the run complete, or failed."""
        if returncode:
            write_json(self.path(spec, "failed.json"), {"returncode": returncode})
            return
        names = ["metrics.csv", "checkpoint.pt", *(["evaluation.csv"] if spec.evaluation else [])]
        files = {n: hashlib.sha256(self.path(spec, n).read_bytes()).hexdigest() for n in names}
        content = {"hash": spec.hash, "seconds": round(seconds, 1), "sha256": files}
        write_json(self.path(spec, "done.json"), content)

    def metrics(self, spec: RunSpec) -> pd.DataFrame | None:
        """A row for each update so far, or None where there is none yet."""
        try:
            content = self.path(spec, "metrics.csv").read_bytes()
        except FileNotFoundError:
            return None
        whole = content[: content.rfind(b"\n") + 1]  # the run may be writing a line now
        return pd.read_csv(io.BytesIO(whole)) if whole.count(b"\n") > 1 else None

    def steps(self, spec: RunSpec) -> int:
        """Environment steps done, cheaply: from the last whole line of metrics.csv."""
        try:
            with open(self.path(spec, "metrics.csv"), "rb") as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - 4096))
                lines = file.read().split(b"\n")[:-1]
        except FileNotFoundError:
            return 0
        first = lines[-1].split(b",")[0] if lines else b""
        return int(first) if first.isdigit() else 0

    def log_tail(self, spec: RunSpec, lines: int = 15) -> str:
        try:
            text = self.path(spec, "log.txt").read_text(errors="replace")
        except FileNotFoundError:
            return "(no log)"
        return "\n".join(text.splitlines()[-lines:])


def _flock(descriptor: int) -> bool:
    for _ in range(5):  # `state` holds a lock too, but for an instant
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.02)
        else:
            return True
    return False


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a whole file or nothing."""
    temporary = path.with_suffix(".tmp")
    with open(temporary, "w") as file:
        json.dump(content, file, indent=2)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read_json(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        return None
    except json.JSONDecodeError as error:
        raise StoreError(
            f"{path} is torn ({error}): remove {path.parent} to run it anew"
        ) from error


def _difference(saved: dict[str, Any], spec: RunSpec) -> str:
    old, new = saved["args"] | saved.get("evaluation", {}), spec.args | spec.evaluation
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    changes = [f"{name} {old.get(name)} -> {new.get(name)}" for name in names]
    return ", ".join(changes) or f"baseline {saved['baseline']} -> {spec.baseline}"
