"""Sign-flip tests and their intervals: by hand, by SciPy, and by their properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.statistics import (
    ALPHA,
    detectable_difference,
    sign_flip_interval,
    sign_flip_test,
    smallest_n,
)
from harness.statistics.signflips import EXACT, SUBSETS, subsets


def test_subsets_of_three_by_hand():
    expected = {(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1)}
    found = [tuple(row) for row in subsets(3).astype(int)]
    assert set(found) == expected | {(1, 1, 1)}
    assert len(found) == 8
    assert found[0] == (0, 0, 0)


def test_beyond_twelve_pairs_subsets_are_drawn():
    drawn = subsets(EXACT + 1)
    assert drawn.shape == (SUBSETS, EXACT + 1)
    assert not drawn[0].any()
    assert drawn[1:].mean() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("differences", "p"),
    [
        ([1.0, 2.0, 3.0], 2 / 8),  # only all signs flipped is as extreme
        ([1.0, 2.0, -1.0], 6 / 8),  # sums: 2, 0, -2, 4 and their opposites; |sum| < 2 twice
        ([-1.0, -2.0, -3.0], 2 / 8),
        ([1.0, 1.0, 0.0], 4 / 8),  # the sign of 0 does not matter
        ([0.0, 0.0], 1.0),
        ([5.0], 1.0),
    ],
)
def test_the_p_value_by_hand(differences, p):
    assert sign_flip_test(np.array(differences)) == pytest.approx(p)


@pytest.mark.parametrize("n", [2, 7, 10, 12])
def test_to_twelve_pairs_the_p_value_is_scipys(n):
    differences = np.random.default_rng(n).normal(0.4, size=n)
    expected = stats.permutation_test(
        (differences,), np.mean, permutation_type="samples", n_resamples=2**n
    ).pvalue
    assert sign_flip_test(differences) == pytest.approx(expected)


def test_beyond_twelve_pairs_it_is_close_to_students():
    differences = np.random.default_rng(1).normal(0.3, size=40)
    expected = stats.ttest_1samp(differences, 0).pvalue
    assert sign_flip_test(differences) == pytest.approx(expected, abs=0.02)


def test_data_sets_do_not_mix():
    many = np.random.default_rng(2).normal(size=(3, 4, 9))
    found = sign_flip_test(many)
    low, high = sign_flip_interval(many)
    assert found.shape == low.shape == high.shape == (3, 4)
    assert found[1, 2] == sign_flip_test(many[1, 2])
    np.testing.assert_allclose((low[1, 2], high[1, 2]), sign_flip_interval(many[1, 2]))


def test_missing_pairs_do_not_count():
    there = np.random.default_rng(3).normal(0.5, size=8)
    holes = np.insert(there, [0, 3, 5], np.nan)
    assert sign_flip_test(holes) == pytest.approx(sign_flip_test(there))
    np.testing.assert_allclose(sign_flip_interval(holes), sign_flip_interval(there))
    assert np.isnan(sign_flip_test(np.full(4, np.nan)))
    assert np.isnan(sign_flip_test(np.stack([there, there * np.nan]))).tolist() == [False, True]
    assert np.isnan(sign_flip_interval(np.full(4, np.nan))).all()


def test_what_is_exact_is_counted_in_pairs_not_in_columns():
    """Six pairs in twenty columns have 64 subsets, and not 4096 drawn ones."""
    there = np.array([3.0, 9.0, 4.0, 8.0, 5.0, 7.0])
    holes = np.full(20, np.nan)
    holes[[0, 4, 7, 11, 15, 19]] = there
    assert sign_flip_test(holes) == 2 / 64
    assert sign_flip_interval(holes) == (3.0, 9.0)
    beside = np.arange(1.0, 21.0)  # a row that has all pairs does not change that
    assert sign_flip_test(np.stack([holes, beside]))[0] == 2 / 64
    holes[19] = np.nan
    assert np.isnan(sign_flip_interval(holes)).all()


numbers = st.lists(st.integers(-50, 50), min_size=6, max_size=9)


@settings(max_examples=30, deadline=None)
@given(numbers)
def test_the_interval_holds_the_shifts_that_are_not_rejected(drawn):
    differences = np.array(drawn, dtype=float)
    low, high = sign_flip_interval(differences)
    assert low <= differences.mean() <= high
    for end, out in ((low, -1e-6), (high, 1e-6)):
        assert sign_flip_test(differences - end) > ALPHA
        assert sign_flip_test(differences - end - out) <= ALPHA


@settings(max_examples=30, deadline=None)
@given(numbers)
def test_turning_the_differences_round_turns_the_interval_round(drawn):
    differences = np.array(drawn, dtype=float)
    low, high = sign_flip_interval(differences)
    np.testing.assert_allclose(sign_flip_interval(-differences), (-high, -low))
    assert sign_flip_test(-differences) == sign_flip_test(differences)


def test_the_interval_of_six_pairs_is_their_range():
    """2 of 64 subsets leave 5%: the ends are the smallest and the largest difference."""
    assert sign_flip_interval(np.array([3.0, 9.0, 4.0, 8.0, 5.0, 7.0])) == (3.0, 9.0)


def test_five_pairs_have_no_interval_at_all():
    assert np.isnan(sign_flip_interval(np.arange(5.0))).all()
    assert not np.isnan(sign_flip_interval(np.arange(5.0), alpha=0.1)).any()


@pytest.mark.parametrize("n", [8, 20])
def test_intervals_cover_the_truth_nineteen_times_in_twenty(n):
    values = np.random.default_rng(n).normal(1.0, size=(4000, n))
    low, high = sign_flip_interval(values)
    assert ((low <= 1) & (high >= 1)).mean() == pytest.approx(0.95, abs=0.012)


@pytest.mark.parametrize(("share", "n"), [(1.0, 6), (1 / 2, 7), (1 / 16, 10), (1 / 8, 9)])
def test_the_fewest_pairs_that_can_decide(share, n):
    assert smallest_n(share) == n
    agree = np.ones(n)
    assert sign_flip_test(agree) <= ALPHA * share
    assert sign_flip_test(agree[1:]) > ALPHA * share


def test_what_could_have_been_found_grows_with_the_spread():
    found = detectable_difference(np.array([1.0, 2.0, np.nan]), np.array([10, 10, 10]))
    assert found[1] == 2 * found[0]
    assert np.isnan(found[2])
    # Student's: (t(0.975) + t(0.8)) / sqrt(10) with 9 degrees of freedom
    assert found[0] == pytest.approx((2.262 + 0.883) / np.sqrt(10), rel=0.05)


def test_at_a_level_that_all_signs_must_reach_the_effect_is_the_binomials():
    """10 pairs, 16 tests: all ten signs must agree, so P(d > 0) = 0.8^(1/10)."""
    expected = stats.norm.ppf(0.8 ** (1 / 10))
    assert detectable_difference(1.0, 10, 1 / 16) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("n", "share"), [(1, 1.0), (5, 1.0), (9, 1 / 16)])
def test_too_few_pairs_could_have_found_nothing(n, share):
    assert np.isnan(detectable_difference(1.0, n, share))


@pytest.mark.parametrize("n", [6, 10])
def test_the_smallest_p_of_n_pairs_is_found(n):
    """At a level of exactly 2 / 2^n all n signs must agree: P(d > 0) = 0.8^(1/n)."""
    share = 2.0 ** (1 - n) / ALPHA
    expected = stats.norm.ppf(0.8 ** (1 / n))
    assert detectable_difference(1.0, n, share) == pytest.approx(expected, rel=0.05)
    assert np.isnan(detectable_difference(1.0, n, 0.999 * share))


def test_the_p_value_of_small_numbers_is_that_of_large_ones():
    """Sums of equal differences differ in their last bits alone, whatever the unit."""
    differences = np.array([0.1, 0.2, -0.3, 0.1, 0.2, 0.3])
    expected = sign_flip_test(np.array([1.0, 2.0, -3.0, 1.0, 2.0, 3.0]))
    for unit in (1e-12, 1.0, 1e12):
        assert sign_flip_test(unit * differences) == expected
