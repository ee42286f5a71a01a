"""The tests of the claims, on data with a known answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from harness.statistics import detectable_difference, holm, sign_flip_test
from harness.statistics.judgements import associate, compare_arms

RNG = np.random.default_rng(0)
PAIRS = RNG.normal(size=(2, 2, 3, 10))  # arms, contrasts, tasks, n


def test_the_headline_is_the_mean_over_tasks_in_deviations_of_both_arms():
    first, second = PAIRS * np.array([1.0, 100.0, 0.01])[:, None]
    found = compare_arms(first, second)
    for contrast in range(2):
        parts = [
            (second[contrast, t] - first[contrast, t]).mean()
            / np.concatenate([first[contrast, t], second[contrast, t]]).std(ddof=1)
            for t in range(3)
        ]
        assert found.headline.mean[contrast] == pytest.approx(np.mean(parts))
    assert found.headline.n.tolist() == [10, 10]


def test_signs_are_flipped_jointly_over_tasks():
    """Three tasks that repeat each other are no more evidence than one."""
    first = np.repeat(PAIRS[0, :1, :1], 3, axis=1)
    second = np.repeat(PAIRS[1, :1, :1], 3, axis=1)
    found = compare_arms(first, second)
    assert found.headline.p[0] == sign_flip_test(second[0, 0] - first[0, 0])
    np.testing.assert_allclose(found.tasks.p[0], found.headline.p[0])


def test_the_family_is_the_headlines_and_all_tasks():
    first, second = PAIRS
    found = compare_arms(first, second + 0.8)
    tests = np.concatenate([found.headline.p, found.tasks.p.ravel()])
    expected = holm(tests, np.array([0.4, 0.4] + [0.2 / 6] * 6))
    np.testing.assert_allclose(found.headline.corrected, expected[:2])
    np.testing.assert_allclose(found.tasks.corrected.ravel(), expected[2:])


@pytest.mark.parametrize("sign", [1, -1])
def test_words_are_the_direction_of_what_is_found(sign):
    first, second = PAIRS
    found = compare_arms(first, first + sign * (1 + 0.01 * second))
    assert (found.headline.word == sign).all()
    assert (found.tasks.word == sign).all()
    even = compare_arms(first, first + 0.001 * second)
    assert not even.headline.word.any()
    assert not even.tasks.word.any()


def test_a_loss_on_one_task_is_seen_where_headlines_say_nothing():
    """30 pairs: the other tasks gain what this one loses."""
    rng = np.random.default_rng(1)
    first = rng.normal(size=(1, 3, 30))
    second = rng.normal(size=(1, 3, 30)) + np.array([-2.0, 1.0, 1.0])[:, None]
    found = compare_arms(first, second)
    assert found.headline.word.tolist() == [0]
    assert found.tasks.word[0, 0] == -1


def test_exchanging_the_arms_turns_everything_round():
    first, second = PAIRS
    there = compare_arms(first, second + 0.5)
    back = compare_arms(second + 0.5, first)
    np.testing.assert_allclose(back.headline.mean, -there.headline.mean)
    np.testing.assert_allclose(back.headline.p, there.headline.p)
    np.testing.assert_allclose(back.tasks.corrected, there.tasks.corrected)
    np.testing.assert_allclose(back.tasks.low, -there.tasks.high)


def test_negligible_is_the_whole_interval_within_half_a_deviation():
    first = np.repeat(np.linspace(-1, 1, 10)[None, None], 3, axis=1)  # deviation 0.66, half 0.33
    wobble = 0.01 * RNG.normal(size=10)
    gains = np.array([0.25, 0.4, -0.25])
    found = compare_arms(first, first + gains[:, None] + wobble)
    assert found.negligible[0].tolist() == [True, False, True]
    assert (found.tasks.word[0] == [1, 1, -1]).all()  # sure, and small all the same


def test_the_bound_of_negligible_is_the_plain_arms():
    wide = np.linspace(-10, 10, 10)
    narrow = np.linspace(-1, 1, 10)
    assert compare_arms(wide[None, None], (wide + narrow)[None, None]).negligible.all()
    assert not compare_arms(narrow[None, None], (wide + narrow)[None, None]).negligible.any()


def test_equal_arms_are_no_difference():
    first = np.full((1, 2, 8), 5.0)
    found = compare_arms(first, first)
    assert found.headline.p.tolist() == [1.0]
    assert (found.tasks.mean == 0).all()
    assert not found.headline.word.any()


def test_missing_agents_leave_the_means_of_their_tasks():
    first = PAIRS[0].copy()
    second = PAIRS[1] + 0.5
    first[0, 1, :4] = np.nan
    second[1, 2] = np.nan
    found = compare_arms(first, second)
    assert found.tasks.n.tolist() == [[10, 6, 10], [10, 10, 0]]
    alone = compare_arms(first[:1, 1:2, 4:], second[:1, 1:2, 4:])
    assert found.tasks.mean[0, 1] == pytest.approx(alone.tasks.mean[0, 0])
    assert found.tasks.p[0, 1] == pytest.approx(alone.tasks.p[0, 0])
    means = [[np.mean(d[~np.isnan(d)]) for d in tasks] for tasks in found.standard[:, :2]]
    third = found.standard[0, 2].mean()
    assert found.headline.mean[0] == pytest.approx(np.mean([*means[0], third]))
    assert found.headline.mean[1] == pytest.approx(np.mean(means[1]))
    assert np.isnan(found.tasks.p[1, 2])


def test_data_sets_do_not_mix():
    many = np.random.default_rng(3).normal(size=(2, 5, 2, 3, 8))
    found = compare_arms(many[0], many[1])
    one = compare_arms(many[0, 3], many[1, 3])
    for several, single in zip(found.headline, one.headline, strict=True):
        np.testing.assert_allclose(several[3], single)
    for several, single in zip(found.tasks, one.tasks, strict=True):
        np.testing.assert_allclose(several[3], single)


@pytest.mark.parametrize(("sign", "word"), [(-1.0, 1), (1.0, -1)])
def test_psi_that_falls_with_the_score_is_what_claim_a_says(sign, word):
    rng = np.random.default_rng(4)
    score = rng.normal(size=(4, 10))
    psi = sign * score + 0.1 * rng.normal(size=(2, 4, 10))
    found = associate(psi, score, np.array([0, 0, 1, 1]))
    assert (found.headline.word == word).all()
    assert (found.tasks.word == word).all()
    assert (np.sign(found.headline.mean) == sign).all()
    assert found.tasks.mean.shape == (2, 2)


def test_parts_and_tasks_are_not_mixed_up():
    """Late psi falls with the score on task 1 only; early psi has nothing to do with it."""
    rng = np.random.default_rng(5)
    score = rng.normal(size=(2, 12))
    psi = rng.normal(size=(2, 2, 12))
    psi[0, 1] = -score[1]
    found = associate(psi, score, np.array([0, 1]))
    assert found.tasks.mean[0, 1] == pytest.approx(-1.0)
    assert found.tasks.word.tolist() == [[0, 1], [0, 0]]
    assert found.headline.mean[0] == pytest.approx(found.tasks.mean[0].mean())


def test_the_test_is_one_sided_but_for_a_fifth():
    score = np.arange(4.0)[None]
    falling = associate(np.stack([-score, -score]), score, np.array([0]))
    rising = associate(np.stack([score, score]), score, np.array([0]))
    for found, part in ((falling, 0.8), (rising, 0.2)):
        assert found.headline.p == pytest.approx([1 / 24] * 2)  # as the test gave it
        # each of two headlines has 0.4 of the level, and its side a part of that
        assert found.headline.corrected == pytest.approx([1 / 24 / part / 0.4] * 2)


def test_what_could_have_been_found_is_a_correlation():
    rng = np.random.default_rng(6)
    few = associate(rng.normal(size=(2, 1, 10)), rng.normal(size=(1, 10)), np.array([0]))
    many = associate(rng.normal(size=(2, 4, 30)), rng.normal(size=(4, 30)), np.array([0, 0, 1, 1]))
    # deviation 1 / sqrt(9), z(1 - 0.05 * 0.8 / 2) + z(0.8) = 2.05 + 0.84
    assert few.headline.detectable == pytest.approx([2.9 / 3] * 2, rel=0.05)
    assert (many.headline.detectable < 0.35).all()


def test_what_could_have_been_found_has_its_share_of_the_level():
    """A headline has 2/5 of the level, half of their 4/5; a task of five 1/25."""
    first, second = PAIRS.copy()
    second[1, 2] = np.nan  # so that five tasks have a test
    found = compare_arms(first, second)
    for contrast in range(2):
        for task in range(2):
            spread = (second - first)[contrast, task].std(ddof=1)
            expected = detectable_difference(spread, 10, 1 / 25)
            assert found.tasks.detectable[contrast, task] == pytest.approx(expected)
    assert np.isnan(found.tasks.detectable[1, 2])
    # all agents have all tasks: each has its mean over the tasks
    for contrast, tasks in ((0, 3), (1, 2)):
        spread = found.standard[contrast, :tasks].mean(axis=0).std(ddof=1)
        expected = detectable_difference(spread, 10, 2 / 5)
        assert found.headline.detectable[contrast] == pytest.approx(expected)


def test_no_p_value_of_a_correlation_is_above_1():
    """Two agents: the data are below both permutations, and above one of two."""
    score = np.arange(2.0)[None]
    found = associate(np.stack([score, score]), score, np.array([0]))
    assert found.headline.p.tolist() == [1.0, 1.0]
    assert found.headline.word.tolist() == [0, 0]


def test_a_correlation_is_of_all_its_agents_and_settings_that_are_flat_have_none():
    score = np.random.default_rng(8).normal(size=(2, 9))
    psi = np.stack([score, score])
    psi[:, 1] = 3.0
    found = associate(psi, score, np.array([0, 1]))
    assert found.tasks.n.tolist() == [[9, 0], [9, 0]]
    assert np.isnan(found.tasks.p).tolist() == [[False, True], [False, True]]
    assert found.headline.mean == pytest.approx([1.0, 1.0])
    # every other test of the family is decided, so each has the whole level
    assert found.tasks.share[:, 0].tolist() == [1.0, 1.0]
    assert np.isnan(found.tasks.share[:, 1]).all()
    reach = stats.norm.ppf(1 - 0.05 * 0.8) + stats.norm.ppf(0.8)
    assert found.tasks.detectable[:, 0] == pytest.approx([reach / np.sqrt(8)] * 2, rel=0.05)


def test_a_task_of_sixteen_has_an_eightieth_until_headlines_are_decided():
    """Ten pairs that all agree have p = 2 / 1024, above 5% / 80 and below 5% / 16."""
    rng = np.random.default_rng(9)
    first = rng.normal(size=(2, 8, 10))
    noise = first + rng.normal(size=(2, 8, 10))
    undecided = compare_arms(first, noise)
    assert not undecided.headline.word.any()
    np.testing.assert_allclose(undecided.tasks.share, 1 / 80)
    assert np.isnan(undecided.tasks.detectable).all()

    decided = compare_arms(first, noise + np.where(np.arange(8) > 0, 1.5, 0.0)[:, None])
    assert decided.headline.word.all()
    assert (decided.tasks.share > 1 / 80).all()
    assert np.isfinite(decided.tasks.detectable).all()


def test_no_correlation_above_1_could_have_been_found():
    """Five agents, one setting: (z(1 - 0.016) + z(0.8)) / sqrt(4) = 1.49."""
    rng = np.random.default_rng(10)
    few = associate(rng.normal(size=(2, 1, 5)), rng.normal(size=(1, 5)), np.array([0]))
    assert np.isnan(few.headline.detectable).all()
    assert np.isnan(few.tasks.detectable).all()
    many = associate(rng.normal(size=(2, 9, 5)), rng.normal(size=(9, 5)), np.repeat(0, 9))
    assert (many.headline.detectable < 1).all()


def test_a_p_that_no_permutation_reaches_could_have_found_nothing():
    """Three agents have 6 permutations: no p is below 1/6, however many settings there are."""
    rng = np.random.default_rng(11)
    found = associate(rng.normal(size=(2, 40, 3)), rng.normal(size=(40, 3)), np.repeat(0, 40))
    assert np.isnan(found.headline.detectable).all()
