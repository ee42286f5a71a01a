"""The format of a suite's file: keys, types and arguments, and what each refusal says."""

from __future__ import annotations

import types
from typing import Any, Literal

import pytest

from harness.schema import SuiteError, check_args, check_known, fits, read

COINRUN = {"env_id": "coinrun", "total_timesteps": 16, "num_envs": 2, "num_steps": 8}
COINRUN |= {"num_minibatches": 2}
INCLUDING = 'title = "Both"\ninclude = ["table1", "figure1"]\n'


@pytest.mark.parametrize(
    ("value", "hint", "fit"),
    [
        (1, int, True),
        (True, int, False),
        (1.0, int, False),
        (1, float, True),
        (1.5, float, True),
        (True, float, False),
        ("1", float, False),
        (True, bool, True),
        (1, bool, False),
        ("tanh", Literal["tanh", "relu"], True),
        ("gelu", Literal["tanh", "relu"], False),
        ([1, 2], tuple[int, ...], True),
        ([], tuple[int, ...], True),
        ([1, "2"], tuple[int, ...], False),
        (1, tuple[int, ...], False),
        (1, int | None, True),
        ("1", int | None, False),
        ({}, dict, True),
    ],
)
def test_a_value_fits_its_type(value: Any, hint: type | types.UnionType, fit: bool):
    assert fits(value, hint) is fit


def test_an_unknown_name_is_answered_with_the_closest_or_with_all():
    with pytest.raises(SuiteError, match=r"key 'sedes' is unknown: seeds\?"):
        check_known({"sedes": 1}, {"seeds", "agents"}, "key")
    with pytest.raises(SuiteError, match=r"key 'xyz' is unknown: agents or seeds\?"):
        check_known({"xyz": 1}, {"seeds", "agents"}, "key")


def test_games_are_checked_by_their_baseline_and_tasks_by_gymnasium():
    check_args("ppo_reg_coinrun", COINRUN, {}, "here")
    with pytest.raises(SuiteError, match=r"here: env_id must be one of .*coinrun.*got 'coinrum'"):
        check_args("ppo_reg_coinrun", COINRUN | {"env_id": "coinrum"}, {}, "here")
    with pytest.raises(SuiteError, match="coinrun"):
        check_args("ppo_reg", {"env_id": "coinrun"}, {}, "here")


def test_what_is_no_baseline_is_refused():
    with pytest.raises(SuiteError, match="here: baseline 'ppo' cannot be imported"):
        check_args("ppo", COINRUN, {}, "here")


def test_a_suite_that_only_includes_others_needs_no_algorithms(tmp_path):
    path = tmp_path / "both.toml"
    path.write_text(INCLUDING)
    assert read(str(path)) == (path, {"title": "Both", "include": ["table1", "figure1"]})


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[figures]\n"All" = ["PPO"]', "key 'figures' is unknown"),
        ("[evaluation]\nlevels = 2\nrepeats = 2", "key 'evaluation' is unknown"),
        ("[[sweeps]]\nname = 'x'", "key 'sweeps' is unknown"),
        ("inclde = ['x']", "key 'inclde' is unknown: include?"),
        ("seeds = [1]", "both.toml needs the key 'agents'"),
        ("[environments]\nCoinRun = 'coinrun'", "both.toml needs the key 'agents'"),
    ],
)
def test_a_suite_that_only_includes_others_has_nothing_that_would_go_unheard(
    tmp_path, more, message
):
    path = tmp_path / "both.toml"
    path.write_text(INCLUDING + more)
    with pytest.raises(SuiteError, match=message):
        read(str(path))


@pytest.mark.parametrize("include", ['"table1"', "[1]", "3"])
def test_include_is_a_list_of_names(tmp_path, include):
    path = tmp_path / "both.toml"
    path.write_text(f'title = "Both"\ninclude = {include}')
    with pytest.raises(SuiteError, match=r"both\.toml: include must be of type .*str"):
        read(str(path))


def test_a_suite_needs_a_title_whatever_it_includes(tmp_path):
    path = tmp_path / "both.toml"
    path.write_text('include = ["table1"]')
    with pytest.raises(SuiteError, match="needs the key 'title'"):
        read(str(path))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[evaluation]\nlevels = 2", "evaluation needs the key 'repeats'"),
        ("[evaluation]\nrepeats = 2", "evaluation needs the key 'levels'"),
        ("[evaluation]", "evaluation needs the key 'levels'"),
        (
            "[evaluation]\nlevels = 2\nrepeats = 2\nunsen = 1",
            "evaluation: key 'unsen' is unknown: levels or repeats?",
        ),
        ("[evaluation]\nlevels = 2\nrepeat = 2", "key 'repeat' is unknown: repeats?"),
        ("[evaluation]\nlevels = 0\nrepeats = 2", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2\nrepeats = -1", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2.0\nrepeats = 2", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2\nrepeats = true", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2\nrepeats = '2'", "must hold numbers of at least 1"),
    ],
)
def test_a_bad_evaluation_is_refused_and_the_reason_told(suite_file, table, message):
    suite_file.write_text(f"{suite_file.read_text()}\n{table}\n")
    with pytest.raises(SuiteError, match=message):
        read(str(suite_file))


@pytest.mark.parametrize("value", ["3", "[2, 2]", "true"])
def test_an_evaluation_is_a_table(suite_file, value):
    suite_file.write_text(f"evaluation = {value}\n{suite_file.read_text()}")
    with pytest.raises(SuiteError, match=r"tiny\.toml: evaluation must be of type .*dict"):
        read(str(suite_file))


@pytest.mark.parametrize(
    ("baseline", "levels", "message"),
    [
        ("ppo_reg", 1, "1 levels to be evaluated on, but it is trained on no countable ones"),
        ("ppo_reg_coinrun", 501, "501 levels to be evaluated on, but it is trained on 500"),
    ],
)
def test_an_evaluation_that_cannot_be_is_refused_before_training(baseline, levels, message):
    env_id = "coinrun" if baseline == "ppo_reg_coinrun" else "Pendulum-v1"
    args = {"env_id": env_id, "total_timesteps": 10_000}
    with pytest.raises(SuiteError, match=message):
        check_args(baseline, args, {"levels": levels, "repeats": 1}, "here")
