"""Aggregates with known answers."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from harness.statistics import estimate_mean, final_score, interval_of_means


def test_the_final_score_is_the_mean_of_the_last_updates_in_which_an_episode_ended():
    returns = [100.0] * 50 + [1.0] * 60 + [np.nan] * 20 + [2.0] * 20
    metrics = pd.DataFrame({"charts/episodic_return": returns})
    # of the last 100 rows 60 say 1, 20 nothing and 20 say 2
    assert final_score(metrics) == pytest.approx((60 * 1 + 20 * 2) / 80)
    assert final_score(metrics, updates=20) == 2.0


def test_fewer_updates_are_all_taken():
    assert final_score(pd.DataFrame({"charts/episodic_return": [1.0, 3.0]})) == 2.0


def test_no_episode_has_no_score():
    assert np.isnan(final_score(pd.DataFrame({"charts/episodic_return": [np.nan]})))


def test_the_interval_is_that_of_the_normal_distribution_for_many_values():
    values = np.random.default_rng(1).normal(5.0, 2.0, size=400)
    mean, low, high, n = estimate_mean(values)
    error = 1.96 * values.std() / np.sqrt(400)
    assert mean == pytest.approx(values.mean())
    assert low == pytest.approx(mean - error, abs=0.03)
    assert high == pytest.approx(mean + error, abs=0.03)
    assert n == 400


def test_the_interval_covers_the_truth_19_times_in_20():
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(100):
        _, low, high, _ = estimate_mean(rng.normal(size=30))
        covered += low <= 0 <= high
    assert 85 <= covered <= 99


def test_equal_values_have_no_spread():
    assert estimate_mean(np.full(5, 3.0)) == (3.0, 3.0, 3.0, 5)


@pytest.mark.parametrize(("values", "mean"), [([], np.nan), ([4.0], 4.0)])
def test_too_few_values_have_no_interval(values, mean):
    estimate = estimate_mean(np.array(values))
    np.testing.assert_equal(estimate, (mean, np.nan, np.nan, len(values)))


def test_intervals_of_rows_are_those_of_each_row():
    values = np.random.default_rng(3).normal(size=(4, 50)) + np.arange(4)[:, None]
    low, high = interval_of_means(values)
    for i, row in enumerate(values):
        estimate = estimate_mean(row)
        assert low[i] == pytest.approx(estimate.low, abs=0.05)
        assert high[i] == pytest.approx(estimate.high, abs=0.05)


def test_missing_entries_of_a_row_do_not_count():
    low, high = interval_of_means(np.array([[1.0, np.nan, 1.0], [np.nan] * 3]))
    np.testing.assert_equal(low, [1.0, np.nan])
    np.testing.assert_equal(high, [1.0, np.nan])
