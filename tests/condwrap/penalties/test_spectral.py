"""Functions of singular values as penalties: by hand and by finite differences."""

import pytest
import torch
from torch import nn

from condwrap.penalties import SpectralPenalty, isometry
from tests.condwrap.penalties.helpers import gradcheck, linear, mlp

# PyTorch itself scripts what forward mode imports
pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit.script.* is deprecated:DeprecationWarning"
)

HAND = [[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]]  # singular values 3 and 2


def obs(size=4, n=3):
    return torch.randn(size, n, dtype=torch.float64)


def condition(values):
    return values[:, 0] / values[:, -1]


@pytest.mark.parametrize(
    ("options", "want"),
    [
        ({}, ((3 - 1) ** 2 + (2 - 1) ** 2) / 2),
        ({"function": condition}, 1.5),
        ({"values": "largest"}, 4.0),
        ({"values": "largest", "function": lambda values: values[:, 0] ** 2}, 9.0),
    ],
)
def test_values_worked_out_by_hand(options, want):
    result = SpectralPenalty(coefficient=0.1, **options)(linear(HAND), obs())
    assert result.metrics() == {
        "penalty/spectral": pytest.approx(want),
        "penalty/spectral_largest": pytest.approx(3.0),
    }
    assert result.penalty.item() == pytest.approx(0.1 * want)


@pytest.mark.parametrize("function", [isometry, condition])
def test_the_gradient_is_that_of_finite_differences(function):
    net, states = mlp(), obs()
    assert gradcheck(net, lambda policy: SpectralPenalty(1.0, function)(policy, states))


def test_the_gradient_of_the_largest_is_that_of_finite_differences():
    # its vector is detached, which is exact where the iteration has converged
    net, states = nn.Sequential(nn.Tanh(), linear([[3.0, 1.0], [0.0, 1.0]])), obs(2, n=2)
    penalty = {"values": "largest", "iterations": 30}
    assert gradcheck(net, lambda policy: SpectralPenalty(1.0, **penalty)(policy, states))


def test_an_isometry_costs_nothing():
    rotation = linear([[0.6, 0.8], [-0.8, 0.6]])
    assert SpectralPenalty()(rotation, obs(n=2)).penalty.item() == pytest.approx(0.0, abs=1e-15)


def test_a_condition_number_does_not_change_with_scale():
    net, states = mlp(), obs()
    one = SpectralPenalty(function=condition)(net, states).penalty
    twice = SpectralPenalty(function=condition)(lambda x: 2 * net(x), states).penalty
    torch.testing.assert_close(one, twice)


@pytest.mark.parametrize("function", [torch.sum, lambda values: 1.0, lambda values: values])
def test_a_function_of_another_shape_is_refused(function):
    with pytest.raises(ValueError, match=r"function must map singular values of shape \(4, 2\)"):
        SpectralPenalty(function=function)(linear(HAND), obs())


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"coefficient": -1.0}, ValueError, "coefficient must be finite and at least 0"),
        ({"function": 3}, TypeError, "function must be callable, got int"),
        ({"values": "some"}, ValueError, r"values must be one of \['all', 'largest'\]"),
        ({"iterations": 0}, ValueError, "iterations must be at least 1, got 0"),
    ],
)
def test_bad_arguments_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        SpectralPenalty(**options)
