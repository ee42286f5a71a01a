"""One table of a benchmark run: work, ours, peer, ratio, goal.

python -m tests.benchmarks.table benchmarks.json > docs/benchmarks.md
"""

from __future__ import annotations

import json
import sys
from itertools import groupby
from pathlib import Path


def table(content: dict) -> str:
    """Markdown. In each group the peer is what says so of itself; a ratio above 1 is faster."""
    machine, lines = content["machine_info"], []
    cpu = machine["cpu"]
    lines += ["# Benchmarks", ""]
    where = f"{cpu['brand_raw']}, {cpu['count']} cores, Python {machine['python_version']}"
    lines += [f"{content['datetime'][:10]}, {where}, `make bench`.",
              "Ratios are taken within one run; a step is one of one environment."]  # fmt: skip
    benchmarks = sorted(filter(in_table, content["benchmarks"]), key=lambda b: b["group"] or "")
    for group, found in groupby(benchmarks, key=lambda b: b["group"] or ""):
        found = list(found)
        peer = next((b for b in found if b["extra_info"].get("peer")), None)
        lines += ["", f"## {group}", "", "| work | time | steps/s | × peer | goal |",
                  "|---|--:|--:|--:|--:|"]  # fmt: skip
        for b in sorted(found, key=pace):
            ratio = f"{pace(peer) / pace(b):.2f}" if peer else ""
            steps, goal = b["extra_info"].get("steps"), b["extra_info"].get("goal", "")
            speed = f"{1 / pace(b):,.0f}" if steps else ""
            name = b["name"].removeprefix("test_") + (" (peer)" if b is peer else "")
            lines.append(f"| {name} | {duration(b)} | {speed} | {ratio} | {goal} |")
        shares = [line for b in found for line in share_lines(b, found)]
        lines += ["", *shares] if shares else []
    return "\n".join(lines) + "\n"


def share_lines(benchmark: dict, group: list[dict]) -> list[str]:
    """What share it reaches of the speed of others in its group, beside the goal for that."""
    lines = []
    for other in group:
        goal = benchmark["extra_info"].get("shares", {}).get(other["name"])
        if goal is not None:
            share = pace(other) / pace(benchmark)
            names = [b["name"].removeprefix("test_") for b in (benchmark, other)]
            lines.append(f"- {names[0]}: {share:.2f} of {names[1]} (goal {goal})")
    return lines


def in_table(benchmark: dict) -> bool:
    """False for what only the figure of growth shows."""
    info = benchmark["extra_info"]
    return "panel" not in info or "goal" in info or "peer" in info


def pace(benchmark: dict) -> float:
    """Median seconds of a step, or of the whole where steps are not counted."""
    return benchmark["stats"]["median"] / benchmark["extra_info"].get("steps", 1)


def duration(benchmark: dict) -> str:
    seconds = benchmark["stats"]["median"]
    return f"{1000 * seconds:,.2f} ms" if seconds < 1 else f"{seconds:,.2f} s"


if __name__ == "__main__":
    sys.stdout.write(table(json.loads(Path(sys.argv[1]).read_text())))
