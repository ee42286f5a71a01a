"""Aggregates with known answers."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.statistics import (
    MIN_AGENTS,
    Estimate,
    estimate_mean,
    estimate_success,
    final_score,
    interquartile_mean,
    interval_of_means,
    rank_correlation,
    spearman,
    success_matrix,
    verdict,
)
from tests.harness.conftest import make_episodes


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


def pairs(x, y) -> np.ndarray:
    return np.column_stack([x, y]).astype(float)


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
def test_the_rank_correlation_of_four_pairs_by_hand(y, expected):
    estimate = rank_correlation([pairs([1, 2, 3, 4], y)])
    assert estimate.mean == pytest.approx(expected)
    assert estimate.n == 4


@pytest.mark.parametrize("seed", range(5))
def test_the_rank_correlation_of_one_group_is_scipys(seed):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=25)
    y = np.round(x + rng.normal(size=25))  # with ties
    expected = stats.spearmanr(x, y).statistic
    assert rank_correlation([pairs(x, y)]).mean == pytest.approx(expected)


def test_each_set_of_pairs_has_its_own_correlation():
    sets = np.random.default_rng(4).normal(size=(6, 9, 2))
    expected = [stats.spearmanr(x).statistic for x in sets]
    np.testing.assert_allclose(spearman(sets), expected)


@pytest.mark.parametrize("flat", [0, 1])
def test_a_flat_side_has_no_correlation(flat):
    sets = np.array([[[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]] * 2)
    sets[1, :, flat] = 7.0
    np.testing.assert_allclose(spearman(sets), [1.0, np.nan])


whole = st.integers(-1000, 1000)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(whole, whole), min_size=3, max_size=12))
def test_rising_maps_of_either_side_leave_the_rank_correlation_as_it_is(drawn):
    given_pairs = np.array(drawn, dtype=float)
    mapped = pairs(given_pairs[:, 0] ** 3 + 2 * given_pairs[:, 0], 5 * given_pairs[:, 1] - 1e6)
    np.testing.assert_allclose(rank_correlation([mapped]), rank_correlation([given_pairs]))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(whole, whole), min_size=3, max_size=12))
def test_a_falling_map_turns_the_rank_correlation_round(drawn):
    given_pairs = np.array(drawn, dtype=float)
    mean, low, high, n = rank_correlation([given_pairs])
    turned = rank_correlation([given_pairs * [1.0, -1.0]])
    np.testing.assert_allclose(turned, (-mean, -high, -low, n), atol=1e-9)


def test_groups_are_weighted_by_their_size():
    rising, falling = pairs(range(4), range(4)), pairs(range(8), range(8, 0, -1))
    estimate = rank_correlation([rising, falling])
    assert estimate.mean == pytest.approx((4 - 8) / 12)
    assert estimate.n == 12


def test_differences_between_groups_are_no_correlation():
    """Within each group the pairs fall, though the groups' centres rise."""
    falling = pairs(range(6), range(6, 0, -1))
    estimate = rank_correlation([falling, falling + 100.0])
    np.testing.assert_allclose(estimate, (-1.0, -1.0, -1.0, 12))
    assert rank_correlation([np.concatenate([falling, falling + 100.0])]).mean > 0


@pytest.mark.parametrize(
    "told", [[[1, 2], [2, 1]], [[1, 5], [2, 5], [3, 5]], [[7, 1], [7, 2], [7, 3]]]
)
def test_tiny_and_flat_groups_are_left_out(told):
    nothing, rising = np.array(told, dtype=float), pairs(range(5), range(5))
    np.testing.assert_equal(rank_correlation([nothing]), (np.nan, np.nan, np.nan, 0))
    assert rank_correlation([nothing, rising]) == rank_correlation([rising])


def test_no_group_has_no_rank_correlation():
    np.testing.assert_equal(rank_correlation([]), (np.nan, np.nan, np.nan, 0))


