"""What the commands print: the report's tables and verdicts, and what other suites would take."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from rich.console import Console
from rich.table import Table

from harness.estimate import Cost
from harness.progress import duration
from harness.provenance import cores
from harness.report.page import write_page, write_report
from harness.report.part import Part
from harness.report.results import Results
from harness.scheduler import Outcome
from harness.schema import suite_names
from harness.statistics import estimate_success, success_matrix
from harness.store import Store
from harness.suite import load_suite

console = Console()
say = functools.partial(console.print, highlight=False, soft_wrap=True)


class Report(NamedTuple):
    """What was written: the parts of the page, one for each suite, and the page."""

    parts: list[Part]
    page: Path


def make_report(found: list[Results], store: Store) -> Report:
    """Print the tables and write the report of each suite, and one page of several.

    The page of one suite is in results/<suite>/report/, that of several in results/report/.
    """
    parts = [write_report(results, store.report_path(results.suite.name)) for results in found]
    for part in parts:
        if len(parts) > 1 and part.unjudged:
            continue  # a table of single agents says that they ran, and the page has it
        for section in part.sections:
            if section.table:
                console.print(section.table)
                for note in section.notes:
                    say(f"• {note}", markup=False)
    if len(parts) == 1:
        return Report(parts, parts[0].folder / "report.html")

    page = store.report_path() / "report.html"
    write_page(parts, page)
    return Report(parts, page)


def show_verdicts(report: Report) -> None:
    """The verdicts, a line each, and where the page is: the last that a command prints."""
    for part in report.parts:
        suite = part.results.suite
        done = f"{len(part.results.done)} of {len(suite.runs)} runs done"
        failed = f", {len(part.results.diverged)} diverged" if part.results.diverged else ""
        bases = {claim.basis for claim in part.claims if claim.basis}
        shared = f", {bases.pop()}" if len(bases) == 1 else ""
        say(f"\n[bold]{suite.name}[/]: {done}{failed}{shared}. {part.unjudged}")
        for claim in part.claims:
            own = "" if shared else f" ({claim.basis})"
            say(f"({claim.letter}) [bold]{claim.verdict}[/]: {claim.statement}{own}")
    say(f"\nWritten: {report.page}")


def show_outcome(outcome: Outcome, store: Store) -> None:
    """The runs that another process has, and the log of each that failed."""
    if outcome.held:
        say(f"[yellow]{len(outcome.held)} runs are being run by another process.[/]")
    for spec in outcome.failed:
        say(f"\n[red bold]FAILED[/] {spec.run_id}: {store.path(spec, 'log.txt')} ends")
        say(store.log_tail(spec), markup=False)


def evaluation_tables(found: dict[str, pd.DataFrame]) -> list[Table]:
    """What evaluations found, by run: of control agents, under attack, and CoinRun's."""
    control = Table("run", "actions", "episodes", "return", "length", "|change|", "Sm")
    levels = Table("run", "levels", "actions", "success rate", "95% interval over levels")
    attacked = Table("run", "attack", "radius", "norm", "episodes", "return", "length", "|change|")
    for run, episodes in found.items():
        if "split" in episodes:
            for (split, policy), part in episodes.groupby(["split", "policy"]):
                rate = estimate_success([success_matrix(part)])
                interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f}"
                levels.add_row(run, split, policy, f"{100 * rate.mean:.1f}%", interval)
            continue
        if "attack" in episodes:
            for (attack, radius, norm), part in episodes.groupby(
                ["attack", "radius", "norm"], sort=False
            ):
                mean = part.mean(numeric_only=True)
                attacked.add_row(
                    run, attack, f"{radius:g}", norm, str(len(part)),
                    f"{mean['return']:.1f} ± {part['return'].std(ddof=0):.1f}",
                    f"{mean['length']:.0f}", f"{mean['action_change']:.3f}",
                )  # fmt: skip
            continue
        for policy, part in episodes.groupby("policy"):
            mean = part.mean(numeric_only=True)
            spread = part["return"].std(ddof=0)
            control.add_row(
                run, policy, str(len(part)), f"{mean['return']:.1f} ± {spread:.1f}",
                f"{mean['length']:.0f}", f"{mean['action_change']:.3f}",
                f"{mean['smoothness']:.2e}",
            )  # fmt: skip
    return [table for table in (control, attacked, levels) if table.row_count]


def show_others(found: list[Results]) -> None:
    """What the other suites would take here, at the speed that these ones' runs have shown."""
    speed = {
        (run.baseline, run.environment): results.scores[run.run_id]["final/charts/SPS"]
        for results in reversed(found)  # the first one's count
        for run in results.suite.runs
        if run.run_id in results.scores and "levels" not in run.evaluation  # too short to tell
    }
    shown = {results.suite.name for results in found}
    for name in suite_names():
        if name in shown:
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
