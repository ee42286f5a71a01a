"""Curves against environment steps, a column of panels for each task."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from harness.report.figures.style import COLUMNS, colors_of, plain_logarithm, save, tidy, width_of
from harness.report.results import Results
from harness.statistics import interval_of_means

POINTS = 100  # of a curve, at most
FEW = 20  # points up to which each is marked


class Measure(NamedTuple):
    """A row of panels: the columns that it draws, each in a style of line."""

    label: str
    columns: dict[str, str]
    """the line's style by column of the metrics"""
    log: bool = False
    """a logarithmic axis, on which zeros are left out"""
    marks: tuple[float, ...] = ()
    """values that have a thin line of their own"""


LEARNING = (
    Measure("reward", {"charts/episodic_return": "-"}),
    Measure("psi", {"conditioning/psi": "-"}),
)
CONDITIONING = (
    Measure(
        "J: median, 5% and 95%",
        {
            "conditioning/quotient_q50": "-",
            "conditioning/quotient_q05": ":",
            "conditioning/quotient_q95": ":",
        },
        log=True,
        marks=(1.0, 20.0),
    ),
    Measure("median J, executed", {"conditioning/quotient_executed": "-"}, log=True, marks=(1.0,)),
    Measure(
        "states below 1,\nabove 20 (dashes)",
        {"conditioning/fraction_below": "-", "conditioning/fraction_above": "--"},
    ),
    Measure("gradient share", {"conditioning/gradient_share": "-"}, log=True),
)


def draw_measures(
    results: Results, algorithms: list[str], measures: tuple[Measure, ...], path: Path
) -> bool:
    """Mean over agents with its 95% interval, as a PNG; returns whether there was any to draw.

    A column for each task that the suite plans for all of these algorithms, and a row for each
    measure, as far as any run has logged it there.
    """
    planned = results.suite.planned
    curves = {
        (task, measure.label): found
        for task in results.suite.environments
        if all((task, algorithm) in planned for algorithm in algorithms)
        for measure in measures
        if (found := _curves(results, task, algorithms, measure))
    }
    tasks = list(dict.fromkeys(task for task, _ in curves))
    rows = [
        measure for measure in measures if any((task, measure.label) in curves for task in tasks)
    ]
    if not tasks:
        return False

    columns = min(COLUMNS, len(tasks))
    blocks = -(-len(tasks) // columns)
    figure, axes = plt.subplots(
        len(rows) * blocks, columns, figsize=(width_of(columns), 2.1 * len(rows) * blocks),
        squeeze=False, sharex=True, layout="constrained",
    )  # fmt: skip
    for axis in axes.flat:
        axis.set_visible(False)
    for i, task in enumerate(tasks):
        block, column = divmod(i, columns)
        own = [row for row in rows if (task, row.label) in curves]
        for measure in own:
            axis = axes[len(rows) * block + rows.index(measure), column]
            axis.set_visible(True)
            _draw_panel(axis, measure, curves[task, measure.label], algorithms)
            axis.set_ylabel(measure.label if column == 0 else "")
            axis.set_title(task if measure == own[0] else "", fontsize=11)
            last = measure == own[-1] and i + columns >= len(tasks)
            axis.set_xlabel("environment steps" if last else "")
            axis.tick_params(labelbottom=True)
    save(figure, path)
    return True


def _curves(
    results: Results, task: str, algorithms: list[str], measure: Measure
) -> dict[tuple[str, str], pd.DataFrame]:
    """What there is to draw in a panel, by algorithm and column."""
    found = {}
    for algorithm in algorithms:
        for column in measure.columns:
            curves = results.curves(task, algorithm, column)
            curves = curves.where(curves > 0) if measure.log else curves
            curves = curves.dropna(how="all")
            if len(curves):
                found[algorithm, column] = curves
    return found


def _draw_panel(
    axis: Axes,
    measure: Measure,
    curves: dict[tuple[str, str], pd.DataFrame],
    algorithms: list[str],
) -> None:
    tidy(axis)
    colors = colors_of(algorithms)
    for (algorithm, column), found in curves.items():
        first = next(iter(measure.columns))  # the others share its entry of the legend
        style = measure.columns[column]
        label = algorithm if column == first else None
        draw_curves(axis, found, label, colors[algorithm], style, interval=column == first)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    if measure.log:
        axis.set_yscale("log")
        plain_logarithm(axis)
    for mark in measure.marks:
        low, high = axis.get_ylim()
        if low <= mark <= high:
            axis.axhline(mark, color="gray", linewidth=0.7)


def draw_curves(
    axis: Axes,
    curves: pd.DataFrame,
    label: str | None,
    color: str,
    style: str = "-",
    interval: bool = True,
) -> None:
    """The mean over agents, and its interval where there are several and it is asked for."""
    if curves.empty:
        return
    curves = block_means(curves, -(-len(curves) // POINTS))
    mean = curves.mean(axis=1)
    marker = "o" if len(curves) <= FEW else ""
    look = {"color": color, "lw": 1.6, "ls": style, "marker": marker, "markersize": 3}
    axis.plot(mean.index, mean, label=label, **look)
    if interval and curves.shape[1] > 1:
        low, high = interval_of_means(curves.to_numpy())
        axis.fill_between(mean.index, low, high, color=color, alpha=0.2, linewidth=0)


def block_means(curves: pd.DataFrame, size: int) -> pd.DataFrame:
    """The mean of each `size` neighbouring rows, under the steps of the last of them."""
    block = np.arange(len(curves)) // size
    means = curves.groupby(block).mean()
    means.index = pd.Index(curves.index.to_series().groupby(block).last())
    return means
