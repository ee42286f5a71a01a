"""Archives: what they keep exactly, what is refused, and how they stand in for the runs."""

from __future__ import annotations

import dataclasses
import json
import lzma
import math
import random

import numpy as np
import pandas as pd
import pytest

from harness.archive import (
    ArchiveError,
    Archives,
    checkpoints_path,
    names_in,
    read_archive,
    read_checkpoint,
    write_archive,
)
from harness.files import StoreError
from harness.pack import pack
from harness.report.results import load_results
from harness.store import Store
from harness.suite import load_suite
from tests.harness.conftest import write_run

EPISODES = pd.DataFrame(
    {
        "policy": ["deterministic", "sampled", "sampled"],
        "episode": [0, 0, 1],
        "return": [1 / 3, -2e-17, 5.0],
        "smoothness": [0.1 + 0.2, math.nan, 1.0],
    }
)


@pytest.fixture
def root(tmp_path):
    return tmp_path / "docs"


@pytest.fixture
def runs(suite):
    """The suite's runs of PPO on Hopper: two seeds of two agents."""
    return [x for x in suite.runs if (x.algorithm, x.environment) == ("PPO", "Hopper")]


@pytest.fixture
def finish(store):
    """Finishes runs of 250 updates, each with curves of its own."""

    def make(specs, shift: float = 0.0, **changes) -> None:
        for spec in specs:
            rng = np.random.default_rng(1000 * spec.args["seed"] + spec.args["agent"])
            columns = {"conditioning/gradient_share": [0.25] + [math.nan] * 248 + [0.5]}
            returns = rng.normal(size=250) + shift
            write_run(store, spec, returns, rng.random(250), columns=columns, **changes)

    return make


def packed(suite, store, root, with_checkpoints=False):
    """Archive; gives the texts that are said."""
    return [x.text for x in pack(suite, store, root, with_checkpoints)]


def files(root):
    return sorted(path.name for path in root.glob("tiny/*"))


# --- what it keeps -------------------------------------------------------------------------------


def test_scores_and_evaluations_are_exact_and_curves_are_close(store, runs, root, finish):
    spec = dataclasses.replace(runs[0], evaluation={"levels": 1, "repeats": 1})
    spec = spec.with_args(total_timesteps=25_000)  # 250 updates: three make a point
    finish([spec], episodes=EPISODES)
    store.path(spec, "evaluation.json").write_text('{"asked": "for this"}')
    own = store.record(spec)
    path = root / "tiny" / "a.jsonl.xz"
    write_archive(path, [own])
    (record,) = read_archive(path)

    assert record.scores == own.scores
    assert len(record.scores) > 8
    assert record.done == own.done
    assert record.asked == {"asked": "for this"}
    pd.testing.assert_frame_equal(record.evaluation, own.evaluation, check_exact=True)
    assert record.updates == 3
    assert len(record.curves) == 84
    assert record.curves["global_step"].tolist()[:2] == [300, 600]
    psi = own.curves["conditioning/psi"]
    assert record.curves["conditioning/psi"][0] == pytest.approx(psi[:3].mean(), rel=1e-4)
    assert record.curves["conditioning/gradient_share"].dropna().tolist() == [0.25, 0.5]
    assert not record.changes(spec)


def test_what_is_no_number_travels_as_it_is(store, runs, root):
    inf = math.inf
    write_run(store, runs[0], [1.0, inf, math.nan], [-inf, 2.0, 3.0])
    own = dataclasses.replace(
        store.record(runs[0]),
        scores={"a": inf, "b": -inf, "c": math.nan, "d": 1 / 3},
        evaluation=pd.DataFrame({"return": [inf, -inf, 0.5], "smoothness": [math.nan, inf, 1.0]}),
    )
    write_archive(root / "a.jsonl.xz", [own])
    (record,) = read_archive(root / "a.jsonl.xz")
    assert record.scores == pytest.approx(own.scores, rel=0, abs=0, nan_ok=True)
    pd.testing.assert_frame_equal(record.evaluation, own.evaluation, check_exact=True)
    for column in ("charts/episodic_return", "conditioning/psi"):
        assert record.curves[column].tolist() == pytest.approx(
            own.curves[column].tolist(), nan_ok=True
        )

    unknown = dataclasses.replace(own, done={"seconds": math.nan})
    with pytest.raises(ValueError, match="JSON"):  # which another reader would not take
        write_archive(root / "b.jsonl.xz", [unknown])


