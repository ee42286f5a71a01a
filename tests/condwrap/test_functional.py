"""Equations (1) and (2): hand-worked values, three array libraries, gradients, bad input."""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from condwrap import clamping_penalty, conditioning_quotient
from condwrap.functional import safe_norm

PROPERTY = settings(derandomize=True, deadline=None, max_examples=50)
LIBRARIES = {"numpy": np.asarray, "torch": torch.as_tensor, "jax": jnp.asarray}
TOLERANCE = {"float32": 1e-6, "float64": 1e-14}
COMPILED = {"fullgraph": True, "backend": "aot_eager"}

library = pytest.mark.parametrize("library", LIBRARIES)
dtype = pytest.mark.parametrize("dtype", TOLERANCE)

# change (3, 4), no change, change (0, 2) over delta of length 2, 3 and 0.5
OUTPUT = [[0.0, 0.0], [1.0, 1.0], [0.0, 2.0]]
PERTURBED = [[3.0, 4.0], [1.0, 1.0], [0.0, 0.0]]
DELTA = [[0.0, 0.0, 2.0], [1.0, 2.0, 2.0], [0.3, 0.4, 0.0]]
QUOTIENT = [2.5, 0.0, 4.0]


@pytest.fixture(autouse=True, scope="module")
def _float64_in_jax():
    with jax.enable_x64(True):
        yield


def arrays(library, dtype, *values):
    return [LIBRARIES[library](np.array(v, dtype=dtype)) for v in values]


def psi_of(output, perturbed_output, delta):
    return clamping_penalty(conditioning_quotient(output, perturbed_output, delta))


def torch_gradients(function, *inputs):
    leaves = [torch.tensor(x, requires_grad=True) for x in inputs]
    return [g.numpy() for g in torch.autograd.grad(function(*leaves).sum(), leaves)]


def jax_gradients(function, *inputs):
    leaves = [jnp.asarray(x) for x in inputs]
    every = tuple(range(len(leaves)))
    return jax.grad(lambda *xs: function(*xs).sum(), argnums=every)(*leaves)


GRADIENTS = {"torch": torch_gradients, "jax": jax_gradients}


@library
@dtype
def test_quotient_worked_out_by_hand(library, dtype):
    quotient = conditioning_quotient(*arrays(library, dtype, OUTPUT, PERTURBED, DELTA))
    assert isinstance(quotient, type(LIBRARIES[library](np.zeros(1))))
    assert str(quotient.dtype).endswith(dtype)
    np.testing.assert_allclose(np.asarray(quotient), QUOTIENT, rtol=TOLERANCE[dtype])


@library
@dtype
def test_penalty_worked_out_by_hand(library, dtype):
    (quotient,) = arrays(library, dtype, [[0.0, 0.5, 1.0], [7.0, 20.0, 23.0]])
    psi = clamping_penalty(quotient)
    assert isinstance(psi, type(quotient))
    assert psi.dtype == quotient.dtype
    np.testing.assert_array_equal(np.asarray(psi), [[1.0, 0.25, 0.0], [0.0, 0.0, 9.0]])


@library
@pytest.mark.parametrize(
    ("lambda_min", "lambda_max", "expected"),
    [
        (0.0, math.inf, [0.0, 0.0, 0.0]),
        (2.0, math.inf, [4.0, 0.0, 0.0]),
        (0.0, 4.0, [0.0, 0.0, 9.0]),
        (3.0, 3.0, [9.0, 0.0, 16.0]),
    ],
)
def test_penalty_with_other_ranges(library, lambda_min, lambda_max, expected):
    (quotient,) = arrays(library, "float64", [0.0, 3.0, 7.0])
    psi = clamping_penalty(quotient, lambda_min, lambda_max)
    np.testing.assert_array_equal(np.asarray(psi), expected)


