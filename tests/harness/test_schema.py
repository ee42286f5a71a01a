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
            r"evaluation: key 'unsen' is unknown: unseen\?",
        ),
        ("[evaluation]\nlevels = 2\nrepeat = 2", "key 'repeat' is unknown: repeats?"),
        ("[evaluation]\nlevels = 0\nrepeats = 2", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2\nrepeats = -1", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2.0\nrepeats = 2", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2\nrepeats = true", "must hold numbers of at least 1"),
        ("[evaluation]\nlevels = 2\nrepeats = '2'", "must hold numbers of at least 1"),
        (
            "[evaluation]\nlevels = 2\nrepeats = 2\nunseen = 'later'",
            "unseen must be next or unbounded or themes, got 'later'",
        ),
        ("[evaluation]\nlevels = 2\nrepeats = 2\nunseen = 3", "themes, got 3"),
        ("[evaluation]\nepisodes = 0", "must hold numbers of at least 1"),
        ("[evaluation]\nepisodes = 2.5", "must hold numbers of at least 1"),
        ("[evaluation]\nepisodes = 2\nlevels = 2", "key 'levels' is unknown: episodes"),
        ("[evaluation]\nepisodes = 2\nunseen = 'next'", "key 'unseen' is unknown: episodes"),
        ("[evaluation]\nepisode = 2", r"key 'episode' is unknown: episodes\?"),
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


EPISODES, LEVELS = {"episodes": 2}, {"levels": 2, "repeats": 2}


def test_each_kind_of_baseline_has_its_own_evaluation():
    control = {"env_id": "Pendulum-v1", "total_timesteps": 10_000}
    games = {"env_id": "coinrun", "total_timesteps": 10_000}
    for baseline in ("ppo_reg", "trpo_reg"):
        check_args(baseline, control, EPISODES, "here")
        with pytest.raises(SuiteError, match="here: evaluation needs episodes, got levels, rep"):
            check_args(baseline, control, LEVELS, "here")
    for unseen in ("next", "unbounded"):
        check_args("ppo_reg_coinrun", games, {**LEVELS, "unseen": unseen}, "here")
    with pytest.raises(SuiteError, match="here: evaluation needs levels and repeats, got episodes"):
        check_args("ppo_reg_coinrun", games, EPISODES, "here")


def test_unseen_themes_need_an_agent_that_trained_without_them():
    games, asked = {"env_id": "coinrun", "total_timesteps": 10_000}, {**LEVELS, "unseen": "themes"}
    check_args("ppo_reg_coinrun", games | {"restrict_themes": True}, asked, "here")
    with pytest.raises(SuiteError, match="unseen = 'themes' needs restrict_themes = true"):
        check_args("ppo_reg_coinrun", games, asked, "here")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"num_levels": 1}, "2 levels to be evaluated on, but it is trained on 1"),
        ({"num_levels": 0}, "2 levels to be evaluated on, but it is trained on no countable ones"),
    ],
)
def test_an_evaluation_that_cannot_be_is_refused_before_training(more, message):
    args = {"env_id": "coinrun", "total_timesteps": 10_000} | more
    with pytest.raises(SuiteError, match=message):
        check_args("ppo_reg_coinrun", args, LEVELS, "here")
