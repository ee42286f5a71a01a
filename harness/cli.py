"""The command line: python -m harness run-all | list | status | evaluate | cost | report."""

from __future__ import annotations

import dataclasses
import functools
import math
import signal
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import rich.progress
import tyro
from rich.console import Console
from rich.table import Table

from harness.cost import IMPLEMENTATIONS, CostError, measure_in_turn
from harness.estimate import Cost, EstimateError, measure
from harness.launchers.groups import make_groups
from harness.launchers.local import Outcome, cores, run_local
from harness.progress import Progress, duration
from harness.report.cost import measured_in_turn
from harness.report.page import write_report
from harness.report.results import TIMED, Results, load_results
from harness.schema import SuiteError, Unseen, check_known, suite_names
from harness.statistics import estimate_success, success_matrix
from harness.store import STATES, EvaluationError, Store, StoreError
from harness.suite import load_suite

app = tyro.extras.SubcommandApp()
console = Console()
say = functools.partial(console.print, highlight=False, soft_wrap=True)
DEFAULT_SUITE = "smoke"


@app.command(name="run-all")
def run_all(
    suite: str = DEFAULT_SUITE,
    jobs: int | None = None,
    results_dir: Path = Path("results"),
    total_timesteps: int | None = None,
    seeds: int | None = None,
    agents: int | None = None,
    env: tuple[str, ...] = (),
    plain: bool = False,
    dry_run: bool = False,
) -> None:
    """Run what a suite still lacks, side by side, then report it.

    A finished run is never run again; an interrupted one continues from its last checkpoint.
    Ctrl-C stops the runs and keeps their checkpoints: the same command continues.

    Args:
        suite: Name of a suite (see `list`), or path of a TOML file.
        jobs: Runs at a time, one core each; by default all cores.
        results_dir: Where the runs' folders and the reports go.
        total_timesteps: Environment steps of each run, instead of the suite's.
        seeds: So many seeds: the suite's first, then those that follow its last.
        agents: Only so many agents for each seed.
        env: Only these tasks, such as Hopper.
        plain: One process for each agent, by the single files; by default the agents of a seed
            share one, which computes the same in less time.
        dry_run: Run nothing for good: measure two updates of each kind of run, and say what the
            rest takes in hours and bytes.
    """
    jobs = cores() if jobs is None else jobs
    if jobs < 1:
        raise SuiteError(f"jobs must be at least 1, got {jobs}")
    store = Store(results_dir)
    plan = load_suite(suite, total_timesteps=total_timesteps, seeds=seeds, agents=agents, env=env)
    for spec in plan.runs:
        store.refuse_changed(spec)
    todo = [spec for spec in plan.runs if store.state(spec) != "done"]
    done = len(plan.runs) - len(todo)
    say(
        f"[bold]{plan.name}[/]: {plan.title}. {len(plan.runs)} runs, {plan.timesteps:,} steps; "
        f"{done} done before, {len(todo)} to do, {jobs} at a time."
    )
    if dry_run:
        if todo:
            show_costs(measure(make_groups(todo, store, jobs, plain), jobs, console), jobs)
        return
    outcome = Outcome()
    if todo:
        with Progress(console, store, todo) as progress:
            outcome = run_local(make_groups(todo, store, jobs, plain), store, jobs, progress)
    own = load_suite(suite, total_timesteps=total_timesteps)
    runs = {run.run_id: run for run in [*own.runs, *plan.runs]}  # seeds beyond the suite's too
    whole = load_results(dataclasses.replace(own, runs=list(runs.values())), store)
    make_report(whole, store)
    show_others(whole)
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

    "changed" counts runs whose folder holds another configuration than the suite's.

    Args:
        suite: Names of suites; by default all.
        results_dir: Where the runs' folders are.
    """
    store = Store(results_dir)
    table = Table("suite", *STATES, "steps")
    for name in suite or suite_names():
        plan = load_suite(name)
        states = {run.run_id: store.state(run) for run in plan.runs}
        steps = sum(store.steps(run) for run in plan.runs if states[run.run_id] != "changed")
        counts = Counter(states.values())
        numbers = [str(counts[state]) for state in STATES]
        table.add_row(plan.name, *numbers, f"{steps:,} of {plan.timesteps:,}")
    console.print(table)


@app.command(name="evaluate")
def evaluate(
    run_dirs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    episodes: int = 20,
    levels: int = 500,
    repeats: int = 20,
    unseen: Unseen = "next",
    device: str = "auto",
) -> None:
    """Play the final policy of trained agents, from seeds that training does not use.

    On control tasks: episodes with the policy's mean and with sampled actions, observations clean
    and normalized as training ended, returns of raw rewards, and how smooth the actions are.

    On CoinRun: the success rate on training levels and on levels that the agent never saw. Each
    level counts equally: sampled actions are repeated, greedy ones played once, since a level is
    deterministic. A GIF shows an episode of each kind of level.

    Every episode goes to evaluation.csv in the run's folder; a second call with the same settings
    reads it.

    Args:
        run_dirs: Folders of runs, each with its checkpoint.pt.
        episodes: Control tasks: episodes with the policy's mean, and as many with sampled actions.
        levels: CoinRun: levels of each kind; fewer than the training set has are evenly spaced in
            it.
        repeats: CoinRun: episodes with sampled actions on each level.
        unseen: CoinRun: next are the levels after the training set, unbounded are drawn at random.
            For agents trained with --restrict-themes, themes are the next levels without and with
            unseen themes.
        device: CoinRun: cpu, cuda or cuda:1; auto: a GPU if there is one.
    """
    from harness.evaluation.runs import Settings, evaluate_run  # PyTorch and the simulators

    if not run_dirs:
        raise EvaluationError("name at least one folder of a run, such as results/smoke/<run id>")
    settings = Settings(episodes, levels, repeats, unseen, device)
    found: dict[str, pd.DataFrame] = {}
    with rich.progress.Progress(console=console, disable=not console.is_interactive) as bar:
        for i, path in enumerate(run_dirs, 1):
            name = path.resolve().name
            if (path / "diverged.json").exists():
                say(f"[{i}/{len(run_dirs)}] {name} diverged: it has no final policy", markup=False)
                continue

            def show(parts: Iterable[Any], total: int, name: str = name) -> Iterable[Any]:
                return bar.track(parts, total, description=name)

            found[str(path)] = evaluate_run(path, settings, show)
            say(f"[{i}/{len(run_dirs)}] {name} evaluated", markup=False)
    for table in evaluation_tables({Path(path).resolve().name: x for path, x in found.items()}):
        console.print(table)


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


@app.command(name="report")
def report(
    suite: str = DEFAULT_SUITE, results_dir: Path = Path("results"), seeds: int | None = None
) -> None:
    """Report what a suite's runs show so far, beside the paper's tables.

    Args:
        suite: Name of a suite (see `list`), or path of a TOML file.
        results_dir: Where the runs' folders are and the report goes.
        seeds: So many seeds, as in `run-all`: the suite's first, then those that follow its last.
    """
    plan, store = load_suite(suite, seeds=seeds), Store(results_dir)
    make_report(load_results(plan, store), store)


@app.command(name="cost")
def cost(
    implementation: tuple[str, ...] = ("single file", "population"),
    env: tuple[str, ...] = ("Hopper",),
    repetitions: int = 10,
    updates: int = 6,
    results_dir: Path = Path("results"),
) -> None:
    """Measure what the penalty costs: plain and regularized runs in turn, on this machine alone.

    The report's claim (e) is of this measurement where there is one. Run nothing beside it.

    Args:
        implementation: "single file", "compiled" (PPO; needs a C++ compiler) and "population".
        env: Tasks, by the names that the suite table1 uses.
        repetitions: Pairs of runs; from 6 on they have an interval.
        updates: Of each run, 2000 steps each; the first is not counted.
        results_dir: Where cost.csv goes, beside the suites' results.
    """
    plan = load_suite("table1", env=env)
    ids = {run.environment: run.args["env_id"] for run in plan.runs}
    check_known(dict.fromkeys(implementation), set(IMPLEMENTATIONS), "implementation")
    timed = measure_in_turn(ids, list(implementation), repetitions, updates, say)
    results_dir.mkdir(parents=True, exist_ok=True)
    timed.to_csv(results_dir / TIMED, index=False)
    for finding in measured_in_turn(timed):
        mean, low, high, n = finding.estimate
        say(
            f"{finding.task}, {finding.about}: {100 * mean:+.1f}% [{100 * low:+.1f}, "
            f"{100 * high:+.1f}], n {n}: {finding.verdict}"
        )


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


def main() -> None:
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # and nohup is left to work
        signal.signal(signal.SIGHUP, signal.default_int_handler)
    try:
        app.cli(prog="python -m harness", description=__doc__)
    except (SuiteError, StoreError, EvaluationError, EstimateError, CostError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        say("\nInterrupted: the same command continues from the runs' last checkpoints.")
        sys.exit(130)
