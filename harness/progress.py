"""What run-all shows while it works: a live bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

import rich.progress
from rich.console import Console

from harness.store import Store
from harness.suite import RunSpec

PLAIN_INTERVAL = 30.0  # seconds between two lines where there is no terminal
LIVE_INTERVAL = 0.5


class Progress:
    """Runs done, environment steps, steps/s and time left, over all runs of one or more suites.

    Steps are read from the runs' own metrics.csv, so they grow by an update at a time.
    """

    def __init__(self, console: Console, store: Store, specs: list[RunSpec]) -> None:
        self.console, self.store, self.specs = console, store, specs
        self.steps = {_key(spec): store.steps(spec) for spec in specs}
        self.total = sum(spec.args["total_timesteps"] for spec in specs)
        self.first = sum(self.steps.values())
        self.started = time.monotonic()
        self.ended_runs = 0
        self.shown = 0.0
        self.several = len({spec.suite for spec in specs}) > 1
        self.bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            rich.progress.TextColumn("{task.fields[speed]}"),
            rich.progress.TimeElapsedColumn(),
            console=console,
            disable=not console.is_interactive,
        )
        self.task = self.bar.add_task("", total=self.total, completed=self.first, speed="")

    def __enter__(self) -> Progress:
        self.bar.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._show()  # the last state, not the one of half a second ago
        self.bar.__exit__(kind, error, traceback)

    def ended(self, spec: RunSpec, how: str) -> None:
        """Say that a run is over."""
        self.ended_runs += 1
        done = self.store.is_done(spec)  # whole updates may end short of the total
        self.steps[_key(spec)] = spec.args["total_timesteps"] if done else self.store.steps(spec)
        name = "/".join(_key(spec)) if self.several else spec.run_id
        line = f"[{self.ended_runs}/{len(self.specs)}] {name}  {how}"
        self.bar.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def update(self, running: list[RunSpec]) -> None:
        """Show how far all is, at most every half second, or every half minute in plain lines."""
        now = time.monotonic()
        interval = LIVE_INTERVAL if self.console.is_interactive else PLAIN_INTERVAL
        if now - max(self.shown, self.started) < interval:
            return
        self.shown = now
        self.steps |= {_key(spec): self.store.steps(spec) for spec in running}
        line = self._show()
        if not self.console.is_interactive:
            self.console.print(line, highlight=False, soft_wrap=True)

    def _show(self) -> str:
        done, seconds = sum(self.steps.values()), time.monotonic() - self.started
        rate = (done - self.first) / seconds if seconds else 0.0
        left = f"{duration((self.total - done) / rate)} left" if rate else "starting"
        what, speed = f"{self.ended_runs}/{len(self.specs)} runs", f"{rate:,.0f} steps/s, {left}"
        self.bar.update(self.task, completed=done, description=what, speed=speed)
        return f"{what}  {100 * done / self.total:.0f}%  {speed}"


def _key(spec: RunSpec) -> tuple[str, str]:
    """Suite and run id: suites have runs of the same name."""
    return spec.suite, spec.run_id


def duration(seconds: float) -> str:
    """Seconds as a person would say them: "40 s", "12 min", "3.5 h", "9 days"."""
    for limit, unit, name, digits in (
        (90, 1, "s", 0),
        (5400, 60, "min", 0),
        (172800, 3600, "h", 1),
    ):
        if seconds < limit:
            return f"{seconds / unit:.{digits}f} {name}"
    return f"{seconds / 86400:,.0f} days"
