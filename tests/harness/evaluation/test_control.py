"""Evaluation of control agents: a toy's episodes worked out by hand, and real agents'."""

from __future__ import annotations

import dataclasses
import math
import shutil

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch

from baselines import ppo_reg, ppo_reg_population, trpo_reg
from harness.evaluation import control
from harness.evaluation.checkpoint import read_checkpoint
from harness.evaluation.control import COLUMNS, episode_seeds, evaluate, time_step
from harness.evaluation.settings import EvaluationError
from tests.harness.evaluation.toy import DEVIATION, LIMIT, MEAN, SLOPE, Toy, write_checkpoint

BULLET = "harness.envs.fast_bullet:Fast{}BulletEnv-v0"


@pytest.fixture(autouse=True)
def made(monkeypatch) -> list[Toy]:
    """The environments of the evaluation, in turn."""
    toys: list[Toy] = []
    monkeypatch.setattr(Toy, "made", toys)
    return toys


def play(path, episodes: int = 3) -> pd.DataFrame:
    Toy.made.clear()
    rows = list(evaluate(read_checkpoint(path), episodes))
    assert [len(row) for row in rows] == [1] * (2 * episodes)
    Toy.made[:] = [toy for toy in Toy.made if toy.seeds]  # one told the learner the sizes only
    return pd.concat(rows, ignore_index=True)


def mean_action(x: float) -> float:
    return SLOPE * (x - MEAN) / DEVIATION


@pytest.mark.parametrize("module", [ppo_reg, trpo_reg])
def test_the_mean_actions_episodes_by_hand(tmp_path, made, module):
    write_checkpoint(tmp_path, module)
    found = play(tmp_path)
    assert list(found.columns) == COLUMNS
    assert found["policy"].tolist() == ["deterministic"] * 3 + ["sampled"] * 3
    assert found["episode"].tolist() == [0, 1, 2] * 2
    assert found["length"].tolist() == [4] * 6
    clipped = 0
    for toy, row in zip(made[:3], found.to_dict("records"), strict=False):
        expected = np.array([mean_action(x) for x in toy.seen[:4]])
        clipped += int((expected > LIMIT).sum())
        np.testing.assert_allclose(toy.actions, expected.clip(-LIMIT, LIMIT), atol=1e-5)
        assert row["return"] == pytest.approx(10 * sum(toy.actions))  # raw, not normalized
        changes = np.abs(np.diff(toy.actions))
        assert row["action_change"] == pytest.approx(changes.mean())
        # n = 3 frequencies 0, f_s / 4, f_s / 2; by hand: X_1 and X_2 of four numbers
        a, b, c, d = toy.actions
        m1, m2 = 2 * math.hypot(a - c, b - d) / 4, abs(a - b + c - d) / 4
        assert row["smoothness"] == pytest.approx(2 / 3 * (m1 / 4 + m2 / 2), abs=1e-6)
    assert 0 < clipped < 12


def test_sampled_actions_have_the_policys_deviation(tmp_path, made):
    write_checkpoint(tmp_path, log_std=-3.0)
    play(tmp_path, episodes=40)
    noise = [
        (action - mean_action(x)) / math.exp(-3)
        for toy in made[40:]
        for action, x in zip(toy.actions, toy.seen, strict=False)
        if abs(mean_action(x)) < LIMIT - 0.2  # four deviations from where it is clipped
    ]
    assert len(noise) > 80
    assert np.mean(noise) == pytest.approx(0, abs=0.25)
    assert np.std(noise) == pytest.approx(1, abs=0.2)
    again = np.array([toy.actions for toy in made[40:]])
    assert len(np.unique(again[:, 0])) == 40  # each episode has noise of its own


def test_both_policies_start_alike_and_each_episode_elsewhere(tmp_path, made):
    args = write_checkpoint(tmp_path)
    play(tmp_path)
    seeds = [toy.seeds for toy in made]
    assert seeds == [[episode_seeds(args, i)[0]] for i in range(3)] * 2
    assert len({toy.seen[0] for toy in made[:3]}) == 3
    assert all(toy.closed for toy in made)


def test_an_episode_does_not_depend_on_the_others(tmp_path):
    write_checkpoint(tmp_path)
    few, many = play(tmp_path, 2), play(tmp_path, 5)
    pd.testing.assert_frame_equal(few, many[many["episode"] < 2].reset_index(drop=True))
    state = torch.get_rng_state()
    pd.testing.assert_frame_equal(few, play(tmp_path, 2))
    assert torch.equal(state, torch.get_rng_state())


