"""Success rates over levels: by hand, by resampling, and how often intervals hold the truth."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from harness.statistics import MIN_TRAINING_RUNS, compare_success, estimate_success, success_matrix
from tests.harness.conftest import make_episodes


def test_successes_stand_at_their_level_and_repeat():
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    episodes = make_episodes(seen_sampled=matrix)
    np.testing.assert_array_equal(success_matrix(episodes), matrix)
    np.testing.assert_array_equal(success_matrix(episodes.sample(frac=1, random_state=1)), matrix)


def test_an_episode_that_counts_twice_is_refused():
    episodes = make_episodes(seen_sampled=[[1.0, 0.0]])
    with pytest.raises(ValueError, match="duplicate"):
        success_matrix(pd.concat([episodes, episodes]))


@pytest.mark.parametrize(
    ("agents", "mean"),
    [
        ([[[1, 1, 0, 0], [1, 0, 0, 0]]], (0.5 + 0.25) / 2),
        ([[[1], [0], [0], [0]]], 0.25),
        ([[[1, 1], [1, 1]], [[0, 0], [0, 1]]], (1 + 0.25) / 2),
        ([[[1, 0]], [[1, 1]], [[0, 0]]], 0.5),
    ],
)
def test_the_success_rate_by_hand(agents, mean):
    estimate = estimate_success([np.array(matrix, float) for matrix in agents])
    assert estimate.mean == pytest.approx(mean)
    assert estimate.n == len(agents)


def test_no_agent_has_no_success_rate():
    np.testing.assert_equal(estimate_success([]), (np.nan, np.nan, np.nan, 0))


@pytest.mark.parametrize("agents", [1, 3, 6])
@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_levels_that_are_all_alike_and_sure_leave_no_doubt(agents, rate):
    assert estimate_success([np.full((4, 5), rate)] * agents) == (rate, rate, rate, agents)


def test_levels_are_not_repeats():
    """3 levels of 40 repeats, not 40 levels of 3: the levels' means are 1, 0.5 and 0."""
    wins = np.array([[1.0] * 40, [1.0] * 20 + [0.0] * 20, [0.0] * 40])
    mean, low, high, _ = estimate_success([wins])
    reach = stats.t.ppf(0.975, 2) * np.std([1, 0.5, 0], ddof=1) / np.sqrt(3)
    assert mean == pytest.approx(0.5)
    assert (low, high) == (max(0.0, 0.5 - reach), min(1.0, 0.5 + reach))
    many = estimate_success([np.tile(wins, (40, 1))])
    assert many.high - many.low < 0.2


def test_the_noise_of_repeats_counts_once():
    """100 equal levels of 1 repeat: the interval of 100 coins, which is what the levels show."""
    wins = np.tile([1.0, 0.0], 50).reshape(100, 1)
    _, low, high, _ = estimate_success([wins])
    assert (low, high) == pytest.approx((0.5 - 1.98 * 0.0503, 0.5 + 1.98 * 0.0503), abs=0.002)
    # 10 levels, each won in half of 10 repeats: no level differs, so no doubt is left to show
    assert estimate_success([np.tile([1.0, 0.0], (10, 5))])[:3] == (0.5, 0.5, 0.5)


def test_below_five_runs_the_interval_is_over_levels_only():
    """Runs that differ much, levels that do not."""
    sure = [np.full((50, 2), rate) for rate in (0.0, 1.0, 0.0, 1.0)]
    assert estimate_success(sure)[:3] == (0.5, 0.5, 0.5)
    _, low, high, _ = estimate_success([*sure, np.full((50, 2), 0.5)])
    assert low < 0.1
    assert high > 0.9


def test_more_runs_know_of_no_more_levels():
    """20 agents that win the same 50 of 100 levels."""
    wins = np.tile([1.0, 0.0], 50).reshape(100, 1)
    one = estimate_success([wins])
    many = estimate_success([wins] * 20)
    assert (many.low, many.high) == pytest.approx((one.low, one.high), abs=0.02)


def test_the_error_is_what_resampling_runs_then_levels_gives():
    rng = np.random.default_rng(1)
    runs, levels = 12, 40
    rates = 0.2 * rng.normal(size=(runs, 1)) + 0.3 * rng.normal(size=(1, levels))
    rates += 0.1 * rng.normal(size=(runs, levels))
    resampled = [
        rates[rng.integers(runs, size=runs)][:, rng.integers(levels, size=levels)].mean()
        for _ in range(4000)
    ]
    found = compare_success(rates)
    error = (found.high - found.low) / 2 / stats.t.ppf(0.975, runs - 1)
    assert error == pytest.approx(np.std(resampled), rel=0.08)


