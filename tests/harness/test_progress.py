"""What run-all shows while it works."""

from __future__ import annotations

import dataclasses
import io

import pytest
from rich.console import Console

from harness import progress
from harness.progress import Progress, duration
from tests.harness.conftest import write_run


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (89, "89 s"),
        (90, "2 min"),
        (5399, "90 min"),
        (5400, "1.5 h"),
        (864000, "10 days"),
    ],
)
def test_durations_are_said_as_a_person_would(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize("terminal", [True, False])
def test_it_counts_runs_and_steps(store, suite, monkeypatch, terminal):
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    monkeypatch.setattr(progress, "LIVE_INTERVAL", 0.0)
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100)
    specs = suite.runs[:2]
    with Progress(console, store, specs) as shown:
        write_run(store, specs[0], [1.0, 2.0])
        shown.ended(specs[0], "done in 1 s")
        shown.update(specs[1:])
    text = out.getvalue()
    assert "[1/2] ppo__Hopper__s1__a0  done in 1 s" in text
    assert "1/2 runs" in text
    assert "50%" in text
    assert "steps/s" in text


def test_what_was_done_before_does_not_count_as_speed(store, suite, monkeypatch):
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    write_run(store, suite.runs[0], [1.0])
    out = io.StringIO()
    with Progress(Console(file=out, width=100), store, suite.runs[:2]) as shown:
        shown.update(suite.runs[:2])
    assert "starting" in out.getvalue()
    assert "25%" in out.getvalue()


def test_runs_of_the_same_name_in_two_suites_count_each(store, suite, monkeypatch):
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    other = dataclasses.replace(suite.runs[0], suite="other")
    write_run(store, other, [1.0, 2.0])
    out = io.StringIO()
    with Progress(Console(file=out, width=100), store, [suite.runs[0], other]) as shown:
        shown.ended(other, "done in 1 s")
        shown.update([suite.runs[0]])
    assert "[1/2] other/ppo__Hopper__s1__a0  done in 1 s" in out.getvalue()
    assert "1/2 runs  50%" in out.getvalue()
