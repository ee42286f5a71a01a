"""Published numbers, as they were printed."""

from __future__ import annotations

import pytest

from harness.report.published import deviations, paper_numbers, zoo_numbers
from harness.suite import load_suite

TASKS = [
    "Humanoid", "Hopper", "Ant", "Reacher", "DoublePendulum", "Walker2D", "HumanoidFlagrun",
    "HalfCheetah",
]  # fmt: skip
TABLE1 = {
    "PPO": [73.1, 106.8, 414.1, -13.5, 4534.9, 55.1, 43.6, 9.9],
    "PPO reg": [73.2, 18.6, 294.8, -7.4, 4978.4, 74.2, 38.4, 941.2],
    "TRPO": [165.6, 1697.0, 1376.8, 18.2, 6993.6, 892.4, 98.7, 1795.3],
    "TRPO reg": [245.8, 2001.2, 1379.4, 17.7, 8213.8, 1013.5, 98.7, 1843.3],
}
EIGHT = ["PPO", "PPO reg", "PPO-l2", "PPO-l2 reg", "PPO-D", "PPO-D reg", "PPO-IMP", "PPO-IMP reg"]
SEEN = [55, 60.7, 57.2, 61, 54.5, 60.2, 59, 68.2]
UNSEEN = [14, 20, 18.5, 30.5, 19.2, 20, 26, 32.8]
ZOO = {
    "PPO": {
        "Ant": (2866, 56, 2e6), "HalfCheetah": (2925, 64, 2e6), "Hopper": (2575, 223, 2e6),
        "Reacher": (17.1, 11.0, 1e6), "Walker2D": (2110, 14, 2e6),
    },
    "TRPO": {
        "Ant": (2561, 52, 2e6), "HalfCheetah": (2759, 327, 2e6), "Hopper": (2565, 410, 1e6),
        "Reacher": (14.7, 11.6, 3e5), "Walker2D": (1483, 823, 2e6),
    },
}  # fmt: skip


def test_table_1_is_the_papers():
    paper = paper_numbers("table1")
    for algorithm, numbers in TABLE1.items():
        assert paper[algorithm] == dict(zip(TASKS, numbers, strict=True))
    assert (paper["timesteps"], paper["seeds"], paper["agents"]) == (5_000_000, 3, 10)


def test_the_suite_names_tasks_and_algorithms_as_the_paper_does():
    suite = load_suite("table1")
    assert suite.environments == TASKS
    assert suite.algorithms == list(TABLE1)


def test_table_2_is_the_papers():
    paper = paper_numbers("table2")
    assert paper["seen"] == dict(zip(EIGHT, SEEN, strict=True))
    assert paper["unseen"] == dict(zip(EIGHT, UNSEEN, strict=True))
    assert (paper["timesteps"], paper["seeds"]) == (50_000_000, 1)
    assert (paper["levels"], paper["repeats"]) == (500, 20)


@pytest.mark.parametrize("name", ["table2", "smoke_coinrun"])
def test_the_suites_name_their_agents_as_the_paper_does(name):
    assert load_suite(name).algorithms == EIGHT


def test_there_is_no_other_table():
    with pytest.raises(KeyError, match="table3"):
        paper_numbers("table3")


@pytest.mark.parametrize("algorithm", ["PPO", "TRPO"])
def test_the_zoos_agents_are_the_zoos(algorithm):
    found = {
        task: (numbers["mean"], numbers["deviation"], numbers["steps"])
        for task, numbers in zoo_numbers(algorithm).items()
    }
    assert found == ZOO[algorithm]


def test_the_zoo_has_no_regularized_agents():
    assert zoo_numbers("PPO reg") == {}


@pytest.mark.parametrize(
    ("heading", "words"),
    [
        ("What differs from the paper", ("HalfCheetah", "Time limits", "Optimization")),
        ("CoinRun today", ("EnvPool", "15 actions", "velocity", "visual themes", "Dropout",
                           "new levels", "difficulty 3", "clipped as PPO's ratio")),
    ],
)  # fmt: skip
def test_each_deviation_that_a_reader_would_ask_for_is_named(heading, words):
    section = deviations(heading)
    assert all(word in section for word in words)
    assert "\n## " not in section


def test_a_section_that_there_is_not_is_an_error():
    with pytest.raises(ValueError, match="no section 'Elsewhere'"):
        deviations("Elsewhere")
