"""Where runs come from, and what is said where they come from several places."""

from __future__ import annotations

import platform
import re
import subprocess
from datetime import datetime

import numpy as np
import pytest
import torch

from harness import provenance
from harness.provenance import device_of, find_origins, here, implementation_of


def git(*words: object) -> None:
    flags = ["-c", "user.name=x", "-c", "user.email=x@x"]
    subprocess.run(["git", *flags, *map(str, words)], check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A repository with one commit, in place of this one."""
    root = tmp_path.resolve() / "checkout"
    (root / "condwrap").mkdir(parents=True)
    (root / "condwrap" / "a.py").write_text("1")
    git("init", root)
    git("-C", root, "add", ".")
    git("-C", root, "commit", "-m", "First")
    monkeypatch.setattr(provenance, "ROOT", root)
    return root


def test_the_commit_and_whether_code_differs_from_it(checkout):
    found = here()
    assert re.fullmatch("[0-9a-f]{40}", found["commit"])
    assert found["clean"] is True

    (checkout / "notes.txt").write_text("not code")
    assert here()["clean"] is True

    (checkout / "condwrap" / "a.py").write_text("2")
    assert here() == {**found, "clean": False}


def test_a_repository_around_the_code_is_not_its_own(checkout, monkeypatch):
    monkeypatch.setattr(provenance, "ROOT", checkout / "condwrap")
    assert (here()["commit"], here()["clean"]) == ("unknown", None)


def test_the_versions_and_the_machine():
    found = here()
    assert found["versions"]["Python"] == platform.python_version()
    assert found["versions"]["NumPy"] == np.__version__
    assert found["versions"]["PyTorch"] == torch.__version__
    assert {"Gymnasium", "condwrap"} <= found["versions"].keys()
    assert found["processor"]
    assert found["cores"] >= 1


def test_the_time_is_utc():
    assert datetime.fromisoformat(provenance.now()).utcoffset().total_seconds() == 0


def test_the_device_and_the_implementation(monkeypatch):
    assert device_of({}) == device_of({"device": "cpu"}) == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda name: f"GPU {name}")
    assert device_of({"device": "auto"}) == "GPU None"
    assert device_of({"device": "cuda:1"}) == "GPU cuda:1"
    assert device_of({}) == "cpu"  # control tasks have no such flag
    assert implementation_of({}, 1) == "single file"
    assert implementation_of({"compile": False}, 10) == "population"
    assert implementation_of({"compile": True}, 1) == "compiled"


def session(**changes) -> dict:
    content = {"commit": "a" * 40, "clean": True, "versions": {"NumPy": "2.0"},
               "processor": "Chip", "cores": 2, "device": "cpu",
               "implementation": "population"}  # fmt: skip
    return {**content, **changes}


def spec(*sessions: dict, version: int = 2) -> dict:
    return {"baseline": "ppo_reg", "version": version, "sessions": list(sessions)}


def test_runs_that_come_from_one_place_need_no_warning():
    origins = find_origins([spec(session()), spec(session())])
    assert origins.commits == {"a" * 10: 2}
    assert origins.versions == {"NumPy": {"2.0": 2}}
    assert origins.machines == {"Chip, 2 cores": 2}
    assert origins.implementations == {"population": 2}
    assert origins.baselines == {"ppo_reg 2": 2}
    assert origins.warnings == []


@pytest.mark.parametrize(
    ("changes", "warning"),
    [
        ({"commit": "b" * 40}, "The runs mix commits: aaaaaaaaaa (2), bbbbbbbbbb (1)."),
        ({"versions": {"NumPy": "1.9"}}, "The runs mix versions of NumPy: 2.0 (2), 1.9 (1)."),
        ({"versions": {}}, "The runs mix versions of NumPy: 2.0 (2), none (1)."),
        ({"processor": "Other"}, "mix machines: Chip, 2 cores (2), Other, 2 cores (1)."),
        ({"cores": 4}, "mix machines: Chip, 2 cores (2), Chip, 4 cores (1)."),
        ({"device": "GPU"}, "Chip, 2 cores (2), Chip, 2 cores, GPU (1)."),
        ({"implementation": "single file"}, "implementations: population (2), single file (1)."),
    ],
    ids=str,
)
def test_what_mixes_is_said(changes, warning):
    origins = find_origins([spec(session(**changes)), spec(session()), spec(session())])
    assert len(origins.warnings) == 1
    assert origins.warnings[0].endswith(warning)


def test_code_that_no_commit_holds_is_said():
    origins = find_origins([spec(session(clean=False))])
    assert origins.commits == {"a" * 10 + "+": 1}
    assert origins.warnings == ["1 runs were made by code that no commit holds."]
    assert find_origins([spec(session(clean=None))]).commits == {"a" * 10: 1}


def test_a_run_that_another_commit_continued_counts_for_both():
    origins = find_origins([spec(session(), session(commit="b" * 40), session())])
    assert origins.commits == {"a" * 10: 1, "b" * 10: 1}
    assert origins.warnings[-1] == "1 runs were continued by another commit than began them."


def test_runs_from_before_this_was_recorded_are_counted():
    origins = find_origins([{"baseline": "ppo_reg"}])
    assert origins.warnings == ["1 runs do not say what code and machine made them."]
    assert origins.baselines == {"ppo_reg 1": 1}
