"""Scores of a run, by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from harness.statistics import (
    early_psi,
    final_score,
    moved_together,
    training_psi,
    training_score,
    window_of,
)


def metrics(returns, psi=0.5, episodes=None, every=100) -> pd.DataFrame:
    steps = np.arange(1, len(returns) + 1) * every
    frame = pd.DataFrame(
        {"global_step": steps, "charts/episodic_return": returns, "conditioning/psi": psi}
    )
    return frame if episodes is None else frame.assign(**{"charts/episodes": episodes})


@pytest.mark.parametrize(
    ("total", "window"), [(1000, 100), (2_000_000, 200_000), (5_000_000, 200_000)]
)
def test_the_window_is_a_tenth_and_at_most_the_papers(total, window):
    assert window_of(total) == window


def test_episodes_that_ended_in_the_last_tenth_count_equally():
    # 20 updates of 100 steps: the last 200 steps are the last two
    returns = [9.0] * 18 + [1.0, 4.0]
    counts = [7] * 18 + [2, 1]
    assert training_score(metrics(returns, episodes=counts), 2000) == pytest.approx((1 + 1 + 4) / 3)
    assert training_score(metrics(returns), 2000) == 2.5


def test_a_score_does_not_depend_on_how_the_steps_are_cut():
    fine = metrics(np.repeat([9.0, 1.0, 3.0, 5.0], 5), every=100)
    coarse = metrics([9.0, 1.0, 3.0, 5.0], every=500)
    assert training_score(fine, 10_000) == training_score(coarse, 10_000) == 4.0  # last 1000 steps


def test_an_update_at_the_windows_edge_ended_before_it():
    assert training_score(metrics([8.0, 2.0], every=500), 5000) == 2.0  # of (500, 1000]


def test_without_an_episode_in_the_window_the_last_one_counts():
    returns = [9.0, 3.0, 7.0] + [np.nan] * 17
    counts = [1, 1, 2] + [0] * 17
    assert training_score(metrics(returns, episodes=counts), 2000) == 7.0


def test_updates_without_an_episode_have_no_weight():
    returns = [9.0] * 8 + [2.0, np.nan]
    assert training_score(metrics(returns, episodes=[1] * 9 + [0]), 2000) == 2.0


@pytest.mark.parametrize("returns", [[], [np.nan, np.nan]])
def test_no_episode_has_no_score(returns):
    assert np.isnan(training_score(metrics(returns), 1000))


def test_psi_is_taken_over_the_scores_window_and_the_first_tenth():
    frame = metrics(np.zeros(40), psi=np.arange(40.0))
    assert training_psi(frame, 4000) == np.mean([36, 37, 38, 39])
    assert early_psi(frame, 4000) == np.mean([0, 1, 2, 3])


def test_the_first_update_is_early_however_long_it_is():
    assert early_psi(metrics([0.0] * 3, psi=[7.0, 8.0, 9.0]), 300) == 7.0


def test_a_failed_run_has_its_last_finite_psi():
    psi = [1.0, 2.0, 3.0] + [np.inf, np.nan] * 9
    assert training_psi(metrics(np.zeros(21), psi=psi), 2100) == 3.0
    assert np.isnan(training_psi(metrics([0.0], psi=[np.nan]), 100))


def test_changes_are_correlated_and_levels_are_not():
    """Both rise all the time, but psi rises much where reward rises little."""
    psi_steps = [1.0, 4.0, 2.0, 3.0]
    reward_steps = [4.0, 1.0, 3.0, 2.0]
    frame = metrics(np.cumsum([0, *reward_steps]), psi=np.cumsum([0, *psi_steps]))
    assert moved_together(frame) == pytest.approx(-1.0)


def test_updates_without_an_episode_are_left_out_of_the_changes():
    frame = metrics([0.0, 1.0, np.nan, 4.0, 2.0, 9.0], psi=[0.0, 2.0, 50.0, 3.0, 3.5, 1.0])
    kept = frame.dropna()
    expected = stats.spearmanr(
        np.diff(kept["charts/episodic_return"]), np.diff(kept["conditioning/psi"])
    ).statistic
    assert moved_together(frame) == pytest.approx(expected)


@pytest.mark.parametrize("returns", [[1.0, 2.0, 4.0], [1.0, np.nan, 2.0, 4.0], [4.0] * 6])
def test_too_little_or_nothing_moved_together(returns):
    assert np.isnan(moved_together(metrics(returns, psi=np.arange(len(returns)) ** 2.0)))


def test_the_final_policys_score_is_the_mean_of_one_kind_of_episode():
    episodes = pd.DataFrame(
        {"policy": ["deterministic", "sampled", "deterministic"], "return": [1.0, 100.0, 4.0]}
    )
    assert final_score(episodes) == 2.5
    assert final_score(episodes, "sampled") == 100.0
    assert np.isnan(final_score(episodes.iloc[1:2]))
