"""The squared Frobenius norm: by hand, by finite differences, and its estimate's mean."""

import pytest
import torch

from condwrap.penalties import JacobianNorm
from tests.condwrap.helpers import central_differences
from tests.condwrap.penalties.helpers import gradcheck, linear, mlp

HAND = [[3.0, 0.0, 0.0], [0.0, 1.0, 2.0]]  # ‖·‖² = 9 + 1 + 4


def obs(size=4, n=3):
    return torch.randn(size, n, dtype=torch.float64)


def test_a_value_worked_out_by_hand():
    result = JacobianNorm(coefficient=0.5, exact=True)(linear(HAND), obs())
    assert result.metrics() == {"penalty/jacobian_norm": 7.0}
    assert result.penalty.item() == 3.5


def test_the_exact_norm_is_that_of_central_differences():
    net, states = mlp(), obs()
    result = JacobianNorm(exact=True)(net, states)
    want = (central_differences(net, states) ** 2).sum((1, 2)).mean() / 2
    assert result.metrics()["penalty/jacobian_norm"] == pytest.approx(want, rel=1e-6)


def test_one_output_needs_no_average():
    # v is ±1 then, so that one projection is exact
    result = JacobianNorm(coefficient=1.0)(linear([[3.0, 4.0]]), obs(n=2))
    assert result.penalty.item() == pytest.approx(12.5)


def test_the_estimate_has_the_exact_mean():
    # of ½ · 2 · (9 a² + 5 b²), a² + b² = 1: mean 7, and 5 and 9 at the ends
    result = JacobianNorm(coefficient=1.0, projections=4000)(linear(HAND), obs(8))
    assert result.penalty.item() == pytest.approx(7.0, rel=0.01)
    single = [JacobianNorm(1.0, seed=k)(linear(HAND), obs(1)).penalty.item() for k in range(50)]
    assert 5 <= min(single) < 6
    assert 8 < max(single) <= 9


@pytest.mark.parametrize("exact", [False, True])
def test_the_gradient_is_that_of_finite_differences(exact):
    net, states = mlp(), obs()
    assert gradcheck(net, lambda policy: JacobianNorm(1.0, exact=exact)(policy, states))


@pytest.mark.parametrize("exact", [False, True])
def test_it_grows_with_the_square_of_the_policy(exact):
    net, states = mlp(), obs()
    one = JacobianNorm(exact=exact)(net, states).penalty
    twice = JacobianNorm(exact=exact)(lambda x: 2 * net(x), states).penalty
    torch.testing.assert_close(twice, 4 * one)


def test_a_constant_policy_costs_nothing():
    net = mlp()
    result = JacobianNorm()(lambda x: 0.0 * net(x) + 3.0, obs())
    assert result.penalty.item() == 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coefficient": -0.1}, "coefficient must be finite and at least 0, got -0.1"),
        ({"projections": 0}, "projections must be at least 1, got 0"),
        ({"select": "best"}, "select must be one of"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        JacobianNorm(**options)
