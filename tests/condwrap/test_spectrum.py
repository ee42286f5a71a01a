"""Singular values against NumPy's, and each measure against what it is a measure of."""

import copy
import gc
import math
import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch import distributions as td

from condwrap import ConditioningRegularizer
from condwrap.spectrum import (
    condition_number,
    jacobian_singular_values,
    largest_singular_value,
    mean_squared_singular_value,
    squared_frobenius_norm,
)
from tests.condwrap.helpers import central_differences, stochastic

# PyTorch itself scripts what forward mode imports
pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit.script.* is deprecated:DeprecationWarning"
)

PROPERTY = settings(derandomize=True, deadline=None, max_examples=15)
MEASURES = {
    f.__name__: f
    for f in (
        jacobian_singular_values,
        condition_number,
        mean_squared_singular_value,
        largest_singular_value,
        squared_frobenius_norm,
    )
}
EXACT = [jacobian_singular_values, condition_number, mean_squared_singular_value]
DRAWN = [largest_singular_value, squared_frobenius_norm]
every_measure = pytest.mark.parametrize("measure", MEASURES.values(), ids=MEASURES)
exact_measures = pytest.mark.parametrize("measure", EXACT)
drawn_measures = pytest.mark.parametrize("measure", DRAWN)


def mlp(n=4, m=3):
    return nn.Sequential(nn.Linear(n, 16), nn.Tanh(), nn.Linear(16, m))


def with_jacobians(matrices):
    """A policy and observations, [B, n], whose Jacobians are these, [B, m, n]."""
    obs = torch.randn(len(matrices), matrices.shape[2], dtype=matrices.dtype)
    return lambda x: torch.einsum("bmn,bn->bm", matrices, x), obs


def of_singular_values(values, m, n, count=20):
    """Random float64 matrices, [count, m, n]."""
    left = torch.linalg.qr(torch.randn(count, m, len(values), dtype=torch.float64))[0]
    right = torch.linalg.qr(torch.randn(count, n, len(values), dtype=torch.float64))[0]
    return left * torch.as_tensor(values, dtype=torch.float64) @ right.mT


def gradient(measure, matrices, **options):
    matrices = matrices.clone().requires_grad_()
    values = measure(*with_jacobians(matrices), **options)
    return torch.autograd.grad(values.sum(), matrices)[0]


# --- values worked out by hand ----------------------------------------------------------------

HAND = [[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize(
    ("measure", "expected"),
    [
        (jacobian_singular_values, [3, 2]),
        (condition_number, 1.5),
        (mean_squared_singular_value, 6.5),
        (largest_singular_value, 3),
        (squared_frobenius_norm, 13),
    ],
)
def test_values_worked_out_by_hand(measure, expected, transposed, dtype):
    matrix = torch.tensor(HAND, dtype=dtype)
    matrix = matrix.T if transposed else matrix
    probes = {"probes": 1000} if measure is squared_frobenius_norm else {}
    got = measure(lambda x: x @ matrix.T, torch.ones(2, matrix.shape[1], dtype=dtype), **probes)
    assert got.dtype == dtype
    want = torch.tensor(expected, dtype=dtype).expand(got.shape)
    assert got.shape[0] == 2
    torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 6), (6, 1), (3, 3)])
def test_an_orthogonal_jacobian_is_perfectly_conditioned(m, n):
    policy, obs = with_jacobians(of_singular_values([1.0] * min(m, n), m, n))
    ones = torch.ones(20, min(m, n), dtype=torch.float64)
    torch.testing.assert_close(jacobian_singular_values(policy, obs), ones)
    for measure in (condition_number, mean_squared_singular_value, largest_singular_value):
        torch.testing.assert_close(measure(policy, obs), ones[:, 0])


# --- all singular values ----------------------------------------------------------------------

# float32 takes the Gram matrix for the first four and the SVD for the others
SHAPES = [(10, 3), (3, 10), (8, 4), (1, 6), (7, 4), (4, 7), (5, 5)]


@pytest.mark.parametrize(("m", "n"), SHAPES)
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float32, 1e-5), (torch.float64, 1e-8)])
def test_singular_values_are_numpys_of_central_differences(m, n, dtype, rtol):
    policy, obs = mlp(n, m).double(), torch.randn(6, n).double()
    expected = np.linalg.svd(central_differences(policy, obs), compute_uv=False)
    got = jacobian_singular_values(policy.to(dtype), obs.to(dtype))
    assert got.dtype == dtype
    assert got.shape == (6, min(m, n))
    np.testing.assert_allclose(got.detach().numpy(), expected, rtol=0, atol=rtol * expected.max())


