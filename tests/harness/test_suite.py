"""Suites: what a TOML file turns into, and what is refused before anything starts."""

from __future__ import annotations

import pytest
import tyro

from baselines.ppo_reg import Args
from harness.suite import SuiteError, load_suite, suite_names


def test_every_algorithm_task_seed_and_agent_is_a_run(suite):
    assert len(suite.runs) == 2 * 2 * 2 * 2
    assert len({run.run_id for run in suite.runs}) == len(suite.runs)
    assert suite.runs[0].run_id == "ppo__Hopper__s1__a0"
    assert suite.timesteps == 16 * 200


def test_the_hash_is_of_the_configuration(suite, suite_file):
    assert len({run.hash for run in suite.runs}) == len(suite.runs)
    assert load_suite(str(suite_file)).runs[3].hash == suite.runs[3].hash
    assert load_suite(str(suite_file), total_timesteps=300).runs[3].hash != suite.runs[3].hash


@pytest.mark.parametrize("name", suite_names())
def test_flags_say_to_the_baseline_what_the_suite_says(name):
    for run in load_suite(name).runs[::7]:
        args = tyro.cli(Args, args=run.flags)
        expected = Args(**{k: tuple(v) if isinstance(v, list) else v for k, v in run.args.items()})
        assert args == expected


def test_flags_of_booleans_and_lists(suite_file):
    text = suite_file.read_text().replace(
        "num_steps = 100",
        "num_steps = 100\nnorm_obs = false\nanneal_lr = true\nhidden_sizes = [8, 4]",
    )
    suite_file.write_text(text)
    args = tyro.cli(Args, args=load_suite(str(suite_file)).runs[0].flags)
    assert (args.norm_obs, args.anneal_lr, args.hidden_sizes) == (False, True, (8, 4))


def test_it_scales_down(suite_file):
    suite = load_suite(str(suite_file), total_timesteps=100, seeds=1, agents=1, env=("Reacher",))
    assert [run.run_id for run in suite.runs] == [
        "ppo__Reacher__s1__a0",
        "ppo-reg__Reacher__s1__a0",
    ]
    assert suite.timesteps == 200


@pytest.mark.parametrize("flag", ["total_timesteps", "seeds", "agents"])
def test_counts_start_at_1(suite_file, flag):
    with pytest.raises(SuiteError, match=f"{flag} must be at least 1, got 0"):
        load_suite(str(suite_file), **{flag: 0})


def test_it_does_not_scale_up_seeds_in_silence(suite_file):
    with pytest.raises(SuiteError, match=r"has 2 seeds, fewer than 3"):
        load_suite(str(suite_file), seeds=3)


def test_table1_is_the_papers_plan():
    suite = load_suite("table1")
    assert len(suite.environments) == 8
    assert {run.args["total_timesteps"] for run in suite.runs} == {5_000_000}
    for algorithm in suite.algorithms:
        runs = [r for r in suite.runs if (r.algorithm, r.environment) == (algorithm, "Ant")]
        assert len({(r.args["seed"], r.args["agent"]) for r in runs}) == 30


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("num_steps", "num_stesp", "argument 'num_stesp' is unknown: num_steps?"),
        ('title = "Tiny"', 'titel = "Tiny"', "key 'titel' is unknown: title?"),
        ("num_minibatches = 2", "num_minibatches = 3", "num_minibatches must divide"),
        ("num_minibatches = 2", 'num_minibatches = "2"', "num_minibatches must be .*int.*got '2'"),
        (
            "num_minibatches = 2",
            "num_minibatches = true",
            "num_minibatches must be .*int.*got True",
        ),
        ("coefficient = 0.0", "coefficient = -1.0", "coefficient must be finite and at least 0"),
        ("Pendulum-v1", "Pendulum-v7", "Pendulum"),
        ('"ppo_reg"\nargs', '"ppo"\nargs', "baseline 'ppo' cannot be imported"),
        ("[args]", "[args", "not valid TOML"),
        ("agents = 2\n", "", "needs the key 'agents'"),
        ("[1, 2]", "[]", "no runs"),
        ("[1, 2]", "[1, 1]", "must differ"),
        ("[1, 2]", "[-1]", "seed must be at least 0, got -1"),
        ("[1, 2]", "1", "seeds must be of type .*got 1"),
        ("agents = 2", 'agents = "2"', "agents must be of type .*got '2'"),
        ("total_timesteps = 200\n", "", "args needs total_timesteps"),
        (
            "args = { coefficient",
            "arg = { coefficient",
            "key of an algorithm 'arg' is unknown: args?",
        ),
        ('name = "PPO reg"\n', "", "an algorithm needs the key 'name'"),
        ('name = "PPO reg"', 'name = "PPO"', "must differ"),
    ],
)
def test_a_bad_suite_is_refused_and_the_reason_told(suite_file, old, new, message):
    assert old in suite_file.read_text()
    suite_file.write_text(suite_file.read_text().replace(old, new))
    with pytest.raises(SuiteError, match=message):
        load_suite(str(suite_file))


def test_unknown_names_are_refused(suite_file):
    with pytest.raises(SuiteError, match=r"no suite 'tabel1': there are .*table1"):
        load_suite("tabel1")
    with pytest.raises(SuiteError, match=r"no file tabel1\.toml"):
        load_suite("tabel1.toml")
    with pytest.raises(SuiteError, match=r"environment 'Hoper' is unknown: Hopper\?"):
        load_suite(str(suite_file), env=("Hoper",))
