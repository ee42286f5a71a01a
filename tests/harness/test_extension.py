"""Finished runs that are continued: as if they had had that length from the start, or refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pandas as pd
import pytest
import torch

from baselines import ppo_reg, ppo_reg_coinrun, trpo_reg
from harness.extension import refuse_extension, why_not
from harness.files import StoreError
from harness.launchers.groups import commands
from harness.store import Store
from harness.suite import load_suite
from tests.baselines.helpers import short_run, weights, without_speed
from tests.harness.conftest import make_episodes, write_run

SUITE = """
title = "One"
seeds = [1]
agents = 3

[args]
total_timesteps = 128
num_steps = 64
num_minibatches = 2
update_epochs = 1
vf_epochs = 1
checkpoint_interval = 2

[[algorithms]]
name = "PPO"
baseline = "ppo_reg"

[environments]
Hopper = "Pendulum-v1"
"""


@pytest.fixture
def one_file(tmp_path):
    path = tmp_path / "one.toml"
    path.write_text(SUITE)
    return path


@pytest.fixture
def plan(one_file):
    """The suite's runs at a length."""
    return lambda steps: load_suite(str(one_file), total_timesteps=steps).runs


# --- bit for bit ---------------------------------------------------------------------------------


def learner_of(store, spec) -> dict:
    return torch.load(store.path(spec, "checkpoint.pt"), weights_only=True)["learner"]


def check_equal(ours, theirs) -> None:
    """The same content, to the bit, of whatever a checkpoint holds."""
    if isinstance(theirs, torch.Tensor):
        assert torch.equal(ours, theirs)
    elif isinstance(theirs, dict | list):
        assert len(ours) == len(theirs)
        pairs = theirs.items() if isinstance(theirs, dict) else enumerate(theirs)
        for key, value in pairs:
            check_equal(ours[key], value)
    else:
        assert ours == theirs


def test_a_population_ends_as_if_it_had_been_that_long(run_cli, store, one_file, plan, tmp_path):
    short = ["run-all", "--suite", one_file, "--results-dir", store.root, "--jobs", 1]
    long = [*short, "--total-timesteps", 256]
    run_cli(*short)
    before = [store.record(spec) for spec in plan(128)]
    status, out = run_cli(*long, "--extend", "--agents", 2)  # the third is continued with them
    assert status == 0, out
    status, out = run_cli(*long[:4], tmp_path / "straight", *long[5:])
    assert status == 0, out

    straight = Store(tmp_path / "straight")
    for spec in plan(256):
        check_equal(learner_of(store, spec), learner_of(straight, spec))
        rows = without_speed(store.path(spec))
        assert len(rows) == 4
        assert rows == without_speed(straight.path(spec))

    # The shorter runs are as they were.
    for spec, record in zip(plan(128), before, strict=True):
        assert store.state(spec) == "done"
        again = store.record(spec)
        assert (again.scores, again.done, again.spec) == (record.scores, record.done, record.spec)
        pd.testing.assert_frame_equal(again.curves, record.curves)
    status, out = run_cli(*short)
    assert "3 done before, 0 to do" in out


@pytest.mark.parametrize("baseline", [ppo_reg, trpo_reg, ppo_reg_coinrun])
def test_a_single_run_ends_as_if_it_had_been_that_long(baseline, tmp_path):
    often = {"checkpoint_interval": 1}
    if baseline is ppo_reg_coinrun:
        often["anneal"] = False
    baseline.train(short_run(baseline, tmp_path / "a", total_timesteps=128, **often))
    longer = {"total_timesteps": 256, **often}
    extended = baseline.train(
        short_run(baseline, tmp_path / "a", resume=True, extend=True, **longer)
    )
    straight = baseline.train(short_run(baseline, tmp_path / "b", **longer))
    assert torch.equal(weights(extended), weights(straight))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")
    assert len(without_speed(tmp_path / "a")) == 4


@pytest.mark.parametrize("baseline", [ppo_reg, trpo_reg, ppo_reg_coinrun])
def test_a_baseline_grows_only_when_told_to_and_never_shrinks(baseline, tmp_path):
    own = {"anneal": False} if baseline is ppo_reg_coinrun else {}
    baseline.train(short_run(baseline, tmp_path, total_timesteps=128, **own))
    again = {"resume": True, **own}
    more = short_run(baseline, tmp_path, total_timesteps=256, **again)
    with pytest.raises(baseline.RunError, match="total_timesteps=128, not 256"):
        baseline.train(more)
    again["extend"] = True
    less = short_run(baseline, tmp_path, total_timesteps=64, **again)
    with pytest.raises(baseline.RunError, match="total_timesteps=128, not 64"):
        baseline.train(less)
    other = short_run(baseline, tmp_path, total_timesteps=256, gamma=0.5, **again)
    with pytest.raises(baseline.RunError, match="gamma"):
        baseline.train(other)


# --- what is refused -----------------------------------------------------------------------------


SMALL = {"total_timesteps": 400, "num_steps": 100, "num_minibatches": 2, "checkpoint_interval": 2}
GAMES = {"total_timesteps": 2048, "num_envs": 4, "checkpoint_interval": 1}