def test_the_interval_of_a_rank_correlation_covers_the_truth_19_times_in_20():
    rng, normal = np.random.default_rng(5), 0.5
    true = 6 / np.pi * np.arcsin(normal / 2)  # Spearman's, of a normal distribution
    covered = 0
    for _ in range(100):
        drawn = rng.multivariate_normal([0, 0], [[1, normal], [normal, 1]], size=30)
        _, low, high, _ = rank_correlation([drawn])
        covered += low <= true <= high
    assert 89 <= covered <= 99


@pytest.mark.parametrize("sizes", [[20], [3] * 8])
def test_independent_sides_are_rarely_called_correlated(sizes):
    rng = np.random.default_rng(6)
    found = [rank_correlation([rng.normal(size=(n, 2)) for n in sizes]) for _ in range(60)]
    assert sum(not low <= 0 <= high for _, low, high, _ in found) <= 6


def test_a_side_that_hardly_varies_is_rarely_called_correlated():
    """One agent in ten has a psi above 0, and its reward is anything."""
    rng = np.random.default_rng(7)
    found = [
        rank_correlation([pairs(np.arange(10) == 0, rng.normal(size=10)) for _ in range(8)])
        for _ in range(60)
    ]
    assert sum(not low <= 0 <= high for _, low, high, _ in found) <= 9


def test_the_middle_half_by_hand():
    # of 8 values two fall off at either end: the mean of 2, 3, 4 and 5
    values = np.array([100.0, 3.0, 1.0, 5.0, 2.0, 4.0, 0.0, 6.0])
    assert interquartile_mean([values]).mean == 3.5
    assert interquartile_mean([values[:3], values[3:]]).mean == 3.5
    assert interquartile_mean([values[:3], values[3:]]).n == 8


@pytest.mark.parametrize("n", [2, 3, 7, 40])
def test_the_middle_half_is_scipys(n):
    values = np.random.default_rng(n).normal(size=n)
    assert interquartile_mean([values]).mean == pytest.approx(stats.trim_mean(values, 0.25))


def test_outliers_do_not_move_the_interquartile_mean():
    values = np.arange(12.0)
    wild = values.copy()
    wild[:2], wild[-2:] = -1e9, 1e9
    assert interquartile_mean([wild]).mean == interquartile_mean([values]).mean == 5.5
    assert estimate_mean(wild + 1e9).mean > 1e8


def test_the_interquartile_mean_of_many_values_covers_their_centre():
    rng = np.random.default_rng(8)
    found = [interquartile_mean([rng.normal(size=20), rng.normal(size=20)]) for _ in range(100)]
    assert 85 <= sum(low <= 0 <= high for _, low, high, _ in found) <= 99


def test_the_interquartile_interval_of_one_group_is_scipys():
    values = np.random.default_rng(9).normal(size=40)
    expected = stats.bootstrap(
        (values,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), method="percentile",
        n_resamples=5000, rng=np.random.default_rng(1), batch=1000,
    ).confidence_interval  # fmt: skip
    _, low, high, _ = interquartile_mean([values])
    assert (low, high) == pytest.approx(tuple(expected), abs=0.02)


def test_values_are_resampled_within_their_groups():
    # whatever is drawn from each group, the whole holds as many of each
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


@pytest.mark.parametrize(
    ("low", "high", "sign", "word"),
    [
        (0.1, 0.5, +1, "supported"),
        (0.1, 0.5, -1, "contradicted"),
        (-0.5, -0.1, -1, "supported"),
        (-0.5, -0.1, +1, "contradicted"),
        (-0.1, 0.5, +1, "not supported"),
        (-0.1, 0.5, -1, "not supported"),
        (0.0, 0.5, +1, "not supported"),
        (-0.5, 0.0, -1, "not supported"),
        (np.nan, np.nan, +1, "too few runs to tell"),
    ],
)
def test_a_verdict_is_where_the_interval_lies(low, high, sign, word):
    assert verdict(Estimate((low + high) / 2, low, high, MIN_AGENTS), sign) == word


