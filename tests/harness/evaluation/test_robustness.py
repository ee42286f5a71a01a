"""Attacked episodes: a toy's worked out by hand, real agents', and what is kept of them."""

from __future__ import annotations

import json
import math

import numpy as np
import pandas as pd
import pytest
import torch

from baselines import ppo_reg, trpo_reg
from harness.evaluation import robustness, sarsa
from harness.evaluation.checkpoint import read_checkpoint
from harness.evaluation.control import episode_seeds
from harness.evaluation.robustness import (
    COLUMNS,
    Threat,
    evaluate_robustness,
    parse_threat,
)
from harness.evaluation.runs import evaluate_run
from harness.evaluation.settings import EvaluationError, Settings
from tests.harness.evaluation.toy import DEVIATION, LIMIT, MEAN, SLOPE, Toy, write_checkpoint

REACHER = "harness.envs.fast_bullet:FastReacherBulletEnv-v0"


@pytest.fixture(autouse=True)
def made(monkeypatch) -> list[Toy]:
    """The environments of the evaluation, in turn."""
    toys: list[Toy] = []
    monkeypatch.setattr(Toy, "made", toys)
    return toys


@pytest.fixture(scope="module")
def reacher(tmp_path_factory):
    """A real agent after an update."""
    path = tmp_path_factory.mktemp("reacher")
    ppo_reg.train(
        ppo_reg.Args(
            env_id=REACHER, total_timesteps=200, num_steps=200, num_minibatches=4,
            update_epochs=2, vf_epochs=2, output_gain=1.0, run_dir=path,
        )
    )  # fmt: skip
    return path


def attack(path, names, radii, norm="linf", episodes=2, **options):
    threat = Threat(tuple(names.split(",")), radii, norm)
    return evaluate_robustness(path, Settings(episodes=episodes), threat, **options)


def rows(found, **chosen):
    for name, value in chosen.items():
        found = found[found[name] == value]
    return found.reset_index(drop=True)


# --- episodes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", [ppo_reg, trpo_reg])
def test_the_strongest_change_of_one_number_by_hand(tmp_path, made, module):
    """The policy is linear in one number: mad moves each action by SLOPE · radius, up or down."""
    write_checkpoint(tmp_path, module)
    found = attack(tmp_path, "mad", (0.1,), "linf", 3)
    assert list(found.columns) == COLUMNS
    assert found["episode"].tolist() == [0, 1, 2]
    assert found["length"].tolist() == [4] * 3
    toys = [toy for toy in made if toy.seeds]
    for toy, row in zip(toys, found.to_dict("records"), strict=True):
        clean = np.array([SLOPE * (x - MEAN) / DEVIATION for x in toy.seen[:4]])
        up, down = ((clean + s * SLOPE * 0.1).clip(-LIMIT, LIMIT) for s in (1, -1))
        actions = np.array(toy.actions)
        assert np.all(np.isclose(actions, up, atol=1e-5) | np.isclose(actions, down, atol=1e-5))
        assert row["return"] == pytest.approx(10 * sum(toy.actions))
        assert row["action_change"] == pytest.approx(np.abs(np.diff(actions)).mean())


def test_the_critic_is_descended_by_hand(tmp_path, made):
    """V falls with the number that is seen, so that the policy is shown one that is larger."""
    write_checkpoint(tmp_path)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    critic = saved["learner"]["critic"]
    critic["0.weight"].fill_(-1.0)
    critic["0.bias"].fill_(20.0)
    critic["2.weight"].fill_(1.0)
    torch.save(saved, tmp_path / "checkpoint.pt")
    attack(tmp_path, "critic", (0.2,), "l2", 2)
    for toy in made[-2:]:
        shown = [SLOPE * ((x - MEAN) / DEVIATION + 0.2) for x in toy.seen[:4]]
        np.testing.assert_allclose(toy.actions, np.clip(shown, -LIMIT, LIMIT), atol=1e-5)


def test_radius_0_is_the_evaluation_number_for_number(reacher):
    clean = rows(evaluate_run(reacher, Settings(episodes=3)), policy="deterministic")
    found = attack(reacher, "random,mad", (0.0, 0.3), episodes=3)
    measures = ["episode", "return", "length", "action_change", "smoothness"]
    for name in ("random", "mad"):
        still = rows(found, attack=name, radius=0.0)
        pd.testing.assert_frame_equal(still[measures], clean[measures], check_exact=True)
        moved = rows(found, attack=name, radius=0.3)
        assert (moved["return"] != clean["return"]).all()


def test_all_radii_and_attacks_have_the_same_episodes(tmp_path, made):
    args = write_checkpoint(tmp_path)
    attack(tmp_path, "random,mad", (0.0, 0.1), episodes=2)
    toys = [toy for toy in made if toy.seeds]
    assert [toy.seeds[0] for toy in toys] == [episode_seeds(args, i)[0] for i in range(2)] * 3
    assert len({toy.seen[0] for toy in toys}) == 2
    assert all(toy.closed for toy in toys)


@pytest.mark.parametrize("name", robustness.ATTACKS)
def test_an_episode_does_not_depend_on_the_others(reacher, name, monkeypatch):
    monkeypatch.setattr(robustness, "SLOTS", 3)
    monkeypatch.setattr(sarsa, "UPDATES", 20)
    state = torch.get_rng_state()
    few, many = (attack(reacher, name, (0.3,), "l2", episodes=n) for n in (1, 4))
    pd.testing.assert_frame_equal(few, many[:1], check_exact=True)
    assert len(set(many["return"])) == 4
    assert torch.equal(state, torch.get_rng_state())


