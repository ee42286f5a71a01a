"""The measures of smoothness: values worked out by hand, and what they do not depend on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from harness.evaluation.smoothness import action_change, smoothness

SECONDS = np.arange(8) / 8  # a second of 8 actions
SINE = 3 * np.sin(2 * np.pi * 2 * SECONDS)  # of amplitude 3, twice a second
ACTIONS = arrays.arrays(np.float64, st.tuples(st.integers(2, 20), st.integers(1, 3)),
                        elements=st.floats(-1, 1))  # fmt: skip


def column(*values: float) -> np.ndarray:
    return np.array(values, dtype=float)[:, None]


def test_a_sine_has_its_amplitude_at_its_frequency():
    """n = 5 frequencies, 0 to 4 Hz: 2 / (5 · 8) · 3 · 2."""
    assert smoothness(SINE[:, None], rate=8.0) == pytest.approx(0.3)


def test_the_last_frequency_of_an_even_length_counts_once():
    """1, -1, ... is a cosine of amplitude 1 at 4 Hz, half the rate: 2 / (5 · 8) · 1 · 4."""
    assert smoothness(column(*[1, -1] * 4), rate=8.0) == pytest.approx(0.2)


def test_the_last_frequency_of_an_odd_length_counts_twice():
    """|1 - w + w²| = 2 for w = exp(-2 pi i / 3), so M = 2 · 2 / 3 at f = rate / 3, and n = 2."""
    assert smoothness(column(1, -1, 1), rate=6.0) == pytest.approx(4 / 9)


def test_two_sines_add_up_and_the_level_does_not_count():
    both = 5 + SINE + np.cos(2 * np.pi * 3 * SECONDS)
    assert smoothness(both[:, None], rate=8.0) == pytest.approx(0.3 + 2 / 40 * 3)


def test_it_is_the_mean_over_the_actions_dimensions():
    actions = np.stack([SINE, np.ones(8), 2 * SINE], axis=1)
    assert smoothness(actions, rate=8.0) == pytest.approx((0.3 + 0 + 0.6) / 3)


@settings(max_examples=50, deadline=None)
@given(ACTIONS, st.floats(0.1, 1000), st.floats(0.1, 10))
def test_it_scales_with_the_actions_and_not_with_the_rate(actions, rate, factor):
    value = smoothness(actions, rate=1.0)
    assert value >= 0
    assert smoothness(actions, rate) == pytest.approx(value)
    assert smoothness(factor * actions, rate) == pytest.approx(factor * value)


def test_the_change_of_actions_by_hand():
    """|1| + |-1| + |0| + |2| over two steps of two dimensions."""
    assert action_change(np.array([[0.0, 0.0], [1.0, -1.0], [1.0, 1.0]])) == 1.0


@pytest.mark.parametrize("measure", [action_change, lambda actions: smoothness(actions, 8.0)])
def test_constant_actions_are_smooth_and_one_action_has_no_measure(measure):
    assert measure(np.full((5, 2), 0.7)) == pytest.approx(0, abs=1e-12)
    assert math.isnan(measure(np.ones((1, 2))))


def test_two_actions_have_both_measures():
    """A change of 2; M = 1 at half the rate, of n = 2 frequencies: 2 / (2 · 8) · 1 · 4."""
    assert action_change(column(1, -1)) == 2.0
    assert smoothness(column(1, -1), rate=8.0) == pytest.approx(0.5)