@pytest.mark.parametrize(("m", "n"), [*SHAPES, (60, 12), (12, 60), (40, 30)])
@pytest.mark.parametrize("condition", [1.0, 1e2, 1e4])
@pytest.mark.parametrize(("dtype", "accuracy"), [(torch.float32, 1e-7), (torch.float64, 1e-16)])
def test_the_error_is_as_small_as_stated(m, n, condition, dtype, accuracy):
    values = np.geomspace(7.0, 7.0 / condition, min(m, n))
    matrices = of_singular_values(values, m, n).to(dtype)
    got = jacobian_singular_values(*with_jacobians(matrices)).double().numpy()
    exact = np.linalg.svd(matrices.double().numpy(), compute_uv=False)
    assert np.abs(got - exact).max() < 10 * accuracy * 7


@pytest.mark.parametrize(("m", "n"), [(3, 12), (12, 3), (4, 5), (5, 5)])
def test_an_ill_conditioned_jacobian_has_its_condition_number(m, n):
    matrices = of_singular_values(np.geomspace(1.0, 1e-4, min(m, n)), m, n).float()
    exact = np.linalg.cond(matrices.double().numpy())
    got = condition_number(*with_jacobians(matrices)).numpy()
    np.testing.assert_allclose(got, exact, rtol=1e-2)  # 1e-7 of 1e-4, and some


@PROPERTY
@given(m=st.integers(1, 9), n=st.integers(1, 9), scale=st.floats(-8, 8), seed=st.integers(0, 99))
def test_any_jacobian_has_numpys_singular_values(m, n, scale, seed):
    matrices = torch.randn(3, m, n, generator=torch.Generator().manual_seed(seed)) * 10**scale
    exact = np.linalg.svd(matrices.double().numpy(), compute_uv=False)
    policy, obs = with_jacobians(matrices)
    got = jacobian_singular_values(policy, obs).numpy()
    np.testing.assert_allclose(got, exact, rtol=0, atol=1e-6 * exact.max())
    assert (np.diff(got) <= 0).all()
    squares = mean_squared_singular_value(policy, obs).numpy()
    np.testing.assert_allclose(squares, (exact**2).mean(1), rtol=1e-5)
    assert (condition_number(policy, obs) >= 1).all()


# --- rank-deficient Jacobians -----------------------------------------------------------------


