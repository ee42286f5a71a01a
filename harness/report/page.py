"""The whole report of a suite: tables, figures and verdicts, as files and one HTML page."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from urllib.parse import quote

import jinja2
from rich.table import Table

from harness.report import claims, figures, study, table1, table2
from harness.report.cost import cost_claim
from harness.report.results import Results


@dataclasses.dataclass(frozen=True)
class Section:
    """One table of the paper beside ours, with its notes and figures."""

    title: str
    header: list[str]
    rows: list[list[str]]
    notes: list[str]
    pictures: list[tuple[str, str]]
    """a title and a file's name"""
    table: Table
    """the same table for a terminal"""


def write_report(results: Results, folder: Path) -> tuple[list[Section], list[claims.Claim]]:
    """Write report.html, the tables as Markdown and CSV, and the figures as PNG, to a folder."""
    control, levels = results.part(evaluated=False), results.part(evaluated=True)
    found, sections = [], []
    if control.suite.runs:
        found += claims.make_claims(control)
        sections += [_control(control, found, folder), *_final(control, folder)]
    if levels.suite.runs:
        claim = claims.generalization_claim(levels)
        found += [claim] if claim.findings else []
        sections.append(_levels(levels, claim, folder))
    cost = cost_claim(results)
    found += [cost] if cost.findings else []
    claims.to_frame(found).to_csv(folder / "claims.csv", index=False)
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        (Path(__file__).parent / "page.html").read_text()
    )
    content = page.render(
        suite=results.suite, claims=found, sections=sections, episodes=_episodes(levels, folder),
    )  # fmt: skip
    (folder / "report.html").write_text(content)
    return sections, found


def _control(results: Results, found: list[claims.Claim], folder: Path) -> Section:
    cells = table1.make_cells(results)
    (folder / "table1.md").write_text(table1.to_markdown(results, cells))
    table1.to_frame(cells).to_csv(folder / "table1.csv", index=False)
    header, rows = table1.to_rows(results.suite, cells)
    return Section(
        "Table 1: training scores, beside the paper's", header, rows,
        table1.notes(results, cells), _draw(results, found, folder), table1.to_rich(results, cells),
    )  # fmt: skip


def _final(results: Results, folder: Path) -> list[Section]:
    """Table 1 once more, of the final policies, if any was evaluated."""
    cells = table1.make_cells(results, "final")
    if not any(cell.agents for cell in cells):
        return []
    (folder / "table1_final.md").write_text(table1.to_markdown(results, cells, "final"))
    table1.to_frame(cells).to_csv(folder / "table1_final.csv", index=False)
    header, rows = table1.to_rows(results.suite, cells)
    return [
        Section(
            "Table 1: final policies", header, rows, table1.notes(results, cells), [],
            table1.to_rich(results, cells, "final"),
        )
    ]  # fmt: skip


def _levels(results: Results, claim: claims.Claim, folder: Path) -> Section:
    cells = table2.make_cells(results)
    (folder / "table2.md").write_text(table2.to_markdown(results, cells))
    table2.to_frame(cells).to_csv(folder / "table2.csv", index=False)
    header, rows = table2.to_rows(results, cells)
    pictures = []
    if claim.findings and results.metrics:
        title = "Figure 4: success on seen and unseen levels during training"
        pictures.append((title, "figure4.png"))
        table2.success_curves(results, folder / "figure4.png")
    if claim.findings:
        pictures.append(("Claim (d), number by number", "claim_d.png"))
        study.findings(claim, folder / "claim_d.png")
    return Section(
        "Table 2: success rate on CoinRun levels, %, beside the paper's", header, rows,
        table2.notes(results, cells), pictures, table2.to_rich(results, cells),
    )  # fmt: skip


def _episodes(results: Results, folder: Path) -> list[tuple[str, list[str]]]:
    """GIFs of each algorithm's first agent, on a seen and on an unseen level, if recorded."""
    shown: dict[str, list[str]] = {}
    for run in results.suite.runs:
        gifs = [results.folders[run.run_id] / f"{split}.gif" for split in table2.SPLITS]
        if run.algorithm not in shown and all(gif.exists() for gif in gifs):
            shown[run.algorithm] = [quote(os.path.relpath(gif, folder)) for gif in gifs]
    return list(shown.items())


def _draw(results: Results, found: list[claims.Claim], folder: Path) -> list[tuple[str, str]]:
    """Every figure that the control runs allow: its title and its file's name."""
    pictures = []
    for i, (title, algorithms) in enumerate(results.suite.figures.items(), 1):
        pictures.append((title, f"learning_curves_{i}.png"))
        figures.learning_curves(results, algorithms, folder / pictures[-1][1])
    agents = claims.agent_table(results)
    if agents["plain"].any():
        pictures.append(("Claim (a): psi and reward over agents", "psi_and_reward.png"))
        study.psi_and_reward(agents, folder / pictures[-1][1])
    for claim in found:
        pictures.append((f"Claim ({claim.letter}), number by number", f"claim_{claim.letter}.png"))
        study.findings(claim, folder / pictures[-1][1])
    for i, name in enumerate(results.suite.sweeps, 1):
        pictures.append((f"Ablation: {name}", f"ablation_{i}.png"))
        study.sweep(results, agents, name, folder / pictures[-1][1])
    if study.quotient_and_spectrum(results, folder / "quotient_and_spectrum.png"):
        title = (
            "What J is worth: J against the exact mean singular value (yellow: late in training). "
            "With fewer actions than observed numbers J is smaller by design"
        )
        pictures.append((title, "quotient_and_spectrum.png"))
    return pictures
