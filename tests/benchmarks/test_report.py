"""The table and the figure of a benchmark run."""

from __future__ import annotations

import matplotlib.pyplot as plt

from tests.benchmarks.figure import growth
from tests.benchmarks.table import table


def measured(name: str, seconds: float, group: str = "", **info) -> dict:
    return {
        "name": f"test_{name}",
        "group": group,
        "stats": {"median": seconds},
        "extra_info": info,
    }


def content(*benchmarks: dict) -> dict:
    cpu = {"brand_raw": "Some CPU", "count": 2}
    machine = {"cpu": cpu, "python_version": "3.11.7"}
    return {"machine_info": machine, "datetime": "2026-01-02T03:04:05", "benchmarks": benchmarks}


def test_ratios_are_of_the_pace_of_a_step():
    lines = table(
        content(
            measured("peer[a]", 2.0, "PPO", steps=1000, peer=True),
            measured("ours[a]", 5.0, "PPO", steps=10_000, goal=4.0),
        )
    ).splitlines()
    assert "2026-01-02, Some CPU, 2 cores, Python 3.11.7, `make bench`." in lines
    assert lines[-4] == "| work | time | steps/s | × peer | goal |"
    assert lines[-2] == "| ours[a] | 5.00 s | 2,000 | 4.00 | 4.0 |"
    assert lines[-1] == "| peer[a] (peer) | 2.00 s | 500 | 1.00 |  |"


def test_shares_are_of_the_speed_of_another_in_the_group():
    lines = table(
        content(
            measured("plain[a]", 1.0, "PPO", steps=1000),
            measured("penalty[a]", 2.5, "PPO", steps=2000, shares={"test_plain[a]": 0.9}),
        )
    ).splitlines()
    assert lines[-1] == "- penalty[a]: 0.80 of plain[a] (goal 0.9)"


def test_what_only_the_figure_shows_is_not_in_the_table():
    grown = measured("batch[16]", 1.0, panel="batch", x=16, series="ours")
    lines = table(content(grown, measured("other", 0.5, "alone"))).splitlines()
    assert lines[-1] == "| other | 500.00 ms |  |  |  |"
    assert not any("batch" in line for line in lines)


def test_the_figure_has_a_panel_for_each_quantity_and_a_line_for_each_series():
    panels = {"batch": {}, "jobs": {"steps": 1000}}
    figure = growth(
        [
            measured(f"{panel}[{x}]", 0.5 * x, panel=panel, x=x, series=name, **info)
            for panel, info in panels.items()
            for x in (4, 1, 2)
            for name in ("ours", "theirs")
        ]
    )
    batch, jobs = figure.axes
    assert (batch.get_xlabel(), jobs.get_xlabel()) == ("batch", "jobs")
    lines = {line.get_label(): line.get_xydata().tolist() for line in batch.lines}
    assert lines == {name: [[1, 500.0], [2, 1000.0], [4, 2000.0]] for name in ("ours", "theirs")}
    plt.close(figure)
    assert jobs.lines[0].get_xydata().tolist() == [[1, 2000.0], [2, 1000.0], [4, 500.0]]
