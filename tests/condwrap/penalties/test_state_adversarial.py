"""SA-PPO's regularizer: its maximum by hand and by enumeration, and finite differences."""

import itertools
import math

import pytest
import torch
from torch import distributions as td
from torch import nn

from condwrap.penalties import StateAdversarial
from tests.condwrap.penalties.helpers import Discrete, Gaussian, gradcheck, linear, mlp

F64 = torch.float64


def obs(size=5, n=3):
    return torch.randn(size, n, dtype=F64)


@pytest.mark.parametrize("steps", [1, 2, 10])
def test_the_maximum_of_a_linear_policy_by_hand(steps):
    # ½ (ε ‖w‖₁ / σ)², with w = (3, -1, 0.5), ε = 0.1, σ = 2; from every start, so in many states
    policy = Gaussian(linear([[3.0, -1.0, 0.5]]), [math.log(2.0)])
    penalty = StateAdversarial(coefficient=2.0, radius=0.1, steps=steps)
    result = penalty(policy, obs(100))
    assert result.metrics()["penalty/sa_divergence"] == pytest.approx(0.5 * (0.45 / 2) ** 2)
    assert result.penalty.item() == pytest.approx((0.45 / 2) ** 2)


def test_it_is_the_divergence_of_two_gaussians():
    policy = Gaussian(linear([[3.0, -1.0]]), [math.log(2.0)])
    here, there = torch.zeros(1, 2, dtype=F64), torch.tensor([[0.1, -0.1]], dtype=F64)
    want = td.kl_divergence(policy(here), policy(there)).item()
    result = StateAdversarial(radius=0.1)(policy, here)
    assert result.metrics()["penalty/sa_divergence"] == pytest.approx(want)


def test_it_stays_in_the_box():
    seen = []
    net = mlp()

    def policy(x):
        seen.append(x)
        return td.Normal(net(x), 1.0)

    states = obs()
    StateAdversarial(radius=0.3, steps=4)(policy, states)
    assert len(seen) == 1 + 4 + 1
    lengths = [(x.detach() - states).abs() for x in seen]
    assert max(x.max().item() for x in lengths) <= 0.3 + 1e-12
    torch.testing.assert_close(lengths[1], torch.full_like(states, 0.3 / 4))  # signs, not 0


def test_it_is_near_the_best_corner_and_beats_random_ones():
    # of two outputs the maximum is at a corner of the box, which 2⁴ corners hold
    mean, states, radius = linear(torch.randn(2, 4).tolist()), obs(50, 4), 0.2
    policy = Gaussian(mean, [0.0, 0.0])
    corners = torch.tensor(list(itertools.product((-radius, radius), repeat=4)), dtype=F64)
    each = mean(corners).square().sum(-1).detach() / 2
    found = StateAdversarial(radius=radius)(policy, states).metrics()["penalty/sa_divergence"]
    assert each.mean() < found <= each.max() + 1e-12
    assert found > 0.8 * each.max()


def test_the_gradient_is_that_of_finite_differences():
    states = obs()
    policy = Gaussian(mlp(), [0.3, -0.2])
    assert gradcheck(policy, lambda p: StateAdversarial(1.0, radius=0.2)(p, states))


def test_it_grows_with_the_square_of_the_radius():
    policy, states = Gaussian(linear([[1.0, 2.0, 3.0]]), [0.0]), obs()
    one, double = (StateAdversarial(radius=r)(policy, states).penalty for r in (0.1, 0.2))
    torch.testing.assert_close(double, 4 * one)


def test_a_constant_policy_costs_nothing():
    constant = td.Normal(torch.zeros(5, 2, dtype=F64), 1.0)
    measured = StateAdversarial(coefficient=0.0)(lambda x: constant, obs())
    assert measured.metrics() == {"penalty/sa_divergence": 0.0}
    flat = Gaussian(linear([[0.0, 0.0, 0.0]]), [0.0])
    assert StateAdversarial()(flat, obs()).penalty.item() == 0.0


def test_autocast_does_not_round_the_search():
    # the slope is 1001 - 1000, and in bf16 both weights are 1000
    mean = nn.Sequential(linear([[1001.0], [1000.0]]), linear([[1.0, -1.0]])).float()
    policy = Gaussian(mean, [0.0]).float()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = StateAdversarial(radius=0.1)(policy, torch.zeros(50, 1))
    assert result.metrics()["penalty/sa_divergence"] == pytest.approx(0.1**2 / 2, rel=1e-2)


def test_the_search_leaves_no_gradient_behind():
    policy = Gaussian(mlp(), [0.0, 0.0])
    with torch.no_grad():
        StateAdversarial()(policy, obs())
    StateAdversarial()(policy, obs())
    assert all(p.grad is None for p in policy.parameters())


def test_a_known_output_gives_the_same():
    policy, states = Gaussian(mlp(), [0.0, 0.0]), obs()
    known = StateAdversarial()(policy, states, output=policy(states)).penalty
    assert torch.equal(known, StateAdversarial()(policy, states).penalty)
    noisy = Gaussian(nn.Sequential(mlp(), nn.Dropout(0.5)), [0.0, 0.0])
    with pytest.raises(ValueError, match="output cannot be used with Dropout"):
        StateAdversarial()(noisy, states, output=noisy(states))


def test_other_policies_are_refused():
    with pytest.raises(TypeError, match="StateAdversarial needs a policy that returns one torch"):
        StateAdversarial()(mlp(), obs())
    with pytest.raises(TypeError, match="returns a Normal, got Categorical"):
        StateAdversarial()(Discrete(mlp()), obs())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coefficient": -1.0}, "coefficient must be finite and at least 0, got -1.0"),
        ({"radius": 0.0}, "radius must be finite and above 0, got 0.0"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        StateAdversarial(**options)
