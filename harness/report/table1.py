"""Table 1: mean reward over the last 100 updates, beside the paper's numbers."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.table import Table

from harness.statistics import Estimate, estimate_mean, final_score
from harness.store import Store
from harness.suite import Suite

LAST_UPDATES = 100


@dataclasses.dataclass(frozen=True)
class Cell:
    """One algorithm on one environment."""

    environment: str
    algorithm: str
    estimate: Estimate
    seeds: int
    agents: int
    """agents with a finished episode, over all seeds"""
    planned: int
    """agents in the suite"""
    steps: int
    """environment steps of the agent that has done the fewest"""
    updates: int
    """updates that the mean is over, at most"""
    paper: float | None

    @property
    def text(self) -> str:
        """The mean and its interval, or a dash where there is no run."""
        mean, low, high, _ = self.estimate
        if np.isnan(mean):
            return "–"
        return f"{mean:.1f}" if np.isnan(low) else f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def paper_numbers() -> dict[str, Any]:
    path = Path(__file__).parents[1] / "paper.toml"
    return tomllib.loads(path.read_text())["table1"]


def make_cells(suite: Suite, store: Store) -> list[Cell]:
    """A cell for each environment and algorithm, from whatever has been run so far."""
    paper, cells = paper_numbers(), []
    for environment in suite.environments:
        for algorithm in suite.algorithms:
            specs = [
                r for r in suite.runs if (r.environment, r.algorithm) == (environment, algorithm)
            ]
            found = [(s, m) for s in specs if (m := store.metrics(s)) is not None]
            scored = [(s, m) for s, m in found if not np.isnan(final_score(m, LAST_UPDATES))]
            cells.append(
                Cell(
                    environment=environment,
                    algorithm=algorithm,
                    estimate=estimate_mean(
                        np.array([final_score(m, LAST_UPDATES) for _, m in scored])
                    ),
                    seeds=len({s.args["seed"] for s, _ in scored}),
                    agents=len(scored),
                    planned=len(specs),
                    steps=min((int(m["global_step"].iloc[-1]) for _, m in found), default=0),
                    updates=max((len(m.tail(LAST_UPDATES)) for _, m in found), default=0),
                    paper=paper.get(algorithm, {}).get(environment),
                )
            )
    return cells


def notes(suite: Suite, cells: list[Cell]) -> list[str]:
    """What a reader must know before comparing."""
    paper = paper_numbers()
    lines = [suite.note] if suite.note else []
    steps, updates = min(c.steps for c in cells), max(c.updates for c in cells)
    most = max(c.steps for c in cells)
    if most < paper["timesteps"]:
        lines.append(
            f"Steps done: {steps:,} to {most:,}, against the paper's {paper['timesteps']:,}. "
            "These numbers cannot confirm or refute the paper's."
        )
    if updates < LAST_UPDATES:
        lines.append(
            f"The mean is over all updates, at most {updates}: fewer than the paper's 100."
        )
    agents = sorted({c.agents for c in cells})
    lines.append(
        f"Agents per cell: {agents[0]}{f' to {agents[-1]}' if len(agents) > 1 else ''} over "
        f"{max(c.seeds for c in cells)} seed(s); the paper has {paper['seeds']} seeds of "
        f"{paper['agents']} agents. Brackets hold the 95% bootstrap interval over agents, "
        "where there are two or more."
    )
    missing = [f"{c.algorithm} on {c.environment}" for c in cells if not c.agents]
    partial = [
        f"{c.algorithm} on {c.environment} ({c.agents}/{c.planned})"
        for c in cells
        if 0 < c.agents < c.planned
    ]
    if missing:
        lines.append(f"Missing (–): {', '.join(missing)}.")
    if partial:
        lines.append(f"Agents so far: {', '.join(partial)}.")
    return lines


def to_frame(cells: list[Cell]) -> pd.DataFrame:
    """A row for each cell, for CSV."""
    rows = [
        {
            **{k: v for k, v in dataclasses.asdict(c).items() if k not in ("estimate", "n")},
            "mean": c.estimate.mean,
            "low": c.estimate.low,
            "high": c.estimate.high,
        }
        for c in cells
    ]
    return pd.DataFrame(rows)


def _rows(suite: Suite, cells: list[Cell]) -> tuple[list[str], list[list[str]]]:
    header = ["task"]
    for algorithm in suite.algorithms:
        header += [algorithm, f"{algorithm}, paper"]
    rows = []
    for environment in suite.environments:
        row = [environment]
        for cell in (c for c in cells if c.environment == environment):
            row += [cell.text, "–" if cell.paper is None else f"{cell.paper:.1f}"]
        rows.append(row)
    return header, rows


def to_markdown(suite: Suite, cells: list[Cell]) -> str:
    header, rows = _rows(suite, cells)
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    listed = "\n".join(f"- {line}" for line in notes(suite, cells))
    return f"# {suite.title}\n\n{paper_numbers()['metric'].capitalize()}.\n\n{table}\n\n{listed}\n"


def to_rich(suite: Suite, cells: list[Cell]) -> Table:
    header, rows = _rows(suite, cells)
    table = Table(title=f"Table 1 ({suite.name}): {paper_numbers()['metric']}")
    for name in header:
        table.add_column(name, justify="left" if name == "task" else "right",
                         style="dim" if name.endswith("paper") else "")  # fmt: skip
    for row in rows:
        table.add_row(*row)
    return table
