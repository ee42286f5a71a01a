"""Claims (b) and (c): which agents are paired, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from harness.report.claims import Claim, Finding, agent_table, make_claims
from harness.report.claims.comparison import comparison_claim, make_arms
from harness.report.results import load_results
from tests.harness.conftest import write_run

TASKS = ("Hopper", "Ant", "Reacher")
FOUR = ("PPO", "PPO reg", "TRPO", "TRPO reg")
UP, DOWN, EVEN = 300.0, -300.0, 0.0
SIGNS = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1])


def claim_of(results, letter: str = "b") -> Claim | None:
    return next((c for c in make_claims(results) if c.letter == letter), None)


def found(claim: Claim, about: str, task: str = "all") -> Finding:
    (finding,) = [f for f in claim.findings if about in f.about and f.task == task]
    return finding


def headline(claim: Claim, contrast: str = "PPO reg - PPO") -> Finding:
    return next(f for f in claim.findings if f.about.startswith(contrast) and f.task == "all")


def shifted(by: dict[str, float], better: str = "PPO reg"):
    """Scores of 0 to 900, and a gain by task for one algorithm that a coin disturbs."""

    def reward(task, algorithm, agent):
        gain = by[task] + 5 * (1 + agent % 7) * SIGNS[agent % 10] if algorithm == better else 0.0
        return 100.0 * (agent % 10) + gain

    return reward


def deviation_of_both() -> float:
    """Of the scores of both arms, where PPO reg gains `UP`."""
    plain = [100.0 * i for i in range(10)]
    gained = [100.0 * i + UP + 5 * (1 + i % 7) * SIGNS[i] for i in range(10)]
    return float(np.std(plain + gained, ddof=1))


@pytest.mark.parametrize(
    ("gains", "word", "words"),
    [
        ((UP, UP, UP), "supported", ("win", "win", "win")),
        ((UP, UP, DOWN), "supported", ("win", "win", "loss")),
        ((DOWN, DOWN, DOWN), "contradicted", ("loss", "loss", "loss")),
    ],
)
def test_the_headline_is_the_mean_over_tasks(study, gains, word, words):
    claim = claim_of(study(shifted(dict(zip(TASKS, gains, strict=True))), tasks=TASKS))
    assert (claim.letter, claim.verdict, headline(claim).verdict) == ("b", word, word)
    assert claim.statement == "The regularizer wins on most of the tasks."
    found_words = tuple(found(claim, "PPO reg - PPO: reward", task).verdict for task in TASKS)
    assert found_words == words
    for task, gain in zip(TASKS, gains, strict=True):
        finding = found(claim, "PPO reg - PPO: reward", task)
        assert finding.estimate.mean == pytest.approx(gain, abs=10)
        assert finding.estimate.n == 10
        assert finding.p == pytest.approx(2 / 1024)


def test_the_notes_count_wins_and_losses(study):
    claim = claim_of(study(shifted(dict.fromkeys(TASKS, UP)), tasks=TASKS))
    assert claim.notes[0] == "PPO reg - PPO: 3 wins and 0 losses on 3 tasks, on most tasks."
    losing = claim_of(study(shifted(dict.fromkeys(TASKS, DOWN)), tasks=TASKS))
    assert losing.notes[0] == "PPO reg - PPO: 0 wins and 3 losses on 3 tasks."


def test_the_verdict_names_the_steps_that_it_rests_on(study):
    claim = claim_of(study(shifted({"Hopper": UP})))
    assert claim.basis == "at 0.08% of the paper's length (4,000 steps)"


def test_tasks_within_half_a_deviation_are_no_effect(study):
    """The deviation of the plain arm is 303, and the gains are 35 at most."""
    claim = claim_of(study(shifted(dict.fromkeys(TASKS, EVEN)), tasks=TASKS))
    assert claim.verdict == headline(claim).verdict == "no effect"
    assert {found(claim, "reward", task).verdict for task in TASKS} == {"negligible"}


def test_half_of_the_tasks_within_half_a_deviation_are_not_enough(study):
    gains = {"Hopper": EVEN, "Ant": UP}
    claim = claim_of(study(shifted(gains), tasks=tuple(gains)))
    assert found(claim, "reward", "Hopper").verdict == "negligible"
    assert claim.verdict == "supported"
    assert claim.notes[0] == "PPO reg - PPO: 1 wins and 0 losses on 2 tasks."  # not on most


def test_both_contrasts_must_agree(study):
    def reward(ppo_gain, trpo_gain):
        gains = {"PPO reg": ppo_gain, "TRPO reg": trpo_gain}

        def score(_task, name, agent):
            return 100.0 * agent + gains.get(name, 0.0) * (1 + 0.01 * agent)

        return score

    assert claim_of(study(reward(UP, UP), algorithms=FOUR)).verdict == "supported"
    claim = claim_of(study(reward(UP, DOWN), algorithms=FOUR))
    assert claim.verdict == "undecided"
    assert headline(claim).verdict == "supported"
    assert headline(claim, "TRPO reg - TRPO").verdict == "contradicted"


@pytest.mark.parametrize(("gain", "word"), [(UP, "supported"), (DOWN, "contradicted")])
def test_claim_c_is_trpo_against_ppo(study, gain, word):
    results = study(shifted({"Hopper": gain}, better="TRPO"), algorithms=("PPO", "TRPO"))
    claim = claim_of(results, "c")
    assert (claim.verdict, claim.statement) == (word, "TRPO beats PPO.")
    assert found(claim, "TRPO - PPO: reward", "Hopper").estimate.mean == pytest.approx(gain, abs=10)
    assert claim_of(results, "b") is None


def test_a_claim_is_not_there_without_its_algorithms(study):
    assert [c.letter for c in make_claims(study(lambda *k: k[2], algorithms=["PPO"]))] == ["a"]


# --- pairs ----------------------------------------------------------------------------------------


def test_pairs_are_of_one_task_seed_and_agent(store, suite):
    """PPO reg gains 10 on Hopper and loses 1 on Reacher; one agent of each lacks its partner."""
    for spec in suite.runs:
        base = 1000.0 * spec.args["seed"] + 100.0 * spec.args["agent"]
        gain = {"Hopper": 10.0, "Reacher": -1.0}[spec.environment]
        if spec.run_id in ("ppo__Hopper__s2__a0", "ppo-reg__Reacher__s1__a1"):
            continue
        write_run(store, spec, [base + (gain if spec.algorithm == "PPO reg" else 0.0)])
    agents = agent_table(load_results(suite, store))
    for table in (agents, agents.sample(frac=1, random_state=0)):
        arms = make_arms(table, (("PPO", "PPO reg"),), "reward")
        gains = dict(zip(arms.tasks, (arms.second - arms.first)[0], strict=True))
        np.testing.assert_equal(gains["Hopper"], [10.0, 10.0, np.nan, 10.0])
        np.testing.assert_equal(gains["Reacher"], [-1.0, np.nan, -1.0, -1.0])


def test_pairs_show_what_means_do_not(study):
    """A gain of 20 is far below the spread of 303 between agents, and in every pair."""
    results = study(lambda _, name, agent: 100.0 * agent + (20.0 + agent) * (name == "PPO reg"))
    claim = claim_of(results)
    low, high = found(claim, "reward", "Hopper").estimate[1:3]
    assert 20 <= low < 24.5 < high <= 29


def test_an_agent_without_a_score_has_no_pair(study):
    def reward(_task, algorithm, agent):
        return np.nan if (algorithm, agent) == ("PPO", 3) else 1.0 * agent

    claim = claim_of(study(reward))
    assert found(claim, "reward", "Hopper").estimate.n == 9
    assert "Not yet run" not in claim.notes[0]  # the task has nine pairs


def test_standard_differences_are_in_deviations_of_both_arms(study):
    results = study(lambda _, name, agent: agent + (2.0 if name == "PPO reg" else 0.0))
    deviation = np.std([*range(10), *range(2, 12)], ddof=1)
    finding = found(claim_of(results), "PPO reg - PPO: in standard deviations", "Hopper")
    assert finding.estimate.mean == pytest.approx(2.0 / deviation)
    assert finding.estimate.low == pytest.approx(2.0 / deviation)
    assert headline(claim_of(results)).estimate.mean == pytest.approx(2.0 / deviation)


def test_a_task_in_deviations_is_the_same_finding_in_another_unit(study):
    claim = claim_of(study(shifted(dict.fromkeys(TASKS, UP)), tasks=TASKS))
    for task in TASKS:
        raw = found(claim, "PPO reg - PPO: reward", task)
        standard = found(claim, "PPO reg - PPO: in standard deviations", task)
        scaled = np.array(raw.estimate[:3]) / deviation_of_both()
        assert standard.estimate[:3] == pytest.approx(tuple(scaled))
        assert standard.detectable == pytest.approx(raw.detectable / deviation_of_both())
        for name in ("p", "p_holm", "verdict", "note", "failed"):
            assert getattr(standard, name) == getattr(raw, name)
        assert standard.estimate.n == raw.estimate.n == 10
        assert raw.p < raw.p_holm  # of four tests
    assert headline(claim).p == pytest.approx(2 / 1024)
    # the headline has four fifths of the level, and what it is decided leaves the rest
    assert headline(claim).p_holm == pytest.approx(2 / 1024 / 0.8)


def test_equal_rewards_are_no_difference(study):
    claim = claim_of(study(lambda *_: 5.0))
    assert found(claim, "reward", "Hopper").estimate == (0.0, 0.0, 0.0, 10)
    assert found(claim, "probability").estimate == (0.5, 0.5, 0.5, 10)
    assert claim.verdict == "undecided"


def test_middle_and_chance_stand_beside_without_a_verdict(study):
    results = study(shifted(dict.fromkeys(TASKS, UP)), tasks=TASKS)
    for about in ("interquartile", "probability"):
        finding = found(claim_of(results), about)
        assert finding.verdict == "reported"
        assert finding.estimate.n == 30
        assert np.isnan(finding.p)
    # 900 on top is beaten only by the plain agents above; ten by ten agents meet
    middle = stats.trim_mean(
        np.concatenate(
            [
                np.array([UP + 5 * (1 + i % 7) * SIGNS[i] for i in range(10)]) / deviation_of_both()
                for _ in TASKS
            ]
        ),
        0.25,
    )
    assert found(claim_of(results), "interquartile").estimate.mean == pytest.approx(middle)
    chance = np.mean(
        [
            np.heaviside(100 * i + UP + 5 * (1 + i % 7) * SIGNS[i] - 100 * j, 0.5)
            for i in range(10) for j in range(10)
        ]
    )  # fmt: skip
    assert found(claim_of(results), "probability").estimate.mean == pytest.approx(chance)


# --- failures -------------------------------------------------------------------------------------


def test_a_failed_run_has_the_worst_score_of_the_compared_arms(study):
    """Of PPO reg agent 0 fails; the worst of both arms is PPO's agent 1 with -50."""

    def reward(_task, name, agent):
        return -50.0 if (name, agent) == ("PPO", 1) else 10.0 * agent

    results = study(reward, diverged=lambda _, name, agent: (name, agent) == ("PPO reg", 0))
    claim = claim_of(results)
    finding = found(claim, "reward", "Hopper")
    assert finding.estimate.mean == pytest.approx((-50.0 + 60.0) / 10)
    assert (finding.failed, headline(claim).failed, claim.failed) == (1, 1, 1)
    assert finding.estimate.n == 10


