"""Claims: numbers with known answers, and the verdicts that they allow."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from harness.report.claims import (
    MIN_UPDATES,
    Claim,
    Finding,
    agent_table,
    agreed,
    make_claims,
    most_of,
    paired_differences,
    to_frame,
)
from harness.report.results import load_results
from tests.harness.conftest import write_run

UNTOLD = "too few runs to tell"
TASKS = ("Hopper", "Ant", "Reacher")
RISING = np.linspace(0.0, 1.0, MIN_UPDATES)


def claim_of(results, letter: str) -> Claim | None:
    return next((c for c in make_claims(results) if c.letter == letter), None)


def found(claim: Claim, about: str, task: str = "all") -> Finding:
    (finding,) = [f for f in claim.findings if about in f.about and f.task == task]
    return finding


def noise(agent: int) -> float:
    """A little, the same for each agent, and 0 on average over ten."""
    return 0.01 * (agent % 10 - 4.5)


# --- the table of agents --------------------------------------------------------------------------


def test_an_agent_is_a_row_with_its_early_and_late_numbers(store, suite):
    spec = suite.runs[1]
    psi = np.arange(200.0)
    returns = np.where(np.arange(200) < 100, -5.0, 3.0)
    returns[-50:] = np.nan  # no episode ended
    write_run(store, spec, returns, psi)
    (row,) = agent_table(load_results(suite, store)).to_dict("records")
    assert (row["environment"], row["algorithm"]) == ("Hopper", "PPO")
    assert (row["seed"], row["agent"], row["updates"]) == (1, 1, 200)
    assert row["reward"] == 3.0
    assert row["psi"] == np.arange(100, 200).mean()
    assert row["early_psi"] == np.arange(20).mean()  # a tenth
    expected = stats.spearmanr(psi[:150], returns[:150]).statistic
    assert row["together"] == pytest.approx(expected)


def test_the_first_update_is_early_however_few_there_are(store, suite):
    write_run(store, suite.runs[0], [1.0, 2.0, 3.0], [7.0, 8.0, 9.0])
    assert agent_table(load_results(suite, store))["early_psi"].tolist() == [7.0]


@pytest.mark.parametrize("returns", [[1.0, 2.0], [1.0, np.nan, 2.0], [4.0, 4.0, 4.0, 4.0]])
def test_too_little_or_nothing_moved_together(store, suite, returns):
    write_run(store, suite.runs[0], returns, np.arange(len(returns)) + 1.0)
    assert agent_table(load_results(suite, store))["together"].isna().all()


def test_plain_agents_have_neither_penalty_nor_noise(study):
    algorithms = ("PPO", "PPO reg", "TRPO", "TRPO reg", "PPO setting 2", "PPO noise")
    agents = agent_table(study(lambda *_: 1.0, algorithms=algorithms, agents=2, updates=2))
    plain = agents.groupby("algorithm")["plain"].first()
    assert set(plain[plain].index) == {"PPO", "TRPO", "PPO setting 2"}


def test_no_runs_are_an_empty_table_and_leave_the_claim_open(store, suite):
    results = load_results(suite, store)
    agents = agent_table(results)
    assert len(agents) == 0
    assert {"environment", "algorithm", "plain", "reward", "psi", "early_psi"} <= set(agents)
    assert [(c.letter, c.verdict) for c in make_claims(results)] == [("a", UNTOLD)]


# --- claim (a): psi and reward --------------------------------------------------------------------


def falls(_task, _algorithm, agent):
    """Better agents are better conditioned from the first, and psi falls as they learn."""
    return 12.0 - agent - RISING


def rises(_task, _algorithm, agent):
    return agent + RISING


def learns(_task, _algorithm, agent):
    return agent + RISING


def test_claim_a_is_supported_where_psi_falls_as_reward_rises(study):
    claim = claim_of(study(learns, falls, algorithms=["PPO"], tasks=TASKS), "a")
    assert claim.verdict == "supported"
    for about in ("final psi", "early psi", "over training"):
        np.testing.assert_allclose(found(claim, about).estimate, (-1, -1, -1, 30))
        assert found(claim, about, "Ant").estimate.n == 10
        assert found(claim, about, "Ant").verdict == "supported"


def test_claim_a_is_contradicted_where_psi_rises_with_reward(study):
    claim = claim_of(study(learns, rises, algorithms=["PPO"], tasks=TASKS), "a")
    assert claim.verdict == "contradicted"
    assert {f.verdict for f in claim.findings} == {"contradicted"}


def test_claim_a_is_not_supported_where_its_parts_disagree(study):
    """Better agents are better conditioned, but psi rises as each of them learns."""
    results = study(learns, lambda *key: 12.0 - key[2] + RISING, algorithms=["PPO"])
    claim = claim_of(results, "a")
    assert found(claim, "final psi").verdict == "supported"
    assert found(claim, "over training").verdict == "contradicted"
    assert claim.verdict == "not supported"


def test_claim_a_is_not_supported_where_psi_and_reward_have_nothing_to_do_with_each_other(study):
    order = [5, 1, 8, 3, 7, 2, 9, 4, 0, 6]
    results = study(learns, lambda *key: order[key[2]] + RISING[::-1], algorithms=["PPO"])
    finding = found(claim_of(results, "a"), "final psi")
    assert finding.estimate.mean == pytest.approx(stats.spearmanr(range(10), order).statistic)
    assert abs(finding.estimate.mean) < 0.2
    assert finding.verdict == "not supported"


def test_the_correlation_over_agents_by_hand(study):
    """Neighbours change places: d = 1 ten times, so 1 - 6 * 10 / (10 * 99)."""
    results = study(learns, lambda *key: (key[2] ^ 1) + RISING, algorithms=["PPO"])
    estimate = found(claim_of(results, "a"), "final psi").estimate
    assert estimate.mean == pytest.approx(1 - 60 / 990)
    assert estimate.low < estimate.mean < estimate.high


def test_early_psi_is_not_late_psi(study):
    """In the first tenth the better agents are worse conditioned; from then on better."""
    early = np.arange(MIN_UPDATES) < MIN_UPDATES / 10

    def psi(_task, _algorithm, agent):
        return np.where(early, agent, 100.0 - 10 * agent)

    claim = claim_of(study(learns, psi, algorithms=["PPO"]), "a")
    assert found(claim, "early psi").verdict == "contradicted"
    assert found(claim, "final psi").verdict == "supported"


@pytest.mark.parametrize("other", ["PPO reg", "PPO noise"])
def test_regularized_agents_do_not_count_in_claim_a(study, other):
    def psi(task, algorithm, agent):
        return (falls if algorithm == "PPO" else rises)(task, algorithm, agent)

    claim = claim_of(study(learns, psi, algorithms=["PPO", other]), "a")
    assert claim.verdict == "supported"
    assert {f.estimate.n for f in claim.findings} == {10}


def test_plain_agents_of_every_setting_count_in_claim_a(study):
    algorithms = ["PPO", "PPO setting 2", "TRPO"]
    claim = claim_of(study(learns, falls, algorithms=algorithms), "a")
    assert {f.estimate.n for f in claim.findings} == {30}


def test_tasks_of_different_scale_are_ranked_apart(study):
    """Hopper has more reward and more psi than Ant; within each psi falls with reward."""
    scale = {"Hopper": 1000.0, "Ant": 1.0}
    results = study(
        lambda task, _, agent: scale[task] * (agent + RISING),
        lambda task, _, agent: scale[task] * (12 - agent - RISING),
        algorithms=["PPO"], tasks=tuple(scale),
    )  # fmt: skip
    assert found(claim_of(results, "a"), "final psi").estimate.mean == pytest.approx(-1)


# --- claims (b) and (c): paired differences -------------------------------------------------------


def shifted(by: dict[str, float], better: str = "PPO reg"):
    """Rewards that differ much between agents and a little, by task, between algorithms."""

    def reward(task, algorithm, agent):
        gain = by[task] + noise(agent) if algorithm == better else 0.0
        return 100.0 * (agent % 10) + gain

    return reward


UP, DOWN, EVEN = 1.0, -1.0, 0.0


@pytest.mark.parametrize(
    ("gains", "word"),
    [
        ((UP, UP, UP), "supported"),
        ((UP, UP, DOWN), "supported"),
        ((UP, DOWN, DOWN), "contradicted"),
        ((UP, EVEN, DOWN), "not supported"),
        ((UP, EVEN, EVEN), "not supported"),
        ((EVEN, EVEN, EVEN), "not supported"),
    ],
)
def test_claim_b_is_on_most_of_the_tasks(study, gains, word):
    claim = claim_of(study(shifted(dict(zip(TASKS, gains, strict=True))), tasks=TASKS), "b")
    assert claim.verdict == word
    words = {UP: "supported", EVEN: "not supported", DOWN: "contradicted"}
    for task, gain in zip(TASKS, gains, strict=True):
        finding = found(claim, "PPO reg - PPO: reward", task)
        assert finding.verdict == words[gain]
        assert finding.estimate.mean == pytest.approx(gain)
        assert finding.estimate.n == 10


def test_a_win_on_half_of_the_tasks_is_not_on_most(study):
    tasks = (*TASKS, "Walker2D")
    gains = dict(zip(tasks, (UP, UP, EVEN, EVEN), strict=True))
    assert claim_of(study(shifted(gains), tasks=tasks), "b").verdict == "not supported"


def test_pairs_show_what_means_do_not(study):
    """The gain of 1 is far below the spread of 287 between agents."""
    claim = claim_of(study(shifted({"Hopper": UP})), "b")
    low, high = found(claim, "reward", "Hopper").estimate[1:3]
    assert (low, high) == pytest.approx((1.0, 1.0), abs=0.03)


def test_pairs_are_of_one_task_seed_and_agent(store, suite):
    """PPO reg gains 10 on Hopper and loses 1 on Reacher; one agent of each lacks its partner."""
    for spec in suite.runs:
        seed, agent = spec.args["seed"], spec.args["agent"]
        base = 1000.0 * seed + 100.0 * agent
        gain = {"Hopper": 10.0, "Reacher": -1.0}[spec.environment]
        if spec.run_id in ("ppo__Hopper__s2__a0", "ppo-reg__Reacher__s1__a1"):
            continue
        write_run(store, spec, [base + (gain if spec.algorithm == "PPO reg" else 0.0)])
    agents = agent_table(load_results(suite, store))
    differences = paired_differences(agents, "PPO", "PPO reg")
    assert list(differences) == ["Hopper", "Reacher"]
    assert list(differences["Hopper"].index) == [(1, 0), (1, 1), (2, 1)]
    assert list(differences["Reacher"].index) == [(1, 0), (2, 0), (2, 1)]
    assert differences["Hopper"]["raw"].tolist() == [10.0] * 3
    assert differences["Reacher"]["raw"].tolist() == [-1.0] * 3
    shuffled = agents.sample(frac=1, random_state=0)
    assert paired_differences(shuffled, "PPO", "PPO reg")["Hopper"]["raw"].tolist() == [10.0] * 3


def test_an_agent_whose_partner_has_no_episode_is_dropped(study):
    def reward(_task, algorithm, agent):
        return np.nan if (algorithm, agent) == ("PPO", 3) else 1.0 * agent

    differences = paired_differences(agent_table(study(reward, updates=2)), "PPO", "PPO reg")
    assert len(differences["Hopper"]) == 9


def test_standard_differences_are_in_deviations_of_both_algorithms(study):
    results = study(lambda _, name, agent: agent + (2.0 if name == "PPO reg" else 0.0), updates=2)
    differences = paired_differences(agent_table(results), "PPO", "PPO reg")["Hopper"]
    deviation = np.std([*range(10), *range(2, 12)])
    np.testing.assert_allclose(differences["standard"], 2.0 / deviation)


def test_equal_rewards_are_no_difference(study):
    claim = claim_of(study(lambda *_: 5.0), "b")
    assert found(claim, "reward", "Hopper").estimate == (0.0, 0.0, 0.0, 10)
    assert found(claim, "interquartile").estimate == (0.0, 0.0, 0.0, 10)
    assert found(claim, "probability").estimate == (0.5, 0.5, 0.5, 10)
    assert {f.verdict for f in claim.findings} == {claim.verdict} == {"not supported"}


def test_a_tie_is_half_an_improvement(study):
    gains = [1.0] * 6 + [0.0] * 2 + [-1.0] * 2
    results = study(lambda _, name, agent: gains[agent] if name == "PPO reg" else 0.0)
    finding = found(claim_of(results, "b"), "probability")
    assert finding.estimate.mean == pytest.approx(0.7)
    assert finding.verdict == "not supported"  # 7 of 10 may be chance


@pytest.mark.parametrize(("gain", "word"), [(UP, "supported"), (DOWN, "contradicted")])
def test_the_probability_of_improvement_is_judged_from_one_half(study, gain, word):
    """9 pairs in 10 go one way."""
    results = study(lambda _, name, agent: (gain if agent else -gain) if name == "PPO reg" else 0.0)
    finding = found(claim_of(results, "b"), "probability")
    assert finding.estimate.mean == pytest.approx(0.9 if gain > 0 else 0.1)
    assert finding.verdict == word


def test_one_wild_task_does_not_move_the_interquartile_mean(study):
    """On three tasks the gain is 1 against a spread of 3; on the fourth it is a million."""
    tasks = (*TASKS, "Walker2D")
    gains = dict.fromkeys(TASKS, 1.0) | {"Walker2D": 1e6}

    def reward(task, algorithm, agent):
        return agent + (gains[task] if algorithm == "PPO reg" else 0.0)

    claim = claim_of(study(reward, tasks=tasks), "b")
    expected = 1.0 / np.std([*range(10), *range(1, 11)])
    assert found(claim, "interquartile").estimate.mean == pytest.approx(expected)
    assert found(claim, "interquartile").estimate.n == 40


def test_claim_b_needs_both_pairs_of_algorithms_to_agree(study):
    algorithms = ("PPO", "PPO reg", "TRPO", "TRPO reg")

    def reward(ppo_gain, trpo_gain):
        gains = {"PPO reg": ppo_gain, "TRPO reg": trpo_gain}
        return lambda _, name, agent: 100.0 * agent + gains.get(name, 0.0)

    assert claim_of(study(reward(UP, UP), algorithms=algorithms), "b").verdict == "supported"
    claim = claim_of(study(reward(UP, DOWN), algorithms=algorithms), "b")
    assert claim.verdict == "not supported"
    assert found(claim, "TRPO reg - TRPO: reward", "Hopper").verdict == "contradicted"


@pytest.mark.parametrize(("gain", "word"), [(UP, "supported"), (DOWN, "contradicted")])
def test_claim_c_is_trpo_against_ppo(study, gain, word):
    results = study(shifted({"Hopper": gain}, better="TRPO"), algorithms=("PPO", "TRPO"))
    claim = claim_of(results, "c")
    assert claim.verdict == word
    finding = found(claim, "TRPO - PPO: reward", "Hopper")
    assert finding.estimate.mean == pytest.approx(gain)
    assert claim_of(results, "b") is None


def test_claims_b_and_c_are_not_there_without_their_algorithms(study):
    assert [c.letter for c in make_claims(study(learns, algorithms=["PPO"]))] == ["a"]
    assert [c.letter for c in make_claims(study(learns))] == ["a", "b"]


# --- how much it takes to say anything ------------------------------------------------------------


def test_few_agents_tell_nothing(study):
    claims = make_claims(study(shifted(dict.fromkeys(TASKS, UP)), falls, tasks=TASKS, agents=8))
    assert [c.verdict for c in claims] == [UNTOLD, UNTOLD]
    assert found(claims[1], "reward", "Ant").verdict == UNTOLD
    assert found(claims[1], "reward", "Ant").estimate.low > 0  # though the interval is shown


def test_two_agents_on_each_of_many_tasks_are_few(study):
    """Resampling within groups of two makes intervals far too narrow: 1 in 5 misses."""
    tasks = [f"task {i}" for i in range(8)]
    claim = claim_of(study(shifted(dict.fromkeys(tasks, UP)), tasks=tasks, agents=2), "b")
    assert found(claim, "interquartile").estimate.n == 16
    assert found(claim, "interquartile").verdict == UNTOLD
    assert claim.verdict == UNTOLD


def test_short_runs_have_no_verdict(study):
    results = study(shifted({"Hopper": UP}), updates=MIN_UPDATES - 1)
    claims = make_claims(results)
    assert {c.letter for c in claims} == {"a", "b"}
    assert {f.verdict for c in claims for f in c.findings} == {UNTOLD}
    assert {c.verdict for c in claims} == {UNTOLD}
    assert found(claims[1], "reward", "Hopper").estimate.low > 0  # though the numbers are there


def test_runs_that_still_learn_are_not_matched_with_finished_ones(study):
    """PPO reg is at an early update of its runs, and no worse than PPO was there."""

    def reward(_task, algorithm, agent):
        return agent + (100.0 if algorithm == "PPO" else 0.0)

    results = study(reward, unfinished=lambda _, algorithm, __: algorithm == "PPO reg")
    claim = claim_of(results, "b")
    assert claim is None or claim.verdict == UNTOLD


def test_unfinished_agents_are_left_out_of_the_claims(study):
    results = study(
        shifted({"Hopper": UP}), falls, agents=24, unfinished=lambda _, __, agent: agent % 2
    )
    claims = make_claims(results)
    assert found(claims[0], "final psi").estimate.n == 12
    assert found(claims[1], "reward", "Hopper").estimate.n == 12


@pytest.mark.parametrize("missing", TASKS)
def test_most_of_the_tasks_are_not_the_tasks_that_have_been_run(study, missing):
    win = shifted(dict.fromkeys(TASKS, UP))
    claim = claim_of(study(lambda *key: None if key[0] == missing else win(*key), tasks=TASKS), "b")
    assert claim.verdict == UNTOLD


def test_a_pair_of_algorithms_that_has_not_run_leaves_the_claim_open(study):
    win = shifted({"Hopper": UP})
    results = study(
        lambda *key: None if "TRPO" in key[1] else win(*key),
        algorithms=("PPO", "PPO reg", "TRPO", "TRPO reg"),
    )
    assert claim_of(results, "b").verdict == UNTOLD
    assert found(claim_of(results, "b"), "PPO reg - PPO: reward", "Hopper").verdict == "supported"


@pytest.mark.parametrize(
    ("words", "most", "all_of_them"),
    [
        ("s", "supported", "supported"),
        ("ssc", "supported", "not supported"),
        ("sscc", "not supported", "not supported"),
        ("ccn", "contradicted", "not supported"),
        ("snn", "not supported", "not supported"),
        ("nn", "not supported", "not supported"),
        ("cc", "contradicted", "contradicted"),
        ("sst", UNTOLD, UNTOLD),
    ],
)
def test_verdicts_are_put_together(words, most, all_of_them):
    meaning = {"s": "supported", "c": "contradicted", "n": "not supported", "t": UNTOLD}
    for ordered in itertools.permutations(words):
        verdicts = [meaning[word] for word in ordered]
        assert most_of(verdicts) == most
        assert agreed(verdicts) == all_of_them


def test_nothing_found_is_too_few_to_agree():
    assert agreed([]) == UNTOLD


def test_the_frame_has_a_row_for_each_finding(study):
    claims = make_claims(study(shifted({"Hopper": UP}), falls))
    frame = to_frame(claims)
    assert len(frame) == sum(len(c.findings) for c in claims)
    assert frame["claim"].value_counts().to_dict() == {c.letter: len(c.findings) for c in claims}
    row = frame[(frame["claim"] == "b") & (frame["task"] == "Hopper")].iloc[0]
    finding = found(claims[1], "reward", "Hopper")
    assert tuple(row[["mean", "low", "high", "n"]]) == tuple(finding.estimate)
    assert (row["about"], row["verdict"]) == (finding.about, "supported")