def test_curves_have_five_digits_and_the_text_no_spaces(store, runs, root):
    write_run(store, runs[0], [2 / 3, 123456.7, 2.0])
    write_archive(root / "a.jsonl.xz", [store.record(runs[0])])
    (record,) = read_archive(root / "a.jsonl.xz")
    assert record.curves["charts/episodic_return"].tolist() == [0.66667, 123460.0, 2.0]
    text = lzma.decompress((root / "a.jsonl.xz").read_bytes()).decode()
    for line in text.splitlines():
        assert line == json.dumps(json.loads(line), separators=(",", ":"))


def test_an_archive_of_an_archive_is_the_same(store, runs, root, finish):
    spec = runs[0].with_args(total_timesteps=25_000)  # three updates make a point
    finish([spec])
    write_archive(root / "a.jsonl.xz", [store.record(spec)])
    write_archive(root / "b.jsonl.xz", read_archive(root / "a.jsonl.xz"))
    assert (root / "a.jsonl.xz").read_bytes() == (root / "b.jsonl.xz").read_bytes()


def test_an_archive_names_no_folder_of_this_machine_and_no_pickle(store, runs, root, finish):
    finish(runs[:1])
    path = root / "a.jsonl.xz"
    write_archive(path, [store.record(runs[0])])
    text = lzma.decompress(path.read_bytes()).decode()
    header, run = map(json.loads, text.splitlines())
    assert header["format"] == "condwrap results"
    assert set(run["spec"]) == {"baseline", "version", "args", "evaluation", "agents", "sessions"}
    assert str(root.parent) not in text


def test_the_same_runs_give_the_same_bytes(store, runs, root, finish):
    finish(runs)
    records = [store.record(spec) for spec in runs]
    write_archive(root / "a.jsonl.xz", records)
    write_archive(root / "b.jsonl.xz", records[::-1])
    assert (root / "a.jsonl.xz").read_bytes() == (root / "b.jsonl.xz").read_bytes()


def test_a_hundred_runs_take_about_a_mebibyte(store, runs, root):
    """With 30 columns of noise, which nothing can compress, at 100 points each."""
    spec = runs[0].with_args(total_timesteps=25_000)
    rng = np.random.default_rng(0)
    columns = {f"losses/{i}": rng.normal(size=250) for i in range(26)}
    write_run(store, spec, rng.normal(size=250), rng.random(250), columns=columns)
    record = store.record(spec)
    many = [dataclasses.replace(record, run_id=str(i), curves=shuffled(record.curves, rng))
            for i in range(10)]  # fmt: skip
    write_archive(root / "a.jsonl.xz", many)
    assert (root / "a.jsonl.xz").stat().st_size < 10 * 1.1 * 2**20 / 100


def shuffled(curves, rng):
    return curves.sample(frac=1, random_state=rng).assign(global_step=curves["global_step"])


# --- damage --------------------------------------------------------------------------------------


@pytest.fixture
def archive(store, runs, root, finish):
    finish(runs)
    path = root / "tiny" / "ppo__Hopper.jsonl.xz"
    write_archive(path, [store.record(spec) for spec in runs])
    return path


def test_every_damaged_archive_is_refused_by_name(archive):
    content = archive.read_bytes()
    rng = random.Random(0)
    damaged = [content[:-1], content[: len(content) // 2], b"", content + b"x", content * 2]
    for _ in range(100):
        bit = rng.randrange(8 * len(content))
        changed = bytearray(content)
        changed[bit // 8] ^= 1 << bit % 8
        damaged.append(bytes(changed))
    for some in damaged:
        archive.write_bytes(some)
        with pytest.raises(ArchiveError, match=r"ppo__Hopper\.jsonl\.xz is damaged"):
            read_archive(archive)


def rewrite(path, change) -> None:
    """Change the lines of an archive and compress it again: xz's own checksum is right then."""
    lines = lzma.decompress(path.read_bytes()).decode().splitlines()
    path.write_bytes(lzma.compress("".join(f"{x}\n" for x in change(lines)).encode()))


def test_only_the_format_xz_is_taken(archive):
    older = lzma.compress(lzma.decompress(archive.read_bytes()), format=lzma.FORMAT_ALONE)
    archive.write_bytes(older)  # it has no checksum of its own
    with pytest.raises(ArchiveError, match="is damaged"):
        read_archive(archive)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [lines[0], *lines[2:]], "has not the checksum that it names"),
        (lambda lines: [*lines[:-1], lines[-1].replace("Pendulum", "Pendulun")], "checksum"),
        (lambda lines: [lines[0].replace('"runs":4', '"runs":5'), *lines[1:]], "4 runs of 5"),
        (lambda lines: [lines[0].replace('"version":1', '"version":9'), *lines[1:]], "format"),
        (lambda lines: ["[]"], "no archive of results"),
        (lambda lines: ["what"], "no archive of results"),
    ],
)
def test_what_is_compressed_is_checked_too(archive, change, message):
    rewrite(archive, change)
    with pytest.raises(ArchiveError, match=message):
        read_archive(archive)


