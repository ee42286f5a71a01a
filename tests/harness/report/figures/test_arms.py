"""Figures of ablations: every agent, the means, and PPO beside them."""

from __future__ import annotations

import numpy as np

from harness.report.claims import agent_table
from harness.report.figures.arms import draw_arms, sweep
from harness.report.tables.arms import Arm
from harness.statistics import Estimate, estimate_mean

SWEEP = """
[[sweeps]]
name = "size of delta"
baseline = "ppo_reg"
parameter = "radius"
values = [0.1, 2, 5]
"""


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
    assert sweep(results, agent_table(results), "size of delta", tmp_path / "figure.png")
    axes = np.array(drawn().axes).reshape(2, 2)  # [measure, task]
    assert [axis.get_title() for axis in axes[0]] == ["Hopper", "Ant"]
    for axis, expected in zip(axes[:, 1], ([3.5, 22.5, 52.5], [10.0, 0.5, 0.2]), strict=True):
        bars = [line for line in axis.get_lines() if line.get_linewidth() == 2]
        np.testing.assert_allclose([line.get_xdata().mean() for line in bars], [0, 1, 2])
        np.testing.assert_allclose([line.get_ydata()[0] for line in bars], expected)
    assert [label.get_text() for label in axes[1, 1].get_xticklabels()] == ["0.1", "2", "5"]
    dots = [line.get_ydata() for line in axes[0, 1].get_lines() if line.get_marker() == "o"]
    np.testing.assert_allclose(np.sort(dots[1]), np.arange(6) + 20.0)
    spans = [line for line in axes[0, 1].get_lines() if line.get_color() == "black"]
    _, low, high, _ = estimate_mean(np.arange(6) + 20.0)
    np.testing.assert_allclose(spans[1].get_xydata(), [[1, low], [1, high]])
    plain = [line.get_ydata()[0] for line in axes[0, 1].get_lines() if line.get_linestyle() == "--"]
    assert plain == [12.5]
    assert [t.get_text() for t in drawn().legends[0].get_texts()] == ["PPO"]


def test_a_sweep_without_runs_is_no_picture(study, tmp_path):
    results = swept(study, agents=2)
    results.metrics.clear()
    path = tmp_path / "figure.png"
    assert not sweep(results, agent_table(results), "size of delta", path)
    assert not path.exists()


def test_only_tasks_that_have_run_are_swept(study, drawn, tmp_path):
    results = swept(study, agents=2)
    for run_id in [name for name in results.metrics if "Hopper" in name]:
        del results.metrics[run_id]
    sweep(results, agent_table(results), "size of delta", tmp_path / "figure.png")
    assert [axis.get_title() for axis in drawn().axes] == ["Ant", ""]


def test_an_arm_is_two_differences_and_a_psi(drawn, tmp_path):
    nothing = Estimate(np.nan, np.nan, np.nan, 0)
    arms = [
        Arm("Hopper", "printed sign", "PPO", Estimate(-3.0, -5.0, -1.0, 10),
            Estimate(2.0, 1.0, 4.0, 10), 3.0, 0, Estimate(0.5, 0.4, 0.6, 10), 0.9, 0.3, 0.5),
        Arm("Hopper", "per batch", "PPO", Estimate(1.0, np.nan, np.nan, 2), nothing, np.nan, 0,
            Estimate(0.2, np.nan, np.nan, 2), 0.8, 0.1, 0.2),
    ]  # fmt: skip
    draw_arms(arms, tmp_path / "figure.png")
    top, bottom = drawn().axes
    labels = [label.get_text() for label in top.get_yticklabels()]
    assert labels == ["printed sign", "per batch"]
    assert list(top.get_yticks()) == [1, 0]
    dots = [tuple(x.get_xydata()[0]) for x in top.get_lines() if x.get_marker() == "o"]
    assert dots == [(-3.0, 1.15), (2.0, 0.85), (1.0, 0.15)]
    spans = [list(x.get_xdata()) for x in top.get_lines() if x.get_linewidth() == 1.8]
    assert spans == [[-5.0, -1.0], [1.0, 4.0]]
    psis = [x.get_xdata()[0] for x in bottom.get_lines() if x.get_marker() == "o"]
    assert psis == [0.5, 0.2]
    plain = [x.get_xdata()[0] for x in bottom.get_lines() if x.get_marker() == "|"]
    assert plain == [0.9, 0.8]
    names = [text.get_text() for text in drawn().legends[0].get_texts()]
    assert names == ["training score", "final policy", "psi by the yardstick", "psi, plain"]
