"""Runs side by side on this machine, each a process of its own with its share of the cores."""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from harness.progress import Progress
from harness.store import Store
from harness.suite import RunSpec

ROOT = Path(__file__).parents[2]  # the checkout
GRACE = 15.0  # seconds that a run has to end itself


@dataclass
class Outcome:
    """What became of the runs that were started, and of those that were not."""

    done: list[RunSpec] = field(default_factory=list)
    failed: list[RunSpec] = field(default_factory=list)
    held: list[RunSpec] = field(default_factory=list)
    """locked by another process, which runs them"""


@dataclass
class _Child:
    spec: RunSpec
    process: subprocess.Popen[bytes]
    then: list[list[str]]
    """commands that follow, each if the one before it succeeds"""
    start: Callable[[list[str]], subprocess.Popen[bytes]]
    resources: contextlib.ExitStack
    started: float

    def ended(self) -> bool:
        """Whether the last of its commands has ended, or one has failed; begins the next."""
        if self.process.poll() is None:
            return False
        if self.process.returncode or not self.then:
            return True
        self.process = self.start(self.then.pop(0))
        return False


def commands(spec: RunSpec, store: Store) -> list[list[str]]:
    """What runs it, one after the other, in the checkout's folder; a person can type it too."""
    path = str(store.path(spec).resolve())
    train = [f"baselines.{spec.baseline}", *spec.flags, "--run-dir", path, "--resume"]
    made = [[sys.executable, "-m", *train]]
    if spec.evaluation:
        flags = [word for name, x in spec.evaluation.items() for word in (f"--{name}", str(x))]
        made.append([sys.executable, "-m", "harness", "evaluate", path, *flags])
    return made


def run_local(specs: list[RunSpec], store: Store, jobs: int, progress: Progress) -> Outcome:
    """Run them, `jobs` at a time; whatever ends this early stops the children first.

    A child that is stopped keeps its last checkpoint, and goes on from it when it is run again.
    """
    waiting, children, outcome = deque(specs), [], Outcome()
    with _stopping(children):
        while waiting or children:
            while waiting and len(children) < jobs:
                spec = waiting.popleft()
                child = _start(spec, store, max(1, (os.cpu_count() or 1) // jobs))
                if child is not None:
                    children.append(child)
                elif store.is_done(spec):
                    outcome.done.append(spec)
                    progress.ended(spec, "done by another process")
                else:
                    outcome.held.append(spec)
                    progress.ended(spec, "being run by another process")
            for child in [c for c in children if c.ended()]:
                children.remove(child)
                seconds = time.monotonic() - child.started
                store.finish(child.spec, child.process.returncode, seconds)
                child.resources.close()
                good = child.process.returncode == 0
                (outcome.done if good else outcome.failed).append(child.spec)
                progress.ended(child.spec, f"{'done' if good else 'FAILED'} in {seconds:.0f} s")
            progress.update([child.spec for child in children])
            time.sleep(0.1)
    return outcome


def _start(spec: RunSpec, store: Store, threads: int) -> _Child | None:
    with contextlib.ExitStack() as stack:
        lock = stack.enter_context(store.lock(spec))
        if lock is None or store.is_done(spec):  # by another launcher since the plan was made
            return None
        first, *then = commands(spec, store)
        store.start(spec, first)
        log = stack.enter_context(open(store.path(spec, "log.txt"), "ab"))
        start = functools.partial(
            subprocess.Popen[bytes],
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for run-all, which stops them in turn
            pass_fds=[lock],
        )
        return _Child(spec, start(first), then, start, stack.pop_all(), time.monotonic())


@contextlib.contextmanager
def _stopping(children: list[_Child]) -> Iterator[None]:
    try:
        yield
    finally:
        for child in children:
            child.process.terminate()
        deadline = time.monotonic() + GRACE
        for child in children:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
            child.resources.close()
