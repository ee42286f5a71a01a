"""Runs side by side on this machine, each a process of its own with its share of the cores."""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from harness.launchers.groups import Group, commands
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
    group: Group
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


def cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def run_local(groups: list[Group], store: Store, jobs: int, progress: Progress) -> Outcome:
    """Run the groups, `jobs` at a time; whatever ends this early stops the children first.

    A child that is stopped keeps its last checkpoint, and goes on from it when it is run again.
    """
    waiting, children, outcome = deque(groups), [], Outcome()
    with _stopping(children):
        while waiting or children:
            while waiting and len(children) < jobs:
                group = waiting.popleft()
                child = _start(group, store, max(1, cores() // jobs))
                if child is not None:
                    children.append(child)
                    continue
                if len(group) > 1:  # some are another launcher's: see each for itself
                    waiting.extendleft([spec] for spec in reversed(group))
                    continue
                for spec in group:
                    done = store.is_done(spec)
                    (outcome.done if done else outcome.held).append(spec)
                    how = "done by" if done else "being run by"
                    progress.ended(spec, f"{how} another process")
            for child in [c for c in children if c.ended()]:
                children.remove(child)
                seconds = time.monotonic() - child.started
                good = child.process.returncode == 0
                for spec in child.group:
                    store.finish(spec, child.process.returncode, seconds / len(child.group))
                    (outcome.done if good else outcome.failed).append(spec)
                child.resources.close()
                for spec in child.group:
                    progress.ended(spec, f"{'done' if good else 'FAILED'} in {seconds:.0f} s")
            progress.update([spec for child in children for spec in child.group])
            time.sleep(0.1)
    return outcome


def _start(group: Group, store: Store, threads: int) -> _Child | None:
    with contextlib.ExitStack() as stack:
        locks = [stack.enter_context(store.lock(spec)) for spec in group]
        if None in locks or any(map(store.is_done, group)):  # by another launcher since the plan
            return None
        first, *then = commands(group, store)
        for spec in group:
            store.start(spec, first, group)
        log = stack.enter_context(open(store.path(group[0], "log.txt"), "ab"))
        start = functools.partial(
            subprocess.Popen[bytes],
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for run-all, which stops them in turn
            pass_fds=locks,
        )
        return _Child(group, start(first), then, start, stack.pop_all(), time.monotonic())


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
