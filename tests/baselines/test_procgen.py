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
from baselines.ppo_reg_coinrun import GAMES, Args, Procgen, RunError, load_qt, make_env, play
from tests.baselines.helpers import Scripted

STAY, RIGHT, JUMP_RIGHT = 4, 7, 8
RIGHTWARD = (1, STAY, RIGHT, RIGHT, JUMP_RIGHT, JUMP_RIGHT, JUMP_RIGHT)


@pytest.fixture
def make():
    """Procgen, closed when the test ends."""
    made = []

    def build(game: str = "coinrun", num_envs: int = 1, **settings) -> Procgen:
        settings = {"distribution_mode": "easy", "num_threads": 1, **settings}
        args = Args(env_id=game, **settings)
        made.append(make_env(args, num_envs, args.start_level))
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


def test_the_engine_gets_every_setting():
    settings = {"num_levels": 9, "start_level": 4, "paint_vel_info": False, "restrict_themes": True}
    args = Args(env_id="maze", distribution_mode="easy", num_threads=3, **settings)
    for num_envs, num_threads in ((2, 2), (8, 3)):  # never more threads than environments
        env = make_env(args, num_envs, 7)
        assert (env.task, env.num_envs) == ("MazeEasy-v0", num_envs)
        assert env.options == {**settings, "start_level": 7, "num_threads": num_threads}


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
        for i in np.flatnonzero(info.get("_episode", [])):
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
            assert info["_episode"].tolist() == ended
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


def test_a_missing_engine_is_named_with_the_command(make, monkeypatch):
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(RunError, match="CoinRun needs EnvPool: pip install envpool"):
        make().reset(seed=0)


# --- play ----------------------------------------------------------------------------------------


class Mover(nn.Module):
    """Goes right, and jumps as a fixed function of the frame says."""

    def __init__(self) -> None:
        super().__init__()
        self.device = torch.device("cpu")
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


class OneStep:
    """Episodes of one step; it keeps the actions."""

    num_envs = 50_000

    def reset(self, seed):
        return np.zeros((self.num_envs, 1), np.uint8), {}

    def step(self, actions):
        self.actions = actions
        zeros = np.zeros(self.num_envs)
        info = {"episode": {"r": zeros, "l": zeros}, "_episode": np.ones(self.num_envs, bool)}
        return None, zeros, zeros, zeros, {**info, "success": zeros, "level_seed": zeros}


def test_sampled_play_acts_as_the_policy_is_distributed():
    logprobs = torch.randn(15, generator=torch.Generator().manual_seed(0)).log_softmax(-1)

    class Fixed(Mover):
        def forward(self, frames):
            return logprobs.repeat(len(frames), 1), None

    env = OneStep()
    play(Fixed(), env, 0, torch.Generator().manual_seed(1))
    expected = env.num_envs * logprobs.exp().double().numpy()
    found = np.bincount(env.actions, minlength=15)
    assert ((found - expected) ** 2 / expected).sum() < 36.1  # 99.9% of chi-square of 14


def test_play_is_without_dropout_and_leaves_the_agent_training():
    agent = Mover()
    play(agent, Scripted(lengths=[[3]]), 0, None)
    assert agent.trained_in == [False] * 3
    assert agent.training


@pytest.mark.parametrize("eval_dropout", [False, True])
def test_play_changes_no_parameter_and_no_dropout_mask(eval_dropout):
    args = Args(dropout=0.5, eval_dropout=eval_dropout)
    agent = ppo_reg_coinrun.Agent(args, torch.Generator())
    mask = agent.network[9].mask
    mask.zero_()
    mask[:, ::2] = 2.0
    before = {name: x.clone() for name, x in agent.state_dict().items()}
    play(agent, Scripted(lengths=[[2], [3]]), 0, torch.Generator())
    assert all(torch.equal(x, before[name]) for name, x in agent.state_dict().items())


# --- themes ---------------------------------------------------------------------------------------


def test_restricted_themes_show_one_ground_where_all_show_several(make):
    """The ground fills the lower left corner of every first frame."""

    def grounds(restrict: bool) -> int:
        corners = set()
        for level in range(12):
            settings = {"num_levels": 1, "start_level": level, "distribution_mode": "hard"}
            frame = make(**settings, restrict_themes=restrict).reset(seed=0)[0][0]
            corners.add(frame[:, 56:, :8].tobytes())
        return len(corners)

    assert grounds(restrict=False) > 1
    assert grounds(restrict=True) == 1


def test_a_level_is_laid_out_alike_whatever_its_themes(make):
    """The same actions lead to the same rewards and ends, on frames that differ."""
    answers = []
    frames = []
    for restrict in (False, True):
        env = make(num_envs=16, distribution_mode="hard", restrict_themes=restrict)
        frames.append(env.reset(seed=3)[0].copy())
        steps = list(play_randomly(env, 300))
        answers.append([(r.tolist(), t.tolist(), c.tolist()) for _, r, t, c, _ in steps])
        assert any("episode" in info for *_, info in steps)

    assert answers[0] == answers[1]
    assert (frames[0] != frames[1]).any()
