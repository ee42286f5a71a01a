"""Numbers that others have published: the paper's tables, and what tuned agents reach."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "published"


def paper_numbers(table: str) -> dict[str, Any]:
    """A table of published/paper.toml: "table1" or "table2"."""
    return tomllib.loads((FOLDER / "paper.toml").read_text())[table]


def zoo_numbers(algorithm: str) -> dict[str, dict[str, float]]:
    """Mean, deviation and steps of rl-baselines3-zoo's tuned agents by task; {} if it has none."""
    return tomllib.loads((FOLDER / "zoo.toml").read_text()).get(algorithm, {})
