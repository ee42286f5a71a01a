"""Evaluation on levels: which they are, each as often as the others, a real agent's episodes."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from baselines.ppo_reg_coinrun import Agent, Args, RunError, make_env
from harness.evaluation import levels as module
from harness.evaluation.checkpoint import Checkpoint, read_checkpoint
from harness.evaluation.levels import (
    COLUMNS,
    Levels,
    choose_levels,
    evaluate,
    evaluate_levels,
    load_agent,
    record,
)
from harness.evaluation.runs import evaluate_run
from harness.evaluation.settings import EvaluationError, Settings

ARGS = Args(num_levels=10, start_level=5, dropout=0.5)


# --- which levels ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "seen", "unseen"),
    [
        (10, list(range(5, 15)), list(range(15, 25))),
        (3, [5, 8, 11], [15, 18, 21]),
        (1, [5], [15]),
    ],
)
def test_levels_are_evenly_spaced_in_the_training_set_and_after_it(count, seen, unseen):
    assert choose_levels(ARGS, count, "next") == {"seen": seen, "unseen": unseen}


def test_by_default_they_are_all_500_and_the_500_after_them():
    chosen = choose_levels(Args(), 500, "next")
    assert chosen == {"seen": list(range(500)), "unseen": list(range(500, 1000))}


@settings(max_examples=50, deadline=None)
@given(
    st.integers(1, 60), st.integers(0, 100), st.floats(0, 1), st.sampled_from(["next", "unbounded"])
)
def test_no_unseen_level_was_trained_on_and_none_counts_twice(levels, start, share, unseen):
    args = dataclasses.replace(ARGS, num_levels=levels, start_level=start)
    count = 1 + int(share * (levels - 1))
    chosen = choose_levels(args, count, unseen)
    trained = set(range(start, start + levels))
    assert set(chosen["seen"]) <= trained
    assert not set(chosen["unseen"]) & trained
    assert [len(set(some)) for some in chosen.values()] == [count, count]


def test_unbounded_levels_are_drawn_again_where_they_were_trained_on(monkeypatch):
    monkeypatch.setattr(module, "MAX_SEED", 30)  # 10 of 30 are trained on
    unseen = choose_levels(ARGS, 10, "unbounded")["unseen"]
    assert len(set(unseen)) == 10
    assert set(unseen) <= set(range(5)) | set(range(15, 30))


def test_by_default_every_agent_meets_the_same_unbounded_levels():
    first = choose_levels(Args(), 3, "unbounded")["unseen"]
    assert first == choose_levels(Args(coefficient=0.0), 3, "unbounded", seed=0)["unseen"]
    assert first == [176863850, 47463564, 1815655339]


def test_a_level_is_a_seed_that_the_engine_takes():
    assert np.iinfo(np.int32).max == module.MAX_SEED


def test_the_unbounded_draw_is_set_by_its_seed():
    unseen = [choose_levels(ARGS, 5, "unbounded", seed)["unseen"] for seed in (0, 0, 1)]
    assert unseen[0] == unseen[1] != unseen[2]
    assert max(unseen[0]) > 10**6


@pytest.mark.parametrize(
    ("changed", "count", "unseen", "message"),
    [
        ({}, 11, "next", "levels must be from 1 to 10, got 11"),
        ({}, 0, "next", "levels must be from 1 to 10, got 0"),
        ({"num_levels": 0}, 5, "next", "levels without bound: none is unseen"),
        ({}, 5, "later", "unseen must be one of .*'next', 'unbounded', 'themes'.*got 'later'"),
    ],
)
def test_levels_that_cannot_be_had_are_refused(changed, count, unseen, message):
    with pytest.raises(EvaluationError, match=message):
        choose_levels(dataclasses.replace(ARGS, **changed), count, unseen)


# --- several levels side by side ------------------------------------------------------------------


class OneLevel:
    """An engine of our own: level L's episodes last L, L + 1, ... steps; even levels are won."""

    made: ClassVar[list[OneLevel]] = []
    single_observation_space = gym.spaces.Box(0, 255, (3, 64, 64), np.uint8)
    single_action_space = gym.spaces.Discrete(15)

    def __init__(self, args: Args, num_envs: int, level: int) -> None:
        self.args = args
        self.metadata: dict = {}
        self.level, self.num_envs, self.closed = level, num_envs, False
        OneLevel.made.append(self)

    def reset(self, seed: int | None = None) -> tuple:
        self.seed, self.steps, self.actions = seed, 0, []
        return self.frames(), {}

    def frames(self) -> np.ndarray:
        frames = np.zeros((self.num_envs, 3, 64, 64), np.uint8)
        frames[:, 0], frames[:, 1, :8, :8] = self.level, 80 * (self.steps % 3)
        return frames

    def step_async(self, actions: np.ndarray) -> None:
        assert actions.shape == (self.num_envs,)
        self.actions.append(actions)
        self.steps += 1

    def step_wait(self) -> tuple:
        lengths = self.level + np.arange(self.num_envs)
        ended = self.steps % lengths == 0
        info: dict = {"reset": np.zeros(self.num_envs, bool)}
        if ended.any():
            won = np.full(self.num_envs, self.level % 2 == 0)
            info |= {"episode": {"r": 10.0 * won, "l": np.full(self.num_envs, self.steps)}}
            info |= {"success": won, "level_seed": np.full(self.num_envs, self.level)}
            info["_episode"] = ended
        return self.frames(), np.zeros(self.num_envs), ended, np.zeros_like(ended), info

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def own_engine(monkeypatch) -> list[OneLevel]:
    """Puts it in the engine's place, and gives all that were made."""
    monkeypatch.setattr(OneLevel, "made", [])
    monkeypatch.setattr(module, "make_env", OneLevel)
    return OneLevel.made


