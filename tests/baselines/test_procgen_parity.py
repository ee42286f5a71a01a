"""Both engines give the same frames, rewards, ends and levels, episode after episode.

Both draw by Qt, and procgen-mirror's Qt 5.9 does not round as 5.15 does, which EnvPool needs: a
quarter of the frames differ then, in a few of their 12,288 numbers. So the frames are compared
with the original engine linked to the Qt that EnvPool uses.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils import seeding

from baselines.ppo_reg_coinrun import GAMES, Args, Procgen, load_qt, make_env
from tests.baselines import procgen_original
from tests.baselines.procgen_original import TIME_LIMITS, digest

pytestmark = pytest.mark.slow
SEED = 5


@pytest.fixture(scope="module")
def python(tmp_path_factory) -> Path:
    """An interpreter that has OpenAI's engine."""
    folder = tmp_path_factory.mktemp("procgen")
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    command = [python, "-m", "pip", "install", "--quiet", "procgen-mirror", "numpy<2"]
    pip = subprocess.run(command, capture_output=True, text=True, check=False)
    if pip.returncode:
        said = pip.stderr.strip().splitlines()
        pytest.skip(f"pip could not install procgen-mirror: {said[-1] if said else 'no reason'}")
    return python


def choose_qt(python: Path, own: bool) -> dict[str, str]:
    """Link the engine to its own Qt or to ours, and return the environment that it then needs."""
    load_qt()
    loaded = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines()}
    (libraries,) = python.parent.parent.glob("lib/python*/site-packages/procgen_mirror.libs")
    (libraries / "own").mkdir(exist_ok=True)
    for name in ("libQt5Core", "libQt5Gui"):
        (ours,) = (Path(path).resolve() for path in loaded if f"/{name}.so" in path)
        (theirs,) = libraries.glob(f"{name}-*")
        if not theirs.is_symlink():
            theirs.rename(libraries / "own" / theirs.name)
        theirs.unlink(missing_ok=True)
        theirs.symlink_to(libraries / "own" / theirs.name if own else ours)
    return {**os.environ, **({} if own else {"LD_LIBRARY_PATH": str(ours.parent)})}


def record(
    python: Path, folder: Path, runs: list[dict], *, own_qt: bool = False
) -> list[dict[str, np.ndarray]]:
    """What OpenAI's engine answers, `[T, N]`, and its T + 1 frames."""
    recorder = subprocess.run(
        [python, procgen_original.__file__], input=json.dumps(runs), text=True, capture_output=True,
        cwd=folder, env=choose_qt(python, own_qt), check=False,
    )  # fmt: skip
    assert recorder.returncode == 0, recorder.stderr
    return [dict(np.load(run["out"])) for run in runs]


def compare(env: Procgen, actions: np.ndarray, expected: dict[str, np.ndarray]) -> int:
    """Step EnvPool's engine as the other was, and return how many episodes ended.

    `taken` counts each environment's actions: EnvPool spends a step, and no action, on a reset.
    """
    num_envs, steps = env.num_envs, len(actions)
    taken, everyone = np.zeros(num_envs, int), np.arange(num_envs)

    np.testing.assert_array_equal(digest(env.reset(seed=SEED)[0]), expected["digests"][0])
    episodes, running = 0, np.ones(num_envs, bool)
    while running.any():
        frames, rewards, terminations, truncations, info = env.step(
            actions[np.minimum(taken, steps - 1), everyone]
        )
        acted, at = running & ~info["reset"], np.minimum(taken, steps - 1)
        answers = {"rewards": rewards, "terminations": terminations, "truncations": truncations}
        ended = terminations | truncations
        for name, answer in answers.items():
            np.testing.assert_array_equal(answer[acted], expected[name][at, everyone][acted], name)
        for name in ("success", "level_seed") if (acted & ended).any() else ():
            np.testing.assert_array_equal(
                info[name][acted & ended], expected[name][at, everyone][acted & ended], name
            )
        taken += acted
        # The frame that ends an episode is EnvPool's alone; its next is the other's that ended it.
        shown = running & ~ended
        np.testing.assert_array_equal(
            digest(frames)[shown], expected["digests"][taken, everyone][shown]
        )
        episodes += (acted & ended).sum()
        running &= (taken < steps) | ended
    return episodes


