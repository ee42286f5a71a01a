"""What returns are worth under attack: the strongest attack on each agent, and the median agent."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd

from harness.files import read_json
from harness.report.results import Results
from harness.report.tables.text import number

COLUMNS = [
    "task", "algorithm", "run", "norm", "attack", "radius", "return", "action_change", "smoothness"
]  # fmt: skip
NORMS = {"linf": "l∞", "l2": "l2"}
NOTES = (
    "Returns of the deterministic policy where an adversary adds to each normalized observation a "
    "perturbation of at most this radius, in deviations of the observations. The strongest attack "
    "is chosen for each agent and radius by its mean return. A row is of the median agent under "
    "it, as in Zhang et al. (2020); of an even number the lower one. Retained is its return under "
    "the strongest attack as a share of its own without attack, where neither is below 0.",
    "psi is the median agent's at the end of training. Sm and |Δa| are of its actions without "
    "attack: smaller is smoother.",
)


@dataclasses.dataclass(frozen=True)
class Standing:
    """The median agent of one algorithm on one task, under the strongest attack of one radius."""

    task: str
    algorithm: str
    norm: str
    radius: float
    agents: int
    run: str
    """the median agent's"""
    clean: float
    """its return at radius 0; NaN where that was not played"""
    returns: dict[str, float]
    """its return under each attack"""
    strongest: str
    """the attack with its lowest return"""
    psi: float
    action_change: float
    """at radius 0"""
    smoothness: float
    """at radius 0"""


def robustness_frame(results: Results) -> pd.DataFrame:
    """A row for each attacked agent, norm, attack and radius: means over its episodes.

    Read from the robustness.csv of the runs' folders, where it is of the run's final policy.
    """
    parts = []
    for run in results.suite.runs:
        if _is_attacked(results, run.run_id):
            episodes = pd.read_csv(results.folders[run.run_id] / "robustness.csv")
            keys = ["norm", "attack", "radius"]
            means = episodes.groupby(keys, sort=False).mean(numeric_only=True).reset_index()
            own = {"task": run.environment, "algorithm": run.algorithm, "run": run.run_id}
            parts.append(means.assign(**own)[COLUMNS])
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=COLUMNS)


def _is_attacked(results: Results, run_id: str) -> bool:
    """Whether the agent that the report is about was attacked, not one that was trained for less.

    The folder of a run that has been extended since holds the longer run's spec.json.
    """
    folder = results.folders[run_id]
    about = read_json(folder / "robustness.json")
    done = read_json(folder / "done.json")
    if (
        about is None
        or done is None
        or read_json(folder / "spec.json") != results.specs.get(run_id)
    ):
        return False
    return about["checkpoint_sha256"] == done.get("sha256", {}).get("checkpoint.pt")


def strongest(frame: pd.DataFrame) -> pd.DataFrame:
    """The row of the attack with the lowest return, for each agent, norm and radius.

    Of the attacks that all agents of a task had at that radius: one that was attacked in more ways
    would look weaker.
    """
    place = ["task", "norm", "radius"]
    agents = frame.groupby(place)["run"].transform("nunique")
    shared = frame[frame.groupby([*place, "attack"])["run"].transform("nunique") == agents]
    lowest = shared.groupby(["run", "norm", "radius"], sort=False)["return"].idxmin()
    return frame.loc[lowest].reset_index(drop=True)


def standings(results: Results, frame: pd.DataFrame) -> list[Standing]:
    """One for each task, norm, radius above 0 and algorithm, in the suite's order."""
    worst = strongest(frame)
    attacked = worst[worst["radius"] > 0]
    keys = attacked[["norm", "radius"]].drop_duplicates().sort_values(["norm", "radius"])
    found = []
    for task in results.suite.environments:
        for norm, radius in keys.itertuples(index=False):
            for name in results.suite.algorithms:
                chosen = attacked[
                    (attacked[["task", "algorithm", "norm"]] == [task, name, norm]).all(axis=1)
                    & (attacked["radius"] == radius)
                ]
                if len(chosen):
                    found.append(_standing(results, frame, chosen))
    return found


def _standing(results: Results, frame: pd.DataFrame, chosen: pd.DataFrame) -> Standing:
    ranked = chosen.sort_values(["return", "run"])
    median = ranked.iloc[(len(ranked) - 1) // 2]
    own = frame[(frame["run"] == median["run"]) & (frame["norm"] == median["norm"])]
    under = own[own["radius"] == median["radius"]].set_index("attack")["return"]
    still = own[own["radius"] == 0].mean(numeric_only=True)
    return Standing(
        task=median["task"],
        algorithm=median["algorithm"],
        norm=median["norm"],
        radius=float(median["radius"]),
        agents=len(ranked),
        run=median["run"],
        clean=float(still["return"]),
        returns={str(attack): float(value) for attack, value in under.items()},
        strongest=median["attack"],
        psi=results.scores.get(median["run"], {}).get("psi", np.nan),
        action_change=float(still["action_change"]),
        smoothness=float(still["smoothness"]),
    )


def to_frame(found: list[Standing]) -> pd.DataFrame:
    """All of it, to be written as CSV: a column for the return under each attack."""
    rows = []
    for one in found:
        row = dataclasses.asdict(one)
        returns = {f"return, {attack}": value for attack, value in row.pop("returns").items()}
        rows.append({**row, **returns})
    return pd.DataFrame(rows)


def to_rows(found: list[Standing]) -> tuple[list[str], list[list[str]]]:
    """The table as text: a header, and a row for each standing."""
    attacks = list(dict.fromkeys(attack for one in found for attack in one.returns))
    header = ["task", "algorithm", "radius", "n", "no attack", *attacks, "strongest", "retained",
              "psi", "Sm", "|Δa|"]  # fmt: skip
    rows = []
    for one in found:
        lowest = one.returns[one.strongest]
        kept = f"{100 * lowest / one.clean:.0f}%" if one.clean > 0 <= lowest else "–"
        returns = [number(one.returns.get(attack, np.nan)) for attack in attacks]
        rows.append([
            one.task, one.algorithm, f"{one.radius:g} {NORMS[one.norm]}", str(one.agents),
            number(one.clean), *returns, one.strongest, kept,
            number(one.psi), number(one.smoothness), number(one.action_change),
        ])  # fmt: skip
    return header, rows
