"""A suite of experiments: a TOML file, turned into runs that are checked before any starts."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.evaluation.settings import resolve as resolve_evaluation
from harness.identity import identify, resolve
from harness.schema import SuiteError, check_args, check_keys, check_known, fits, read

ALGORITHM_KEYS = {"name", "baseline", "args", "environments"}
SWEEP_KEYS = ALGORITHM_KEYS | {"parameter", "values"}


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
    evaluation: dict[str, Any] = dataclasses.field(default_factory=dict)
    """how the trained agent is evaluated, defaults included: episodes of a control agent, levels,
    repeats and unseen of one on CoinRun; empty if it is not"""

    @property
    def run_id(self) -> str:
        seed, agent = self.args["seed"], self.args["agent"]
        return f"{slug(self.algorithm)}__{self.environment}__s{seed}__a{agent}"

    @property
    def resolved(self) -> dict[str, Any]:
        """All arguments, the baseline's defaults included."""
        return resolve(self.baseline, self.args)

    @functools.cached_property
    def identity(self) -> dict[str, Any]:
        """All that decides the run's numbers: see harness.identity."""
        return identify(self.baseline, self.args)

    @property
    def hash(self) -> str:
        """Of the identity, so that runs of the same settings are found among many."""
        content = json.dumps(self.identity, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    def with_args(self, **changes: Any) -> RunSpec:
        """The same run with other arguments."""
        return dataclasses.replace(self, args={**self.args, **changes})

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


def slug(name: str) -> str:
    """An algorithm's name as part of a file's name."""
    return re.sub(r"\W+", "-", name.lower())


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
        seeds: Take so many seeds: the suite's first, then those that follow its last.
        agents: Train only so many agents for each seed.
        env: Take only these environments, by the names that the tables use.

    Raises:
        SuiteError: An unknown suite, environment, baseline or argument, or a bad value.
    """
    for flag, value in (("total_timesteps", total_timesteps), ("seeds", seeds), ("agents", agents)):
        if value is not None and value < 1:
            raise SuiteError(f"{flag} must be at least 1, got {value}")
    path, data = read(name)
    included = [read(other) for other in data.get("include", [])]
    for other, its in included:
        if "include" in its:
            raise SuiteError(f"{path.name} includes {other.stem}, which includes others: name them")

    files = [(p, d) for p, d in [(path, data), *included] if "algorithms" in d]
    known = {environment for _, d in files for environment in d["environments"]}
    check_known(dict.fromkeys(env), known, "environment")

    parts = [_own_runs(p, _scaled(d, total_timesteps, seeds, agents, env)) for p, d in files]
    found: dict[tuple[str, ...], RunSpec] = {}
    for part in parts:
        for run in part.runs:  # what several suites have is run once, by the first of them
            found.setdefault((run.algorithm, run.environment, run.hash), run)

    runs = list(found.values())
    if not runs:
        raise SuiteError(f"{path.name} has no runs: it needs algorithms, environments and seeds")
    if len({run.run_id for run in runs}) < len(runs):
        raise SuiteError(f"{path.name}: names of algorithms and seeds must differ from each other")
    return Suite(
        name=path.stem,
        title=data["title"],
        note=data.get("note", ""),
        algorithms=list(dict.fromkeys(a for part in parts for a in part.algorithms)),
        environments=list(dict.fromkeys(e for part in parts for e in part.environments)),
        runs=runs,
        figures={k: v for part in parts for k, v in part.figures.items()},
        sweeps={k: v for part in parts for k, v in part.sweeps.items()},
    )


def load_suites(
    names: Sequence[str],
    *,
    total_timesteps: int | None = None,
    seeds: int | None = None,
    agents: int | None = None,
    env: tuple[str, ...] = (),
) -> dict[str, Suite]:
    """Several suites by the names that were given, each scaled as by `load_suite`.

    Each takes those of the environments that it has; a suite that has none of them is left out.
    """
    if len(set(names)) < len(names) or not names:
        raise SuiteError(f"name each suite once, at least one, got {' '.join(names) or 'none'}")
    known = {name: load_suite(name).environments for name in names}
    check_known(dict.fromkeys(env), {e for its in known.values() for e in its}, "environment")

    found = {}
    for name in names:
        own = tuple(environment for environment in env if environment in known[name])
        if own or not env:
            found[name] = load_suite(
                name, total_timesteps=total_timesteps, seeds=seeds, agents=agents, env=own
            )
    if len({suite.name for suite in found.values()}) < len(found):
        raise SuiteError(f"suites must differ in name, got {' '.join(names)}")
    return found


def _scaled(
    data: dict[str, Any],
    total_timesteps: int | None,
    seeds: int | None,
    agents: int | None,
    env: tuple[str, ...],
) -> dict[str, Any]:
    """The suite's data with what the command line asks for instead."""
    own_seeds = data["seeds"]
    if seeds is not None:
        first = max(own_seeds) + 1  # of those that follow the suite's own
        own_seeds = [*own_seeds, *range(first, first + seeds)][:seeds]

    args = data["args"]
    if total_timesteps is not None:
        args = {**args, "total_timesteps": total_timesteps}

    environments = data["environments"]
    if env:
        environments = {name: x for name, x in environments.items() if name in env}

    return {
        **data,
        "seeds": own_seeds,
        "agents": data["agents"] if agents is None else agents,
        "args": args,
        "environments": environments,
        "all_environments": set(data["environments"]),
    }


def _own_runs(path: Path, data: dict[str, Any]) -> Suite:
    """What a file says itself, without what it includes."""
    sweeps = _sweeps(data, path)
    algorithms = [*data["algorithms"], *(a for made in sweeps.values() for a in made.values())]
    for algorithm in algorithms:
        check_keys(algorithm, {"name", "baseline"}, ALGORITHM_KEYS, f"{path.name}: algorithm")
        check_known(dict.fromkeys(algorithm.get("environments", ())), data["all_environments"],
               f"{path.name}: {algorithm['name']}: environment")  # fmt: skip
    for title, named in data.get("figures", {}).items():
        if not fits(named, tuple[str, ...]):
            raise SuiteError(f"{path.name}: figure {title!r} must list algorithms, got {named!r}")
        check_known(
            dict.fromkeys(named), {a["name"] for a in algorithms}, f"{path.name}: algorithm"
        )
    runs = [run for algorithm in algorithms for run in _runs(algorithm, data, path)]
    if len({run.run_id for run in runs}) < len(runs):
        raise SuiteError(f"{path.name}: names of algorithms and seeds must differ from each other")
    return Suite(
        name=path.stem,
        title=data["title"],
        note=data.get("note", ""),
        algorithms=[algorithm["name"] for algorithm in algorithms],
        environments=list(data["environments"]),
        runs=runs,
        figures=data.get("figures", {}),
        sweeps={k: {v: a["name"] for v, a in made.items()} for k, made in sweeps.items()},
    )


def _runs(algorithm: dict[str, Any], data: dict[str, Any], path: Path) -> list[RunSpec]:
    """One algorithm's runs on its environments, seeds and agents, their arguments checked."""
    runs = []
    for environment, env_id in data["environments"].items():
        if environment not in algorithm.get("environments", data["environments"]):
            continue
        args = {"env_id": env_id, **data["args"], **algorithm.get("args", {})}
        where = f"{path.name}: {algorithm['name']} on {environment}"
        for seed in data["seeds"]:
            settings = {**args, "seed": seed, "agent": 0}
            check_args(algorithm["baseline"], settings, data.get("evaluation", {}), where)
        runs += [
            RunSpec(
                suite=path.stem,
                algorithm=algorithm["name"],
                environment=environment,
                baseline=algorithm["baseline"],
                args={**args, "seed": seed, "agent": agent},
                evaluation=resolve_evaluation(algorithm["baseline"], data.get("evaluation", {})),
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
        check_keys(sweep, needed, SWEEP_KEYS, f"{path.name}: sweep")
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
