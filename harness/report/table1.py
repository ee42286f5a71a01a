"""Table 1: mean reward over the last 100 updates, beside the paper's numbers."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable

import numpy as np
import pandas as pd
from rich.table import Table

from harness.report.markdown import to_markdown_table
from harness.report.paper import paper_numbers
from harness.report.results import Results
from harness.statistics import LAST_UPDATES, Estimate, estimate_mean, final_score
from harness.suite import Suite


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
    """updates that the mean of the agent with the fewest is over"""
    paper: float | None

    @property
    def text(self) -> str:
        """The mean and its interval, or a dash where there is no run."""
        mean, low, high, _ = self.estimate
        if np.isnan(mean):
            return "–"
        return f"{mean:.1f}" if np.isnan(low) else f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def make_cells(results: Results) -> list[Cell]:
    """A cell for each environment and algorithm, from whatever has been run so far."""
    suite, paper = results.suite, paper_numbers("table1")
    algorithms = [a for a in suite.algorithms if a in paper] or suite.algorithms
    planned = suite.planned
    seeds = {run.run_id: run.args["seed"] for run in suite.runs}
    cells = []
    for environment, algorithm in itertools.product(suite.environments, algorithms):
        if not planned[environment, algorithm]:
            continue
        found = results.of(environment, algorithm)
        scores = {k: final_score(m) for k, m in found.items()}
        scores = {k: score for k, score in scores.items() if not np.isnan(score)}
        cells.append(
            Cell(
                environment=environment,
                algorithm=algorithm,
                estimate=estimate_mean(np.array(list(scores.values()))),
                seeds=len({seeds[k] for k in scores}),
                agents=len(scores),
                planned=planned[environment, algorithm],
                steps=min((int(m["global_step"].iloc[-1]) for m in found.values()), default=0),
                updates=min((len(m.tail(LAST_UPDATES)) for m in found.values()), default=0),
                paper=paper.get(algorithm, {}).get(environment),
            )
        )
    return cells


def notes(results: Results, cells: list[Cell]) -> list[str]:
    """What a reader must know before comparing."""
    paper, run = paper_numbers("table1"), [c for c in cells if c.agents]
    lines = [results.suite.note] if results.suite.note else []
    if any(c.steps < paper["timesteps"] for c in run):
        lines.append(
            f"Steps done: {_span(c.steps for c in run)}; the paper's runs have "
            f"{paper['timesteps']:,}. Shorter runs can neither confirm nor refute it."
        )
    if any(c.updates < LAST_UPDATES for c in run):
        lines.append(
            f"Means are over all updates where a run has fewer than {LAST_UPDATES}: "
            f"{_span(c.updates for c in run)} here."
        )
    if run:
        lines.append(
            f"Agents in a cell: {_span(c.agents for c in run)}; "
            f"seeds: {_span(c.seeds for c in run)}. "
            f"The paper has {paper['agents']} agents for each of {paper['seeds']} seeds."
        )
    if any(c.agents > 1 for c in cells):
        lines.append("Brackets hold the 95% bootstrap interval of the mean over agents.")
    missing = [f"{c.algorithm} on {c.environment}" for c in cells if not c.agents]
    partial = [
        f"{c.algorithm} on {c.environment} ({c.agents} of {c.planned})"
        for c in cells
        if 0 < c.agents < c.planned
    ]
    if missing:
        lines.append(f"Missing (–): {', '.join(missing)}.")
    if partial:
        lines.append(f"Incomplete: {', '.join(partial)}.")
    if results.changed:
        lines.append(f"Left out, since run with other settings: {', '.join(results.changed)}.")
    return lines


def _span(numbers: Iterable[int]) -> str:
    found = sorted(set(numbers))
    return f"{found[0]:,}" if len(found) == 1 else f"{found[0]:,} to {found[-1]:,}"


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


def to_rows(suite: Suite, cells: list[Cell]) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each task."""
    algorithms = [a for a in suite.algorithms if any(c.algorithm == a for c in cells)]
    found = {(c.environment, c.algorithm): c for c in cells}
    header = ["task"]
    for algorithm in algorithms:
        header += [algorithm, f"{algorithm}, paper"]
    rows = []
    for environment in suite.environments:
        row = [environment]
        for algorithm in algorithms:
            cell = found.get((environment, algorithm))
            paper = cell.paper if cell else None
            row += [cell.text if cell else "", "" if paper is None else f"{paper:.1f}"]
        rows.append(row)
    return header, rows


def to_markdown(results: Results, cells: list[Cell]) -> str:
    """The table and its notes, then how much each cell rests on."""
    header, rows = to_rows(results.suite, cells)
    about = ["task", "algorithm", "agents", "seeds", "steps", "updates"]
    weights = [
        [c.environment, c.algorithm, f"{c.agents} of {c.planned}", str(c.seeds), f"{c.steps:,}",
         str(c.updates)] for c in cells
    ]  # fmt: skip
    return (
        "\n\n".join(
            [
                f"# {results.suite.title}",
                f"{paper_numbers('table1')['metric'].capitalize()}.",
                to_markdown_table(header, rows),
                "\n".join(f"- {line}" for line in notes(results, cells)),
                "What each cell rests on:",
                to_markdown_table(about, weights),
            ]
        )
        + "\n"
    )


def to_rich(results: Results, cells: list[Cell]) -> Table:
    """The table for a terminal: the paper's number below ours."""
    header, rows = to_rows(results.suite, cells)
    table = Table(
        title=f"{results.suite.name}: {paper_numbers('table1')['metric']}", show_lines=True
    )
    table.add_column(header[0])
    for name in header[1::2]:
        table.add_column(name, justify="right")
    for task, *texts in rows:
        pairs = zip(texts[::2], texts[1::2], strict=True)
        table.add_row(task, *(f"{ours}\n[dim]paper {paper or '–'}[/]" for ours, paper in pairs))
    return table
