"""What the page shows of one suite: verdicts, then sections of tables and figures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.table import Table

from harness.provenance import Origins
from harness.report import claims
from harness.report.cost import cost_claim, mixed_measurements
from harness.report.figures.arms import draw_arms, sweep
from harness.report.figures.claims import findings, psi_and_reward
from harness.report.figures.curves import CONDITIONING, LEARNING, draw_measures
from harness.report.figures.jacobian import squares
from harness.report.figures.robustness import return_against_radius
from harness.report.figures.scores import score_cells
from harness.report.figures.success import success_curves
from harness.report.results import Results
from harness.report.tables import arms, conditioning, robustness, smoothness, table1, table2

Picture = tuple[str, str]
"""a title and a file's name"""


@dataclasses.dataclass(frozen=True)
class Section:
    """A table, with its notes and figures; any of them may be missing."""

    title: str
    header: list[str] = dataclasses.field(default_factory=list)
    rows: list[list[str]] = dataclasses.field(default_factory=list)
    notes: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()
    table: Table | None = None
    """the same table for a terminal, where it is shown there"""


@dataclasses.dataclass(frozen=True)
class Part:
    """What the page shows of one suite."""

    results: Results
    folder: Path
    """where its files are"""
    claims: list[claims.Claim]
    unjudged: str
    """why there is no verdict; empty if there are any"""
    sections: list[Section]
    episodes: list[tuple[str, list[tuple[str, Path]]]]
    """recorded episodes of each algorithm: what they are played on, and their file"""

    @property
    def origins(self) -> Origins:
        """The code, versions and machines behind its numbers."""
        return self.results.origins

    @property
    def warnings(self) -> list[str]:
        """What cannot be read, and what mixes: control tasks and CoinRun by themselves."""
        parts = [self.results.part(evaluated) for evaluated in (False, True)]
        mixing = [warning for part in parts for warning in part.origins.warnings]
        found = [*self.results.warnings, *mixing]
        if any(claim.letter == "e" for claim in self.claims):
            found += mixed_measurements(self.results.timed)
        return list(dict.fromkeys(found))

    @property
    def diverged(self) -> list[tuple[str, str]]:
        """Runs whose own numbers became non-finite: the run, and what became so at which update."""
        return [
            (run_id, f"{found['what']} at update {found['update']}: {found['message']}")
            for run_id, found in self.results.diverged.items()
        ]


def make_part(results: Results, folder: Path) -> Part:
    """Write a suite's tables as Markdown and CSV and its figures as PNG, and collect them."""
    control, levels = results.part(evaluated=False), results.part(evaluated=True)
    unjudged = _unjudged(control)
    found: list[claims.Claim] = []
    sections: list[Section] = []
    if control.suite.runs:
        found += [] if unjudged else claims.make_claims(control)
        sections += _control(control, found, folder)
    if levels.suite.runs:
        claim = claims.generalization_claim(levels)
        shown = claim if claim.findings and not unjudged else None
        found += [shown] if shown else []
        sections.append(_levels(levels, shown, folder))
    cost = cost_claim(results)
    if cost.findings and not unjudged:
        found.append(cost)
    claims.to_frame(found).to_csv(folder / "claims.csv", index=False)
    return Part(results, folder, found, unjudged, sections, _episodes(levels))


def _unjudged(control: Results) -> str:
    """Why a suite with control tasks has no verdict, if it has none."""
    most = max(control.suite.planned.values(), default=0)
    return "One agent a setting: nothing to judge." if most == 1 else ""


def _control(results: Results, found: list[claims.Claim], folder: Path) -> list[Section]:
    """Curves and claims first, then the tables, then what J is and what it is worth."""
    cells = table1.make_cells(results)
    final = table1.make_cells(results, "final")
    sections = [
        Section("Learning curves", pictures=_curves(results, folder)),
        Section(
            "The claims in pictures" if found else "Psi and reward",
            pictures=_claims(results, found, folder),
        ),
        _arms(results, folder),
        _scores("Table 1: training scores, beside the paper's", results, cells, folder),
        _final(results, final, folder),
        _smoothness(results, folder),
        _robustness(results, folder),
        _conditioning(results, folder),
    ]
    return [section for section in sections if section.rows or section.pictures]


def _curves(results: Results, folder: Path) -> tuple[Picture, ...]:
    pictures = []
    for i, (title, algorithms) in enumerate(results.suite.figures.items(), 1):
        name = f"learning_curves_{i}.png"
        if draw_measures(results, algorithms, LEARNING, folder / name):
            pictures.append((title, name))
    return tuple(pictures)


def _claims(results: Results, found: list[claims.Claim], folder: Path) -> tuple[Picture, ...]:
    pictures = []
    for claim in found:
        name = f"claim_{claim.letter}.png"
        pictures.append((f"Claim ({claim.letter}), number by number", name))
        findings(claim, folder / name)
    if psi_and_reward(claims.agent_table(results), folder / "psi_and_reward.png"):
        title = "psi and reward: agents are dots, the means of their settings diamonds"
        pictures.append((title, "psi_and_reward.png"))
    return tuple(pictures)


