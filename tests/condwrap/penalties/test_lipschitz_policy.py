"""LCP by hand for a Gaussian and a Categorical, and by finite differences."""

import math

import pytest
import torch
from torch import distributions as td

from condwrap.penalties import LipschitzPolicy
from tests.condwrap.penalties.helpers import Discrete, Gaussian, gradcheck, linear, mlp

F64 = torch.float64
OBS = torch.tensor([[1.0, 0.0, -1.0], [0.5, 2.0, 0.0]], dtype=F64)
ACTIONS = torch.tensor([[0.3, -0.2], [1.0, 0.5]], dtype=F64)


def test_a_gaussian_by_hand():
    # ∇_s log π = (a - w·s) / σ² · w, with w = (3, 4), σ = 2: (10 - 0) / 4 · 5 and (5 - 3) / 4 · 5
    policy = Gaussian(linear([[3.0, 4.0]]), [math.log(2.0)])
    obs = torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=F64)
    actions = torch.tensor([[10.0], [5.0]], dtype=F64)
    result = LipschitzPolicy(coefficient=0.1)(policy, obs, actions=actions)
    want = (12.5**2 + 2.5**2) / 2
    assert result.metrics()["penalty/lcp_gradient_squared"] == pytest.approx(want)
    assert result.penalty.item() == pytest.approx(0.1 * want)


def test_independent_coordinates_add_their_log_probabilities():
    # π(a | s) of two actions whose means are s and -s, a = 1, s = 0: the slopes 1 and -1 cancel
    mean = linear([[1.0], [-1.0]])
    obs, actions = torch.zeros(1, 1, dtype=F64), torch.ones(1, 2, dtype=F64)
    result = LipschitzPolicy()(lambda x: td.Normal(mean(x), 1.0), obs, actions=actions)
    assert result.penalty.item() == 0.0


def test_a_categorical_by_hand():
    # logits (s, 0): d/ds log π(0) = 1 - p = 0.5 at s = 0, d/ds log π(1) = -p = -0.5
    policy = Discrete(linear([[1.0], [0.0]]))
    obs, actions = torch.zeros(2, 1, dtype=F64), torch.tensor([0, 1])
    result = LipschitzPolicy(coefficient=1.0)(policy, obs, actions=actions)
    assert result.penalty.item() == pytest.approx(0.25)


@pytest.mark.parametrize("policy", [Gaussian(mlp(), [-0.5, 0.2]), Discrete(mlp())])
def test_the_gradient_is_that_of_finite_differences(policy):
    actions = ACTIONS if isinstance(policy, Gaussian) else torch.tensor([1, 0])
    assert gradcheck(policy, lambda p: LipschitzPolicy(1.0)(p, OBS, actions=actions))


def test_it_falls_with_the_fourth_power_of_sigma():
    mean = linear([[1.0, 2.0, 0.0], [0.0, 1.0, 1.0]])
    one, double = (Gaussian(mean, [math.log(std)] * 2) for std in (1.0, 2.0))
    first = LipschitzPolicy()(one, OBS, actions=ACTIONS).penalty
    second = LipschitzPolicy()(double, OBS, actions=ACTIONS).penalty
    torch.testing.assert_close(first, 16 * second)


def test_a_constant_policy_costs_nothing():
    constant = td.Normal(torch.zeros(2, 2, dtype=F64), 1.0)
    measured = LipschitzPolicy(coefficient=0.0)(lambda x: constant, OBS, actions=ACTIONS)
    assert measured.metrics() == {"penalty/lcp_gradient_squared": 0.0}
    flat = Gaussian(linear([[0.0] * 3] * 2), [0.0, 0.0])
    assert LipschitzPolicy()(flat, OBS, actions=ACTIONS).penalty.item() == 0.0


def test_it_measures_without_gradients():
    policy = Gaussian(mlp(), [0.0, 0.0])
    with torch.no_grad():
        measured = LipschitzPolicy()(policy, OBS, actions=ACTIONS)
    assert not measured.penalty.requires_grad
    assert measured.penalty == LipschitzPolicy()(policy, OBS, actions=ACTIONS).penalty


def test_it_names_what_it_lacks():
    with pytest.raises(ValueError, match="LipschitzPolicy needs actions: it differentiates"):
        LipschitzPolicy()(Gaussian(mlp(), [0.0, 0.0]), OBS)
    with pytest.raises(TypeError, match="LipschitzPolicy needs a policy that returns one torch"):
        LipschitzPolicy()(mlp(), OBS, actions=ACTIONS)


@pytest.mark.parametrize("actions", [ACTIONS[:, 0], ACTIONS[:1], [0.0]])
def test_actions_that_would_broadcast_are_refused(actions):
    with pytest.raises(ValueError, match=r"actions must be a tensor of the policy's shape \(2, 2"):
        LipschitzPolicy()(Gaussian(mlp(), [0.0, 0.0]), OBS, actions=actions)


def test_a_bad_coefficient_is_refused():
    with pytest.raises(ValueError, match="coefficient must be finite and at least 0, got inf"):
        LipschitzPolicy(coefficient=math.inf)
