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

from harness.launchers.groups import Group, commands
from harness.progress import Progress
from harness.provenance import ROOT, cores
from harness.store import Store
from harness.suite import RunSpec

GRACE = 15.0  # seconds that a run has to end itself


@dataclass
class Outcome:
    """What became of the runs that were started, and of those that were not."""

    done: list[RunSpec] = field(default_factory=list)
    """those that diverged too: that is an outcome"""
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


def run_local(groups: list[Group], store: Store, jobs: int, progress: Progress) -> Outcome:
    """Run the groups, `jobs` at a time; whatever ends this early stops the children first.

    A child that is stopped keeps its last checkpoint, and goes on from it when it is run again.
    """
    waiting, outcome = deque(groups), Outcome()
    children: list[_Child] = []
    with _stopping(children):
        while waiting or children:
            while waiting and len(children) < jobs:
                group = waiting.popleft()
                if child := _start(group, store, max(1, cores() // jobs)):
                    children.append(child)
                elif len(group) > 1 and not _is_begun(group, store):
                    # Some are another launcher's, so see each for itself.
                    waiting.extendleft([spec] for spec in reversed(group))
                else:
                    _leave(group, store, outcome, progress)

            for child in [c for c in children if c.ended()]:
                children.remove(child)
                _finish(child, store, outcome, progress)

            progress.update([spec for child in children for spec in child.group])
            time.sleep(0.1)
    return outcome


def _leave(group: Group, store: Store, outcome: Outcome, progress: Progress) -> None:
    """Account for runs that another process has, or that must not be started."""
    for spec in group:
        done = store.is_done(spec)
        (outcome.done if done else outcome.held).append(spec)
        how = "done by" if done else "being run by"
        progress.ended(spec, f"{how} another process")


def _finish(child: _Child, store: Store, outcome: Outcome, progress: Progress) -> None:
    """Mark the runs of a child that has ended, and say so."""
    seconds = time.monotonic() - child.started
    states = {}
    for spec in child.group:
        if store.is_done(spec):  # before the others of its group, which a kill left behind
            states[spec.run_id] = store.state(spec)
        else:
            returncode = child.process.returncode
            states[spec.run_id] = store.finish(spec, returncode, seconds / len(child.group))

    child.resources.close()
    for spec in child.group:
        state = states[spec.run_id]
        (outcome.failed if state == "failed" else outcome.done).append(spec)
        progress.ended(spec, f"{state.replace('failed', 'FAILED')} in {seconds:.0f} s")


def _start(group: Group, store: Store, threads: int) -> _Child | None:
    """Begin to train a group, or to continue it; None where another process has a part in it."""
    with contextlib.ExitStack() as stack:
        locks = [stack.enter_context(store.lock(spec)) for spec in group]
        if None in locks or not _may_start(group, store):
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


def _is_begun(group: Group, store: Store) -> bool:
    """Whether it was begun as this very group."""
    agents = [spec.args["agent"] for spec in group]
    return any(store.members(spec) == agents for spec in group)


def _may_start(group: Group, store: Store) -> bool:
    """Whether the group is still as it was when it was planned: another launcher may have come."""
    agents = [spec.args["agent"] for spec in group]
    if any(store.members(spec) not in ([], agents) for spec in group):
        return False  # begun with others since
    if any(set(store.changes(spec)) - {"total_timesteps"} for spec in group):
        return False  # begun with other settings since

    done = [store.is_done(spec) for spec in group]
    return not all(done) if _is_begun(group, store) else not any(done)


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
