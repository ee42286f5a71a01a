"""The look that all figures share."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito's
COLUMNS = 4  # panels side by side, at most
DPI = 110


def colors_of(names: Sequence[str]) -> dict[str, str]:
    """A colour for each name; they begin again where there are more names than colours."""
    return dict(zip(names, itertools.cycle(COLORS), strict=False))


def tidy(axis: Axes) -> None:
    """No frame at the top and right, and a faint grid."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)


def width_of(columns: int) -> float:
    """Of a figure, in inches: wider panels where they are few."""
    return 4.4 * columns + 0.6 if columns < 3 else 3.4 * columns


def plain_logarithm(axis: Axes) -> None:
    """Numbers such as 0.02 on a logarithmic y axis, also where it spans less than a decade."""
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=8))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())


def make_panels(names: Sequence[str], height: float = 2.9) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a titled panel for each name, at most `COLUMNS` in a row."""
    columns = max(1, min(COLUMNS, len(names)))
    rows = max(1, -(-len(names) // columns))
    figure, axes = plt.subplots(
        rows, columns, figsize=(width_of(columns), height * rows + 0.4), squeeze=False,
        layout="constrained",
    )  # fmt: skip
    named = dict(zip(names, axes.flat, strict=False))
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for name, axis in named.items():
        tidy(axis)
        axis.set_title(name, fontsize=11)
    return figure, named


def save(figure: Figure, path: Path) -> None:
    """Write the figure, with one legend for all of its axes above it."""
    named: dict[str, Any] = {}
    for axis in figure.axes:
        handles, labels = axis.get_legend_handles_labels()
        named.update(zip(labels, handles, strict=True))
    if named:
        columns = 6 if figure.get_figwidth() > 10 else 4
        figure.legend(
            named.values(), named.keys(), loc="outside upper center", ncols=columns, frameon=False
        )
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
