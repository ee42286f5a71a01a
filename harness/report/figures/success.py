"""Figure 4: success on seen and unseen CoinRun levels while agents are trained."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd

from harness.report.claims.generalization import plain_agents
from harness.report.figures.curves import draw_curves
from harness.report.figures.style import COLORS, save, tidy
from harness.report.results import Results

MEASURES = {
    "eval/success_seen": "success, seen",
    "eval/success_unseen": "success, unseen",
    "conditioning/psi": "psi",
}


def success_curves(results: Results, path: Path) -> bool:
    """A column for each pair of agents and a row for each measure, as far as any run has logged it.

    Returns whether there was any to draw.
    """
    games = results.suite.environments
    pairs = list(itertools.product(games, plain_agents(results)))
    curves = {
        (game, name, measure): found
        for game, plain in pairs
        for name in (plain, f"{plain} reg")
        for measure in MEASURES
        if len(found := _by_update(results, game, name, measure))
    }
    columns = [
        (game, plain) for game, plain in pairs
        if any((game, name) == key[:2] for name in (plain, f"{plain} reg") for key in curves)
    ]  # fmt: skip
    rows = [measure for measure in MEASURES if any(measure == key[2] for key in curves)]
    if not columns:
        return False

    figure, axes = plt.subplots(
        len(rows), len(columns), figsize=(max(3.0 * len(columns), 5), 2.1 * len(rows) + 0.4),
        squeeze=False, sharex=True, sharey="row", layout="constrained",
    )  # fmt: skip
    for column, (game, plain) in enumerate(columns):
        for row, measure in enumerate(rows):
            axis: Any = axes[row, column]
            tidy(axis)
            for name, kind, style in ((plain, "plain", "-"), (f"{plain} reg", "reg", "--")):
                found = curves.get((game, name, measure), pd.DataFrame())
                draw_curves(axis, found, kind, COLORS[kind == "reg"], style)
            if measure.startswith("eval"):
                axis.set_ylim(-0.03, 1.03)
            axis.set_ylabel(MEASURES[measure] if column == 0 else "")
        axes[0, column].set_title(plain if len(games) == 1 else f"{game}: {plain}", fontsize=11)
        axes[-1, column].set_xlabel("environment steps")
    save(figure, path)
    return True


def _by_update(results: Results, environment: str, name: str, measure: str) -> pd.DataFrame:
    """Agents count their steps differently by a few, so curves are joined by update."""
    found = results.of(environment, name)
    curves = pd.DataFrame({k: m[measure] for k, m in found.items() if measure in m})
    steps = pd.DataFrame({k: m["global_step"] for k, m in found.items()}).mean(axis=1)
    return curves.set_index(steps).dropna(how="all") if len(curves) else curves
