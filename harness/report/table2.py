"""Table 2 and Figure 4: success on CoinRun levels seen and unseen in training."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from rich.table import Table

from harness.report.claims.generalization import SPLITS, plain_agents, splits
from harness.report.figures import COLORS, draw_curves, save, tidy
from harness.report.markdown import supported_by, to_markdown_table
from harness.report.published import paper_numbers
from harness.report.results import Results
from harness.statistics import (
    MIN_TRAINING_RUNS,
    Estimate,
    compare_success,
    estimate_success,
    success_matrix,
)

POLICIES = ("sampled", "greedy")
PAPERS = "CoinRun"  # the game that the paper has
DEVIATIONS = (
    "The engine is Procgen's CoinRun (EnvPool's port), hard levels, where the paper has the "
    "original CoinRun: 15 actions in place of 7, other level generator and visual themes.",
    "The agent's velocity is painted into the frame, as in the original.",
    "Unseen levels are those after the training set; Lee et al. draw theirs without bound.",
    "Repeats are episodes of each level, every level counted equally, first episodes only.",
    "Dropout in NatureCNN acts on its last hidden layer, with one mask for a rollout and its "
    "update; the paper does not say where.",
    "Where delta comes from is not stated in the paper: here a random direction of length 1 over "
    "pixels in [0, 1]. pi(S) is the log-probabilities.",
    "Time limits count as ends, as in the original engine. Weights begin orthogonal. The critic's "
    "loss is not clipped; that of Lee et al. is, by the policy's clip range.",
)
THEMES = (
    "These agents trained with one theme each of the player, the ground, the crates and the "
    "enemies. Themes are the unseen levels once more, in all themes: nearest to the paper's unseen "
    "levels, which have other themes than training throughout, backgrounds included, are unbounded "
    "in number, and are all of difficulty 3."
)


@dataclasses.dataclass(frozen=True)
class Cell:
    """One agent of the paper on one kind of levels."""

    environment: str
    algorithm: str
    split: str
    policy: str
    estimate: Estimate
    """success rate in [0, 1]"""
    levels: int
    repeats: int
    planned: int
    steps: int
    paper: float | None
    failed: int
    """agents whose own numbers became non-finite"""
    detectable: float
    """difference to an agent of this spread that would have been found with 80% power, unpaired"""

    @property
    def text(self) -> str:
        """The rate with its interval in percent, and what it rests on."""
        mean, low, high, n = self.estimate
        if not n:
            return "–"
        interval = "" if np.isnan(low) else f" [{100 * low:.1f}, {100 * high:.1f}]"
        return f"{100 * mean:.1f}{interval} {supported_by(n, self.failed, 100 * self.detectable)}"


def make_cells(results: Results) -> list[Cell]:
    """A cell for each agent, kind of levels and kind of actions, from what has been evaluated."""
    suite = results.suite
    paper = paper_numbers("table2")
    cells = []
    for environment, algorithm in itertools.product(suite.environments, suite.algorithms):
        if not suite.planned[environment, algorithm]:
            continue
        found = results.evaluations_of(environment, algorithm)
        metrics = results.of(environment, algorithm)
        steps = min((int(m["global_step"].iloc[-1]) for m in metrics.values()), default=0)
        failed = sum(
            run.run_id in results.diverged
            for run in suite.runs
            if (run.environment, run.algorithm) == (environment, algorithm)
        )
        for policy, split in itertools.product(POLICIES, splits(results)):
            matrices = [_matrix(episodes, split, policy) for episodes in found.values()]
            rates = np.array([matrix.mean(axis=1) for matrix in matrices])
            alone = float(compare_success(rates).detectable) if len(rates) else np.nan
            printed = (policy, environment) == ("sampled", PAPERS)
            cells.append(
                Cell(
                    environment, algorithm, split, policy, estimate_success(matrices),
                    levels=matrices[0].shape[0] if matrices else 0,
                    repeats=matrices[0].shape[1] if matrices else 0,
                    planned=suite.planned[environment, algorithm], steps=steps,
                    paper=paper.get(split, {}).get(algorithm) if printed else None,
                    failed=failed, detectable=np.sqrt(2) * alone,
                )
            )  # fmt: skip
    return cells


def _matrix(episodes: pd.DataFrame, split: str, policy: str) -> np.ndarray:
    chosen = (episodes["split"] == split) & (episodes["policy"] == policy)
    return success_matrix(episodes[chosen])


def notes(results: Results, cells: list[Cell]) -> list[str]:
    """What a reader must know before comparing, then every deviation from the paper."""
    paper = paper_numbers("table2")
    run = [cell for cell in cells if cell.estimate.n]
    lines = []
    if run:
        first = run[0]
        most = max(cell.estimate.n for cell in run)
        lines += [
            f"{first.levels} seen and {first.levels} unseen levels, {first.repeats} repeats with "
            f"sampled actions; greedy actions once, as a level is deterministic. The paper: "
            f"{paper['levels']} training levels, {paper['repeats']} repeats.",
            f"Training runs in a cell: at most {most}; the paper has {paper['seeds']}. Brackets "
            f"hold the 95% interval over levels; from {MIN_TRAINING_RUNS} runs on over training "
            "runs and levels. Fewer runs say nothing of another training run.",
        ]
        steps = min(c.steps for c in run)
        if steps < 0.95 * paper["timesteps"]:
            lines.append(
                f"Steps done: {steps:,}; the paper's runs have {paper['timesteps']:,}. Shorter "
                "runs can neither confirm nor refute it."
            )
    missing = sorted({c.algorithm for c in cells if c.estimate.n < c.planned})
    if missing:
        lines.append(f"Not all evaluated yet: {', '.join(missing)}.")
    if "themes" in splits(results):
        lines.append(THEMES)
    return lines + list(DEVIATIONS)


def to_rows(results: Results, cells: list[Cell]) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each agent."""
    header = ["agent"]
    for policy, split in itertools.product(POLICIES, splits(results)):
        header.append(split if policy == "sampled" else f"{split}, greedy")
        header += [f"{split}, paper"] if policy == "sampled" and split in SPLITS else []
    suite, rows = results.suite, []
    for game, algorithm in itertools.product(suite.environments, suite.algorithms):
        row = [algorithm if len(suite.environments) == 1 else f"{game}: {algorithm}"]
        for cell in (c for c in cells if (c.environment, c.algorithm) == (game, algorithm)):
            paper = ["" if cell.paper is None else f"{cell.paper:.1f}"]
            row.append(cell.text)
            row += paper if cell.policy == "sampled" and cell.split in SPLITS else []
        rows += [row] if len(row) > 1 else []
    return header, rows


