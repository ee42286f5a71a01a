"""The table of agents, and scores of those that failed."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from harness.report.claims import agent_table
from harness.report.claims.agents import fill_failed
from harness.report.results import load_results
from harness.store import write_json
from tests.harness.conftest import make_control_episodes, write_run


def table(suite, store) -> dict[str, object]:
    (row,) = agent_table(load_results(suite, store)).to_dict("records")
    return row


def test_an_agent_is_a_row_with_its_early_and_late_numbers(store, suite):
    spec = suite.runs[1]  # 200 steps, so the window is 20 and the first tenth too
    columns = {"global_step": np.arange(1, 21) * 10, "charts/episodes": [1] * 18 + [3, 1]}
    write_run(store, spec, np.arange(20.0), np.arange(20.0) ** 2, columns=columns)
    row = table(suite, store)
    assert (row["environment"], row["algorithm"]) == ("Hopper", "PPO")
    assert (row["seed"], row["agent"], row["updates"], row["steps"]) == (1, 1, 20, 200)
    assert row["reward"] == (18 * 3 + 19) / 4
    assert row["psi"] == (18**2 + 19**2) / 2
    assert row["early_psi"] == 0.5
    assert (row["done"], row["failed"]) == (True, False)


def test_the_changes_of_psi_and_reward_are_correlated(store, suite):
    # changes 1, 3, 2 of reward and 5, 1, 2 of psi: d = 2, 2, 0, so 1 - 6 * 8 / 24
    write_run(store, suite.runs[0], [0.0, 1.0, 4.0, 6.0], [0.0, 5.0, 6.0, 8.0])
    assert table(suite, store)["together"] == pytest.approx(-1.0)


def test_agents_that_have_not_begun_have_no_row(store, suite):
    write_run(store, suite.runs[5], [1.0, 2.0], done=False)
    row = table(suite, store)
    assert (row["environment"], row["seed"], row["agent"]) == ("Reacher", 1, 1)
    assert (row["done"], row["failed"], row["updates"]) == (False, False, 2)


def test_the_final_policy_is_beside(store, suite):
    episodes = make_control_episodes([1.0, 3.0], [5.0])
    write_run(store, suite.runs[0], [0.0], episodes=episodes)
    row = table(suite, store)
    assert (row["final"], row["final_sampled"]) == (2.0, 5.0)


def test_an_agent_that_was_not_evaluated_has_no_final_score(store, suite):
    write_run(store, suite.runs[0], [0.0])
    assert np.isnan(table(suite, store)["final"])


def test_a_failed_agent_has_no_score_and_its_last_finite_psi(store, suite):
    write_run(store, suite.runs[0], [9.0, 8.0], [0.5, np.nan], diverged=True)
    row = table(suite, store)
    assert (row["failed"], row["done"], row["psi"]) == (True, True, 0.5)
    assert np.isnan(row["reward"])


def test_an_agent_that_failed_before_its_first_update_counts(store, suite):
    spec = suite.runs[0]
    store.start(spec, ["true"], [spec])
    failure = {"update": 1, "what": "loss", "message": "loss is NaN"}
    write_json(store.path(spec, "diverged.json"), failure)
    store.finish(spec, returncode=3, seconds=1.0)
    row = table(suite, store)
    assert (row["failed"], row["updates"], row["steps"]) == (True, 0, 0)


def test_plain_agents_have_neither_penalty_nor_noise(study):
    algorithms = ("PPO", "PPO reg", "TRPO", "TRPO reg", "PPO setting 2", "PPO noise")
    agents = agent_table(study(lambda *_: 1.0, algorithms=algorithms, agents=2, updates=2))
    plain = agents.groupby("algorithm")["plain"].first()
    assert set(plain[plain].index) == {"PPO", "TRPO", "PPO setting 2"}


def test_no_runs_are_an_empty_table(store, suite):
    agents = agent_table(load_results(suite, store))
    assert len(agents) == 0
    assert {"environment", "algorithm", "plain", "reward", "psi", "failed"} <= set(agents)


def scored(*rows) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["environment", "failed", "reward"])


def test_a_failed_run_has_the_worst_score_of_its_task():
    agents = scored(
        ("Ant", False, 3.0), ("Ant", True, np.nan), ("Ant", False, -2.0), ("Hopper", False, -9.0)
    )
    assert fill_failed(agents, "reward")["reward"].tolist() == [3.0, -2.0, -2.0, -9.0]


def test_where_all_failed_all_are_equal():
    agents = scored(("Ant", True, np.nan), ("Ant", True, np.nan), ("Hopper", False, 4.0))
    assert fill_failed(agents, "reward")["reward"].tolist() == [0.0, 0.0, 4.0]


def test_without_failures_missing_scores_stay_missing():
    agents = scored(("Ant", False, np.nan), ("Ant", False, 1.0))
    pd.testing.assert_frame_equal(fill_failed(agents, "reward"), agents)


@pytest.mark.parametrize("column", ["reward", "psi"])
def test_only_the_asked_column_is_filled(column):
    agents = scored(("Ant", True, np.nan), ("Ant", False, 1.0)).assign(psi=[np.nan, 2.0])
    filled = fill_failed(agents, column)
    other = {"reward": "psi", "psi": "reward"}[column]
    assert filled[column].notna().all()
    assert filled[other].isna().tolist() == [True, False]
