"""Reading a checkpoint: whose it is, and what is refused; nothing in it is executed."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
from pathlib import Path

import pytest
import torch

from baselines import ppo_reg, trpo_reg
from harness.evaluation.checkpoint import read_checkpoint
from harness.evaluation.settings import EvaluationError
from tests.harness.evaluation.toy import write_checkpoint


@pytest.fixture(params=["control", "coinrun"])
def path(request, tmp_path, coinrun_run) -> Path:
    """The folder of a run of each kind."""
    if request.param == "control":
        write_checkpoint(tmp_path / "run")
        return tmp_path / "run"
    return Path(shutil.copytree(coinrun_run[0], tmp_path / "run"))


@pytest.mark.parametrize("module", [ppo_reg, trpo_reg])
def test_a_checkpoint_is_known_by_its_settings(tmp_path, module):
    args = write_checkpoint(tmp_path, module, seed=4, gamma=0.9)
    found = read_checkpoint(tmp_path)
    assert found.module is module
    assert (found.path, found.args.seed, found.args.gamma) == (tmp_path, 4, 0.9)
    assert found.args.hidden_sizes == args.hidden_sizes
    content = (tmp_path / "checkpoint.pt").read_bytes()
    assert found.sha256 == hashlib.sha256(content).hexdigest()


def test_a_run_of_coinrun_is_known_by_its_settings(coinrun_run):
    assert read_checkpoint(coinrun_run[0]).baseline == "ppo_reg_coinrun"


class Malicious:
    """Unpickled, it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("where", ["args", "learner", "more"])
def test_a_malicious_checkpoint_is_refused_and_executes_nothing(path, tmp_path, where):
    saved = torch.load(path / "checkpoint.pt", weights_only=True)
    saved.setdefault(where, {})["evil"] = Malicious(tmp_path / "owned")
    torch.save(saved, path / "checkpoint.pt")
    with pytest.raises(EvaluationError, match=r"checkpoint\.pt cannot be read"):
        read_checkpoint(path)
    assert not (tmp_path / "owned").exists()
    torch.load(path / "checkpoint.pt", weights_only=False)
    assert (tmp_path / "owned").exists()  # it would have worked


@pytest.mark.parametrize("kept", [0, 100, 2000])
def test_a_torn_checkpoint_is_refused(path, kept):
    content = (path / "checkpoint.pt").read_bytes()
    (path / "checkpoint.pt").write_bytes(content[:kept])
    with pytest.raises(EvaluationError, match=r"checkpoint\.pt cannot be read"):
        read_checkpoint(path)


def test_a_folder_without_checkpoint_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(EvaluationError, match=r"holds no checkpoint\.pt: train it first"):
            read_checkpoint(path)


@pytest.mark.parametrize(
    "args", [{"env_id": "Toy-v0", "beta": 1}, {"env_id": "Toy-v0", "seed": 1}, {}]
)
def test_the_checkpoint_of_another_program_is_refused(tmp_path, args):
    torch.save({"args": args, "learner": {}}, tmp_path / "checkpoint.pt")
    with pytest.raises(
        EvaluationError, match=r"not of a baseline .*: ppo_reg, trpo_reg, ppo_reg_c"
    ):
        read_checkpoint(tmp_path)


def test_settings_that_are_no_longer_valid_are_refused(tmp_path):
    write_checkpoint(tmp_path)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    saved["args"]["gamma"] = 2.0
    torch.save(saved, tmp_path / "checkpoint.pt")
    with pytest.raises(EvaluationError, match=r"ppo_reg refuses: gamma must be in \[0, 1\]"):
        read_checkpoint(tmp_path)


def test_an_agent_that_a_gpu_trained_is_read_on_the_cpu(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(torch.serialization, "location_tag", lambda storage: "cuda:0")
        write_checkpoint(tmp_path)
    learner = read_checkpoint(tmp_path).learner
    assert learner["actor"]["log_std"].device == torch.device("cpu")


def test_what_was_read_cannot_be_changed(tmp_path):
    write_checkpoint(tmp_path)
    found = read_checkpoint(tmp_path)
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.baseline = "trpo_reg"