@pytest.fixture
def agent() -> Agent:
    made = Agent(ARGS, torch.Generator().manual_seed(0))
    for mask in made.buffers():
        mask.zero_()  # with dropout on, it would see nothing
    return made


@pytest.mark.usefixtures("own_engine")
def test_frames_and_infos_are_in_the_order_of_the_levels():
    env = Levels(ARGS, [4, 2, 3], repeats=2)
    frames, _ = env.reset(seed=0)
    assert env.num_envs == 6
    assert frames.shape == env.observation_space.shape
    assert env.action_space.shape == (6,)
    assert frames[:, 0, 0, 0].tolist() == [4, 4, 2, 2, 3, 3]
    actions = np.arange(6)
    assert env.step(actions)[-1] == {}
    _, _, ended, _, info = env.step(actions)
    assert [e.actions[0].tolist() for e in env.envs] == [[0, 1], [2, 3], [4, 5]]
    assert ended.tolist() == info["_episode"].tolist() == [False, False, True, False, False, False]
    assert (info["success"][2], info["level_seed"][2]) == (1, 2)
    assert (info["episode"]["r"][2], info["episode"]["l"][2]) == (10.0, 2)
    _, _, ended, _, info = env.step(actions)
    assert ended.tolist() == info["_episode"].tolist() == [False, False, False, True, True, False]
    assert info["level_seed"][[3, 4]].tolist() == [2, 3]
    assert info["success"][[3, 4]].tolist() == [1, 0]
    env.close()
    assert all(e.closed for e in env.envs)


def test_a_pool_holds_one_level_and_takes_one_thread(own_engine):
    Levels(ARGS, [4, 2], repeats=3)
    assert [(e.level, e.num_envs) for e in own_engine] == [(4, 3), (2, 3)]
    assert {(e.args.num_levels, e.args.num_threads) for e in own_engine} == {(1, 1)}


def test_the_seed_of_a_reset_gives_each_pool_one_that_the_engine_takes(own_engine):
    seeds = []
    for seed in (0, 0, 1):
        own_engine.clear()
        Levels(ARGS, list(range(1, 33)), repeats=1).reset(seed=seed)
        seeds.append([e.seed for e in own_engine])
    assert seeds[0] == seeds[1]
    assert len({*seeds[0], *seeds[2]}) == 2 * 32
    assert 10**9 < max(seeds[0]) < 2**31