@pytest.mark.parametrize("wide", ["output", "delta"])
@library
def test_mixed_dtypes_are_promoted(library, wide):
    """float32 beside float64 gives float64: 5 / 2 with a ninth digit that float32 lacks."""
    make = LIBRARIES[library]
    change = np.array([[3.0, 4.0]]) * (1 + 1e-9 * (wide == "output"))
    length = np.array([[0.0, 2.0]]) / (1 + 1e-9 * (wide == "delta"))
    dtypes = {"output": ("float64", "float32"), "delta": ("float32", "float64")}[wide]
    output = make(np.zeros((1, 2), dtypes[0]))
    quotient = conditioning_quotient(
        output, make(change.astype(dtypes[0])), make(length.astype(dtypes[1]))
    )
    assert str(quotient.dtype).endswith("float64")
    np.testing.assert_allclose(np.asarray(quotient), [2.5 * (1 + 1e-9)], rtol=1e-13)


@library
def test_batch_ndim_0_gives_one_quotient_of_the_whole_batch(library):
    quotient = conditioning_quotient(
        *arrays(library, "float64", OUTPUT, PERTURBED, DELTA), batch_ndim=0
    )
    assert quotient.shape == ()
    # changes of squared length 25, 0, 4 over deltas of squared length 4, 9, 0.25
    assert float(quotient) == pytest.approx(math.sqrt(29 / 13.25), rel=1e-14)


@library
def test_a_delta_of_0_counts_as_divisor_1(library):
    quotient = conditioning_quotient(
        *arrays(library, "float64", [[2.0], [1.0]], [[2.0], [4.0]], [[0.0], [0.0]])
    )
    np.testing.assert_array_equal(np.asarray(quotient), [0.0, 3.0])


@library
def test_an_empty_batch_has_an_empty_quotient(library):
    none = np.zeros((0, 3))
    quotient = conditioning_quotient(*arrays(library, "float64", none, none, none))
    assert quotient.shape == (0,)


@PROPERTY
@given(
    st.lists(st.integers(1, 3), max_size=3),
    st.lists(st.integers(1, 3), max_size=2),
    st.lists(st.integers(1, 3), max_size=2),
    st.integers(0, 99),
)
def test_any_leading_axes_agree_with_a_loop_over_states(batch, out_shape, obs_shape, seed):
    rng = np.random.default_rng(seed)
    output, perturbed = rng.normal(size=(2, *batch, *out_shape))
    delta = rng.normal(size=(*batch, *obs_shape))
    expected = np.empty(batch)
    for state in np.ndindex(*batch):
        change = np.linalg.norm(np.ravel(output[state] - perturbed[state]))
        expected[state] = change / np.linalg.norm(np.ravel(delta[state]))
    for library in ("numpy", "torch"):  # JAX compiles each shape anew, for a second
        inputs = arrays(library, "float64", output, perturbed, delta)
        quotient = conditioning_quotient(*inputs, batch_ndim=len(batch))
        assert quotient.shape == tuple(batch)
        np.testing.assert_allclose(np.asarray(quotient), expected, rtol=1e-12)


@pytest.mark.parametrize("batch_ndim", [0, 1, 2])
def test_leading_axes_in_jax_agree_with_numpy(batch_ndim):
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3, 5))
    from_jax = conditioning_quotient(*map(jnp.asarray, inputs), batch_ndim=batch_ndim)
    from_numpy = conditioning_quotient(*inputs, batch_ndim=batch_ndim)
    assert from_jax.shape == from_numpy.shape == (2, 3)[:batch_ndim]
    np.testing.assert_allclose(from_jax, from_numpy, rtol=1e-14)


@PROPERTY
@given(
    hnp.arrays(np.float64, 5, elements=st.floats(0, 1e6)),
    st.floats(0, 100),
    st.floats(0, 100),
)
def test_the_clip_form_is_the_two_terms_of_the_paper(quotient, one_end, other_end):
    lambda_min, lambda_max = sorted((one_end, other_end))
    psi_max = (np.maximum(quotient, lambda_max) - lambda_max) ** 2
    psi_min = (np.minimum(quotient, lambda_min) - lambda_min) ** 2
    psi = clamping_penalty(quotient, lambda_min, lambda_max)
    np.testing.assert_array_equal(psi, psi_min + psi_max)


