"""Everything about results/: where a run's files are, what state it is in, when it is complete.

results/<suite>/<run id>/ holds spec.json (written first), log.txt, metrics.csv, checkpoint.pt and,
written last, done.json with the checksums of what the run made. Whoever runs it holds a lock on
the folder, which the operating system drops when the process ends, however it ends.

A run that is extended keeps the shorter run as a record of its own: spec-200.json, done-200.json,
evaluation-200.csv and evaluation-200.json for one of 200 steps, whose metrics are the first rows.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from harness import provenance
from harness.archive import Archives, refuse_two
from harness.evaluation.settings import answers
from harness.files import StoreError, checksum, read_json, write_json
from harness.identity import Changes, compare, describe
from harness.record import Record
from harness.scores import exact_scores
from harness.suite import RunSpec

FINISHED = ("done", "diverged")
STATES = (*FINISHED, "running", "failed", "interrupted", "pending", "changed")
DIVERGED = 3  # exit status of a run that ends itself, since its own numbers became non-finite


class Store:
    """The results folder, and the archives of finished runs beside it."""

    def __init__(self, root: Path, archives: Path | None = None) -> None:
        self.root = root
        self.archives = Archives(archives)

    def path(self, spec: RunSpec, name: str = "") -> Path:
        return self.root / spec.suite / spec.run_id / name

    def report_path(self, suite: str = "") -> Path:
        """The folder of a suite's report, or of the page of several suites; made if need be."""
        path = self.root / suite / "report"
        path.mkdir(parents=True, exist_ok=True)
        return path

    # --- what there is ---------------------------------------------------------------------------

    def state(self, spec: RunSpec) -> str:
        """One of STATES; "changed" where the folder holds a run of another configuration."""
        if finished := self._finished(spec):
            return finished
        if not self.path(spec, "spec.json").exists():
            return "pending"
        if self.changes(spec):
            return "changed"
        with self.lock(spec) as lock:
            if lock is None:
                return "running"
        return "failed" if self.path(spec, "failed.json").exists() else "interrupted"

    def is_done(self, spec: RunSpec) -> bool:
        """Whether it has come to its end, here or in an archive; also where it diverged."""
        return self._finished(spec) is not None

    def _finished(self, spec: RunSpec) -> str | None:
        if self.is_trained(spec) and self.is_evaluated(spec):
            return self._done(spec).get("state", "done")
        archived = self.archives.find(spec)
        return archived.state if archived else None

    def is_trained(self, spec: RunSpec) -> bool:
        """Whether the folder's run has come to its end, however it was evaluated."""
        return bool(self._done(spec)) and not self.changes(spec)

    def is_evaluated(self, spec: RunSpec) -> bool:
        """Whether the folder's run was evaluated as it is asked for now.

        One that has been extended since keeps the evaluation that it has: its agent is gone.
        """
        if self._went_on(spec):
            return True
        saved = self.saved(spec) or {}
        return answers(saved.get("evaluation", {}), spec.evaluation)

    def _went_on(self, spec: RunSpec) -> bool:
        """Whether the run of this length has been extended since it was finished."""
        return self.path(spec, _shorter("done.json", spec.args["total_timesteps"])).exists()

    def _done(self, spec: RunSpec) -> dict[str, Any]:
        """The content of done.json; empty where there is none."""
        return read_json(self.kept(spec, "done.json")) or {}

    def kept(self, spec: RunSpec, name: str) -> Path:
        """The file as the run of this length left it, if it has been extended since."""
        kept = self.path(spec, _shorter(name, spec.args["total_timesteps"]))
        return kept if kept.exists() else self.path(spec, name)

    def changes(self, spec: RunSpec) -> Changes:
        """How the configuration that the folder was run with differs; empty if it does not."""
        saved = read_json(self.kept(spec, "spec.json"))
        return {} if saved is None else compare(saved, spec.identity)

    def refuse_changed(self, spec: RunSpec) -> None:
        """Raise StoreError if the folder holds a run of another configuration."""
        if not self.is_done(spec) and (changes := self.changes(spec)):
            raise StoreError(
                f"{self.path(spec)} was run with another configuration ({describe(changes)}): "
                f"{_advice(changes)}"
            )

    def members(self, spec: RunSpec) -> list[int]:
        """Numbers of the agents that it was begun with, itself included; [] if it never was."""
        saved = read_json(self.path(spec, "spec.json"))
        return [] if saved is None else saved.get("agents", [spec.args["agent"]])

    def saved(self, spec: RunSpec) -> dict[str, Any] | None:
        """The newest spec.json of the folder."""
        return read_json(self.path(spec, "spec.json"))

    def was_extended(self, spec: RunSpec) -> bool:
        """Whether the folder's run was begun with fewer steps than this one's."""
        saved = self.saved(spec)
        shorter = saved and saved["args"]["total_timesteps"] < spec.args["total_timesteps"]
        return bool(shorter or self.shorter_lengths(spec))

    def shorter_lengths(self, spec: RunSpec) -> list[int]:
        """The lengths, in steps, that the folder's run was finished with before it was extended."""
        found = self.path(spec).glob("done-*.json")
        return sorted(int(path.stem.removeprefix("done-")) for path in found)

    # --- running ---------------------------------------------------------------------------------

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
        self._keep_shorter(spec)
        if not self.is_evaluated(spec):
            self.path(spec, "done.json").unlink(missing_ok=True)
        self.path(spec, "failed.json").unlink(missing_ok=True)

        agents = [run.args["agent"] for run in group]
        session = {
            "start": provenance.now(),
            "agents": agents,
            "implementation": provenance.implementation_of(spec.args, len(group)),
            "device": provenance.device_of(spec.resolved),
            **provenance.here(),
        }
        before = self.saved(spec) or {}
        content = {
            "baseline": spec.baseline,
            "version": spec.identity["version"],
            "args": spec.resolved,
            "evaluation": spec.evaluation,
            "agents": agents,
            "command": command,
            "sessions": [*before.get("sessions", []), session],
        }
        write_json(self.path(spec, "spec.json"), content)

        if spec != group[0]:
            about = f"trained together with {group[0].run_id}, whose log.txt has what was said\n"
            self.path(spec, "log.txt").write_text(about)

    def _keep_shorter(self, spec: RunSpec) -> None:
        """Keep the run that the folder holds beside the longer one that continues it.

        A kill leaves the shorter run complete, or the longer one begun, never something between.
        """
        saved = self.saved(spec)
        if saved is None or saved["args"]["total_timesteps"] >= spec.args["total_timesteps"]:
            return

        length = saved["args"]["total_timesteps"]
        done = self.path(spec, "done.json")
        if done.exists():
            for name in ("spec.json", "evaluation.csv", "evaluation.json", "done.json"):
                if self.path(spec, name).exists():
                    copy = self.path(spec, f"{name}.tmp")
                    shutil.copyfile(self.path(spec, name), copy)
                    copy.replace(self.path(spec, _shorter(name, length)))
            done.unlink()
        for name in ("evaluation.csv", "evaluation.json"):
            self.path(spec, name).unlink(missing_ok=True)

    def finish(self, spec: RunSpec, returncode: int, seconds: float) -> str:
        """Mark the run complete, or failed; its state: done, diverged or failed."""
        diverged = read_json(self.path(spec, "diverged.json"))
        if returncode == DIVERGED and diverged is not None:
            returncode = 0
        names = ["metrics.csv", "checkpoint.pt", *(["evaluation.csv"] if spec.evaluation else [])]
        missing = [name for name in names if not self.path(spec, name).exists()]
        if returncode or (missing and diverged is None):
            why = {"returncode": returncode} if returncode else {"missing": missing}
            write_json(self.path(spec, "failed.json"), why)
            return "failed"

        there = [name for name in names if name not in missing]
        metrics = self._rows(spec)
        content = {
            "state": "done" if diverged is None else "diverged",
            "end": provenance.now(),
            "seconds": round(seconds, 1),
            "rows": 0 if metrics is None else len(metrics),
            "sha256": {name: checksum(self.path(spec, name)) for name in there},
        }
        if diverged is not None:
            content["diverged"] = diverged
        write_json(self.path(spec, "done.json"), content)
        return content["state"]

    # --- what it has made ------------------------------------------------------------------------

    def metrics(self, spec: RunSpec) -> pd.DataFrame | None:
        """A row for each update so far, or None where there is none yet."""
        metrics = self._rows(spec)
        if metrics is None:
            return None
        kept = read_json(self.path(spec, _shorter("done.json", spec.args["total_timesteps"])))
        return metrics.head(kept["rows"]) if kept else metrics

    def _rows(self, spec: RunSpec) -> pd.DataFrame | None:
        try:
            content = self.path(spec, "metrics.csv").read_bytes()
        except FileNotFoundError:
            return None
        whole = content[: content.rfind(b"\n") + 1]  # the run may be writing a line now
        return pd.read_csv(io.BytesIO(whole)) if whole.count(b"\n") > 1 else None

    def record(self, spec: RunSpec) -> Record | None:
        """The finished run: the folder's, or else an archive's; None where it is not finished.

        Raises:
            ArchiveError: The folder and an archive hold it with different scores.
        """
        archived = self.archives.find(spec)
        own = self.own_record(spec)
        if own and archived:
            refuse_two(own, archived)
        return own or archived

    def own_record(self, spec: RunSpec) -> Record | None:
        """The finished run, if the folder holds it.

        Raises:
            StoreError: A file that it is read from is not the one that the run ended with.
        """
        done = self._done(spec)
        saved = read_json(self.kept(spec, "spec.json"))
        if saved is None or not self.is_trained(spec) or not self.is_evaluated(spec):
            return None
        self.verify(spec, ("metrics.csv", "evaluation.csv"))
        metrics = self.metrics(spec)
        evaluation = self.kept(spec, "evaluation.csv")
        return Record(
            place=self.path(spec),
            run_id=spec.run_id,
            spec=saved,
            done=done,
            scores={} if metrics is None else exact_scores(metrics, spec.args["total_timesteps"]),
            updates=1,
            curves=pd.DataFrame() if metrics is None else metrics,
            evaluation=pd.read_csv(evaluation) if evaluation.exists() else None,
            asked=read_json(self.kept(spec, "evaluation.json")),
        )

    def verify(self, spec: RunSpec, names: Sequence[str]) -> None:
        """Raise StoreError if one of a finished run's files is not the one that it ended with.

        Of a run that has been extended since, only the evaluation is still a file of its own.
        """
        went_on = self._went_on(spec)
        expected = self._done(spec).get("sha256", {})
        for name in expected.keys() & names:
            if went_on and name != "evaluation.csv":
                continue
            path = self.kept(spec, name)
            if not path.exists() or checksum(path) != expected[name]:
                raise StoreError(
                    f"{path} is {'damaged' if path.exists() else 'gone'}: it is not the file that "
                    f"the run ended with. Restore it, or remove {path.parent} to run it again"
                )

    def steps(self, spec: RunSpec) -> int:
        """Environment steps done, cheaply: from the last whole line of metrics.csv."""
        total = spec.args["total_timesteps"]
        try:
            with open(self.path(spec, "metrics.csv"), "rb") as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - 4096))
                lines = file.read().split(b"\n")[:-1]
        except FileNotFoundError:
            archived = self.archives.find(spec)
            return int(archived.scores.get("steps", 0)) if archived else 0
        first = lines[-1].split(b",")[0] if lines else b""
        return min(int(first), total) if first.isdigit() else 0  # it may have been extended since

    def log_tail(self, spec: RunSpec, lines: int = 15) -> str:
        try:
            text = self.path(spec, "log.txt").read_text(errors="replace")
        except FileNotFoundError:
            return "(no log)"
        return "\n".join(text.splitlines()[-lines:])


def _advice(changes: Changes) -> str:
    """What to do where a folder holds a run of another configuration."""
    before, now = changes.get("total_timesteps", (0, 0))
    if set(changes) == {"total_timesteps"} and now > before:
        return f"add --extend to continue it to {now} steps, or name another --results-dir"
    return "name another --results-dir, or move it away"


def _shorter(name: str, total_timesteps: int) -> str:
    """The name of a file that belongs to the shorter run in an extended run's folder."""
    stem, _, ending = name.partition(".")
    return f"{stem}-{total_timesteps}.{ending}"


def _flock(descriptor: int) -> bool:
    for _ in range(5):  # `state` holds a lock too, but for an instant
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.02)
        else:
            return True
    return False
