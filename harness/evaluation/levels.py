"""Generalization of a CoinRun agent: every level it was trained on, and as many it never saw.

Each level is played in a pool of its own (`num_levels=1`), so all count equally, and of each
environment only the first episode counts, so short episodes do not count more often. A level is
determined by its seed and the actions: sampled actions are repeated, greedy ones played once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from gymnasium.vector import VectorEnv
from PIL import Image

from baselines.ppo_reg_coinrun import Agent, Args, RunError, find_device, make_env, play
from harness.evaluation.checkpoint import Checkpoint
from harness.evaluation.settings import EvaluationError, Unseen

POOLS = 16  # levels played at a time
MAX_SEED = 2**31 - 1
COLUMNS = ["split", "level", "policy", "repeat", "success", "return", "length"]
GIF_FRAMES, GIF_ZOOM = 300, 4


class Levels(VectorEnv):
    """Several levels side by side, `repeats` environments each, in the order of `levels`."""

    def __init__(self, args: Args, levels: list[int], repeats: int) -> None:
        one = dataclasses.replace(args, num_levels=1, num_threads=1)  # side by side they are many
        self.envs = [make_env(one, repeats, level) for level in levels]
        self.num_envs = len(levels) * repeats
        self.metadata = self.envs[0].metadata
        self.single_observation_space = self.envs[0].single_observation_space
        self.single_action_space = self.envs[0].single_action_space
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        seeds = self.np_random.integers(2**31, size=len(self.envs)).tolist()
        frames = [env.reset(seed=s)[0] for env, s in zip(self.envs, seeds, strict=True)]
        return np.concatenate(frames), {}

    def step(self, actions: np.ndarray) -> tuple:
        for env, chosen in zip(self.envs, np.split(actions, len(self.envs)), strict=True):
            env.step_async(chosen)
        *results, infos = zip(*(env.step_wait() for env in self.envs), strict=True)
        return *map(np.concatenate, results), self._join(infos)

    def _join(self, infos: tuple[dict[str, Any], ...]) -> dict[str, Any]:
        ended = [i for i in infos if "episode" in i]
        if not ended:
            return {}
        none = np.zeros(self.num_envs // len(self.envs))

        def join(read: Callable[[dict[str, Any]], np.ndarray]) -> np.ndarray:
            return np.concatenate([read(i) if "episode" in i else none for i in infos])

        return {
            "episode": {name: join(lambda i, n=name: i["episode"][n]) for name in ("r", "l")},
            **{name: join(lambda i, n=name: i[n]) for name in ("success", "level_seed")},
            "_episode": join(lambda i: i["_episode"]).astype(bool),
        }

    def close_extras(self, **kwargs: Any) -> None:
        for env in self.envs:
            env.close()


def choose_levels(args: Args, count: int, unseen: str, seed: int = 0) -> dict[str, list[int]]:
    """Levels of each split: `count` of the training set, evenly spaced, and `count` beyond it.

    "themes" needs an agent that was trained with `restrict_themes`, and gives three splits: `seen`
    and `unseen` are levels as it knows them, and `themes` are the unseen levels once more, with all
    themes. A level's layout does not depend on its themes, so the last two differ in looks alone.

    That is the nearest to the test of Lee et al. (2020) that Procgen allows, not the same. There
    the player, the ground and the background have themes from the first half of their lists in
    training and from the second half in the test, whose levels are unbounded in number and of
    difficulty 3 only, where training has 1 to 3. Here training has one theme each for the player,
    the ground, the crates and the enemies, and all backgrounds; the test draws from all themes,
    that one among them, and has levels of all difficulties.

    Args:
        args: Of the training run.
        count: Levels of each split.
        unseen: "next", the levels after the training set; "unbounded", seeds drawn at random; or
            "themes", the levels after the training set without and with unseen themes.
        seed: Of the random draw.
    """
    if unseen not in get_args(Unseen):
        raise EvaluationError(f"unseen must be one of {get_args(Unseen)}, got {unseen!r}")
    if args.num_levels == 0:
        raise EvaluationError("the agent was trained on levels without bound: none is unseen")
    if not 1 <= count <= args.num_levels:
        raise EvaluationError(f"levels must be from 1 to {args.num_levels}, got {count}")
    if unseen == "themes" and not args.restrict_themes:
        raise EvaluationError(
            "unseen themes needs an agent that was trained with --restrict-themes: this one has "
            "seen all themes, so evaluate it with --unseen next or unbounded"
        )

    seen = [args.start_level + i * args.num_levels // count for i in range(count)]
    trained = range(args.start_level, args.start_level + args.num_levels)
    if unseen == "unbounded":
        drawn = np.random.default_rng(seed).choice(MAX_SEED, 2 * count + args.num_levels, False)
        fresh = [int(level) for level in drawn if level not in trained][:count]
    else:
        fresh = [trained.stop + i * args.num_levels // count for i in range(count)]
    if set(fresh) & set(trained):
        raise AssertionError("an unseen level was trained on")

    splits = {"seen": seen, "unseen": fresh}
    return {**splits, "themes": fresh} if unseen == "themes" else splits


def as_shown(args: Args, split: str) -> Args:
    """How the levels of a split look: as in training, but for `themes`."""
    return dataclasses.replace(args, restrict_themes=False) if split == "themes" else args


def evaluate_levels(
    agent: Agent, args: Args, levels: list[int], repeats: int, seed: int = 0
) -> Iterator[pd.DataFrame]:
    """Episodes of some levels at a time: `repeats` with sampled actions each, and a greedy one."""
    for first in range(0, len(levels), POOLS):
        some = levels[first : first + POOLS]
        for policy, times in (("sampled", repeats), ("greedy", 1)):
            env = Levels(args, some, times)
            rng = torch.Generator().manual_seed(seed + first) if policy == "sampled" else None
            found = play(agent, env, seed + first, rng)
            env.close()
            level = np.repeat(some, times)
            if not np.array_equal(found.pop("level_seed"), level):
                raise AssertionError("the engine played other levels than it was asked for")
            places = {"level": level, "repeat": np.tile(np.arange(times), len(some))}
            yield pd.DataFrame({**places, "policy": policy, **found})


def evaluate(
    checkpoint: Checkpoint,
    levels: int,
    repeats: int,
    unseen: str,
    device: str,
    show: Callable[[Iterable, int], Iterable] = lambda parts, total: parts,
) -> pd.DataFrame:
    """Episodes on the levels of each split, a row each; the first level's become <split>.gif."""
    chosen = choose_levels(checkpoint.args, levels, unseen)
    agent, args = load_agent(checkpoint, device)
    try:
        env = make_env(args, 1, args.start_level)
        env.reset()
        env.close()
    except RunError as error:
        raise EvaluationError(str(error)) from None

    jobs = (
        part.assign(split=split)
        for split, some in chosen.items()
        for part in evaluate_levels(agent, as_shown(args, split), some, repeats)
    )
    pools = -(-levels // POOLS)
    parts = list(show(jobs, 2 * len(chosen) * pools))
    for split, some in chosen.items():
        record(agent, as_shown(args, split), some[0], checkpoint.path / f"{split}.gif")

    episodes = pd.concat(parts)[COLUMNS].sort_values(COLUMNS[:4], ignore_index=True)
    return episodes.astype({"success": int})


def load_agent(checkpoint: Checkpoint, device: str) -> tuple[Agent, Args]:
    """The agent of a checkpoint, and the settings that it was trained with."""
    args = dataclasses.replace(checkpoint.args, device=device)
    try:
        agent = Agent(args, torch.Generator()).to(find_device(device))
        agent.load_state_dict(checkpoint.learner["agent"])
    except RunError as error:
        raise EvaluationError(str(error)) from None
    except (KeyError, RuntimeError) as error:  # weights of another shape or version
        what = "weights that today's ppo_reg_coinrun does not take"
        raise EvaluationError(f"{checkpoint.path} holds {what}: {error!r}") from error
    return agent, args


def record(agent: Agent, args: Args, level: int, path: Path) -> None:
    """The greedy agent's episode on a level, or its first GIF_FRAMES frames, as an animated GIF."""
    env = Levels(args, [level], 1)
    frames, _ = env.reset(seed=0)
    device = next(agent.parameters()).device
    size = (GIF_ZOOM * 64, GIF_ZOOM * 64)
    pictures: list[Image.Image] = []
    agent.eval()

    while len(pictures) < GIF_FRAMES:
        image = Image.fromarray(frames[0].transpose(1, 2, 0))
        pictures.append(image.resize(size, Image.Resampling.NEAREST))
        with torch.no_grad():
            actions = agent(torch.tensor(frames, device=device))[0].argmax(-1).cpu().numpy()
        frames, _, ended, cut, _ = env.step(actions)
        if (ended | cut).any():
            break

    env.close()
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=67, loop=0)
