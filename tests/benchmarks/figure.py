"""A figure of a benchmark run: how cost grows, from what tests/benchmarks/test_growth.py measured.

python -m tests.benchmarks.figure benchmarks.json docs/images/growth.png
"""

from __future__ import annotations

import json
import sys
from itertools import groupby
from pathlib import Path

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from harness.report.figures.style import COLORS, save, tidy
from tests.benchmarks.table import pace

MARKERS = "osD^"


def growth(benchmarks: list[dict]) -> Figure:
    """A panel for each quantity that grows: steps/s where steps are counted, else milliseconds."""
    found: dict[str, list[dict]] = {}
    for b in benchmarks:
        if "panel" in b["extra_info"]:
            found.setdefault(b["extra_info"]["panel"], []).append(b)
    rows = -(-len(found) // 2)
    figure, axes = plt.subplots(
        rows, 2, figsize=(9, 3.4 * rows), squeeze=False, layout="constrained"
    )
    names = sorted({b["extra_info"]["series"] for each in found.values() for b in each})
    for axis, (panel, measured) in zip(axes.flat, found.items(), strict=False):
        tidy(axis)
        speed = "steps" in measured[0]["extra_info"]
        measured.sort(key=lambda b: (b["extra_info"]["series"], b["extra_info"]["x"]))
        for name, series in groupby(measured, key=lambda b: b["extra_info"]["series"]):
            points = [(b["extra_info"]["x"], height(b)) for b in series]
            i = names.index(name)
            look = {
                "color": COLORS[i % len(COLORS)],
                "marker": MARKERS[i % len(MARKERS)],
                "markersize": 4,
            }
            axis.plot(*zip(*points, strict=True), label=name, lw=1.6, **look)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sorted({b["extra_info"]["x"] for b in measured}))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.minorticks_off()
        axis.set_yscale("linear" if speed else "log")
        axis.set_ylim(bottom=0 if speed else None)
        axis.set_xlabel(panel)
        axis.set_ylabel("steps/s, of all agents" if speed else "ms, forward and backward")
    for axis in axes.flat[len(found) :]:
        axis.set_visible(False)
    return figure


def height(benchmark: dict) -> float:
    """Steps a second where steps are counted, else milliseconds."""
    return 1 / pace(benchmark) if "steps" in benchmark["extra_info"] else 1000 * pace(benchmark)


if __name__ == "__main__":
    save(growth(json.loads(Path(sys.argv[1]).read_text())["benchmarks"]), Path(sys.argv[2]))
