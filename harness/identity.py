"""Which settings make two runs the same run.

A run is its baseline, the baseline's version and every argument that decides its numbers. Two runs
are compared argument by argument: one that was made before a flag existed is taken with the flag's
present default, so a new flag that changes nothing leaves old runs valid. How the trained agent is
evaluated is no part of it: an evaluation can be made anew without training.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import typing
from types import ModuleType
from typing import Any

Changes = dict[str, tuple[Any, Any]]
"""what differs, by name: the saved value and the present one"""


def module_of(baseline: str) -> ModuleType:
    return importlib.import_module(f"baselines.{baseline}")


def version_of(baseline: str) -> int:
    """The baseline's version, which is raised when its numbers change."""
    return getattr(module_of(baseline), "VERSION", 1)


def make_args(baseline: str, args: dict[str, Any]) -> Any:
    """The baseline's own Args, from values as TOML and JSON have them."""
    values = {name: tuple(x) if isinstance(x, list) else x for name, x in args.items()}
    return module_of(baseline).Args(**values)


def resolve(baseline: str, args: dict[str, Any]) -> dict[str, Any]:
    """Every argument that the run has, the baseline's defaults included, as JSON has them."""
    floats, defaults = _fields(baseline)
    found = {**defaults, **args}
    return {name: _plain(value, name in floats) for name, value in found.items()}


def identify(baseline: str, args: dict[str, Any]) -> dict[str, Any]:
    """All that makes the run this run, as one flat dictionary."""
    free = getattr(module_of(baseline), "MAY_CHANGE", frozenset())
    deciding = {k: v for k, v in resolve(baseline, args).items() if k not in free}
    return {"baseline": baseline, "version": version_of(baseline), **deciding}


def compare(saved: dict[str, Any], now: dict[str, Any]) -> Changes:
    """How the run that `saved`, the content of a spec.json, tells of differs from the run `now`.

    Args:
        saved: Its baseline, version and args.
        now: A run as `identify` gives it.
    """
    if saved["baseline"] != now["baseline"]:
        return {"baseline": (saved["baseline"], now["baseline"])}

    baseline = saved["baseline"]
    then = identify(baseline, saved["args"])
    then["version"] = saved.get("version", 1)

    pairs = {name: (then.get(name), now.get(name)) for name in {**then, **now}}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def describe(changes: Changes) -> str:
    return ", ".join(f"{name} {old} -> {new}" for name, (old, new) in changes.items())


@functools.cache
def _fields(baseline: str) -> tuple[frozenset[str], dict[str, Any]]:
    """The names of the arguments that take a float, and each argument's default."""
    cls = module_of(baseline).Args
    hints = typing.get_type_hints(cls)
    floats = {k for k, hint in hints.items() if hint is float or float in typing.get_args(hint)}

    defaults: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if field.default is not dataclasses.MISSING:
            defaults[field.name] = field.default
        elif field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
    return frozenset(floats), defaults


def _plain(value: Any, is_float: bool) -> Any:
    """A value as it is when it has been written to JSON and read again."""
    if isinstance(value, list | tuple):
        return [_plain(x, is_float) for x in value]
    if is_float and type(value) is int:
        return float(value)  # 1 and 1.0 are one setting
    return value if isinstance(value, bool | int | float | str | None) else str(value)
