"""Figures behind the claims: what is in each, for no runs, one run and many."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pytest
from scipy import stats

from harness.report import study as figures
from harness.report.claims import Claim, Finding, agent_table, make_claims
from harness.report.figures import COLORS, learning_curves
from harness.report.results import load_results
from harness.statistics import Estimate, estimate_mean
from harness.suite import load_suite
from tests.harness.conftest import write_run

TASKS = ("Hopper", "Ant", "Reacher", "Walker2D", "Humanoid")
QUOTIENT, SINGULAR, SQUARED = (
    f"conditioning/{name}"
    for name in ("quotient_q50", "singular_value_mean", "squared_singular_value")
)
SWEEP = """
[[sweeps]]
name = "size of delta"
baseline = "ppo_reg"
parameter = "radius"
values = [0.1, 2, 5]
"""


def shown(figure) -> dict[str, object]:
    """The visible panels, by title."""
    return {axis.get_title(): axis for axis in figure.axes if axis.get_visible()}


def is_picture(path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and matplotlib.image.imread(path).std() > 0.01


def points(axis) -> np.ndarray:
    """All points of the panel's scatters, in order."""
    return np.concatenate([np.empty((0, 2)), *(c.get_offsets() for c in axis.collections)])


# --- psi and reward -------------------------------------------------------------------------------


