"""The strongest attack on each agent, and the median agent under it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest

from harness.files import read_json, write_json
from harness.report.tables.robustness import (
    COLUMNS,
    robustness_frame,
    standings,
    strongest,
    to_frame,
    to_rows,
)

# mean returns of agents 0 to 3 of each arm, by attack and radius
RETURNS = {
    ("PPO", "mad", 0.0): [100, 200, 300, 400],
    ("PPO", "critic", 0.0): [100, 200, 300, 400],
    ("PPO", "mad", 0.1): [10, 90, 30, 50],
    ("PPO", "critic", 0.1): [20, 20, 40, 60],
    ("PPO reg", "mad", 0.0): [-1, -1, -1, -1],
    ("PPO reg", "critic", 0.0): [-1, -1, -1, -1],
    ("PPO reg", "mad", 0.1): [-5, -6, -7, -8],
    ("PPO reg", "critic", 0.1): [-4, -5, -6, -7],
}


def write_attacks(results, run, rows):
    """A run's robustness.csv, each of whose means is over two episodes, and its robustness.json."""
    folder = results.folders[run.run_id]
    frame = pd.DataFrame(
        [
            {
                "attack": attack, "radius": radius, "norm": norm, "episode": episode,
                "return": value + 2 * episode - 1, "length": 10,
                "action_change": 0.5 + radius, "smoothness": 0.01 + radius,
            }
            for attack, radius, norm, value in rows
            for episode in (0, 1)
        ]
    )  # fmt: skip
    frame.to_csv(folder / "robustness.csv", index=False)
    sha256 = read_json(folder / "done.json")["sha256"]["checkpoint.pt"]
    write_json(folder / "robustness.json", {"checkpoint_sha256": sha256})


def number_of(run):
    return (run.args["seed"] - 1) * 2 + run.args["agent"]


def attack_all(results, norm="linf"):
    for run in results.suite.runs:
        rows = [
            (attack, radius, norm, values[number_of(run)])
            for (name, attack, radius), values in RETURNS.items()
            if name == run.algorithm
        ]
        write_attacks(results, run, rows)


@pytest.fixture
def results(study):
    found = study(
        lambda *_: 1.0, lambda task, name, agent: float(agent), agents=4, final=lambda *_: 1.0
    )
    attack_all(found)
    return found


def test_each_agent_has_its_own_strongest_attack(results):
    frame = robustness_frame(results)
    assert list(frame.columns) == COLUMNS
    assert len(frame) == 8 * 4
    worst = strongest(frame)
    plain = worst[(worst["algorithm"] == "PPO") & (worst["radius"] == 0.1)]
    assert plain["attack"].tolist() == ["mad", "critic", "mad", "mad"]
    assert plain["return"].tolist() == [10, 20, 30, 50]


def test_the_median_agents_row_by_hand(results):
    plain, regularized = standings(results, robustness_frame(results))
    assert (plain.algorithm, regularized.algorithm) == ("PPO", "PPO reg")
    # 10, 20, 30, 50: of an even number the lower one is agent 1, whose critic attack is strongest
    assert plain.run == "ppo__Hopper__s1__a1"
    assert (plain.agents, plain.clean, plain.strongest) == (4, 200, "critic")
    assert plain.returns == {"mad": 90, "critic": 20}
    assert (plain.psi, plain.action_change, plain.smoothness) == (1.0, 0.5, 0.01)
    assert regularized.run == "ppo-reg__Hopper__s2__a0"  # -8, -7, -6, -5
    header, rows = to_rows([plain, regularized])
    assert header == [
        "task", "algorithm", "radius", "n", "no attack", "mad", "critic", "strongest", "retained",
        "psi", "Sm", "|Δa|",
    ]  # fmt: skip
    assert rows == [
        ["Hopper", "PPO", "0.1 l∞", "4", "200", "90.0", "20.0", "critic", "10%",
         "1.00", "0.0100", "0.500"],
        ["Hopper", "PPO reg", "0.1 l∞", "4", "-1.00", "-7.00", "-6.00", "mad", "–",
         "2.00", "0.0100", "0.500"],
    ]  # fmt: skip
    table = to_frame([plain, regularized])
    assert table["return, mad"].tolist() == [90, -7]


def test_a_return_that_falls_below_0_retains_no_share(results):
    (plain, _) = standings(results, robustness_frame(results))
    fallen = dataclasses.replace(plain, returns={"mad": 90.0, "critic": -20.0})
    assert to_rows([fallen])[1][0][8] == "–"


def test_an_attack_that_one_agent_lacks_does_not_count(results):
    """Else the others would look weaker for having been attacked in more ways."""
    run = next(run for run in results.suite.runs if run.run_id == "ppo__Hopper__s2__a1")
    write_attacks(results, run, [("critic", 0.0, "linf", 400), ("critic", 0.1, "linf", 60)])
    worst = strongest(robustness_frame(results))
    assert set(worst["attack"]) == {"critic"}
    assert len(worst) == 8 * 2


def test_norms_and_radii_stand_in_order(results):
    run = results.suite.runs[0]
    rows = [("mad", r, norm, 5) for r, norm in ((0.3, "linf"), (0.1, "linf"), (0.2, "l2"))]
    write_attacks(results, run, rows)
    for other in results.suite.runs[1:]:
        (results.folders[other.run_id] / "robustness.json").unlink()
    found = standings(results, robustness_frame(results))
    assert [(one.norm, one.radius) for one in found] == [("l2", 0.2), ("linf", 0.1), ("linf", 0.3)]
    assert np.isnan(found[0].clean)  # radius 0 was not played
    assert to_rows(found)[1][0][4] == "–"


@pytest.mark.parametrize("stale", ["checkpoint", "spec", "unfinished", "never"])
def test_what_is_not_of_this_final_policy_is_left_out(results, stale):
    run_id = results.suite.runs[0].run_id
    folder = results.folders[run_id]
    if stale == "checkpoint":
        write_json(folder / "robustness.json", {"checkpoint_sha256": "of a shorter run"})
    elif stale == "spec":
        longer = json.loads((folder / "spec.json").read_text())
        write_json(folder / "spec.json", {**longer, "args": {}})
    else:
        (folder / ("done.json" if stale == "unfinished" else "robustness.json")).unlink()
    frame = robustness_frame(results)
    assert run_id not in set(frame["run"])
    assert frame["run"].nunique() == 7


def test_without_attacks_there_are_no_rows(results):
    nothing = dataclasses.replace(results, specs={})
    frame = robustness_frame(nothing)
    assert list(frame.columns) == COLUMNS
    assert standings(nothing, frame) == []
