"""Table 1, twice: training scores beside the paper's, and the returns of the final policies."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable

import numpy as np
import pandas as pd
from rich.table import Table

from harness.report.claims.agents import agent_table, fill_failed
from harness.report.published import paper_numbers, zoo_numbers
from harness.report.results import Results
from harness.report.tables.text import supported_by, to_markdown_table
from harness.statistics import (
    Estimate,
    detectable_difference,
    estimate_mean,
    is_skewed,
    window_of,
)
from harness.suite import Suite

OUTCOMES = {
    "reward": "training score: mean return of the episodes that ended in the last tenth of the "
    "run, at most 200,000 steps",
    "final": "final policy: mean return of its deterministic actions over the evaluation",
}
BESIDE_ZOO = ("strong",)  # suites with rl-baselines3-zoo's settings


@dataclasses.dataclass(frozen=True)
class Cell:
    """One algorithm on one environment."""

    environment: str
    algorithm: str
    estimate: Estimate
    scores: tuple[float, ...]
    """one for each agent, ordered by size"""
    seeds: int
    agents: int
    """agents with a score, over all seeds; failed ones have the worst of their task"""
    failed: int
    """agents whose own numbers became non-finite"""
    planned: int
    """agents in the suite"""
    steps: int
    """environment steps of the agent that has done the fewest"""
    window: int
    """steps at the end of the run that the training score is over"""
    detectable: float
    """difference to an arm of this spread that would have been found with 80% power, unpaired"""
    paper: float | None
    zoo: str
    """mean and deviation of rl-baselines3-zoo's agent, where it stands beside"""

    @property
    def text(self) -> str:
        """The mean, its interval or its range, and what it rests on; a dash if there is no run."""
        mean, low, high, _ = self.estimate
        if not self.agents:
            return "–"
        spread = ""
        if not np.isnan(low):
            spread = f" [{low:.1f}, {high:.1f}]"
        elif self.agents > 1:
            spread = f" {{{self.scores[0]:.1f} to {self.scores[-1]:.1f}}}"
        return f"{mean:.1f}{spread} {supported_by(self.agents, self.failed, self.detectable)}"


def make_cells(results: Results, outcome: str = "reward") -> list[Cell]:
    """A cell for each environment and algorithm, from whatever has been run so far.

    Args:
        results: What the runs have left.
        outcome: "reward" for training scores, "final" for final policies.
    """
    suite = results.suite
    paper = paper_numbers("table1") if outcome == "reward" else {}
    algorithms = algorithms_of(suite)
    agents = agent_table(results)
    agents = fill_failed(agents[agents["algorithm"].isin(algorithms)], outcome)
    planned = suite.planned
    cells = []
    for environment, algorithm in itertools.product(suite.environments, algorithms):
        if not planned[environment, algorithm]:
            continue
        of_task = agents[agents["environment"] == environment]
        own = of_task[of_task["algorithm"] == algorithm]
        scored = own.dropna(subset=[outcome])
        arms = [arm.dropna().to_numpy() for _, arm in of_task.groupby("algorithm")[outcome]]
        scores = np.sort(scored[outcome].to_numpy(float))
        spread = float(scores.std(ddof=1)) if len(scores) > 1 else np.nan
        zoo = zoo_numbers(algorithm).get(environment)
        beside = outcome == "final" and suite.name in BESIDE_ZOO and zoo is not None
        cells.append(
            Cell(
                environment=environment,
                algorithm=algorithm,
                estimate=_estimate(scores, arms),
                scores=tuple(float(score) for score in scores),
                seeds=scored["seed"].nunique(),
                agents=len(scored),
                failed=int(own["failed"].sum()),
                planned=planned[environment, algorithm],
                steps=int(own["steps"].min()) if len(own) else 0,
                window=_window(suite, environment, algorithm),
                detectable=float(detectable_difference(np.sqrt(2) * spread, len(scores))),
                paper=paper.get(algorithm, {}).get(environment),
                zoo=f"{zoo['mean']:g} ± {zoo['deviation']:g}" if beside and zoo else "",
            )
        )
    return cells


def _estimate(scores: np.ndarray, arms: list[np.ndarray]) -> Estimate:
    """A cell's mean, with its interval unless the cell or its task is skewed."""
    return estimate_mean(scores, skewed=is_skewed(arms) or is_skewed([scores]))


def algorithms_of(suite: Suite) -> list[str]:
    """The suite's algorithms that the paper's table has; all of them if it has none."""
    named = paper_numbers("table1")
    return [name for name in suite.algorithms if name in named] or suite.algorithms


def _window(suite: Suite, environment: str, algorithm: str) -> int:
    totals = [
        run.args["total_timesteps"]
        for run in suite.runs
        if (run.environment, run.algorithm) == (environment, algorithm)
    ]
    return round(window_of(max(totals)))


