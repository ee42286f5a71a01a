"""Mean J² against the Jacobian's exact squares."""

from __future__ import annotations

import numpy as np
import pytest

from harness.report.figures.jacobian import EXACT, SQUARED, squares
from harness.report.results import load_results
from tests.harness.conftest import write_run


def test_a_measurement_is_a_point_and_the_line_is_equality(store, suite, drawn, tmp_path):
    columns = {EXACT: [1.0, np.nan, 4.0, 10.0], SQUARED: [0.5, 9.0, 3.0, 8.0]}
    for spec in suite.runs[:2]:  # two agents on Hopper, measured now and then
        write_run(store, spec, [1.0] * 4, columns=columns)
    assert squares(load_results(suite, store), tmp_path / "figure.png")
    (axis,) = drawn().axes
    once = [[1.0, 0.5], [4.0, 3.0], [10.0, 8.0]]
    np.testing.assert_allclose(axis.collections[0].get_offsets(), once * 2)
    np.testing.assert_allclose(axis.collections[0].get_array(), [100, 300, 400] * 2)  # steps
    np.testing.assert_allclose(axis.get_lines()[0].get_xydata(), [[0.5, 0.5], [10.0, 10.0]])
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert axis.get_title() == "Hopper: median ratio 0.75"


def test_zeros_have_no_logarithm_and_no_point(store, suite, drawn, tmp_path):
    columns = {EXACT: [0.0, 2.0], SQUARED: [1.0, 2.0]}
    write_run(store, suite.runs[0], [1.0] * 2, columns=columns)
    assert squares(load_results(suite, store), tmp_path / "figure.png")
    assert len(drawn().axes[0].collections[0].get_offsets()) == 1


@pytest.mark.parametrize("columns", [None, {EXACT: [np.nan] * 2, SQUARED: [1.0, 2.0]}])
@pytest.mark.parametrize("runs", [0, 1])
def test_without_a_spectrum_there_is_no_picture(store, suite, tmp_path, columns, runs):
    for spec in suite.runs[:runs]:
        write_run(store, spec, [1.0, 2.0], columns=columns)
    assert not squares(load_results(suite, store), tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()
