"""The store: states, completion, locks and torn files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading
import time

import pytest

from baselines import ppo_reg
from harness.archive import ArchiveError, archive_path, write_archive
from harness.report.results import load_results
from harness.scores import exact_scores
from harness.store import DIVERGED, FINISHED, STATES, Store, StoreError, write_json
from tests.harness.conftest import make_episodes, write_run


def test_a_run_is_in_one_of_the_states(store, suite):
    spec, crashed, diverged, *_ = suite.runs
    seen = [store.state(spec)]
    store.start(spec, [], [spec])
    seen.append(store.state(spec))
    with store.lock(spec):
        seen.append(store.state(spec))
    write_run(store, spec, [1.0])
    seen += [store.state(spec), store.state(spec.with_args(gamma=0.9))]
    store.start(crashed, [], [crashed])
    store.finish(crashed, returncode=1, seconds=1.0)
    write_run(store, diverged, [1.0], done=False, diverged=True)
    store.finish(diverged, returncode=DIVERGED, seconds=1.0)
    seen += [store.state(crashed), store.state(diverged)]
    ends = ["done", "changed", "failed", "diverged"]
    assert seen == ["pending", "interrupted", "running", *ends]
    assert sorted(STATES) == sorted(seen)
    assert FINISHED == ("done", "diverged")


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


def test_a_lock_that_another_holds_is_given_up_after_a_tenth_of_a_second(store, suite, monkeypatch):
    waits = []
    monkeypatch.setattr(time, "sleep", waits.append)
    with store.lock(suite.runs[0]), store.lock(suite.runs[0]) as second:
        assert second is None
    assert sum(waits) == pytest.approx(0.1)
    assert max(waits) <= 0.02
    assert store.path(suite.runs[0], "lock").exists()


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


def test_a_run_that_was_evaluated_otherwise_is_trained_but_not_done(store, suite):
    spec = dataclasses.replace(suite.runs[0], evaluation={"episodes": 2})
    write_run(store, spec, [1.0])
    assert store.state(spec) == "done"
    assert json.loads(store.path(spec, "spec.json").read_text())["evaluation"] == {"episodes": 2}

    other = dataclasses.replace(spec, evaluation={"episodes": 3})
    store.refuse_changed(other)
    assert (store.state(other), store.is_trained(other)) == ("interrupted", True)
    assert store.own_record(other) is None

    store.start(other, ["true"], [other])  # before anything else is written, it is done no more
    assert store.state(other) == store.state(spec) == "interrupted"
    store.finish(other, returncode=0, seconds=1.0)
    assert (store.state(other), store.state(spec)) == ("done", "interrupted")


def test_a_run_that_was_extended_since_keeps_the_evaluation_that_it_has(store, suite):
    short = dataclasses.replace(suite.runs[0], evaluation={"episodes": 2})
    long = short.with_args(total_timesteps=400)
    write_run(store, short, [1.0])
    write_run(store, long, [1.0, 2.0])
    otherwise = dataclasses.replace(short, evaluation={"episodes": 3})
    assert store.state(otherwise) == "done"  # its agent is gone
    assert store.state(otherwise.with_args(total_timesteps=400)) == "interrupted"


def test_a_damaged_file_is_named_and_costs_one_run(store, suite):
    first, second, *_ = suite.runs
    write_run(store, first, [1.0, 2.0])
    write_run(store, second, [1.0, 2.0])
    path = store.path(first, "metrics.csv")
    content = path.read_bytes()
    path.write_bytes(content.replace(b"2.0", b"3.0", 1))

    with pytest.raises(StoreError, match=rf"{first.run_id}/metrics\.csv is damaged"):
        store.own_record(first)
    results = load_results(suite, store)
    assert results.done == [second.run_id]
    assert list(results.metrics) == [second.run_id]
    (warning,) = results.warnings
    assert f"{first.run_id}/metrics.csv is damaged" in warning

    path.unlink()
    with pytest.raises(StoreError, match=r"metrics\.csv is gone"):
        store.own_record(first)
    path.write_bytes(content)
    assert store.own_record(first) is not None


def test_a_damaged_evaluation_is_named_also_of_a_run_that_was_extended(store, suite):
    short = dataclasses.replace(suite.runs[0], evaluation={"levels": 1, "repeats": 1})
    write_run(store, short, [1.0, 2.0], episodes=make_episodes(seen_sampled=[[1.0]]))
    path = store.path(short, "evaluation.csv")
    content = path.read_bytes()
    path.write_bytes(content + b"x")
    with pytest.raises(StoreError, match=r"evaluation\.csv is damaged"):
        store.own_record(short)

    path.write_bytes(content)
    long = short.with_args(total_timesteps=400)
    write_run(store, long, [1.0, 2.0, 3.0], episodes=make_episodes(seen_sampled=[[0.0]]))
    assert store.own_record(short) is not None  # though metrics.csv has more rows than it had
    store.path(short, "evaluation-200.csv").write_bytes(content + b"x")
    with pytest.raises(StoreError, match=r"evaluation-200\.csv is damaged"):
        store.verify(short, ("evaluation.csv",))
    assert store.own_record(long) is not None


def test_what_an_older_run_did_not_write_is_not_asked_for(store, suite):
    """Neither the state nor checksums."""
    spec = suite.runs[0]
    write_run(store, spec, [1.0])
    write_json(store.path(spec, "done.json"), {"rows": 1})
    assert store.state(spec) == "done"
    store.verify(spec, ("metrics.csv",))


def test_an_unfinished_run_has_no_record(store, suite):
    spec = suite.runs[0]
    assert not store.was_extended(spec)
    write_run(store, spec, [1.0], done=False)
    assert store.own_record(spec) is None
    assert store.record(spec) is None


def test_advice_for_another_length_is_to_extend(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0])
    with pytest.raises(StoreError, match=r"200 -> 400\): add --extend to continue it to 400 steps"):
        store.refuse_changed(spec.with_args(total_timesteps=400))
    elsewhere = r"200 -> 100\): name another --results-dir, or move it away$"
    with pytest.raises(StoreError, match=elsewhere):
        store.refuse_changed(spec.with_args(total_timesteps=100))
    with pytest.raises(StoreError, match=r"gamma 0\.99 -> 0\.9\): name another --results-dir"):
        store.refuse_changed(spec.with_args(total_timesteps=400, gamma=0.9))


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
    for content in ("", "global_step,charts/SPS\n"):
        store.path(spec, "metrics.csv").write_text(content)
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


def test_a_log_with_broken_text_is_shown_all_the_same(store, suite):
    spec = suite.runs[0]
    store.start(spec, ["true"], [spec])
    store.path(spec, "log.txt").write_bytes(b"good\n\xff\xfe bad\n")
    assert store.log_tail(spec) == "good\n\ufffd\ufffd bad"
    store.path(spec, "log.txt").write_text("\n".join(map(str, range(30))))
    assert store.log_tail(spec).split("\n") == [str(i) for i in range(15, 30)]


# --- what a run says of itself -------------------------------------------------------------------


def test_the_spec_says_what_is_about_to_run(store, suite):
    first, second = suite.runs[:2]
    for spec in (first, second):
        store.start(spec, ["python", "x.py"], [first, second])
    saved = store.saved(second)
    assert list(saved) == [
        "baseline", "version", "args", "evaluation", "agents", "command", "sessions",
    ]  # fmt: skip
    assert saved["baseline"] == "ppo_reg"
    assert saved["version"] == ppo_reg.VERSION
    assert saved["args"] == second.resolved
    assert (saved["args"]["agent"], saved["args"]["gamma"]) == (1, 0.99)
    assert saved["evaluation"] == {}
    assert saved["agents"] == store.members(first) == [0, 1]
    assert saved["command"] == ["python", "x.py"]
    (session,) = saved["sessions"]
    assert session["agents"] == [0, 1]
    assert session["implementation"] == "population"
    assert session["device"] == "cpu"
    assert {"start", "commit", "versions", "processor"} <= set(session)


def test_of_a_group_the_first_has_the_log(store, suite):
    first, second = suite.runs[:2]
    for spec in (first, second):
        store.start(spec, [], [first, second])
    assert not store.path(first, "log.txt").exists()
    assert store.log_tail(second).startswith("trained together with ppo__Hopper__s1__a0, whose log")


def test_each_start_is_a_session_more(store, suite):
    spec = suite.runs[0]
    store.start(spec, ["once"], [spec])
    store.start(spec, ["twice"], [spec])
    saved = store.saved(spec)
    assert len(saved["sessions"]) == 2
    assert saved["command"] == ["twice"]


def test_the_members_of_a_run_that_did_not_name_them_are_itself(store, suite):
    spec = suite.runs[1]
    assert store.members(spec) == []
    store.start(spec, [], [spec])
    saved = store.saved(spec)
    del saved["agents"]
    write_json(store.path(spec, "spec.json"), saved)
    assert store.members(spec) == [1]


def test_what_is_done_says_how_much_and_how_long(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0, 2.0, 3.0], done=False)
    assert store.finish(spec, returncode=0, seconds=12.3456) == "done"
    done = json.loads(store.path(spec, "done.json").read_text())
    assert list(done) == ["state", "end", "seconds", "rows", "sha256"]
    assert (done["state"], done["seconds"], done["rows"]) == ("done", 12.3, 3)
    assert done["end"] >= store.saved(spec)["sessions"][0]["start"]


def test_a_run_that_diverged_before_its_first_row_is_finished(store, suite):
    """It may have left nothing: no checkpoint and no row."""
    spec = suite.runs[0]
    store.start(spec, [], [spec])
    failure = {"update": 1, "what": "loss", "message": "loss is NaN"}
    write_json(store.path(spec, "diverged.json"), failure)
    assert store.finish(spec, returncode=DIVERGED, seconds=1.0) == "diverged"
    assert store.state(spec) == "diverged"
    assert store.is_done(spec)
    done = json.loads(store.path(spec, "done.json").read_text())
    assert (done["rows"], done["sha256"], done["diverged"]) == (0, {}, failure)
    record = store.record(spec)
    assert (record.state, record.scores, len(record.curves)) == ("diverged", {}, 0)
    assert record.evaluation is None
    assert record.asked is None


def test_exit_status_3_alone_is_a_failure_and_so_is_a_crash(store, suite):
    spec = suite.runs[0]
    write_run(store, spec, [1.0], done=False)
    assert DIVERGED == 3
    assert store.finish(spec, returncode=DIVERGED, seconds=1.0) == "failed"
    assert json.loads(store.path(spec, "failed.json").read_text()) == {"returncode": 3}
    write_json(store.path(spec, "diverged.json"), {"update": 1, "what": "loss", "message": ""})
    assert store.finish(spec, returncode=1, seconds=1.0) == "failed"
    assert not store.is_done(spec)


def test_the_record_is_what_the_folder_holds(store, suite):
    spec = dataclasses.replace(suite.runs[0], evaluation={"levels": 1, "repeats": 2})
    assert store.record(spec) is None
    episodes = make_episodes(seen_sampled=[[1.0, 0.0]])
    write_run(store, spec, [1.0, 5.0], episodes=episodes)
    write_json(store.path(spec, "evaluation.json"), {"levels": 1})
    record = store.record(spec)
    assert record.place == store.path(spec)
    assert record.run_id == spec.run_id
    assert record.spec == store.saved(spec)
    assert record.done == json.loads(store.path(spec, "done.json").read_text())
    assert record.scores == exact_scores(store.metrics(spec), 200)
    assert record.updates == 1
    assert record.curves["charts/episodic_return"].tolist() == [1.0, 5.0]
    assert record.evaluation.equals(episodes)
    assert record.asked == {"levels": 1}
    other = dataclasses.replace(spec, args={**spec.args, "gamma": 0.9})
    assert store.record(other) is None


def test_steps_are_of_the_last_line_however_long_the_file(store, suite):
    spec = suite.runs[0].with_args(total_timesteps=100_000)
    write_run(store, spec, [1.0] * 700, done=False)
    assert store.path(spec, "metrics.csv").stat().st_size > 2 * 4096
    assert store.steps(spec) == 70_000
    assert store.steps(suite.runs[0]) == 200  # the plan's length, where the folder's run is longer


def test_the_reports_folder_is_made(store):
    assert store.report_path("tiny") == store.report_path("tiny") == store.root / "tiny" / "report"
    assert (store.root / "tiny" / "report").is_dir()
    assert store.report_path() == store.root / "report"


# --- runs that are extended ----------------------------------------------------------------------


def test_a_longer_run_keeps_the_shorter_one_as_it_was(store, suite):
    short = dataclasses.replace(suite.runs[0], evaluation={"levels": 1, "repeats": 1})
    long = short.with_args(total_timesteps=400)
    episodes = make_episodes(seen_sampled=[[1.0]])
    write_run(store, short, [1.0, 2.0], episodes=episodes)
    write_json(store.path(short, "evaluation.json"), {"levels": 1})
    assert store.was_extended(long)
    assert not store.was_extended(short)
    assert store.shorter_lengths(long) == []
    names = ("spec", "done", "evaluation")
    before = {name: store.path(short, f"{name}.json").read_bytes() for name in names}

    store.start(long, [], [long])
    after = {name: store.path(short, f"{name}-200.json").read_bytes() for name in names}
    assert after == before
    for name in ("done.json", "evaluation.json", "evaluation.csv"):
        assert not store.path(long, name).exists()
    assert store.shorter_lengths(long) == [200]
    assert store.saved(long)["args"]["total_timesteps"] == 400
    assert [store.state(short), store.state(long)] == ["done", "interrupted"]

    write_run(store, long, [1.0, 2.0, 3.0, 4.0], episodes=make_episodes(seen_sampled=[[0.0]]))
    assert store.metrics(short)["charts/episodic_return"].tolist() == [1.0, 2.0]
    assert store.metrics(long)["charts/episodic_return"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert store.record(short).evaluation["success"].tolist() == [1.0]
    assert store.record(short).asked == {"levels": 1}
    assert store.record(long).evaluation["success"].tolist() == [0.0]
    assert store.record(long).asked is None
    assert (store.steps(short), store.steps(long)) == (200, 400)
    assert store.was_extended(long)


def test_a_run_without_an_evaluation_is_extended_too(store, suite):
    short, long = suite.runs[0], suite.runs[0].with_args(total_timesteps=400)
    write_run(store, short, [1.0, 2.0])
    store.start(long, [], [long])
    assert [store.state(short), store.state(long)] == ["done", "interrupted"]
    assert not store.path(short, "evaluation-200.csv").exists()


def test_a_run_that_starts_again_at_its_length_keeps_what_it_has(store, suite):
    spec = dataclasses.replace(suite.runs[0], evaluation={"levels": 1, "repeats": 1})
    write_run(store, spec, [1.0], episodes=make_episodes(seen_sampled=[[1.0]]))
    store.start(spec, [], [spec])
    assert store.state(spec) == "done"
    assert store.shorter_lengths(spec) == []
    assert store.path(spec, "evaluation.csv").exists()


def test_a_shorter_run_that_never_ended_leaves_no_record(store, suite):
    short, long = suite.runs[0], suite.runs[0].with_args(total_timesteps=400)
    write_run(store, short, [1.0], episodes=make_episodes(seen_sampled=[[1.0]]), done=False)
    store.start(long, [], [long])
    assert store.shorter_lengths(long) == []
    assert not store.path(long, "evaluation.csv").exists()  # it is not of the longer run
    assert not store.path(long, "spec-200.json").exists()


def test_lengths_are_sorted_as_numbers(store, suite):
    spec = suite.runs[0]
    store.start(spec, [], [spec])
    for length in (1000, 200, 30):
        store.path(spec, f"done-{length}.json").touch()
    assert store.shorter_lengths(spec) == [30, 200, 1000]


# --- archives ------------------------------------------------------------------------------------


def test_an_archived_run_is_done_and_told(store, suite, tmp_path):
    spec, other = suite.runs[:2]
    write_run(store, spec, [1.0, 2.0])
    write_archive(archive_path(tmp_path / "archives", spec), [store.record(spec)])
    elsewhere = Store(tmp_path / "elsewhere", tmp_path / "archives")
    assert [elsewhere.state(spec), elsewhere.state(other)] == ["done", "pending"]
    assert [elsewhere.is_done(spec), elsewhere.is_done(other)] == [True, False]
    assert [elsewhere.steps(spec), elsewhere.steps(other)] == [200, 0]
    assert elsewhere.record(spec).same(store.record(spec))
    assert elsewhere.own_record(spec) is None

    record = dataclasses.replace(store.record(spec), scores={})  # of one without a row
    write_archive(archive_path(tmp_path / "others", spec), [record])
    assert Store(tmp_path / "elsewhere", tmp_path / "others").steps(spec) == 0

    write_run(elsewhere, spec, [1.0, 7.0])
    with pytest.raises(ArchiveError, match="has other results"):
        elsewhere.record(spec)
