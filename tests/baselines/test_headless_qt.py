"""Qt without the system's OpenGL and GLib: it draws the same frames, and shadows nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from baselines import headless_qt
from baselines.headless_qt import SYSTEM_LIBRARIES, load_headless_qt

# CoinRun, and a game that draws much; large images are converted in Qt's worker threads.
PLAY = """
import hashlib
import envpool
import numpy as np

for game in ("Coinrun", "Starpilot"):
    pool = envpool.make_gymnasium(f"{game}Hard-v0", num_envs=4, num_threads=2, seed=3)
    digest = hashlib.sha256(pool.reset()[0].tobytes())
    rng = np.random.default_rng(0)
    total = 0.0
    for _ in range(100):
        frames, rewards, *_ = pool.step(rng.integers(0, 15, 4, dtype=np.int32))
        digest.update(frames.tobytes())
        total += rewards.sum()
    print(game, total, digest.hexdigest())

print([line for line in open("/proc/self/maps") if "libglib" in line or "libGL.so" in line])
"""
PLAIN = "from baselines.ppo_reg_coinrun import load_qt; load_qt()"
HEADLESS = """
import importlib.util
from baselines import headless_qt
headless_qt.is_in_system = lambda name: False
(place,) = importlib.util.find_spec("PyQt5").submodule_search_locations
headless_qt.load_headless_qt(f"{place}/Qt5/lib/libQt5Gui.so.5")
"""


def play(load: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", load + PLAY], env={**os.environ, **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_frames_and_rewards_are_those_with_the_systems_libraries():
    plain = play(PLAIN)
    headless = play(HEADLESS)
    assert plain.returncode == 0, plain.stderr
    assert headless.returncode == 0, headless.stderr

    *expected, _ = plain.stdout.splitlines()
    *frames, loaded = headless.stdout.splitlines()
    assert len(expected) == 2
    assert frames == expected
    assert loaded == "[]"


def test_where_functions_are_looked_up_at_once_the_error_names_one():
    answer = play(HEADLESS, LD_BIND_NOW="1")
    assert answer.returncode == 1
    assert "OSError" in answer.stderr
    assert "undefined symbol: g" in answer.stderr


# --- which libraries it stands in for ------------------------------------------------------------


@pytest.fixture
def wheel(tmp_path) -> Path:
    """The folder of the wheel's libraries."""
    for name in ("libQt5Gui.so.5", "libQt5Core.so.5", "libicudata.so.56"):
        (tmp_path / name).write_text(name)
    return tmp_path


@pytest.fixture
def loaded(monkeypatch) -> dict[str, str]:
    """What each link leads to in the folder from which Qt is loaded; the library is under ''."""
    links: dict[str, str] = {}

    def record(library: Path) -> None:
        links.update({path.name: path.read_text() for path in library.parent.iterdir()})
        links[""] = library.name

    monkeypatch.setattr(headless_qt, "load_lazily", record)
    monkeypatch.setenv("QT_NO_GLIB", "")
    return links


@pytest.mark.parametrize("missing", [*((name,) for name in SYSTEM_LIBRARIES), SYSTEM_LIBRARIES])
def test_only_what_the_system_lacks_gets_a_link(monkeypatch, wheel, loaded, missing):
    monkeypatch.setattr(headless_qt, "is_in_system", lambda name: name not in missing)
    load_headless_qt(wheel / "libQt5Gui.so.5")
    own = {path.name: path.name for path in wheel.iterdir()}
    assert loaded == {"": "libQt5Gui.so.5", **own, **dict.fromkeys(missing, "libicudata.so.56")}
    assert os.environ["QT_NO_GLIB"] == "1"


def test_a_relative_path_is_followed(monkeypatch, wheel, loaded):
    monkeypatch.chdir(wheel)
    monkeypatch.setattr(headless_qt, "is_in_system", lambda name: False)
    load_headless_qt("libQt5Gui.so.5")
    assert loaded["libGL.so.1"] == "libicudata.so.56"


@pytest.mark.parametrize("reason", ["nothing is missing", "not Linux", "no ICU"])
def test_where_it_is_no_remedy_it_loads_nothing(monkeypatch, wheel, loaded, reason):
    complete = reason == "nothing is missing"
    monkeypatch.setattr(headless_qt, "is_in_system", lambda name: complete)
    if reason == "not Linux":
        monkeypatch.setattr(sys, "platform", "darwin")
    if reason == "no ICU":
        (wheel / "libicudata.so.56").unlink()

    with pytest.raises(OSError, match=r"libQt5Gui\.so\.5: cannot do without"):
        load_headless_qt(wheel / "libQt5Gui.so.5")
    assert not loaded
    assert not os.environ["QT_NO_GLIB"]


# --- the loader ----------------------------------------------------------------------------------


def test_what_is_in_the_system_is_what_the_loader_finds():
    assert headless_qt.is_in_system("libc.so.6")
    assert not headless_qt.is_in_system("libno-such-library.so.1")


def test_a_library_that_cannot_be_opened_is_named(tmp_path):
    path = tmp_path / "libQt5Gui.so.5"
    path.write_text("not a library")
    with pytest.raises(OSError, match=r"libQt5Gui\.so\.5: "):
        headless_qt.load_lazily(path)