def test_the_engine_shows_each_level_in_its_place():
    env = Levels(ARGS, [7, 3], repeats=2)
    frames, _ = env.reset(seed=0)
    env.close()
    for first, level in ((0, 7), (2, 3)):
        alone = make_env(dataclasses.replace(ARGS, num_levels=1), 1, level)
        np.testing.assert_array_equal(
            frames[first : first + 2], alone.reset(seed=9)[0].repeat(2, 0)
        )
        alone.close()
    assert (frames[0] != frames[2]).any()


@pytest.mark.usefixtures("own_engine")
def test_each_level_has_its_repeats_and_a_greedy_episode_and_only_first_ones_count(
    agent, monkeypatch
):
    monkeypatch.setattr(module, "POOLS", 2)
    parts = list(evaluate_levels(agent, ARGS, [4, 1, 3], repeats=3))
    assert len(parts) == 4  # two levels and one, sampled and greedy
    episodes = pd.concat(parts)
    assert len(episodes) == 3 * (3 + 1)
    for level in (4, 1, 3):
        sampled = episodes[(episodes["level"] == level) & (episodes["policy"] == "sampled")]
        assert sampled["repeat"].tolist() == [0, 1, 2]
        assert sampled["length"].tolist() == [level, level + 1, level + 2]
        greedy = episodes[(episodes["level"] == level) & (episodes["policy"] == "greedy")]
        assert greedy[["repeat", "length"]].to_numpy().tolist() == [[0, level]]
        both = pd.concat([sampled, greedy])
        assert set(both["success"]) == {level % 2 == 0}
        assert set(both["return"]) == {10.0 * (level % 2 == 0)}


def test_sixteen_levels_are_played_at_a_time(own_engine, agent):
    parts = list(evaluate_levels(agent, ARGS, list(range(1, 18)), repeats=1))
    assert [len(part) for part in parts] == [16, 16, 1, 1]  # sampled, greedy
    assert len(own_engine) == 2 * 17
    assert all(engine.closed for engine in own_engine)


@pytest.fixture
def chosen(own_engine, monkeypatch) -> list[list[int]]:
    """The actions of each step of each level, in the order in which they are taken."""
    taken = []
    step_async = OneLevel.step_async
    monkeypatch.setattr(
        OneLevel, "step_async", lambda e, a: (taken.append(a.tolist()), step_async(e, a))
    )
    return taken


def test_sampled_actions_differ_and_greedy_ones_are_the_likeliest(agent, chosen):
    list(evaluate_levels(agent, ARGS, [3], repeats=20))
    sampled, greedy = chosen[0], chosen[-3]  # its episode has 3 steps
    assert len(set(sampled)) > 5  # an agent that knows nothing: 15 actions alike
    frames = torch.tensor(Levels(ARGS, [3], 1).reset(seed=0)[0])
    assert greedy == agent.eval()(frames)[0].argmax(-1).tolist()


def test_sampled_actions_are_set_by_the_seed_and_the_place_of_a_levels_pool(
    agent, chosen, monkeypatch
):
    monkeypatch.setattr(module, "POOLS", 2)

    def play(levels: list[int], **seed: int) -> list[list[int]]:
        chosen.clear()
        list(evaluate_levels(agent, ARGS, levels, repeats=20, **seed))
        return list(chosen)

    alone = play([3, 2], seed=7)
    assert alone == play([3, 2], seed=7)
    assert alone != play([3, 2], seed=8)
    assert alone == play([4, 1, 3, 2], seed=5)[-len(alone) :]  # the levels from the third on
    assert play([3]) == play([3], seed=0)


