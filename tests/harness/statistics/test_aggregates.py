"""Interquartile mean and probability of improvement, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from harness.statistics import interquartile_mean, probability_of_improvement


def test_the_middle_half_by_hand():
    # of 8 values two fall off at either end: the mean of 2, 3, 4 and 5
    values = np.array([100.0, 3.0, 1.0, 5.0, 2.0, 4.0, 0.0, 6.0])
    assert interquartile_mean([values]).mean == 3.5
    assert interquartile_mean([values[:3], values[3:]]).mean == 3.5
    assert interquartile_mean([values[:3], values[3:]]).n == 8


def test_the_interquartile_interval_of_one_group_is_scipys():
    values = np.random.default_rng(9).normal(size=40)
    expected = stats.bootstrap(
        (values,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), method="percentile",
        n_resamples=5000, rng=np.random.default_rng(1), batch=1000,
    ).confidence_interval  # fmt: skip
    _, low, high, _ = interquartile_mean([values])
    assert (low, high) == pytest.approx(tuple(expected), abs=0.02)


def test_values_are_resampled_within_their_groups():
    estimate = interquartile_mean([np.full(4, 1.0), np.full(4, 5.0)])
    assert estimate == (3.0, 3.0, 3.0, 8)


@pytest.mark.parametrize(
    ("groups", "expected"),
    [
        ([], (np.nan, np.nan, np.nan, 0)),
        ([[]], (np.nan, np.nan, np.nan, 0)),
        ([[2.0]], (2.0, np.nan, np.nan, 1)),
        ([[2.0], [1.0, 3.0, 6.0]], (2.5, np.nan, np.nan, 4)),
    ],
)
def test_one_value_in_a_group_has_no_interquartile_interval(groups, expected):
    np.testing.assert_equal(interquartile_mean([np.array(g) for g in groups]), expected)


def pair(first, second):
    return np.array(first, float), np.array(second, float)


def test_the_chance_of_improvement_by_hand():
    # 4 beats both, 2 beats 1 and not 3; then of two tasks the second is always better
    assert probability_of_improvement([pair([1, 3], [2, 4])]).mean == pytest.approx(0.75)
    both = probability_of_improvement([pair([1, 3], [2, 4]), pair([0, 0, 0], [1, 1, 1])])
    assert both.mean == pytest.approx((0.75 + 1) / 2)  # tasks count equally, agents do not
    assert both.n == 5


def test_every_agent_meets_every_other_not_its_partner_only():
    """Each second agent is worse than its partner; two of three pairs of strangers are better."""
    assert probability_of_improvement([pair([0, 10], [9, 9])]).mean == 0.5
    assert probability_of_improvement([pair([1, 2, 3], [0.5, 2.5, 3.5])]).mean == pytest.approx(
        5 / 9
    )


def test_a_tie_counts_half():
    estimate = probability_of_improvement([pair([5, 5], [5, 5])])
    assert estimate == (0.5, 0.5, 0.5, 2)


def test_the_interval_is_wide_for_few_agents():
    rng = np.random.default_rng(1)
    few = probability_of_improvement([pair(rng.normal(size=5), rng.normal(size=5))])
    many = probability_of_improvement([pair(rng.normal(size=40), rng.normal(size=40))] * 3)
    assert few.low < few.mean < few.high
    assert many.high - many.low < 0.5 * (few.high - few.low)


@pytest.mark.parametrize("pairs", [[], [pair([], [])]])
def test_without_agents_there_is_no_chance(pairs):
    np.testing.assert_equal(probability_of_improvement(pairs), (np.nan, np.nan, np.nan, 0))


def test_the_seed_decides_the_resamples():
    values = np.random.default_rng(3).normal(size=12)
    for of, data in (
        (interquartile_mean, [values]),
        (probability_of_improvement, [(values, -values)]),
    ):
        assert of(data) == of(data, seed=0)
        assert of(data) != of(data, seed=1)
