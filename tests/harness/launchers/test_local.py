"""Real processes: finished, failed, stopped and killed."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from harness import work
from harness.launchers.groups import commands
from harness.launchers.local import LocalLauncher
from harness.progress import Progress
from harness.provenance import ROOT, cores
from harness.scheduler import run_groups
from harness.store import Store
from harness.suite import load_suite
from tests.harness.conftest import write_run


def run(specs, store, jobs=2):
    """Each in a process of its own."""
    with Progress(Console(file=io.StringIO()), store, specs) as progress:
        return run_groups([[spec] for spec in specs], store, LocalLauncher(jobs), progress)


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
        assert [written["command"]] == commands([spec], store)


def test_a_failed_run_is_told_from_the_others(store, suite):
    broken, good = suite.runs[:2]
    store.start(broken, ["true"], [broken])
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


# --- groups --------------------------------------------------------------------------------------

TOUCH = """
import pathlib, sys
for folder in map(pathlib.Path, sys.argv[1:]):
    for name in ("metrics.csv", "checkpoint.pt"):
        (folder / name).write_text("made")
"""
"""a command that writes the files that have to be there, in each folder that it is given"""


@pytest.fixture
def trained(monkeypatch):
    """The groups that were trained, by a command in place of the baseline's."""
    seen = []

    def made(group, store, code=TOUCH):
        seen.append([spec.args["agent"] for spec in group])
        paths = [str(store.path(spec).resolve()) for spec in group]
        return [[sys.executable, "-c", code, *paths]]

    monkeypatch.setattr(work, "commands", made)
    return seen


@pytest.fixture
def agents(suite):
    """Two agents that differ in nothing but their number."""
    return suite.runs[:2]


def run_group(group, store):
    with Progress(Console(file=io.StringIO()), store, group) as progress:
        return run_groups([group], store, LocalLauncher(2), progress)


def test_a_group_is_trained_together_and_says_so(store, agents, trained):
    assert run_group(agents, store).done == agents
    assert trained == [[0, 1]]
    for spec in agents:
        saved = store.saved(spec)
        assert saved["agents"] == saved["sessions"][0]["agents"] == [0, 1]
        assert saved["sessions"][0]["implementation"] == "population"


def test_members_that_a_kill_left_unmarked_are_marked_without_the_others(store, agents, trained):
    first, second = agents
    for spec in agents:
        store.start(spec, [], agents)
        for name in ("metrics.csv", "checkpoint.pt"):
            store.path(spec, name).write_text("made")
    store.finish(first, returncode=0, seconds=1.0)
    before = store.path(first, "done.json").read_text()
    outcome = run_group(agents, store)
    assert trained == [[0, 1]]  # together: the program says that they are finished
    assert outcome.done == agents
    assert store.state(second) == "done"
    assert store.path(first, "done.json").read_text() == before


def test_of_a_new_group_what_another_launcher_has_is_left_to_it(store, agents, trained):
    first, second = agents
    with store.lock(first):
        outcome = run_group(agents, store)
    assert trained == [[1]]
    assert (outcome.held, outcome.done) == ([first], [second])


def test_a_begun_group_is_not_started_without_a_member(store, agents, trained):
    for spec in agents:
        store.start(spec, [], agents)
    with store.lock(agents[0]):
        outcome = run_group(agents, store)
    assert trained == []
    assert outcome.held == agents


def test_a_run_that_was_begun_with_others_since_the_plan_is_left_alone(store, agents, trained):
    for spec in agents:
        store.start(spec, [], agents)
    assert run([agents[0]], store).held == [agents[0]]
    assert trained == []


def test_another_launchers_finished_run_of_other_settings_stays(store, agents, trained):
    write_run(store, agents[0].with_args(gamma=0.5), [1.0])
    assert run([agents[0]], store).held == [agents[0]]
    assert trained == []
    assert store.saved(agents[0])["args"]["gamma"] == 0.5


# --- runs that diverge ---------------------------------------------------------------------------

DIVERGED = '{"update": 3, "what": "reward", "message": "a reward was NaN"}'
DIVERGE = f"(folder / 'diverged.json').write_text({DIVERGED!r})"


