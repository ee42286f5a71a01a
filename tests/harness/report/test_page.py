"""The page: everything is in it, nothing of a suite's text is taken for HTML, and it is stable."""

from __future__ import annotations

import dataclasses
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

from harness.report.claims import Claim, to_frame
from harness.report.page import write_page, write_report
from harness.report.results import Results, load_results
from harness.report.tables.table1 import Cell, make_cells
from harness.suite import load_suite
from tests.harness.conftest import make_episodes, write_run
from tests.harness.report.conftest import UPDATES, make_games, make_study
from tests.harness.report.tables.test_robustness import attack_all

VOID = {"meta", "img", "br", "hr", "link"}
OPTIONAL = {"html"}  # end tags that HTML does not ask for
RISING = np.linspace(0.0, 1.0, UPDATES)
MORE = """
[figures]
"Figure 2: PPO and PPO reg" = ["PPO", "PPO reg"]

[[sweeps]]
name = "size of delta"
baseline = "ppo_reg"
parameter = "radius"
values = [0.1, 2]
"""


MORE_ARMS = MORE[MORE.index("[[sweeps]]") :]
RESTS = " (n 10, 0 failed, finds 0)"


class Page(HTMLParser):
    """A parsed page: its elements, its text, and a complaint about any tag that does not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.images: list[dict[str, str]] = []
        self.verdicts: list[tuple[str, str]] = []  # classes and text
        self.cells: list[list[str]] = []
        self.headings: list[str] = []
        self.texts: list[str] = []
        self._class = ""
        self.feed(text)
        self.close()
        assert set(self.open) <= OPTIONAL, self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        values = dict(attrs)
        self._class = values.get("class") or ""
        if tag == "img":
            self.images.append(values)
        if tag == "tr":
            self.cells.append([])
        if tag in ("td", "th"):
            self.cells[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if self.open and self.open[-1] in ("h2", "h3"):
            self.headings.append(data)
        if {"td", "th"} & set(self.open):
            self.cells[-1][-1] += data
        if self.open and self.open[-1] == "span" and "verdict" in self._class.split():
            self.verdicts.append((self._class, data))

    @property
    def text(self) -> str:
        return "".join(self.texts)


@pytest.fixture
def report(store):
    """Writes the report of some results, and gives its folder, claims and parsed page."""

    def write(results):
        folder = store.report_path(results.suite.name)
        part = write_report(results, folder)
        return folder, part.claims, Page((folder / "report.html").read_text())

    return write


class Written(NamedTuple):
    """A report of 40 agents: claim (a) is supported; of (b) half gain a little and half lose."""

    results: Results
    folder: Path
    cells: list[Cell]
    claims: list[Claim]
    page: Page


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Written:
    folder = tmp_path_factory.mktemp("written")
    results = make_study(
        folder,
        lambda _, name, agent: agent + RISING + (agent % 2 - 0.5) * (name == "PPO reg"),
        lambda _, name, agent: 12.0 - agent - RISING,
        tasks=("Hopper", "Ant"), more=MORE,
    )  # fmt: skip
    report = folder / "report"
    report.mkdir()
    part = write_report(results, report)
    page = Page((report / "report.html").read_text())
    return Written(results, report, make_cells(results), part.claims, page)


def test_the_page_shows_every_figure_and_each_is_there(written):
    folder, page = written.folder, written.page
    files = [image["src"] for image in page.images]
    assert sorted(files) == [
        "ablation_1.png",
        "arms.png",
        "claim_a.png",
        "claim_b.png",
        "learning_curves_1.png",
        "psi_and_reward.png",
        "scores.png",
    ]
    assert sorted(path.name for path in folder.glob("*.png")) == sorted(files)
    for image in page.images:
        assert (folder / image["src"]).read_bytes().startswith(b"\x89PNG")
        assert image["alt"] in page.headings


def test_a_logged_spectrum_has_its_figure(store, suite, report):
    names = ("quotient_squared", "frobenius_squared_per_input")
    columns = {f"conditioning/{name}": [1.0, 2.0] for name in names}
    write_run(store, suite.runs[0], [1.0, 2.0], columns=columns)
    folder, _, page = report(load_results(suite, store))
    assert "jacobian.png" in [image["src"] for image in page.images]
    assert (folder / "jacobian.png").exists()


def test_j_has_a_table_and_its_curves(store, suite_file, report):
    more = '[figures]\n"Both" = ["PPO", "PPO reg"]\n\n[environments]'
    suite_file.write_text(suite_file.read_text().replace("[environments]", more))
    suite = load_suite(str(suite_file))
    for spec in suite.runs:
        write_run(store, spec, [1.0, 2.0], columns={"conditioning/quotient_q50": [0.5, 0.25]})
    _, _, page = report(load_results(suite, store))
    assert "conditioning_1.png" in [image["src"] for image in page.images]
    rows = [cells for cells in page.cells if cells[:2] == ["Hopper", "PPO reg"]]
    assert rows == [["Hopper", "PPO reg", "4", "0.500", "0.250"]]


def test_arms_have_a_table_and_a_picture(study, tmp_path):
    values = {"PPO": 0.0, "size of delta=0.1": 3.0, "size of delta=2": -4.0}
    results = study(lambda _, name, agent: agent + values[name], algorithms=["PPO"], more=MORE_ARMS)
    write_report(results, tmp_path)
    page = Page((tmp_path / "report.html").read_text())
    assert {"arms.png", "ablation_1.png"} <= {image["src"] for image in page.images}
    rows = {cells[0]: cells[1:4] for cells in page.cells if len(cells) == 9}
    assert rows["size of delta=2"] == ["Hopper", "PPO", "-4.00 [-4.00, -4.00]" + RESTS]
    assert pd.read_csv(tmp_path / "arms.csv")["reward"].tolist() == [3.0, -4.0]


def test_attacked_agents_have_a_table_and_a_picture(study, tmp_path):
    results = study(lambda *_: 1.0, agents=4, final=lambda *_: 1.0)
    attack_all(results)
    write_report(results, tmp_path)
    page = Page((tmp_path / "report.html").read_text())
    assert "robustness.png" in [image["src"] for image in page.images]
    assert "Robustness: final policies under attack" in page.headings
    rows = [cells for cells in page.cells if cells[:3] == ["Hopper", "PPO", "0.1 l∞"]]
    assert [row[4:9] for row in rows] == [["200", "90.0", "20.0", "critic", "10%"]]
    assert pd.read_csv(tmp_path / "robustness.csv")["strongest"].tolist() == ["critic", "mad"]


@pytest.mark.parametrize("runs", [0, 1])
def test_few_runs_make_a_page_without_a_verdict(store, suite, report, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 2.0])
    folder, _, page = report(load_results(suite, store))
    assert {text for _, text in page.verdicts} <= {"undecided"}
    assert {"report.html", "table1.md", "table1.csv", "claims.csv"} <= {
        path.name for path in folder.iterdir()
    }
    for image in page.images:
        assert (folder / unquote(image["src"])).exists()


def test_the_page_says_the_verdicts(written):
    claims, page = written.claims, written.page
    found = {claim.letter: claim.verdict for claim in claims}
    assert found == {"a": "supported", "b": "no effect", "e": "undecided"}
    rows = {cells[0]: cells[1].strip() for cells in page.cells if cells[0].startswith("(")}
    assert set(rows) == {f"({c.letter}) {c.statement}" for c in claims}
    for claim in claims:
        row = rows[f"({claim.letter}) {claim.statement}"]
        assert row.startswith(f"{claim.verdict} {claim.basis}")
        assert all(note in row for note in claim.notes)


def test_only_what_is_supported_looks_so(written):
    """The style sheet colours the classes "supported" and "contradicted"."""
    page = written.page
    coloured = {text: set(name.split()) & {"supported", "contradicted"}
                for name, text in page.verdicts}  # fmt: skip
    plain = {"no effect": set(), "undecided": set()}
    assert coloured == {"supported": {"supported"}, **plain}


def test_the_page_has_every_number_behind_the_verdicts(written):
    claims, page = written.claims, written.page
    rows = [cells for cells in page.cells if len(cells) == 10]
    findings = [f for claim in claims for f in claim.findings]
    shown = [row for row in rows if row[0] != "about"]
    assert [(row[0], row[1], row[4], row[5]) for row in shown] == [
        (f.about, f.task, str(f.estimate.n), str(f.failed)) for f in findings
    ]
    assert [row[9].partition(" (")[0] for row in shown] == [f.verdict for f in findings]
    for column, name in ((6, "detectable"), (7, "p"), (8, "p_holm")):
        told = [getattr(f, name) for f in findings]
        assert [row[column] for row in shown] == [
            "–" if np.isnan(number) else f"{number:.2g}" for number in told
        ]
    assert [float(row[2]) for row in shown] == pytest.approx(
        [f.estimate.mean for f in findings], rel=0.01, abs=1e-12
    )


def test_the_papers_numbers_stand_beside_ours(written):
    page = written.page
    header = next(cells for cells in page.cells if cells[0] == "task")
    assert header == ["task", "PPO", "paper", "PPO reg", "paper"]
    rows = {cells[0]: cells for cells in page.cells if len(cells) == 5}
    assert rows["Hopper"][2::2] == ["106.8", "18.6"]
    assert rows["Ant"][2::2] == ["414.1", "294.8"]
    assert rows["Hopper"][1].startswith("5.5 [")  # agents 0 to 9, and what they learn


def test_the_notes_of_the_table_are_on_the_page(written):
    page = written.page
    assert "The paper has 10 agents for each of 3 seeds." in page.text
    assert "Shorter runs can neither confirm nor refute it." in page.text


def test_final_policies_have_a_table_of_their_own(study, tmp_path):
    results = study(lambda *_: 1.0, final=lambda _, name, agent: len(name) + agent)
    part = write_report(results, tmp_path)
    page = Page((tmp_path / "report.html").read_text())
    assert [s.title for s in part.sections] == [
        "The claims in pictures", "Table 1: training scores, beside the paper's",
        "Table 1: final policies", "Smoothness of the final policies' actions",
        "Conditioning at the end of training",
    ]  # fmt: skip
    assert "Table 1: final policies" in page.headings
    rows = [cells for cells in page.cells if cells[0] == "Hopper" and len(cells) == 3]
    assert rows[0][1].startswith("7.5 [")  # 3 + 0 to 9
    assert pd.read_csv(tmp_path / "table1_final.csv")["mean"].tolist() == [7.5, 11.5]


def test_failed_runs_are_on_the_page_with_the_verdict_without_them(study, tmp_path):
    results = study(
        lambda _, name, agent: 5.0 * agent + (50.0 + agent) * (name == "PPO reg"),
        diverged=lambda _, name, agent: name == "PPO reg" and agent == 0,
    )
    write_report(results, tmp_path)
    page = Page((tmp_path / "report.html").read_text())
    assert "1 failed; without them: supported." in page.text
    assert "; without failed: win" in page.text


HOSTILE = "<script>alert('1')</script>"
HOSTILE_SUITE = f"""
title = "{HOSTILE}"
note = "<b>bold</b> & \\"quoted\\""
seeds = [1]
agents = 1

