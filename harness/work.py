"""One group of runs on this machine, from its locks to its marks: what every launcher starts.

The process that trains the group inherits its locks, so a run whose launcher was killed is not
started a second time beside it.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from typing import IO

from harness.launchers.groups import Group, commands
from harness.provenance import ROOT
from harness.store import Store

GRACE = 15.0  # seconds that a process has to end itself
POLL = 0.1  # seconds between two looks at a process

States = dict[str, str]
"""what became of each run of a group, by run id: done, diverged, failed, or held by another"""


class Work:
    """A group that is being trained: its commands run one after the other."""

    def __init__(
        self, group: Group, store: Store, threads: int, locks: list[int], log: IO[bytes]
    ) -> None:
        self.group = group
        self._store = store
        self._threads = threads
        self._locks = locks
        self._log = log
        self._resources = contextlib.ExitStack()
        self._started = time.monotonic()

        first, *self._then = commands(group, store)
        for spec in group:
            store.start(spec, first, group)
        self._process = self._launch(first)

    @classmethod
    def begin(cls, group: Group, store: Store, threads: int) -> Work | None:
        """Begin or continue a group; None where another process has a part in it.

        Args:
            group: Agents that are trained together, or a single run.
            store: Where their folders are.
            threads: How many each process may use.
        """
        with contextlib.ExitStack() as stack:
            locks = [stack.enter_context(store.lock(spec)) for spec in group]
            if None in locks or not _may_start(group, store):
                return None

            log = stack.enter_context(open(store.path(group[0], "log.txt"), "ab"))
            work = cls(group, store, threads, [lock for lock in locks if lock is not None], log)
            work._resources = stack.pop_all()
            return work

    def ended(self) -> bool:
        """Whether the last command has ended, or one has failed; begins the next."""
        if self._process.poll() is None:
            return False
        if self._process.returncode or not self._then:
            return True
        self._process = self._launch(self._then.pop(0))
        return False

    def finish(self) -> States:
        """Mark the runs, give their locks back, and say what became of them."""
        seconds = time.monotonic() - self._started
        states = {}
        for spec in self.group:
            if self._store.is_done(spec):  # before the others of its group, which a kill left
                states[spec.run_id] = self._store.state(spec)
            else:
                returncode = self._process.returncode
                share = seconds / len(self.group)
                states[spec.run_id] = self._store.finish(spec, returncode, share)
        self._resources.close()
        return states

    def terminate(self) -> None:
        """Ask the process to end: it keeps its last checkpoint."""
        self._process.terminate()

    def stop(self, seconds: float) -> None:
        """Wait for a process that was asked to end, kill it if it does not, and drop the locks."""
        try:
            self._process.wait(max(0.0, seconds))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._resources.close()

    def _launch(self, command: list[str]) -> subprocess.Popen[bytes]:
        threads = str(self._threads)
        return subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": threads, "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for run-all, which stops them in turn
            pass_fds=self._locks,
        )


def is_begun(group: Group, store: Store) -> bool:
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
    return not all(done) if is_begun(group, store) else not any(done)