@PROPERTY
@given(hnp.arrays(np.float64, (3, 4), elements=st.floats(-1e6, 1e6)), st.floats(1e-3, 1e3))
def test_quotient_scales_with_the_output_and_against_delta(output, factor):
    delta = np.full((3, 2), 0.7)
    quotient = conditioning_quotient(output, np.zeros_like(output), delta)
    assert (quotient >= 0).all()
    scaled = conditioning_quotient(factor * output, np.zeros_like(output), factor * delta)
    np.testing.assert_allclose(scaled, quotient, rtol=1e-9)


@pytest.mark.parametrize("library", GRADIENTS)
def test_gradients_worked_out_by_hand(library):
    # dJ/d output = (-3, -4) / 5 / 2, dJ/d delta = -J · delta / ‖delta‖² = -2.5 · (0, 2) / 4
    inputs = np.array([[0.0, 0.0]]), np.array([[3.0, 4.0]]), np.array([[0.0, 2.0]])
    output, perturbed, delta = GRADIENTS[library](conditioning_quotient, *inputs)
    np.testing.assert_allclose(output, [[-0.3, -0.4]], rtol=1e-14)
    np.testing.assert_allclose(perturbed, [[0.3, 0.4]], rtol=1e-14)
    np.testing.assert_allclose(delta, [[0.0, -1.25]], rtol=1e-14)


@dtype
def test_gradients_agree_between_torch_and_jax(dtype):
    rng = np.random.default_rng(0)
    # J below, within and above the range
    scale = np.array([0.1, 3.0, 90.0])[:, None]
    inputs = [
        x.astype(dtype) for x in (*(scale * rng.normal(size=(2, 3, 4))), rng.normal(size=(3, 5)))
    ]
    pairs = zip(torch_gradients(psi_of, *inputs), jax_gradients(psi_of, *inputs), strict=True)
    for from_torch, from_jax in pairs:
        assert from_torch.dtype == from_jax.dtype == dtype
        assert np.abs(from_torch).sum(-1).astype(bool).tolist() == [True, False, True]
        np.testing.assert_allclose(from_torch, from_jax, rtol=30 * TOLERANCE[dtype])


@pytest.mark.parametrize("library", GRADIENTS)
@pytest.mark.parametrize("function", [conditioning_quotient, psi_of])
@pytest.mark.parametrize("delta", [[[0.0, 2.0]], [[0.0, 0.0]]], ids=["delta", "no delta"])
def test_gradient_is_zero_where_outputs_are_equal(library, function, delta):
    equal = np.array([[1.0, -2.0]])
    for gradient in GRADIENTS[library](function, equal, equal, np.array(delta)):
        np.testing.assert_array_equal(gradient, np.zeros((1, 2)))


@pytest.mark.parametrize("library", GRADIENTS)
def test_safe_norm_and_its_gradient_at_0(library):
    x = np.array([[0.0, 0.0], [3.0, 4.0]])
    np.testing.assert_array_equal(np.asarray(safe_norm(LIBRARIES[library](x))), [0.0, 5.0])
    (gradient,) = GRADIENTS[library](safe_norm, x)
    np.testing.assert_allclose(gradient, [[0.0, 0.0], [0.6, 0.8]], rtol=1e-15)


def test_second_derivative_beside_a_state_that_does_not_respond():
    weight = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    output = weight * torch.tensor([[0.5], [0.0]], dtype=torch.float64)
    quotient = conditioning_quotient(output, torch.zeros_like(output), torch.ones_like(output))
    # psi = (0.5 w - 1)² + 1: its slope at w = 1 is 0.5 w - 1, and the slope of that 0.5
    (slope,) = torch.autograd.grad(clamping_penalty(quotient).sum(), weight, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, weight)
    assert (slope.item(), curvature.item()) == (-0.5, 0.5)


