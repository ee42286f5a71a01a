"""Finished runs in compact files that travel: docs/results/<suite>/<algorithm>__<task>.jsonl.xz.

An archive is text, a JSON document a line, compressed by xz. The first line names the format and
has the checksum of all that follows; each other line is a finished run: what it was made with,
exact scores, curves of at most 100 points and every episode of its evaluation. A file is written
once and never again: runs that are finished later go to a file of their own, and files merge.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import math
import zipfile
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from harness.record import Record, block_of, thin
from harness.suite import RunSpec, slug

FORMAT = "condwrap results"
VERSION = 1
ENDING = ".jsonl.xz"
CHECKPOINTS = ".checkpoints.zip"
DIGITS = 5  # significant ones of a point of a curve


class ArchiveError(RuntimeError):
    """An archive that cannot be used, and why."""


class Archives:
    """The archives below a folder, each read and verified when a run of its suite is asked for."""

    def __init__(self, root: Path | None = None) -> None:
        self.root = root
        self._suites: dict[str, dict[str, list[Record]]] = {}

    def find(self, spec: RunSpec) -> Record | None:
        """The archived run, if it has these settings.

        Raises:
            ArchiveError: Two archives hold it with different scores.
        """
        found = [record for record in self._of(spec) if not record.changes(spec)]
        for other in found[1:]:
            refuse_two(found[0], other)
        return found[0] if found else None

    def others(self, spec: RunSpec) -> list[Record]:
        """Archived runs of this name and length that have other settings."""
        length = spec.args["total_timesteps"]
        found = [x for x in self._of(spec) if x.total_timesteps == length]
        return [record for record in found if record.changes(spec)]

    def shorter(self, spec: RunSpec) -> list[Record]:
        """Archived runs that differ from this one in having fewer steps, and in nothing else."""
        found = [x for x in self._of(spec) if x.total_timesteps < spec.args["total_timesteps"]]
        return [record for record in found if set(record.changes(spec)) == {"total_timesteps"}]

    def _of(self, spec: RunSpec) -> list[Record]:
        if self.root is None:
            return []
        if spec.suite not in self._suites:
            runs: dict[str, list[Record]] = defaultdict(list)
            for path in sorted((self.root / spec.suite).glob(f"*{ENDING}")):
                for record in read_archive(path):
                    runs[record.run_id].append(record)
            self._suites[spec.suite] = runs
        return self._suites[spec.suite].get(spec.run_id, [])


def refuse_two(one: Record, other: Record) -> None:
    """Raise ArchiveError if the two tell different things of one run."""
    if not one.same(other):
        raise ArchiveError(
            f"{one.run_id} has other results in {one.place} than in {other.place}: remove one"
        )


# --- writing -------------------------------------------------------------------------------------


def archive_path(root: Path, spec: RunSpec) -> Path:
    """A new file for runs of this suite, algorithm and task."""
    name = f"{slug(spec.algorithm)}__{spec.environment}"
    path, number = root / spec.suite / f"{name}{ENDING}", 1
    while path.exists():
        number += 1
        path = path.with_name(f"{name}__{number}{ENDING}")
    return path


def checkpoints_path(path: Path) -> Path:
    """Where the checkpoints of an archive's runs are, if they were archived too."""
    return path.with_name(path.name.removesuffix(ENDING) + CHECKPOINTS)


def write_archive(path: Path, records: Iterable[Record]) -> None:
    """Write finished runs to a file, whole or not at all.

    The same runs give the same bytes.
    """
    ordered = sorted(records, key=lambda record: (record.run_id, record.total_timesteps))
    lines = [_dump(_to_json(record)) for record in ordered]
    body = "".join(f"{line}\n" for line in lines).encode()
    header = {"format": FORMAT, "version": VERSION, "runs": len(lines)}
    header["sha256"] = hashlib.sha256(body).hexdigest()

    content = lzma.compress(f"{_dump(header)}\n".encode() + body, preset=9 | lzma.PRESET_EXTREME)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_bytes(content)
    temporary.replace(path)


def write_checkpoints(path: Path, files: dict[str, Path]) -> None:
    """Write the runs' checkpoints beside an archive, by run id; its runs hold their checksums."""
    target = checkpoints_path(path)
    temporary = target.with_name(f"{target.name}.tmp")
    with zipfile.ZipFile(temporary, "w") as file:
        for run_id, checkpoint in sorted(files.items()):
            about = zipfile.ZipInfo(f"{run_id}.pt")  # without the time, so that bytes repeat
            file.writestr(about, checkpoint.read_bytes())
    temporary.replace(target)