def to_markdown(results: Results, cells: list[Cell]) -> str:
    header, rows = to_rows(results, cells)
    lines = "\n".join(f"- {line}" for line in notes(results, cells))
    table = to_markdown_table(header, rows)
    return f"# {results.suite.title}\n\nSuccess rate, %.\n\n{table}\n\n{lines}\n"


def to_frame(cells: list[Cell]) -> pd.DataFrame:
    """A row for each cell, for CSV."""
    rows = [{**dataclasses.asdict(c), **c.estimate._asdict()} for c in cells]
    return pd.DataFrame(rows).drop(columns="estimate")


def to_rich(results: Results, cells: list[Cell]) -> Table:
    """The table for a terminal."""
    header, rows = to_rows(results, cells)
    table = Table(title=f"{results.suite.name}: success rate on CoinRun levels, %")
    for name in header:
        table.add_column(name, justify="left" if name == "agent" else "right")
    for row in rows:
        table.add_row(*row)
    return table


def success_curves(results: Results, path: Path) -> None:
    """Figure 4: success on seen and unseen levels, and psi, a column for each pair of agents."""
    games = results.suite.environments
    pairs = list(itertools.product(games, plain_agents(results)))
    measures = (("eval/success_seen", "success, seen"), ("eval/success_unseen", "success, unseen"))
    measures += (("conditioning/psi", "psi"),)
    figure, axes = plt.subplots(
        3, len(pairs), figsize=(3.4 * len(pairs), 6.5), squeeze=False, sharex=True, sharey="row",
        layout="constrained",
    )  # fmt: skip
    for column, (game, plain) in enumerate(pairs):
        for row, (measure, label) in enumerate(measures):
            axis: Any = axes[row, column]
            tidy(axis)
            for name, kind, style in ((plain, "plain", "-"), (f"{plain} reg", "reg", "--")):
                curves = _by_update(results, game, name, measure)
                draw_curves(axis, curves, kind, COLORS[kind == "reg"], style)
            if measure.startswith("eval"):
                axis.set_ylim(-0.03, 1.03)
            title = plain if len(games) == 1 else f"{game}: {plain}"
            axis.set_title(title if row == 0 else "", fontsize=11)
            axis.set_ylabel(label if column == 0 else "")
        axes[-1, column].set_xlabel("environment steps")
    save(figure, path)


def _by_update(results: Results, environment: str, name: str, measure: str) -> pd.DataFrame:
    """Agents count their steps differently by a few, so curves are joined by update."""
    found = results.of(environment, name)
    curves = pd.DataFrame({k: m[measure] for k, m in found.items()})
    steps = pd.DataFrame({k: m["global_step"] for k, m in found.items()}).mean(axis=1)
    return curves.set_index(steps).dropna(how="all") if len(curves) else curves
