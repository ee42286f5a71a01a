"""The commands, as a user types them."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pandas as pd
import pytest

from harness.evaluation import robustness, runs
from harness.files import write_json
from harness.provenance import ROOT
from harness.schema import suite_names
from harness.suite import load_suite
from tests.harness.conftest import make_episodes, write_run


@pytest.fixture
def small(suite_file, store):
    """Flags of the smallest plan: two runs."""
    return ["--suite", suite_file, "--results-dir", store.root, "--seeds", 1, "--agents", 1,
            "--env", "Hopper"]  # fmt: skip


def test_run_all_runs_reports_and_runs_nothing_twice(run_cli, store, small):
    status, out = run_cli("run-all", *small)
    assert status == 0, out
    assert "2 runs, 400 steps." in out
    assert "0 done before, 2 to do" in out
    assert "106.8" in out
    report = store.root / "tiny" / "report"
    assert {"report.html", "table1.md", "table1.csv", "claims.csv"} <= {
        p.name for p in report.iterdir()
    }
    status, out = run_cli("run-all", *small)
    assert status == 0
    assert "2 done before, 0 to do" in out
    assert "done in" not in out


def test_run_all_ends_with_the_log_of_what_failed(run_cli, store, suite, small):
    broken = suite.runs[0]
    store.start(broken, ["true"], [broken])
    store.path(broken, "checkpoint.pt").write_bytes(b"torn")
    status, out = run_cli("run-all", *small)
    assert status == 1
    assert "1 done before" not in out
    assert "FAILED ppo__Hopper__s1__a0" in out
    assert "no readable checkpoint" in out


def test_run_all_says_what_the_other_suites_would_take(run_cli, store, small):
    _, out = run_cli("run-all", *small)
    assert "To come: run-all --suite table1 takes 960 runs, 4,800,000,000 steps (" in out


def test_a_changed_configuration_is_refused_before_anything_starts(run_cli, store, suite, small):
    write_run(store, suite.runs[0], [1.0])
    status, out = run_cli("run-all", *small, "--total-timesteps", 300)
    assert status == 1
    assert "total_timesteps 200 -> 300" in out
    assert not store.path(suite.runs[1]).exists()


@pytest.fixture
def two_files(suite_file, tmp_path):
    """Two suites whose runs have the same names: the second has one seed and one agent."""
    text = suite_file.read_text().replace("seeds = [1, 2]", "seeds = [1]")
    other = tmp_path / "other.toml"
    other.write_text(text.replace("agents = 2", "agents = 1").replace("Tiny", "Single"))
    return [suite_file, other]


def test_run_all_of_several_suites_has_one_queue_and_one_page(run_cli, store, two_files):
    for file in two_files:
        for spec in load_suite(str(file)).runs:
            if spec.algorithm == "PPO" or spec.environment == "Reacher":
                write_run(store, spec, [1.0, float(spec.args["agent"])])
    words = ["--suite", *two_files, "--results-dir", store.root]
    status, out = run_cli("run-all", *words, "--seeds", 1, "--env", "Hopper", "--jobs", 2)
    assert status == 0, out
    assert "3 done before, 3 to do, 2 at a time" in out
    assert "[3/3]" in out
    assert "other/ppo-reg__Hopper__s1__a0  done in" in out
    assert store.is_done(load_suite(str(two_files[1])).runs[0])
    for name in ("tiny", "other"):
        assert (store.root / name / "report" / "report.html").exists()
    page = (store.root / "report" / "report.html").read_text()
    assert page.index("<h1>Tiny</h1>") < page.index("<h1>Single</h1>")


def test_the_last_lines_are_the_verdicts_and_the_page(run_cli, store, two_files):
    for file in two_files:
        for spec in load_suite(str(file)).runs:
            write_run(store, spec, [1.0, float(spec.args["agent"])])
    status, out = run_cli("report", "--suite", *two_files, "--results-dir", store.root)
    assert status == 0, out
    lines = [line for line in out.splitlines() if line][-6:]
    assert lines[0].startswith("tiny: 16 of 16 runs done, at 0.004% of the paper's length")
    assert [line[:14] for line in lines[1:4]] == [f"({x}) undecided:" for x in "abe"]
    assert lines[4] == "other: 4 of 4 runs done. One agent a setting: nothing to judge."
    assert lines[5] == f"Written: {store.root / 'report' / 'report.html'}"
    assert "Single" not in out  # single agents have no table here: the page has it


def test_another_evaluation_is_made_without_training_anew(run_cli, store, suite_file):
    words = ["--suite", suite_file, "--results-dir", store.root, "--jobs", 2]
    words += ["--env", "Hopper", "--seeds", 1]
    text = suite_file.read_text()
    suite_file.write_text(f"{text}\n[evaluation]\nepisodes = 1\n")
    status, out = run_cli("run-all", *words)
    assert status == 0, out
    specs = load_suite(str(suite_file), seeds=1, env=("Hopper",)).runs
    trained = [store.path(spec, "checkpoint.pt").read_bytes() for spec in specs]
    first = [pd.read_csv(store.path(spec, "evaluation.csv")) for spec in specs]
    assert [len(found) for found in first] == [2, 2, 2, 2]

    suite_file.write_text(f"{text}\n[evaluation]\nepisodes = 2\n")
    status, out = run_cli("run-all", *words)
    assert status == 0, out
    assert "0 done before, 4 to do" in out
    assert [store.path(spec, "checkpoint.pt").read_bytes() for spec in specs] == trained
    for spec, before in zip(specs, first, strict=True):
        found = pd.read_csv(store.path(spec, "evaluation.csv"))
        assert len(found) == 4
        pd.testing.assert_frame_equal(found[found["episode"] == 0].reset_index(drop=True), before)
    assert "4 done before, 0 to do" in run_cli("run-all", *words)[1]


def test_a_suite_without_the_tasks_that_are_asked_for_is_left_out(run_cli, store, two_files):
    other = two_files[1]
    other.write_text(other.read_text().replace('Hopper = "Pendulum-v1"', ""))
    words = ["--suite", *two_files, "--results-dir", store.root, "--env", "Hopper", "--dry-run"]
    for spec in load_suite(str(two_files[0])).runs:
        write_run(store, spec, [1.0])
    status, out = run_cli("run-all", *words)
    assert status == 0, out
    assert "tiny: Tiny. 8 runs" in out
    assert "Single" not in out


def test_what_a_suite_includes_is_run_once_when_it_is_asked_for_too(run_cli, store):
    words = ["--suite", "smoke", "smoke_coinrun", "--results-dir", store.root, "--dry-run"]
    found = make_episodes(seen_sampled=[[1.0]])
    for spec in load_suite("smoke").runs:
        write_run(store, spec, [1.0], episodes=found if "levels" in spec.evaluation else None)
    status, out = run_cli("run-all", *words)
    assert status == 0, out
    assert "52 done before, 0 to do" in out


def columns(out: str, suite: str) -> dict[str, str]:
    """A suite's row of what `status` prints, by column."""
    lines = [x.replace("┃", " ").replace("│", " ").split() for x in out.splitlines()]
    header = next(line for line in lines if line[:1] == ["suite"])
    row = next(line for line in lines if line[:1] == [suite])
    return dict(
        zip(header, [*row[: len(header) - 1], " ".join(row[len(header) - 1 :])], strict=True)
    )


