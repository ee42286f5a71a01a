"""The store: states, completion, locks and torn files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading

import pytest

from harness.store import StoreError, write_json
from tests.harness.conftest import make_episodes, write_run


def test_a_run_goes_from_pending_to_done(store, suite):
    spec = suite.runs[0]
    assert store.state(spec) == "pending"
    store.start(spec, ["true"], [spec])
    assert store.state(spec) == "interrupted"
    write_run(store, spec, [1.0])
    assert store.state(spec) == "done"


def test_a_failed_run_says_so_until_it_is_started_again(store, suite):
    spec = suite.runs[0]
    store.start(spec, ["false"], [spec])
    store.finish(spec, returncode=1, seconds=1.0)
    assert store.state(spec) == "failed"
    store.start(spec, ["true"], [spec])
    assert store.state(spec) == "interrupted"


def test_a_locked_run_is_running(store, suite):
    spec = suite.runs[0]
    store.start(spec, ["true"], [spec])
    with store.lock(spec) as lock:
        assert lock is not None
        assert store.state(spec) == "running"
        with store.lock(spec) as second:
            assert second is None
    assert store.state(spec) == "interrupted"


def test_asking_for_the_state_does_not_make_another_give_a_run_up(store, suite):
    """The question takes the lock for an instant, and whoever wants the run waits for longer."""
    spec = suite.runs[0]
    store.start(spec, ["true"], [spec])
    stop = threading.Event()

    def ask() -> None:
        while not stop.is_set():
            store.state(spec)

    asking = threading.Thread(target=ask)
    asking.start()
    try:
        for _ in range(200):
            with store.lock(spec) as lock:
                assert lock is not None
    finally:
        stop.set()
        asking.join()


def test_another_configuration_is_not_taken_for_a_finished_run(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0])
    changed = dataclasses.replace(spec, args={**spec.args, "gamma": 0.9})
    assert store.state(changed) == "changed"
    store.refuse_changed(spec)
    with pytest.raises(StoreError, match=r"gamma 0\.99 -> 0\.9.*--results-dir"):
        store.refuse_changed(changed)


def test_another_evaluation_is_another_configuration_and_is_named(store, suite):
    spec = dataclasses.replace(suite.runs[0], evaluation={"levels": 2, "repeats": 3})
    episodes = make_episodes(seen_sampled=[[1.0]])
    write_run(store, spec, [1.0], episodes=episodes)
    assert store.state(spec) == "done"
    assert json.loads(store.path(spec, "spec.json").read_text())["evaluation"] == spec.evaluation
    other = dataclasses.replace(spec, evaluation={"levels": 5, "repeats": 3})
    with pytest.raises(StoreError, match=r"another configuration \(levels 2 -> 5\)"):
        store.refuse_changed(other)
    with pytest.raises(StoreError, match=r"\(levels 2 -> None, repeats 3 -> None\)"):
        store.refuse_changed(suite.runs[0])


def test_another_baseline_is_named(store, suite):
    write_run(store, suite.runs[0], [1.0])
    other = dataclasses.replace(suite.runs[0], baseline="trpo_reg")
    with pytest.raises(StoreError, match=r"\(baseline ppo_reg -> trpo_reg\)"):
        store.refuse_changed(other)


def test_a_run_is_done_when_it_is_evaluated_too(store, suite):
    spec = dataclasses.replace(suite.runs[0], evaluation={"levels": 1, "repeats": 1})
    write_run(store, spec, [1.0], done=False)
    assert store.finish(spec, returncode=0, seconds=1.0) == store.state(spec) == "failed"
    failed = json.loads(store.path(spec, "failed.json").read_text())
    assert failed == {"missing": ["evaluation.csv"]}
    write_run(store, spec, [1.0], episodes=make_episodes(seen_sampled=[[1.0]]))
    done = json.loads(store.path(spec, "done.json").read_text())
    content = store.path(spec, "evaluation.csv").read_bytes()
    assert done["sha256"]["evaluation.csv"] == hashlib.sha256(content).hexdigest()


def test_a_run_that_is_not_evaluated_has_no_checksum_of_it(store, suite):
    write_run(store, suite.runs[0], [1.0])
    done = json.loads(store.path(suite.runs[0], "done.json").read_text())
    assert list(done["sha256"]) == ["metrics.csv", "checkpoint.pt"]


def test_checksums_are_of_the_files(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0])
    done = json.loads(store.path(spec, "done.json").read_text())
    content = store.path(spec, "metrics.csv").read_bytes()
    assert done["sha256"]["metrics.csv"] == hashlib.sha256(content).hexdigest()


def test_metrics_leave_out_a_line_that_is_being_written(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0, 2.0])
    with open(store.path(spec, "metrics.csv"), "a") as file:
        file.write("300,7")
    assert store.metrics(spec)["charts/episodic_return"].tolist() == [1.0, 2.0]
    assert store.steps(spec) == 200


def test_a_run_without_rows_has_no_metrics(store, suite):
    spec = suite.runs[0]
    assert store.metrics(spec) is None
    assert store.steps(spec) == 0
    store.start(spec, ["true"], [spec])
    store.path(spec, "metrics.csv").write_text("global_step,charts/SPS\n")
    assert store.metrics(spec) is None
    assert store.steps(spec) == 0


def test_a_torn_file_is_named(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0])
    store.path(spec, "spec.json").write_text('{"hash": ')
    with pytest.raises(StoreError, match=r"spec\.json is torn.*remove"):
        store.state(spec)


def test_json_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "done.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert json.loads(path.read_text()) == {"a": 1}


def test_the_end_of_the_log(store, suite):
    spec = suite.runs[0]
    assert store.log_tail(spec) == "(no log)"
    store.start(spec, ["true"], [spec])
    store.path(spec, "log.txt").write_text("\n".join(map(str, range(30))))
    assert store.log_tail(spec, lines=2) == "28\n29"
