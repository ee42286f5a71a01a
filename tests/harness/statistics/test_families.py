"""Holm's correction, by hand and by SciPy's cousins."""

from __future__ import annotations

import numpy as np
import pytest

from harness.statistics import ALPHA, holm
from harness.statistics.families import shares_left


def test_equal_weights_by_hand():
    # sorted: 0.01 * 4, 0.02 * 3, 0.03 * 2, 0.04 * 1 and never falling
    np.testing.assert_allclose(holm([0.03, 0.01, 0.04, 0.02]), [0.06, 0.04, 0.06, 0.06])


def test_weights_by_hand():
    # p / weight: 0.02 / 0.8 before 0.01 / 0.1 before 0.04 / 0.1, then never falling
    found = holm([0.02, 0.01, 0.04], np.array([0.8, 0.1, 0.1]))
    np.testing.assert_allclose(found, [0.025, 0.025, 0.04])


def test_what_is_decided_passes_its_share_on():
    weights = np.array([0.8, 0.2])
    assert holm([0.5, 0.02], weights)[1] == pytest.approx(0.02 / 0.2)
    assert holm([0.001, 0.02], weights)[1] == pytest.approx(0.02)


def test_scaling_all_weights_changes_nothing():
    p = np.array([0.2, 0.01, 0.03])
    np.testing.assert_allclose(holm(p, np.array([1, 2, 3])), holm(p, np.array([10, 20, 30])))


def test_tests_that_were_not_made_have_no_weight():
    np.testing.assert_allclose(holm([0.01, np.nan, 0.02]), [0.02, np.nan, 0.02])
    assert np.isnan(holm([np.nan, np.nan])).all()


def test_no_p_value_is_above_1():
    np.testing.assert_allclose(holm([0.6, 0.9]), [1.0, 1.0])


def test_families_do_not_mix():
    p = np.random.default_rng(1).random((3, 5, 4))
    np.testing.assert_allclose(holm(p)[2, 3], holm(p[2, 3]))


@pytest.mark.parametrize("weights", [None, np.array([0.7, 0.1, 0.1, 0.1])])
def test_a_family_of_nulls_is_rejected_in_one_case_of_twenty(weights):
    p = np.random.default_rng(2).random((20_000, 4))
    assert (holm(p, weights) <= 0.05).any(axis=1).mean() == pytest.approx(0.05, abs=0.005)


def test_decided_tests_pass_their_share_on():
    """Weights 4, 4, 1, 1 of 10; the first test is decided, and the last was not made."""
    weights = np.array([0.4, 0.4, 0.1, 0.1])
    none = shares_left(np.array([0.3, 0.3, 0.3, 0.3]), weights)
    np.testing.assert_allclose(none, weights)
    found = shares_left(np.array([0.01, 0.3, 0.3, np.nan]), weights)
    np.testing.assert_allclose(found, [4 / 9, 4 / 5, 1 / 5, np.nan])
    np.testing.assert_allclose(shares_left(np.full(4, ALPHA), weights), 1.0)


def test_a_test_is_called_by_holm_where_it_is_within_its_share():
    rng = np.random.default_rng(5)
    weights = rng.random((500, 6))
    p = rng.random((500, 6)) ** 3 / 10
    corrected = holm(p, weights)
    called = p <= ALPHA * shares_left(corrected, weights)
    np.testing.assert_array_equal(called, corrected <= ALPHA)
