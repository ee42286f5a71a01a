"""Learning curves: that a picture comes out, with what belongs in it."""

from __future__ import annotations

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest

from harness.report import figures
from harness.report.figures import learning_curves
from harness.report.results import load_results
from tests.harness.conftest import write_run


@pytest.mark.parametrize("runs", [0, 1, 16])
def test_a_picture_is_written_for_any_number_of_runs(store, suite, tmp_path, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 5.0, 2.0])
    path = tmp_path / "curves.png"
    learning_curves(load_results(suite, store), suite.algorithms, path)
    picture = matplotlib.image.imread(path)
    assert picture.shape[0] > 300
    assert picture.shape[1] > 500
    assert picture.std() > 0.01


def test_the_legend_names_what_any_panel_shows(store, suite, tmp_path, monkeypatch):
    monkeypatch.setattr(plt, "close", lambda figure: None)
    only = [spec for spec in suite.runs if spec.environment == "Reacher"]
    for spec in only:
        write_run(store, spec, [1.0, 2.0])
    learning_curves(load_results(suite, store), suite.algorithms, tmp_path / "curves.png")
    figure = plt.gcf()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["PPO", "PPO reg"]
    titles = [axis.get_title() for axis in figure.axes if axis.get_visible()]
    assert titles == ["Reacher", ""]
    plt.close("all")


def test_a_long_curve_is_drawn_by_means_of_neighbours(store, suite, tmp_path, monkeypatch):
    monkeypatch.setattr(plt, "close", lambda figure: None)
    monkeypatch.setattr(figures, "POINTS", 3)
    write_run(store, suite.runs[0], [0.0, 2.0, 4.0, 6.0, 10.0])
    learning_curves(load_results(suite, store), ["PPO"], tmp_path / "curves.png")
    (line,) = plt.gcf().axes[0].get_lines()
    np.testing.assert_allclose(line.get_xdata(), [200, 400, 500])
    np.testing.assert_allclose(line.get_ydata(), [1.0, 5.0, 10.0])
    plt.close("all")
