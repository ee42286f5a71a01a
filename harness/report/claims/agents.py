"""A row for each agent, and the scores of those that failed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from harness.report.results import Results
from harness.statistics import final_score
from harness.suite import RunSpec

COLUMNS = {
    "environment": str, "algorithm": str, "plain": bool, "seed": int, "agent": int, "done": bool,
    "failed": bool, "updates": int, "steps": int, "reward": float, "final": float,
    "final_sampled": float, "psi": float, "early_psi": float, "together": float,
}  # fmt: skip


def agent_table(results: Results) -> pd.DataFrame:
    """A row for each agent that has begun.

    `reward` is the training score, `final` and `final_sampled` the final policy's mean return,
    `psi` and `early_psi` are means over the score's window and over the first tenth of the steps,
    `together` is the correlation of their changes, `failed` is whether its own numbers became
    non-finite. Such an agent counts as done, and has no score of its own: see `fill_failed`.
    """
    rows = [
        _row(run, results)
        for run in results.suite.runs
        if run.run_id in results.metrics or run.run_id in results.diverged
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)


def _row(run: RunSpec, results: Results) -> dict[str, Any]:
    scores = results.scores.get(run.run_id, {})
    failed = run.run_id in results.diverged
    episodes = results.evaluations.get(run.run_id)
    played = episodes is not None and not failed and "episode" in episodes

    return {
        "environment": run.environment,
        "algorithm": run.algorithm,
        "plain": run.args.get("coefficient") == 0 and not run.args.get("perturb_obs"),
        "seed": run.args["seed"],
        "agent": run.args["agent"],
        "done": failed or run.run_id in results.done,
        "failed": failed,
        "updates": scores.get("updates", 0),
        "steps": scores.get("steps", 0),
        "reward": np.nan if failed else scores.get("training_score", np.nan),
        "final": final_score(episodes) if played else np.nan,
        "final_sampled": final_score(episodes, "sampled") if played else np.nan,
        "psi": scores.get("last_psi" if failed else "psi", np.nan),
        "early_psi": scores.get("early_psi", np.nan),
        "together": scores.get("together", np.nan),
    }


def fill_failed(agents: pd.DataFrame, column: str) -> pd.DataFrame:
    """The agents, those that failed with the worst score of their task among all that are given.

    Hand it the compared arms only. Where every run of a task failed they are all equal: 0.
    """
    if not agents["failed"].any():
        return agents
    worst = agents.groupby("environment")[column].transform("min").fillna(0.0)
    scores = agents[column].where(~agents["failed"], worst)
    return agents.assign(**{column: scores})
