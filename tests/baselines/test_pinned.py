"""A baseline's numbers do not change unless its version says so."""

from __future__ import annotations

import json
import math

import pytest

from tests.baselines.pinned import (
    ABSOLUTE,
    PINNED,
    RELATIVE,
    RUNS,
    differences,
    excess,
    train,
    version_of,
)

AGAIN = "python -m tests.baselines.pinned --write"


@pytest.fixture(scope="module")
def pinned() -> dict:
    assert PINNED.exists(), f"pin the numbers first: {AGAIN}"
    return json.loads(PINNED.read_text())


@pytest.mark.parametrize("name", RUNS)
def test_numbers_change_only_with_the_version(name, pinned, tmp_path):
    version, before = pinned[name]["version"], pinned[name]["metrics"]
    assert version_of(name) == version, f"the version of {name} was raised: {AGAIN}"
    found = train(name, tmp_path)
    assert found.keys() == before.keys()
    changed = [text for run in before for text in differences(before[run], found[run])]
    assert not changed, f"raise the VERSION of {name} and pin again ({AGAIN}): {changed}"


@pytest.mark.parametrize(
    "changes",
    [
        {"learning_rate": 3.1e-4},
        {"gae_lambda": 0.94},
        {"clip_coef": 0.19},
        {"coefficient": 0.9},
        {"max_grad_norm": 0.4},
        {"vf_epochs": 9},
        {"lambda_min": 0.9},
    ],
    ids=str,
)
def test_a_small_change_of_a_setting_is_noticed(changes, pinned, tmp_path):
    found = train("ppo_reg", tmp_path, **changes)
    assert differences(pinned["ppo_reg"]["metrics"]["a0"], found["a0"])


def test_what_counts_as_a_difference():
    assert excess(1.0, 1.0 + ABSOLUTE + 0.9 * RELATIVE) < 0
    assert excess(1.0, 1.0 - ABSOLUTE - 1.1 * RELATIVE) > 0
    assert excess(None, None) == 0
    assert excess(None, 1.0) == excess(1.0, None) == math.inf


def test_only_pinned_columns_count():
    before = {"a": [1.0, None], "b": [2.0, 2.0]}
    assert differences(before, {**before, "new": [0.0, 0.0]}) == []
    assert differences(before, {"a": [1.0, None]}) == ["b: [2.0, 2.0] -> None"]
    assert differences(before, {**before, "b": [2.0, 2.5]}) == ["b: 2.0 -> 2.5"]
    assert differences(before, {**before, "b": [2.0]}) == ["b: [2.0, 2.0] -> [2.0]"]
    assert differences(before, {"a": [1.0, 0.0], "b": [2.0, 2.0]}) == ["a: None -> 0.0"]
