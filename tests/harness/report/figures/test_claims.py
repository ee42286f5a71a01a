"""Figures behind the claims: what is in each, for one run and many."""

from __future__ import annotations

import matplotlib.image
import numpy as np

from harness.report.claims import Claim, Finding, agent_table, make_claims
from harness.report.figures import claims as figures
from harness.report.figures.style import COLORS
from harness.report.results import load_results
from harness.statistics import Estimate
from tests.harness.conftest import write_run

TASKS = ("Hopper", "Ant", "Reacher", "Walker2D", "Humanoid")


def shown(figure) -> dict[str, object]:
    """The visible panels, by title."""
    return {axis.get_title(): axis for axis in figure.axes if axis.get_visible()}


def is_picture(path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and matplotlib.image.imread(path).std() > 0.01


def points(axis) -> np.ndarray:
    """All points of the panel's scatters, in order."""
    return np.concatenate([np.empty((0, 2)), *(c.get_offsets() for c in axis.collections)])


# --- psi and reward -------------------------------------------------------------------------------


def test_agents_are_dots_and_the_means_of_their_settings_diamonds(study, drawn, tmp_path):
    results = study(
        lambda task, _, agent: 10.0 * TASKS.index(task) + agent,
        lambda task, _, agent: 12.0 - agent,
        algorithms=["PPO", "PPO reg", "TRPO"], tasks=TASKS, agents=4, updates=2,
    )  # fmt: skip
    assert figures.psi_and_reward(agent_table(results), tmp_path / "figure.png")
    assert is_picture(tmp_path / "figure.png")
    panels = shown(drawn())
    assert list(panels) == list(TASKS)
    for i, axis in enumerate(panels.values()):
        once = [[12.0 - agent, 10.0 * i + agent] for agent in range(4)]
        mean = [[10.5, 10.0 * i + 1.5]]
        np.testing.assert_allclose(points(axis), (once + mean) * 2)  # of PPO, then of TRPO
        assert axis.get_xlabel() == "psi, late"
    assert [t.get_text() for t in drawn().legends[0].get_texts()] == ["PPO", "TRPO"]


def test_one_agent_is_its_settings_mean(store, suite, drawn, tmp_path):
    write_run(store, suite.runs[0], [1.0, 3.0], [2.0, 4.0])
    agents = agent_table(load_results(suite, store))
    figures.psi_and_reward(agents, tmp_path / "figure.png")
    found = {task: points(axis).tolist() for task, axis in shown(drawn()).items()}
    assert found == {"Hopper": [[4.0, 3.0]] * 2}


def test_without_agents_there_is_no_picture(store, suite, tmp_path):
    agents = agent_table(load_results(suite, store))
    assert not figures.psi_and_reward(agents, tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()


def test_no_algorithm_is_left_without_points_for_want_of_colours(study, drawn, tmp_path):
    agents = agent_table(study(lambda *_: 1.0, algorithms=["PPO"], agents=2, updates=2))
    many = 2 * len(COLORS) + 1
    agents = agents.loc[agents.index.repeat(many)]
    agents["algorithm"] = [f"PPO {i}" for i in range(many)] * 2
    figures.psi_and_reward(agents, tmp_path / "figure.png")
    (axis,) = shown(drawn()).values()
    assert len(points(axis)) == len(agents) + many


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


def test_kinds_of_one_number_each_share_a_panel(drawn, tmp_path):
    names = ("PPO reg - PPO", "TRPO reg - TRPO")
    found = [
        Finding(f"{name}: probability of improvement", "all", Estimate(0.6, 0.4, 0.8, 22), "win")
        for name in names
    ]
    found.append(Finding("reg - plain: success", "PPO-l2", Estimate(0.1, 0.0, 0.2, 1), "win"))
    figures.findings(Claim("b", "It wins.", "undecided", found), tmp_path / "figure.png")
    panels = shown(drawn())
    labels = {k: [y.get_text() for y in a.get_yticklabels()] for k, a in panels.items()}
    assert labels == {"probability of improvement": list(reversed(names)),
                      "reg - plain: success": ["PPO-l2"]}  # fmt: skip


def test_the_findings_of_every_claim_are_drawn(store, suite, drawn, tmp_path):
    for spec in suite.runs:
        write_run(store, spec, [1.0, 5.0, 2.0 + spec.args["agent"]], [3.0, 2.0, 1.0])
    claims = make_claims(load_results(suite, store))
    assert [c.letter for c in claims] == ["a", "b"]
    for claim in claims:
        figures.findings(claim, tmp_path / f"{claim.letter}.png")
        assert is_picture(tmp_path / f"{claim.letter}.png")
        comparable = [f for f in claim.findings if not f.about.endswith(": reward")]
        panels = shown(drawn()).values()
        dots = sum(x.get_marker() == "o" for panel in panels for x in panel.get_lines())
        assert dots == len(comparable)
