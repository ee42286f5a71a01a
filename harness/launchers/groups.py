"""Which runs one process trains: agents that differ in nothing but their number, side by side."""

from __future__ import annotations

import functools
import importlib.util
import sys
from itertools import groupby

from harness.store import Store
from harness.suite import RunSpec

Group = list[RunSpec]
"""agents of one algorithm, environment and seed, numbered in a row; or a single run"""


def make_groups(specs: list[RunSpec], store: Store, jobs: int, plain: bool = False) -> list[Group]:
    """Runs together, as large as leaves none of `jobs` idle; each alone if `plain` or compiled.

    Agents that were begun together are continued together, whether `specs` names them all or not
    and whatever `plain` says: apart they would end with other numbers.
    """
    largest = max(1, len(specs) // jobs)
    groups: list[Group] = []
    for alike in _differing_in_agent(specs):
        begun = _begun_together(alike, store)
        groups += begun

        members = {spec.run_id for group in begun for spec in group}
        fresh = [spec for spec in alike if spec.run_id not in members]
        size = 1 if plain or _is_alone(alike[0]) else largest
        groups += _chunks(fresh, size)
    return groups


def _differing_in_agent(specs: list[RunSpec]) -> list[list[RunSpec]]:
    """The runs, those together that differ in nothing but the agent's number, in its order."""
    alike: dict[tuple[str, ...], list[RunSpec]] = {}
    for spec in specs:
        settings = [f"{name}={value}" for name, value in spec.args.items() if name != "agent"]
        alike.setdefault((spec.algorithm, spec.environment, *settings), []).append(spec)
    return [sorted(found, key=lambda spec: spec.args["agent"]) for found in alike.values()]


def _begun_together(alike: list[RunSpec], store: Store) -> list[Group]:
    """The groups, all members each, that some of these runs were begun in.

    A kill while a group begins may leave members that do not know of it yet: the first ones do.
    """
    groups = {tuple(store.members(spec)) for spec in alike}
    return [[alike[0].with_args(agent=i) for i in agents] for agents in sorted(groups) if agents]


def _is_alone(spec: RunSpec) -> bool:
    """Whether no population can train it."""
    rival = spec.args.get("penalty", "conditioning") != "conditioning"
    return rival or spec.args.get("compile", False) or not has_population(spec.baseline)


def _chunks(specs: list[RunSpec], size: int) -> list[Group]:
    """At most `size` runs each, split also where a number is missing."""
    numbered = groupby(enumerate(specs), key=lambda pair: pair[1].args["agent"] - pair[0])
    rows = [[spec for _, spec in row] for _, row in numbered]
    return [row[i : i + size] for row in rows for i in range(0, len(row), size)]


@functools.cache
def has_population(baseline: str) -> bool:
    """Whether there is a program that trains several agents of this baseline at once."""
    return importlib.util.find_spec(f"baselines.{baseline}_population") is not None


def commands(group: Group, store: Store) -> list[list[str]]:
    """What runs them, one after the other, in the checkout's folder; a person can type it too."""
    first, baseline = group[0], group[0].baseline
    path, more = str(store.path(first).resolve()), []
    if len(group) > 1:
        baseline += "_population"
        path = path.removesuffix(str(first.args["agent"])) + "{agent}"
        more = ["--num-agents", str(len(group))]
    if any(store.was_extended(spec) for spec in group):
        more.append("--extend")
    train = [f"baselines.{baseline}", *first.flags, *more, "--run-dir", path, "--resume"]
    made = [[sys.executable, "-m", *train]]
    if first.evaluation:
        paths = [str(store.path(spec).resolve()) for spec in group]
        flags = [word for name, x in first.evaluation.items() for word in (f"--{name}", str(x))]
        made.append([sys.executable, "-m", "harness", "evaluate", *paths, *flags])
    return made
