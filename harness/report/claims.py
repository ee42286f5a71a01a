"""The paper's claims about control, one by one: numbers, their uncertainty, and a verdict.

(a) A policy that receives fewer rewards has worse conditioning, and one that ends well is better
    conditioned from the first steps. (b) The regularizer wins on most tasks. (c) TRPO beats PPO.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd

from harness.report.results import Results
from harness.statistics import (
    LAST_UPDATES,
    MIN_AGENTS,
    TOO_FEW,
    Estimate,
    estimate_mean,
    final_score,
    interquartile_mean,
    rank_correlation,
    spearman,
    verdict,
)

MIN_UPDATES = 200  # of every run; in shorter ones the last 100 updates are also the early ones
EARLY = 0.1  # share of the updates that count as "from the first steps"
PAIRS = {
    "b": [("PPO", "PPO reg"), ("TRPO", "TRPO reg")],
    "c": [("PPO", "TRPO"), ("PPO reg", "TRPO reg")],
}
STATEMENTS = {
    "a": "A policy that receives fewer rewards has worse conditioning (larger psi), and one that "
    "ends well is better conditioned from the first steps.",
    "b": "The regularizer wins on most of the tasks.",
    "c": "TRPO beats PPO.",
}


@dataclasses.dataclass(frozen=True)
class Finding:
    """One number behind a verdict."""

    about: str
    task: str
    """a task, or "all" """
    estimate: Estimate
    verdict: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """A claim of the paper, what was found, and the verdict that the findings allow."""

    letter: str
    statement: str
    verdict: str
    findings: list[Finding]


def agent_table(results: Results) -> pd.DataFrame:
    """A row for each agent: its reward and psi, early and late, and how they moved together."""
    rows = []
    for run in results.suite.runs:
        metrics = results.metrics.get(run.run_id)
        if metrics is None:
            continue
        reward, psi = metrics["charts/episodic_return"], metrics["conditioning/psi"]
        pairs = np.column_stack([psi, reward])[reward.notna()]
        rows.append(
            {
                "environment": run.environment,
                "algorithm": run.algorithm,
                "plain": run.args.get("coefficient") == 0 and not run.args.get("perturb_obs"),
                "seed": run.args["seed"],
                "agent": run.args["agent"],
                "done": run.run_id in results.done,
                "updates": len(metrics),
                "reward": final_score(metrics),
                "psi": psi.tail(LAST_UPDATES).mean(),
                "early_psi": psi.head(max(1, round(EARLY * len(psi)))).mean(),
                "together": spearman(pairs[None])[0] if len(pairs) > 2 else np.nan,
            }
        )
    columns = ["environment", "algorithm", "plain", "seed", "agent", "done", "updates"]
    columns += ["reward", "psi", "early_psi", "together"]
    return pd.DataFrame(rows, columns=columns).astype({"plain": bool, "done": bool})


def conditioning_claim(agents: pd.DataFrame) -> Claim:
    """Claim (a), over plain agents of every setting: regularized ones have psi moved by design."""
    agents = agents[agents["plain"]].dropna(subset=["reward"])
    tasks = dict(list(agents.groupby("environment", sort=False)))
    findings = []
    for about, column in (("final psi and reward", "psi"), ("early psi and reward", "early_psi")):
        pairs = {task: a[[column, "reward"]].to_numpy() for task, a in tasks.items()}
        for task, pair in pairs.items():
            findings.append(_finding(f"over agents: {about}", task, rank_correlation([pair]), -1))
        pooled = rank_correlation(list(pairs.values()))
        findings.append(_finding(f"over agents: {about}", "all", pooled, -1))
    about = "over training: psi and reward of an agent"
    together = {task: a["together"].dropna().to_numpy() for task, a in tasks.items()}
    for task, values in together.items():
        findings.append(_finding(about, task, estimate_mean(values), -1))
    pooled = estimate_mean(np.concatenate([np.empty(0), *together.values()]))
    findings.append(_finding(about, "all", pooled, -1))
    overall = agreed([f.verdict for f in findings if f.task == "all"])
    return Claim("a", STATEMENTS["a"], overall, findings)


def comparison_claim(agents: pd.DataFrame, letter: str, planned: set[tuple[str, str]]) -> Claim:
    """Claims (b) and (c): paired differences, second minus first, same seed, agent and noise.

    A task that `planned`, (task, algorithm), has and `agents` has not leaves the claim open.
    """
    findings, verdicts = [], []
    for first, second in PAIRS[letter]:
        about = f"{second} - {first}"
        differences = paired_differences(agents, first, second)
        tasks = {task for task, name in planned if name == first and (task, second) in planned}
        if tasks - set(differences):
            verdicts.append(TOO_FEW)
        if not differences:
            continue
        raw = {task: d["raw"].to_numpy() for task, d in differences.items()}
        standard = {task: d["standard"].to_numpy() for task, d in differences.items()}
        wins = {task: np.heaviside(values, 0.5) for task, values in raw.items()}
        middle, least = interquartile_mean(list(standard.values())), min(map(len, raw.values()))
        each = [_finding(f"{about}: reward", t, estimate_mean(v), +1) for t, v in raw.items()]
        about_standard = f"{about}: in standard deviations (all: interquartile mean)"
        findings += each
        findings += [_finding(about_standard, t, estimate_mean(v), +1) for t, v in standard.items()]
        overall = verdict(middle, +1) if least >= MIN_AGENTS else TOO_FEW
        findings.append(Finding(about_standard, "all", middle, overall))
        for task, values in {**wins, "all": np.concatenate(list(wins.values()))}.items():
            chance = estimate_mean(values)
            judged = verdict(_shift(chance, -0.5), +1)
            findings.append(Finding(f"{about}: probability of improvement", task, chance, judged))
        verdicts.append(most_of([f.verdict for f in each]))
    return Claim(letter, STATEMENTS[letter], agreed(verdicts), findings)


def paired_differences(agents: pd.DataFrame, first: str, second: str) -> dict[str, pd.DataFrame]:
    """For each task, second minus first for each (seed, agent) that has both.

    `raw` is in reward; `standard` in standard deviations of both algorithms' rewards on the task.
    """
    keys = ["environment", "seed", "agent"]
    wide = agents[agents["algorithm"].isin([first, second])].pivot_table(
        index=keys, columns="algorithm", values="reward"
    )
    if not {first, second} <= set(wide.columns):
        return {}
    wide = wide[[first, second]].dropna()
    found = {}
    for task in agents["environment"].unique():
        if task in wide.index.get_level_values("environment"):
            both = wide.xs(task, level="environment")
            raw = both[second] - both[first]
            deviation = both.to_numpy().std() or 1.0
            if len(both) < 2:  # one pair is always 2 of its own deviations apart
                deviation = np.nan
            found[task] = pd.DataFrame({"raw": raw, "standard": raw / deviation})
    return found


def most_of(verdicts: list[str]) -> str:
    """The verdict on "wins on most tasks", from the verdicts on each."""
    if TOO_FEW in verdicts:
        return TOO_FEW
    for word in ("supported", "contradicted"):
        if 2 * verdicts.count(word) > len(verdicts):
            return word
    return "not supported"


def agreed(verdicts: list[str]) -> str:
    """The verdict on a claim of several parts: theirs if they agree."""
    if not verdicts or TOO_FEW in verdicts:
        return TOO_FEW
    return verdicts[0] if len(set(verdicts)) == 1 else "not supported"


def make_claims(results: Results) -> list[Claim]:
    """Claims (a), (b) and (c), as far as the suite's complete runs speak of them."""
    agents = agent_table(results)
    agents = agents[agents["done"]]  # one that still learns is no match for one that is done
    planned = set(results.suite.planned)
    compared = (comparison_claim(agents, letter, planned) for letter in "bc")
    claims = [conditioning_claim(agents), *compared]
    if (agents["updates"] < MIN_UPDATES).any():
        claims = [without_verdict(claim) for claim in claims]
    return [claim for claim in claims if claim.findings]


def to_frame(claims: list[Claim]) -> pd.DataFrame:
    """A row for each finding, for CSV."""
    return pd.DataFrame(
        [
            {"claim": c.letter, "about": f.about, "task": f.task, **f.estimate._asdict(),
             "verdict": f.verdict}
            for c in claims for f in c.findings
        ]
    )  # fmt: skip


def without_verdict(claim: Claim) -> Claim:
    findings = [dataclasses.replace(f, verdict=TOO_FEW) for f in claim.findings]
    return dataclasses.replace(claim, verdict=TOO_FEW, findings=findings)


def _finding(about: str, task: str, estimate: Estimate, sign: int) -> Finding:
    return Finding(about, task, estimate, verdict(estimate, sign))


def _shift(estimate: Estimate, by: float) -> Estimate:
    mean, low, high, n = estimate
    return Estimate(mean + by, low + by, high + by, n)