def test_an_agent_is_a_point_in_the_panel_of_its_task(study, drawn, tmp_path):
    results = study(
        lambda task, _, agent: 10.0 * TASKS.index(task) + agent,
        lambda task, _, agent: 12.0 - agent,
        algorithms=["PPO", "PPO reg", "TRPO"], tasks=TASKS, agents=4, updates=2,
    )  # fmt: skip
    figures.psi_and_reward(agent_table(results), tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    panels = shown(drawn())
    assert list(panels) == list(TASKS)
    for i, axis in enumerate(panels.values()):
        once = [[12.0 - agent, 10.0 * i + agent] for agent in range(4)]
        np.testing.assert_allclose(points(axis), once * 2)  # of PPO, then of TRPO
        assert axis.get_xlabel() == "final psi"
    assert [t.get_text() for t in drawn().legends[0].get_texts()] == ["PPO", "TRPO"]


@pytest.mark.parametrize("runs", [0, 1])
def test_few_agents_make_a_picture_too(store, suite, drawn, tmp_path, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 3.0], [2.0, 4.0])
    agents = agent_table(load_results(suite, store))
    figures.psi_and_reward(agents, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 500
    found = {task: points(axis).tolist() for task, axis in shown(drawn()).items()}
    assert found == ({"Hopper": [[4.0, 3.0]]} if runs else {})


def test_no_algorithm_is_left_without_points_for_want_of_colours(study, drawn, tmp_path):
    agents = agent_table(study(lambda *_: 1.0, algorithms=["PPO"], agents=2, updates=2))
    many = 2 * len(COLORS) + 1
    agents = agents.loc[agents.index.repeat(many)]
    agents["algorithm"] = [f"PPO {i}" for i in range(many)] * 2
    figures.psi_and_reward(agents, tmp_path / "figure.png")
    (axis,) = shown(drawn()).values()
    assert len(points(axis)) == len(agents)


def test_no_curve_is_left_out_for_want_of_colours(store, suite_file, drawn, tmp_path):
    many = len(COLORS) + 1
    values = list(range(1, many + 1))
    text = SWEEP.replace("[0.1, 2, 5]", str(values)) + "\n[environments]"
    suite_file.write_text(suite_file.read_text().replace("\n[environments]", text))
    suite = load_suite(str(suite_file))
    names = list(suite.sweeps["size of delta"].values())
    for spec in suite.runs:
        if spec.algorithm in names and spec.args["agent"] == 0:
            write_run(store, spec, [1.0, 2.0])
    learning_curves(load_results(suite, store), names, tmp_path / "figure.png")
    assert len(drawn().axes[0].get_lines()) == many


# --- findings -------------------------------------------------------------------------------------


def test_a_finding_is_a_point_with_its_interval(drawn, tmp_path):
    found = [
        Finding("reward", "Hopper", Estimate(2.0, 1.0, 3.0, 10), "win"),
        Finding("reward", "Ant", Estimate(-2.0, -3.0, -1.0, 11), "loss"),
        Finding("reward", "Reacher", Estimate(0.5, np.nan, np.nan, 1), "undecided"),
        Finding("probability of improvement", "all", Estimate(0.6, 0.4, 0.8, 22), "reported"),
    ]
    figures.findings(Claim("b", "It wins.", "undecided", found), tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    panels = shown(drawn())
    assert list(panels) == ["reward", "probability of improvement"]
    axis = panels["reward"]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["Reacher", "Ant", "Hopper"]
    dots = {line.get_ydata()[0]: line for line in axis.get_lines() if line.get_marker() == "o"}
    assert [dots[y].get_xdata()[0] for y in (0, 1, 2)] == [0.5, -2.0, 2.0]
    assert [dots[y].get_color() for y in (0, 1, 2)] == ["gray", COLORS[1], COLORS[2]]
    spans = [list(x.get_xdata()) for x in axis.get_lines() if x.get_linewidth() == 2]
    assert spans == [[-3.0, -1.0], [1.0, 3.0]]
    assert [text.get_text().strip() for text in axis.texts] == ["n=1", "n=11", "n=10"]
    none = {name: panel.get_lines()[-1].get_xdata()[0] for name, panel in panels.items()}
    assert none == {"reward": 0, "probability of improvement": 0.5}


@pytest.mark.parametrize("runs", [0, 1, 16])
def test_the_findings_of_every_claim_are_drawn(store, suite, drawn, tmp_path, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 5.0, 2.0 + spec.args["agent"]], [3.0, 2.0, 1.0])
    claims = make_claims(load_results(suite, store))
    assert [c.letter for c in claims] == (["a", "b"] if runs == 16 else [])
    for claim in claims:
        figures.findings(claim, tmp_path / f"{claim.letter}.png")
        assert is_picture(tmp_path / f"{claim.letter}.png")
        panels = shown(drawn())
        comparable = [f for f in claim.findings if not f.about.endswith(": reward")]
        assert set(panels) == {f.about for f in comparable}
        dots = sum(x.get_marker() == "o" for panel in panels.values() for x in panel.get_lines())
        assert dots == len(comparable)


# --- J and the spectrum ---------------------------------------------------------------------------


def spectrum(exact: list[float], quotient: list[float]) -> dict[str, list[float]]:
    return {QUOTIENT: quotient, SINGULAR: exact, SQUARED: [x**2 for x in exact]}


def test_a_measurement_of_the_spectrum_is_a_point(store, suite, drawn, tmp_path):
    exact, quotient = [1.0, np.nan, 3.0, 4.0], [0.5, 9.0, 2.0, 1.5]
    for spec in suite.runs[:2]:  # two agents on Hopper, measured every other update or so
        write_run(store, spec, [1.0] * 4, columns=spectrum(exact, quotient))
    assert figures.quotient_and_spectrum(load_results(suite, store), tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    ((title, axis),) = shown(drawn()).items()
    once = [[1.0, 0.5], [3.0, 2.0], [4.0, 1.5]]
    np.testing.assert_allclose(points(axis), once * 2)
    np.testing.assert_allclose(axis.collections[0].get_array(), [100, 300, 400] * 2)  # steps
    rank = stats.spearmanr(*np.array(once * 2).T).statistic
    assert title == f"Hopper: rank correlation {rank:.2f}"


def test_the_line_of_equality_is_drawn(store, suite, drawn, tmp_path):
    write_run(store, suite.runs[0], [1.0], columns=spectrum([2.0], [5.0]))
    assert figures.quotient_and_spectrum(load_results(suite, store), tmp_path / "figure.png")
    (axis,) = shown(drawn()).values()
    np.testing.assert_allclose(axis.get_lines()[0].get_xydata(), [[0, 0], [5, 5]])


def test_each_task_with_a_spectrum_has_a_panel(store, suite, drawn, tmp_path):
    for spec in suite.runs:
        columns = spectrum([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]) if spec.algorithm == "PPO" else None
        write_run(store, spec, [1.0] * 3, columns=columns)
    figures.quotient_and_spectrum(load_results(suite, store), tmp_path / "figure.png")
    titles = [f"{task}: rank correlation 1.00" for task in ("Hopper", "Reacher")]
    assert list(shown(drawn())) == titles


@pytest.mark.parametrize("columns", [None, spectrum([np.nan, np.nan], [1.0, 2.0])])
@pytest.mark.parametrize("runs", [0, 1, 16])
def test_without_a_spectrum_there_is_no_figure(store, suite, tmp_path, columns, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 2.0], columns=columns)
    path = tmp_path / "figure.png"
    assert not figures.quotient_and_spectrum(load_results(suite, store), path)
    assert not path.exists()


# --- sweeps ---------------------------------------------------------------------------------------


def swept(study, **kwargs):
    """PPO, and three values of the radius: reward is 10 times the value, psi its inverse."""
    values = {"PPO": 1.0, **{f"size of delta={x}": x for x in (0.1, 2, 5)}}
    return study(
        lambda _, algorithm, agent: 10.0 * values[algorithm] + agent,
        lambda _, algorithm, __: 1.0 / values[algorithm],
        algorithms=["PPO"], tasks=("Hopper", "Ant"), more=SWEEP, updates=2, **kwargs,
    )  # fmt: skip


def test_a_value_of_a_sweep_is_a_point_with_its_interval(study, drawn, tmp_path):
    results = swept(study, agents=6)
    figures.sweep(results, agent_table(results), "size of delta", tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    axes = np.array(drawn().axes).reshape(2, 2)  # [measure, task]
    assert [axis.get_title() for axis in axes[0]] == ["Hopper", "Ant"]
    for axis, expected in zip(axes[:, 1], ([3.5, 22.5, 52.5], [10.0, 0.5, 0.2]), strict=True):
        labels = [label.get_text() for label in axis.get_xticklabels()]
        assert labels == ["0.1", "2", "5"]
        dots = [line for line in axis.get_lines() if line.get_marker() == "o"]
        assert [line.get_xdata()[0] for line in dots] == [0, 1, 2]
        np.testing.assert_allclose([line.get_ydata()[0] for line in dots], expected)
    spans = [line for line in axes[0, 1].get_lines() if line.get_linewidth() == 2]
    _, low, high, _ = estimate_mean(np.arange(6) + 20.0)
    np.testing.assert_allclose(spans[1].get_xydata(), [[1, low], [1, high]])
    plain = [line.get_ydata()[0] for line in axes[0, 1].get_lines() if line.get_linestyle() == "--"]
    assert plain == [12.5]
    assert [t.get_text() for t in drawn().legends[0].get_texts()] == ["PPO"]


def test_a_sweep_of_one_run_has_one_point(study, store, drawn, tmp_path):
    results = swept(study, agents=2)
    only = "size-of-delta-2__Ant__s1__a0"
    few = load_results(results.suite, store)
    few.metrics.clear()
    few.metrics[only] = results.metrics[only]
    figures.sweep(few, agent_table(few), "size of delta", tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    dots = {
        i: [(x.get_xdata()[0], x.get_ydata()[0]) for x in axis.get_lines() if x.get_marker() == "o"]
        for i, axis in enumerate(drawn().axes)
    }
    assert dots == {0: [], 1: [(1, 20.0)], 2: [], 3: [(1, 0.5)]}
    assert not drawn().legends  # no PPO has run


def test_a_sweep_without_runs_is_a_picture_too(study, drawn, tmp_path):
    results = swept(study, agents=2)
    results.metrics.clear()
    figures.sweep(results, agent_table(results), "size of delta", tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    assert not [x for axis in drawn().axes for x in axis.get_lines() if x.get_marker() == "o"]
    assert len(drawn().axes) == 4