@pytest.mark.parametrize(("m", "n"), [(2, 7), (7, 2), (4, 12), (4, 5), (5, 5)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rank", [0, 1])
def test_a_jacobian_of_lower_rank_has_singular_value_0_and_a_finite_gradient(m, n, dtype, rank):
    matrices = of_singular_values([3.0] * rank, m, n, count=2000).to(dtype)
    got = jacobian_singular_values(*with_jacobians(matrices))
    epsilon = 100 * torch.finfo(dtype).eps
    torch.testing.assert_close(got[:, :rank], torch.full_like(got[:, :rank], 3.0))
    assert got[:, rank:].abs().max() < epsilon
    slope = gradient(jacobian_singular_values, matrices)
    assert slope.isfinite().all()
    # the slope of each singular value, u vᵀ, has norm 1
    assert slope.flatten(1).norm(dim=1).max() < 1.5 * math.sqrt(min(m, n))


@pytest.mark.parametrize("columns", [2, 3, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("used", [0, 1])
def test_the_condition_number_is_infinite_where_an_output_never_moves(columns, dtype, used):
    matrices = torch.zeros(4, 2, columns, dtype=dtype)
    matrices[:, :used] = 1.0
    matrices[3, 1, 1] = matrices[3, 0, 0] = 1.0  # this one is of full rank
    got = condition_number(*with_jacobians(matrices))
    assert got[:3].isinf().all()
    assert got[:3].gt(0).all()
    assert got[3].isfinite()
    slope = gradient(condition_number, matrices)
    assert slope[:3].eq(0).all()
    assert slope[3].isfinite().all()


@pytest.mark.parametrize(("m", "n"), [(3, 8), (4, 5)])
def test_the_condition_number_is_huge_where_rounding_hides_a_0(m, n):
    matrices = of_singular_values([3.0, 2.0], m, n).float()
    assert condition_number(*with_jacobians(matrices)).min() > 1e6


@every_measure
def test_a_constant_policy_has_a_spectrum_of_0(measure):
    policy = nn.Linear(4, 2)
    nn.init.zeros_(policy.weight)
    got = measure(policy, torch.randn(3, 4))
    assert got.eq(math.inf if measure is condition_number else 0).all()
    got.sum().backward()
    assert policy.weight.grad.eq(0).all() or measure is jacobian_singular_values
    assert policy.weight.grad.isfinite().all()


@every_measure
@pytest.mark.parametrize("n", [3, 4, 40])
def test_a_jacobian_that_is_not_a_number_is_not_called_0(measure, n):
    factor = torch.tensor([1.0, math.nan, 1.0])[:, None]
    got = measure(lambda x: factor * x[:, :3] ** 2, torch.ones(3, n))
    assert got[1].isnan().all()
    assert got[[0, 2]].isfinite().all()


# --- the mean square --------------------------------------------------------------------------


@pytest.mark.parametrize(("m", "n"), SHAPES)
def test_the_mean_square_is_that_of_the_singular_values(m, n):
    policy, obs = mlp(n, m), torch.randn(6, n)
    expected = jacobian_singular_values(policy, obs).square().mean(1)
    torch.testing.assert_close(mean_squared_singular_value(policy, obs), expected)


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_the_mean_square_of_the_quotient_is_the_frobenius_norm_over_n(estimator):
    policy, draws = mlp(5, 3).double(), 20_000
    obs = torch.randn(3, 5, dtype=torch.float64)
    regularizer = ConditioningRegularizer(
        coefficient=0, perturbation="sphere", radius=1e-4, estimator=estimator, seed=1
    )
    quotient = regularizer(policy, obs.repeat_interleave(draws, 0)).quotient.reshape(3, draws)
    expected = 3 * mean_squared_singular_value(policy, obs).detach() / 5
    squares = quotient.square()
    error = squares.std(1) / math.sqrt(draws)
    assert (error < 0.01 * expected).all()
    assert ((squares.mean(1) - expected).abs() < 4 * error).all()


# --- the largest ------------------------------------------------------------------------------


@pytest.mark.parametrize("iterations", [1, 2, 3, 5])
def test_the_direction_is_the_best_in_the_space_of_the_iterates(iterations):
    """V spans k + 1 powers of JᵀJ times the first vector, U spans J times the first k of them."""
    matrices = torch.randn(6, 7, 9, dtype=torch.float64)
    policy, obs = with_jacobians(matrices)
    got = largest_singular_value(policy, obs, iterations=iterations)
    first = torch.randn(6, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gram = matrices.mT @ matrices
    krylov = [torch.linalg.matrix_power(gram, k) @ first[..., None] for k in range(iterations + 1)]
    spanning = torch.cat([x / x.norm(dim=1, keepdim=True) for x in krylov], -1)
    rights = torch.linalg.qr(spanning).Q
    lefts = torch.linalg.qr(matrices @ spanning[..., :-1]).Q
    best = torch.linalg.svd(lefts.mT @ matrices @ rights).Vh[:, 0]
    expected = (matrices @ rights @ best[..., None]).norm(dim=1)[:, 0]
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("m", "n"), SHAPES)
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_iterations_rise_to_the_largest_singular_value(m, n, dtype, rtol):
    matrices = of_singular_values(np.geomspace(5.0, 1.0, min(m, n)), m, n).to(dtype)
    policy, obs = with_jacobians(matrices)
    path = [largest_singular_value(policy, obs, iterations=k) for k in (1, 2, 4, 8, 30)]
    exact = jacobian_singular_values(policy, obs)[:, 0]
    for one, more in zip(path, [*path[1:], exact], strict=True):
        assert (one <= more * (1 + rtol)).all()
    torch.testing.assert_close(path[-1], exact, rtol=rtol, atol=0)
    assert (path[0] < 0.99 * exact).any() or min(m, n) == 1


@pytest.mark.parametrize(("m", "n"), [(8, 3), (3, 8)])
def test_the_largest_singular_value_of_a_network(m, n):
    policy, obs = mlp(n, m), torch.randn(8, n)
    exact = jacobian_singular_values(policy, obs)[:, 0]
    got = largest_singular_value(policy, obs, iterations=100)
    torch.testing.assert_close(got, exact, rtol=1e-4, atol=0)


def test_twenty_iterations_suffice_for_a_policy_of_a_humanoids_size():
    """Power iteration was 3% off after as many."""
    net = torch.nn.Sequential(torch.nn.Linear(44, 64), torch.nn.Tanh(), torch.nn.Linear(64, 17))
    obs = torch.randn(64, 44)
    exact = jacobian_singular_values(net, obs)[:, 0]
    torch.testing.assert_close(largest_singular_value(net, obs), exact, rtol=1e-5, atol=0)


@pytest.mark.parametrize("scale", [1e-15, 1e-12, 1e12, 1e15])
def test_iterations_survive_a_saturated_or_steep_policy(scale):
    matrices = of_singular_values([3.0, 1.0], 4, 6).float()
    got = largest_singular_value(*with_jacobians(matrices * scale))
    torch.testing.assert_close(got / scale, torch.full((20,), 3.0), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("m", "n"), [(3, 8), (8, 3), (5, 5)])
def test_where_it_has_converged_the_gradient_is_that_of_the_exact_one(m, n):
    values = np.geomspace(4.0, 1.0, min(m, n))
    matrices = of_singular_values(values, m, n)
    got = gradient(largest_singular_value, matrices, iterations=60)
    u, _, v = torch.linalg.svd(matrices, full_matrices=False)
    torch.testing.assert_close(got, u[:, :, :1] @ v[:, :1])
    exact = gradient(lambda *args: jacobian_singular_values(*args)[:, 0], matrices)
    torch.testing.assert_close(got, exact)


def test_twenty_iterations_are_the_default():
    policy, obs = with_jacobians(torch.diag(torch.linspace(0.9, 1.0, 100).double())[None])
    default = largest_singular_value(policy, obs)
    assert default == largest_singular_value(policy, obs, iterations=20)
    assert default < largest_singular_value(policy, obs, iterations=21)


def test_the_direction_is_held_fixed_in_the_gradient():
    """J = diag(w): of ‖J v‖ with v held, the gradient is w v² / ‖J v‖, converged or not."""
    w = torch.tensor([2.0, 1.0], dtype=torch.float64, requires_grad=True)
    obs = torch.zeros(1, 2, dtype=torch.float64)
    first = torch.Generator().manual_seed(0)
    v = torch.randn(1, 2, generator=first, dtype=torch.float64)
    v = v * w.detach() ** 2
    v = v / v.norm()
    largest = largest_singular_value(lambda x: x * w, obs, iterations=1)
    (gradient,) = torch.autograd.grad(largest.sum(), w)
    length = (w * v).norm().item()
    assert largest.item() == pytest.approx(length)
    expected = (w.detach() * v**2).flatten() / length
    torch.testing.assert_close(gradient, expected)


@pytest.mark.parametrize(
    ("m", "n", "dtype", "by_gram_matrix"),
    [
        (3, 5, torch.float32, False),
        (5, 3, torch.float32, False),
        (3, 6, torch.float32, True),
        (6, 3, torch.float32, True),
        (3, 9, torch.float64, False),
    ],
)
def test_the_gram_matrix_serves_where_the_jacobian_is_long(
    monkeypatch, m, n, dtype, by_gram_matrix
):
    calls = []
    eigvalsh = torch.linalg.eigvalsh
    monkeypatch.setattr(torch.linalg, "eigvalsh", lambda x: calls.append(x) or eigvalsh(x))
    policy, obs = with_jacobians(torch.randn(2, m, n, dtype=dtype))
    jacobian_singular_values(policy, obs)
    assert [x.shape for x in calls] == ([(2, 3, 3)] if by_gram_matrix else [])


def test_a_jacobian_too_large_to_be_held_is_measured():
    diagonal = torch.linspace(0.0, 1.0, 200_000)  # its Jacobian would take 160 GB
    diagonal[7] = 2.0
    obs = torch.randn(1, 200_000)
    largest = largest_singular_value(lambda x: diagonal * x, obs)
    torch.testing.assert_close(largest, torch.tensor([2.0]), rtol=1e-5, atol=0)
    # one entry in each row and column: signs do not matter
    squares = squared_frobenius_norm(lambda x: diagonal * x, obs)
    torch.testing.assert_close(squares, diagonal.square().sum()[None])


@pytest.mark.parametrize(
    ("measure", "options", "evaluations"),
    [
        (largest_singular_value, {"iterations": 1}, 3),
        (largest_singular_value, {"iterations": 2}, 4),
        (largest_singular_value, {"iterations": 50}, 5),  # of 3 outputs no more are needed
        (squared_frobenius_norm, {"probes": 1}, 1),
        (squared_frobenius_norm, {"probes": 50}, 1),
    ],
)
def test_a_product_costs_at_most_an_evaluation(measure, options, evaluations):
    net, seen = mlp(), []

    def policy(obs):
        seen.append(len(obs))
        return net(obs)

    measure(policy, torch.randn(6, 4), **options)
    assert seen == [6] * evaluations


# --- the Frobenius norm -----------------------------------------------------------------------


@pytest.mark.parametrize("probes", [1, 3])
def test_the_frobenius_norm_is_unbiased(probes):
    policy, draws = mlp(4, 6).double(), 10_000
    obs = torch.randn(3, 4, dtype=torch.float64)
    many = obs.repeat_interleave(draws, 0)
    got = squared_frobenius_norm(policy, many, probes=probes).detach().reshape(3, draws)
    exact = 4 * mean_squared_singular_value(policy, obs).detach()
    error = got.std(1) / math.sqrt(draws)
    assert (error > 0).all()
    assert (error < 0.01 * exact).all()
    assert ((got.mean(1) - exact).abs() < 4 * error).all()


def test_the_deviation_falls_as_the_root_of_the_probes():
    policy, obs = mlp(4, 6), torch.randn(1, 4).expand(4000, 4)
    few, many = (squared_frobenius_norm(policy, obs, probes=k).std() for k in (2, 32))
    assert (few / many).item() == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize("probes", [1, 2])
def test_one_output_makes_the_frobenius_norm_exact(probes):
    policy, obs = mlp(5, 1), torch.randn(6, 5)
    exact = jacobian_singular_values(policy, obs)[:, 0].square()
    torch.testing.assert_close(squared_frobenius_norm(policy, obs, probes=probes), exact)


# --- as a penalty -----------------------------------------------------------------------------

PENALTIES = {
    "all": lambda policy, obs: jacobian_singular_values(policy, obs).sum(1),
    "condition": condition_number,
    "mean square": mean_squared_singular_value,
    "largest": lambda policy, obs: largest_singular_value(policy, obs, iterations=30),
    "frobenius": lambda policy, obs: squared_frobenius_norm(policy, obs, probes=3),
}
penalties = pytest.mark.parametrize("name", PENALTIES)


@penalties
@pytest.mark.parametrize(("m", "n"), [(2, 5), (5, 2), (3, 4)])
def test_the_gradient_of_a_penalty_is_that_of_finite_differences(name, m, n):
    obs = torch.randn(3, n, dtype=torch.float64)
    # singular values apart, so that 30 iterations converge
    weight = of_singular_values(np.geomspace(2.0, 0.2, min(m, n)), m, n, count=1)[0]

    def penalty(weight):
        return PENALTIES[name](lambda x: torch.tanh(x @ weight.T / 4), obs).mean()

    assert torch.autograd.gradcheck(penalty, weight.requires_grad_())


@exact_measures
@pytest.mark.parametrize(("m", "n"), SHAPES)
def test_the_gradient_in_float32_is_that_in_float64(measure, m, n):
    policy, obs = mlp(n, m), torch.randn(4, n)

    def slopes(policy, obs):
        weights = [p for p in policy.parameters() if p.ndim == 2]
        return torch.autograd.grad(measure(policy, obs).log().mean(), weights)

    got = slopes(policy, obs)
    expected = slopes(copy.deepcopy(policy).double(), obs.double())
    for one, other in zip(got, expected, strict=True):
        torch.testing.assert_close(one, other.float(), rtol=1e-3, atol=1e-4)


@penalties
def test_learning_lowers_what_is_penalized(name):
    policy, obs = mlp(4, 3), torch.randn(16, 4)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.01)

    def measured():
        if name == "condition":
            return condition_number(policy, obs).mean().item()
        return jacobian_singular_values(policy, obs)[:, 0].mean().item()

    before = measured()
    for _ in range(10):
        optimizer.zero_grad()
        PENALTIES[name](policy, obs).log().mean().backward()
        optimizer.step()
    assert measured() < 0.9 * before


@every_measure
@pytest.mark.parametrize("enabled", [True, False])
def test_a_gradient_is_carried_where_gradients_are_enabled(measure, enabled):
    policy, obs = mlp(), torch.randn(3, 4)
    with torch.set_grad_enabled(enabled):
        got = measure(policy, obs)
    assert got.requires_grad == enabled
    assert got.gt(0).all()
    assert all(p.grad is None for p in policy.parameters())


@every_measure
def test_a_measure_can_be_taken_in_inference_mode(measure):
    policy, obs = mlp(), torch.randn(3, 4)
    with torch.inference_mode():
        got = measure(policy, obs)
    torch.testing.assert_close(got, measure(policy, obs).detach())


# --- invariances ------------------------------------------------------------------------------


@settings(PROPERTY, max_examples=8)
@given(
    factor=st.floats(0.01, 100).flatmap(lambda c: st.sampled_from([c, -c])),
    seed=st.integers(0, 999),
)
def test_scaling_a_policy_scales_its_singular_values(factor, seed):
    torch.manual_seed(seed)
    policy, obs = mlp(), torch.randn(3, 4)
    for measure, power in zip(MEASURES.values(), (1, 0, 2, 1, 2), strict=True):
        got = measure(lambda x: factor * policy(x), obs)
        expected = abs(factor) ** power * measure(policy, obs)
        torch.testing.assert_close(got, expected, rtol=1e-3, atol=0)


@PROPERTY
@given(seed=st.integers(0, 999), m=st.integers(1, 6), n=st.integers(1, 6))
def test_orthogonal_maps_leave_the_spectrum_as_it_is(seed, m, n):
    torch.manual_seed(seed)
    policy, obs = mlp(n, m).double(), torch.randn(3, n, dtype=torch.float64)
    turn, turn_back = (torch.linalg.qr(torch.randn(k, k, dtype=torch.float64))[0] for k in (n, m))

    def turned(x):
        return policy(x @ turn.T) @ turn_back

    for measure in EXACT:
        torch.testing.assert_close(measure(turned, obs @ turn), measure(policy, obs))


# --- policies and observations ----------------------------------------------------------------


class Mixed(nn.Module):
    """Linear in an image and a vector; the mode scales the output."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(4 + 3, 5, bias=False)

    def forward(self, obs):
        moved = torch.cat([obs["image"].flatten(1) / 255, obs["vector"]], -1)
        return self.linear(moved) * obs["mode"][:, None]


@every_measure
def test_dict_observations_are_measured_as_one_vector(measure):
    policy = Mixed()
    obs = {
        "image": torch.randint(0, 256, (3, 2, 2), dtype=torch.uint8),
        "mode": torch.tensor([1, 2, 3]),
        "vector": torch.randn(3, 3),
    }
    jacobians = policy.linear.weight * obs["mode"][:, None, None]
    expected = measure(*with_jacobians(jacobians))
    torch.testing.assert_close(measure(policy, obs), expected, rtol=1e-3, atol=0)


def conv():
    return nn.Sequential(
        nn.Conv2d(2, 4, 3), nn.ReLU(), nn.MaxPool2d(2), nn.Flatten(), nn.Linear(16, 3)
    )


@every_measure
def test_uint8_images_are_measured_in_the_units_after_division(measure):
    net, image = conv(), torch.randint(0, 256, (4, 2, 6, 6), dtype=torch.uint8)
    got = measure(lambda obs: net(obs / 255), image)
    torch.testing.assert_close(got, measure(net, image / 255), rtol=1e-4, atol=0)
    got.sum().backward()
    assert net[0].weight.grad.abs().sum() > 0


OUTPUTS = [
    (lambda x: td.Normal(x, 1.0), lambda x: x, "default"),
    (lambda x: td.Categorical(logits=x), lambda x: x.log_softmax(-1), "default"),
    (lambda x: td.Categorical(logits=x), lambda x: x.softmax(-1), "probs"),
    (lambda x: {"pi": x, "v": x[:, :2]}, lambda x: x[:, :2], lambda output: output["v"]),
]


@every_measure
@pytest.mark.parametrize(("output", "tensor", "select"), OUTPUTS)
def test_output_selects_what_counts(measure, output, tensor, select):
    net, obs = mlp(), torch.randn(4, 4)
    got = measure(lambda x: output(net(x)), obs, select=select)
    expected = measure(lambda x: tensor(net(x)), obs)
    if measure is condition_number:  # of a Categorical it is all rounding
        got, expected = got.clamp(max=1e4), expected.clamp(max=1e4)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("select", ["logits", "probs"])
@pytest.mark.parametrize("n", [4, 12])
def test_a_categorical_has_one_output_too_many(select, n):
    net, obs = mlp(n, 3), torch.randn(4, n)
    got = condition_number(lambda x: td.Categorical(logits=net(x)), obs, select=select)
    assert got.min() > 1e5
    assert condition_number(net, obs).max() < 1e3


class Recurrent(nn.Module):
    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(4, 6, batch_first=True)
        self.head = nn.Linear(6, 2)

    def forward(self, obs):
        return td.Normal(self.head(self.gru(obs)[0][:, -1]), 1.0)


def test_a_recurrent_policy_is_measured_over_whole_sequences():
    policy, obs = Recurrent().double(), torch.randn(3, 5, 4, dtype=torch.float64)
    jacobians = central_differences(lambda x: policy(x.reshape(3, 5, 4)).mean, obs.flatten(1))
    exact = np.linalg.svd(jacobians, compute_uv=False)
    got = jacobian_singular_values(policy, obs)
    np.testing.assert_allclose(got.detach().numpy(), exact, rtol=1e-6)
    largest = largest_singular_value(policy, obs, iterations=100)
    np.testing.assert_allclose(largest.detach().numpy(), exact[:, 0], rtol=1e-6)
    squares = squared_frobenius_norm(policy, obs, probes=4000)
    np.testing.assert_allclose(squares.detach().numpy(), (exact**2).sum(1), rtol=0.1)
    (got.sum() + largest.sum() + squares.sum()).backward()
    assert policy.gru.weight_hh_l0.grad.abs().sum() > 0


@every_measure
def test_under_bf16_autocast_a_measure_is_that_of_float32(measure):
    policy, obs = mlp(4, 3), torch.randn(8, 4)
    expected = measure(policy, obs)
    slopes = torch.autograd.grad(expected.sum(), policy[0].weight)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = measure(policy, obs)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(torch.autograd.grad(got.sum(), policy[0].weight), slopes)


# --- chunks -----------------------------------------------------------------------------------


@exact_measures
@pytest.mark.parametrize(
    ("chunk_size", "sizes"),
    [(None, [7]), (1, [1] * 7), (3, [3, 3, 1]), (7, [7]), (100, [7])],
)
def test_chunks_bound_the_batch_and_change_no_number(measure, chunk_size, sizes):
    net, seen, obs = mlp(), [], torch.randn(7, 4)

    def policy(obs):
        seen.append(len(obs))
        return net(obs)

    got = measure(policy, obs, chunk_size=chunk_size)
    assert seen == sizes
    torch.testing.assert_close(got, measure(net, obs), rtol=1e-4, atol=0)


@exact_measures
def test_one_chunk_of_jacobians_is_held_at_a_time(measure):
    held, shape = [], (2, 5, 11)

    def policy(obs):
        held.append(sum(type(x) is Tensor and x.shape == shape for x in gc.get_objects()))
        return obs[:, :5] ** 2

    measure(policy, torch.randn(8, 11), chunk_size=2)
    assert held == [0, 0, 0, 0]


# --- randomness and no trace ------------------------------------------------------------------


@every_measure
def test_measuring_leaves_no_trace(measure):
    policy, obs = stochastic(), torch.randn(6, 4)
    policy[4].eval()
    before = copy.deepcopy(policy.state_dict())
    flags = [m.training for m in policy.modules()]
    random_state = torch.get_rng_state()
    first = measure(policy, obs)
    assert torch.equal(torch.get_rng_state(), random_state)
    assert [m.training for m in policy.modules()] == flags
    assert policy.state_dict().keys() == before.keys()
    assert all(torch.equal(policy.state_dict()[k], v) for k, v in before.items())
    assert all(p.grad is None for p in policy.parameters())
    assert torch.equal(measure(policy, obs), first)


@pytest.mark.parametrize("make", [stochastic, lambda: nn.Sequential(mlp(4, 20), nn.Dropout())])
def test_all_products_see_one_dropout_mask(make):
    policy, obs = make(), torch.randn(6, 4)
    exact = jacobian_singular_values(policy, obs)
    largest = largest_singular_value(policy, obs, iterations=100)
    torch.testing.assert_close(largest, exact[:, 0], rtol=1e-4, atol=0)
    squares = squared_frobenius_norm(policy, obs, probes=4000)
    torch.testing.assert_close(squares, exact.square().sum(1), rtol=0.1, atol=0)
    torch.manual_seed(1)
    assert not torch.equal(jacobian_singular_values(policy, obs), exact)


@every_measure
def test_batch_norm_in_training_is_measured_as_in_evaluation(measure):
    policy, obs = stochastic(), torch.randn(6, 4)
    policy[3].eval()
    torch.testing.assert_close(measure(copy.deepcopy(policy).eval(), obs), measure(policy, obs))


@exact_measures
def test_batch_norm_makes_no_state_depend_on_another(measure):
    policy, obs = stochastic(), torch.randn(6, 4)
    policy[3].eval()  # dropout masks depend on the place in the batch
    alone, whole = measure(policy, obs[2:4]), measure(policy, obs)
    torch.testing.assert_close(alone, whole[2:4], rtol=1e-4, atol=0)


ONE_DRAW = {largest_singular_value: {"iterations": 1}, squared_frobenius_norm: {"probes": 1}}


@drawn_measures
def test_the_draw_is_that_of_seed_0_by_default(measure):
    policy, obs, options = mlp(), torch.randn(6, 4), ONE_DRAW[measure]
    default = measure(policy, obs, **options)
    torch.manual_seed(123)
    assert torch.equal(measure(policy, obs, **options), default)
    by_seed = [
        measure(policy, obs, generator=torch.Generator().manual_seed(s), **options) for s in (0, 1)
    ]
    assert torch.equal(by_seed[0], default)
    assert not torch.equal(by_seed[1], default)


@every_measure
def test_the_default_device_plays_no_part(measure):
    """All is made where the states are, so that a policy on a GPU needs no default device."""
    policy, obs = mlp(), torch.randn(5, 4)
    expected = measure(policy, obs)
    with torch.device("meta"):
        got = measure(policy, obs)
    assert torch.equal(got, expected)


@drawn_measures
def test_a_generator_draws_anew_at_each_call(measure):
    policy, obs, options = mlp(), torch.randn(6, 4), ONE_DRAW[measure]
    generator = torch.Generator().manual_seed(5)
    state = generator.get_state()
    first = measure(policy, obs, generator=generator, **options)
    second = measure(policy, obs, generator=generator, **options)
    assert not torch.equal(first, second)
    generator.set_state(state)
    assert torch.equal(measure(policy, obs, generator=generator, **options), first)


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0, -2])
@pytest.mark.parametrize(
    ("measure", "name"),
    [
        *((measure, "chunk_size") for measure in EXACT),
        (largest_singular_value, "iterations"),
        (squared_frobenius_norm, "probes"),
    ],
)
def test_a_count_below_1_is_refused(measure, name, value):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got {value}"):
        measure(mlp(), torch.ones(3, 4), **{name: value})


@every_measure
@pytest.mark.parametrize(
    ("obs", "options", "error", "message"),
    [
        (torch.ones(0, 4), {}, ValueError, "obs must not be empty, got shapes [(0, 4)]"),
        (torch.ones(3, 4) * math.nan, {}, ValueError, "obs must be finite, got NaN or infinity"),
        (torch.ones(3, 4).long(), {}, TypeError, "obs must be floating or uint8, got torch.int64"),
        (torch.ones(3, 4), {"select": "variance"}, ValueError, "select must be one of"),
        (torch.ones(3, 4), {"select": "mean_"}, ValueError, "got 'mean_'"),
    ],
)
def test_what_cannot_be_read_is_refused(measure, obs, options, error, message):
    with pytest.raises(error, match=re.escape(message)):
        measure(mlp(), obs, **options)


@every_measure
@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (lambda x: x.mean(0), ValueError, "begin with the batch axes (3,) of the observations"),
        (lambda x: x.argmax(-1), TypeError, "output must be floating, got torch.int64"),
    ],
)
def test_an_output_is_refused(measure, policy, error, message):
    with pytest.raises(error, match=re.escape(message)):
        measure(policy, torch.ones(3, 4))
