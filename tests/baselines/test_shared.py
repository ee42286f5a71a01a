"""Deliberate repetition: functions and classes that share a name are the same, line for line."""

from __future__ import annotations

import ast
from pathlib import Path
from types import ModuleType

import pytest

from baselines import ppo_reg, trpo_reg

DIFFER = {"Args", "Learner", "update"}
METHODS_DIFFER = {"Args.__post_init__", "Learner.__init__"}


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


PPO, TRPO = definitions(ppo_reg), definitions(trpo_reg)
SHARED = PPO.keys() & TRPO.keys()


@pytest.mark.parametrize("name", sorted(SHARED - DIFFER - METHODS_DIFFER))
def test_what_shares_a_name_is_the_same(name):
    assert TRPO[name] == PPO[name]


@pytest.mark.parametrize("name", sorted(DIFFER | METHODS_DIFFER))
def test_each_exception_is_needed(name):
    assert TRPO[name] != PPO[name]


def test_what_the_baselines_should_share_is_shared():
    expected = {"Actor", "NormalizeObservation", "gae", "measure_conditioning", "rollout", "step"}
    expected |= {"load_checkpoint", "make_envs", "save_checkpoint", "train", "Learner.state_dict"}
    assert expected <= SHARED