def test_a_damaged_archive_stops_a_report_in_a_line(run_cli, archive, store, suite_file, root):
    archive.write_bytes(archive.read_bytes()[:-5])
    words = ["--suite", suite_file, "--results-dir", store.root, "--archives", root]
    status, out = run_cli("report", *words)
    assert status == 1
    assert out.startswith(f"error: {archive} is damaged")


# --- which runs go where -------------------------------------------------------------------------


def test_a_file_is_written_once_all_planned_runs_are_finished(store, suite, runs, root, finish):
    finish(runs[:3])
    texts = packed(suite, store, root)
    assert texts[0] == "PPO on Hopper: 1 of 4 runs are not finished"
    assert not root.exists()
    finish(runs[3:])
    texts = packed(suite, store, root)
    assert texts[0].startswith(f"PPO on Hopper: {root / 'tiny' / 'ppo__Hopper.jsonl.xz'}, ")
    assert texts[1] == "PPO on Reacher: 4 of 4 runs are not finished"
    assert files(root) == ["ppo__Hopper.jsonl.xz"]
    assert len(read_archive(root / "tiny" / "ppo__Hopper.jsonl.xz")) == 4


def test_a_written_file_is_never_written_again(store, suite_file, runs, root, finish):
    finish(runs)
    suite = load_suite(str(suite_file), env=("Hopper",))
    packed(suite, store, root)
    before = (root / "tiny" / "ppo__Hopper.jsonl.xz").read_bytes()
    store = Store(store.root, root)
    assert packed(suite, store, root)[0] == "PPO on Hopper: archived before"

    more = load_suite(str(suite_file), env=("Hopper",), seeds=3)
    finish([x for x in more.runs if x.algorithm == "PPO" and x.args["seed"] == 3])
    packed(more, store, root)
    assert files(root) == ["ppo__Hopper.jsonl.xz", "ppo__Hopper__2.jsonl.xz"]
    assert (root / "tiny" / "ppo__Hopper.jsonl.xz").read_bytes() == before
    later = read_archive(root / "tiny" / "ppo__Hopper__2.jsonl.xz")
    assert [x.run_id for x in later] == ["ppo__Hopper__s3__a0", "ppo__Hopper__s3__a1"]

    merged = Archives(root)  # the two files as one
    ppo = [x for x in more.runs if x.algorithm == "PPO"]
    assert [merged.find(spec).run_id for spec in ppo] == [spec.run_id for spec in ppo]


def test_files_that_changed_since_the_run_ended_are_not_archived(store, suite, runs, root, finish):
    finish(runs)
    path = store.path(runs[2], "metrics.csv")
    path.write_bytes(path.read_bytes().replace(b"100,", b"101,", 1))
    with pytest.raises(StoreError, match=r"s2__a0/metrics\.csv is damaged"):
        packed(suite, store, root)
    assert not root.exists()


def test_checkpoints_come_beside_and_are_checked(store, suite, runs, root, finish):
    finish(runs)
    packed(suite, store, root)
    assert len(files(root)) == 1
    again = Store(store.root, root)
    packed(suite, again, root, with_checkpoints=True)  # also to an archive from before
    assert files(root) == ["ppo__Hopper.checkpoints.zip", "ppo__Hopper.jsonl.xz"]
    record = Archives(root).find(runs[0])
    assert read_checkpoint(record) == b"weights"

    path = checkpoints_path(record.place)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"weights", b"Weights"))
    with pytest.raises(ArchiveError, match=r"checkpoints\.zip is damaged"):
        read_checkpoint(record)
    path.unlink()
    with pytest.raises(ArchiveError, match=r"holds no checkpoint of ppo__Hopper__s1__a0"):
        read_checkpoint(record)


def test_the_shorter_run_of_an_extended_one_is_archived_too(store, suite, runs, root):
    short, long = (runs[0].with_args(total_timesteps=n) for n in (25_000, 50_000))
    rewards = np.random.default_rng(0).normal(size=500)
    write_run(store, short, rewards[:250], rewards[:250])
    scores = store.record(short).scores
    write_run(store, long, rewards, rewards)
    packed(dataclasses.replace(suite, runs=[long]), store, root)
    archives = Archives(root)
    assert archives.find(short).scores == scores
    assert archives.find(long).scores == store.record(long).scores != scores
    assert [record.total_timesteps for record in archives.shorter(long)] == [25_000]
    assert archives.shorter(short) == []
    assert archives.shorter(long.with_args(gamma=0.9)) == []  # another run altogether