def _scores(title: str, results: Results, cells: list[table1.Cell], folder: Path) -> Section:
    (folder / "table1.md").write_text(table1.to_markdown(results, cells))
    table1.to_frame(cells).to_csv(folder / "table1.csv", index=False)
    header, rows = table1.to_rows(results.suite, cells)
    pictures = []
    if any(cell.agents > 1 for cell in cells) and score_cells(cells, folder / "scores.png"):
        pictures.append(("Training scores: agents are dots, means bars", "scores.png"))
    return Section(
        title, header, rows, tuple(table1.notes(results, cells)), tuple(pictures),
        table1.to_rich(results, cells),
    )  # fmt: skip


def _final(results: Results, cells: list[table1.Cell], folder: Path) -> Section:
    """Table 1 once more, of the final policies, if any was evaluated."""
    title = "Table 1: final policies"
    if not any(cell.agents for cell in cells):
        return Section(title)
    (folder / "table1_final.md").write_text(table1.to_markdown(results, cells, "final"))
    table1.to_frame(cells).to_csv(folder / "table1_final.csv", index=False)
    header, rows = table1.to_rows(results.suite, cells)
    note = f"{table1.OUTCOMES['final'].capitalize()}."
    return Section(title, header, rows, (note,), (), table1.to_rich(results, cells, "final"))


def _smoothness(results: Results, folder: Path) -> Section:
    table = smoothness.smoothness_table(results, table1.algorithms_of(results.suite))
    if not len(table):
        return Section("Smoothness")
    table.to_csv(folder / "smoothness.csv", index=False)
    header, rows = smoothness.to_rows(table)
    return Section("Smoothness of the final policies' actions", header, rows, smoothness.NOTES)


def _robustness(results: Results, folder: Path) -> Section:
    """Returns under attack, of the agents that `evaluate --attack` has attacked."""
    title = "Robustness: final policies under attack"
    frame = robustness.robustness_frame(results)
    found = robustness.standings(results, frame)
    if not found:
        return Section(title)
    return_against_radius(results, frame, folder / "robustness.png")
    robustness.to_frame(found).to_csv(folder / "robustness.csv", index=False)
    header, rows = robustness.to_rows(found)
    picture = ("Return under the strongest attack: agents are dots, lines their medians",
               "robustness.png")  # fmt: skip
    return Section(title, header, rows, robustness.NOTES, (picture,))


def _arms(results: Results, folder: Path) -> Section:
    """Each arm of an ablation against its plain algorithm, where there are several agents."""
    title = "Every arm against PPO"
    found = [] if _unjudged(results) else arms.make_arms(results)
    agents = claims.agent_table(results)
    pictures = []
    if found:
        draw_arms(found, folder / "arms.png")
        pictures.append(("Differences of the scores, and psi by the yardstick", "arms.png"))
    for i, name in enumerate(results.suite.sweeps, 1):
        if sweep(results, agents, name, folder / f"ablation_{i}.png"):
            pictures.append((f"Ablation: {name}", f"ablation_{i}.png"))
    if not found:
        return Section(title, pictures=tuple(pictures))
    arms.to_frame(found).to_csv(folder / "arms.csv", index=False)
    header, rows = arms.to_rows(found)
    return Section(title, header, rows, arms.NOTES, tuple(pictures))


def _conditioning(results: Results, folder: Path) -> Section:
    table = conditioning.conditioning_table(results)
    table.to_csv(folder / "conditioning.csv", index=False)
    header, rows = conditioning.to_rows(table)
    pictures = []
    for i, (title, algorithms) in enumerate(results.suite.figures.items(), 1):
        name = f"conditioning_{i}.png"
        if draw_measures(results, algorithms, CONDITIONING, folder / name):
            pictures.append((f"J against steps: {title}", name))
    if squares(results, folder / "jacobian.png"):
        title = (
            "What J is worth: mean J² against ‖Jacobian‖²_F / n, to which it tends for small "
            "delta (yellow: late in training; the line: equal)"
        )
        pictures.append((title, "jacobian.png"))
    return Section(
        "Conditioning at the end of training", header, rows, conditioning.NOTES, tuple(pictures)
    )


def _levels(results: Results, claim: claims.Claim | None, folder: Path) -> Section:
    cells = table2.make_cells(results)
    (folder / "table2.md").write_text(table2.to_markdown(results, cells))
    table2.to_frame(cells).to_csv(folder / "table2.csv", index=False)
    header, rows = table2.to_rows(results, cells)
    pictures = []
    if success_curves(results, folder / "figure4.png"):
        title = "Figure 4: success on seen and unseen levels during training"
        pictures.append((title, "figure4.png"))
    if claim and any(finding.estimate.n for finding in claim.findings):
        pictures.append(("Claim (d), number by number", "claim_d.png"))
        findings(claim, folder / "claim_d.png")
    return Section(
        "Table 2: success rate on CoinRun levels, %, beside the paper's", header, rows,
        tuple(table2.notes(results, cells)), tuple(pictures), table2.to_rich(results, cells),
    )  # fmt: skip


def _episodes(results: Results) -> list[tuple[str, list[tuple[str, Path]]]]:
    """GIFs of each algorithm's first agent, one for each kind of levels, if recorded."""
    kinds = {"seen": "a seen level", "unseen": "an unseen level",
             "themes": "that level in other themes"}  # fmt: skip
    splits = claims.splits(results)
    shown: dict[str, list[tuple[str, Path]]] = {}
    for run in results.suite.runs:
        gifs = [(kinds[split], results.folders[run.run_id] / f"{split}.gif") for split in splits]
        if run.algorithm not in shown and all(gif.exists() for _, gif in gifs):
            shown[run.algorithm] = gifs
    return list(shown.items())