@pytest.mark.usefixtures("own_engine")
def test_dropout_is_off_while_an_agent_is_judged_and_shown(agent, monkeypatch, tmp_path):
    training, forward = [], Agent.forward
    monkeypatch.setattr(
        Agent, "forward", lambda a, x: (training.append(a.training), forward(a, x))[1]
    )
    agent.train()
    list(evaluate_levels(agent, ARGS, [2], repeats=2))
    judged = len(training)
    agent.train()
    record(agent, ARGS, 3, tmp_path / "seen.gif")
    assert judged >= 3 + 2
    assert len(training) == judged + 3
    assert not any(training)


@pytest.mark.usefixtures("own_engine")
def test_an_engine_that_plays_another_level_is_found_out(agent, monkeypatch):
    class Other(OneLevel):
        def step_wait(self):
            *results, info = super().step_wait()
            info |= {"level_seed": info["level_seed"] + 1} if "level_seed" in info else {}
            return *results, info

    monkeypatch.setattr(module, "make_env", Other)
    with pytest.raises(AssertionError, match="other levels than it was asked for"):
        list(evaluate_levels(agent, ARGS, [2], repeats=1))


@pytest.mark.usefixtures("own_engine")
@pytest.mark.parametrize(("level", "frames"), [(3, 3), (50, 10)])
def test_a_gif_ends_with_the_episode_or_at_its_longest(agent, monkeypatch, tmp_path, level, frames):
    monkeypatch.setattr(module, "GIF_FRAMES", 10)
    record(agent, ARGS, level, tmp_path / "seen.gif")
    with Image.open(tmp_path / "seen.gif") as picture:
        assert (picture.format, picture.size, picture.n_frames) == ("GIF", (256, 256), frames)
        assert picture.info["loop"] == 0  # for ever
        assert picture.info["duration"] == 60  # ms: 15 frames a second, in a GIF's steps of 10 ms


def test_by_default_a_gif_has_300_frames_at_most():
    assert module.GIF_FRAMES == 300


def test_a_gif_shows_what_the_agent_saw_and_the_engine_is_closed(own_engine, agent, tmp_path):
    """Red tells the level; the square that blinks in the corner is 8 pixels wide, here 32."""
    record(agent, ARGS, 200, tmp_path / "seen.gif")
    with Image.open(tmp_path / "seen.gif") as picture:
        shown = []
        for frame in range(3):
            picture.seek(frame)
            shown.append(np.asarray(picture.convert("RGB")))
    assert {tuple(image[255, 255]) for image in shown} == {(200, 0, 0)}
    assert [image[31, 31, 1] for image in shown] == [0, 80, 160]
    assert [(image[..., 1] > 0).sum() for image in shown] == [0, 32 * 32, 32 * 32]
    assert [(e.level, e.num_envs, e.closed) for e in own_engine] == [(200, 1, True)]
    first = torch.zeros(1, 3, 64, 64, dtype=torch.uint8)
    first[:, 0] = 200
    assert own_engine[0].actions[0] == agent.eval()(first)[0].argmax()


# --- a checkpoint ---------------------------------------------------------------------------------


@pytest.fixture
def checkpoint(agent, tmp_path) -> Checkpoint:
    """An agent that was trained on the levels 5 to 14."""
    learner = {"agent": agent.state_dict()}
    return Checkpoint(tmp_path, "ppo_reg_coinrun", ARGS, learner, sha256="")


def test_both_kinds_of_levels_are_played_in_order(own_engine, checkpoint, monkeypatch):
    monkeypatch.setattr(module, "POOLS", 2)
    counts = []

    def show(parts, total):
        parts = list(parts)
        counts.append((len(parts), total))
        return reversed(parts)  # whatever their order

    episodes = evaluate(checkpoint, 3, 2, "next", "cpu", show)
    assert counts == [(2 * 2 * 2, 2 * 2 * 2)]  # kinds of levels, pools, kinds of actions
    places = [("greedy", 0), ("sampled", 0), ("sampled", 1)]
    expected = [
        (split, level, *place)
        for split, levels in {"seen": (5, 8, 11), "unseen": (15, 18, 21)}.items()
        for level in levels
        for place in places
    ]
    assert list(map(tuple, episodes[COLUMNS[:4]].to_numpy())) == expected
    assert episodes.index.tolist() == list(range(18))
    assert episodes["success"].dtype == int
    assert sorted(path.name for path in checkpoint.path.glob("*.gif")) == ["seen.gif", "unseen.gif"]
    assert [e.level for e in own_engine[-2:]] == [5, 15]  # of the GIFs
    assert all(engine.closed for engine in own_engine)


