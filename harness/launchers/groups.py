"""Which runs one process trains: agents that differ in nothing but their number, side by side."""

from __future__ import annotations

import functools
import importlib.util
import sys
from itertools import groupby

from harness.store import Store
from harness.suite import RunSpec

Group = list[RunSpec]
"""agents numbered in a row, of one algorithm, environment and seed; or a single run"""


def make_groups(specs: list[RunSpec], store: Store, jobs: int, plain: bool = False) -> list[Group]:
    """Runs together, as large as leaves none of `jobs` idle; each alone if `plain` or compiled.

    Runs that were interrupted stay with those they were begun with: these are as far as they are.
    """
    together: dict[tuple, list[RunSpec]] = {}
    for spec in specs:
        compiled = spec.args.get("compile", False)
        alone = plain or compiled or not has_population(spec.baseline)
        settings = tuple((k, str(v)) for k, v in spec.args.items() if k != "agent")
        partners = tuple(store.partners(spec))
        key = (spec.run_id,) if alone else (spec.algorithm, spec.environment, settings, partners)
        together.setdefault(key, []).append(spec)
    most = max(1, len(specs) // jobs)
    groups = []
    for key, found in together.items():
        begun = len(key) > 1 and key[-1]
        for row in _rows(sorted(found, key=lambda spec: spec.args["agent"])):
            size = len(row) if begun else most
            groups += [row[i : i + size] for i in range(0, len(row), size)]
    return groups


def _rows(specs: list[RunSpec]) -> list[list[RunSpec]]:
    """Split where a number is missing."""
    numbered = groupby(enumerate(specs), key=lambda pair: pair[1].args["agent"] - pair[0])
    return [[spec for _, spec in row] for _, row in numbered]


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
    train = [f"baselines.{baseline}", *first.flags, *more, "--run-dir", path, "--resume"]
    made = [[sys.executable, "-m", *train]]
    if first.evaluation:
        paths = [str(store.path(spec).resolve()) for spec in group]
        flags = [word for name, x in first.evaluation.items() for word in (f"--{name}", str(x))]
        made.append([sys.executable, "-m", "harness", "evaluate", *paths, *flags])
    return made