def test_every_verdict_is_also_given_without_the_failed_runs(study):
    """The regularized agents win wherever they do not fail, and half of them fail."""
    results = study(
        lambda _, name, agent: 5.0 * agent + (50.0 + agent) * (name == "PPO reg"),
        agents=20, diverged=lambda _, name, agent: name == "PPO reg" and agent % 2 == 0,
    )  # fmt: skip
    claim = claim_of(results)
    assert claim.verdict == "undecided"
    assert claim.without_failed == "supported"
    assert found(claim, "reward", "Hopper").without_failed == "win"
    assert found(claim, "reward", "Hopper").failed == 10


def test_without_failures_there_is_no_second_verdict(study):
    claim = claim_of(study(shifted({"Hopper": UP})))
    assert claim.without_failed == ""
    assert {f.without_failed for f in claim.findings} == {""}


# --- final policies -------------------------------------------------------------------------------


def test_final_policies_stand_beside_and_do_not_move_the_verdict(study):
    """Training scores win, final policies lose."""
    results = study(
        shifted({"Hopper": UP}),
        final=lambda _, name, agent: 10.0 * agent - (100.0 + agent) * (name == "PPO reg"),
    )
    claim = claim_of(results)
    assert claim.verdict == "supported"
    assert claim.notes == (
        "PPO reg - PPO: 1 wins and 0 losses on 1 tasks, on most tasks.",
        "final policies, PPO reg - PPO: 0 wins and 1 losses on 1 tasks.",
        "By the final policies: contradicted.",
    )
    assert headline(claim, "final policies, PPO reg - PPO").verdict == "contradicted"
    finding = found(claim, "final policies, PPO reg - PPO: reward", "Hopper")
    assert finding.estimate.mean == pytest.approx(-104.5)
    assert headline(claim).p_holm == headline(claim_of(study(shifted({"Hopper": UP})))).p_holm


