"""What `python -m harness archive` does: which runs go to which file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from harness.archive import (
    archive_path,
    checkpoints_path,
    names_in,
    write_archive,
    write_checkpoints,
)
from harness.files import checksum
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
    without: tuple[str, ...] = ()
    """ids of runs whose checkpoints were asked for and are not in the results folder"""

    @property
    def text(self) -> str:
        if self.missing:
            return f"{self.about}: {self.missing} of {self.runs} runs are not finished"
        if self.path is None:
            text = f"{self.about}: archived before"
        else:
            text = f"{self.about}: {self.path}, {self.path.stat().st_size / 1024:.0f} KiB"
        if self.without:
            text += f"; no checkpoints, since those of {', '.join(self.without)} are not here"
        return text


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
        if missing:
            yield Packed(about, len(specs), missing, None)
            continue
        path, held = _pack(specs, store, root)
        without = _pack_checkpoints(held, store) if with_checkpoints else []
        yield Packed(about, len(specs), 0, path, tuple(without))


def _pack(
    specs: list[RunSpec], store: Store, root: Path
) -> tuple[Path | None, dict[Path, list[RunSpec]]]:
    """Write the runs, and the shorter ones that they continue, that no archive holds yet.

    Returns:
        The file that was written, if any, and which file holds which of the runs.
    """
    path = archive_path(root, specs[0])
    fresh: list[Record] = []
    held: dict[Path, list[RunSpec]] = {}
    for spec in specs:
        archived = store.archives.find(spec)
        record = store.record(spec)
        if archived is None and record is not None:
            store.verify(spec, tuple(record.files))
            fresh.append(record)
        held.setdefault(archived.place if archived else path, []).append(spec)
        fresh += _shorter(spec, store)

    if fresh:
        write_archive(path, fresh)
    return (path if fresh else None), held


def _pack_checkpoints(held: dict[Path, list[RunSpec]], store: Store) -> list[str]:
    """Write the checkpoints of each archive's runs, all of them or none.

    Returns:
        The ids of runs whose checkpoints are missing.
    """
    without: list[str] = []
    for place, specs in held.items():
        target = checkpoints_path(place)
        wanted = [spec for spec in specs if "checkpoint.pt" in _files(spec, store)]
        if target.exists() and {spec.run_id for spec in wanted} <= names_in(target):
            continue
        missing = [spec.run_id for spec in wanted if not _has_checkpoint(spec, store)]
        if missing:
            without += missing
        else:
            paths = {spec.run_id: store.path(spec, "checkpoint.pt") for spec in wanted}
            write_checkpoints(place, paths)
    return without


def _files(spec: RunSpec, store: Store) -> dict[str, str]:
    """Checksums of what the finished run left; one that diverged early left no checkpoint."""
    record = store.record(spec)
    return record.files if record else {}


def _has_checkpoint(spec: RunSpec, store: Store) -> bool:
    """Whether its folder has its final checkpoint; a run that was extended since has another."""
    path = store.path(spec, "checkpoint.pt")
    return path.exists() and checksum(path) == _files(spec, store)["checkpoint.pt"]


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
