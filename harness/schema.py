"""What a suite's file may hold: keys, types, and arguments that its baselines take."""

from __future__ import annotations

import difflib
import importlib
import tomllib
import types
import typing
from pathlib import Path
from typing import Any

import gymnasium as gym

from harness.evaluation.settings import CONTROL, LEVELS, Unseen
from harness.identity import make_args

SUITES = Path(__file__).parent / "suites"
RUNS = {"seeds", "agents", "args", "algorithms", "environments"}
KEYS = RUNS | {"title", "note", "figures", "sweeps", "evaluation", "include"}


class SuiteError(ValueError):
    """A suite that cannot be run, and why."""


def suite_names() -> list[str]:
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def read(name: str) -> tuple[Path, dict[str, Any]]:
    """A suite's file, its keys and their types checked."""
    path = Path(name) if name.endswith(".toml") else SUITES / f"{name}.toml"
    if not path.exists():
        known = f"there are {', '.join(suite_names())}"
        raise SuiteError(f"no file {name}" if path == Path(name) else f"no suite {name!r}: {known}")
    try:
        data = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise SuiteError(f"{path} is not valid TOML: {error}") from error
    if "include" in data and not RUNS & data.keys():
        check_keys(data, {"title"}, {"title", "note", "include"}, path.name)
    else:
        check_keys(data, {"title", *RUNS}, KEYS, path.name)
    types_of = {"seeds": tuple[int, ...], "agents": int, "args": dict, "include": tuple[str, ...]}
    types_of["evaluation"] = dict
    for key, hint in types_of.items():
        if key in data and not fits(data[key], hint):
            raise SuiteError(f"{path.name}: {key} must be of type {hint}, got {data[key]!r}")
    if "args" not in data:
        return path, data
    if not data["seeds"]:
        raise SuiteError(f"{path.name}: seeds must not be empty")
    if "evaluation" in data:
        check_evaluation(data["evaluation"], f"{path.name}: evaluation")
    if "total_timesteps" not in data["args"]:
        raise SuiteError(f"{path.name}: args needs total_timesteps")
    return path, data


def check_keys(given: dict[str, Any], needed: set[str], known: set[str], where: str) -> None:
    check_known(given, known, f"{where}: key")
    for key in sorted(needed - set(given)):
        raise SuiteError(f"{where} needs the key {key!r}")


def check_evaluation(given: dict[str, Any], where: str) -> None:
    """Raise SuiteError unless it is that of control agents, or that of CoinRun's."""
    check_known(given, {*CONTROL, *LEVELS}, f"{where}: key")
    if "episodes" in given:
        check_keys(given, set(CONTROL), set(CONTROL), where)
    else:
        check_keys(given, set(LEVELS) - {"unseen"}, set(LEVELS), where)

    if not fits(given.get("unseen", "next"), Unseen):
        known = " or ".join(typing.get_args(Unseen))
        raise SuiteError(f"{where}: unseen must be {known}, got {given['unseen']!r}")

    numbers = [value for name, value in given.items() if name != "unseen"]
    if any(type(x) is not int or x < 1 for x in numbers):
        raise SuiteError(f"{where} must hold numbers of at least 1")


def check_args(baseline: str, args: dict[str, Any], evaluation: dict[str, Any], where: str) -> None:
    """Raise SuiteError unless the baseline takes these arguments and can be so evaluated."""
    try:
        module = importlib.import_module(f"baselines.{baseline}")
        cls = module.Args
    except ModuleNotFoundError as error:
        raise SuiteError(f"{where}: baseline {baseline!r} cannot be imported: {error}") from error
    has_games = hasattr(module, "GAMES")  # its own check of env_id
    hints = typing.get_type_hints(cls)
    check_known(args, set(hints), f"{where}: argument")
    for name, value in args.items():
        if not fits(value, hints[name]):
            raise SuiteError(f"{where}: {name} must be {hints[name]}, got {value!r}")
    try:
        made = make_args(baseline, args)
        if not has_games:
            registers, _, name = args["env_id"].rpartition(":")
            importlib.import_module(registers or "pybullet_envs_gymnasium")
            gym.spec(name)
    except (ValueError, gym.error.Error, ModuleNotFoundError) as error:
        raise SuiteError(f"{where}: {error}") from error
    if evaluation and has_games == ("episodes" in evaluation):
        needs = "levels and repeats" if has_games else "episodes"
        raise SuiteError(f"{where}: evaluation needs {needs}, got {', '.join(evaluation)}")
    if evaluation and has_games:
        _check_levels(made, evaluation, where)


def _check_levels(made: Any, evaluation: dict[str, Any], where: str) -> None:
    if evaluation["levels"] > made.num_levels:
        wants = f"{evaluation['levels']} levels to be evaluated on"
        has = made.num_levels or "no countable ones"
        raise SuiteError(f"{where}: {wants}, but it is trained on {has}")
    if evaluation.get("unseen") == "themes" and not made.restrict_themes:
        raise SuiteError(f"{where}: unseen = 'themes' needs restrict_themes = true in args")


def check_known(given: dict[str, Any], known: set[str], what: str) -> None:
    for name in given:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1) or sorted(known)
            raise SuiteError(f"{what} {name!r} is unknown: {' or '.join(close)}?")


def fits(value: Any, hint: Any) -> bool:
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        return any(fits(value, option) for option in typing.get_args(hint))
    if origin is typing.Literal:
        return value in typing.get_args(hint)
    if origin is tuple:  # TOML knows lists only
        return isinstance(value, list) and all(fits(x, typing.get_args(hint)[0]) for x in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is hint
