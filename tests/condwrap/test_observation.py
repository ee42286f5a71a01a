"""Observations taken apart and put together: scales, structure, subsets, bad input."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from torch import Tensor

from condwrap.observation import States


def mixed_obs(batch=4):
    return {
        "vector": torch.randn(batch, 3),
        "image": torch.randint(0, 256, (batch, 2, 2), dtype=torch.uint8),
        "mode": torch.arange(batch),
        "mask": torch.ones(batch, 2, dtype=torch.bool),
    }


def read(obs, obs_scale=None, batch_ndim=1):
    return States.read(obs, obs_scale, batch_ndim)


def test_floating_and_uint8_leaves_are_perturbed_in_their_own_units():
    obs = mixed_obs()
    states = read(obs)
    delta = torch.randn(4, 7)
    vector, image = states.displacement(delta)
    torch.testing.assert_close(vector, delta[:, :3])
    torch.testing.assert_close(image, 255 * delta[:, 3:].reshape(4, 2, 2))
    assert image.dtype == torch.float32


def test_two_batch_axes_are_displaced_in_their_own_units():
    obs = {
        "vector": torch.zeros(2, 3, 1),
        "image": torch.zeros(2, 3, 2, dtype=torch.uint8),
    }
    delta = torch.arange(18.0).reshape(2, 3, 3)
    vector, image = read(obs, batch_ndim=2).displacement(delta)
    assert vector.tolist() == delta[..., :1].tolist()
    assert image.tolist() == (255 * delta[..., 1:]).tolist()


def test_autocast_widens_half_precision_alone():
    dtypes = (torch.bfloat16, torch.float16, torch.float32, torch.float64, torch.uint8)
    obs = [torch.ones(4, 2, dtype=dtype) for dtype in dtypes]
    assert [x.dtype for x in read(obs).tensors] == list(dtypes)
    with torch.autocast("cpu", torch.bfloat16):
        widened = [x.dtype for x in read(obs).tensors]
    assert widened == [torch.float32, torch.float32, *dtypes[2:]]


def test_floating_leaves_are_perturbed_as_they_are():
    x = torch.ones(4, 2, dtype=torch.float64)
    states = read(x)
    assert states.perturbed[0] is x
    assert states.device == x.device


def test_the_default_device_plays_no_part():
    x = torch.arange(6.0)[:, None]
    with torch.device("meta"):
        assert read(x).subset(0.5).tensors[0].flatten().tolist() == [0.0, 2.0, 4.0]


def test_chunks_hold_all_states_in_order():
    obs = {"x": torch.arange(5.0)[:, None], "mode": torch.arange(5)}
    chunks = read(obs).chunks(2)
    assert [chunk.tensors[0].flatten().tolist() for chunk in chunks] == [[0, 1], [2, 3], [4]]
    assert [chunk.tensors[1].tolist() for chunk in chunks] == [[0, 1], [2, 3], [4]]
    assert chunks[2].sizes == [1]


def test_states_cannot_be_changed():
    states = read(torch.ones(4, 2))
    with pytest.raises(dataclasses.FrozenInstanceError):
        states.batch_ndim = 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        states.leaves[0].scale = 2.0


def test_leaves_that_are_not_perturbed_pass_as_they_are():
    obs = mixed_obs()
    states = read(obs)
    perturbed = states.obs([x + 1 for x in states.perturbed])
    assert list(perturbed) == list(obs)
    assert perturbed["mode"] is obs["mode"]
    assert perturbed["mask"] is obs["mask"]
    torch.testing.assert_close(perturbed["vector"], obs["vector"] + 1)
    torch.testing.assert_close(perturbed["image"], obs["image"] + 1.0)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int64])
def test_obs_scale_is_the_unit_of_integer_observations(dtype):
    states = read(torch.ones(4, 2, dtype=dtype), obs_scale=10.0)
    torch.testing.assert_close(states.displacement(torch.ones(4, 2))[0], torch.full((4, 2), 10.0))


def test_obs_scale_leaves_floating_leaves_as_they_are():
    states = read({"image": torch.ones(4, 2, dtype=torch.int16), "x": torch.ones(4, 1)}, 10.0)
    image, vector = states.displacement(torch.ones(4, 3))
    torch.testing.assert_close(image, torch.full((4, 2), 10.0))
    torch.testing.assert_close(vector, torch.ones(4, 1))


def test_boolean_leaves_pass_with_an_obs_scale_too():
    obs = {"x": torch.ones(4, 3), "mask": torch.ones(4, 2, dtype=torch.bool)}
    assert read(obs, obs_scale=10.0).sizes == [3]


@pytest.mark.parametrize("batch_ndim", [1, 2])
def test_flatten_reverses_unflatten(batch_ndim):
    obs = {"b": torch.randn(4, 3, 2), "a": (torch.randn(4, 3), torch.arange(12).reshape(4, 3))}
    states = read(obs, batch_ndim=batch_ndim)
    delta = torch.randn(*states.batch, sum(states.sizes))
    tree = states.unflatten(delta)
    assert tree["b"].shape == obs["b"].shape
    assert tree["a"][0].shape == obs["a"][0].shape
    assert tree["a"][1] is None
    torch.testing.assert_close(states.flatten(tree), delta)


def test_a_delta_is_matched_by_key_not_by_position():
    states = read({"a": torch.ones(4, 3), "b": torch.ones(4, 3)})
    delta = torch.randn(4, 6)
    tree = states.unflatten(delta)
    reordered = {"b": tree["b"], "a": tree["a"]}
    torch.testing.assert_close(states.flatten(reordered), delta)


@pytest.mark.parametrize(
    ("obs_dtype", "dtype"),
    [
        (torch.float64, torch.float64),
        (torch.float32, torch.float32),
        (torch.bfloat16, torch.float32),
        (torch.uint8, torch.float32),
    ],
)
def test_delta_is_float64_for_float64_and_float32_otherwise(obs_dtype, dtype):
    assert read({"x": torch.ones(4, 2, dtype=obs_dtype)}).dtype == dtype


def test_float64_beside_float32_is_perturbed_in_float64():
    """A delta of 1 + 1e-9 survives in the float64 leaf; each leaf keeps its own dtype."""
    states = read({"a": torch.ones(4, 2), "b": torch.ones(4, 1, dtype=torch.float64)})
    assert states.dtype == torch.float64
    delta = torch.full((4, 3), 1 + 1e-9, dtype=torch.float64)
    narrow, wide = states.displacement(delta)
    assert (narrow.dtype, wide.dtype) == (torch.float32, torch.float64)
    assert (wide > 1).all()
    assert (narrow == 1).all()


@pytest.mark.parametrize(
    ("size", "fraction", "chosen"),
    [
        (10, 1.0, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]),
        (10, 0.5, [0, 2, 4, 6, 8]),
        (10, 0.3, [0, 3, 6]),
        (10, 0.01, [0]),
        (7, 0.5, [0, 1, 3, 5]),
        (1, 0.5, [0]),
    ],
)
def test_a_fraction_is_evenly_spaced(size, fraction, chosen):
    obs = {"x": torch.arange(size)[:, None].float(), "i": torch.arange(size)}
    subset = read(obs).subset(fraction)
    assert subset.tensors[0].flatten().tolist() == chosen
    assert subset.tensors[1].tolist() == chosen


@pytest.mark.parametrize("percent", [7, 14, 28, 55, 56, 57])
def test_a_percentage_of_100_states_is_that_many_states(percent):
    assert read(torch.ones(100, 1)).subset(percent / 100).batch == (percent,)


@pytest.mark.parametrize(
    ("obs", "error", "message"),
    [
        (np.ones((4, 2)), TypeError, "a Tensor or a dict of Tensors, got ndarray"),
        ({"x": None}, TypeError, "a Tensor or a dict of Tensors, got NoneType"),
        ({}, TypeError, "obs must be floating or uint8, got no tensor"),
        (torch.ones(4, 2, dtype=torch.int64), TypeError, "pass obs_scale=<the divisor>"),
        (torch.ones(4, dtype=torch.bool), TypeError, "got torch.bool"),
        (
            {"a": torch.ones(4).long(), "b": torch.ones(4).bool()},
            TypeError,
            "got torch.int64, torch.bool:",
        ),
        (torch.ones(()), ValueError, "batch_ndim=1 leading axes that its leaves share"),
        (
            {"a": torch.ones(4, 2), "b": torch.ones(3, 2)},
            ValueError,
            "got shapes [(4, 2), (3, 2)]",
        ),
        (torch.ones(0, 2), ValueError, "obs must not be empty, got shapes [(0, 2)]"),
        (torch.tensor([[1.0], [torch.nan]]), ValueError, "obs must be finite"),
        ({"x": torch.tensor([[1.0], [torch.inf]])}, ValueError, "obs must be finite"),
    ],
)
def test_reading_refuses(obs, error, message):
    with pytest.raises(error, match=re.escape(message)):
        read(obs)


def test_two_batch_axes_are_checked():
    with pytest.raises(ValueError, match="obs needs batch_ndim=2"):
        read({"a": torch.ones(4, 3, 2), "b": torch.ones(4, 2, 2)}, batch_ndim=2)
    with pytest.raises(ValueError, match="must not be empty"):
        read(torch.ones(4, 0, 2), batch_ndim=2)


@pytest.mark.parametrize(
    ("delta", "error", "message"),
    [
        (torch.ones(4, 2), ValueError, "leaves of shape [(4, 3)], got [(4, 2)]"),
        (torch.ones(3, 3), ValueError, "sample_delta(obs) draws one that does"),
        ({"x": torch.ones(4, 3), "y": torch.ones(4, 3)}, ValueError, "delta must match"),
        (np.ones((4, 3)), ValueError, "leaves of shape [(4, 3)], got ['ndarray']"),
        (torch.ones(4, 3, dtype=torch.int64), TypeError, "delta must be floating"),
    ],
)
def test_flatten_refuses(delta, error, message):
    with pytest.raises(error, match=re.escape(message)):
        read(torch.ones(4, 3)).flatten(delta)


def test_flatten_refuses_an_integer_part_beside_a_floating_one():
    states = read({"a": torch.ones(4, 3), "b": torch.ones(4, 3)})
    message = re.escape("delta must be floating, got ['torch.float32', 'torch.int64']")
    with pytest.raises(TypeError, match=message):
        states.flatten({"a": torch.ones(4, 3), "b": torch.ones(4, 3).long()})


@pytest.mark.parametrize("delta", [{"a": torch.ones(4, 3)}, torch.ones(4, 3)])
def test_flatten_refuses_another_structure(delta):
    states = read({"a": torch.ones(4, 3), "b": torch.ones(4, 3)})
    with pytest.raises(ValueError, match="delta must match"):
        states.flatten(delta)


def test_flatten_refuses_a_delta_on_a_leaf_that_passes():
    obs = mixed_obs()
    delta = {name: x.float() for name, x in obs.items() if isinstance(x, Tensor)}
    with pytest.raises(ValueError, match="delta must match"):
        read(obs).flatten(delta)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_single_value_that_is_not_finite_is_refused(bad):
    obs = {"a": torch.ones(4, 3), "b": torch.ones(4, 2)}
    obs["b"][2, 1] = bad
    with pytest.raises(ValueError, match="obs must be finite"):
        read(obs)


def test_finite_observations_whose_sum_overflows_are_taken():
    huge = torch.full((4, 3), torch.finfo(torch.float32).max, requires_grad=True)
    assert read(huge).tensors[0] is huge
