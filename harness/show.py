"""What the commands print: the report's tables and verdicts, and what other suites would take."""

from __future__ import annotations

import functools
import math

import pandas as pd
from rich.console import Console
from rich.table import Table

from harness.estimate import Cost
from harness.progress import duration
from harness.provenance import cores
from harness.report.page import write_report
from harness.report.results import Results
from harness.schema import suite_names
from harness.statistics import estimate_success, success_matrix
from harness.store import Store
from harness.suite import load_suite

console = Console()
say = functools.partial(console.print, highlight=False, soft_wrap=True)


def make_report(results: Results, store: Store) -> None:
    """Print the table and the verdicts, and write the whole report to results/<suite>/report/."""
    folder = store.report_path(results.suite.name)
    sections, found = write_report(results, folder)
    for section in sections:
        console.print(section.table)
        for note in section.notes:
            say(f"• {note}", markup=False)
    for claim in found:
        say(f"Claim ({claim.letter}): {claim.statement} [bold]{claim.verdict}[/]")
    say(f"Written: {folder / 'report.html'}, with its tables and figures beside it.")


def evaluation_tables(found: dict[str, pd.DataFrame]) -> list[Table]:
    """What evaluations found, by run: a table of control agents, and one of CoinRun's."""
    control = Table("run", "actions", "episodes", "return", "length", "|change|", "Sm")
    levels = Table("run", "levels", "actions", "success rate", "95% interval over levels")
    for run, episodes in found.items():
        if "split" in episodes:
            for (split, policy), part in episodes.groupby(["split", "policy"]):
                rate = estimate_success([success_matrix(part)])
                interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f}"
                levels.add_row(run, split, policy, f"{100 * rate.mean:.1f}%", interval)
            continue
        for policy, part in episodes.groupby("policy"):
            mean = part.mean(numeric_only=True)
            spread = part["return"].std(ddof=0)
            control.add_row(
                run, policy, str(len(part)), f"{mean['return']:.1f} ± {spread:.1f}",
                f"{mean['length']:.0f}", f"{mean['action_change']:.3f}",
                f"{mean['smoothness']:.2e}",
            )  # fmt: skip
    return [table for table in (control, levels) if table.row_count]


def show_others(results: Results) -> None:
    """What the other suites would take here, at the speed that this one's runs have shown."""
    speed = {
        (run.baseline, run.environment): results.metrics[run.run_id]["charts/SPS"].iloc[-1]
        for run in results.suite.runs
        if run.run_id in results.metrics and "levels" not in run.evaluation  # too short to tell
    }
    for name in suite_names():
        if name == results.suite.name:
            continue
        other = load_suite(name)
        seconds = sum(
            r.args["total_timesteps"] / speed.get((r.baseline, r.environment), math.nan)
            for r in other.runs
        )
        cost = " (--dry-run says how long)" if math.isnan(seconds) else (
            f", about {seconds / 3600:,.0f} core-hours, {duration(seconds / cores())} here"
        )  # fmt: skip
        what = f"{len(other.runs)} runs, {other.timesteps:,} steps"
        say(f"To come: run-all --suite {name} takes {what}{cost}.")


def show_costs(costs: list[Cost], jobs: int) -> None:
    """What is to be run, by algorithm and task, and the sum."""
    table = Table("algorithm", "task", "runs", "steps", "steps/s", "hours", "MB")
    for c in costs:
        table.add_row(c.algorithm, c.environment, str(c.runs), f"{c.steps:,}", f"{c.speed:,.0f}",
                      f"{c.hours:,.1f}", f"{c.bytes / 1e6:,.0f}")  # fmt: skip
    console.print(table)
    hours = sum(c.hours for c in costs)
    say(
        f"{sum(c.runs for c in costs)} runs, {sum(c.steps for c in costs):,} steps: "
        f"{hours:,.1f} hours of one process, {duration(3600 * hours / jobs)} with {jobs} at a "
        f"time, {sum(c.bytes for c in costs) / 1e9:.2f} GB. Evaluations come on top."
    )
