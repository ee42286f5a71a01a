"""What others have published: the paper's tables, how ours differs, what tuned agents reach."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
FOLDER = Path(__file__).parents[1] / "published"


def paper_numbers(table: str) -> dict[str, Any]:
    """A table of published/paper.toml: "table1" or "table2"."""
    return tomllib.loads((FOLDER / "paper.toml").read_text())[table]


def zoo_numbers(algorithm: str) -> dict[str, dict[str, float]]:
    """Mean, deviation and steps of rl-baselines3-zoo's tuned agents by task; {} if it has none."""
    return tomllib.loads((FOLDER / "zoo.toml").read_text()).get(algorithm, {})


def deviations(heading: str) -> str:
    """A section of docs/paper.md, as Markdown without its heading: the one list of what differs."""
    text = (ROOT / "docs" / "paper.md").read_text()
    _, found, rest = text.partition(f"\n## {heading}\n")
    if not found:
        raise ValueError(f"docs/paper.md has no section {heading!r}")
    return rest.partition("\n## ")[0].strip()
