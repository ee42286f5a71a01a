"""Text of tables."""

from __future__ import annotations

import math


def to_markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A header and its rows; numbers, all columns but the first, are set to the right."""
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def supported_by(n: int, failed: int, detectable: float, digits: int = 1) -> str:
    """What a cell rests on: agents, failed runs, and the effect that it could have found.

    The effect is NaN, and a dash, where there are too few agents to find any.
    """
    effect = "–" if math.isnan(detectable) else f"{detectable:.{digits}f}"
    return f"(n {n}, {failed} failed, finds {effect})"