[args]
total_timesteps = 200
num_steps = 100
num_minibatches = 2

[[algorithms]]
name = "{HOSTILE}"
baseline = "ppo_reg"
args = {{ coefficient = 0.0 }}

[[sweeps]]
name = "<i>sweep"
baseline = "ppo_reg"
parameter = "radius"
values = [2.0]

[figures]
'"><img src=x onerror=alert(1)>' = ["{HOSTILE}"]

[environments]
"<em>Hopper" = "Pendulum-v1"
"""


def test_names_of_a_suite_are_text_and_never_html(tmp_path, store, report):
    (tmp_path / "hostile.toml").write_text(HOSTILE_SUITE)
    suite = load_suite(str(tmp_path / "hostile.toml"))
    for spec in suite.runs:
        write_run(store, spec, [1.0, 2.0])
    _, _, page = report(load_results(suite, store))
    assert not {"script", "b", "i"} & set(page.tags)
    assert all(set(image) == {"src", "alt"} for image in page.images)
    assert "x" not in [image["src"] for image in page.images]
    assert '"><img src=x onerror=alert(1)>' in page.headings
    header = next(cells for cells in page.cells if cells[0] == "task")
    assert header[1] == HOSTILE
    assert '<b>bold</b> & "quoted"' in page.text
    assert "Ablation: <i>sweep" in page.headings
    assert "<em>Hopper" in [cells[0] for cells in page.cells]


def test_claims_as_csv_are_the_findings(written):
    words = {"without_failed": str, "note": str}
    saved = pd.read_csv(written.folder / "claims.csv", dtype=words).fillna(dict.fromkeys(words, ""))
    expected = to_frame(written.claims)
    pd.testing.assert_frame_equal(saved, expected, check_dtype=False, rtol=1e-12)
    assert len(saved) == sum(len(claim.findings) for claim in written.claims)


def test_table_1_as_csv_is_the_cells(written):
    saved = pd.read_csv(written.folder / "table1.csv")
    assert saved["mean"].tolist() == pytest.approx([c.estimate.mean for c in written.cells])
    assert saved["paper"].tolist() == [106.8, 18.6, 414.1, 294.8]


def test_a_second_report_is_the_same_to_the_byte(written, tmp_path):
    write_report(written.results, tmp_path)
    first = {path.name: path.read_bytes() for path in written.folder.iterdir()}
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first


# --- games: Table 2, Figure 4, claim (d) and what an agent does -----------------------------------


def played(*_) -> pd.DataFrame:
    half, none = [[1], [0]], [[0], [0]]
    return make_episodes(
        seen_sampled=half, unseen_sampled=none, seen_greedy=half, unseen_greedy=none
    )


@pytest.fixture
def games(tmp_path):
    """Makes results of agents on CoinRun, or other games."""

    def make(algorithms=("PPO", "PPO reg"), names=("CoinRun",), episodes=played, **more):
        coinrun = dict.fromkeys(names, "coinrun")
        return make_games(tmp_path, episodes, algorithms, coinrun, **more)

    return make


def test_a_page_of_games_has_table_2_and_nothing_of_table_1(games, report):
    folder, claims, page = report(games())
    assert [h for h in page.headings if h.startswith("Table")] == [
        "Table 2: success rate on CoinRun levels, %, beside the paper's"
    ]
    assert [claim.letter for claim in claims] == ["d", "e"]
    assert [image["src"] for image in page.images] == ["figure4.png", "claim_d.png"]
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "report.html", "table2.md", "table2.csv", "claims.csv", "figure4.png", "claim_d.png",
    }  # fmt: skip
    rows = {cells[0]: cells for cells in page.cells if len(cells) == 7}
    assert rows["agent"][1:4] == ["seen", "paper", "unseen"]
    assert rows["PPO reg"][:3] == ["PPO reg", "50.0 [0.0, 100.0] (n 1, 0 failed, finds –)", "60.7"]
    assert rows["PPO"][6] == "0.0 [0.0, 0.0] (n 1, 0 failed, finds –)"
    assert "the velocity painted" in page.text
    assert "What differs from the paper" not in page.headings
    assert len(pd.read_csv(folder / "table2.csv")) == 2 * 4
    assert pd.read_csv(folder / "claims.csv")["claim"].tolist() == ["d", "d", "e"]


def test_a_page_of_control_tasks_has_nothing_of_table_2(written):
    assert not any("Table 2" in heading for heading in written.page.headings)
    assert not any("episodes" in heading for heading in written.page.headings)
    assert not (written.folder / "table2.csv").exists()


def test_a_page_of_both_has_both(games, report, store, suite):
    """As the suites `smoke` and `paper`: runs of several files in one report."""
    some = games()
    write_run(store, suite.runs[0], [1.0, 2.0])
    control = load_results(suite, store)
    both = dataclasses.replace(
        suite,
        runs=[*suite.runs, *some.suite.runs],
        environments=[*suite.environments, *some.suite.environments],
    )
    merged = Results(
        both, control.metrics | some.metrics, [], control.done + some.done, some.evaluations,
        control.folders | some.folders, scores=control.scores | some.scores,
    )  # fmt: skip
    folder, claims, page = report(merged)
    assert [h[:7] for h in page.headings if h.startswith("Table")] == ["Table 1", "Table 2"]
    assert [claim.letter for claim in claims] == ["d", "e"]
    task = next(cells for cells in page.cells if cells[0] == "Hopper")
    assert task[1] == "2.0 (n 1, 0 failed, finds –)"
    assert "CoinRun" not in [cells[0] for cells in page.cells]  # no row of Table 1
    assert (folder / "table1.csv").exists()
    assert (folder / "table2.csv").exists()


def test_a_page_of_games_before_anything_ran(report, store):
    _, claims, page = report(load_results(load_suite("table2"), store))
    assert [claim.verdict for claim in claims] == ["undecided"]
    assert page.images == []
    assert "Not all evaluated yet: PPO, " in page.text


@pytest.mark.parametrize("algorithms", [["PPO"], ["Mine", "Other"]])
def test_agents_without_a_regularized_partner_have_a_table_and_no_claim(games, report, algorithms):
    _, claims, page = report(games(algorithms))
    assert claims == []
    assert page.images == []
    rows = [cells[0] for cells in page.cells if len(cells) == 7]
    assert rows == ["agent", *algorithms]


def test_the_verdict_of_claim_d_is_on_the_page(games, report):
    seeds = range(1, 11)

    def better(game, algorithm, seed):
        won = [[1, int(algorithm.endswith("reg"))]]
        return make_episodes(
            seen_sampled=won, unseen_sampled=won, seen_greedy=[[1]], unseen_greedy=[[1]]
        )

    _, _, page = report(games(episodes=better, updates=UPDATES, seeds=seeds))
    assert [text for _, text in page.verdicts] == ["supported", "supported"]
    rows = [cells for cells in page.cells if len(cells) == 10 and cells[0] != "about"]
    assert [(row[0], row[2], row[3], row[4]) for row in rows] == [
        ("reg - plain: success, seen levels", "0.5", "0.5 to 0.5", "10"),
        ("reg - plain: success, unseen levels", "0.5", "0.5 to 0.5", "10"),
        ("reg / plain - 1: time for a step, CoinRun, single file", "0", "0 to 0", "10"),
    ]


def test_each_agents_first_recorded_episodes_are_shown(games, report):
    results = games(seeds=(1, 2), gifs=True)
    folder, _, page = report(results)
    shown = [image for image in page.images if image["src"].endswith(".gif")]
    assert [image["alt"] for image in shown] == [
        "PPO on a seen level", "PPO on an unseen level",
        "PPO reg on a seen level", "PPO reg on an unseen level",
    ]  # fmt: skip
    for image in shown:
        assert not Path(image["src"]).is_absolute()
        assert (folder / image["src"]).read_bytes() == b"GIF89a"
        assert "s1__a0" in image["src"]


def test_an_agent_with_one_episode_of_two_is_not_shown(games, report):
    results = games(gifs=True)
    first = results.suite.runs[0]
    (results.folders[first.run_id] / "unseen.gif").unlink()
    _, _, page = report(results)
    assert {image["alt"][:7] for image in page.images if ".gif" in image["src"]} == {"PPO reg"}


def test_names_of_games_and_their_agents_are_text_and_never_html(games, report):
    agents = ["<script>x</script>", "<script>x</script> reg"]
    folder, _, page = report(games(agents, ["<em>Coin", "Maze"], gifs=True))
    assert "script" not in page.tags
    assert all(set(image) == {"src", "alt"} for image in page.images)
    rows = [cells[0] for cells in page.cells if len(cells) == 7]
    assert rows[1:3] == [f"<em>Coin: {agent}" for agent in agents]
    assert "<em>Coin: <script>x</script>" in [cells[1] for cells in page.cells if len(cells) == 10]
    assert "<script>x</script>: a seen level, an unseen level" in page.text
    for image in page.images:
        assert (folder / unquote(image["src"])).exists()


def test_a_third_kind_of_levels_has_its_episode(store, report):
    suite = load_suite("themes", seeds=1)
    run = suite.runs[0]
    found = [played(), make_episodes(themes_sampled=[[1], [0]], themes_greedy=[[1], [0]])]
    write_run(store, run, [1.0], episodes=pd.concat(found))
    for split in ("seen", "unseen", "themes"):
        store.path(run, f"{split}.gif").write_bytes(b"GIF89a")
    _, _, page = report(load_results(suite, store))
    shown = [Path(image["src"]).name for image in page.images if image["src"].endswith(".gif")]
    assert shown == ["seen.gif", "unseen.gif", "themes.gif"]
    assert f"{run.algorithm} on that level in other themes" in [x["alt"] for x in page.images]


# --- what the numbers come from -------------------------------------------------------------------


def test_the_page_says_what_made_its_numbers(store, suite, report):
    for spec in suite.runs[:2]:
        write_run(store, spec, [1.0])
    results = load_results(suite, store)
    for number, spec in enumerate(results.specs.values()):
        session = spec["sessions"][-1]
        session.update(commit=f"{number}" * 40, clean=True, processor="Abacus", cores=3)
    _, _, page = report(results)
    rows = {cells[0]: cells[1] for cells in page.cells if len(cells) == 2}
    assert rows["commits"] == "0000000000 (1), 1111111111 (1)"
    assert rows["implementations"] == "single file (2)"
    assert rows["machines"] == "Abacus, 3 cores (2)"
    assert rows["baselines and their versions"].startswith("ppo_reg ")
    assert {"Python", "PyTorch", "NumPy", "Gymnasium"} <= set(rows)
    assert "The runs mix commits: 0000000000 (1), 1111111111 (1)." in page.text
    assert "Before you trust a comparison" in page.text


def test_a_page_whose_runs_share_their_origin_has_no_warning(store, suite, report):
    for spec in suite.runs[:2]:
        write_run(store, spec, [1.0])
    results = load_results(suite, store)
    for spec in results.specs.values():
        spec["sessions"][-1]["clean"] = True
    _, _, page = report(results)
    assert "Before you trust a comparison" not in page.text


def test_runs_that_diverged_are_named_with_update_and_what(store, suite, report):
    write_run(store, suite.runs[0], [1.0, 2.0], diverged=True)
    _, _, page = report(load_results(suite, store))
    assert "ppo__Hopper__s1__a0: loss at update 2: loss is NaN" in page.text


# --- one agent, and several suites ----------------------------------------------------------------


@pytest.fixture
def single(store, suite_file):
    """Results of one agent a setting."""
    suite = load_suite(str(suite_file), seeds=1, agents=1)
    suite = dataclasses.replace(suite, name="single", title="Single agents")
    for spec in suite.runs:
        write_run(store, spec, [1.0, 2.0])
    return load_results(suite, store)


def test_single_agents_are_not_judged(single, report):
    folder, claims, page = report(single)
    assert claims == []
    assert page.verdicts == []
    assert "One agent a setting: nothing to judge." in page.text
    assert not list(folder.glob("claim_*.png"))
    assert not (folder / "scores.png").exists()
    assert (folder / "claims.csv").exists()


def test_a_page_of_several_suites_has_a_part_for_each_in_order(written, single, store, tmp_path):
    folders = [tmp_path / name for name in ("judged", "single")]
    for folder in folders:
        folder.mkdir()
    parts = [
        write_report(results, folder)
        for results, folder in zip((written.results, single), folders, strict=True)
    ]
    together = tmp_path / "together"
    together.mkdir()
    write_page(parts, together / "report.html")
    page = Page((together / "report.html").read_text())
    text = page.text.partition("How this differs from the paper")[0]
    order = ["supported at 0.08%", "Table 1", "Single agents", "nothing to judge"]
    places = [text.index(what) for what in order]
    assert places == sorted(places)
    assert len(text) < len(page.text)
    sources = [Path(unquote(image["src"])) for image in page.images]
    assert {source.parts[:2] for source in sources} == {("..", "judged"), ("..", "single")}
    assert all((together / source).exists() for source in sources)
