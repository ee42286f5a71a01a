"""Which groups run when, and what became of them; a launcher says where."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

from harness.launchers.groups import Group
from harness.progress import Progress
from harness.store import Store
from harness.suite import RunSpec
from harness.work import POLL, States, is_begun


@dataclass
class Outcome:
    """What became of the runs that were started, and of those that were not."""

    done: list[RunSpec] = field(default_factory=list)
    """those that diverged too: that is an outcome"""
    failed: list[RunSpec] = field(default_factory=list)
    held: list[RunSpec] = field(default_factory=list)
    """locked by another process, which runs them"""


class Handle(Protocol):
    """A group that a launcher has started."""

    group: Group

    def poll(self) -> States | None:
        """What became of its runs; None while it goes on."""

    def terminate(self) -> None:
        """Ask it to stop and to keep its last checkpoints."""

    def stop(self) -> None:
        """Wait until it has stopped, for a while, then make it stop."""


class Launcher(Protocol):
    """Starts groups of runs somewhere."""

    slots: int
    """groups that may run at a time"""

    def start(self, group: Group, store: Store) -> Handle | None:
        """Start a group; None where another process has a part in it."""


def run_groups(
    groups: list[Group], store: Store, launcher: Launcher, progress: Progress
) -> Outcome:
    """Run the groups, as many at a time as the launcher has slots.

    Whatever ends this early stops the groups first. They keep their last checkpoints, and go on
    from these when they are run again.
    """
    waiting = deque(groups)
    outcome = Outcome()
    handles: list[Handle] = []
    started: dict[int, float] = {}
    with _stopping(handles):
        while waiting or handles:
            while waiting and len(handles) < launcher.slots:
                group = waiting.popleft()
                if handle := launcher.start(group, store):
                    handles.append(handle)
                    started[id(handle)] = time.monotonic()
                elif len(group) > 1 and not is_begun(group, store):
                    # Some are another launcher's, so see each for itself.
                    waiting.extendleft([spec] for spec in reversed(group))
                else:
                    _leave(group, store, outcome, progress)

            for handle in list(handles):
                states = handle.poll()
                if states is not None:
                    handles.remove(handle)
                    seconds = time.monotonic() - started.pop(id(handle))
                    _end(handle.group, states, seconds, outcome, progress)

            progress.update([spec for handle in handles for spec in handle.group])
            time.sleep(POLL)
    return outcome


def _leave(group: Group, store: Store, outcome: Outcome, progress: Progress) -> None:
    """Account for runs that another process has, or that must not be started."""
    for spec in group:
        done = store.is_done(spec)
        (outcome.done if done else outcome.held).append(spec)
        how = "done by" if done else "being run by"
        progress.ended(spec, f"{how} another process")


def _end(
    group: Group, states: States, seconds: float, outcome: Outcome, progress: Progress
) -> None:
    """Account for runs that have ended, and say so."""
    for spec in group:
        state = states[spec.run_id]
        (outcome.failed if state == "failed" else outcome.done).append(spec)
        progress.ended(spec, f"{state.replace('failed', 'FAILED')} in {seconds:.0f} s")


@contextlib.contextmanager
def _stopping(handles: list[Handle]) -> Iterator[None]:
    try:
        yield
    finally:
        for handle in handles:
            handle.terminate()
        for handle in handles:
            handle.stop()
