"""Intervals of a mean: by hand, and how often they hold the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.statistics import estimate_mean, half_width, interval_of_means, is_skewed


def test_the_interval_is_that_of_the_normal_distribution_for_many_values():
    values = np.random.default_rng(1).normal(5.0, 2.0, size=400)
    mean, low, high, n = estimate_mean(values)
    error = 1.96 * values.std() / np.sqrt(400)
    assert mean == pytest.approx(values.mean())
    assert (low, high) == pytest.approx((mean - error, mean + error), abs=0.03)
    assert n == 400


@pytest.mark.parametrize("n", [10, 30])
def test_intervals_cover_the_truth_nineteen_times_in_twenty(n):
    rng = np.random.default_rng(2)
    found = [estimate_mean(rng.normal(size=n), skewed=False) for _ in range(300)]
    covered = sum(low <= 0 <= high for _, low, high, _ in found)
    assert 277 <= covered <= 296  # 95% of 300, two standard errors down and three up


def test_skewed_values_have_an_interval_that_leans():
    """The long tail is on the right, so the mean may lie further to the right."""
    values = np.random.default_rng(3).exponential(size=60)
    mean, low, high, _ = estimate_mean(values)
    assert high - mean > 1.2 * (mean - low)


@pytest.mark.parametrize("n", [5, 30])
def test_equal_values_have_no_interval(n):
    """They say nothing of how much others would differ."""
    np.testing.assert_equal(estimate_mean(np.full(n, 3.0)), (3.0, np.nan, np.nan, n))
    rounded = np.full(n, 0.3)
    rounded[0] = 0.1 + 0.2
    assert np.isnan(estimate_mean(rounded).low)


def test_small_differences_of_large_values_have_an_interval():
    offset = estimate_mean(np.arange(10.0) + 2.0**30)
    expected = estimate_mean(np.arange(10.0))
    assert offset.high - 2.0**30 == pytest.approx(expected.high, abs=1e-5)


@pytest.mark.parametrize(
    ("values", "mean"), [([], np.nan), ([4.0], 4.0), ([1.0, 2.0, 6.0, 7.0], 4.0)]
)
def test_fewer_than_five_values_have_no_interval(values, mean):
    estimate = estimate_mean(np.array(values))
    np.testing.assert_equal(estimate, (mean, np.nan, np.nan, len(values)))


def test_few_skewed_values_have_no_interval():
    one_success = np.array([0.0, 0.1, 0.2] * 3 + [50.0])
    assert np.isnan(estimate_mean(one_success).low)
    assert not np.isnan(estimate_mean(one_success, skewed=False).low)
    assert not np.isnan(estimate_mean(np.tile(one_success, 3)).low)  # 30 agents


def test_values_that_look_even_have_none_where_their_task_is_skewed():
    assert np.isnan(estimate_mean(np.arange(10.0), skewed=True).low)


def test_arms_are_judged_together():
    """No success among ten, but some in the other arms: this one may have missed them by chance."""
    without = np.linspace(-1, 1, 10)
    with_one = np.append(without[:-1], 30.0)
    assert not is_skewed([without])
    assert is_skewed([without, with_one])
    assert not is_skewed([without, without + 1000.0])  # arms differ, agents do not
    assert not is_skewed([without, without, without, without + 1000.0])
    assert not is_skewed([np.full(5, 2.0), np.empty(0)])


def test_the_interval_of_symmetric_values_is_students():
    values = np.array([1.0, 2.0, 4.0, 6.0, 7.0])
    _, low, high, _ = estimate_mean(values)
    expected = stats.t.interval(0.95, 4, 4.0, stats.sem(values))
    assert (low, high) == pytest.approx(expected)
    assert estimate_mean(values + 1e-7 * np.array([0, 0, 0, 0, 1.0])).high == pytest.approx(high)


def test_the_ends_solve_halls_equation():
    """T + g T^2 / 3 + g^2 T^3 / 27 + g / 6n is Student's quantile at either end."""
    values = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 5.0, 7.0])
    skewness = stats.skew(values)
    assert 0.5 < skewness < 1.0  # above 1.05 it would be limited
    mean, low, high, _ = estimate_mean(values, skewed=False)
    reach = stats.t.ppf(0.975, 9) / np.sqrt(10)
    for end, quantile in ((low, reach), (high, -reach)):
        t = (mean - end) / values.std(ddof=1)
        found = t + skewness * t**2 / 3 + skewness**2 * t**3 / 27 + skewness / 60
        assert found == pytest.approx(quantile)


