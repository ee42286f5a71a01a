"""Cost measured in turn, with runs that take known times."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pandas as pd
import pytest

from harness import cost
from harness.cost import CostError, measure_in_turn
from harness.suite import SuiteError

HERE = {"commit": "0123456789abcdef", "clean": False, "processor": "Fast 9", "cores": 2}
ENVIRONMENTS = {"Hopper": "Hopper-id", "Ant": "Ant-id"}


@pytest.fixture
def commands(monkeypatch) -> list[list[str]]:
    """Runs that say they took 5 s for the first 100 steps, then 1 ms a step, with the penalty 2."""
    given = []

    def run(command, **_):
        given.append(command)
        plain = command[command.index("--run-dir") + 2 :][:2] == ["--coefficient", "0.0"]
        steps = pd.Series([100, 200, 300])
        seconds = 5 + (steps - 100) * (1e-3 if plain else 2e-3)
        folder = Path(command[command.index("--run-dir") + 1].replace("{agent}", "0"))
        folder.mkdir()
        metrics = pd.DataFrame({"global_step": steps, "charts/SPS": steps / seconds})
        metrics.to_csv(folder / "metrics.csv", index=False)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(cost.subprocess, "run", run)
    monkeypatch.setattr(cost, "here", lambda: HERE)
    return given


def test_a_repetition_is_a_pair_without_its_first_update(commands):
    timed = measure_in_turn(ENVIRONMENTS, ["single file"], 2, 3, lambda _: None)
    assert len(timed) == 2 * 2 * 2  # repetitions, algorithms, tasks
    assert timed["plain"].tolist() == pytest.approx([1e-3] * 8)
    assert timed["reg"].tolist() == pytest.approx([2e-3] * 8)
    assert timed["environment"].tolist()[:2] == ["Hopper", "Ant"]
    assert len(commands) == 16


def test_each_repetition_says_where_and_when_it_was_measured(commands, monkeypatch):
    times = iter(["2026-02-03T04:05:06+00:00", "2026-02-03T04:05:07+00:00"])
    monkeypatch.setattr(cost, "now", lambda: next(times))
    timed = measure_in_turn({"Hopper": "Hopper-id"}, ["compiled"], 2, 3, lambda _: None)
    assert timed["commit"].tolist() == ["0123456789+"] * 2
    assert timed["machine"].tolist() == ["Fast 9, 2 cores"] * 2
    assert timed["date"].tolist() == ["2026-02-03T04:05:06+00:00", "2026-02-03T04:05:07+00:00"]


def test_the_arms_change_who_goes_first(commands):
    measure_in_turn({"Hopper": "Hopper-id"}, ["population"], 2, 3, lambda _: None)
    plain = ["--coefficient" in command for command in commands]
    assert plain == [True, False, True, False, False, True, False, True]
    assert {command[2] for command in commands} == {
        "baselines.ppo_reg_population", "baselines.trpo_reg_population",
    }  # fmt: skip


def test_trpo_is_not_compiled(commands):
    timed = measure_in_turn({"Hopper": "Hopper-id"}, ["compiled"], 1, 3, lambda _: None)
    assert timed["algorithm"].tolist() == ["PPO"]
    assert all("--compile" in command for command in commands)
    assert all("6000" in command for command in commands)  # 3 updates of 2000 steps


@pytest.mark.parametrize(("repetitions", "updates"), [(0, 3), (1, 2)])
def test_too_little_is_refused(repetitions, updates):
    with pytest.raises(SuiteError, match=f"got {repetitions} and {updates}"):
        measure_in_turn(ENVIRONMENTS, ["single file"], repetitions, updates)


def test_a_run_that_fails_says_why(monkeypatch):
    failed = subprocess.CompletedProcess([], 1, "", "no such environment")
    monkeypatch.setattr(cost.subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(CostError, match="no such environment"):
        measure_in_turn(ENVIRONMENTS, ["single file"], 1, 3, lambda _: None)