def test_a_run_that_diverges_is_an_outcome_not_a_failure(store, evaluated, scripts):
    scripts(say("train", f"{DIVERGE}; sys.exit(3)"), say("judge"))
    assert run([evaluated], store).done == [evaluated]
    assert store.state(evaluated) == "diverged"
    assert store.path(evaluated, "log.txt").read_text().split() == ["train"]
    done = json.loads(store.path(evaluated, "done.json").read_text())
    assert done["diverged"] == json.loads(DIVERGED)
    assert (done["rows"], done["sha256"]) == (0, {})  # it had written nothing yet
    assert run([evaluated], store).done == [evaluated]  # and is not run again
    assert store.path(evaluated, "log.txt").read_text().split() == ["train"]


@pytest.mark.parametrize("status", [1, 2])
def test_another_exit_status_is_a_failure_even_so(store, evaluated, scripts, status):
    scripts(say("train", f"{DIVERGE}; sys.exit({status})"))
    assert run([evaluated], store).failed == [evaluated]
    assert store.state(evaluated) == "failed"


def test_one_agent_of_a_population_diverges_and_the_others_are_done(
    store, agents, trained, monkeypatch
):
    code = TOUCH + f"(folder / 'diverged.json').write_text({DIVERGED!r})"  # in the last folder
    monkeypatch.setattr(work, "commands", functools.partial(work.commands, code=code))
    assert run_group(agents, store).done == agents
    assert [store.state(spec) for spec in agents] == ["done", "diverged"]
    done = json.loads(store.path(agents[1], "done.json").read_text())
    assert set(done["sha256"]) == {"metrics.csv", "checkpoint.pt"}


# --- two commands: train, then evaluate -----------------------------------------------------------


@pytest.fixture
def evaluated(suite):
    """A run that is evaluated when it is trained."""
    return dataclasses.replace(suite.runs[0], evaluation={"levels": 3, "repeats": 2})


def say(name: str, more: str = "") -> str:
    """Code of a command that writes the files of a run that have to be there, and its name."""
    files = ("metrics.csv", "checkpoint.pt") if name == "train" else ("evaluation.csv",)
    code = f"import os, pathlib, sys, time; folder = pathlib.Path(sys.argv[1]); print({name!r})\n"
    return code + more + "".join(f"\n(folder / {file!r}).write_text({name!r})" for file in files)


@pytest.fixture
def scripts(monkeypatch):
    """Commands in place of a baseline and its evaluation, which are given the run's folder."""

    def use(*codes: str) -> None:
        def made(group, store):
            path = store.path(group[0]).resolve()
            return [[sys.executable, "-c", code, str(path)] for code in codes]

        monkeypatch.setattr(work, "commands", made)

    return use


def test_the_commands_of_a_run_that_is_evaluated(store, evaluated, suite):
    path = str(store.path(evaluated).resolve())
    train, judge = commands([evaluated], store)
    assert train == commands([suite.runs[0]], store)[0]
    assert train[1:3] == ["-m", "baselines.ppo_reg"]
    assert train[-3:] == ["--run-dir", path, "--resume"]
    flags = ["--levels", "3", "--repeats", "2"]
    assert judge == [sys.executable, "-m", "harness", "evaluate", path, *flags]
    assert len(commands([suite.runs[0]], store)) == 1


def test_the_second_command_follows_the_first(store, evaluated, scripts):
    late = "assert (folder / 'metrics.csv').read_text() == 'train'"
    scripts(say("train", "time.sleep(0.5)"), say("judge", late))
    assert run([evaluated], store).done == [evaluated]
    assert store.path(evaluated, "log.txt").read_text().split() == ["train", "judge"]
    done = json.loads(store.path(evaluated, "done.json").read_text())
    assert done["sha256"]["evaluation.csv"] == hashlib.sha256(b"judge").hexdigest()
    assert done["seconds"] >= 0.5


def test_nothing_follows_a_command_that_fails(store, evaluated, scripts):
    scripts(say("train", "sys.exit(3)"), say("judge"))
    assert run([evaluated], store).failed == [evaluated]
    assert store.path(evaluated, "log.txt").read_text().split() == ["train"]
    failed = json.loads(store.path(evaluated, "failed.json").read_text())
    assert failed == {"returncode": 3}


