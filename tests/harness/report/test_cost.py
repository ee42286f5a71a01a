"""Claim (e), from runs whose speeds are known."""

from __future__ import annotations

import numpy as np
import pytest

from harness.report.claims import MIN_UPDATES
from harness.report.cost import cost_claim
from harness.report.results import load_results
from harness.suite import load_suite
from tests.harness.conftest import write_run


def claim_of(store, speed, seeds=2, updates=MIN_UPDATES, agents=2):
    """Plain runs take 1000 steps/s, regularized ones what `speed` says for task and agent."""
    suite = load_suite("table1", seeds=seeds, agents=agents)
    for run in suite.runs:
        reg = run.algorithm.endswith(" reg")
        sps = speed(run.environment, run.args["agent"]) if reg else 1000.0
        write_run(store, run, np.zeros(updates), columns={"charts/SPS": [sps] * updates})
    return cost_claim(load_results(suite, store))


@pytest.mark.parametrize(
    ("speed", "added", "expected"),
    [
        (1000 / 1.05, 0.05, "supported"),
        (1000 / 1.2, 0.2, "contradicted"),
        (1100, -1 / 11, "supported"),
    ],
)
def test_time_added_by_hand(store, speed, added, expected):
    claim = claim_of(store, lambda *_: speed)
    assert (claim.letter, claim.verdict) == ("e", expected)
    assert [f.task for f in claim.findings] == ["PPO", "TRPO"]
    for finding in claim.findings:
        assert finding.estimate.mean == pytest.approx(added)
        assert finding.estimate.n == 8 * 2  # tasks and seeds, not agents
        assert finding.verdict == expected


def test_an_interval_that_holds_the_limit_supports_nothing(store):
    claim = claim_of(store, lambda task, _: 1000 / (1.0 if task < "Hopper" else 1.2))
    assert claim.verdict == "not supported"


def test_agents_of_a_seed_count_once(store):
    claim = claim_of(store, lambda _, agent: 1000 / (1.0 + 0.1 * agent), agents=3)
    assert claim.findings[0].estimate.mean == pytest.approx(0.1)
    assert claim.findings[0].estimate.n == 16


@pytest.mark.parametrize("few", [{"seeds": 1}, {"updates": MIN_UPDATES - 1}])
def test_few_or_short_runs_have_no_verdict(store, few):
    assert claim_of(store, lambda *_: 1000.0, **few).verdict == "too few runs to tell"


def test_without_pairs_there_is_no_finding(store):
    suite = load_suite("figure1")
    assert cost_claim(load_results(suite, store)).findings == []
