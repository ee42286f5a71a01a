"""The command line: run-all | list | status | evaluate | archive | cost | report."""

from __future__ import annotations

import dataclasses
import functools
import signal
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
import rich.progress
import tyro
from rich.table import Table

from harness.archive import ArchiveError
from harness.cost import IMPLEMENTATIONS, CostError, measure_in_turn
from harness.estimate import EstimateError, measure
from harness.evaluation.settings import EvaluationError, Settings, Unseen
from harness.extension import refuse_extension
from harness.launchers.groups import make_groups
from harness.launchers.local import LocalLauncher
from harness.pack import pack
from harness.progress import Progress
from harness.provenance import ROOT, cores
from harness.report.cost import measured_in_turn
from harness.report.results import TIMED, load_results
from harness.scheduler import Outcome, run_groups
from harness.schema import SuiteError, check_known, suite_names
from harness.show import (
    console,
    evaluation_tables,
    make_report,
    say,
    show_costs,
    show_others,
    show_outcome,
    show_verdicts,
)
from harness.store import STATES, Store, StoreError
from harness.suite import RunSpec, Suite, load_suite, load_suites

app = tyro.extras.SubcommandApp()
DEFAULT_SUITES = ("first", "smoke")
RESULTS = Path("results")
ARCHIVES = ROOT / "docs" / "results"
ERRORS = (  # what a person can mend, each with a sentence that says how
    SuiteError,
    StoreError,
    ArchiveError,
    EvaluationError,
    EstimateError,
    CostError,
)


@app.command(name="run-all")
def run_all(
    suite: tuple[str, ...] = DEFAULT_SUITES,
    jobs: int | None = None,
    results_dir: Path = RESULTS,
    archives: Path | None = None,
    total_timesteps: int | None = None,
    extend: bool = False,
    seeds: int | None = None,
    agents: int | None = None,
    env: tuple[str, ...] = (),
    plain: bool = False,
    dry_run: bool = False,
) -> None:
    """Run what the suites still lack, side by side, then report them on one page.

    A finished run is never run again; an interrupted one continues from its last checkpoint.
    Ctrl-C stops the runs and keeps their checkpoints: the same command continues.

    Args:
        suite: Names of suites (see `list`), or paths of TOML files. Several make one page, with a
            part for each in this order.
        jobs: Runs at a time, one core each; by default all cores.
        results_dir: Where the runs' folders and the reports go.
        archives: Where archives of finished runs are: what they hold is not run again. By default
            docs/results of this checkout.
        total_timesteps: Environment steps of each run, instead of the suite's.
        extend: Continue finished runs to --total-timesteps, as if they had had them from the start.
            The shorter runs' scores and evaluations are kept.
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
    if extend and total_timesteps is None:
        raise SuiteError("--extend needs --total-timesteps: the length to continue the runs to")
    store = Store(results_dir, archives or ARCHIVES)
    plans = load_suites(suite, total_timesteps=total_timesteps, seeds=seeds, agents=agents, env=env)
    runs = _distinct(plans.values())
    for spec in runs:
        if extend:
            refuse_extension(spec, store)
        else:
            store.refuse_changed(spec)
    todo = [spec for spec in runs if not store.is_done(spec)]
    groups = make_groups(todo, store, jobs, plain)
    for plan in plans.values():
        say(f"[bold]{plan.name}[/]: {plan.title}. {len(plan.runs)} runs, {plan.timesteps:,} steps.")
    say(f"{len(runs) - len(todo)} done before, {len(todo)} to do, {jobs} at a time.")
    if dry_run:
        if todo:
            show_costs(measure(groups, jobs, console), jobs)
        return

    outcome = Outcome()
    if todo:
        members = [spec for group in groups for spec in group]  # those that share a run's process
        with Progress(console, store, members) as progress:
            outcome = run_groups(groups, store, LocalLauncher(jobs), progress)

    suites = [_whole(name, plan, total_timesteps) for name, plan in plans.items()]
    found = [load_results(one, store) for one in suites]
    report = make_report(found, store)
    show_others(found)
    show_outcome(outcome, store)
    show_verdicts(report)
    if outcome.failed:
        raise SystemExit(1)


def _distinct(plans: Iterable[Suite]) -> list[RunSpec]:
    """The runs of all suites, each once: what a suite includes may be asked for as well."""
    return list({(run.suite, run.run_id): run for plan in plans for run in plan.runs}.values())


def _whole(name: str, plan: Suite, total_timesteps: int | None) -> Suite:
    """The whole suite, of which a plan may be a part, and the plan's seeds beyond its own."""
    own = load_suite(name, total_timesteps=total_timesteps)
    runs = {run.run_id: run for run in [*own.runs, *plan.runs]}
    return dataclasses.replace(own, runs=list(runs.values()))


@app.command(name="list")
def list_suites() -> None:
    """List the suites: how many runs and steps each takes."""
    table = Table("suite", "what it is", "runs", "steps")
    for name in suite_names():
        plan = load_suite(name)
        table.add_row(name, plan.title, str(len(plan.runs)), f"{plan.timesteps:,}")
    console.print(table)