def test_a_run_whose_second_command_fails_has_failed(store, evaluated, suite, scripts):
    scripts(say("train"), say("judge", "sys.exit(4)"))
    outcome = run([evaluated, suite.runs[1]], store)
    assert evaluated in outcome.failed
    assert store.state(evaluated) == "failed"
    assert json.loads(store.path(evaluated, "failed.json").read_text()) == {"returncode": 4}
    assert not store.path(evaluated, "done.json").exists()


@pytest.mark.parametrize("when", ["train", "judge"])
def test_a_run_that_is_stopped_goes_on_when_it_is_run_again(store, evaluated, scripts, when):
    pause = {when: "(folder / 'begun').touch(); time.sleep(60)"}
    scripts(*(say(name, pause.get(name, "")) for name in ("train", "judge")))

    class Stopping(Progress):
        def update(self, running):
            if store.path(evaluated, "begun").exists():
                raise KeyboardInterrupt

    progress = Stopping(Console(file=io.StringIO()), store, [evaluated])
    with pytest.raises(KeyboardInterrupt):
        run_groups([[evaluated]], store, LocalLauncher(1), progress)
    assert store.state(evaluated) == "interrupted"
    assert not store.path(evaluated, "evaluation.csv").exists()
    assert store.path(evaluated, "metrics.csv").exists() == (when == "judge")
    scripts(say("train"), say("judge"))
    assert run([evaluated], store).done == [evaluated]
    assert store.state(evaluated) == "done"


@pytest.mark.parametrize(("jobs", "share"), [(1, 4), (2, 2), (3, 1), (9, 1)])
def test_a_run_has_its_share_of_the_cores(store, evaluated, scripts, monkeypatch, jobs, share):
    monkeypatch.setattr("harness.launchers.local.cores", lambda: 4)
    show = "print(os.environ['OMP_NUM_THREADS'])"
    scripts(say("train", show), say("judge", show))
    run([evaluated], store, jobs)
    log = store.path(evaluated, "log.txt").read_text()
    assert log.split() == ["train", str(share), "judge", str(share)]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system pins no processes")
def test_cores_are_those_that_the_process_may_use():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert cores() == len(allowed)


def test_a_trained_agent_that_was_not_evaluated_yet_only_is(store, coinrun_run):
    """As after an interruption between the two: training says that it is finished."""
    folder, spec = coinrun_run
    shutil.copytree(folder, store.path(spec))
    before = store.path(spec, "checkpoint.pt").read_bytes()
    assert run([spec], store, jobs=99).done == [spec]  # on one core
    log = store.path(spec, "log.txt").read_text()
    assert "is finished" in log
    assert log.index("is finished") < log.index("sampled")
    assert store.path(spec, "checkpoint.pt").read_bytes() == before
    episodes = pd.read_csv(store.path(spec, "evaluation.csv"))
    assert episodes.groupby(["split", "policy"]).size().tolist() == [1, 1, 1, 1]
    content = store.path(spec, "evaluation.csv").read_bytes()
    done = json.loads(store.path(spec, "done.json").read_text())
    assert done["sha256"]["evaluation.csv"] == hashlib.sha256(content).hexdigest()
    assert store.path(spec, "seen.gif").exists()


def test_every_agent_of_a_group_is_evaluated(store, suite):
    asked = {"episodes": 1}
    group = [dataclasses.replace(spec, evaluation=asked) for spec in suite.runs[:2]]
    assert [spec.args["agent"] for spec in group] == [0, 1]
    progress = Progress(Console(file=io.StringIO()), store, group)
    assert run_groups([group], store, LocalLauncher(1), progress).done == group
    returns = []
    for spec in group:
        content = store.path(spec, "evaluation.csv").read_bytes()
        done = json.loads(store.path(spec, "done.json").read_text())
        assert done["sha256"]["evaluation.csv"] == hashlib.sha256(content).hexdigest()
        episodes = pd.read_csv(store.path(spec, "evaluation.csv"))
        assert episodes["policy"].tolist() == ["deterministic", "sampled"]
        assert episodes["length"].tolist() == [200, 200]
        returns += episodes["return"].tolist()
    assert len(set(returns)) == 4
    assert "[2/2] " in store.path(group[0], "log.txt").read_text()
