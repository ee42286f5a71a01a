"""Procgen as a Gymnasium vector environment, and the first episodes that `play` keeps of it."""

from __future__ import annotations

import ctypes
import importlib.util
import re
import sys
import types

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

from baselines import ppo_reg_coinrun
from baselines.ppo_reg_coinrun import GAMES, Procgen, RunError, load_qt, play
from tests.baselines.helpers import Scripted

STAY, RIGHT, JUMP_RIGHT = 4, 7, 8
RIGHTWARD = (1, STAY, RIGHT, RIGHT, JUMP_RIGHT, JUMP_RIGHT, JUMP_RIGHT)


@pytest.fixture
def make():
    """Procgen, closed when the test ends."""
    made = []

    def build(*args, **kwargs) -> Procgen:
        made.append(Procgen(*args, **{"distribution_mode": "easy", "num_threads": 1, **kwargs}))
        return made[-1]

    yield build
    for env in made:
        env.close()


def play_randomly(env: Procgen, steps: int, seed: int = 0):
    """What each step returned; mostly to the right, so that episodes end."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        yield env.step(rng.choice(RIGHTWARD, env.num_envs))


def first_frames(make, levels) -> dict[bytes, int]:
    """The level that begins with this frame."""
    frames = {}
    for level in levels:
        env = make(num_levels=1, start_level=level)
        frames[env.reset(seed=0)[0].tobytes()] = level
    assert len(frames) == len(levels)
    return frames


# --- the contract of a vector environment --------------------------------------------------------


def test_spaces_and_dtypes(make):
    env = make(num_envs=3)
    assert env.single_observation_space == gym.spaces.Box(0, 255, (3, 64, 64), np.uint8)
    assert env.single_action_space == gym.spaces.Discrete(15)
    assert env.observation_space.shape == (3, 3, 64, 64)
    assert env.action_space == gym.spaces.MultiDiscrete([15] * 3)
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    frames, info = env.reset(seed=0)
    assert frames in env.observation_space
    assert info == {}
    frames, rewards, terminations, truncations, info = env.step(env.action_space.sample())
    assert frames in env.observation_space
    assert rewards.shape == terminations.shape == truncations.shape == (3,)
    assert np.issubdtype(rewards.dtype, np.floating)
    assert terminations.dtype == truncations.dtype == info["reset"].dtype == bool
    assert list(info) == ["reset"]  # nothing more until an episode ends


def test_frames_are_channel_first(make):
    """A coinrun level's sky and ground differ from row to row more than colors would."""
    frame = make(num_levels=1).reset(seed=0)[0][0].astype(float)
    neighbours = [np.abs(np.diff(frame, axis=axis)).mean() for axis in (1, 2)]
    assert max(neighbours) < np.abs(np.diff(frame, axis=0)).mean()


@pytest.mark.parametrize("game", GAMES)
def test_every_game_runs_and_is_deterministic(make, game):
    runs = []
    for _ in range(2):
        env = make(game, num_envs=2, num_levels=3)
        env.reset(seed=1)
        runs.append([(step[0].copy(), step[1].copy()) for step in play_randomly(env, 5)])
    for (frames, rewards), (again, rewards_again) in zip(*runs, strict=True):
        np.testing.assert_array_equal(frames, again)
        np.testing.assert_array_equal(rewards, rewards_again)
    assert len({frames.tobytes() for frames, _ in runs[0]}) > 1


def test_a_seed_decides_the_levels_and_another_seed_others(make):
    env = make(num_envs=8)
    frames = [env.reset(seed=seed)[0].copy() for seed in (1, 1, 2)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[0] != frames[2]).any()
    env.reset(seed=1)
    assert (env.reset()[0] != frames[0]).any()  # without a seed the stream goes on


def test_a_seed_decides_the_episodes_that_follow_too(make):
    env, ends = make(num_envs=8, num_levels=0), []
    for _ in range(2):
        env.reset(seed=3)
        steps = list(play_randomly(env, 300))
        assert any("episode" in info for *_, info in steps)
        ends.append([info["level_seed"].tolist() for *_, info in steps if "episode" in info])
    assert ends[0] == ends[1]


