"""What is read of a suite's runs."""

from __future__ import annotations

from harness.report.results import load_results
from tests.harness.conftest import write_run


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
