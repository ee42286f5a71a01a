"""What is read of a suite's runs."""

from __future__ import annotations

import dataclasses

import pandas as pd
import pytest

from harness.report.results import load_results
from harness.suite import load_suite
from tests.harness.conftest import make_episodes, write_run


def test_curves_are_a_column_for_each_agent(store, suite):
    for spec in suite.runs:
        write_run(store, spec, [1.0 * spec.args["agent"], 2.0])
    curves = load_results(suite, store).curves("Hopper", "PPO", "charts/episodic_return")
    assert curves.index.tolist() == [100, 200]
    assert curves.loc[100].tolist() == [0.0, 1.0, 0.0, 1.0]


def test_runs_without_metrics_are_not_there(store, suite):
    write_run(store, suite.runs[0], [1.0])
    results = load_results(suite, store)
    assert list(results.metrics) == [suite.runs[0].run_id]
    assert results.curves("Reacher", "PPO", "conditioning/psi").empty


EPISODES = make_episodes(seen_sampled=[[1, 0]], unseen_sampled=[[0, 0]])


@pytest.fixture
def mixed(tmp_path, suite_file, coinrun_run):
    """The tiny suite and, in another file, CoinRun's: a run with levels among others."""
    _, spec = coinrun_run
    suite = load_suite(str(suite_file))
    return dataclasses.replace(
        suite,
        runs=[spec, *suite.runs],
        environments=[spec.environment, *suite.environments],
    )


def test_the_parts_are_the_runs_with_levels_and_the_others(store, mixed):
    results = load_results(mixed, store)
    levels, control = results.part(evaluated=True).suite, results.part(evaluated=False).suite
    assert levels.runs == mixed.runs[:1]
    assert (levels.algorithms, levels.environments) == (["PPO"], ["CoinRun"])
    assert control.runs == mixed.runs[1:]
    assert control.algorithms == ["PPO", "PPO reg"]
    assert control.environments == ["Hopper", "Reacher"]


def test_a_part_that_there_is_not_is_empty(store, suite):
    part = load_results(suite, store).part(evaluated=True).suite
    assert (part.runs, part.algorithms, part.environments) == ([], [], [])


def test_evaluations_are_of_complete_runs_and_found_by_seed_and_agent(store, tmp_path):
    suite = load_suite("table2", seeds=3)
    first, second, third = (run for run in suite.runs if run.algorithm == "PPO")
    write_run(store, first, [1.0], episodes=EPISODES)
    write_run(store, second, [1.0], episodes=EPISODES, done=False)
    results = load_results(suite, store)
    assert list(results.evaluations) == [first.run_id]
    assert list(results.metrics) == [first.run_id, second.run_id]
    pairs = results.pairs("CoinRun", "PPO")
    assert list(pairs) == [(1, 0)]
    pd.testing.assert_frame_equal(pairs[1, 0], EPISODES)
    assert results.evaluations_of("CoinRun", "PPO reg") == {}
    assert results.pairs("CoinRun", "PPO reg") == {}
    assert results.folders[third.run_id] == store.path(third)


def test_evaluations_of_another_configuration_are_left_out(store):
    write_run(store, load_suite("table2").runs[0], [1.0], episodes=EPISODES)
    changed = load_suite("table2", total_timesteps=10**6)
    results = load_results(changed, store)
    assert results.evaluations == results.metrics == {}
    assert results.changed == [changed.runs[0].run_id]


def test_a_part_has_its_own_runs_evaluations(store, suite_file):
    text = suite_file.read_text().replace("[args]", "[evaluation]\nepisodes = 2\n\n[args]")
    suite_file.write_text(text)
    control, games = load_suite(str(suite_file)), load_suite("table2")
    write_run(store, control.runs[0], [3.0])
    write_run(store, games.runs[0], [1.0], episodes=EPISODES)
    both = dataclasses.replace(control, runs=[control.runs[0], games.runs[0]])
    results = load_results(both, store)
    assert list(results.evaluations) == [control.runs[0].run_id, games.runs[0].run_id]
    levels, others = (results.part(evaluated=which) for which in (True, False))
    assert (levels.suite.runs, others.suite.runs) == ([games.runs[0]], [control.runs[0]])
    assert list(levels.evaluations) == [games.runs[0].run_id]
    assert list(others.evaluations) == [control.runs[0].run_id]
    returns = others.evaluations[control.runs[0].run_id]["return"]
    assert returns.tolist() == [3.0] * 4
