"""A table in Markdown."""

from __future__ import annotations


def to_markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A header and its rows; numbers, all columns but the first, are set to the right."""
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