def test_the_engine_is_tried_with_one_environment_before_all_others(own_engine, checkpoint):
    evaluate(checkpoint, 1, 1, "next", "cpu")
    first = own_engine[0]
    assert (first.level, first.num_envs, first.args.num_levels) == (5, 1, 10)


def test_an_engine_that_does_not_start_is_told(own_engine, checkpoint, monkeypatch):
    def fail(self, seed=None):
        raise RunError("no engine here")

    monkeypatch.setattr(OneLevel, "reset", fail)
    with pytest.raises(EvaluationError, match="no engine here"):
        evaluate(checkpoint, 1, 1, "next", "cpu")
    assert len(own_engine) == 1


def test_weights_that_do_not_fit_are_refused(checkpoint):
    with pytest.raises(EvaluationError, match="holds weights that today's ppo_reg_coinrun does"):
        load_agent(dataclasses.replace(checkpoint, learner={"agent": {}}), "cpu")
    with pytest.raises(EvaluationError, match="holds weights that today's ppo_reg_coinrun does"):
        load_agent(dataclasses.replace(checkpoint, learner={}), "cpu")


def test_an_agent_is_loaded_to_the_device_that_was_asked_for(checkpoint):
    elsewhere = dataclasses.replace(checkpoint.args, device="cuda:99")
    agent, args = load_agent(dataclasses.replace(checkpoint, args=elsewhere), "cpu")
    assert args == dataclasses.replace(ARGS, device="cpu")
    assert agent.device.type == "cpu"
    with pytest.raises(EvaluationError, match="device cuda:99 cannot be used"):
        load_agent(checkpoint, "cuda:99")


# --- a run ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def evaluated(coinrun_run, tmp_path_factory) -> tuple[Path, pd.DataFrame]:
    """A real agent on two levels of each kind, twice: the folder, and what was found."""
    path = tmp_path_factory.mktemp("evaluated") / "run"
    shutil.copytree(coinrun_run[0], path)
    return path, evaluate_run(path, Settings(levels=2, repeats=2, device="cpu"))


def test_a_real_agent_plays_every_level_as_often(evaluated):
    _, episodes = evaluated
    assert list(episodes.columns) == COLUMNS
    counts = episodes.groupby(["split", "level", "policy"]).size().to_dict()
    levels = {"seen": (0, 250), "unseen": (500, 750)}
    assert counts == {
        (split, level, policy): times
        for split, some in levels.items()
        for level in some
        for policy, times in (("sampled", 2), ("greedy", 1))
    }
    assert set(episodes["success"]) <= {0, 1}
    assert episodes["length"].between(1, 1000).all()
    assert (episodes["return"] == 10 * episodes["success"]).all()


def test_what_a_real_agent_did_is_written(evaluated):
    path, episodes = evaluated
    pd.testing.assert_frame_equal(pd.read_csv(path / "evaluation.csv"), episodes)
    about = json.loads((path / "evaluation.json").read_text())
    assert (about["levels"], about["repeats"], about["unseen"]) == (2, 2, "next")
    assert not list(path.glob("*.tmp"))
    for split in ("seen", "unseen"):
        with Image.open(path / f"{split}.gif") as picture:
            assert picture.n_frames > 1


def test_the_agent_is_the_one_that_was_trained(coinrun_run):
    path, spec = coinrun_run
    agent, args = load_agent(read_checkpoint(path), "cpu")
    assert {name: getattr(args, name) for name in spec.args} == spec.args
    saved = torch.load(path / "checkpoint.pt", weights_only=True)["learner"]["agent"]
    assert saved.keys() == agent.state_dict().keys()
    for name, value in agent.state_dict().items():
        torch.testing.assert_close(value, saved[name], rtol=0, atol=0)