def test_final_policies_are_judged_where_some_were_evaluated(study):
    final = {agent: 10.0 * agent for agent in range(6)}
    claim = claim_of(study(shifted({"Hopper": UP}), final=lambda *key: final.get(key[2])))
    assert found(claim, "final policies, PPO reg - PPO: reward", "Hopper").estimate.n == 6


def test_final_policies_are_also_judged_without_the_failed_runs(study):
    """Half of the regularized agents fail; the final policies of the others win."""

    def score(_task, name, agent):
        return 5.0 * agent + (50.0 + agent) * (name == "PPO reg")

    results = study(
        score, final=score, agents=20,
        diverged=lambda _, name, agent: name == "PPO reg" and agent % 2 == 0,
    )  # fmt: skip
    claim = claim_of(results)
    finding = found(claim, "final policies, PPO reg - PPO: reward", "Hopper")
    assert (finding.verdict, finding.without_failed) == ("undecided", "win")
    note = "By the final policies: undecided; without the failed runs: supported."
    assert note in claim.notes


def test_no_difference_has_an_interval_in_deviations_too(study):
    claim = claim_of(study(lambda _, name, agent: 10.0 * agent + SIGNS[agent] * (len(name) > 3)))
    finding = found(claim, "PPO reg - PPO: in standard deviations", "Hopper")
    assert finding.estimate.mean == 0.0
    assert finding.estimate.low == pytest.approx(-finding.estimate.high)
    assert finding.estimate.high > 0


