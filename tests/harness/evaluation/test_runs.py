"""A run's evaluation is made once: what is kept, what is made again, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from baselines import ppo_reg, trpo_reg
from harness.evaluation import control, levels, runs
from harness.evaluation.runs import evaluate_run
from harness.evaluation.settings import EvaluationError, Settings
from tests.harness.evaluation.toy import write_checkpoint

# --- a run of CoinRun -----------------------------------------------------------------------------


class Quick:
    """Stands in for playing: a row for each level and policy, and how often it was asked."""

    def __init__(self, monkeypatch) -> None:
        self.calls: list[list[int]] = []
        self.recorded: list[tuple[str, int]] = []
        monkeypatch.setattr(levels, "evaluate_levels", self.play)
        monkeypatch.setattr(levels, "record", self.record)

    def play(self, agent, args, levels, repeats):
        self.calls.append(levels)
        for policy, times in (("sampled", repeats), ("greedy", 1)):
            places = {"level": np.repeat(levels, times), "repeat": [*range(times)] * len(levels)}
            found = {"success": True, "return": 10.0, "length": 7}
            yield pd.DataFrame({**places, "policy": policy, **found})

    def record(self, agent, args, level, path):
        self.recorded.append((path.name, level))


@pytest.fixture
def quick(monkeypatch) -> Quick:
    return Quick(monkeypatch)


@pytest.fixture
def path(coinrun_run, tmp_path) -> Path:
    """A copy of the trained run."""
    return Path(shutil.copytree(coinrun_run[0], tmp_path / "run"))


def judge(path: Path, **changed) -> pd.DataFrame:
    return evaluate_run(path, Settings(**{"levels": 2, "repeats": 2, "device": "cpu", **changed}))


def test_a_second_call_reads_what_the_first_found(path, quick):
    first = judge(path)
    assert quick.calls == [[0, 250], [500, 750]]
    assert quick.recorded == [("seen.gif", 0), ("unseen.gif", 500)]
    pd.testing.assert_frame_equal(judge(path), first)
    assert len(quick.calls) == 2


@pytest.mark.parametrize("changed", [{"levels": 3}, {"repeats": 1}, {"unseen": "unbounded"}])
def test_other_settings_are_played(path, quick, changed):
    judge(path)
    judge(path, **changed)
    assert len(quick.calls) == 4
    pd.testing.assert_frame_equal(judge(path, **changed), pd.read_csv(path / "evaluation.csv"))
    assert len(quick.calls) == 4


def test_another_checkpoint_is_played(path, quick):
    judge(path)
    saved = torch.load(path / "checkpoint.pt", weights_only=True)
    saved["learner"]["agent"]["policy.bias"] += 1
    torch.save(saved, path / "checkpoint.pt")
    judge(path)
    assert len(quick.calls) == 4


def test_the_evaluation_of_a_suites_run_is_not_overwritten(path, quick):
    first = judge(path)
    (path / "done.json").write_text("{}")
    with pytest.raises(EvaluationError, match=r"a suite's run, evaluated with .*: copy it"):
        judge(path, repeats=1)
    pd.testing.assert_frame_equal(judge(path), first)
    (path / "evaluation.csv").unlink()
    judge(path)  # lost, and so made again
    assert len(quick.calls) == 4


def test_what_is_killed_before_its_last_file_is_played_again(path, quick, monkeypatch):
    judge(path)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(runs, "write_json", killed)
        with pytest.raises(KeyboardInterrupt):
            judge(path, repeats=1)
    assert not (path / "evaluation.json").exists()
    assert len(judge(path, repeats=2)) == 2 * 2 * 3  # not what the killed one has left
    assert len(quick.calls) == 6


def test_what_is_killed_while_it_plays_leaves_what_was_there(path, quick, monkeypatch):
    before = judge(path)
    with monkeypatch.context() as patch:
        patch.setattr(levels, "record", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            judge(path, repeats=1)
    pd.testing.assert_frame_equal(judge(path), before)
    assert len(quick.calls) == 4


def test_it_shows_how_far_it_is(path, quick, monkeypatch):
    monkeypatch.setattr(levels, "POOLS", 500)
    totals = []

    def show(parts, total):
        parts = list(parts)
        totals.append((len(parts), total))
        return parts

    evaluate_run(path, Settings(levels=3, repeats=1, device="cpu"), show)
    assert totals == [(4, 4)]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"repeats": 0}, "repeats must be at least 1, got 0"),
        ({"levels": 501}, "levels must be from 1 to 500, got 501"),
    ],
)
def test_bad_settings_are_refused(path, changed, message):
    with pytest.raises(EvaluationError, match=message):
        judge(path, **changed)
    assert not (path / "evaluation.json").exists()


def test_a_device_that_is_not_there_is_refused(path):
    with pytest.raises(EvaluationError, match="device cuda:99 cannot be used"):
        judge(path, device="cuda:99")


# --- a control run --------------------------------------------------------------------------------


@pytest.fixture
def played(monkeypatch) -> list[int]:
    """How many episodes were asked for, each time that an agent was really played."""
    asked: list[int] = []
    evaluate = control.evaluate

    def counted(checkpoint, episodes):
        asked.append(episodes)
        return evaluate(checkpoint, episodes)

    monkeypatch.setattr(control, "evaluate", counted)
    return asked


@pytest.mark.parametrize("module", [ppo_reg, trpo_reg])
def test_a_control_run_is_kept_with_what_was_asked(tmp_path, played, module):
    write_checkpoint(tmp_path, module)
    first = evaluate_run(tmp_path, Settings(episodes=3))
    kept = pd.read_csv(tmp_path / "evaluation.csv")
    pd.testing.assert_frame_equal(kept, first, check_exact=True)
    assert len(first) == 2 * 3
    about = json.loads((tmp_path / "evaluation.json").read_text())
    assert set(about) == {"episodes", "checkpoint_sha256"}
    assert about["episodes"] == 3
    again = evaluate_run(tmp_path, Settings(episodes=3))
    pd.testing.assert_frame_equal(again, first, check_exact=True)
    assert played == [3]


def test_another_number_of_episodes_or_agent_is_played(tmp_path, played):
    write_checkpoint(tmp_path)
    evaluate_run(tmp_path, Settings(episodes=1))
    evaluate_run(tmp_path, Settings(episodes=2))
    write_checkpoint(tmp_path, log_std=-1.0)
    evaluate_run(tmp_path, Settings(episodes=2))
    assert played == [1, 2, 2]


def test_the_control_evaluation_of_a_suites_run_is_not_overwritten(tmp_path, played):
    write_checkpoint(tmp_path)
    evaluate_run(tmp_path, Settings(episodes=1))
    (tmp_path / "done.json").write_text("{}")
    with pytest.raises(EvaluationError, match=r"a suite's run, evaluated with .*: copy it"):
        evaluate_run(tmp_path, Settings(episodes=2))
    assert played == [1]


def test_by_default_there_are_20_episodes_of_each_policy(tmp_path, played):
    write_checkpoint(tmp_path)
    totals = []

    def show(parts, total):
        totals.append(total)
        return parts

    found = evaluate_run(tmp_path, Settings(), show)
    assert found.groupby("policy").size().to_dict() == {"deterministic": 20, "sampled": 20}
    assert totals == [40]
    assert played == [20]


@pytest.mark.parametrize(
    ("changed", "flag"),
    [({"levels": 3}, "--levels 3"), ({"unseen": "themes"}, "--unseen themes"),
     ({"repeats": 3}, "--repeats 3"), ({"device": "cuda"}, "--device cuda")],
)  # fmt: skip
def test_flags_for_coinrun_are_refused_by_a_control_run(tmp_path, changed, flag):
    write_checkpoint(tmp_path)
    message = f"is a run of ppo_reg, which is evaluated by --episodes: leave out {flag}"
    with pytest.raises(EvaluationError, match=message):
        evaluate_run(tmp_path, Settings(**changed))
    assert not (tmp_path / "evaluation.json").exists()


def test_flags_for_control_are_refused_by_a_run_of_coinrun(path):
    flags = "--device and --levels and --repeats and --unseen: leave out --episodes 3"
    with pytest.raises(EvaluationError, match=f"of ppo_reg_coinrun, .* by {flags}"):
        judge(path, episodes=3)


@pytest.mark.parametrize("name", ["episodes", "levels", "repeats"])
def test_counts_start_at_1(name):
    with pytest.raises(EvaluationError, match=f"{name} must be at least 1, got 0"):
        Settings(**{name: 0})


def test_what_is_asked_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Settings().episodes = 0
