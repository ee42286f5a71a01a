"""Arms of an ablation against their plain algorithm."""

from __future__ import annotations

import numpy as np
import pytest

from harness.report.tables.arms import arm_names, make_arms, to_frame, to_rows
from harness.statistics import detectable_difference, sign_flip_interval

ARMS = """
[[algorithms]]
name = "PPO, gain 1"
baseline = "ppo_reg"
args = { coefficient = 0.0, output_gain = 1.0 }

[[algorithms]]
name = "PPO reg, gain 1"
baseline = "ppo_reg"
args = { output_gain = 1.0 }
"""
GAINS = {"PPO": 0.0, "PPO, gain 1": 10.0, "PPO reg, gain 1": 15.0}


@pytest.fixture
def results(study):
    """Agents differ, and the regularized arm gains more with each; PPO has no evaluation."""
    return study(
        lambda _, name, agent: agent**2 + GAINS[name] + agent * (name == "PPO reg, gain 1"),
        lambda _, name, agent: 0.1 * agent + GAINS[name],
        algorithms=["PPO"], agents=6, more=ARMS,
        final=lambda _, name, agent: None if name == "PPO" else GAINS[name] - agent,
    )  # fmt: skip


def test_an_arm_is_compared_with_its_twin_without_the_penalty(results):
    assert arm_names(results) == {"PPO, gain 1": "PPO", "PPO reg, gain 1": "PPO, gain 1"}


def test_differences_are_paired(results):
    plain, regularized = make_arms(results)
    assert (plain.arm, plain.task, plain.against) == ("PPO, gain 1", "Hopper", "PPO")
    assert plain.reward == (10.0, 10.0, 10.0, 6)
    assert plain.final.n == 0
    assert regularized.reward.mean == 5.0 + 2.5
    ends = [float(end) for end in sign_flip_interval(5.0 + np.arange(6.0))]
    assert list(regularized.reward[1:]) == [*ends, 6]
    assert regularized.final == (5.0, 5.0, 5.0, 6)
    spread = np.std(np.arange(6.0), ddof=1)
    assert regularized.detectable == pytest.approx(float(detectable_difference(spread, 6)))


def test_psi_is_the_arms_own_by_the_yardstick(results):
    _, regularized = make_arms(results)
    assert regularized.psi.mean == pytest.approx(15.25)
    assert regularized.plain_psi == pytest.approx(10.25)
    assert np.isnan(regularized.quotient)
    assert np.isnan(regularized.own_psi)


def test_rows_say_what_they_rest_on(results):
    header, rows = to_rows(make_arms(results))
    assert header[:4] == ["arm", "task", "against", "training score"]
    assert rows[0][3] == "10.0 [10.0, 10.0] (n 6, 0 failed, finds 0)"
    assert rows[0][4] == "–"
    assert rows[1][4] == "5.00 [5.00, 5.00]"
    assert rows[1][-2:] == ["–", "–"]
    frame = to_frame(make_arms(results))
    assert frame["reward"].tolist() == [10.0, 7.5]
    assert frame["against"].tolist() == ["PPO", "PPO, gain 1"]


def test_a_failed_run_has_the_worst_score_of_its_task(study):
    results = study(
        lambda _, name, agent: 1.0 + agent + GAINS[name], algorithms=["PPO"], agents=2, more=ARMS,
        diverged=lambda _, name, agent: (name, agent) == ("PPO, gain 1", 0),
    )  # fmt: skip
    plain, regularized = make_arms(results)
    assert (plain.failed, regularized.failed) == (1, 1)
    assert plain.reward.mean == np.mean([1.0 - 1.0, 12.0 - 2.0])


def test_the_papers_algorithms_are_no_arms(study):
    results = study(lambda *_: 1.0, algorithms=["PPO", "PPO reg", "TRPO"], agents=2)
    assert arm_names(results) == {}
    assert make_arms(results) == []