# --- unseen themes --------------------------------------------------------------------------------


def test_themes_are_the_unseen_levels_once_more():
    args = dataclasses.replace(ARGS, restrict_themes=True)
    chosen = choose_levels(args, 3, "themes")
    assert chosen == {"seen": [5, 8, 11], "unseen": [15, 18, 21], "themes": [15, 18, 21]}
    assert choose_levels(args, 3, "next") == {k: chosen[k] for k in ("seen", "unseen")}


def test_an_agent_that_saw_all_themes_is_not_tested_on_unseen_ones():
    with pytest.raises(EvaluationError, match=r"trained with --restrict-themes.*--unseen next"):
        choose_levels(ARGS, 3, "themes")


@pytest.fixture
def restricted_run(coinrun_run, tmp_path) -> Path:
    """A run that says it was trained with one theme of each kind."""
    path = Path(shutil.copytree(coinrun_run[0], tmp_path / "run"))
    saved = torch.load(path / "checkpoint.pt", weights_only=True)
    saved["args"]["restrict_themes"] = True
    torch.save(saved, path / "checkpoint.pt")
    return path


def test_only_the_themes_split_is_shown_in_all_themes(restricted_run, monkeypatch):
    played, recorded = [], []

    def play(agent, args, levels, repeats):
        played.append((levels, args.restrict_themes))
        found = {"success": True, "return": 10.0, "length": 7}
        yield pd.DataFrame({"level": levels, "repeat": 0, "policy": "greedy", **found})

    monkeypatch.setattr(module, "evaluate_levels", play)
    monkeypatch.setattr(
        module, "record",
        lambda agent, args, level, path: recorded.append((path.name, level, args.restrict_themes)),
    )  # fmt: skip
    totals = []
    episodes = evaluate_run(
        restricted_run, Settings(levels=2, unseen="themes", device="cpu"),
        lambda parts, total: (totals.append(total), parts)[1],
    )  # fmt: skip
    assert played == [([0, 250], True), ([500, 750], True), ([500, 750], False)]
    assert recorded == [
        ("seen.gif", 0, True), ("unseen.gif", 500, True), ("themes.gif", 500, False)
    ]  # fmt: skip
    found = episodes[["split", "level"]].to_numpy().tolist()
    assert found == [["seen", 0], ["seen", 250], ["themes", 500], ["themes", 750],
                     ["unseen", 500], ["unseen", 750]]  # fmt: skip
    assert totals == [3 * 2]  # splits, kinds of actions
    about = json.loads((restricted_run / "evaluation.json").read_text())
    assert about["unseen"] == "themes"


def test_a_levels_frames_have_the_themes_that_were_asked_for():
    frames = {}
    for restricted in (True, False):
        env = Levels(dataclasses.replace(ARGS, restrict_themes=restricted), [500], repeats=1)
        frames[restricted] = env.reset(seed=0)[0]
        env.close()
    assert (frames[True] != frames[False]).any()


def test_themes_change_what_a_level_looks_like_and_nothing_else():
    """The same actions on the same levels: other frames, the same rewards and ends."""
    told, seen = [], []
    for restricted in (True, False):
        args = dataclasses.replace(ARGS, restrict_themes=restricted)
        env = Levels(args, list(range(8)), repeats=1)
        rng = np.random.default_rng(0)
        frames, _ = env.reset(seed=0)
        seen.append(frames)
        told.append([env.step(rng.choice([5, 7, 8], 8))[1:4] for _ in range(200)])
        env.close()
    np.testing.assert_array_equal(np.array(told[0]), np.array(told[1]))
    assert np.array(told[0])[:, 1].any()  # some episodes ended
    different = (seen[0] != seen[1]).reshape(8, -1).any(1)
    assert different.sum() >= 6  # a level may happen to have the one theme anyway
