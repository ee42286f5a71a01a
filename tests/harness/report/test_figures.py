"""Learning curves: what is drawn, and that a picture comes out."""

from __future__ import annotations

import matplotlib.image
import pytest

from harness.report.figures import agent_curves, learning_curves
from tests.harness.conftest import write_run


def test_curves_are_a_column_for_each_agent(store, suite):
    for spec in suite.runs:
        write_run(store, spec, [1.0 * spec.args["agent"], 2.0])
    curves = agent_curves(suite, store, "Hopper", "PPO", "charts/episodic_return")
    assert curves.index.tolist() == [100, 200]
    assert curves.loc[100].tolist() == [0.0, 1.0, 0.0, 1.0]


@pytest.mark.parametrize("runs", [0, 1, 16])
def test_a_picture_is_written_for_any_number_of_runs(store, suite, tmp_path, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 5.0, 2.0])
    path = tmp_path / "curves.png"
    learning_curves(suite, store, path)
    picture = matplotlib.image.imread(path)
    assert picture.shape[0] > 300
    assert picture.shape[1] > 500
    assert picture.std() > 0.01
