"""Claim (a): who counts, what is correlated with what, and what is said."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from harness.report.claims import Claim, Finding, agent_table, make_claims, setting_means

TASKS = ("Hopper", "Ant", "Reacher")
RISING = np.linspace(0.0, 1.0, 40)


def claim_of(results) -> Claim | None:
    return next((c for c in make_claims(results) if c.letter == "a"), None)


def found(claim: Claim, about: str, task: str = "all") -> Finding:
    (finding,) = [f for f in claim.findings if about in f.about and f.task == task]
    return finding


def learns(_task, _algorithm, agent):
    return agent + RISING


def falls(_task, _algorithm, agent):
    """Better agents are better conditioned from the first."""
    return 12.0 - agent - RISING


def rises(_task, _algorithm, agent):
    return agent + RISING


def test_it_is_supported_where_better_agents_have_smaller_psi(study):
    claim = claim_of(study(learns, falls, algorithms=["PPO"], tasks=TASKS))
    assert claim.verdict == "supported"
    for about in ("final psi", "early psi"):
        for task in ("all", *TASKS):
            np.testing.assert_allclose(found(claim, about, task).estimate, (-1, -1, -1, 10))
            assert found(claim, about, task).verdict == "supported"
    assert claim.basis == "at 0.08% of the paper's length (4,000 steps)"
    assert list(dict.fromkeys(f.about for f in claim.findings)) == [
        "over agents: final psi and reward",
        "over agents: early psi and reward",
        "over training: changes of psi and reward",
    ]
    assert (claim.failed, claim.without_failed) == (0, "")
    assert claim.notes == ("Changes over training are reported; they are no part of the verdict.",)


def test_it_is_contradicted_where_they_have_larger_psi(study):
    claim = claim_of(study(learns, rises, algorithms=["PPO"], tasks=TASKS))
    assert claim.verdict == "contradicted"


def test_it_is_undecided_where_psi_has_nothing_to_do_with_reward(study):
    order = [5, 1, 8, 3, 7, 2, 9, 4, 0, 6]
    results = study(learns, lambda *key: order[key[2]] + RISING[::-1], algorithms=["PPO"])
    finding = found(claim_of(results), "final psi")
    assert finding.estimate.mean == pytest.approx(stats.spearmanr(range(10), order).statistic)
    assert finding.verdict == "undecided"
    assert claim_of(results).verdict == "undecided"
    assert finding.p == pytest.approx(0.47, abs=0.02)  # as the test gave it: SciPy's


def test_what_could_have_been_found_is_a_correlation_of_at_most_1(study):
    """A headline of two has 2/5 of the level, four fifths of it on one side."""
    reach = stats.norm.ppf(1 - 0.05 * 2 / 5 * 4 / 5) + stats.norm.ppf(0.8)
    order = np.random.default_rng(0).permutation(20)
    results = study(learns, lambda *key: order[key[2]] + RISING, algorithms=["PPO"], agents=20)
    finding = found(claim_of(results), "final psi")
    assert finding.detectable == pytest.approx(reach / np.sqrt(19), rel=0.05)
    few = study(learns, lambda *key: order[key[2]] + RISING, algorithms=["PPO"], agents=6)
    assert np.isnan(found(claim_of(few), "final psi").detectable)  # 1.34 is none


def test_early_psi_is_not_late_psi(study):
    """In the first tenth the better agents are worse conditioned; from then on better."""
    early = np.arange(40) < 4

    def psi(_task, _algorithm, agent):
        return np.where(early, agent, 100.0 - 10 * agent)

    claim = claim_of(study(learns, psi, algorithms=["PPO"]))
    assert found(claim, "early psi").verdict == "contradicted"
    assert found(claim, "final psi").verdict == "supported"
    assert claim.verdict == "undecided"


def test_what_differs_between_settings_is_no_evidence(study):
    """The worse setting has the larger psi; within each, psi has nothing to do with reward."""
    order = [5, 1, 8, 3, 7, 2, 9, 4, 0, 6]
    worse = {"PPO": 0.0, "PPO setting 2": 1000.0, "TRPO": 2000.0}
    results = study(
        lambda _, name, agent: agent - worse[name],
        lambda _, name, agent: order[agent] + worse[name],
        algorithms=list(worse),
    )
    claim = claim_of(results)
    assert claim.verdict == "undecided"
    assert abs(found(claim, "final psi").estimate.mean) < 0.2


def test_the_verdict_is_of_all_tasks_not_of_the_single_ones(study):
    """Each task by itself is undecided; together they are not."""
    orders = {
        "Hopper": [8, 9, 6, 3, 7, 5, 1, 4, 2, 0],
        "Ant": [9, 5, 8, 7, 2, 6, 4, 0, 3, 1],
        "Reacher": [6, 9, 8, 4, 7, 3, 5, 0, 2, 1],
    }
    results = study(
        lambda _, __, agent: 1.0 * agent,
        lambda task, _, agent: orders[task][agent] + 0.5,
        algorithms=["PPO"], tasks=TASKS,
    )  # fmt: skip
    claim = claim_of(results)
    headline = found(claim, "final psi")
    singles = [found(claim, "final psi", task) for task in TASKS]
    assert headline.estimate.mean == pytest.approx(np.mean([f.estimate.mean for f in singles]))
    expected = [stats.spearmanr(range(10), orders[task]).statistic for task in TASKS]
    assert [f.estimate.mean for f in singles] == pytest.approx(expected)
    assert headline.p_holm < min(f.p_holm for f in singles)
    assert claim.verdict == headline.verdict == "supported"


def test_tasks_of_different_scale_are_ranked_apart(study):
    scale = {"Hopper": 1000.0, "Ant": 1.0}
    results = study(
        lambda task, _, agent: scale[task] * (agent + RISING),
        lambda task, _, agent: scale[task] * (12 - agent - RISING),
        algorithms=["PPO"], tasks=tuple(scale),
    )  # fmt: skip
    assert found(claim_of(results), "final psi").estimate.mean == pytest.approx(-1)


@pytest.mark.parametrize("other", ["PPO reg", "PPO noise"])
def test_agents_whose_psi_was_moved_by_design_do_not_count(study, other):
    def psi(task, algorithm, agent):
        return (falls if algorithm == "PPO" else rises)(task, algorithm, agent)

    claim = claim_of(study(learns, psi, algorithms=["PPO", other]))
    assert claim.verdict == "supported"
    assert found(claim, "final psi").estimate.mean == pytest.approx(-1.0)


def test_agents_that_a_setting_lacks_are_left_out_of_all(study):
    missing = [("Hopper", "TRPO", 3), ("Hopper", "PPO", 5)]
    results = study(
        lambda *key: None if key in missing else learns(*key), falls, algorithms=["PPO", "TRPO"]
    )
    finding = found(claim_of(results), "final psi")
    assert (finding.estimate.n, finding.estimate.mean) == (8, pytest.approx(-1.0))


def test_unfinished_agents_do_not_count(study):
    results = study(
        learns, falls, algorithms=["PPO"], agents=24, unfinished=lambda _, __, agent: agent % 2
    )
    assert found(claim_of(results), "final psi").estimate.n == 12


def test_two_agents_have_no_claim(study):
    assert claim_of(study(learns, falls, algorithms=["PPO"], agents=2)) is None


def test_four_agents_can_decide_nothing_about_three_tasks(study):
    claim = claim_of(study(learns, falls, algorithms=["PPO"], tasks=TASKS, agents=4))
    assert claim.verdict == "undecided"
    assert found(claim, "final psi").estimate.mean == pytest.approx(-1.0)


def test_changes_over_training_are_reported_and_not_judged(study):
    """psi falls while reward rises, in all agents alike: nothing that differs between agents."""
    wave = np.sin(np.arange(40.0))
    results = study(
        lambda _, __, agent: 10.0 * RISING + wave * (1 + 0.01 * agent),
        lambda _, __, agent: 30.0 - 10.0 * RISING - wave,
        algorithms=["PPO"],
    )
    claim = claim_of(results)
    finding = found(claim, "over training")
    assert finding.estimate.mean == pytest.approx(-1.0)
    assert finding.verdict == "reported"
    assert finding.p == pytest.approx(2 / 1024)
    assert finding.estimate.n == 10
    assert claim.verdict == "undecided"  # psi is the same for all


def test_settings_that_share_an_agent_count_it_once_over_training(study):
    results = study(learns, lambda *_: RISING**2, algorithms=["PPO", "TRPO"])
    assert found(claim_of(results), "over training").estimate.n <= 10


def test_a_failed_agent_has_the_worst_score_and_is_counted(study):
    """Agent 9 is best until it fails, with the largest psi of all."""
    results = study(
        learns, lambda *key: 12.0 - key[2] if key[2] < 9 else 50.0, algorithms=["PPO"],
        diverged=lambda *key: key[2] == 9,
    )  # fmt: skip
    claim = claim_of(results)
    finding = found(claim, "final psi")
    assert (claim.failed, finding.failed, finding.estimate.n) == (1, 1, 10)
    psi = [12.0 - agent for agent in range(9)] + [50.0]
    scores = [*range(9), 0]
    assert finding.estimate.mean == pytest.approx(stats.spearmanr(psi, scores).statistic)
    assert claim.without_failed == finding.without_failed == "supported"


def test_means_of_settings_are_there_to_be_drawn(study):
    results = study(lambda _, name, __: 1.0 * len(name), lambda *key: 2.0 * key[2],
                    algorithms=["TRPO", "PPO", "PPO reg"], updates=4)  # fmt: skip
    means = setting_means(agent_table(results)).set_index("algorithm")
    assert list(means.index) == ["TRPO", "PPO"]  # as the suite has them
    assert means["reward"].to_dict() == {"PPO": 3.0, "TRPO": 4.0}
    assert means.loc["PPO", "psi"] == 9.0


def test_a_task_has_its_own_failures(study):
    claim = claim_of(
        study(
            learns, falls, algorithms=["PPO", "TRPO"], tasks=("Hopper", "Ant"),
            diverged=lambda task, _, agent: (task, agent) == ("Ant", 2),
        )
    )  # fmt: skip
    for about in ("final psi", "early psi", "over training"):
        failed = [found(claim, about, task).failed for task in ("all", "Hopper", "Ant")]
        assert failed == [2, 0, 2]


def test_three_agents_are_enough_for_a_correlation_and_two_are_not(study):
    def three(task, _, agent):
        return None if agent >= {"Hopper": 3, "Ant": 2}[task] else agent + RISING

    claim = claim_of(study(three, falls, algorithms=["PPO"], tasks=("Hopper", "Ant")))
    assert {f.task for f in claim.findings if "final psi" in f.about} == {"all", "Hopper"}
    assert found(claim, "final psi").estimate.n == 3