def notes(results: Results, cells: list[Cell]) -> list[str]:
    """What a reader must know before comparing."""
    paper = paper_numbers("table1")
    run = [cell for cell in cells if cell.agents]
    lines = [results.suite.note] if results.suite.note else []
    if any(cell.steps < paper["timesteps"] for cell in run):
        lines.append(
            f"Steps done: {_span(c.steps for c in run)}; the paper's runs have "
            f"{paper['timesteps']:,}. Shorter runs can neither confirm nor refute it."
        )
    if run:
        lines.append(
            f"Training scores are over the last {_span(c.window for c in run)} steps; the paper's "
            "are over its last 100 updates, 200,000 steps."
        )
        lines.append(
            f"Agents in a cell: {_span(c.agents for c in run)}; "
            f"seeds: {_span(c.seeds for c in run)}. "
            f"The paper has {paper['agents']} agents for each of {paper['seeds']} seeds."
        )
    if any(cell.agents > 1 for cell in run):
        lines.append(
            "[Brackets] hold the 95% interval of the mean over agents, Student's with a correction "
            "for skewness. {Braces} hold the smallest and the largest score, where there are fewer "
            "than 5 agents, or fewer than 30 with skewed scores, or where all scores are equal: no "
            "interval can be trusted there."
        )
        lines.append(
            "In parentheses: agents, failed ones among them, and the difference to an arm of the "
            "same spread that would have been found with 80% power at 5%."
        )
    if any(cell.failed for cell in cells):
        lines.append(
            "A failed run's numbers became non-finite. It counts with the worst score of its task."
        )
    return lines + _incomplete(results, cells)


def _incomplete(results: Results, cells: list[Cell]) -> list[str]:
    lines = []
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
    rows = []
    for cell in cells:
        fields = {field.name: getattr(cell, field.name) for field in dataclasses.fields(cell)}
        del fields["estimate"], fields["scores"]
        mean, low, high, _ = cell.estimate
        rows.append({**fields, "mean": mean, "low": low, "high": high})
    return pd.DataFrame(rows)


def to_rows(suite: Suite, cells: list[Cell]) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each task.

    Beside an algorithm's column stands the paper's, or the zoo's, if any cell has a number there.
    """
    algorithms = [a for a in suite.algorithms if any(c.algorithm == a for c in cells)]
    found = {(c.environment, c.algorithm): c for c in cells}
    others = [
        (algorithm, source)
        for algorithm in algorithms
        for source in ("paper", "zoo")
        if any(_published(c, source) for c in cells if c.algorithm == algorithm)
    ]
    header = ["task"]
    for algorithm in algorithms:
        header.append(algorithm)
        header += [f"{algorithm}, {source}" for name, source in others if name == algorithm]
    rows = []
    for environment in suite.environments:
        row = [environment]
        for algorithm in algorithms:
            cell = found.get((environment, algorithm))
            row.append(cell.text if cell else "")
            row += [_published(cell, source) for name, source in others if name == algorithm]
        rows.append(row)
    return header, rows


def _published(cell: Cell | None, source: str) -> str:
    if cell is None:
        return ""
    if source == "zoo":
        return cell.zoo
    return "" if cell.paper is None else f"{cell.paper:.1f}"


def to_markdown(results: Results, cells: list[Cell], outcome: str = "reward") -> str:
    """The table and its notes, then how much each cell rests on."""
    header, rows = to_rows(results.suite, cells)
    about = ["task", "algorithm", "agents", "failed", "seeds", "steps", "window"]
    weights = [
        [c.environment, c.algorithm, f"{c.agents} of {c.planned}", str(c.failed), str(c.seeds),
         f"{c.steps:,}", f"{c.window:,}"] for c in cells
    ]  # fmt: skip
    parts = [
        f"# {results.suite.title}",
        f"{OUTCOMES[outcome].capitalize()}.",
        to_markdown_table(header, rows),
        "\n".join(f"- {line}" for line in notes(results, cells)),
        "What each cell rests on:",
        to_markdown_table(about, weights),
    ]
    return "\n\n".join(parts) + "\n"


def to_rich(results: Results, cells: list[Cell], outcome: str = "reward") -> Table:
    """The table for a terminal: what was published below ours."""
    header, rows = to_rows(results.suite, cells)
    title = f"{results.suite.name}: {OUTCOMES[outcome].partition(':')[0]}"
    table = Table(title=title, show_lines=True)
    for name in header:
        if ", paper" not in name and ", zoo" not in name:
            table.add_column(name, justify="left" if name == "task" else "right")
    for row in rows:
        texts: list[str] = []
        for name, text in zip(header, row, strict=True):
            algorithm, _, source = name.rpartition(", ")
            if algorithm and source in ("paper", "zoo"):
                texts[-1] += f"\n[dim]{source} {text or '–'}[/]"
            else:
                texts.append(text.replace("[", r"\[").replace(" (n ", "\n(n "))
        table.add_row(*texts)
    return table
