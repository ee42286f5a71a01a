"""How smooth the actions of final policies are."""

from __future__ import annotations

import dataclasses

import pytest

from harness.report.tables.smoothness import smoothness_table, to_rows


@pytest.fixture
def played(study):
    """Both algorithms on Ant; on Hopper only PPO, whose second agent moves more."""
    results = study(
        lambda *_: 1.0, tasks=("Hopper", "Ant"), agents=2,
        final=lambda task, name, _: 1.0 if (task, name) != ("Hopper", "PPO reg") else None,
    )  # fmt: skip
    rough = results.evaluations["ppo__Hopper__s2__a0"]
    rough.loc[rough["policy"] == "deterministic", ["action_change", "smoothness"]] = [1.5, 0.003]
    rough.loc[rough["policy"] == "sampled", "action_change"] = 99.0
    return results


def test_a_cell_is_the_mean_over_agents_of_deterministic_episodes(played):
    table = smoothness_table(played, ["PPO", "PPO reg"])
    columns = ["PPO, |Δa|", "PPO, Sm", "PPO reg, |Δa|", "PPO reg, Sm"]
    assert list(table.columns) == ["task", *columns]
    header, rows = to_rows(table)
    assert header == list(table.columns)
    assert rows == [
        ["Hopper", "1.00", "0.00200", "–", "–"],
        ["Ant", "0.500", "0.00100", "0.500", "0.00100"],
    ]


def test_algorithms_that_the_table_has_not_are_left_out(played):
    assert list(smoothness_table(played, ["PPO"]).columns) == ["task", "PPO, |Δa|", "PPO, Sm"]


def test_without_evaluations_there_are_no_rows(played):
    nothing = dataclasses.replace(played, evaluations={})
    assert len(smoothness_table(nothing, ["PPO"])) == 0
