"""Arms of an ablation against their plain algorithm, by one yardstick."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd

from harness.report.claims.agents import agent_table, fill_failed
from harness.report.published import paper_numbers
from harness.report.results import Results
from harness.report.tables.text import interval, number
from harness.statistics import Estimate, detectable_difference, estimate_mean, sign_flip_interval

BASE = "PPO"
NOTES = (
    "Differences are paired by seed and agent: the arm less what it is against. [Brackets] hold "
    "the 95% interval that inverts the sign-flip test, for each number by itself: among so many "
    "arms some leave out 0 by chance. Fewer than 6 pairs have none. A failed run has its task's "
    "worst score.",
    "Psi and J are those of the paper's settings in every arm, so that arms are comparable; own "
    "psi is what the arm itself trains on. Final policies are scored on clean observations.",
)


@dataclasses.dataclass(frozen=True)
class Arm:
    """One arm on one task."""

    task: str
    arm: str
    against: str
    """the algorithm without the penalty that it is compared with"""
    reward: Estimate
    """difference of the training score"""
    final: Estimate
    """difference of the final policy's score"""
    detectable: float
    """difference of the training score that would have been found with 80% power"""
    failed: int
    """runs of both whose own numbers became non-finite"""
    psi: Estimate
    """by the yardstick, of the arm itself"""
    plain_psi: float
    """the mean of what it is compared with"""
    quotient: float
    """its median J"""
    own_psi: float


def arm_names(results: Results) -> dict[str, str]:
    """What each arm of the suite is compared with, by the arm's name; {} where there are none.

    Arms are the algorithms that the paper's tables do not name. "PPO reg, gain 1" is compared with
    "PPO, gain 1" if there is such an arm, and any other one with PPO.
    """
    names = results.suite.algorithms
    if BASE not in names:
        return {}
    found = {}
    for name in names:
        if name not in paper_numbers("table1"):
            plain = name.replace(" reg", "")
            found[name] = plain if plain in names and plain != name else BASE
    return found


def make_arms(results: Results) -> list[Arm]:
    """A row for each arm and task that has any finished pair."""
    against = arm_names(results)
    agents = agent_table(results)
    agents = agents[agents["done"] & agents["algorithm"].isin({*against, *against.values()})]
    filled = {column: fill_failed(agents, column) for column in ("reward", "final")}
    arms = []
    for task in results.suite.environments:
        for name, plain in against.items():
            reward, final = (
                _differences(filled[column], task, name, plain, column) for column in filled
            )
            if len(reward):
                arms.append(_arm(results, agents, (task, name, plain), reward, final))
    return arms


def _differences(agents: pd.DataFrame, task: str, name: str, plain: str, column: str) -> np.ndarray:
    """Of each pair that has both scores."""
    of_task = agents[agents["environment"] == task].set_index(["seed", "agent"])
    arm = of_task.loc[of_task["algorithm"] == name, column]
    base = of_task.loc[of_task["algorithm"] == plain, column]
    return (arm - base).dropna().to_numpy(float)


def _arm(
    results: Results,
    agents: pd.DataFrame,
    key: tuple[str, str, str],
    reward: np.ndarray,
    final: np.ndarray,
) -> Arm:
    task, name, plain = key
    of_task = agents[agents["environment"] == task]
    own = of_task[of_task["algorithm"] == name]
    both = of_task[of_task["algorithm"].isin((name, plain))]
    spread = float(reward.std(ddof=1)) if len(reward) > 1 else np.nan
    return Arm(
        task, name, plain, _paired(reward), _paired(final),
        detectable=float(detectable_difference(np.array(spread), np.array(len(reward)))),
        failed=int(both["failed"].sum()),
        psi=estimate_mean(own["psi"].dropna().to_numpy()),
        plain_psi=float(of_task.loc[of_task["algorithm"] == plain, "psi"].mean()),
        quotient=_at_the_end(results, task, name, "quotient_q50"),
        own_psi=_at_the_end(results, task, name, "own_psi"),
    )  # fmt: skip


def _paired(differences: np.ndarray) -> Estimate:
    if not len(differences):
        return Estimate(np.nan, np.nan, np.nan, 0)
    low, high = (float(end) for end in sign_flip_interval(differences))
    return Estimate(float(differences.mean()), low, high, len(differences))


def _at_the_end(results: Results, task: str, name: str, column: str) -> float:
    """Mean over agents of what they logged in the training score's window."""
    values = [
        results.scores[run.run_id].get(f"final/conditioning/{column}", np.nan)
        for run in results.suite.runs
        if (run.environment, run.algorithm) == (task, name) and run.run_id in results.scores
    ]
    return float(np.nanmean(values)) if not np.isnan(values).all() else np.nan


def to_rows(arms: list[Arm]) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each arm and task."""
    header = ["arm", "task", "against", "training score", "final policy", "psi", "psi, plain",
              "median J", "own psi"]  # fmt: skip
    rows = []
    for arm in arms:
        rests = f"(n {arm.reward.n}, {arm.failed} failed, finds {number(arm.detectable)})"
        rows.append(
            [
                arm.arm, arm.task, arm.against, f"{interval(*arm.reward[:3])} {rests}",
                interval(*arm.final[:3]), interval(*arm.psi[:3]),
                number(arm.plain_psi), number(arm.quotient), number(arm.own_psi),
            ]
        )  # fmt: skip
    return header, rows


def to_frame(arms: list[Arm]) -> pd.DataFrame:
    """A row for each arm and task, for CSV."""
    rows = []
    for arm in arms:
        row = {"task": arm.task, "arm": arm.arm, "against": arm.against}
        for name in ("reward", "final", "psi"):
            mean, low, high, n = getattr(arm, name)
            row |= {name: mean, f"{name}_low": low, f"{name}_high": high, f"{name}_n": n}
        rows.append(
            {
                **row,
                "plain_psi": arm.plain_psi,
                "median_quotient": arm.quotient,
                "own_psi": arm.own_psi,
                "detectable": arm.detectable,
                "failed": arm.failed,
            }
        )
    return pd.DataFrame(rows)
