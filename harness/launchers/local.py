"""Groups side by side on this machine, each a process of its own with its share of the cores."""

from __future__ import annotations

import time

from harness.launchers.groups import Group
from harness.provenance import cores
from harness.store import Store
from harness.work import GRACE, States, Work


class LocalLauncher:
    """Starts groups as child processes.

    Args:
        jobs: Groups at a time; each may use an equal share of the cores.
    """

    def __init__(self, jobs: int) -> None:
        self.slots = jobs
        self.threads = max(1, cores() // jobs)

    def start(self, group: Group, store: Store) -> LocalHandle | None:
        work = Work.begin(group, store, self.threads)
        return None if work is None else LocalHandle(work)


class LocalHandle:
    """A group in a child process."""

    def __init__(self, work: Work) -> None:
        self.group = work.group
        self._work = work
        self._deadline = 0.0

    def poll(self) -> States | None:
        return self._work.finish() if self._work.ended() else None

    def terminate(self) -> None:
        self._work.terminate()
        self._deadline = time.monotonic() + GRACE

    def stop(self) -> None:
        self._work.stop(self._deadline - time.monotonic())