def test_step_async_and_step_wait_are_step(make):
    whole, halves = make(num_envs=4), make(num_envs=4)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(whole.reset(seed=2)[0], halves.reset(seed=2)[0])
    for _ in range(200):
        actions = rng.integers(15, size=4)
        halves.step_async(actions)
        for one, other in zip(whole.step(actions)[:4], halves.step_wait()[:4], strict=True):
            np.testing.assert_array_equal(one, other)


def test_closing_twice_and_resetting_after_it(make):
    env = make()
    env.close()
    env.close()
    assert make().reset(seed=0)[0].shape == (1, 3, 64, 64)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_levels": -1}, "num_levels must be at least 0, got -1"),
        ({"start_level": -5}, "start_level must be at least 0, got -5"),
        ({"num_threads": -2}, "num_threads must be at least 0, got -2"),
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"distribution_mode": "extreme"}, "must be one of easy, hard, got 'extreme'"),
        ({"game": "coinrunner"}, "game must be one of bigfish, .*, got 'coinrunner'"),
        ({"backend": "unity"}, "backend must be one of envpool, procgen, got 'unity'"),
    ],
)
def test_what_the_engine_would_misread_is_refused(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_stepping_before_a_reset_is_refused(make):
    with pytest.raises(gym.error.ResetNeeded, match="reset the environments before"):
        make().step(np.zeros(1, int))


# --- episodes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("start", "count"), [(0, 6), (500, 6)])
def test_level_seed_names_the_level_that_was_played(make, start, count):
    levels = first_frames(make, range(start, start + count))
    env = make(num_envs=16, num_levels=count, start_level=start)
    playing = [levels[frame.tobytes()] for frame in env.reset(seed=0)[0]]
    seen = []
    for frames, *_, info in play_randomly(env, 600):
        for i in np.flatnonzero(info["reset"]):
            playing[i] = levels[frames[i].tobytes()]
        for i in np.flatnonzero(info.get("_level_seed", [])):
            assert info["level_seed"][i] == playing[i]
            seen.append(playing[i])
    assert set(seen) == set(range(start, start + count))


def test_num_levels_0_has_no_bound_and_no_start(make):
    env, seeds = make(num_envs=16, num_levels=0, start_level=7), set()
    env.reset(seed=0)
    for *_, info in play_randomly(env, 400):
        seeds |= set(np.extract(info.get("_episode", []), info.get("level_seed", [])).tolist())
    assert len(seeds) > 5
    assert max(seeds) > 10_000


def test_a_reset_spends_one_step_after_each_end_and_counts_as_none(make):
    """6,400 steps counted by hand: what is in `info` is what was seen."""
    env = make(num_envs=8, num_levels=20)
    env.reset(seed=0)
    lengths, returns, ended = [0] * 8, [0.0] * 8, [False] * 8
    ends = resets = steps = 0
    for _, rewards, terminations, truncations, info in play_randomly(env, 800):
        assert info["reset"].tolist() == ended
        for i in range(8):
            if ended[i]:
                resets += 1
                assert rewards[i] == 0
                lengths[i], returns[i] = 0, 0.0
            else:
                steps += 1
                lengths[i] += 1
                returns[i] += rewards[i]
        ended = (terminations | truncations).tolist()
        assert not (terminations & truncations).any()
        assert any(ended) == ("episode" in info)
        if any(ended):
            for mask in ("_episode", "_success", "_level_seed"):
                assert info[mask].tolist() == ended
            for i in np.flatnonzero(ended):
                ends += 1
                assert (info["episode"]["l"][i], info["episode"]["r"][i]) == (
                    lengths[i],
                    returns[i],
                )
                assert info["success"][i] == (returns[i] == 10)
    assert ends >= 20
    assert resets == ends - sum(ended)
    assert steps + resets == 6400


def test_statistics_of_an_earlier_step_are_not_overwritten(make):
    env, kept = make(num_envs=8), []
    env.reset(seed=0)
    for *_, info in play_randomly(env, 300):
        if "episode" in info:
            kept.append((info["episode"]["l"], info["episode"]["l"].copy(), info["_episode"]))
            assert kept[-1][2].any()
    assert all((lengths == copy).all() and mask.any() for lengths, copy, mask in kept)


def test_the_action_after_an_end_is_ignored(make):
    """Two pools that differ in nothing but that action go on alike."""
    pools = make(num_envs=8), make(num_envs=8)
    rng, resets = np.random.default_rng(0), 0
    ended = np.zeros(8, bool)
    for env in pools:
        env.reset(seed=4)
    for _ in range(400):
        actions = rng.choice(RIGHTWARD, 8)
        answers = [env.step(np.where(ended, x, actions)) for env, x in zip(pools, (0, 8))]  # noqa: B905
        np.testing.assert_array_equal(answers[0][0], answers[1][0])
        np.testing.assert_array_equal(answers[0][1], answers[1][1])
        ended = answers[0][2] | answers[0][3]
        resets += ended.sum()
    assert resets > 5


def test_1000_steps_are_a_truncation(make):
    env = make(num_envs=8, num_levels=0)
    env.reset(seed=0)
    for t in range(1, 1001):
        _, _, terminations, truncations, info = env.step(np.full(8, STAY))
        assert not truncations.any() or t == 1000
    assert truncations.any()
    assert not terminations[truncations].any()
    assert (info["episode"]["l"][truncations] == 1000).all()
    assert not info["success"][truncations].any()


# --- what is not installed -----------------------------------------------------------------------


def refuse(path, mode=None):
    raise OSError(f"{path}: cannot open shared object file")


@pytest.fixture
def qt(monkeypatch):
    """Stand-ins for what loads Qt, which record what they load; the wheel is in /wheel."""
    loaded = []
    wheel = types.SimpleNamespace(submodule_search_locations=["/wheel/PyQt5"])
    headless = types.SimpleNamespace(load_headless_qt=refuse)

    def load(path, mode):
        assert mode == ctypes.RTLD_GLOBAL
        loaded.append(path)

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: wheel)
    monkeypatch.setattr(ctypes, "CDLL", load)
    monkeypatch.setattr(ppo_reg_coinrun, "headless_qt", headless)
    return types.SimpleNamespace(loaded=loaded, load=load, headless=headless)


