"""The page: a part for each suite, in one HTML file that links the pictures beside it."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import quote

import jinja2
from markdown_it import MarkdownIt
from markupsafe import Markup

from harness.report.part import Part, make_part
from harness.report.published import deviations
from harness.report.results import Results

DEVIATIONS = {False: "What differs from the paper", True: "CoinRun today"}
"""sections of docs/paper.md, by whether they are about runs that are evaluated on levels"""


def write_report(results: Results, folder: Path) -> Part:
    """Write a suite's report.html, its tables as Markdown and CSV, and its figures, to a folder."""
    part = make_part(results, folder)
    write_page([part], folder / "report.html")
    return part


def write_page(parts: list[Part], path: Path) -> None:
    """One page of several suites; it links the figures where their own reports have them."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["url"] = lambda file: quote(os.path.relpath(file, path.parent))
    environment.filters["lines"] = lambda text: re.split(r" (?=[\[{(])", text)
    template = environment.from_string((Path(__file__).parent / "page.html").read_text())
    path.write_text(template.render(parts=parts, deviations=_deviations(parts)))


def _deviations(parts: list[Part]) -> list[tuple[str, Markup]]:
    """A heading and its text as HTML, for each kind of runs that the parts have."""
    kinds = {"levels" in run.evaluation for part in parts for run in part.results.suite.runs}
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    return [
        (heading, Markup(markdown.render(deviations(heading))))
        for kind, heading in DEVIATIONS.items()
        if kind in kinds
    ]