def test_status_counts_states(run_cli, store, suite, suite_file):
    write_run(store, suite.runs[0], [1.0, 2.0])
    store.start(suite.runs[1], ["true"], [suite.runs[1]])
    status, out = run_cli("status", "--suite", suite_file, "--results-dir", store.root)
    assert status == 0
    assert columns(out, "tiny") == {
        "suite": "tiny", "done": "1", "interrupted": "1", "pending": "14", "steps": "200 of 3,200"
    }  # fmt: skip


def test_status_counts_runs_that_diverged(run_cli, store, suite, suite_file):
    write_run(store, suite.runs[0], [1.0], done=False)
    write_json(store.path(suite.runs[0], "diverged.json"), {"message": "NaN"})
    store.finish(suite.runs[0], returncode=3, seconds=1.0)
    _, out = run_cli("status", "--suite", suite_file, "--results-dir", store.root)
    assert columns(out, "tiny")["diverged"] == "1"
    assert columns(out, "tiny")["done"] == "0"


def test_status_goes_on_where_the_settings_were_others(run_cli, store, suite):
    changed = dataclasses.replace(suite.runs[0], suite="smoke").with_args(gamma=0.5)
    write_run(store, changed, [1.0])
    status, out = run_cli("status", "--results-dir", store.root)
    assert status == 0
    assert columns(out, "smoke")["changed"] == "1"
    assert columns(out, "table1")["changed"] == "0"


def test_a_part_of_a_suite_does_not_hide_the_rest_of_the_report(run_cli, store, suite, small):
    for spec in suite.runs:
        write_run(store, spec, [1.0])
    _, out = run_cli("run-all", *small)
    assert "Reacher" in out
    assert (store.root / "tiny" / "report" / "table1.csv").read_text().count("\n") == 5


