"""Claim (e), from runs whose speeds are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

from harness.cost import CostError
from harness.report.cost import added_time, cost_claim
from harness.report.part import make_part
from harness.report.results import load_results
from harness.store import read_json, write_json
from harness.suite import load_suite
from tests.harness.conftest import write_run


def claim_of(store, speed, seeds=2, agents=2, said=lambda run: {}):
    """Plain runs take 1000 steps/s, regularized ones what `speed` says for task and agent."""
    suite = load_suite("table1", seeds=seeds, agents=agents)
    for run in suite.runs:
        reg = run.algorithm.endswith(" reg")
        sps = speed(run.environment, run.args["agent"]) if reg else 1000.0
        write_run(store, run, [0.0], columns={"charts/SPS": [sps]})
        path = store.path(run, "spec.json")
        saved = read_json(path)
        saved["sessions"][-1] |= said(run)
        write_json(path, saved)
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
        assert finding.about == "reg / plain - 1: time for a step, control, single file"
        assert finding.estimate.mean == pytest.approx(added)
        assert finding.estimate.n == 8 * 2  # tasks and seeds, not agents
        assert finding.verdict == expected


def test_an_interval_that_holds_the_limit_is_undecided(store):
    claim = claim_of(store, lambda task, _: 1000 / (1.0 if task < "Hopper" else 1.2))
    assert claim.verdict == "undecided"


def test_agents_of_a_seed_count_once(store):
    claim = claim_of(store, lambda _, agent: 1000 / (1.0 + 0.1 * agent), agents=3)
    assert claim.findings[0].estimate.mean == pytest.approx(0.1)
    assert claim.findings[0].estimate.n == 16


def test_each_implementation_is_judged_by_itself(store):
    """The population adds a fifth, the single file nothing."""

    def said(run):
        population = run.environment in ("Humanoid", "Ant", "Hopper", "Reacher")
        return {"implementation": "population" if population else "single file"}

    slow = ("Humanoid", "Ant", "Hopper", "Reacher")
    claim = claim_of(store, lambda task, _: 1000 / (1.2 if task in slow else 1.0), said=said)
    found = {(f.task, f.about.rpartition(", ")[2]): f for f in claim.findings}
    assert found["PPO", "population"].estimate.mean == pytest.approx(0.2)
    assert found["PPO", "population"].verdict == "contradicted"
    assert found["PPO", "single file"].verdict == "supported"
    assert found["PPO", "single file"].estimate.n == 8
    assert claim.verdict == "undecided"


@pytest.mark.parametrize("what", ["implementation", "processor"])
def test_arms_of_different_making_are_no_pair(store, what):
    claim = claim_of(store, lambda *_: 1000.0, said=lambda run: {what: f"of {run.algorithm}"})
    assert claim.findings == []


def test_the_whole_interval_must_be_on_one_side():
    """Of six the interval is the range."""
    below = added_time("x", "PPO", np.array([0.01, 0.02, 0.03, 0.05, 0.08, 0.1]))
    assert (below.estimate.low, below.estimate.high, below.verdict) == (0.01, 0.1, "supported")
    over = added_time("x", "PPO", np.array([0.11] * 5 + [0.12]))
    assert (over.p, np.isnan(over.p_holm)) == (2 / 64, True)  # of the limit, and not adjusted
    assert added_time("x", "PPO", np.array([0.0] * 5 + [0.11])).verdict == "undecided"
    assert added_time("x", "PPO", np.array([0.11] * 5 + [0.12])).verdict == "contradicted"


def test_five_pairs_decide_nothing():
    few = added_time("x", "PPO", np.zeros(5))
    assert (few.verdict, few.note) == ("undecided", "6 pairs could decide")
    assert np.isnan(few.estimate.low)


def test_without_pairs_there_is_no_finding(store):
    suite = load_suite("figure1")
    claim = cost_claim(load_results(suite, store))
    assert (claim.findings, claim.verdict) == ([], "undecided")


def measure(store, **changes) -> None:
    """Six repetitions that say +2%."""
    timed = pd.DataFrame(
        {
            "algorithm": "PPO", "implementation": "population", "environment": "Hopper",
            "repetition": range(6), "plain": 1e-3, "reg": 1.02e-3, "commit": "abcdef0123",
            "machine": "Fast 9, 2 cores", "date": "2026-02-03T04:05:06+00:00", **changes,
        }
    )  # fmt: skip
    store.root.mkdir(parents=True)
    timed.to_csv(store.root / "cost.csv", index=False)


def test_what_was_measured_in_turn_has_the_say(store):
    """The runs' own speeds say +20%; the six repetitions say +2%."""
    measure(store)
    claim = claim_of(store, lambda *_: 1000 / 1.2)
    (finding,) = claim.findings
    assert finding.about.endswith("in turn, Hopper, population")
    assert finding.estimate.mean == pytest.approx(0.02)
    assert claim.verdict == "supported"


def test_what_a_measurement_comes_from_stands_beside_the_verdict(store):
    measure(store, date=["2026-02-03T04:05:06+00:00"] * 3 + ["2026-02-04T00:00:00+00:00"] * 3)
    same = {"commit": "abcdef0123456789", "clean": True, "processor": "Fast 9", "cores": 2}
    claim = claim_of(store, lambda *_: 1000.0, said=lambda _: same)
    assert claim.notes == (
        "Implementations: population. Measured on both arms in turn, alone.",
        "Commit abcdef0123; Fast 9, 2 cores; 2026-02-03 to 2026-02-04.",
    )


def test_a_measurement_from_elsewhere_than_the_runs_says_so(store):
    measure(store)
    other = {"commit": "9876543210fedcba", "clean": False, "processor": "Slow 1", "cores": 4}
    claim = claim_of(store, lambda *_: 1000.0, said=lambda _: other)
    assert claim.notes[1:] == (
        "Commit abcdef0123; Fast 9, 2 cores; 2026-02-03.",
        "The suite's own runs are of another commit: 9876543210+.",
        "The suite's own runs are of another machine: Slow 1, 4 cores.",
    )


def test_measurements_that_mix_are_a_warning(study, store, tmp_path):
    results = study(lambda _, __, agent: 1.0 * agent)
    for commits, warnings in (
        (["abcdef0123"] * 6, []),
        (["abcdef0123"] * 4 + ["fedcba3210"] * 2,
         ["The measurements of claim (e) mix commits: abcdef0123 (4), fedcba3210 (2)."]),
    ):  # fmt: skip
        timed = pd.DataFrame(
            {
                "algorithm": "PPO", "implementation": "population", "environment": "Hopper",
                "repetition": range(6), "plain": 1e-3, "reg": 1.02e-3, "commit": commits,
                "machine": "Fast 9, 2 cores", "date": "2026-02-03T04:05:06+00:00",
            }
        )  # fmt: skip
        part = make_part(dataclasses.replace(results, timed=timed), tmp_path)
        assert [line for line in part.warnings if "claim (e)" in line] == warnings


@pytest.mark.parametrize("column", ["commit", "machine", "date"])
def test_a_measurement_without_its_origin_is_to_be_made_again(store, column):
    measure(store)
    path = store.root / "cost.csv"
    pd.read_csv(path).drop(columns=column).to_csv(path, index=False)
    with pytest.raises(CostError, match=f"no {column}: .* Measure again with python -m harness"):
        claim_of(store, lambda *_: 1000.0)
