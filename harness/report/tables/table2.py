"""Table 2: success on CoinRun levels seen and unseen in training."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pandas as pd
from rich.table import Table

from harness.report.claims.generalization import SPLITS, splits
from harness.report.published import paper_numbers
from harness.report.results import Results
from harness.report.tables.text import supported_by, to_markdown_table
from harness.statistics import (
    MIN_TRAINING_RUNS,
    Estimate,
    compare_success,
    estimate_success,
    success_matrix,
)

POLICIES = ("sampled", "greedy")
PAPERS = "CoinRun"  # the game that the paper has
BEYOND = {
    "next": "the levels that follow the training set",
    "unbounded": "levels drawn without bound",
    "themes": "the levels that follow the training set",
}
UNSEEN = (
    "The paper's unseen levels are new in three ways at once, as in Lee et al.: other levels, "
    "themes that training never showed, and difficulty 3 only, where training has 1 to 3. Ours "
    "are {}, with the themes and the difficulties of training. So the two unseen columns are not "
    "of the same test."
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
    """What a reader must know before comparing; docs/paper.md has every deviation."""
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
    lines.append(UNSEEN.format(" or ".join(_beyond(results))))
    if "themes" in splits(results):
        lines.append(THEMES)
    return lines


def _beyond(results: Results) -> list[str]:
    """What the unseen levels are, in words."""
    asked = [run.evaluation["unseen"] for run in results.suite.runs]
    return list(dict.fromkeys(BEYOND[unseen] for unseen in asked))


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
        table.add_row(*(text.replace("[", r"\[").replace(" (n ", "\n(n ") for text in row))
    return table