# --- how much it takes ----------------------------------------------------------------------------


@pytest.mark.parametrize(("agents", "word"), [(4, "undecided"), (6, "supported")])
def test_six_pairs_can_decide_one_task(study, agents, word):
    claim = claim_of(study(shifted({"Hopper": UP}), agents=agents))
    assert claim.verdict == word
    note = headline(claim).note
    assert note == ("6 pairs could decide" if agents < 6 else "")
    assert np.isnan(headline(claim).detectable) == (agents < 6)


def test_one_pair_is_undecided_and_says_what_it_takes(study):
    results = study(lambda *key: None if key[2] else 1.0 * len(key[1]), agents=2, tasks=TASKS)
    claim = claim_of(results)
    assert claim.verdict == "undecided"
    # a task of three has 5% / 5 / 3, which 2 / 2^10 is below
    assert found(claim, "reward", "Ant").note == "10 pairs could decide"
    assert np.isnan(found(claim, "reward", "Ant").detectable)
    standard = found(claim, "PPO reg - PPO: in standard deviations", "Ant")
    assert standard.note == "10 pairs could decide"


def test_runs_that_still_learn_are_not_matched_with_finished_ones(study):
    results = study(
        lambda _task, algorithm, agent: agent + (100.0 if algorithm == "PPO" else 0.0),
        unfinished=lambda _, algorithm, __: algorithm == "PPO reg",
    )
    assert claim_of(results) is None


@pytest.mark.parametrize("missing", TASKS)
def test_most_of_the_tasks_are_not_the_tasks_that_have_been_run(study, missing):
    win = shifted(dict.fromkeys(TASKS, UP))
    claim = claim_of(study(lambda *key: None if key[0] == missing else win(*key), tasks=TASKS))
    assert claim.verdict == "undecided"
    assert claim.notes[0] == (
        f"PPO reg - PPO: 2 wins and 0 losses on 2 tasks, on most tasks. Not yet run: {missing}."
    )
    reached = {f.task for f in claim.findings}
    assert reached == {"all", *TASKS} - {missing}


def test_a_contrast_that_has_not_run_leaves_the_claim_open(study):
    win = shifted({"Hopper": UP})
    results = study(lambda *key: None if "TRPO" in key[1] else win(*key), algorithms=FOUR)
    claim = claim_of(results)
    assert claim.verdict == "undecided"
    assert headline(claim).verdict == "supported"
    assert "No pairs yet: TRPO reg - TRPO." in claim.notes


def test_two_contrasts_take_a_pair_more_than_one(study):
    results = study(shifted({"Hopper": UP}), algorithms=FOUR, agents=6)
    for contrast in ("PPO reg - PPO", "TRPO reg - TRPO"):
        assert headline(claim_of(results), contrast).note == "7 pairs could decide"
        # one of two tasks has 5% / 5 / 2, which 2 / 2^9 is below
        task = found(claim_of(results), f"{contrast}: reward", "Hopper")
        assert task.note == "9 pairs could decide"