def test_seeds_beyond_the_suites_own_are_in_the_report(run_cli, store, suite_file):
    for spec in load_suite(str(suite_file), seeds=3).runs:
        write_run(store, spec, [6.0 if spec.args["seed"] == 3 else 0.0])
    words = ["--suite", suite_file, "--results-dir", store.root, "--seeds", 3]
    table = store.root / "tiny" / "report" / "table1.csv"
    for command in ("run-all", "report"):
        status, out = run_cli(command, *words)
        assert status == 0, out
        cells = pd.read_csv(table)
        assert cells["mean"].tolist() == [2.0] * 4
        assert (set(cells["seeds"]), set(cells["planned"])) == ({3}, {6})
        table.unlink()
    run_cli("run-all", *words[:-1], 1)  # fewer seeds hide nothing of the suite
    assert set(pd.read_csv(table)["seeds"]) == {2}


LEVELS = make_episodes(
    seen_sampled=[[1, 1], [1, 1]], unseen_sampled=[[0, 1], [0, 0]],
    seen_greedy=[[1], [1]], unseen_greedy=[[0], [0]],
)  # fmt: skip
CONTROL = pd.DataFrame(
    [
        ("deterministic", 0, 10.0, 100, 0.5, 0.001),
        ("deterministic", 1, 20.0, 300, 0.7, 0.003),
        ("sampled", 0, -5.0, 50, 1.0, 0.01),
    ],
    columns=["policy", "episode", "return", "length", "action_change", "smoothness"],
)


@pytest.fixture
def asked(monkeypatch):
    """Evaluations that were asked for; each run gives what its folder's name says."""
    found = []

    def evaluate_run(path, settings, show):
        found.append((path, settings))
        return {"levels": LEVELS, "control": CONTROL}[path.name.split("-")[0]]

    monkeypatch.setattr(runs, "evaluate_run", evaluate_run)
    return found


def rows(out: str) -> list[list[str]]:
    return [line.replace("│", " ").split() for line in out.splitlines() if "│" in line]


def test_evaluate_says_the_rates_and_their_intervals(run_cli, asked, tmp_path):
    path = tmp_path / "levels-1"
    flags = ["--levels", 2, "--repeats", 3, "--unseen", "unbounded", "--device", "cpu"]
    status, out = run_cli("evaluate", path, *flags)
    assert status == 0, out
    settings = runs.Settings(levels=2, repeats=3, unseen="unbounded", device="cpu")
    assert asked == [(path, settings)]
    found = rows(out)
    assert found == [
        ["levels-1", "seen", "greedy", "100.0%", "100.0", "to", "100.0"],
        ["levels-1", "seen", "sampled", "100.0%", "100.0", "to", "100.0"],
        ["levels-1", "unseen", "greedy", "0.0%", "0.0", "to", "0.0"],
        ["levels-1", "unseen", "sampled", "25.0%", "0.0", "to", found[3][6]],
    ]
    run_cli("evaluate", path)
    assert asked[1] == (path, runs.Settings())


def test_evaluate_takes_several_runs_of_both_kinds(run_cli, asked, tmp_path):
    paths = [tmp_path / name for name in ("control-1", "levels-2", "control-3")]
    status, out = run_cli("evaluate", *paths, "--episodes", 7)
    assert status == 0, out
    assert asked == [(path, runs.Settings(episodes=7)) for path in paths]
    of_control = [row for row in rows(out) if row[0].startswith("control")]
    assert of_control == [
        [name, *cells]
        for name in ("control-1", "control-3")
        for cells in (
            ["deterministic", "2", "15.0", "±", "5.0", "200", "0.600", "2.00e-03"],
            ["sampled", "1", "-5.0", "±", "0.0", "50", "1.000", "1.00e-02"],
        )
    ]
    assert sum(row[0] == "levels-2" for row in rows(out)) == 4
    assert "[2/3] levels-2 evaluated" in out


def test_evaluate_attacks_where_it_is_asked_to(run_cli, monkeypatch, tmp_path):
    found = []

    def evaluate_robustness(path, settings, show, threat):
        found.append((path, settings, threat))
        rows = [("mad", 0.1, "l2", i, x, 10, 0.5, 0.01) for i, x in enumerate((10.0, 20.0))]
        return pd.DataFrame(rows, columns=robustness.COLUMNS)

    monkeypatch.setattr(robustness, "evaluate_robustness", evaluate_robustness)
    flags = ["--attack", "mad,random", "--radius", "0.1", "--norm", "l2", "--episodes", 2]
    status, out = run_cli("evaluate", tmp_path / "run", *flags)
    assert status == 0, out
    threat = robustness.Threat(("mad", "random"), (0.1,), "l2")
    assert found == [(tmp_path / "run", runs.Settings(episodes=2), threat)]
    assert rows(out) == [["run", "mad", "0.1", "l2", "2", "15.0", "±", "5.0", "10", "0.500"]]
    status, out = run_cli("evaluate", tmp_path / "run", "--radius", "0.1")
    assert (status, len(found)) == (1, 1)
    assert out.startswith("error: --radius and --norm need --attack")


