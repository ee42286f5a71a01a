"""A suite of experiments: a TOML file, turned into runs that are checked before any starts."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import importlib
import json
import re
import tomllib
import types
import typing
from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium as gym

SUITES = Path(__file__).parent / "suites"
REQUIRED = {"title", "seeds", "agents", "args", "algorithms", "environments"}
KEYS = REQUIRED | {"note", "figures", "sweeps"}
ALGORITHM_KEYS = {"name", "baseline", "args", "environments"}
SWEEP_KEYS = ALGORITHM_KEYS | {"parameter", "values"}


class SuiteError(ValueError):
    """A suite that cannot be run, and why."""


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """One run of one baseline; what `args` does not name has the baseline's default."""

    suite: str
    algorithm: str
    """the name in the tables, such as "PPO reg" """
    environment: str
    """the name in the tables, such as "Hopper" """
    baseline: str
    """module in baselines/"""
    args: dict[str, Any]
    """of the baseline: env_id, seed, agent, total_timesteps, and what the suite sets"""

    @property
    def run_id(self) -> str:
        algorithm = re.sub(r"\W+", "-", self.algorithm.lower())
        return f"{algorithm}__{self.environment}__s{self.args['seed']}__a{self.args['agent']}"

    @property
    def hash(self) -> str:
        """Tells a changed configuration from a finished one."""
        content = json.dumps([self.baseline, self.args], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def flags(self) -> list[str]:
        """The baseline's command-line arguments."""
        flags: list[str] = []
        for name, value in self.args.items():
            flag = name.replace("_", "-")
            if isinstance(value, bool):
                flags.append(f"--{flag}" if value else f"--no-{flag}")
            else:
                values = value if isinstance(value, list) else [value]
                flags += [f"--{flag}", *map(str, values)]
        return flags


@dataclasses.dataclass(frozen=True)
class Suite:
    """A named set of runs and the reports that they feed."""

    name: str
    title: str
    note: str
    algorithms: list[str]
    environments: list[str]
    runs: list[RunSpec]
    figures: dict[str, list[str]]
    """figures of learning curves: a title, and the algorithms in it"""
    sweeps: dict[str, dict[str, Any]]
    """for each ablation, the algorithm that each value of its parameter makes"""

    @property
    def planned(self) -> Counter[tuple[str, str]]:
        """Runs of each (environment, algorithm)."""
        return Counter((run.environment, run.algorithm) for run in self.runs)

    @property
    def timesteps(self) -> int:
        return sum(run.args["total_timesteps"] for run in self.runs)


def suite_names() -> list[str]:
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def load_suite(
    name: str,
    *,
    total_timesteps: int | None = None,
    seeds: int | None = None,
    agents: int | None = None,
    env: tuple[str, ...] = (),
) -> Suite:
    """Read a suite and check every run against its baseline's `Args`.

    Args:
        name: The name of a file in harness/suites, or the path of a TOML file.
        total_timesteps: Environment steps of each run, instead of the suite's.
        seeds: Take only the first so many seeds.
        agents: Train only so many agents for each seed.
        env: Take only these environments, by the names that the tables use.

    Raises:
        SuiteError: An unknown suite, environment, baseline or argument, or a bad value.
    """
    for flag, value in (("total_timesteps", total_timesteps), ("seeds", seeds), ("agents", agents)):
        if value is not None and value < 1:
            raise SuiteError(f"{flag} must be at least 1, got {value}")
    path, data = _read(name)
    _known(dict.fromkeys(env), set(data["environments"]), "environment")
    if seeds is not None and seeds > len(data["seeds"]):
        raise SuiteError(f"{path.name} has {len(data['seeds'])} seeds, fewer than {seeds}")
    scaled = {
        **data,
        "seeds": data["seeds"][:seeds],
        "agents": agents or data["agents"],
        "args": {
            **data["args"],
            "total_timesteps": total_timesteps or data["args"]["total_timesteps"],
        },
        "environments": {k: v for k, v in data["environments"].items() if k in env or not env},
    }
    sweeps = _sweeps(data, path)
    algorithms = [*data["algorithms"], *(a for made in sweeps.values() for a in made.values())]
    for algorithm in algorithms:
        _check_keys(algorithm, {"name", "baseline"}, ALGORITHM_KEYS, f"{path.name}: algorithm")
        _known(dict.fromkeys(algorithm.get("environments", ())), set(data["environments"]),
               f"{path.name}: {algorithm['name']}: environment")  # fmt: skip
    runs = [run for algorithm in algorithms for run in _runs(algorithm, scaled, path)]
    if not runs:
        raise SuiteError(f"{path.name} has no runs: it needs algorithms, environments and seeds")
    if len({run.run_id for run in runs}) < len(runs):
        raise SuiteError(f"{path.name}: names of algorithms and seeds must differ from each other")
    for title, named in data.get("figures", {}).items():
        if not _fits(named, tuple[str, ...]):
            raise SuiteError(f"{path.name}: figure {title!r} must list algorithms, got {named!r}")
        _known(dict.fromkeys(named), {a["name"] for a in algorithms}, f"{path.name}: algorithm")
    return Suite(
        name=path.stem,
        title=data["title"],
        note=data.get("note", ""),
        algorithms=[algorithm["name"] for algorithm in algorithms],
        environments=list(scaled["environments"]),
        runs=runs,
        figures=data.get("figures", {}),
        sweeps={k: {v: a["name"] for v, a in made.items()} for k, made in sweeps.items()},
    )


def _read(name: str) -> tuple[Path, dict[str, Any]]:
    """A suite's file, its keys and their types checked."""
    path = Path(name) if name.endswith(".toml") else SUITES / f"{name}.toml"
    if not path.exists():
        known = f"there are {', '.join(suite_names())}"
        raise SuiteError(f"no file {name}" if path == Path(name) else f"no suite {name!r}: {known}")
    try:
        data = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise SuiteError(f"{path} is not valid TOML: {error}") from error
    _check_keys(data, REQUIRED, KEYS, path.name)
    for key, hint in (("seeds", tuple[int, ...]), ("agents", int), ("args", dict)):
        if not _fits(data[key], hint):
            raise SuiteError(f"{path.name}: {key} must be of type {hint}, got {data[key]!r}")
    if "total_timesteps" not in data["args"]:
        raise SuiteError(f"{path.name}: args needs total_timesteps")
    return path, data


def _runs(algorithm: dict[str, Any], data: dict[str, Any], path: Path) -> list[RunSpec]:
    """One algorithm's runs on its environments, seeds and agents, their arguments checked."""
    runs = []
    for environment, env_id in data["environments"].items():
        if environment not in algorithm.get("environments", data["environments"]):
            continue
        args = {"env_id": env_id, **data["args"], **algorithm.get("args", {})}
        where = f"{path.name}: {algorithm['name']} on {environment}"
        for seed in data["seeds"]:
            check_args(algorithm["baseline"], {**args, "seed": seed, "agent": 0}, where)
        runs += [
            RunSpec(
                suite=path.stem,
                algorithm=algorithm["name"],
                environment=environment,
                baseline=algorithm["baseline"],
                args={**args, "seed": seed, "agent": agent},
            )
            for seed in data["seeds"]
            for agent in range(data["agents"])
        ]
    return runs


def _sweeps(data: dict[str, Any], path: Path) -> dict[str, dict[Any, dict[str, Any]]]:
    """For each sweep, the algorithm that each of its values makes."""
    made = {}
    for sweep in data.get("sweeps", []):
        needed = {"name", "baseline", "parameter", "values"}
        _check_keys(sweep, needed, SWEEP_KEYS, f"{path.name}: sweep")
        where, values = f"{path.name}: sweep {sweep['name']}", sweep["values"]
        if not isinstance(values, list) or any(isinstance(value, list | dict) for value in values):
            raise SuiteError(f"{where}: values must be a list of plain values, got {values!r}")
        if sweep["name"] in made or len(set(values)) < len(values):
            raise SuiteError(f"{where}: names of sweeps and their values must differ")
        common = {k: v for k, v in sweep.items() if k in ALGORITHM_KEYS}
        made[sweep["name"]] = {
            value: {
                **common,
                "name": f"{sweep['name']}={value}",
                "args": {**sweep.get("args", {}), sweep["parameter"]: value},
            }
            for value in values
        }
    return made


def _check_keys(given: dict[str, Any], needed: set[str], known: set[str], where: str) -> None:
    _known(given, known, f"{where}: key")
    for key in sorted(needed - set(given)):
        raise SuiteError(f"{where} needs the key {key!r}")


def check_args(baseline: str, args: dict[str, Any], where: str) -> None:
    """Raise SuiteError unless the baseline takes these arguments and the environment exists."""
    try:
        cls = importlib.import_module(f"baselines.{baseline}").Args
    except ModuleNotFoundError as error:
        raise SuiteError(f"{where}: baseline {baseline!r} cannot be imported: {error}") from error
    hints = typing.get_type_hints(cls)
    _known(args, set(hints), f"{where}: argument")
    for name, value in args.items():
        if not _fits(value, hints[name]):
            raise SuiteError(f"{where}: {name} must be {hints[name]}, got {value!r}")
    try:
        cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in args.items()})
        importlib.import_module("pybullet_envs_gymnasium")  # registers its tasks
        gym.spec(args["env_id"])
    except (ValueError, gym.error.Error, ModuleNotFoundError) as error:
        raise SuiteError(f"{where}: {error}") from error


def _known(given: dict[str, Any], known: set[str], what: str) -> None:
    for name in given:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1) or sorted(known)
            raise SuiteError(f"{what} {name!r} is unknown: {' or '.join(close)}?")


def _fits(value: Any, hint: Any) -> bool:
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        return any(_fits(value, option) for option in typing.get_args(hint))
    if origin is typing.Literal:
        return value in typing.get_args(hint)
    if origin is tuple:  # TOML knows lists only
        return isinstance(value, list) and all(_fits(x, typing.get_args(hint)[0]) for x in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is hint
