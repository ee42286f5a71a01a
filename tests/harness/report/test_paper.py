"""The paper's numbers, as it prints them."""

from __future__ import annotations

import pytest

from harness.report.paper import paper_numbers
from harness.suite import load_suite

EIGHT = ["PPO", "PPO reg", "PPO-l2", "PPO-l2 reg", "PPO-D", "PPO-D reg", "PPO-IMP", "PPO-IMP reg"]


def test_table_1_has_a_number_for_each_task_and_algorithm():
    paper, suite = paper_numbers("table1"), load_suite("table1")
    for algorithm in suite.algorithms:
        assert list(paper[algorithm]) == suite.environments
    assert (paper["timesteps"], paper["seeds"], paper["agents"]) == (5_000_000, 3, 10)


def test_table_2_is_the_papers():
    paper = paper_numbers("table2")
    seen = [55, 60.7, 57.2, 61, 54.5, 60.2, 59, 68.2]
    unseen = [14, 20, 18.5, 30.5, 19.2, 20, 26, 32.8]
    assert paper["seen"] == dict(zip(EIGHT, seen, strict=True))
    assert paper["unseen"] == dict(zip(EIGHT, unseen, strict=True))
    assert (paper["timesteps"], paper["seeds"]) == (50_000_000, 1)
    assert (paper["levels"], paper["repeats"]) == (500, 20)


@pytest.mark.parametrize("name", ["table2", "smoke_coinrun"])
def test_the_suites_name_their_agents_as_the_paper_does(name):
    assert load_suite(name).algorithms == EIGHT


def test_there_is_no_other_table():
    with pytest.raises(KeyError, match="table3"):
        paper_numbers("table3")
