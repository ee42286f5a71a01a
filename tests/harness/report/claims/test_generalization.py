"""Claim (d), from episodes with known rates."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from harness.report.claims import generalization, generalization_claim
from harness.report.results import load_results
from harness.schema import SUITES
from harness.statistics import compare_success
from harness.suite import load_suite
from tests.harness.conftest import make_episodes, write_run
from tests.harness.report.conftest import make_games

PLAIN = [[1, 0], [0, 0]]  # 1/4
BETTER, WORSE = [[1, 1], [0, 0]], [[0, 0], [0, 0]]  # 1/2, 0


def episodes(seen, unseen, greedy=((1,), (0,))):
    return make_episodes(
        seen_sampled=seen, unseen_sampled=unseen, seen_greedy=greedy, unseen_greedy=greedy
    )


def both_levels(rate: int) -> list[list[int]]:
    """4 levels of 4 repeats, each won `rate` times of 4."""
    return [[1] * rate + [0] * (4 - rate)] * 4


def claim_of(store, reg, seeds=10, plain=lambda _: 1, leave_out=(), lost=lambda *_: False):
    """Agents win `plain(seed)` of 4 repeats on each level, and `reg(seed)` with the penalty.

    Those that `lost(algorithm, seed)` names have failed, and were evaluated all the same.
    """
    suite = load_suite("table2", seeds=seeds)
    for run in suite.runs:
        seed = run.args["seed"]
        if (run.algorithm, seed) in leave_out:
            continue
        rates = reg(seed) if run.algorithm.endswith(" reg") else plain(seed)
        seen, unseen = rates if isinstance(rates, tuple) else (rates, rates)
        write_run(
            store, run, [0.0], episodes=episodes(both_levels(seen), both_levels(unseen)),
            diverged=lost(run.algorithm, seed),
        )  # fmt: skip
    return generalization_claim(load_results(suite, store))


def gain(seed: int) -> int:
    """2 or 3 of 4, where the plain agents have 1."""
    return 2 + seed % 2


@pytest.mark.parametrize(
    ("reg", "expected", "gains"),
    [
        (gain, "supported", (0.375, 0.375)),
        (lambda seed: 0, "contradicted", (-0.25, -0.25)),
        (lambda seed: 1, "undecided", (0.0, 0.0)),
        (lambda seed: (gain(seed), 1), "undecided", (0.375, 0.0)),
        (lambda seed: (gain(seed), 0), "undecided", (0.375, -0.25)),
    ],
)
def test_the_verdict_is_where_all_gains_are(store, reg, expected, gains):
    claim = claim_of(store, reg)
    assert (claim.letter, claim.verdict) == ("d", expected)
    assert claim.statement == (
        "The regularizer improves all four CoinRun agents, on seen and on unseen levels."
    )
    assert len(claim.findings) == 4 * 2  # pairs of agents, seen and unseen
    assert [f.estimate.mean for f in claim.findings] == pytest.approx([*gains] * 4)
    assert {f.estimate.n for f in claim.findings} == {10}
    assert {f.note for f in claim.findings} == {"interval over training runs and levels"}
    first, second = claim.findings[:2]
    assert (first.task, first.about) == ("PPO", "reg - plain: success, seen levels")
    assert (second.task, second.about) == ("PPO", "reg - plain: success, unseen levels")


def test_p_is_corrected_over_all_eight_columns(store):
    claim = claim_of(store, lambda seed: (gain(seed), seed % 3), seeds=6)
    p = sorted(f.p for f in claim.findings)
    corrected = sorted(f.p_holm for f in claim.findings)
    assert corrected[0] == pytest.approx(8 * p[0])
    assert corrected[4] == pytest.approx(min(1.0, 4 * p[4]))


@pytest.mark.parametrize(
    ("seeds", "word"), [(1, "one training run"), (2, "2 training runs"), (4, "4 training runs")]
)
def test_below_five_training_runs_the_verdict_says_how_many(store, seeds, word):
    claim = claim_of(store, gain, seeds=seeds)
    assert claim.verdict == word
    assert {f.verdict for f in claim.findings} == {word}
    assert {f.note for f in claim.findings} == {"interval over levels only"}
    assert np.isnan([f.p for f in claim.findings]).all()


def test_five_training_runs_have_a_verdict(store):
    claim = claim_of(store, lambda seed: 3 + seed % 2, seeds=5)
    assert claim.verdict == "supported"
    assert {f.note for f in claim.findings} == {"interval over training runs and levels"}


def test_five_equal_gains_decide_nothing(store):
    """Five signs agree, which has a chance of 2 / 32."""
    claim = claim_of(store, lambda _: 4, seeds=5)
    assert claim.verdict == "undecided"
    assert {f.p for f in claim.findings} == {2 / 32}


@pytest.mark.parametrize(("corrected", "word"), [(0.05, "supported"), (0.0501, "undecided")])
def test_a_corrected_p_of_5_percent_is_enough(store, monkeypatch, corrected, word):
    monkeypatch.setattr(generalization, "holm", lambda p: np.full_like(p, corrected))
    assert claim_of(store, gain, seeds=5).verdict == word


def test_without_a_regularized_agent_there_is_nothing_to_say(tmp_path):
    results = make_games(tmp_path, lambda *_: episodes(PLAIN, PLAIN), ["PPO"], {"Maze": "maze"})
    claim = generalization_claim(results)
    assert (claim.verdict, claim.findings) == ("undecided", [])


def test_the_pair_with_the_fewest_runs_speaks_for_all(store):
    missing = [("PPO-D reg", seed) for seed in range(2, 11)]
    assert claim_of(store, gain, leave_out=missing).verdict == "one training run"


def test_a_pair_that_has_not_run_leaves_the_claim_open(store):
    missing = [("PPO-D", seed) for seed in range(1, 11)]
    claim = claim_of(store, gain, leave_out=missing)
    assert claim.verdict == "undecided"
    assert [f.note for f in claim.findings if f.task == "PPO-D"] == ["no pair yet"] * 2


def test_only_seeds_that_both_have_are_compared(store):
    """Seed 3 has no regularized agent, seed 4 no plain one."""
    suite = load_suite("table2", seeds=4)
    rates = {1: PLAIN, 2: PLAIN, 3: BETTER, 4: WORSE}
    for run in suite.runs:
        seed, reg = run.args["seed"], run.algorithm.endswith(" reg")
        if seed != (3 if reg else 4):
            found = BETTER if reg else rates[seed]
            write_run(store, run, [0.0], episodes=episodes(found, found))
    claim = generalization_claim(load_results(suite, store))
    assert {(f.estimate.mean, f.estimate.n) for f in claim.findings} == {(0.25, 2)}


def test_levels_are_paired(store):
    """Gains of 1/2 on every level, however much levels differ: no doubt over levels is left."""
    suite = load_suite("table2")
    hard, easy = [[0, 0], [1, 0]], [[1, 0], [1, 1]]
    for run in suite.runs:
        found = easy if run.algorithm.endswith(" reg") else hard
        write_run(store, run, [0.0], episodes=episodes(found, found))
    claim = generalization_claim(load_results(suite, store))
    assert {f.estimate[:3] for f in claim.findings} == {(0.5, 0.5, 0.5)}


def test_greedy_episodes_do_not_move_the_claim(store):
    suite = load_suite("table2")
    for run in suite.runs:
        greedy = [[run.algorithm.endswith(" reg")]] * 2
        write_run(store, run, [0.0], episodes=episodes(PLAIN, PLAIN, greedy))
    claim = generalization_claim(load_results(suite, store))
    assert {f.estimate.mean for f in claim.findings} == {0.0}


def test_the_basis_is_the_papers_fifty_million_steps(store):
    suite = load_suite("table2")
    for run in suite.runs[:2]:
        write_run(store, run, [0.0, 0.0, 0.0], episodes=episodes(PLAIN, PLAIN))
    claim = generalization_claim(load_results(suite, store))
    assert claim.basis == "at 0.0006% of the paper's length (300 steps)"


def test_a_finding_is_the_test_of_its_column(store):
    """Seen levels are decided; four unseen columns share the level that they pass on."""
    claim = claim_of(store, lambda seed: (gain(seed), seed % 3), seeds=6)
    wins = np.arange(1, 7)
    won = ((2 + wins % 2, 1 / 5), (wins % 3, 1 / 4))
    for finding, (reg, share) in zip(claim.findings[:2], won, strict=True):
        gains = np.repeat((reg - 1)[:, None] / 4, 4, axis=1)
        expected = compare_success(gains, share)
        assert finding.estimate == pytest.approx((*(float(x) for x in expected[:3]), 6))
        assert finding.p == pytest.approx(float(expected.p))
        assert finding.detectable == pytest.approx(float(expected.detectable))


def test_levels_that_one_of_the_runs_lacks_are_left_out(store):
    """Of the plain agents' levels 0 and 1 the regularized ones have played 0."""
    suite = load_suite("table2")
    for run in suite.runs:
        found = [[1, 1]] if run.algorithm.endswith(" reg") else [[0, 1], [0, 0]]
        write_run(store, run, [0.0], episodes=episodes(found, found))
    claim = generalization_claim(load_results(suite, store))
    assert {f.estimate.mean for f in claim.findings} == {0.5}