def test_a_checkpoint_of_a_longer_run_is_not_taken_for_the_shorter_ones(store, suite, runs, root):
    short, long = (runs[0].with_args(total_timesteps=n) for n in (25_000, 50_000))
    write_run(store, short, np.zeros(250))
    write_run(store, long, np.zeros(500))
    store.path(long, "checkpoint.pt").write_bytes(b"longer")
    packed(dataclasses.replace(suite, runs=[short]), store, root, with_checkpoints=True)
    (record,) = read_archive(root / "tiny" / "ppo__Hopper.jsonl.xz")
    assert record.total_timesteps == 25_000
    assert files(root) == ["ppo__Hopper.jsonl.xz"]
    with pytest.raises(ArchiveError, match="holds no checkpoint of ppo__Hopper__s1__a0"):
        read_checkpoint(record)


def test_checkpoints_are_all_there_or_none(store, suite, runs, root, finish):
    finish(runs)
    packed(suite, store, root)
    path = store.path(runs[1], "checkpoint.pt")
    content = path.read_bytes()
    path.unlink()
    again = Store(store.root, root)
    text = packed(suite, again, root, with_checkpoints=True)[0]
    assert text.endswith(f"no checkpoints, since those of {runs[1].run_id} are not here")
    assert files(root) == ["ppo__Hopper.jsonl.xz"]

    path.write_bytes(content)
    packed(suite, again, root, with_checkpoints=True)
    target = root / "tiny" / "ppo__Hopper.checkpoints.zip"
    assert names_in(target) == {spec.run_id for spec in runs}
    target.write_bytes(target.read_bytes()[:50])  # as a kill of an older version left it
    packed(suite, again, root, with_checkpoints=True)
    assert names_in(target) == {spec.run_id for spec in runs}


# --- in place of the runs ------------------------------------------------------------------------


@pytest.fixture
def elsewhere(tmp_path, archive, root):
    """A results folder without runs, beside the archive."""
    return Store(tmp_path / "elsewhere", root)


def test_an_archived_run_is_done_and_is_read(elsewhere, suite, runs, store):
    assert [elsewhere.state(spec) for spec in runs] == ["done"] * 4
    results = load_results(suite, elsewhere)
    assert results.done == [spec.run_id for spec in runs]
    for spec in runs:
        assert results.scores[spec.run_id] == store.record(spec).scores
    assert results.curves("Hopper", "PPO", "conditioning/psi").shape[1] == 4
    assert results.origins.implementations == {"single file": 4}


def test_run_all_runs_only_what_is_not_archived(run_cli, elsewhere, runs, suite_file, root, store):
    words = ["--suite", suite_file, "--results-dir", elsewhere.root, "--archives", root]
    status, out = run_cli("status", *words)
    row = next(line for line in out.splitlines() if "tiny" in line)
    assert row.replace("│", " ").split() == ["tiny", "4", "12", "100,000", "of", "3,200"]
    status, out = run_cli("run-all", *words, "--dry-run", "--env", "Hopper", "--seeds", 1)
    assert status == 0, out
    assert "4 runs, 800 steps" in out
    assert "2 done before, 2 to do" in out
    assert not elsewhere.path(runs[0]).exists()


def test_an_archive_of_other_settings_does_not_count(elsewhere, runs, suite):
    other = runs[0].with_args(gamma=0.5)
    assert elsewhere.state(other) == "pending"
    changed = dataclasses.replace(suite, runs=[other, *runs[1:]])
    results = load_results(changed, elsewhere)
    assert results.changed == [other.run_id]
    assert other.run_id not in results.metrics
    longer = runs[0].with_args(total_timesteps=300)
    assert load_results(dataclasses.replace(suite, runs=[longer]), elsewhere).changed == []


def test_a_run_under_way_is_seen_beside_an_archive_of_other_settings(elsewhere, runs, suite):
    other = runs[0].with_args(gamma=0.5)
    write_run(elsewhere, other, [1.0, 2.0], done=False)
    results = load_results(dataclasses.replace(suite, runs=[other, *runs[1:]]), elsewhere)
    assert results.changed == []
    assert len(results.metrics[other.run_id]) == 2


