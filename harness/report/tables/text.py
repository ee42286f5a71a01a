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


def number(value: float, digits: int = 3) -> str:
    """So many significant digits, an exponent only for the very small and large; NaN: a dash."""
    if math.isnan(value):
        return "–"
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    text = f"{value:#.{digits}g}" if value else "0"
    return f"{float(text):.0f}" if "e" in text else text.removesuffix(".")


def interval(mean: float, low: float, high: float, digits: int = 3) -> str:
    """A mean, and its interval in brackets where it has one."""
    if math.isnan(low):
        return number(mean, digits)
    return f"{number(mean, digits)} [{number(low, digits)}, {number(high, digits)}]"