def test_below_ten_agents_there_is_no_verdict():
    estimate = Estimate(1.0, 0.9, 1.1, 10)
    assert verdict(estimate, +1) == "supported"
    assert verdict(estimate._replace(n=9), +1) == "too few runs to tell"


def test_successes_stand_at_their_level_and_repeat():
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    episodes = make_episodes(seen_sampled=matrix)
    np.testing.assert_array_equal(success_matrix(episodes), matrix)
    np.testing.assert_array_equal(success_matrix(episodes.sample(frac=1, random_state=1)), matrix)
    greedy = success_matrix(make_episodes(seen_greedy=[[1], [0], [1]]))
    np.testing.assert_array_equal(greedy, [[1.0], [0.0], [1.0]])


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
    assert 0 <= estimate.low <= mean <= estimate.high <= 1
    assert estimate.n == len(agents)


def test_no_agent_has_no_success_rate():
    np.testing.assert_equal(estimate_success([]), (np.nan, np.nan, np.nan, 0))


@pytest.mark.parametrize("agents", [1, 3])
@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_levels_that_are_all_alike_and_sure_leave_no_doubt(agents, rate):
    estimate = estimate_success([np.full((4, 5), rate)] * agents)
    assert estimate == (rate, rate, rate, agents)


@pytest.mark.parametrize("shape", [(100, 1), (10, 10)])
def test_the_interval_of_one_agent_is_the_binomial_one_where_levels_are_alike(shape):
    """100 levels, half of them won; or 10 levels, each won in half of 10 repeats."""
    wins = np.tile([1.0, 0.0], 50).reshape(shape)
    mean, low, high, _ = estimate_success([wins])
    assert mean == 0.5
    assert (low, high) == pytest.approx(stats.binom.ppf([0.025, 0.975], 100, 0.5) / 100, abs=0.02)


def test_repeats_of_few_levels_do_not_narrow_the_interval_at_will():
    """Two levels, one always won: 1000 repeats say nothing of a third."""
    estimate = estimate_success([np.repeat([[1.0], [0.0]], 1000, axis=1)])
    assert estimate == (0.5, 0.0, 1.0, 1)


def test_levels_are_resampled_alike_for_all_agents():
    """20 agents that win the same 50 of 100 levels know of no more levels than one of them."""
    wins = np.tile([1.0, 0.0], 50).reshape(100, 1)
    one, many = estimate_success([wins]), estimate_success([wins] * 20)
    assert many.n == 20
    assert (many.low, many.high) == pytest.approx((one.low, one.high), abs=0.03)


def test_agents_are_resampled():
    """Each agent is sure of itself, so all doubt is in which agents there are."""
    rates = [0.0, 0.0, 1.0, 1.0]
    _, low, high, _ = estimate_success([np.full((50, 2), rate) for rate in rates])
    assert (low, high) == (0.0, 1.0)  # all four alike: 2 in 16 resamples, above 5 in 100


def test_an_estimate_of_success_is_the_same_each_time():
    wins = np.random.default_rng(1).integers(2, size=(3, 20, 4)).astype(float)
    assert estimate_success(list(wins)) == estimate_success(list(wins))


def test_the_interval_of_a_success_rate_covers_the_truth_19_times_in_20():
    """Agents and levels differ, around a success rate of 1/2 by symmetry."""
    rng, covered = np.random.default_rng(10), 0
    for _ in range(40):
        logits = rng.normal(size=(12, 1, 1)) + rng.normal(size=(1, 30, 1))
        wins = rng.random((12, 30, 5)) < 1 / (1 + np.exp(-logits))
        _, low, high, _ = estimate_success(list(wins.astype(float)))
        covered += low <= 0.5 <= high
    assert covered >= 35