def test_an_archived_run_counts_as_done_however_it_was_evaluated(elsewhere, runs, suite):
    asked = [dataclasses.replace(spec, evaluation={"episodes": 20}) for spec in runs]
    assert {elsewhere.state(spec) for spec in asked} == {"done"}
    results = load_results(dataclasses.replace(suite, runs=asked), elsewhere)
    assert results.evaluations == {}
    (warning,) = results.warnings
    assert warning.startswith("4 archived runs were evaluated otherwise than the suite asks for")


def test_scores_by_other_definitions_are_told(store, runs, root, finish, suite, tmp_path):
    finish(runs)
    old = [dataclasses.replace(store.record(spec), scores_version=0) for spec in runs]
    write_archive(root / "tiny" / "ppo__Hopper.jsonl.xz", old)
    results = load_results(suite, Store(tmp_path / "nothing", root))
    (warning,) = results.warnings
    assert warning.startswith("4 archived runs have scores by other definitions than today's")


def test_the_results_folder_wins_where_both_hold_the_same(store, archive, runs, suite, root):
    both = Store(store.root, root)
    assert both.record(runs[0]).place == store.path(runs[0])
    assert both.record(runs[0]).updates == 1


def test_two_outcomes_of_one_run_are_refused_and_both_named(
    store, suite, archive, runs, root, finish
):
    finish(runs[:1], shift=1.0)
    with pytest.raises(ArchiveError) as error:
        load_results(suite, Store(store.root, root))
    assert str(store.path(runs[0])) in str(error.value)
    assert str(archive) in str(error.value)

    other = archive.with_name("ppo__Hopper__2.jsonl.xz")
    write_archive(other, [store.record(runs[0])])
    with pytest.raises(ArchiveError) as error:
        Archives(root).find(runs[0])
    assert str(other) in str(error.value)
    assert str(archive) in str(error.value)


def test_the_same_run_in_two_archives_is_one(archive, runs, root):
    archive.with_name("copy.jsonl.xz").write_bytes(archive.read_bytes())
    assert Archives(root).find(runs[0]).run_id == runs[0].run_id


def test_curves_of_a_folder_and_of_an_archive_have_the_same_points(
    store, runs, root, tmp_path, suite, finish
):
    """The folder's are thinned alike, else the two would share no steps."""
    specs = [spec.with_args(total_timesteps=25_000) for spec in runs[:2]]
    finish(specs)
    write_archive(root / "tiny" / "a.jsonl.xz", [store.record(specs[0])])
    mixed = Store(tmp_path / "elsewhere", root)
    mixed.path(specs[1]).parent.mkdir(parents=True)
    store.path(specs[1]).rename(mixed.path(specs[1]))
    results = load_results(dataclasses.replace(suite, runs=specs), mixed)
    curves = results.curves("Hopper", "PPO", "conditioning/psi")
    assert curves.shape == (84, 2)
    assert not curves.isna().any().any()
    assert results.scores[specs[1].run_id]["updates"] == 250


def test_a_run_that_diverged_travels_with_what_it_said(store, runs, root, finish, suite, tmp_path):
    finish(runs[1:])
    finish(runs[:1], done=False)
    said = {"update": 7, "what": "loss", "message": "the loss was NaN"}
    store.path(runs[0], "diverged.json").write_text(json.dumps(said))
    assert store.finish(runs[0], 3, 1.0) == "diverged"
    packed(suite, store, root)
    elsewhere = Store(tmp_path / "elsewhere", root)
    assert elsewhere.state(runs[0]) == "diverged"
    results = load_results(suite, elsewhere)
    assert results.diverged == {runs[0].run_id: said}
    assert runs[0].run_id in results.done


def test_a_run_that_only_an_archive_holds_cannot_be_extended(run_cli, elsewhere, suite_file, root):
    words = ["--suite", suite_file, "--results-dir", elsewhere.root, "--archives", root]
    more = ["--extend", "--total-timesteps", 400, "--dry-run"]
    status, out = run_cli("run-all", *words, *more)
    assert status == 1
    assert "ppo__Hopper__s1__a0 cannot be extended: its 200 steps are in" in out


def test_archive_as_a_command(run_cli, store, suite_file, root, runs, finish):
    finish(runs)
    words = ["--results-dir", store.root, "--archives", root, "--env", "Hopper"]
    status, out = run_cli("archive", suite_file, *words, "--with-checkpoints")
    assert status == 0
    assert "PPO on Hopper: " in out
    assert "PPO reg on Hopper: 4 of 4 runs are not finished" in out
    assert files(root) == ["ppo__Hopper.checkpoints.zip", "ppo__Hopper.jsonl.xz"]
