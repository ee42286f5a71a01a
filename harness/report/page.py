"""The whole report of a suite: tables, figures and verdicts, as files and one HTML page."""

from __future__ import annotations

from pathlib import Path

import jinja2

from harness.report import claims, figures, study, table1
from harness.report.results import Results
from harness.statistics import MIN_AGENTS


def write_report(results: Results, folder: Path) -> tuple[list[table1.Cell], list[claims.Claim]]:
    """Write report.html, the tables as Markdown and CSV, and the figures as PNG, to a folder."""
    cells, found = table1.make_cells(results), claims.make_claims(results)
    (folder / "table1.md").write_text(table1.to_markdown(results, cells))
    table1.to_frame(cells).to_csv(folder / "table1.csv", index=False)
    claims.to_frame(found).to_csv(folder / "claims.csv", index=False)
    header, rows = table1.to_rows(results.suite, cells)
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        (Path(__file__).parent / "page.html").read_text()
    )
    content = page.render(
        suite=results.suite, claims=found, header=header, rows=rows, min_agents=MIN_AGENTS,
        min_updates=claims.MIN_UPDATES,
        notes=table1.notes(results, cells), pictures=_draw(results, found, folder),
    )  # fmt: skip
    (folder / "report.html").write_text(content)
    return cells, found


def _draw(results: Results, found: list[claims.Claim], folder: Path) -> list[tuple[str, str]]:
    """Every figure that the suite's runs allow: its title and its file's name."""
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
