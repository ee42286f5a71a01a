"""The numbers that the paper prints."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any


def paper_numbers(table: str) -> dict[str, Any]:
    """A table of paper.toml: "table1" or "table2"."""
    return tomllib.loads((Path(__file__).parents[1] / "paper.toml").read_text())[table]
