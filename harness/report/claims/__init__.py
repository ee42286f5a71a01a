"""The paper's claims, one module each: numbers, their uncertainty, and a verdict.

(a) `conditioning`: a policy that receives fewer rewards has worse conditioning. (b) and (c)
`comparison`: the regularizer wins on most tasks; TRPO beats PPO. (d) `generalization`: CoinRun.
(e), what the penalty costs, is harness.report.cost.
"""

from __future__ import annotations

from harness.report.claims.agents import agent_table
from harness.report.claims.comparison import comparison_claim
from harness.report.claims.conditioning import conditioning_claim, setting_means
from harness.report.claims.finding import Claim, Finding, agreed, to_frame
from harness.report.claims.generalization import generalization_claim, splits
from harness.report.results import Results

__all__ = [
    "Claim",
    "Finding",
    "agent_table",
    "agreed",
    "comparison_claim",
    "conditioning_claim",
    "generalization_claim",
    "make_claims",
    "setting_means",
    "splits",
    "to_frame",
]


def make_claims(results: Results) -> list[Claim]:
    """Claims (a), (b) and (c), as far as the suite's finished runs speak of them."""
    agents = agent_table(results)
    agents = agents[agents["done"]]  # one that still learns is no match for one that is done
    planned = set(results.suite.planned)
    claims = [
        conditioning_claim(agents),
        comparison_claim(agents, "b", planned),
        comparison_claim(agents, "c", planned),
    ]
    return [claim for claim in claims if claim.findings]
