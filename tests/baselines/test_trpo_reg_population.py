"""The TRPO population: the step of each agent is that of the single file, accepted or not."""

from __future__ import annotations

import copy

import pytest
import torch

from baselines import trpo_reg, trpo_reg_population
from baselines.trpo_reg_population import conjugate_gradient
from tests.baselines.population_helpers import arguments, check_close, recorded
from tests.baselines.test_trpo_reg import positive_definite

# --- conjugate gradient --------------------------------------------------------------------------


def problems(flip: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Four systems of 7: an ordinary one, one for 0, one that is quickly solved, one flipped."""
    pairs = [positive_definite(7, seed) for seed in range(4)]
    matrices, b = (torch.stack(x) for x in zip(*pairs, strict=True))
    b[1], matrices[2] = 0, torch.eye(7, dtype=torch.float64)
    matrices[3] *= flip
    return matrices, b


@pytest.mark.parametrize("steps", [1, 4, 7, 30])
@pytest.mark.parametrize("flip", [1.0, -1.0, float("nan")])
def test_each_row_is_solved_as_alone(steps, flip):
    matrices, b = problems(flip)
    x, residuals = conjugate_gradient(lambda v: (matrices @ v[..., None])[..., 0], b, steps)
    for i in range(4):
        alone, residual = trpo_reg.conjugate_gradient(lambda v, i=i: matrices[i] @ v, b[i], steps)
        torch.testing.assert_close(x[i], alone, rtol=1e-9, atol=1e-12)
        assert residuals[i].item() == pytest.approx(residual, abs=1e-9)
    assert x[1].tolist() == [0] * 7
    torch.testing.assert_close(x[2], b[2])
    assert (x[3] == 0).all() == (flip != 1.0)


# --- an update -----------------------------------------------------------------------------------

CASES = {
    "plain": {"coefficient": 0.0},
    "penalty": {"coefficient": 0.5},
    "wide range": {"coefficient": 0.1, "lambda_min": 0.0, "lambda_max": 0.01, "radius": 0.1},
    "uniform": {"coefficient": 0.1, "perturbation": "uniform"},
    "printed sign": {"coefficient": 0.5, "printed_sign": True},
    "one J a batch": {"coefficient": 0.5, "reduction": "batch"},
    "above the range": {"coefficient": 0.5, "reduction": "batch", "lambda_min": 0.0,
                        "lambda_max": 0.01, "output_gain": 1.0},
    "longer steps": {"target_kl": 0.05, "coefficient": 1.0},
    "few steps": {"cg_steps": 2, "vf_epochs": 1, "target_kl": 0.1},
    "environments": {"num_envs": 3, "total_timesteps": 960, "hidden_sizes": (9,)},
    "one": {"num_agents": 1, "agent": 4, "seed": 7},
    "default": {},
}  # fmt: skip
RELU = {"hidden_sizes": (33, 17, 8), "activation": "relu", "log_std_init": -1.0}


def check_updates(dtype, tolerance: float, **changes) -> list[dict[str, float]]:
    """Two updates are those of the single file; the logs of both.

    On Hopper: Pendulum shows 3 numbers, and what conjugate gradients still find in its Fisher
    matrix after a few steps is rounding, in the single file as well.
    """
    settings = {"env_id": "HopperBulletEnv-v0", "num_agents": 3, **changes}
    args = arguments(trpo_reg_population, **settings)
    learners, rollouts = recorded(args, dtype)
    alone, found = copy.deepcopy(learners), []
    for number in range(2):  # the second begins with the critic's moments
        ours = trpo_reg_population.update(args, learners, rollouts)
        for i, run in enumerate(args.runs):
            theirs = trpo_reg.update(run, alone[i], rollouts[i])
            assert list(ours[i]) == list(theirs)
            assert ours[i] == pytest.approx(
                theirs, abs=10 * tolerance, rel=10 * tolerance, nan_ok=True
            )
            learners[i].update = alone[i].update = number + 1
            check_close(learners[i], alone[i], tolerance)
        found += ours
    return found


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_two_updates_are_those_of_the_single_file(changes, dtype, tolerance):
    check_updates(dtype, tolerance, **changes)


def test_they_are_with_relu():
    """In float64: rounding in conjugate gradients moves float32 by 1e-4, the single file's too."""
    check_updates(torch.float64, 1e-11, **RELU)


def test_each_agent_searches_and_decides_by_itself(capsys):
    """The bound is so wide that some agents shorten their step, and differently; one rejects it."""
    settings = {"target_kl": 1.0, "coefficient": 10.0, "num_agents": 8}
    search = {"line_search_steps": 4, "line_search_shrink": 0.9}
    logs = check_updates(torch.float64, 1e-10, **search, **settings)
    fractions = {x["losses/step_fraction"] for x in logs}
    assert len(fractions) > 2
    assert 0.0 in fractions
    assert "step rejected: no fraction of it" in capsys.readouterr().out


def test_an_agent_that_cannot_step_keeps_its_policy_and_the_others_step(capsys):
    args = arguments(trpo_reg_population, coefficient=0.0)
    learners, rollouts = recorded(args)
    still = rollouts[0].rewards * 0
    rollouts[0] = rollouts[0]._replace(rewards=still, values=still, next_values=still)
    rollouts[1] = rollouts[1]._replace(rewards=still + torch.inf)
    before, alone = copy.deepcopy(learners), copy.deepcopy(learners)
    ours = trpo_reg_population.update(args, learners, rollouts)
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "agent 0: step rejected: the gradient is 0"
    assert said[1] == "agent 1: step rejected: the gradient is not finite"
    for i in range(2):
        for p, old in zip(
            learners[i].actor.parameters(), before[i].actor.parameters(), strict=True
        ):
            assert torch.equal(p, old)
        assert ours[i]["losses/accepted"] == 0
        assert trpo_reg.update(args.runs[i], alone[i], rollouts[i])["losses/accepted"] == 0
    theirs = trpo_reg.update(args.runs[2], alone[2], rollouts[2])
    assert ours[2] == pytest.approx(theirs, abs=1e-4)
    assert ours[2]["losses/accepted"] == 1


def test_the_default_update_is_that_of_the_single_file():
    default = {"num_steps": 2000, "num_minibatches": 16, "vf_epochs": 10, "total_timesteps": 2000}
    check_updates(torch.float32, 1e-5, num_agents=2, **default)