def test_one_in_five_leans_up_and_stays_near_its_range():
    """g is 1.5 and limited to 0.75 / (2.776 / sqrt(5)) = 0.604; the deviation is sqrt(0.2).

    At the upper end cbrt(1 - 0.604 * (1.2415 + 0.0201)) = 0.6197, so it is 0.2 + 1.889 * 0.4472.
    """
    _, low, high, _ = estimate_mean(np.array([0.0, 0.0, 0.0, 0.0, 1.0]), skewed=False)
    assert high == pytest.approx(1.045, abs=0.002)
    assert -0.25 < low < 0.0


@pytest.mark.parametrize("low_ones", range(1, 10))
def test_two_values_and_a_grain_of_noise_do_not_break_it(low_ones):
    """Resamples of one value alone made a studentized bootstrap run to -2051 here."""
    values = np.where(np.arange(10) < low_ones, 8455.0, 9350.0) + np.arange(10)
    mean, low, high, _ = estimate_mean(values, skewed=False)
    assert values.min() - 0.3 * np.ptp(values) < low < mean < high
    assert high < values.max() + 0.3 * np.ptp(values)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(-100, 100), min_size=5, max_size=30).filter(lambda x: len(set(x)) > 1))
def test_ends_stay_within_a_third_of_the_range(drawn):
    values = np.array(drawn, dtype=float)
    mean, low, high, _ = estimate_mean(values, skewed=False)
    assert values.min() - np.ptp(values) / 3 < low < mean < high
    assert high < values.max() + np.ptp(values) / 3
    turned = estimate_mean(5 - 2 * values, skewed=False)
    assert (turned.low, turned.high) == pytest.approx((5 - 2 * high, 5 - 2 * low))


def test_skewness_has_a_limit_either_way():
    # of 0, 1 with a share p of ones the third standardized moment is (1 - 2p) / sqrt(p (1 - p))
    half, more = np.repeat([0.0, 1.0], [7, 3]), np.repeat([0.0, 1.0], [8, 2])  # 0.87 and 1.5
    assert [is_skewed([half]), is_skewed([-half])] == [False, False]
    assert [is_skewed([more]), is_skewed([-more])] == [True, True]


def test_thirty_skewed_values_have_an_interval_and_29_have_none():
    values = np.random.default_rng(7).exponential(size=30)
    assert np.isnan(estimate_mean(values[:29], skewed=True).low)
    assert np.isfinite(estimate_mean(values, skewed=True).low)


def test_intervals_of_rows_are_students():
    values = np.random.default_rng(5).normal(size=(3, 8)) + np.arange(3)[:, None]
    low, high = interval_of_means(values)
    for row, *ends in zip(values, low, high, strict=True):
        expected = stats.t.interval(0.95, 7, row.mean(), stats.sem(row))
        assert ends == pytest.approx(expected)


def test_missing_entries_of_a_row_do_not_count():
    row = [1.0, np.nan, 3.0, 5.0]
    low, high = interval_of_means(np.array([row, [np.nan] * 4, [1.0, np.nan, np.nan, np.nan]]))
    expected = stats.t.interval(0.95, 2, 3.0, 2 / np.sqrt(3))
    assert (low[0], high[0]) == pytest.approx(expected)
    assert np.isnan([low[1], high[1], low[2], high[2]]).all()


def test_half_a_width_by_hand():
    assert half_width(2.0, 4) == pytest.approx(3.182 * 2.0 / 2, abs=1e-3)