def request(folder: Path, settings: dict, steps: int, keep: int = 0) -> tuple[Procgen, dict]:
    """A pool of EnvPool's, and what the recorder needs to know to do the same."""
    chosen = dict(settings)
    num_envs = chosen.pop("num_envs")
    args = Args(**chosen)
    env = make_env(args, num_envs, args.start_level)

    path = Path(tempfile.mkdtemp(dir=folder))
    rng = np.random.default_rng(0)
    actions = rng.choice([1, 4, 7, 7, 8, 8, 8, *range(15)], (steps, num_envs))
    np.save(path / "actions.npy", actions.astype(np.int32))

    engine = {
        "game": args.env_id,
        "mode": args.distribution_mode,
        "num_envs": num_envs,
        "seed": int(seeding.np_random(SEED)[0].integers(2**31)),  # which reset(seed=SEED) draws
        "options": {
            "num_levels": args.num_levels,
            "start_level": args.start_level,
            "paint_vel_info": args.paint_vel_info,
            "restrict_themes": args.restrict_themes,
        },
    }
    files = {"actions": str(path / "actions.npy"), "out": str(path / "recorded.npz")}
    return env, {"engine": engine, "keep": keep, **files}


def check(python: Path, folder: Path, runs: list[dict], steps: int) -> list[int]:
    """Compare runs of the engines, given as arguments of Procgen; episodes that ended in each."""
    requests = [request(folder, settings, steps) for settings in runs]
    recorded = record(python, folder, [run for _, run in requests])
    ended = []
    for (env, run), expected in zip(requests, recorded, strict=True):
        ended.append(compare(env, np.load(run["actions"]), expected))
        env.close()
    return ended


@pytest.mark.parametrize("mode", ["easy", "hard"])
@pytest.mark.parametrize("option", ["paint_vel_info", "restrict_themes", "neither"])
def test_coinrun_is_the_same_over_hundreds_of_levels(python, tmp_path, mode, option):
    chosen = {name: name == option for name in ("paint_vel_info", "restrict_themes")}
    settings = {"distribution_mode": mode, "num_envs": 64, **chosen}
    levels = [{"num_levels": 500}, {"num_levels": 500, "start_level": 500}, {"num_levels": 0}]
    ended = check(python, tmp_path, [{**settings, **some} for some in levels], steps=400)
    assert min(ended) > 64


def test_coinruns_time_limit_is_the_same(python, tmp_path):
    run = {"num_envs": 16, "num_levels": 500, "distribution_mode": "easy"}
    assert check(python, tmp_path, [run], steps=1005)[0] > 16


def test_every_game_is_the_same(python, tmp_path):
    run = {"num_envs": 8, "num_levels": 100, "paint_vel_info": False}
    runs = [
        {**run, "env_id": game, "distribution_mode": mode}
        for game in GAMES
        for mode in ("easy", "hard")
    ]
    assert sum(check(python, tmp_path, runs, steps=200)) > 64


@pytest.mark.parametrize(("mode", "share", "difference"), [("easy", 0.4, 0.01), ("hard", 0.4, 0.1)])
def test_with_its_own_qt_the_original_engine_draws_almost_the_same(
    python, tmp_path, mode, share, difference
):
    """Rewards, ends and levels are equal; frames are but for a few numbers in [0, 255]."""
    steps = 150
    settings = {"num_envs": 32, "num_levels": 500, "distribution_mode": mode}
    env, run = request(tmp_path, settings, steps, keep=steps)
    (expected,) = record(python, tmp_path, [run], own_qt=True)
    frames, _ = env.reset(seed=SEED)
    running, distances = np.ones(32, bool), []
    for t, actions in enumerate(np.load(run["actions"])):
        apart = np.abs(frames.astype(int) - expected["first"][t]).mean((1, 2, 3))
        distances += apart[running].tolist()
        frames, *answers, _ = env.step(actions)
        for name, answer in zip(("rewards", "terminations", "truncations"), answers, strict=True):
            np.testing.assert_array_equal(answer[running], expected[name][t][running])
        running &= ~(answers[1] | answers[2])
    env.close()
    assert 10 < running.sum() < 32
    assert 0 < np.mean(np.array(distances) > 0) < share
    assert np.mean(distances) < difference


@pytest.mark.parametrize("game", GAMES)
def test_the_time_limits_are_those_of_envpools_port(game):
    env = make_env(Args(env_id=game), 1, 0)
    env.reset(seed=0)
    limit = env.pool.spec.config.max_episode_steps
    env.close()
    assert TIME_LIMITS.get(game, 1000) == limit
