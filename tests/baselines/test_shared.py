"""Deliberate repetition: functions and classes that share a name are the same, line for line."""

from __future__ import annotations

import ast
import itertools
from pathlib import Path
from types import ModuleType

import pytest

from baselines import ppo_reg, ppo_reg_coinrun, trpo_reg

ALIKE = {"Args", "Args.__post_init__", "Learner", "Learner.__init__", "update"}  # each its own
# Images, groups of environments, one network and one optimizer, a count of valid steps and an
# annealing horizon; no simulator in Python, so no Gymnasium wrappers, and threads.
IMAGES = {"Learner.load_state_dict", "Learner.state_dict", "Learner.weights", "Rollout", "main"}
IMAGES |= {"log_update", "make_env", "make_envs", "open_logs", "rollout", "train"}
EXCEPTIONS = {
    (ppo_reg, trpo_reg): ALIKE,
    (ppo_reg, ppo_reg_coinrun): ALIKE | IMAGES,
    (trpo_reg, ppo_reg_coinrun): ALIKE | IMAGES,
}


def definitions(baseline: ModuleType) -> dict[str, str]:
    """Source of each function and class, and of each method as Class.method."""
    code = Path(baseline.__file__).read_text()
    lines = code.splitlines()
    found = {}

    def add(nodes, prefix: str = "") -> None:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                first = min([node.lineno, *[d.lineno for d in node.decorator_list]])
                found[prefix + node.name] = "\n".join(lines[first - 1 : node.end_lineno])
            if isinstance(node, ast.ClassDef):
                add(node.body, f"{node.name}.")

    add(ast.parse(code).body)
    return found


BASELINES = (ppo_reg, trpo_reg, ppo_reg_coinrun)
FOUND = {baseline: definitions(baseline) for baseline in BASELINES}


def shared(one: ModuleType, other: ModuleType) -> set[str]:
    return FOUND[one].keys() & FOUND[other].keys()


def label(value) -> str | None:
    return Path(value.__file__).stem if isinstance(value, ModuleType) else None


@pytest.mark.parametrize(
    ("one", "other", "name"),
    [(*pair, x) for pair, own in EXCEPTIONS.items() for x in sorted(shared(*pair) - own)],
    ids=label,
)
def test_what_shares_a_name_is_the_same(one, other, name):
    assert FOUND[one][name] == FOUND[other][name]


@pytest.mark.parametrize(
    ("one", "other", "name"),
    [(*pair, x) for pair, own in EXCEPTIONS.items() for x in sorted(own)],
    ids=label,
)
def test_each_exception_is_needed(one, other, name):
    assert FOUND[one][name] != FOUND[other][name]


def test_every_pair_is_compared():
    assert set(EXCEPTIONS) == set(itertools.combinations(BASELINES, 2))


@pytest.mark.parametrize("name", ["MAY_CHANGE", "OBS_CLIP"])
def test_the_control_baselines_share_their_constants(name):
    assert getattr(ppo_reg, name) == getattr(trpo_reg, name)


def test_what_the_baselines_should_share_is_shared():
    everywhere = {"RunError", "env_seeds", "gae", "load_checkpoint", "save_checkpoint", "step"}
    everywhere |= {"rollout", "train", "check_same", "check_finite", "Learner.state_dict"}
    everywhere |= {"Args.batch_size", "Args.num_updates", "Args.path", "Args.require"}
    assert all(everywhere <= shared(*pair) for pair in EXCEPTIONS)
    assert {"Actor", "NormalizeObservation", "make_envs"} <= shared(ppo_reg, trpo_reg)
