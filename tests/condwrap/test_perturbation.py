"""The maps from noise to delta: lengths, distributions, libraries, bad input."""

import math
import re

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from scipy import stats

from condwrap import gaussian, sphere, uniform
from condwrap.perturbation import get_perturbation

MAPS = {"sphere": sphere, "gaussian": gaussian, "uniform": uniform}
LIBRARIES = {"numpy": np.asarray, "torch": torch.as_tensor}

every_map = pytest.mark.parametrize("name", MAPS)


def noise(*shape, dtype=np.float64):
    return np.random.default_rng(0).standard_normal(shape).astype(dtype)


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sphere", [[1.2, 1.6], [0.0, -2.0]]),
        # 2 / √2 · noise
        ("gaussian", [[4.242640687119285, 5.656854249492381], [0.0, -2.8284271247461903]]),
        # 2 · √(3/2) = √6; erf(z / √2) is the share of a normal sample within z deviations
        (
            "uniform",
            [
                [6**0.5 * 0.9973002039367398, 6**0.5 * 0.9999366575163338],
                [0.0, -(6**0.5) * 0.9544997361036416],
            ],
        ),
    ],
)
def test_delta_worked_out_by_hand(library, name, expected):
    z = LIBRARIES[library](np.array([[3.0, 4.0], [0.0, -2.0]]))
    delta = MAPS[name](z, radius=2.0)
    assert isinstance(delta, type(z))
    np.testing.assert_allclose(np.asarray(delta), expected, rtol=1e-14)


@every_map
def test_the_default_radius_is_1(name):
    z = noise(4, 3)
    np.testing.assert_array_equal(MAPS[name](z), MAPS[name](z, radius=1.0))


@pytest.mark.parametrize("radius", [1e-3, 1.0, 7.0])
def test_sphere_has_length_radius_on_any_leading_axes(radius):
    delta = sphere(noise(3, 4, 5), radius)
    np.testing.assert_allclose(np.linalg.norm(delta, axis=-1), np.full((3, 4), radius))


@every_map
@pytest.mark.parametrize("leading", [(), (2,), (2, 3)])
def test_leading_axes_index_states(name, leading):
    """Each row of four coordinates is mapped as it is alone, whatever the number of rows."""
    z = noise(*leading, 4)
    rows = [MAPS[name](row, radius=0.5) for row in z.reshape(-1, 4)]
    expected = np.stack(rows).reshape(z.shape)
    np.testing.assert_allclose(MAPS[name](z, radius=0.5), expected, rtol=1e-14)


def test_sphere_keeps_the_direction_of_the_noise():
    z = noise(20, 5)
    cosine = (z * sphere(z)).sum(-1) / np.linalg.norm(z, axis=-1)
    np.testing.assert_allclose(cosine, np.ones(20))


def test_uniform_is_within_its_half_width():
    delta = uniform(noise(1000, 3), radius=0.5)  # three coordinates: the half-width is 0.5 too
    assert (np.abs(delta) < 0.5).all()
    assert np.abs(delta).max() > 0.49


@pytest.mark.parametrize(
    ("name", "distribution"),
    [
        # a coordinate of a point on the 2-sphere is uniform (Archimedes)
        ("sphere", stats.uniform(-2, 4)),
        ("gaussian", stats.norm(0, 2 / 3**0.5)),
        ("uniform", stats.uniform(-2, 4)),
    ],
)
def test_coordinates_follow_their_distribution(name, distribution):
    coordinates = MAPS[name](noise(5000, 3), radius=2.0)
    for axis in range(3):
        assert stats.kstest(coordinates[:, axis], distribution.cdf).pvalue > 0.01


@every_map
@pytest.mark.parametrize("n", [1, 3, 40])
def test_the_mean_squared_length_is_the_squared_radius(name, n):
    delta = MAPS[name](noise(40_000, n), radius=3.0)
    assert np.square(delta).sum(-1).mean() == pytest.approx(9.0, rel=0.03)


@every_map
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("library", LIBRARIES)
def test_dtype_and_shape_are_kept(name, dtype, library):
    z = LIBRARIES[library](noise(2, 3, dtype=dtype))
    delta = MAPS[name](z, radius=0.1)
    assert delta.dtype == z.dtype
    assert delta.shape == z.shape


@every_map
@pytest.mark.parametrize(("dtype", "rtol"), [("float32", 1e-5), ("float64", 1e-13)])
def test_numpy_and_torch_agree(name, dtype, rtol):
    z = noise(50, 3, dtype=dtype)
    from_torch = MAPS[name](torch.from_numpy(z), radius=0.3)
    np.testing.assert_allclose(MAPS[name](z, radius=0.3), from_torch, rtol=rtol)


@pytest.mark.parametrize("name", ["sphere", "gaussian"])
def test_jax_agrees_with_numpy(name):
    z = noise(50, 3, dtype="float32")
    delta = MAPS[name](jnp.asarray(z), radius=0.3)
    np.testing.assert_allclose(delta, MAPS[name](z, radius=0.3), rtol=1e-5)


@every_map
def test_noise_is_left_as_it_was(name):
    z = noise(4, 3)
    MAPS[name](z, radius=2.0)
    np.testing.assert_array_equal(z, noise(4, 3))


@every_map
def test_names_give_the_maps(name):
    z = noise(4, 3)
    np.testing.assert_array_equal(get_perturbation(name, 0.2)(z), MAPS[name](z, 0.2))


def test_a_callable_is_returned_as_it_is():
    def own(z):
        return z

    assert get_perturbation(own, 1.0) is own


@every_map
@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan, math.inf])
def test_a_radius_must_be_finite_and_above_0(name, radius):
    message = f"radius must be finite and above 0, got {radius}"
    with pytest.raises(ValueError, match=message):
        MAPS[name](noise(4, 3), radius)
    with pytest.raises(ValueError, match=message):
        get_perturbation(name, radius)


@every_map
def test_integer_noise_is_refused(name):
    with pytest.raises(TypeError, match="noise must be floating, got int64"):
        MAPS[name](np.array([[3, 4]]))


@every_map
def test_noise_must_be_an_array(name):
    with pytest.raises(TypeError, match=r"noise must be an? .*array.*, got list"):
        MAPS[name]([0.1, 0.2])


def test_uniform_refuses_other_libraries():
    with pytest.raises(TypeError, match="a NumPy array or a PyTorch tensor, got ArrayImpl"):
        uniform(jnp.ones(3))


@pytest.mark.parametrize(
    ("perturbation", "radius", "error", "message"),
    [
        (
            "cube",
            1.0,
            ValueError,
            "perturbation must be one of ['gaussian', 'sphere', 'uniform'] or a callable "
            "noise -> delta, got 'cube'",
        ),
        (3, 1.0, TypeError, "perturbation must be a name or a callable, got int"),
        (sphere, 2.0, ValueError, "radius=2.0 goes with a named perturbation"),
    ],
)
def test_get_perturbation_refuses(perturbation, radius, error, message):
    with pytest.raises(error, match=re.escape(message)):
        get_perturbation(perturbation, radius)
