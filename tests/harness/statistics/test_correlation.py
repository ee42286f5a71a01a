"""Rank correlation and its permutations: by hand and by SciPy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from harness.statistics import permuted_correlations, rank_correlation, spearman
from harness.statistics.correlation import PERMUTATIONS, permutations, summarize


@pytest.mark.parametrize(
    ("y", "expected"),
    [
        ([10, 20, 30, 40], 1.0),
        ([4, 3, 2, 1], -1.0),
        ([2, 1, 4, 3], 0.6),  # 1 - 6 sum(d^2) / (n (n^2 - 1)), d = 1 four times: 1 - 24 / 60
        ([1, 4, 3, 2], 0.2),  # d = 0, 2, 0, 2: 1 - 48 / 60
        ([3, 4, 1, 2], -0.6),  # d = 2 four times: 1 - 96 / 60
    ],
)
def test_the_correlation_of_four_pairs_by_hand(y, expected):
    assert spearman(np.arange(4.0), np.array(y)) == pytest.approx(expected)


def test_with_ties_it_is_scipys():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(5, 25))
    y = np.round(x + rng.normal(size=x.shape))
    expected = [stats.spearmanr(a, b).statistic for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(spearman(x, y), expected)


def test_a_flat_side_has_no_correlation():
    assert np.isnan(spearman(np.arange(4.0), np.full(4, 7.0)))
    assert np.isnan(spearman(np.full(4, 7.0), np.arange(4.0)))


def test_a_small_range_is_not_flat():
    """Rewards that span less than 1 count like any others."""
    x = np.arange(5.0)[None]
    assert rank_correlation(x, 1e-3 * x).mean == pytest.approx(1.0)


def test_settings_are_averaged_each_within_itself():
    """Within each setting the pairs fall, though the settings' centres rise."""
    x = np.arange(6.0) + np.array([[0.0], [100.0]])
    y = -np.arange(6.0) + np.array([[0.0], [100.0]])
    np.testing.assert_allclose(rank_correlation(x, y), (-1.0, -1.0, -1.0, 6))
    both = rank_correlation(x, np.array([y[0], -y[1]]))
    assert both.mean == pytest.approx(0.0)


def test_flat_settings_are_left_out():
    x = np.array([np.arange(5.0), np.full(5, 2.0)])
    y = np.array([np.arange(5.0), np.arange(5.0)])
    assert rank_correlation(x, y).mean == 1.0
    assert np.isnan(rank_correlation(x[1:], y[1:]).mean)
    sums, settings = permuted_correlations(x, y)
    assert settings == 1
    assert summarize(sums, settings).mean == pytest.approx(1.0)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_fewer_than_three_agents_tell_nothing(n):
    x = np.arange(float(n))[None]
    np.testing.assert_equal(rank_correlation(x, x), (np.nan, np.nan, np.nan, n))


def test_no_setting_tells_nothing():
    empty = np.empty((0, 5))
    np.testing.assert_equal(rank_correlation(empty, empty), (np.nan, np.nan, np.nan, 0))


def test_the_interval_covers_the_truth():
    rng = np.random.default_rng(5)
    true = 6 / np.pi * np.arcsin(0.5 / 2)  # Spearman's, of a normal distribution
    covered = 0
    for _ in range(200):
        drawn = rng.multivariate_normal([0, 0], [[1, 0.5], [0.5, 1]], size=(2, 20))
        _, low, high, _ = rank_correlation(drawn[..., 0], drawn[..., 1])
        covered += low <= true <= high
    assert 183 <= covered <= 199


def test_few_agents_have_all_their_permutations():
    assert sorted(map(tuple, permutations(4))) == sorted(itertools.permutations(range(4)))
    assert permutations(4)[0].tolist() == [0, 1, 2, 3]


def test_many_agents_have_permutations_drawn():
    drawn = permutations(10)
    assert drawn.shape == (PERMUTATIONS, 10)
    assert drawn[0].tolist() == list(range(10))
    assert (np.sort(drawn, axis=1) == np.arange(10)).all()
    assert drawn[:, 0].mean() == pytest.approx(4.5, abs=0.2)


def test_every_setting_is_permuted_alike():
    rng = np.random.default_rng(6)
    x = rng.normal(size=(2, 3, 7))
    y = rng.normal(size=(2, 3, 7))
    sums, settings = permuted_correlations(x, y)
    assert settings.tolist() == [3, 3]
    for i, move in enumerate(permutations(7)[:20]):
        expected = sum(stats.spearmanr(x[1, s], y[1, s][move]).statistic for s in range(3))
        assert sums[1, i] == pytest.approx(expected)


def test_settings_that_repeat_each_other_are_no_more_evidence():
    """Four copies of one setting have the p of one."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(1, 10))
    y = rng.normal(size=(1, 10))
    one = summarize(*permuted_correlations(x, y))
    four = summarize(*permuted_correlations(np.repeat(x, 4, axis=0), np.repeat(y, 4, axis=0)))
    for copied, single in zip(four, one, strict=True):
        assert copied == pytest.approx(single)


def test_the_place_among_the_permutations_is_scipys():
    x = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    y = np.array([2.0, 1.0, 4.0, 3.0, 5.0])
    found = summarize(*permuted_correlations(x[None], y[None]))
    for name, side in (("below", "less"), ("above", "greater")):
        expected = stats.permutation_test(
            (x,), lambda moved: stats.spearmanr(moved, y).statistic, permutation_type="pairings",
            alternative=side, n_resamples=200,
        ).pvalue  # fmt: skip
        assert getattr(found, name) == pytest.approx(expected)
    assert found.deviation == pytest.approx(1 / np.sqrt(4))  # 1 / sqrt(n - 1)


def test_data_sets_have_each_their_place():
    rng = np.random.default_rng(8)
    x, y = rng.normal(size=(2, 3, 2, 6))
    sums, settings = permuted_correlations(x, y)
    many = summarize(sums, settings)
    for i in range(3):
        single = summarize(*permuted_correlations(x[i], y[i]))
        for several, one in zip(many, single, strict=True):
            assert several[i] == pytest.approx(one)


def test_where_no_setting_tells_there_is_no_place():
    found = summarize(*permuted_correlations(np.ones((2, 5)), np.ones((2, 5))))
    assert np.isnan(found).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_the_jackknife_by_hand(sign):
    """Four agents; without one of them the correlation of the three is 0.5, 0.5, 1 and 1."""
    x, y = np.array([[1.0, 2.0, 3.0, 4.0]]), sign * np.array([[1.0, 2.0, 4.0, 3.0]])
    without = [stats.spearmanr(np.delete(x, i), np.delete(y, i)).statistic for i in range(4)]
    assert without == pytest.approx([sign * 0.5, sign * 0.5, sign, sign])
    # variance 1 / 16, times 3; the interval ends at 1 or -1, where the correlation does
    reach = stats.t.ppf(0.975, 3) * np.sqrt(3 / 16)
    expected = sorted([sign, sign * (0.8 - reach)])
    np.testing.assert_allclose(rank_correlation(x, y), (sign * 0.8, *expected, 4))


def test_three_agents_have_a_correlation_and_no_interval():
    x = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(rank_correlation(x, x[:, ::-1]), (-1.0, np.nan, np.nan, 3))