def test_p_is_students_of_the_runs_where_levels_do_not_differ():
    gains = np.array([0.1, 0.2, -0.05, 0.3, 0.1, 0.15])
    found = compare_success(np.repeat(gains[:, None], 7, axis=1))
    assert found.p == pytest.approx(stats.ttest_1samp(gains, 0).pvalue)
    interval = stats.t.interval(0.95, 5, gains.mean(), stats.sem(gains))
    assert (found.low, found.high) == pytest.approx(interval)


def test_below_five_runs_there_is_no_test():
    rates = np.random.default_rng(2).normal(size=(MIN_TRAINING_RUNS, 10))
    assert np.isfinite([compare_success(rates).p, compare_success(rates).detectable]).all()
    few = compare_success(rates[1:])
    assert np.isnan([few.p, few.detectable]).all()


def test_what_could_have_been_found_by_hand():
    gains = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    found = compare_success(np.repeat(gains[:, None], 3, axis=1), share=1 / 8)
    error = gains.std(ddof=1) / np.sqrt(5)
    expected = (stats.t.ppf(1 - 0.05 / 16, 4) + stats.t.ppf(0.8, 4)) * error
    assert found.detectable == pytest.approx(expected)


def test_no_difference_is_none():
    found = compare_success(np.zeros((6, 4)))
    assert (found.mean, found.low, found.high, found.p) == (0, 0, 0, 1)


@pytest.mark.parametrize("gain", [0.25, -0.1 * 3])
def test_equal_gains_are_as_many_signs_that_agree(gain):
    """Nothing varies, so Student's p would be 0: the sign-flip test's is 2 / 2^n."""
    five = compare_success(np.full((5, 4), gain))
    assert (five.mean, five.p) == (pytest.approx(gain), 2 / 32)
    assert np.isnan([five.low, five.high, five.detectable]).all()
    ten = compare_success(np.full((10, 4), gain), share=1 / 8)
    assert ten.p == 2 / 1024
    assert (ten.low, ten.high, ten.detectable) == pytest.approx((gain, gain, 0.0))


def test_rounding_is_no_gain():
    noise = 1e-17 * np.array([1.0, -1.0, 3.0, 1.0, 2.0, 1.0])
    found = compare_success(np.repeat(noise[:, None], 3, axis=1))
    assert found.p == 1.0


def test_only_data_sets_that_do_not_vary_are_flipped():
    varied = np.random.default_rng(4).normal(0.3, size=(6, 4))
    both = compare_success(np.stack([varied, np.full((6, 4), 0.3)]))
    alone = compare_success(varied)
    np.testing.assert_allclose([values[0] for values in both], alone)
    assert both.p[1] == 2 / 64


def test_one_level_has_no_interval_over_levels():
    assert np.isnan(compare_success(np.array([[0.5]])).low)
    assert np.isfinite(compare_success(np.arange(5.0)[:, None]).low)


def test_data_sets_do_not_mix():
    many = np.random.default_rng(3).normal(size=(4, 3, 6, 9))
    np.testing.assert_allclose(
        [values[2, 1] for values in compare_success(many)], compare_success(many[2, 1])
    )


def test_the_variance_by_hand():
    """Five runs on two levels: what differs between runs, between levels, and is left."""
    rates = np.array([[0.5, 0.1], [0.7, 0.5], [0.9, 0.7], [0.6, 0.0], [0.8, 0.2]])
    means = [0.3, 0.6, 0.8, 0.3, 0.5]  # of the runs; of the levels 0.7 and 0.3
    # each run's first level less its mean and less 0.2, the level's: the second is its opposite
    left = np.array([0.2, 0.1, 0.1, 0.3, 0.3]) - 0.2
    noise = 2 * (left**2).sum() / ((5 - 1) * (2 - 1))
    variance = np.var(means, ddof=1) / 5 + np.var([0.7, 0.3], ddof=1) / 2 - noise / (5 * 2)
    found = compare_success(rates)
    assert found.mean == pytest.approx(0.5)
    assert found.high - found.mean == pytest.approx(stats.t.ppf(0.975, 4) * np.sqrt(variance))
    assert found.mean - found.low == pytest.approx(found.high - found.mean)