def test_a_run_that_diverged_is_passed_over(run_cli, asked, tmp_path):
    bad, good = tmp_path / "control-bad", tmp_path / "control-good"
    bad.mkdir()
    (bad / "diverged.json").write_text("{}")
    status, out = run_cli("evaluate", bad, good)
    assert status == 0, out
    assert [path for path, _ in asked] == [good]
    assert "control-bad diverged: it has no final policy" in out


def test_evaluate_refuses_in_a_line(run_cli, tmp_path):
    status, out = run_cli("evaluate", tmp_path)
    assert status == 1
    assert out == f"error: {tmp_path} holds no checkpoint.pt: train it first"
    status, out = run_cli("evaluate")
    assert status == 1
    assert out.startswith("error: name at least one folder of a run")
    status, out = run_cli("evaluate", tmp_path, "--episodes", 0)
    assert (status, out) == (1, "error: episodes must be at least 1, got 0")


def test_status_and_list_count_the_runs_of_suites_that_include_others(run_cli, store):
    spec = load_suite("smoke_coinrun").runs[0]
    write_run(store, spec, [1.0], episodes=make_episodes(seen_sampled=[[1.0]]))
    _, out = run_cli("status", "--results-dir", store.root)
    rows = {
        row[0]: row[1:] for row in (x.replace("│", " ").split() for x in out.splitlines()) if row
    }
    assert rows["smoke_coinrun"][0] == rows["smoke"][0] == "1"  # the same run, once
    assert rows["table2"][0] == "0"
    _, out = run_cli("list")
    assert "1328" in next(line for line in out.splitlines() if "│ paper" in line)


def test_list_names_every_suite(run_cli):
    _, out = run_cli("list")
    assert all(name in out for name in suite_names())


def test_report_of_an_unfinished_suite(run_cli, store, suite, suite_file):
    write_run(store, suite.runs[0], [1.0, 2.0])
    status, out = run_cli("report", "--suite", suite_file, "--results-dir", store.root)
    assert status == 0
    assert "(n 1, 0 failed, finds –)" in out
    assert "Missing" in out


def test_cost_says_what_was_added_and_keeps_it(run_cli, tmp_path, monkeypatch):
    timed = pd.DataFrame(
        {
            "algorithm": "PPO", "implementation": "population", "environment": "Hopper",
            "repetition": range(6), "plain": 1e-3, "reg": 1.05e-3,
        }
    )  # fmt: skip
    asked = []
    monkeypatch.setattr("harness.cli.measure_in_turn", lambda *given: asked.append(given) or timed)
    status, out = run_cli("cost", "--env", "Hopper", "--results-dir", tmp_path / "new")
    assert status == 0
    assert "+5.0% [+5.0, +5.0], n 6: supported" in out
    assert len(pd.read_csv(tmp_path / "new" / "cost.csv")) == 6
    ids, implementations, repetitions, updates, _ = asked[0]
    assert list(ids) == ["Hopper"]
    assert (implementations, repetitions, updates) == (["single file", "population"], 10, 6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run-all", "--suite", "tabel1"], "no suite 'tabel1'"),
        (["run-all", "--suite", "first", "first"], "name each suite once"),
        (["report", "--suite", "first", "smok"], "no suite 'smok'"),
        (["run-all", "--env", "Hoper"], "Hopper?"),
        (["cost", "--implementation", "populatoin"], "population?"),
        (["run-all", "--jobs", "0"], "jobs must be at least 1, got 0"),
        (["run-all", "--total-timesteps", "5"], "total_timesteps must be at least"),
    ],
)
def test_bad_flags_are_refused(run_cli, words, message):
    status, out = run_cli(*words)
    assert status == 1
    assert message in out


def test_help_explains_every_flag():
    words = [sys.executable, "-m", "harness", "run-all", "--help"]
    out = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for flag in ("--suite", "--jobs", "--results-dir", "--total-timesteps", "--seeds", "--env"):
        assert flag in out
    assert "Ctrl-C" in out


def test_help_of_evaluate_says_what_each_flag_is_for():
    words = [sys.executable, "-m", "harness", "evaluate", "--help"]
    out = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for flag in ("--episodes", "--levels", "--repeats", "--unseen", "--device", "--attack"):
        assert flag in out
    assert "{next,unbounded,themes}" in out
    assert "final policy" in out