@pytest.mark.parametrize(
    ("baseline", "args", "longer", "reason"),
    [
        ("ppo_reg", SMALL, 800, ""),
        ("trpo_reg", SMALL, 401, ""),
        ("ppo_reg", SMALL, 400, "it has 400 steps, not fewer than 400"),
        ("ppo_reg", {**SMALL, "anneal_lr": True}, 800, "anneal_lr makes"),
        ("ppo_reg", {**SMALL, "checkpoint_interval": 3}, 800,
         "4 updates are no multiple of checkpoint_interval = 3"),
        ("ppo_reg_coinrun", GAMES, 4096, "anneal without anneal_timesteps makes"),
        ("ppo_reg_coinrun", {**GAMES, "anneal": False}, 4096, ""),
    ],
)  # fmt: skip
def test_why_a_run_cannot_go_on(baseline, args, longer, reason):
    found = why_not(baseline, {"env_id": "coinrun", **args}, longer)
    assert reason in found
    assert bool(found) == bool(reason)


def test_nothing_is_refused_that_is_new_or_under_way_or_done(store, plan):
    spec = plan(256)[0]
    refuse_extension(spec, store)
    store.start(spec, [], [spec])
    refuse_extension(spec, store)
    write_run(store, spec, [1.0])
    refuse_extension(spec, store)


def test_a_finished_run_is_extended_and_an_unfinished_one_is_not(store, plan):
    short, spec = plan(128)[0], plan(256)[0]
    write_run(store, short, [1.0, 2.0], done=False)
    with pytest.raises(StoreError, match=r"not finished its 128 steps: .*--total-timesteps 128"):
        refuse_extension(spec, store)
    write_run(store, short, [1.0, 2.0])
    refuse_extension(spec, store)
    with pytest.raises(StoreError, match=r"cannot be extended: it has 128 steps"):
        refuse_extension(plan(64)[0], store)


def test_other_changes_than_the_length_are_refused(store, plan):
    write_run(store, plan(128)[0], [1.0, 2.0])
    with pytest.raises(StoreError, match=r"gamma 0\.99 -> 0\.5"):
        refuse_extension(plan(256)[0].with_args(gamma=0.5), store)


def test_run_all_refuses_before_anything_starts(run_cli, store, one_file, plan):
    write_run(store, plan(64)[0], [1.0])
    words = ["run-all", "--suite", one_file, "--results-dir", store.root, "--extend"]
    status, out = run_cli(*words, "--total-timesteps", 256)
    assert status == 1
    assert "1 updates are no multiple of checkpoint_interval = 2" in out
    assert not store.path(plan(256)[1]).exists()
    status, out = run_cli(*words)
    assert status == 1
    assert "--extend needs --total-timesteps" in out


# --- the shorter run -----------------------------------------------------------------------------


def test_the_shorter_run_is_kept_beside_the_longer_one(store, plan):
    short, long = (
        dataclasses.replace(plan(steps)[0], evaluation={"levels": 1, "repeats": 1})
        for steps in (128, 256)
    )
    episodes = make_episodes(seen_sampled=[[1.0]])
    write_run(store, short, [1.0, 2.0], episodes=episodes)
    store.path(short, "evaluation.json").write_text('{"levels": 1}')
    assert not store.was_extended(short)
    assert store.was_extended(long)
    assert "--extend" in commands([long], store)[0]

    store.start(long, [], [long])
    assert store.state(short) == "done"
    assert store.state(long) == "interrupted"
    assert not store.path(long, "evaluation.csv").exists()  # it is of the shorter run
    assert not store.path(long, "evaluation.json").exists()
    assert "--extend" in commands([long], store)[0]  # also when it is continued again

    write_run(store, long, [1.0, 2.0, 3.0, 4.0], episodes=make_episodes(seen_sampled=[[0.0]]))
    assert store.state(long) == store.state(short) == "done"
    before, after = store.record(short), store.record(long)
    assert before.curves["charts/episodic_return"].tolist() == [1.0, 2.0]
    assert after.curves["charts/episodic_return"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert (before.scores["training_score"], after.scores["training_score"]) == (2.0, 4.0)
    assert (before.evaluation["success"].item(), after.evaluation["success"].item()) == (1, 0)
    assert before.asked == {"levels": 1}
    assert len(before.spec["sessions"]) == 1
    assert store.shorter_lengths(long) == [128]


@pytest.mark.parametrize("last", ["spec.json", "done.json"])
def test_a_kill_while_the_shorter_run_is_put_aside_loses_nothing(store, plan, monkeypatch, last):
    short, long = plan(128)[0], plan(256)[0]
    write_run(store, short, [1.0, 2.0])
    score = store.record(short).scores

    replace = Path.replace

    def stop_after(path, target):
        replace(path, target)
        if path.name == f"{last}.tmp":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stop_after)
        with pytest.raises(KeyboardInterrupt):
            store.start(long, [], [long])

    assert store.state(short) == "done"
    assert store.record(short).scores == score
    assert store.state(long) == "changed"
    refuse_extension(long, store)
    store.start(long, [], [long])
    assert store.state(long) == "interrupted"
    assert store.record(short).scores == score
    assert json.loads(store.path(short, "done-128.json").read_text())["rows"] == 2