def test_failures_are_counted_for_each_pair_of_agents(store):
    suite = load_suite("table2", seeds=2)
    lost = {("PPO", 1), ("PPO reg", 1), ("PPO reg", 2), ("PPO-IMP", 2)}
    for run in suite.runs:
        write_run(
            store, run, [0.0], episodes=episodes(PLAIN, PLAIN),
            diverged=(run.algorithm, run.args["seed"]) in lost,
        )  # fmt: skip
    claim = generalization_claim(load_results(suite, store))
    failed = {f.task: f.failed for f in claim.findings if f.note != "no pair yet"}
    expected = {"PPO": 3, "PPO-l2": 0, "PPO-D": 0, "PPO-IMP": 1}
    assert failed == {task: expected[task] for task in failed}
    assert {"PPO-l2", "PPO-IMP"} <= set(failed)


def test_a_failed_run_has_the_rates_of_the_worst_single_run(store):
    """The worst run of all is a plain one of seed 7 with no success; PPO reg fails with seed 3.

    In quarters: 3 - 1 for seeds 1, 5 and 9, 3 - 0 for 7, 2 - 1 for even ones, and 0 - 1 for 3.
    """
    claim = claim_of(
        store, gain, plain=lambda seed: 0 if seed == 7 else 1,
        lost=lambda name, seed: (name, seed) == ("PPO reg", 3),
    )  # fmt: skip
    first, second = claim.findings[0], claim.findings[2]
    assert first.estimate.mean == pytest.approx((3 * 2 + 3 + 5 - 1) / 10 / 4)
    assert second.estimate.mean == pytest.approx((4 * 2 + 3 + 5) / 10 / 4)  # PPO-l2's are whole
    assert [(f.failed, f.estimate.n) for f in (first, second)] == [(1, 10), (0, 10)]
    assert claim.failed == 1


