"""Real processes: finished, failed, stopped and killed."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from harness.launchers.local import ROOT, commands, run_local
from harness.progress import Progress
from harness.store import Store
from harness.suite import load_suite
from tests.harness.conftest import write_run


def run(specs, store, jobs=2):
    with Progress(Console(file=io.StringIO()), store, specs) as progress:
        return run_local(specs, store, jobs, progress)


def start_run_all(suite_file: Path, results: Path) -> subprocess.Popen:
    """run-all in a process of its own, its runs long enough to be stopped."""
    words = ["run-all", "--suite", suite_file, "--results-dir", results, "--jobs", "2"]
    words += ["--total-timesteps", "20000", "--seeds", "1", "--agents", "1", "--env", "Hopper"]
    with open(results.parent / "out.txt", "ab") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "harness", *map(str, words)],
            cwd=ROOT, stdout=out, stderr=out, start_new_session=True,
        )  # fmt: skip


def checkpoints(results: Path) -> list[Path]:
    return sorted(results.glob("tiny/*/checkpoint.pt"))


def wait_for(condition, process: subprocess.Popen, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)


def running(suite_file: Path, results: Path) -> list[str]:
    """Ids of the runs that some process holds."""
    plan = load_suite(str(suite_file), total_timesteps=20_000, seeds=1, agents=1, env=("Hopper",))
    return [run.run_id for run in plan.runs if Store(results).state(run) == "running"]


def test_runs_finish_and_leave_what_the_store_promises(store, suite):
    specs = suite.runs[:2]
    outcome = run(specs, store)
    assert sorted(s.run_id for s in outcome.done) == [s.run_id for s in specs]
    for spec in specs:
        assert store.state(spec) == "done"
        assert store.steps(spec) == 200
        assert "update 2/2" in store.path(spec, "log.txt").read_text()
        written = json.loads(store.path(spec, "spec.json").read_text())
        assert [written["command"]] == commands(spec, store)


def test_a_failed_run_is_told_from_the_others(store, suite):
    broken, good = suite.runs[:2]
    store.start(broken, ["true"])
    store.path(broken, "checkpoint.pt").write_bytes(b"torn")
    outcome = run([broken, good], store)
    assert (outcome.failed, outcome.done) == ([broken], [good])
    assert store.state(broken) == "failed"
    assert "no readable checkpoint" in store.log_tail(broken)


def test_a_run_that_another_process_holds_is_left_to_it(store, suite):
    held, free = suite.runs[:2]
    with store.lock(held):
        outcome = run([held, free], store)
    assert (outcome.held, outcome.done) == ([held], [free])


def test_a_run_that_another_launcher_has_finished_is_not_run_again(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0])
    before = store.path(spec, "done.json").read_text()
    assert run([spec], store).done == [spec]
    assert store.path(spec, "done.json").read_text() == before
    assert not store.path(spec, "log.txt").exists()


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_stopping_run_all_stops_the_runs_and_keeps_their_checkpoints(suite_file, tmp_path, stop):
    results = tmp_path / "results"
    process = start_run_all(suite_file, results)
    wait_for(lambda: len(checkpoints(results)) == 2, process)
    process.send_signal(stop)
    assert process.wait(30) == 130
    assert not running(suite_file, results)
    assert len(checkpoints(results)) == 2
    assert "the same command continues from" in (tmp_path / "out.txt").read_text()
    assert start_run_all(suite_file, results).wait() == 0
    for folder in results.glob("tiny/ppo*"):
        steps = [int(row.split(",")[0]) for row in (folder / "metrics.csv").read_text().split()[1:]]
        assert steps == list(range(100, 20001, 100))
        assert (folder / "done.json").exists()


def test_runs_whose_launcher_was_killed_are_not_started_twice(suite_file, tmp_path):
    results = tmp_path / "results"
    process = start_run_all(suite_file, results)
    wait_for(lambda: len(checkpoints(results)) == 2, process)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert len(running(suite_file, results)) == 2
    second = start_run_all(suite_file, results)
    assert second.wait(60) == 0
    assert "2 runs are being run by another process" in (tmp_path / "out.txt").read_text()
    wait_for_end = time.monotonic() + 120  # the orphans go on, and finish
    while running(suite_file, results):
        assert time.monotonic() < wait_for_end
        time.sleep(0.2)
    assert [path.read_text().count("\n") for path in results.glob("tiny/*/metrics.csv")] == [
        201
    ] * 2
