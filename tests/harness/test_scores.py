"""The exact numbers of a run, each against a value worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from harness.scores import correlation_of_steps, exact_scores, in_window, training_score

NAN = math.nan


def metrics(returns, episodes=None, psi=None, step=100) -> pd.DataFrame:
    columns = {
        "global_step": step * np.arange(1, len(returns) + 1),
        "charts/episodic_return": returns,
    }
    if episodes is not None:
        columns["charts/episodes"] = episodes
    if psi is not None:
        columns["conditioning/psi"] = psi
    return pd.DataFrame(columns)


def test_the_window_is_a_tenth_of_the_run_and_at_most_200_000_steps():
    assert in_window(metrics(np.zeros(20)), 2000).sum() == 2
    assert in_window(metrics(np.zeros(20)), 2050).sum() == 3  # the row of which a part is in it
    long = metrics(np.zeros(2500), step=2000)
    assert in_window(long, 5_000_000).sum() == 100


def test_episodes_count_equally_not_updates():
    rows = metrics([9.0] * 18 + [1.0, 4.0], [1] * 18 + [1, 2])
    assert training_score(rows, 2000) == 3.0  # (1 · 1 + 2 · 4) / 3
    rows = metrics([9.0] * 18 + [1.0, 4.0])
    assert training_score(rows, 2000) == 2.5  # without counts


def test_the_last_update_with_an_episode_stands_in_for_an_empty_window():
    rows = metrics([1.0, 5.0, 7.0, NAN, NAN], [1, 1, 2, 0, 0])
    assert training_score(rows, 500) == 7.0
    assert np.isnan(training_score(metrics([NAN, NAN], [0, 0]), 200))


def test_all_scores_by_hand():
    psi = [4.0, 2.0, *[0.0] * 16, 5.0, 6.0]
    rows = metrics([1.0] * 18 + [2.0, 4.0], [1] * 20, psi)
    rows["charts/SPS"] = [100.0] * 19 + [50.0]
    found = exact_scores(rows, 2000)
    assert found["training_score"] == found["final/charts/episodic_return"] == 3.0
    assert found["early_psi"] == 3.0
    assert found["final/conditioning/psi"] == 5.5
    assert found["final/charts/SPS"] == 50.0
    assert (found["steps"], found["updates"]) == (2000.0, 20.0)


def test_the_correlation_within_a_run_is_of_first_differences():
    # psi's steps 1, 2, -1, 3; the return's 2, 1, 3, -4: ranks 2, 3, 1, 4 and 3, 2, 4, 1.
    rows = metrics([0.0, 2.0, 3.0, 6.0, 2.0], psi=[0.0, 1.0, 3.0, 2.0, 5.0])
    assert correlation_of_steps(rows) == pytest.approx(-1.0)
    both_grow = metrics([0.0, 1.0, 3.0, 4.0, 6.0], psi=[0.0, 2.0, 3.0, 5.0, 6.0])
    assert correlation_of_steps(both_grow) == pytest.approx(-1.0)  # though both grow
    assert np.isnan(correlation_of_steps(metrics([0.0, 1.0], psi=[0.0, 1.0])))


def test_a_run_without_psi_has_its_other_scores():
    found = exact_scores(metrics([1.0, 2.0]), 200)
    assert found["training_score"] == 2.0
    assert "early_psi" not in found
