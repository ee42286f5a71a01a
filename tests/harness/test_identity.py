"""Two runs are one where every argument that decides their numbers is the same."""

from __future__ import annotations

import dataclasses
import json
import sys
import types
from pathlib import Path

import pytest

from harness import identity
from harness.identity import compare, describe, identify, make_args, resolve, version_of
from harness.suite import RunSpec


@pytest.fixture
def toy(monkeypatch):
    """Makes a baseline `toy` with these defaults, its version and what may change."""

    def make(version: int | None = None, may_change=("run_dir",), **defaults) -> None:
        fields = [(name, type(x), dataclasses.field(default=x)) for name, x in defaults.items()]
        module = types.ModuleType("baselines.toy")
        module.Args = dataclasses.make_dataclass("Args", fields, frozen=True)
        module.Args.__module__ = "baselines.toy"
        if may_change is not None:
            module.MAY_CHANGE = set(may_change)
        if version is not None:
            module.VERSION = version
        monkeypatch.setitem(sys.modules, "baselines.toy", module)
        identity._fields.cache_clear()

    yield make
    identity._fields.cache_clear()


def saved(args=None, version: int = 1) -> dict:
    """The spec.json of a run of the toy with these arguments."""
    return {"baseline": "toy", "version": version, "args": resolve("toy", args or {})}


def changes(spec: dict, args=None) -> dict:
    return compare(spec, identify("toy", args or {}))


def test_arguments_are_resolved_with_the_baselines_defaults():
    args = resolve("ppo_reg", {"gamma": 1, "hidden_sizes": [8]})
    assert args["gamma"] == 1.0
    assert type(args["gamma"]) is float
    assert args["gae_lambda"] == 0.95
    assert args["hidden_sizes"] == [8]
    assert args["run_dir"] is None
    assert resolve("ppo_reg", {})["hidden_sizes"] == [64, 64]
    assert make_args("ppo_reg", {**args, "num_minibatches": 8}).hidden_sizes == (8,)


def test_values_are_resolved_as_json_holds_them(toy):
    toy(steps=4, scale=1.5, betas=(1, 2), layers=(1, 2), path=Path("a/b"), log=True, rate=None)
    hints = sys.modules["baselines.toy"].Args.__annotations__
    hints |= {"betas": tuple[float, ...], "layers": tuple[int, ...], "rate": float | None}
    found = resolve("toy", {"scale": 2})
    expected = {"steps": 4, "scale": 2.0, "betas": [1.0, 2.0], "layers": [1, 2], "path": "a/b"}
    assert json.dumps(found) == json.dumps({**expected, "log": True, "rate": None})


def test_defaults_may_be_made_and_an_argument_may_have_none(toy):
    toy()

    @dataclasses.dataclass
    class Args:
        env_id: str
        layers: list = dataclasses.field(default_factory=lambda: [64])

    Args.__module__ = "baselines.toy"
    sys.modules["baselines.toy"].Args = Args
    assert resolve("toy", {}) == {"layers": [64]}
    assert resolve("toy", {"env_id": "x"}) == {"layers": [64], "env_id": "x"}


def test_every_argument_decides_where_the_baseline_frees_none(toy):
    toy(may_change=None, gamma=0.9, run_dir="a")
    assert identify("toy", {}) == {
        "baseline": "toy", "version": 1, "gamma": 0.9, "run_dir": "a",
    }  # fmt: skip


def test_a_changed_default_is_a_changed_run(toy):
    toy(gamma=0.9, steps=4)
    before = saved()
    assert changes(before) == {}
    toy(gamma=0.8, steps=4)
    assert changes(before) == {"gamma": (0.9, 0.8)}
    assert changes(before, {"gamma": 0.9}) == {}  # and what is set keeps its value


def test_a_flag_that_is_added_with_a_default_leaves_older_runs_valid(toy):
    toy(gamma=0.9)
    before = saved()
    toy(gamma=0.9, clip=False, rate=2.0)
    assert changes(before) == {}
    assert changes(before, {"clip": True}) == {"clip": (False, True)}


def test_a_flag_that_is_gone_is_a_change(toy):
    toy(gamma=0.9, quotient="state")
    before = saved()
    toy(gamma=0.9)
    assert changes(before) == {"quotient": ("state", None)}


def test_a_raised_version_is_a_changed_run(toy):
    toy(gamma=0.9)
    assert version_of("toy") == 1  # where the baseline does not say
    before = saved()
    toy(version=2, gamma=0.9)
    assert changes(before) == {"version": (1, 2)}
    assert changes(saved(version=2)) == {}
    assert changes(saved(version=3)) == {"version": (3, 2)}
    del before["version"]  # as in a file from before there were versions
    assert changes(before) == {"version": (1, 2)}


def test_what_may_change_when_a_run_is_resumed_is_no_part_of_it(toy):
    toy(gamma=0.9, run_dir="a", may_change={"run_dir"})
    before = saved()
    toy(gamma=0.9, run_dir="b", may_change={"run_dir"})
    assert changes(before) == {}
    assert identify("toy", {}) == {"baseline": "toy", "version": 1, "gamma": 0.9}


def test_precision_is_part_of_a_run_and_the_folder_and_the_logs_are_not():
    coinrun = identify("ppo_reg_coinrun", {})
    assert {"bf16", "compile"} <= coinrun.keys()
    assert "compile" in identify("ppo_reg", {})
    both = {"run_dir", "resume", "track", "capture_video"}
    assert not both & (coinrun.keys() | identify("ppo_reg", {}).keys())


def test_another_baseline_is_the_one_change(toy):
    toy(gamma=0.9)
    other = compare(saved(), identify("ppo_reg", {}))
    assert other == {"baseline": ("toy", "ppo_reg")}
    assert describe({"levels": (2, 3), "gamma": (0.9, 0.8)}) == "levels 2 -> 3, gamma 0.9 -> 0.8"


def test_one_and_one_point_zero_are_one_setting():
    def spec(**args):
        args = {"env_id": "x", "seed": 1, "agent": 0, **args}
        return RunSpec("suite", "PPO", "Hopper", "ppo_reg", args)

    assert spec(gamma=1).hash == spec(gamma=1.0).hash
    assert spec(target_kl=1).hash == spec(target_kl=1.0).hash
    assert spec(coefficient=0).hash == spec(coefficient=0.0).hash
    assert spec(gamma=0.99).hash == spec().hash  # the default, said or not
    assert spec(gamma=0.9).hash != spec().hash
