"""The flags of a training loop, and what they make."""

from __future__ import annotations

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

from condwrap import ConditioningRegularizer
from condwrap.settings import ConditioningArgs, PenaltyArgs
from condwrap.wrappers import VectorPerturbObservation

DEFAULTS = {
    "coefficient": 0.001,
    "lambda_min": 1.0,
    "lambda_max": 20.0,
    "reduction": "sample",
    "perturbation": "sphere",
    "radius": 1.0,
    "printed_sign": False,
    "probe_fraction": 1.0,
    "log_spectrum": 0,
    "perturb_obs": False,
}


def test_the_defaults_are_the_papers():
    assert dataclasses.asdict(ConditioningArgs()) == DEFAULTS


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"coefficient": 0.5},
        {"lambda_min": 0.0, "lambda_max": 0.2},
        {"lambda_min": 2.0},
        {"reduction": "batch"},
        {"perturbation": "gaussian"},
        {"perturbation": "uniform", "radius": 3.0},
        {"printed_sign": True},
    ],
)
def test_each_flag_reaches_the_regularizer(changes):
    net, obs = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 2)), torch.randn(6, 4)
    flags = {"coefficient": 0.001, **changes}
    expected = ConditioningRegularizer(**flags, seed=7)(net, obs)
    got = PenaltyArgs(**changes).make_regularizer(seed=7)(net, obs)
    assert got.penalty == expected.penalty
    assert torch.equal(got.quotient, expected.quotient)


def test_a_probe_measures_with_the_flags():
    net, obs = nn.Linear(3, 2), torch.randn(40, 3)
    args = PenaltyArgs(lambda_min=0.0, probe_fraction=0.5, log_spectrum=2)
    box = gym.spaces.Box(-0.1, 0.1, (2,))
    probe = args.make_probe(seed=1, action_space=box)
    got = probe.measure(2, net, obs)
    assert got["conditioning/own_fraction_below"] == 0.0
    assert got["conditioning/fraction_below"] > 0.5
    assert got["conditioning/quotient_executed"] < got["conditioning/quotient_q50"]
    assert got["conditioning/condition_number"] >= 1.0
    assert probe.fraction == 0.5
    assert probe.own.coefficient == 0.001


@pytest.mark.parametrize(
    "name", ["lambda_min", "lambda_max", "reduction", "perturbation", "radius"]
)
def test_own_settings_are_measured_where_one_differs(name):
    other = {
        "lambda_min": 0.5,
        "lambda_max": 2.0,
        "reduction": "batch",
        "perturbation": "gaussian",
        "radius": 2.0,
    }
    assert PenaltyArgs().make_probe(seed=0).own_is_paper
    assert PenaltyArgs(coefficient=0.0, printed_sign=True).make_probe(seed=0).own_is_paper
    assert not PenaltyArgs(**{name: other[name]}).make_probe(seed=0).own_is_paper


def test_observations_are_perturbed_where_asked():
    envs = gym.make_vec("Pendulum-v1", 2, vectorization_mode="sync")
    assert ConditioningArgs().perturb(envs) is envs
    perturbed = ConditioningArgs(perturb_obs=True, radius=0.25).perturb(envs)
    assert isinstance(perturbed, VectorPerturbObservation)
    obs, _ = perturbed.reset(seed=0)
    clean, _ = envs.reset(seed=0)
    np.testing.assert_array_equal(perturbed.clean_obs, clean)
    assert 0 < np.linalg.norm(obs - clean, axis=-1).max() <= 0.2501


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coefficient": -1.0}, "coefficient must be finite and at least 0, got -1.0"),
        ({"lambda_min": 30.0}, "got lambda_min=30.0 and lambda_max=20.0"),
        ({"reduction": "mean"}, "reduction must be 'sample' or 'batch', got 'mean'"),
        ({"perturbation": "cube"}, "perturbation must be one of"),
        ({"radius": 0.0}, "radius must be finite and above 0, got 0.0"),
        ({"probe_fraction": 0.0}, r"probe_fraction must be in \(0, 1\], got 0.0"),
        ({"probe_fraction": 1.5}, r"probe_fraction must be in \(0, 1\], got 1.5"),
        ({"log_spectrum": -1}, "log_spectrum must be at least 0, got -1"),
    ],
)
def test_a_flag_out_of_range_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        PenaltyArgs(**changes).check_conditioning()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"coefficient": 0.0, "lambda_min": 0.0, "lambda_max": 0.0},
        {"probe_fraction": 0.01, "log_spectrum": 1},
    ],
)
def test_the_ends_of_a_range_are_in_it(changes):
    PenaltyArgs(**changes).check_conditioning()


def test_noise_is_drawn_on_the_device_that_is_asked_for(monkeypatch):
    devices = []
    make = torch.Generator

    def spy(device="cpu"):
        devices.append(device)
        return make()

    monkeypatch.setattr(torch, "Generator", spy)
    PenaltyArgs().make_regularizer(seed=0, device="cuda:0")
    assert devices == ["cuda:0"]
    PenaltyArgs().make_probe(seed=0, device="cuda:1")
    assert devices == ["cuda:0", "cuda:1", "cuda:1"]
    PenaltyArgs().make_probe(seed=0)
    assert devices[3:] == ["cpu", "cpu"]
