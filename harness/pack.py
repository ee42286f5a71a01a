"""What `python -m harness archive` does: which runs go to which file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from harness.archive import archive_path, checkpoints_path, write_archive, write_checkpoints
from harness.files import StoreError, checksum
from harness.record import Record
from harness.store import Store
from harness.suite import RunSpec, Suite


@dataclasses.dataclass(frozen=True)
class Packed:
    """What became of one algorithm's runs on one task."""

    about: str
    """algorithm and task"""
    runs: int
    missing: int
    """runs that are not finished yet: then nothing is written"""
    path: Path | None
    """the file that was written, if one was"""

    @property
    def text(self) -> str:
        if self.missing:
            return f"{self.about}: {self.missing} of {self.runs} runs are not finished"
        if self.path is None:
            return f"{self.about}: archived before"
        return f"{self.about}: {self.path}, {self.path.stat().st_size / 1024:.0f} KiB"


def pack(plan: Suite, store: Store, root: Path, with_checkpoints: bool) -> Iterator[Packed]:
    """Archive what is finished and not archived yet, a file for each algorithm and task.

    Raises:
        StoreError: A finished run's files are not those that it ended with.
        ArchiveError: An archive holds another outcome of a run than its folder.
    """
    kinds: dict[tuple[str, str, str], list[RunSpec]] = {}
    for spec in plan.runs:
        kinds.setdefault((spec.suite, spec.algorithm, spec.environment), []).append(spec)
    for (_, algorithm, environment), specs in kinds.items():
        about = f"{algorithm} on {environment}"
        missing = sum(not store.is_done(spec) for spec in specs)
        path = None if missing else _pack(specs, store, root, with_checkpoints)
        yield Packed(about, len(specs), missing, path)


def _pack(specs: list[RunSpec], store: Store, root: Path, with_checkpoints: bool) -> Path | None:
    """Write the runs, and the shorter ones that they continue, that no archive holds yet."""
    path = archive_path(root, specs[0])
    fresh: list[Record] = []
    held: dict[Path, list[RunSpec]] = {}  # which file holds which of the runs
    for spec in specs:
        archived = store.archives.find(spec)
        record = store.record(spec)
        if archived is None and record is not None:
            _verify(spec, record, store)
            fresh.append(record)
        held.setdefault(archived.place if archived else path, []).append(spec)
        fresh += _shorter(spec, store)

    if fresh:
        write_archive(path, fresh)
    if with_checkpoints:
        for place, found in held.items():
            if not checkpoints_path(place).exists():
                write_checkpoints(place, _checkpoints(found, store))
    return path if fresh else None


def _checkpoints(specs: list[RunSpec], store: Store) -> dict[str, Path]:
    """The final checkpoint of each run, by run id; a run that was extended since has another."""
    found = {}
    for spec in specs:
        record, path = store.record(spec), store.path(spec, "checkpoint.pt")
        if record and path.exists() and checksum(path) == record.files.get("checkpoint.pt"):
            found[spec.run_id] = path
    return found


def _shorter(spec: RunSpec, store: Store) -> list[Record]:
    """What the run left at each shorter length that it was continued from."""
    found = []
    lengths = [n for n in store.shorter_lengths(spec) if n < spec.args["total_timesteps"]]
    for length in lengths:
        before = spec.with_args(total_timesteps=length)
        record = store.own_record(before)
        if record is not None and store.archives.find(before) is None:
            found.append(record)
    return found


def _verify(spec: RunSpec, record: Record, store: Store) -> None:
    """Raise StoreError if a file is not the one that the run ended with."""
    if record.total_timesteps in store.shorter_lengths(spec):
        return  # it has been continued since: its metrics are the first rows of a longer file
    for name, expected in record.files.items():
        path = store.path(spec, name)
        if not path.exists() or checksum(path) != expected:
            raise StoreError(
                f"{path} is not the file that the run ended with: remove {path.parent} to run it "
                "again"
            )
