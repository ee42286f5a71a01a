"""The command line: python -m harness run-all | list | status | report."""

from __future__ import annotations

import functools
import os
import signal
import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from harness.launchers.local import Outcome, run_local
from harness.progress import Progress, duration
from harness.report import figures, table1
from harness.store import Store, StoreError
from harness.suite import Suite, SuiteError, load_suite, suite_names

app = tyro.extras.SubcommandApp()
console = Console()
say = functools.partial(console.print, highlight=False, soft_wrap=True)
DEFAULT_SUITE = "smoke"


@app.command(name="run-all")
def run_all(
    suite: str = DEFAULT_SUITE,
    jobs: int = os.cpu_count() or 1,
    results_dir: Path = Path("results"),
    total_timesteps: int | None = None,
    seeds: int | None = None,
    agents: int | None = None,
    env: tuple[str, ...] = (),
) -> None:
    """Run what a suite still lacks, side by side, then report it.

    A finished run is never run again; an interrupted one continues from its last checkpoint.
    Ctrl-C stops the runs and keeps their checkpoints: the same command continues.

    Args:
        suite: Name of a suite (see `list`), or path of a TOML file.
        jobs: Runs at a time, one core each; by default all cores.
        results_dir: Where the runs' folders and the reports go.
        total_timesteps: Environment steps of each run, instead of the suite's.
        seeds: Only the first so many seeds.
        agents: Only so many agents for each seed.
        env: Only these tasks, such as Hopper.
    """
    if jobs < 1:
        raise SuiteError(f"jobs must be at least 1, got {jobs}")
    store = Store(results_dir)
    plan = load_suite(suite, total_timesteps=total_timesteps, seeds=seeds, agents=agents, env=env)
    todo = [spec for spec in plan.runs if store.state(spec) != "done"]
    done = len(plan.runs) - len(todo)
    say(
        f"[bold]{plan.name}[/]: {plan.title}. {len(plan.runs)} runs, {plan.timesteps:,} steps; "
        f"{done} done before, {len(todo)} to do, {jobs} at a time."
    )
    outcome = Outcome()
    if todo:
        with Progress(console, store, todo) as progress:
            outcome = run_local(todo, store, jobs, progress)
    make_report(plan, store)
    show_others(plan, store)
    if outcome.held:
        say(f"[yellow]{len(outcome.held)} runs are being run by another process.[/]")
    for spec in outcome.failed:
        say(f"\n[red bold]FAILED[/] {spec.run_id}: {store.path(spec, 'log.txt')} ends")
        say(store.log_tail(spec), markup=False)
    if outcome.failed:
        raise SystemExit(1)


@app.command(name="list")
def list_suites() -> None:
    """List the suites: how many runs and steps each takes."""
    table = Table("suite", "what it is", "runs", "steps")
    for name in suite_names():
        plan = load_suite(name)
        table.add_row(name, plan.title, str(len(plan.runs)), f"{plan.timesteps:,}")
    console.print(table)


@app.command(name="status")
def status(suite: tuple[str, ...] = (), results_dir: Path = Path("results")) -> None:
    """Tell how far each suite is: runs done, running, failed, interrupted and pending.

    Args:
        suite: Names of suites; by default all.
        results_dir: Where the runs' folders are.
    """
    store = Store(results_dir)
    table = Table("suite", "done", "running", "failed", "interrupted", "pending", "steps")
    for name in suite or suite_names():
        plan = load_suite(name)
        states = Counter(store.state(spec) for spec in plan.runs)
        steps = sum(store.steps(spec) for spec in plan.runs)
        counts = [str(states[s]) for s in ("done", "running", "failed", "interrupted", "pending")]
        table.add_row(name, *counts, f"{steps:,} of {plan.timesteps:,}")
    console.print(table)


@app.command(name="report")
def report(
    suite: Annotated[str, tyro.conf.Positional] = DEFAULT_SUITE,
    results_dir: Path = Path("results"),
) -> None:
    """Report what a suite's runs show so far, beside the paper's tables.

    Args:
        suite: Name of a suite (see `list`), or path of a TOML file.
        results_dir: Where the runs' folders are and the report goes.
    """
    make_report(load_suite(suite), Store(results_dir))


def make_report(plan: Suite, store: Store) -> None:
    """Print the table and write it, and the learning curves, to results/<suite>/report/."""
    folder = store.report_path(plan.name)
    cells = table1.make_cells(plan, store)
    console.print(table1.to_rich(plan, cells))
    for note in table1.notes(plan, cells):
        say(f"• {note}", markup=False)
    (folder / "table1.md").write_text(table1.to_markdown(plan, cells))
    table1.to_frame(cells).to_csv(folder / "table1.csv", index=False)
    figures.learning_curves(plan, store, folder / "learning_curves.png")
    say(f"Written: {folder}/table1.md, table1.csv, learning_curves.png")


def show_others(plan: Suite, store: Store) -> None:
    """What the other suites would take here, at the speed that this one's runs have shown."""
    speed = {}
    for spec in plan.runs:
        metrics = store.metrics(spec)
        if metrics is not None:
            speed[spec.baseline, spec.environment] = metrics["charts/SPS"].iloc[-1]
    for name in suite_names():
        if name == plan.name:
            continue
        other = load_suite(name)
        seconds = [
            r.args["total_timesteps"] / speed.get((r.baseline, r.environment), float("nan"))
            for r in other.runs
        ]
        time = duration(sum(seconds) / (os.cpu_count() or 1))
        known = sum(seconds) == sum(seconds)  # NaN where an environment's speed is not known
        cost = f", about {sum(seconds) / 3600:,.0f} core-hours, {time} here" if known else ""
        say(f"run-all --suite {name}: {len(other.runs)} runs, {other.timesteps:,} steps{cost}")


def main() -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        app.cli(prog="python -m harness", description=__doc__)
    except (SuiteError, StoreError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        console.print("\nInterrupted. The runs are stopped and their checkpoints kept: "
                      "the same command continues.")  # fmt: skip
        sys.exit(130)
