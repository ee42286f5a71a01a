"""The exact numbers of a run, each against a value worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from harness.scores import exact_scores
from harness.statistics.scores import early_psi, moved_together, training_psi, training_score

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


@pytest.mark.parametrize(
    ("updates", "step", "total", "inside"),
    [
        (20, 100, 2000, 2),
        (20, 100, 2050, 3),  # the row of which a part is in it
        (2500, 2000, 5_000_000, 100),
    ],
)
def test_the_window_is_a_tenth_of_the_run_and_at_most_200_000_steps(updates, step, total, inside):
    rows = metrics(np.arange(updates), psi=np.arange(updates) ** 2.0, step=step)
    last = np.arange(updates)[-inside:]
    assert training_score(rows, total) == last.mean()
    assert training_psi(rows, total) == (last**2.0).mean()


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
    psi = [4.0, 2.0, *[0.0] * 16, 5.0, 6.0]  # two of 20 rows are early, two are late
    rows = metrics([1.0] * 18 + [2.0, 4.0], [1] * 20, psi)
    rows["charts/SPS"] = [100.0] * 19 + [50.0]
    found = exact_scores(rows, 2000)
    assert found["training_score"] == found["final/charts/episodic_return"] == 3.0
    assert found["early_psi"] == 3.0
    assert found["psi"] == found["final/conditioning/psi"] == 5.5
    assert found["final/charts/SPS"] == 50.0
    assert (found["steps"], found["updates"]) == (2000.0, 20.0)


def test_the_correlation_within_a_run_is_of_first_differences():
    # psi's steps 1, 2, -1, 3; the return's 2, 1, 3, -4: ranks 2, 3, 1, 4 and 3, 2, 4, 1.
    rows = metrics([0.0, 2.0, 3.0, 6.0, 2.0], psi=[0.0, 1.0, 3.0, 2.0, 5.0])
    assert moved_together(rows) == pytest.approx(-1.0)
    both_grow = metrics([0.0, 1.0, 3.0, 4.0, 6.0], psi=[0.0, 2.0, 3.0, 5.0, 6.0])
    assert moved_together(both_grow) == pytest.approx(-1.0)  # though both grow
    assert np.isnan(moved_together(metrics([0.0, 1.0], psi=[0.0, 1.0])))
    assert np.isnan(moved_together(metrics([0.0, 1.0, 3.0, 4.0], psi=[1.0] * 4)))


def test_a_run_without_psi_has_its_other_scores():
    found = exact_scores(metrics([1.0, 2.0]), 200)
    assert found["training_score"] == 2.0
    assert "early_psi" not in found


def test_psi_that_is_not_finite_is_left_out():
    rows = metrics([1.0] * 20, psi=[math.inf, 2.0, *[0.0] * 15, 7.0, NAN, NAN])
    assert early_psi(rows, 2000) == 2.0
    assert training_psi(rows, 2000) == 7.0  # the last finite one


def test_the_first_update_is_early_where_it_is_longer_than_a_tenth():
    assert early_psi(metrics([1.0, 2.0], psi=[3.0, 5.0]), 200) == 3.0
