"""Whether a finished run can be continued to more steps as if it had had them from the start."""

from __future__ import annotations

from typing import Any

from harness.files import StoreError
from harness.identity import make_args
from harness.store import Store
from harness.suite import RunSpec


def refuse_extension(spec: RunSpec, store: Store) -> None:
    """Raise StoreError unless the folder's run is this one, or can become it by more steps.

    A folder that holds nothing yet is fine: the run begins at its full length.
    """
    saved, changes = store.saved(spec), store.changes(spec)
    if store.is_done(spec) or (saved and not changes):
        return
    if saved is None:
        _refuse_archived(spec, store)
        return
    if set(changes) != {"total_timesteps"}:
        store.refuse_changed(spec)

    length = saved["args"]["total_timesteps"]
    if not store.is_trained(spec.with_args(total_timesteps=length)):
        reason = f"it has not finished its {length} steps: run it with --total-timesteps {length}"
    else:
        reason = why_not(spec.baseline, saved["args"], spec.args["total_timesteps"])
    if reason:
        raise StoreError(f"{store.path(spec)} cannot be extended: {reason}")


def why_not(baseline: str, args: dict[str, Any], total_timesteps: int) -> str:
    """Why a run that finished with these arguments cannot go on; empty if it can.

    Args:
        baseline: Module in baselines/.
        args: What it was run with.
        total_timesteps: What it is to be continued to.
    """
    run = make_args(baseline, args)
    updates, interval = int(run.num_updates), int(run.checkpoint_interval)
    if total_timesteps <= run.total_timesteps:
        return f"it has {run.total_timesteps} steps, not fewer than {total_timesteps}"
    if getattr(run, "anneal_lr", False):
        return "anneal_lr makes its step sizes depend on its length"
    if getattr(run, "anneal", False) and not getattr(run, "anneal_timesteps", 0):
        return "anneal without anneal_timesteps makes its step size depend on its length"
    if updates % interval:
        return (
            f"its {updates} updates are no multiple of checkpoint_interval = {interval}, "
            "where the environments are rebuilt"
        )
    return ""


def _refuse_archived(spec: RunSpec, store: Store) -> None:
    """A run that only an archive holds has no folder to go on in."""
    for record in store.archives.shorter(spec):
        raise StoreError(
            f"{spec.run_id} cannot be extended: its {record.total_timesteps} steps are in "
            f"{record.place} only, without the folder to go on in; without --extend it is run from "
            "the start"
        )