def names_in(path: Path) -> set[str]:
    """The run ids that a file of checkpoints holds; none if it is damaged."""
    try:
        with zipfile.ZipFile(path) as file:
            return {name.removesuffix(".pt") for name in file.namelist()}
    except zipfile.BadZipFile:
        return set()


def _to_json(record: Record) -> dict[str, Any]:
    curves = record.curves
    if record.updates == 1:
        block = block_of(record.spec)
        curves = thin(curves, block)
    else:
        block = record.updates
    spec = {k: v for k, v in record.spec.items() if k != "command"}  # which names this machine
    return {
        "run_id": record.run_id,
        "spec": spec,
        "done": record.done,
        "scores_version": record.scores_version,
        "scores": {name: _number(value) for name, value in record.scores.items()},
        "updates": block,
        "curves": {name: [_round(x) for x in column] for name, column in curves.items()},
        "evaluation": _table(record.evaluation),
        "asked": record.asked,
    }


def _table(frame: pd.DataFrame | None) -> dict[str, list[Any]] | None:
    if frame is None:
        return None
    return {str(name): [_number(x) for x in column.tolist()] for name, column in frame.items()}


def _number(value: Any) -> Any:
    """None where it is not a number, which JSON does not know; infinity as a string."""
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return None if math.isnan(value) else str(value)


def _round(value: float) -> float | int | str | None:
    if float(value).is_integer():
        return int(value)
    return _number(float(f"{value:.{DIGITS}g}"))


def _dump(content: dict[str, Any]) -> str:
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


# --- reading -------------------------------------------------------------------------------------


def read_archive(path: Path) -> list[Record]:
    """The runs of an archive.

    Raises:
        ArchiveError: It is damaged, or of a format that is not known here.
    """
    text = _decompress(path)
    first, _, body = text.partition(b"\n")
    try:
        header = json.loads(first)
        known = (header["format"], header["version"]) == (FORMAT, VERSION)
    except (ValueError, KeyError, TypeError):
        raise ArchiveError(f"{path} is no archive of results") from None
    if not known:
        raise ArchiveError(f"{path} has another format than {FORMAT} {VERSION}: {header}")
    if hashlib.sha256(body).hexdigest() != header["sha256"]:
        raise ArchiveError(f"{path} is damaged: its content has not the checksum that it names")

    lines = body.splitlines()
    if len(lines) != header["runs"]:
        raise ArchiveError(f"{path} is damaged: it holds {len(lines)} runs of {header['runs']}")
    return [_from_json(json.loads(line), path) for line in lines]


def read_checkpoint(record: Record) -> bytes:
    """An archived run's final checkpoint.

    Raises:
        ArchiveError: It was not archived, or is damaged.
    """
    path = checkpoints_path(record.place)
    try:
        with zipfile.ZipFile(path) as file:
            content = file.read(f"{record.run_id}.pt")
    except (FileNotFoundError, KeyError):
        raise ArchiveError(f"{path} holds no checkpoint of {record.run_id}") from None
    except zipfile.BadZipFile as error:
        raise ArchiveError(f"{path} is damaged: {error}") from None
    if hashlib.sha256(content).hexdigest() != record.files["checkpoint.pt"]:
        raise ArchiveError(f"{path} is damaged: {record.run_id} has another checksum")
    return content


def _decompress(path: Path) -> bytes:
    reader = lzma.LZMADecompressor(format=lzma.FORMAT_XZ)
    try:
        text = reader.decompress(path.read_bytes())
    except lzma.LZMAError as error:
        raise ArchiveError(f"{path} is damaged: {error}") from None
    if not reader.eof or reader.unused_data:
        raise ArchiveError(f"{path} is damaged: it is cut short, or something follows it")
    return text


def _from_json(content: dict[str, Any], path: Path) -> Record:
    evaluation = content["evaluation"]
    return Record(
        place=path,
        run_id=content["run_id"],
        spec=content["spec"],
        done=content["done"],
        scores_version=content["scores_version"],
        scores={name: _float(value) for name, value in content["scores"].items()},
        updates=content["updates"],
        curves=_frame(content["curves"]),
        evaluation=None if evaluation is None else _frame(evaluation),
        asked=content["asked"],
    )


def _frame(columns: dict[str, list[Any]]) -> pd.DataFrame:
    return pd.DataFrame({name: _column(values) for name, values in columns.items()})


def _column(values: list[Any]) -> list[Any]:
    """Numbers, NaN where none was; a column of texts as it is."""
    texts = [x for x in values if isinstance(x, str) and x not in ("inf", "-inf")]
    if texts or all(type(x) is int for x in values):
        return values
    return [_float(x) for x in values]


def _float(value: Any) -> float:
    return math.nan if value is None else float(value)