@app.command(name="status")
def status(
    suite: tuple[str, ...] = (), results_dir: Path = RESULTS, archives: Path | None = None
) -> None:
    """Tell how far each suite is: runs done, running, failed, interrupted and pending.

    "diverged" counts runs that ended since their own numbers became non-finite, which is an
    outcome, and "changed" those whose folder holds another configuration than the suite's.

    Args:
        suite: Names of suites; by default all.
        results_dir: Where the runs' folders are.
        archives: Where archives of finished runs are; by default docs/results of this checkout.
    """
    store = Store(results_dir, archives or ARCHIVES)
    rows: dict[str, tuple[Counter[str], str]] = {}
    for name in suite or suite_names():
        plan = load_suite(name)
        states = {run.run_id: store.state(run) for run in plan.runs}
        steps = sum(store.steps(run) for run in plan.runs if states[run.run_id] != "changed")
        rows[plan.name] = Counter(states.values()), f"{steps:,} of {plan.timesteps:,}"

    always = {"done", "pending"}
    shown = [x for x in STATES if x in always or any(counts[x] for counts, _ in rows.values())]
    table = Table("suite", *shown, "steps")
    for name, (counts, done) in rows.items():
        table.add_row(name, *[str(counts[state]) for state in shown], done)
    console.print(table)


@app.command(name="evaluate")
def evaluate(
    run_dirs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    episodes: int = 20,
    levels: int = 500,
    repeats: int = 20,
    unseen: Unseen = "next",
    device: str = "auto",
    attack: str = "",
    radius: str = "",
    norm: Literal["linf", "l2"] = "linf",
) -> None:
    """Play the final policy of trained agents, from seeds that training does not use.

    On control tasks: episodes with the policy's mean and with sampled actions, observations clean
    and normalized as training ended, returns of raw rewards, and how smooth the actions are.

    On CoinRun: the success rate on training levels and on levels that the agent never saw. Each
    level counts equally: sampled actions are repeated, greedy ones played once, since a level is
    deterministic. A GIF shows an episode of each kind of level.

    Every episode goes to evaluation.csv in the run's folder; a second call with the same settings
    reads it.

    With --attack, on control tasks: episodes with the policy's mean where an adversary perturbs
    what the agent sees, after it is normalized. They go to robustness.csv.

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
        attack: Some of random, mad (the largest change of the action), critic (the lowest value)
            and sarsa (the worst action by a Q that is learnt for it), such as random,mad,critic.
        radius: Sizes of the perturbation, in deviations of the observations; by default 0,0.05,0.1.
        norm: What a perturbation's size is: of its largest number, or its Euclidean length.
    """
    from harness.evaluation.robustness import evaluate_robustness, parse_threat
    from harness.evaluation.runs import evaluate_run  # PyTorch and the simulators

    threat = parse_threat(attack, radius, norm)
    judge = functools.partial(evaluate_robustness, threat=threat) if threat else evaluate_run
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

            found[str(path)] = judge(path, settings, show=show)
            say(f"[{i}/{len(run_dirs)}] {name} evaluated", markup=False)
    for table in evaluation_tables({Path(path).resolve().name: x for path, x in found.items()}):
        console.print(table)


@app.command(name="archive")
def archive(
    suite: Annotated[str, tyro.conf.Positional],
    results_dir: Path = RESULTS,
    archives: Path | None = None,
    total_timesteps: int | None = None,
    seeds: int | None = None,
    agents: int | None = None,
    env: tuple[str, ...] = (),
    with_checkpoints: bool = False,
) -> None:
    """Write a suite's finished runs to compact files, which `run-all` and `report` read.

    A file holds the runs of one algorithm on one task, and is written once, when all are finished:
    exact scores, curves of at most 100 points, evaluations, and what the runs were made with. Runs
    that are finished later, such as those of more seeds, go to a file of their own.

    Args:
        suite: Name of a suite (see `list`), or path of a TOML file.
        results_dir: Where the runs' folders are.
        archives: Where the files go, in a folder for each suite; by default docs/results of this
            checkout.
        total_timesteps: Environment steps of each run, as in `run-all`.
        seeds: So many seeds, as in `run-all`.
        agents: Only so many agents for each seed.
        env: Only these tasks, such as Hopper.
        with_checkpoints: Write the final checkpoints too, to a ZIP file beside each.
    """
    plan = load_suite(suite, total_timesteps=total_timesteps, seeds=seeds, agents=agents, env=env)
    root = archives or ARCHIVES
    for packed in pack(plan, Store(results_dir, root), root, with_checkpoints):
        say(packed.text, markup=False)


@app.command(name="report")
def report(
    suite: tuple[str, ...] = DEFAULT_SUITES,
    results_dir: Path = RESULTS,
    archives: Path | None = None,
    total_timesteps: int | None = None,
    seeds: int | None = None,
    agents: int | None = None,
) -> None:
    """Report what the runs of suites show so far, beside the paper's tables.

    Args:
        suite: Names of suites (see `list`), or paths of TOML files. Several make one page, with a
            part for each in this order.
        results_dir: Where the runs' folders are and the report goes.
        archives: Where archives of finished runs are; by default docs/results of this checkout.
        total_timesteps: The runs of so many steps each, as in `run-all`.
        seeds: So many seeds, as in `run-all`: the suite's first, then those that follow its last.
        agents: Only so many agents for each seed, as in `run-all`.
    """
    store = Store(results_dir, archives or ARCHIVES)
    plans = load_suites(suite, total_timesteps=total_timesteps, seeds=seeds, agents=agents)
    show_verdicts(make_report([load_results(plan, store) for plan in plans.values()], store))


@app.command(name="cost")
def cost(
    implementation: tuple[str, ...] = ("single file", "population"),
    env: tuple[str, ...] = ("Hopper",),
    repetitions: int = 10,
    updates: int = 6,
    results_dir: Path = RESULTS,
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


def main() -> None:
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # and nohup is left to work
        signal.signal(signal.SIGHUP, signal.default_int_handler)
    try:
        app.cli(prog="python -m harness", description=__doc__)
    except ERRORS as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        say("\nInterrupted: the same command continues from the runs' last checkpoints.")
        sys.exit(130)