@pytest.mark.parametrize("alone", [False, True])
def test_without_qt_the_error_says_what_to_install(qt, monkeypatch, alone):
    monkeypatch.setattr(ctypes, "CDLL", refuse)
    if alone:
        monkeypatch.setattr(ppo_reg_coinrun, "headless_qt", None)
    with pytest.raises(RunError, match=r"pip install PyQt5-Qt5.*libgl1, libglib2") as error:
        load_qt.__wrapped__()
    tried = ["libQt5Gui.so.5", *["/wheel/PyQt5/Qt5/lib/libQt5Gui.so.5"] * (1 if alone else 2)]
    assert re.findall(r"(\S+): cannot open", str(error.value)) == tried


def test_without_the_wheel_the_error_says_what_to_install(qt, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", refuse)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RunError, match=r"pip install PyQt5-Qt5.*libQt5Gui\.so\.5: cannot open"):
        load_qt.__wrapped__()


def test_qt_is_taken_from_the_system_if_it_has_it(qt):
    load_qt.__wrapped__()
    assert qt.loaded == ["libQt5Gui.so.5"]


def test_qt_is_taken_from_the_wheel_otherwise(qt, monkeypatch):
    def load(path, mode):
        return qt.load(path, mode) if "/" in path else refuse(path)

    monkeypatch.setattr(ctypes, "CDLL", load)
    load_qt.__wrapped__()
    assert qt.loaded == ["/wheel/PyQt5/Qt5/lib/libQt5Gui.so.5"]


def test_qt_is_loaded_headless_where_all_else_fails(qt, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", refuse)
    qt.headless.load_headless_qt = qt.loaded.append
    load_qt.__wrapped__()
    assert qt.loaded == ["/wheel/PyQt5/Qt5/lib/libQt5Gui.so.5"]


@pytest.mark.parametrize(
    ("backend", "module", "command"),
    [
        ("envpool", "envpool", "pip install envpool"),
        ("procgen", "procgen", "pip install procgen-mirror"),
    ],
)
def test_a_missing_engine_is_named_with_the_command(make, monkeypatch, backend, module, command):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(RunError, match=f"backend {backend} needs .*{command}"):
        make(backend=backend).reset(seed=0)


# --- play ----------------------------------------------------------------------------------------


class Mover(nn.Module):
    """Goes right, and jumps as a fixed function of the frame says; its dropout drops all."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mask", torch.zeros(4))
        self.trained_in: list[bool] = []

    def forward(self, frames):
        self.trained_in.append(self.training)
        logits = torch.full((len(frames), 15), -4.0)
        logits[:, RIGHT] = 1.0
        logits[:, JUMP_RIGHT] = 2 * frames.float().mean((1, 2, 3)).mul(7).sin()
        return logits.log_softmax(-1), torch.zeros(len(frames))


def test_play_keeps_the_first_episode_of_each_environment():
    """The short episodes of one environment would push the long one of another out."""
    env = Scripted(lengths=[[2, 2, 2, 2], [9, 1], [6, 1, 1]])
    found = play(Mover(), env, 0, None)
    assert found["length"].tolist() == [2, 9, 6]
    assert found["level_seed"].tolist() == [0, 100, 200]
    assert found["return"].tolist() == [0.0, 10.0, 0.0]
    assert found["success"].tolist() == [False, True, False]


def test_greedy_play_of_one_level_is_one_episode_in_every_environment(make):
    runs = [play(Mover(), make(num_envs=4, num_levels=1, start_level=3), s, None) for s in (0, 1)]
    for run in runs:
        assert run["level_seed"].tolist() == [3] * 4
        for name in ("success", "return", "length"):
            assert len({*run[name].tolist(), *runs[0][name].tolist()}) == 1


def test_sampled_play_is_decided_by_the_generator(make):
    def lengths(seed: int) -> list[int]:
        rng = torch.Generator().manual_seed(seed)
        return play(Mover(), make(num_envs=4, num_levels=1), 0, rng)["length"].tolist()

    assert lengths(0) == lengths(0)
    assert lengths(0) != lengths(1)
    assert len(set(lengths(0))) > 1


def test_play_is_without_dropout_and_leaves_the_agent_training():
    agent = Mover()
    play(agent, Scripted(lengths=[[3]]), 0, None)
    assert agent.trained_in == [False] * 3
    assert agent.training


def test_play_changes_no_parameter_and_no_dropout_mask():
    args = ppo_reg_coinrun.Args(dropout=0.5)
    agent = ppo_reg_coinrun.Agent(args, torch.Generator())
    agent.mask.zero_()
    agent.mask[::2] = 2.0
    before = {name: x.clone() for name, x in agent.state_dict().items()}
    play(agent, Scripted(lengths=[[2], [3]]), 0, torch.Generator())
    assert all(torch.equal(x, before[name]) for name, x in agent.state_dict().items())


# --- OpenAI's engine, its package faked ----------------------------------------------------------


class FakeProcgenGym3Env:
    """Episodes of the lengths that it is told, in the order and with the fields of the real one."""

    lengths: tuple[int, ...] = ()
    made: list[dict] = []  # noqa: RUF012

    def __init__(self, **kwargs) -> None:
        self.made.append(kwargs)
        self.num, self.t, self.first = kwargs["num"], np.zeros(kwargs["num"], int), True
        self.episode = np.zeros(self.num, int)
        self.rewards, self.ended = np.zeros(self.num, np.float32), np.ones(self.num, bool)

    def observe(self):
        rgb = np.zeros((self.num, 64, 64, 3), np.uint8)
        rgb[..., 0] = (self.t % 256)[:, None, None]
        rgb[..., 2] = 7
        return self.rewards, {"rgb": rgb}, self.ended

    def act(self, actions):
        assert actions.dtype == np.int32
        self.t += 1
        self.ended = self.t == np.array(self.lengths)
        self.won = self.ended & (self.t < 1000)
        self.rewards = np.where(self.won, 10, 0).astype(np.float32)
        self.previous = self.episode.copy()
        self.episode += self.ended
        self.t[self.ended] = 0

    def get_info(self):
        columns = zip(self.previous, self.won, self.episode, strict=True)
        names = ("prev_level_seed", "prev_level_complete", "level_seed")
        return [dict(zip(names, (int(x) for x in row), strict=True)) for row in columns]

    def close(self):
        pass


@pytest.fixture
def fake_procgen(monkeypatch):
    monkeypatch.setitem(
        sys.modules, "procgen", types.SimpleNamespace(ProcgenGym3Env=FakeProcgenGym3Env)
    )
    monkeypatch.setattr(FakeProcgenGym3Env, "made", [])

    def set_lengths(*lengths: int) -> None:
        monkeypatch.setattr(FakeProcgenGym3Env, "lengths", lengths)

    return set_lengths


def test_the_original_engine_gets_the_settings(make, fake_procgen):
    settings = {"num_levels": 9, "start_level": 4, "paint_vel_info": False}
    env = make("maze", 2, backend="procgen", **settings, distribution_mode="hard", num_threads=3)
    env.reset(seed=5)
    made = FakeProcgenGym3Env.made[0]
    assert isinstance(made.pop("rand_seed"), int)
    expected = {"num": 2, "env_name": "maze", "distribution_mode": "hard", "num_threads": 3}
    assert made == {**expected, **settings}


def test_the_original_engine_begins_an_episode_in_the_step_that_ends_one(make, fake_procgen):
    fake_procgen(3, 5)
    env = make(num_envs=2, backend="procgen")
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    frames, _ = env.reset(seed=0)
    assert frames.shape == (2, 3, 64, 64)
    assert frames[0, :, 0, 0].tolist() == [0, 0, 7]
    seen = []
    for _ in range(10):
        frames, rewards, terminations, truncations, info = env.step(np.zeros(2, int))
        assert not info["reset"].any()
        assert not truncations.any()
        for i in np.flatnonzero(terminations):
            assert frames[i, 0, 0, 0] == 0  # the next episode's
            assert rewards[i] == 10
            row = (info["episode"]["l"][i], info["episode"]["r"][i], info["level_seed"][i])
            seen.append((i, *(int(x) for x in row), bool(info["success"][i])))
            assert info["_success"][i]
    ends = [(0, 3, 0), (1, 5, 0), (0, 3, 1), (0, 3, 2), (1, 5, 1)]
    assert seen == [(i, length, 10, level, True) for i, length, level in ends]


@pytest.mark.parametrize(("game", "limit"), [("coinrun", 1000), ("maze", 500), ("plunder", 4000)])
def test_the_original_engines_time_limit_is_a_truncation(make, fake_procgen, game, limit):
    fake_procgen(limit, limit - 1)
    env = make(game, num_envs=2, backend="procgen")
    env.reset(seed=0)
    for _ in range(limit):
        _, _, terminations, truncations, info = env.step(np.zeros(2, int))
        if truncations[0]:
            assert info["episode"]["l"][0] == limit
        if terminations[1]:
            assert info["episode"]["l"][1] == limit - 1
    assert truncations.tolist() == [True, False]
    assert not terminations.any()


@pytest.mark.parametrize("game", GAMES)
def test_the_original_engines_time_limits_are_those_of_envpools_port(make, game):
    env = make(game)
    env.reset(seed=0)
    limit = env.engine.pool.spec.config.max_episode_steps
    assert ppo_reg_coinrun.TIME_LIMITS.get(game, 1000) == limit