def test_perturbed_training_is_evaluated_on_clean_observations(tmp_path):
    write_checkpoint(tmp_path / "clean")
    write_checkpoint(tmp_path / "noisy", perturb_obs=True, radius=3.0)
    pd.testing.assert_frame_equal(play(tmp_path / "clean"), play(tmp_path / "noisy"))


def test_statistics_stay_as_training_left_them(tmp_path, monkeypatch):
    seen = []
    make = control.make_env
    monkeypatch.setattr(
        control,
        "make_env",
        lambda m, a, stats: (seen.append(stats["obs_rms"]), make(m, a, stats))[1],
    )
    write_checkpoint(tmp_path)
    play(tmp_path)
    assert {(x.mean.item(), x.var.item(), float(x.count)) for x in seen} == {(2.0, 16.0, 100.0)}


def test_an_agent_without_normalization_sees_what_there_is(tmp_path, made):
    write_checkpoint(tmp_path, norm_obs=False)
    play(tmp_path, 1)
    expected = np.array([SLOPE * x for x in made[0].seen[:4]])
    np.testing.assert_allclose(made[0].actions, expected.clip(-LIMIT, LIMIT), atol=1e-5)


def test_the_seeds_are_the_pairs_and_not_of_training():
    args = ppo_reg.Args(seed=3, agent=2)
    own = [episode_seeds(args, i) for i in range(20)]
    assert own == [episode_seeds(trpo_reg.Args(seed=3, agent=2), i) for i in range(20)]
    flat = {seed for pair in own for seed in pair}
    assert len(flat) == 40
    training = {seed for c in range(200) for seed in ppo_reg.env_seeds(args, c)}
    others = [dataclasses.replace(args, agent=1), dataclasses.replace(args, seed=2)]
    elsewhere = {x for other in others for i in range(20) for x in episode_seeds(other, i)}
    assert not flat & (training | elsewhere)


def test_actions_that_are_not_finite_are_told(tmp_path):
    write_checkpoint(tmp_path, log_std=math.nan)
    with pytest.raises(EvaluationError, match="gives actions that are not finite"):
        play(tmp_path)
    assert all(toy.closed for toy in Toy.made)


def test_weights_of_another_shape_are_refused(tmp_path):
    write_checkpoint(tmp_path)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    saved["args"]["hidden_sizes"] = (2,)
    torch.save(saved, tmp_path / "checkpoint.pt")
    with pytest.raises(EvaluationError, match="weights that today's ppo_reg does not take"):
        play(tmp_path)


def test_a_task_that_is_not_installed_is_told(tmp_path):
    write_checkpoint(tmp_path)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    saved["args"]["env_id"] = "Nowhere-v3"
    torch.save(saved, tmp_path / "checkpoint.pt")
    with pytest.raises(EvaluationError, match="Nowhere"):
        play(tmp_path)


@pytest.mark.parametrize(
    ("env_id", "seconds"),
    [
        (BULLET.format("Hopper"), 0.0165),
        (BULLET.format("Reacher"), 0.0165),
        ("Pendulum-v1", 0.05),
        ("MountainCarContinuous-v0", 1.0),
    ],
)
def test_the_time_step_is_the_tasks_own(env_id, seconds):
    env = gym.make(env_id)
    env.reset()
    assert time_step(env) == pytest.approx(seconds)
    env.close()


def test_a_member_of_a_population_is_evaluated_as_itself(tmp_path):
    """A real task, trained together; each agent's folder is that of a single run."""
    args = ppo_reg_population.Args(
        env_id=BULLET.format("Reacher"), total_timesteps=400, num_steps=200, num_minibatches=4,
        num_agents=2, run_dir=tmp_path / "a{agent}",
    )  # fmt: skip
    ppo_reg_population.train(args)
    found = [play(tmp_path / f"a{i}", 2) for i in range(2)]
    assert all((x["length"] == 150).all() for x in found)
    assert set(found[0]["return"]).isdisjoint(found[1]["return"])
    copy = shutil.copytree(tmp_path / "a0", tmp_path / "copy")
    pd.testing.assert_frame_equal(play(copy, 2), found[0])  # bit for bit