def test_groups_draw_different_noise_and_attacks_the_same(tmp_path):
    args = write_checkpoint(tmp_path)
    first, again, second = (
        torch.rand(3, generator=robustness._noise(args, group)) for group in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, second)


def test_the_attack_sees_normalized_observations(tmp_path, made, monkeypatch):
    write_checkpoint(tmp_path)
    seen = []

    def spy(policy, obs, radius, norm, generator):
        seen.append(obs.clone())
        assert (radius, norm) == (0.1, "l2")
        return torch.zeros_like(obs)

    monkeypatch.setattr(robustness.attacks, "mad", spy)
    attack(tmp_path, "mad", (0.1,), "l2", 2)
    toys = [toy for toy in made if toy.seeds]
    assert [x.shape for x in seen] == [(robustness.SLOTS, 1)] * 4
    for step, obs in enumerate(seen):
        expected = [(toy.seen[step] - MEAN) / DEVIATION for toy in toys]
        np.testing.assert_allclose(obs[:2, 0], expected, atol=1e-5)


def test_actions_that_are_not_finite_are_told(tmp_path):
    write_checkpoint(tmp_path)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    saved["learner"]["actor"]["mean.2.bias"].fill_(math.nan)
    torch.save(saved, tmp_path / "checkpoint.pt")
    with pytest.raises(EvaluationError, match=f"{tmp_path}.*actions that are not finite"):
        attack(tmp_path, "random", (0.1,), episodes=1)
    assert all(toy.closed for toy in Toy.made if toy.seeds)


# --- what is kept ---------------------------------------------------------------------------------


def test_both_files_say_what_was_asked(tmp_path):
    write_checkpoint(tmp_path)
    found = attack(tmp_path, "mad,random", (0.1, 0.0), "l2", 2)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "robustness.csv"), found)
    assert found["attack"].tolist() == ["mad"] * 4 + ["random"] * 4
    assert found["radius"].tolist() == [0, 0, 0.1, 0.1] * 2
    assert json.loads((tmp_path / "robustness.json").read_text()) == {
        "attacks": ["mad", "random"], "radii": [0.1, 0.0], "norm": "l2", "episodes": 2,
        "checkpoint_sha256": read_checkpoint(tmp_path).sha256,
    }  # fmt: skip


def test_a_second_call_reads_what_the_first_found(tmp_path, monkeypatch):
    write_checkpoint(tmp_path)
    first = attack(tmp_path, "random", (0.1,))
    monkeypatch.setattr(robustness, "evaluate", lambda *_: 1 / 0)
    pd.testing.assert_frame_equal(attack(tmp_path, "random", (0.1,)), first)
    for changed in ({"radii": (0.2,)}, {"norm": "l2"}, {"episodes": 3}, {"names": "mad"}):
        with pytest.raises(ZeroDivisionError):
            attack(tmp_path, **{"names": "random", "radii": (0.1,), **changed})
    write_checkpoint(tmp_path, log_std=-2.0)  # another checkpoint
    with pytest.raises(ZeroDivisionError):
        attack(tmp_path, "random", (0.1,))


def test_it_shows_how_far_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(robustness, "SLOTS", 2)
    write_checkpoint(tmp_path)
    totals = []

    def show(parts, total):
        parts = list(parts)
        totals.append((len(parts), total))
        return parts

    attack(tmp_path, "random,critic", (0.0, 0.1), episodes=3, show=show)
    assert totals == [(6, 6)]  # two groups of no attack, and of each attack


# --- bad input ------------------------------------------------------------------------------------


def test_flags_are_parsed():
    assert parse_threat("", "", "linf") is None
    assert parse_threat("mad", "", "linf") == Threat(("mad",), (0.0, 0.05, 0.1), "linf")
    assert parse_threat("random,mad", "0,0.05", "l2") == Threat(
        ("random", "mad"), (0.0, 0.05), "l2"
    )


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("noise", "0", "l2"), "attack must be some of random,mad,critic,sarsa, got 'noise'"),
        (("", "0.1", "linf"), "--radius and --norm need --attack"),
        (("", "", "l2"), "--radius and --norm need --attack"),
        (("mad,", "", "l2"), "attack must be some of .* got 'mad,'"),
        (("mad,mad", "0", "l2"), "attack names one twice"),
        (("mad", "0.1,0.10", "l2"), "radius names one twice"),
        (("mad", "small", "l2"), "radius must be numbers with commas between them, got 'small'"),
        (("mad", "-1", "l2"), "radius must be finite and at least 0"),
        (("mad", "nan", "l2"), "radius must be finite and at least 0"),
        (("mad", "0", "l1"), "norm must be one of .* got 'l1'"),
    ],
)
def test_bad_flags_are_refused_by_name(flags, message):
    with pytest.raises(EvaluationError, match=message):
        parse_threat(*flags)


def test_agents_of_coinrun_are_refused(coinrun_run):
    with pytest.raises(EvaluationError, match="run of ppo_reg_coinrun: attacks are for control"):
        attack(coinrun_run[0], "random", (0.1,))


def test_settings_that_would_be_ignored_are_refused(tmp_path):
    write_checkpoint(tmp_path)
    with pytest.raises(EvaluationError, match="leave out --levels 3"):
        evaluate_robustness(tmp_path, Settings(levels=3), Threat(("random",)))
