"""Which runs share a process."""

from __future__ import annotations

import dataclasses
import sys

import pytest

from harness.launchers.groups import commands, has_population, make_groups
from harness.suite import load_suite


def table1(**scale):
    return load_suite("table1", env=("Hopper",), **scale).runs


def names(made):
    return [[run.run_id for run in group] for group in made]


def test_the_agents_of_a_seed_are_trained_together(store):
    made = make_groups(table1(seeds=2, agents=3), store, jobs=2)
    assert [len(group) for group in made] == [3] * 8  # four algorithms, two seeds
    for group in made:
        assert len({(run.algorithm, run.args["seed"]) for run in group}) == 1
        assert [run.args["agent"] for run in group] == [0, 1, 2]


def test_plain_and_compiled_and_what_has_no_population_are_alone(store):
    runs = table1(seeds=1, agents=3)
    compiled = [dataclasses.replace(run, args={**run.args, "compile": True}) for run in runs]
    assert [len(group) for group in make_groups(compiled, store, 2)] == [1] * 12
    assert [len(group) for group in make_groups(runs, store, 2, plain=True)] == [1] * 12
    coinrun = load_suite("table2").runs
    assert not has_population("ppo_reg_coinrun")
    assert [len(group) for group in make_groups(coinrun, store, 2)] == [1] * 8


@pytest.mark.parametrize(("jobs", "sizes"), [(4, [10] * 4), (8, [5] * 8), (64, [1] * 40)])
def test_no_process_is_left_idle(store, jobs, sizes):
    made = make_groups(table1(seeds=1, agents=10), store, jobs)
    assert [len(group) for group in made] == sizes


def test_a_group_is_numbered_in_a_row(store):
    runs = [run for run in table1(seeds=1, agents=5) if run.args["agent"] != 2]
    made = make_groups(runs, store, jobs=1)
    assert [[run.args["agent"] for run in group] for group in made] == [[0, 1], [3, 4]] * 4


def test_interrupted_agents_stay_with_those_they_were_begun_with(store):
    runs = [run for run in table1(seeds=1, agents=4) if run.algorithm == "PPO"]
    for run in runs[:2]:
        store.start(run, [], runs[:2])
    made = make_groups(runs, store, jobs=1)
    assert names(made) == [names([runs[:2]])[0], names([runs[2:]])[0]]
    assert len(make_groups(runs[:2], store, jobs=8)) == 1  # even if cores stay idle


def test_agents_begun_together_stay_so_whatever_is_asked_for(store):
    """In a part of the plan and in `plain` too: apart they would end with other numbers."""
    runs = [run for run in table1(seeds=1, agents=4) if run.algorithm == "PPO"]
    for run in runs:
        store.start(run, [], runs)
    assert names(make_groups(runs[:1], store, jobs=8)) == names([runs])
    assert names(make_groups(runs, store, jobs=1, plain=True)) == names([runs])


def test_a_group_that_a_kill_left_half_begun_is_whole_again(store):
    """The first members know of all; the last ones have not been told yet."""
    runs = [run for run in table1(seeds=1, agents=4) if run.algorithm == "PPO"]
    store.start(runs[0], [], runs[:3])
    assert names(make_groups(runs, store, jobs=1)) == names([runs[:3], runs[3:]])


def test_an_agent_that_was_begun_alone_is_not_joined_by_newcomers(store):
    runs = [run for run in table1(seeds=1, agents=3) if run.algorithm == "PPO"]
    store.start(runs[0], [], runs[:1])
    made = make_groups(runs, store, jobs=1)
    assert sorted(names(made)) == sorted([*names([runs[:1]]), *names([runs[1:]])])


def test_every_run_is_in_one_group(store):
    runs = load_suite("paper").runs
    made = make_groups(runs, store, jobs=7)
    assert sorted(run.run_id for group in made for run in group) == sorted(r.run_id for r in runs)


def test_different_settings_are_not_mixed(store):
    runs = [run for run in table1(seeds=1, agents=2) if run.algorithm == "PPO"]
    other = dataclasses.replace(runs[1], args={**runs[1].args, "gamma": 0.5})
    assert [len(group) for group in make_groups([runs[0], other], store, jobs=1)] == [1, 1]


def test_the_command_of_a_group_and_of_one(store):
    runs = [run for run in table1(seeds=1, agents=3) if run.algorithm == "TRPO"]
    together, judge = commands(runs[1:], store)
    assert "baselines.trpo_reg_population" in together
    assert together[together.index("--agent") + 1] == "1"
    assert together[together.index("--num-agents") + 1] == "2"
    folder = together[together.index("--run-dir") + 1]
    paths = [str(store.path(run).resolve()) for run in runs[1:]]
    assert [folder.replace("{agent}", str(i)) for i in (1, 2)] == paths
    assert judge == [sys.executable, "-m", "harness", "evaluate", *paths, "--episodes", "20"]
    alone, judge = commands(runs[:1], store)
    assert "baselines.trpo_reg" in alone
    assert "--num-agents" not in alone
    assert judge[4:] == [str(store.path(runs[0]).resolve()), "--episodes", "20"]
    assert len(commands([dataclasses.replace(run, evaluation={}) for run in runs], store)) == 1


def test_agents_with_a_rival_of_the_penalty_are_alone(store):
    runs = load_suite("rivals", env=("Hopper",)).runs
    rivals = [run for run in runs if run.algorithm == "CAPS"]
    assert [len(group) for group in make_groups(rivals, store, jobs=1)] == [1] * 5
    conditioning = [run for run in runs if run.algorithm == "conditioning"]
    assert [len(group) for group in make_groups(conditioning, store, jobs=1)] == [5]