def test_twelve_pairs_could_decide_one_of_sixteen_tasks(study):
    """5% / 5 / 16 = 0.000625 is above 2 / 2^12, and below 2 / 2^11."""
    tasks = tuple("ABCDEFGH")
    results = study(
        lambda _, name, agent: agent + 3.0 * SIGNS[agent] * (name in ("PPO reg", "TRPO reg")),
        algorithms=FOUR, tasks=tasks, agents=2,
    )  # fmt: skip
    claim = claim_of(results)
    for task in tasks:
        finding = found(claim, "TRPO reg - TRPO: reward", task)
        assert finding.note == "12 pairs could decide"
        assert np.isnan(finding.detectable)


def test_a_contrast_of_which_one_arm_has_run_has_no_pair(study):
    win = shifted({"Hopper": UP})
    results = study(lambda *key: None if key[1] == "TRPO" else win(*key), algorithms=FOUR)
    claim = claim_of(results)
    assert claim.notes[-1] == "No pairs yet: TRPO reg - TRPO."
    assert {f.about.partition(":")[0] for f in claim.findings} == {"PPO reg - PPO"}


def test_without_any_pair_a_claim_is_undecided(study):
    win = shifted({"Hopper": UP})
    agents = agent_table(study(lambda *key: None if "reg" in key[1] else win(*key)))
    claim = comparison_claim(agents, "b", set())
    assert (claim.verdict, claim.findings, claim.notes) == ("undecided", [], ())
    assert (claim.failed, claim.without_failed) == (0, "")


PLANNED = {(task, name) for task in TASKS for name in ("PPO", "PPO reg")}


@pytest.mark.parametrize(
    ("planned", "verdict", "ending"),
    [
        (PLANNED - {("Ant", "PPO reg"), ("Reacher", "PPO reg")}, "supported", "on most tasks."),
        (PLANNED - {("Ant", "PPO"), ("Reacher", "PPO reg")}, "supported", "on most tasks."),
        (PLANNED - {("Ant", "PPO")}, "undecided", "Not yet run: Reacher."),
        (PLANNED, "undecided", "Not yet run: Ant, Reacher."),
    ],
)
def test_only_tasks_that_both_arms_plan_are_missing(study, planned, verdict, ending):
    agents = agent_table(study(shifted({"Hopper": UP})))
    claim = comparison_claim(agents, "b", planned)
    assert claim.verdict == verdict
    assert claim.notes[0].endswith(ending)


@pytest.mark.parametrize(
    ("planned", "open_"), [({"TRPO"}, False), ({"TRPO reg"}, False), ({"TRPO", "TRPO reg"}, True)]
)
def test_only_contrasts_that_both_arms_plan_are_open(study, planned, open_):
    agents = agent_table(study(shifted({"Hopper": UP})))
    more = {("Hopper", name) for name in planned}
    claim = comparison_claim(agents, "b", {("Hopper", "PPO"), ("Hopper", "PPO reg")} | more)
    assert ("No pairs yet: TRPO reg - TRPO." in claim.notes) == open_
    assert claim.verdict == ("undecided" if open_ else "supported")


def test_a_contrast_is_open_if_it_is_planned_on_any_task(study):
    agents = agent_table(study(shifted({"Hopper": UP})))
    planned = {("Hopper", name) for name in FOUR} | {("Ant", "TRPO")}
    claim = comparison_claim(agents, "b", planned)
    assert claim.notes[-1] == "No pairs yet: TRPO reg - TRPO."


def test_failures_are_counted_where_they_happened(study):
    """On Ant one agent of PPO and two of PPO reg fail; none of TRPO."""
    lost = {("Ant", "PPO", 1), ("Ant", "PPO reg", 1), ("Ant", "PPO reg", 4)}
    win = shifted({"Hopper": UP, "Ant": UP})
    claim = claim_of(
        study(win, algorithms=FOUR, tasks=("Hopper", "Ant"), diverged=lambda *key: key in lost)
    )
    assert claim.failed == 3
    for about in ("reward", "in standard deviations"):
        failed = [found(claim, f"PPO reg - PPO: {about}", t).failed for t in ("Hopper", "Ant")]
        assert failed == [0, 3]
    for about in ("in standard deviations", "interquartile", "probability"):
        contrasts = ("PPO reg - PPO", "TRPO reg - TRPO")
        assert [found(claim, f"{c}: {about}").failed for c in contrasts] == [3, 0]
