"""Return against the radius of the strongest attack."""

from __future__ import annotations

import numpy as np
import pytest

from harness.report.figures.robustness import return_against_radius
from harness.report.tables.robustness import robustness_frame
from tests.harness.report.tables.test_robustness import attack_all


@pytest.fixture
def results(study):
    return study(lambda *_: 1.0, agents=4, final=lambda *_: 1.0)


def test_dots_are_agents_and_lines_their_medians(results, drawn, tmp_path):
    attack_all(results)
    assert return_against_radius(results, robustness_frame(results), tmp_path / "figure.png")
    (axis,) = drawn().axes
    assert axis.get_title() == "Hopper (l∞)"
    dots, line, other_dots, other = axis.get_lines()
    assert sorted(dots.get_ydata()) == [10, 20, 30, 50, 100, 200, 300, 400]
    assert line.get_ydata().tolist() == [250, 25]
    assert other.get_ydata().tolist() == [-1, -6.5]
    assert line.get_label() == "PPO"
    assert other.get_label() == "PPO reg"
    assert line.get_color() != other.get_color()
    assert line.get_xdata()[0] < 0 < other.get_xdata()[0]  # side by side
    np.testing.assert_allclose(other_dots.get_xdata()[:2], other.get_xdata())
    assert [text.get_text() for text in axis.get_xticklabels()] == ["0", "0.1"]


def test_norms_have_panels_of_their_own(results, drawn, tmp_path):
    attack_all(results, "l2")
    assert return_against_radius(results, robustness_frame(results), tmp_path / "figure.png")
    assert [axis.get_title() for axis in drawn().axes] == ["Hopper (l2)"]


def test_without_attacks_there_is_no_picture(results, tmp_path):
    assert not return_against_radius(results, robustness_frame(results), tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()