def test_a_failed_run_that_was_not_evaluated_counts_too(store):
    suite = load_suite("table2", seeds=2)
    for run in suite.runs:
        lost = (run.algorithm, run.args["seed"]) == ("PPO", 2)
        found = None if lost else episodes(BETTER, BETTER)
        write_run(store, run, [0.0], episodes=found, diverged=lost)
    claim = generalization_claim(load_results(suite, store))
    assert (claim.findings[0].estimate.n, claim.findings[0].estimate.mean) == (2, 0.0)
    assert claim.failed == 1


def test_every_verdict_is_also_given_without_the_failed_runs(store):
    """The regularized agents win wherever they do not fail, and half of them fail."""
    claim = claim_of(
        store, lambda seed: 2 + seed % 4 // 2,
        lost=lambda name, seed: name.endswith(" reg") and seed % 2 == 1,
    )  # fmt: skip
    assert (claim.verdict, claim.without_failed) == ("undecided", "supported")
    assert {f.without_failed for f in claim.findings} == {"supported"}
    assert claim.failed == 4 * 5


def test_without_failures_there_is_no_second_verdict(store):
    claim = claim_of(store, gain)
    assert (claim.failed, claim.without_failed) == (0, "")
    assert {f.without_failed for f in claim.findings} == {""}


def test_runs_that_all_failed_are_equal(store):
    claim = claim_of(store, gain, seeds=6, lost=lambda *_: True)
    assert claim.verdict == "undecided"
    assert {(f.estimate.mean, f.p, f.failed) for f in claim.findings} == {(0.0, 1.0, 12)}
    assert {f.without_failed for f in claim.findings} == {"undecided"}


def test_agents_of_two_games_are_apart(store, tmp_path):
    path = tmp_path / "games.toml"
    text = (SUITES / "table2.toml").read_text()
    assert 'CoinRun = "coinrun"' in text
    path.write_text(text.replace('CoinRun = "coinrun"', 'CoinRun = "coinrun"\nMaze = "maze"'))
    suite = load_suite(str(path))
    for run in suite.runs:
        won = BETTER if (run.environment, run.algorithm) == ("Maze", "PPO-D reg") else PLAIN
        write_run(store, run, [0.0], episodes=episodes(won, won))
    claim = generalization_claim(load_results(suite, store))
    gains = {f.task: f.estimate.mean for f in claim.findings}
    assert len(claim.findings) == 2 * 4 * 2
    assert {task for task, mean in gains.items() if mean} == {"Maze: PPO-D"}


def test_unseen_themes_are_a_column_of_the_claim(store):
    """PPO is right in a half of the levels with all themes, PPO reg in three of four."""
    suite = load_suite("themes", seeds=1)
    for run in suite.runs:
        won = [[1, 1], [1, 0]] if run.algorithm == "PPO reg" else [[1, 0], [0, 1]]
        found = [episodes(PLAIN, PLAIN), make_episodes(themes_sampled=won)]
        write_run(store, run, [1.0], episodes=pd.concat(found))
    claim = generalization_claim(load_results(suite, store))
    assert {f.about: f.estimate.mean for f in claim.findings} == {
        "reg - plain: success, seen levels": 0.0,
        "reg - plain: success, unseen levels": 0.0,
        "reg - plain: success, themes levels": 0.25,
    }
