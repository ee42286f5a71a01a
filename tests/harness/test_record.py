"""What a finished run is thinned to, and when two are the same."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest

from baselines import ppo_reg
from harness.record import Record, block_of, thin
from harness.suite import RunSpec

NAN = math.nan


def test_a_block_is_one_row_by_hand():
    metrics = pd.DataFrame(
        {
            "global_step": [10, 20, 30, 40, 50],
            "charts/episodic_return": [1.0, 4.0, NAN, NAN, 7.0],
            "charts/episodes": [1, 2, 0, 0, 3],
            "conditioning/psi": [1.0, 3.0, 5.0, 7.0, 9.0],
            "conditioning/gradient_share": [NAN, 0.5, NAN, NAN, NAN],
        }
    )
    expected = pd.DataFrame(
        {
            "global_step": [20, 40, 50],
            "charts/episodic_return": [3.0, NAN, 7.0],  # (1 · 1 + 2 · 4) / 3
            "charts/episodes": [3, 0, 3],
            "conditioning/psi": [2.0, 6.0, 9.0],
            "conditioning/gradient_share": [0.5, NAN, NAN],
        }
    )
    pd.testing.assert_frame_equal(thin(metrics, 2), expected)
    pd.testing.assert_frame_equal(thin(metrics, 1), metrics)


@pytest.mark.parametrize(
    "column", ["charts/episodic_return", "charts/episodic_length", "charts/success_rate"]
)
def test_means_over_episodes_are_weighted_by_their_number(column):
    metrics = pd.DataFrame(
        {
            "global_step": [1, 2, 3, 4],
            column: [1.0, 5.0, NAN, 7.0],
            "charts/episodes": [3, 1, 0, 1],
        }
    )
    rows = thin(metrics, 2)
    assert rows[column].tolist() == [2.0, 7.0]  # (3 · 1 + 1 · 5) / 4, and one episode's own
    assert rows["charts/episodes"].tolist() == [4, 1]


def test_where_episodes_were_not_counted_each_update_with_any_counts_once():
    metrics = pd.DataFrame({"global_step": [1, 2, 3], "charts/episodic_return": [1.0, NAN, 5.0]})
    assert thin(metrics, 3)["charts/episodic_return"].tolist() == [3.0]
    assert thin(metrics[1:], 2)["charts/episodic_return"].tolist() == [5.0]  # whatever the index


def test_thinning_keeps_the_mean_over_all_episodes():
    rng = np.random.default_rng(0)
    episodes = rng.integers(0, 5, 240)
    returns = np.where(episodes > 0, rng.normal(size=240), NAN)
    metrics = pd.DataFrame(
        {"global_step": np.arange(240), "charts/episodic_return": returns,
         "charts/episodes": episodes}
    )  # fmt: skip
    rows = thin(metrics, 24)
    assert len(rows) == 10
    mean = np.average(rows["charts/episodic_return"], weights=rows["charts/episodes"])
    every = np.average(returns[episodes > 0], weights=episodes[episodes > 0])
    assert mean == pytest.approx(every)


@pytest.mark.parametrize(
    ("steps", "block"), [(2000, 1), (200_000, 1), (202_000, 2), (5_000_000, 25), (5_002_000, 26)]
)
def test_curves_have_at_most_100_points(steps, block):
    spec = {"baseline": "ppo_reg", "args": {"total_timesteps": steps}}
    assert block_of(spec) == block


@pytest.fixture
def record(tmp_path):
    return Record(
        place=tmp_path,
        run_id="ppo__Hopper__s1__a0",
        spec={"baseline": "ppo_reg", "args": {"total_timesteps": 4000}},
        done={"sha256": {"metrics.csv": "1"}},
        scores={"training_score": 1.0, "early_psi": NAN, "final/charts/SPS": 100.0},
        updates=1,
        curves=pd.DataFrame({"global_step": [2000, 4000]}),
        evaluation=pd.DataFrame({"return": [1.0, NAN]}),
    )


def changed(record, **changes) -> Record:
    return dataclasses.replace(record, done={"sha256": {"metrics.csv": "2"}}, **changes)


def test_the_same_files_or_the_same_outcome_at_another_speed_are_one_run(record):
    other = {**record.scores, "final/charts/SPS": 50.0, "early_psi": float("nan")}
    assert record.same(changed(record, scores=other, evaluation=record.evaluation.copy()))
    assert record.same(dataclasses.replace(record, scores={}))  # its files are the same
    assert changed(record, evaluation=None).same(changed(record, evaluation=None))


@pytest.mark.parametrize(
    "changes",
    [
        {"scores": {"training_score": 1.5, "early_psi": NAN, "final/charts/SPS": 100.0}},
        {"scores": {"training_score": 1.0, "early_psi": 0.0, "final/charts/SPS": 100.0}},
        {"evaluation": pd.DataFrame({"return": [1.0, 2.0]})},
        {"evaluation": None},
    ],
    ids=["score", "number for NaN", "episode", "no evaluation"],
)
def test_another_outcome_is_told(record, changes):
    assert not record.same(changed(record, **changes))
    assert not changed(record, **changes).same(record)


def test_a_record_cannot_be_changed_and_knows_its_length(record):
    assert record.total_timesteps == 4000
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.updates = 2


def test_a_record_is_compared_with_what_is_asked_for(record):
    args = {"total_timesteps": 4000, "env_id": "x"}
    record = dataclasses.replace(
        record, spec={"baseline": "ppo_reg", "version": ppo_reg.VERSION, "args": args}
    )
    spec = RunSpec("suite", "PPO", "Hopper", "ppo_reg", args)
    assert record.changes(spec) == {}
    assert record.changes(spec.with_args(gamma=0.5)) == {"gamma": (0.99, 0.5)}


def test_a_run_that_diverged_is_not_the_one_that_did_not(record):
    other = changed(record)
    other.done["state"] = "diverged"
    assert (record.state, other.state) == ("done", "diverged")
    assert not record.same(other)