def test_jit_gives_the_same_values_and_gradients():
    inputs = arrays("jax", "float64", OUTPUT, PERTURBED, DELTA)
    np.testing.assert_allclose(jax.jit(conditioning_quotient)(*inputs), QUOTIENT, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(psi_of)(*inputs), [0.0, 1.0, 0.0], rtol=1e-14)
    slope = jax.grad(lambda *xs: psi_of(*xs).sum())
    np.testing.assert_allclose(jax.jit(slope)(*inputs), slope(*inputs), rtol=1e-14)


def test_torch_compile_gives_the_same_values_and_gradients():
    inputs = arrays("torch", "float64", OUTPUT, PERTURBED, DELTA)
    leaves = [x.clone().requires_grad_() for x in inputs]
    # pytest turns a warning of the compiler into an error
    psi = torch.compile(psi_of, **COMPILED)(*leaves)
    torch.testing.assert_close(psi, psi_of(*inputs))
    expected = torch_gradients(psi_of, OUTPUT, PERTURBED, DELTA)
    gradients = torch.autograd.grad(psi.sum(), leaves)
    for got, want in zip(gradients, expected, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-6)


X = np.ones((3, 2))


@pytest.mark.parametrize(
    ("inputs", "options", "error", "message"),
    [
        (([1.0], X, X), {}, TypeError, "output must be an array, got list"),
        ((X, X, None), {}, TypeError, "delta must be an array, got NoneType"),
        ((X, X.astype(int), X), {}, TypeError, "perturbed_output must be floating, got int64"),
        ((X, X, X.astype(complex)), {}, TypeError, "delta must be floating, got complex128"),
        (
            (X, torch.ones(3, 2), X),
            {},
            TypeError,
            "arrays of one library are needed, got output ndarray, perturbed_output Tensor, "
            "delta ndarray",
        ),
        (
            (X, np.ones((3, 1)), X),
            {},
            ValueError,
            "output and perturbed_output need the same shape, got (3, 2) and (3, 1)",
        ),
        (
            (X, X, np.ones((2, 2))),
            {},
            ValueError,
            "need the same 1 leading axes, got shapes (3, 2) and (2, 2)",
        ),
        ((X, X, X), {"batch_ndim": -1}, ValueError, "batch_ndim must be in [0, 2]"),
        ((X, X, X), {"batch_ndim": 3}, ValueError, "got 3"),
        (
            (X, X, np.ones(3)),
            {"batch_ndim": 2},
            ValueError,
            "batch_ndim must be in [0, 1] for an output of shape (3, 2) and a delta of shape (3,)",
        ),
    ],
)
def test_quotient_refuses(inputs, options, error, message):
    with pytest.raises(error, match=re.escape(message)):
        conditioning_quotient(*inputs, **options)


@pytest.mark.parametrize(
    ("quotient", "message"),
    [
        (3.0, "quotient must be an array, got float"),
        (np.array([1, 2]), "quotient must be floating, got int64"),
        (torch.tensor([True]), "quotient must be floating, got torch.bool"),
    ],
)
def test_penalty_refuses_what_is_no_floating_array(quotient, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        clamping_penalty(quotient)


@pytest.mark.parametrize(
    ("lambda_min", "lambda_max"),
    [(2.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (0.0, math.nan), (math.inf, math.inf)],
)
def test_penalty_refuses_a_range(lambda_min, lambda_max):
    message = f"got lambda_min={lambda_min} and lambda_max={lambda_max}"
    with pytest.raises(ValueError, match=re.escape(message)):
        clamping_penalty(np.ones(2), lambda_min, lambda_max)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_broken_output_does_not_pass_for_a_well_conditioned_one(value):
    output, other = torch.tensor([[value, 0.0]]), torch.zeros(1, 2)
    quotient = conditioning_quotient(output, other, torch.ones(1, 2))
    assert not torch.isfinite(quotient).any()
