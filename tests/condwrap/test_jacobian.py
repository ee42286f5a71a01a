"""Jacobians against finite differences, and what they ask of the policy."""

import copy
import math
import re

import numpy as np
import pytest
import torch
from torch import distributions as td
from torch import nn

from condwrap.jacobian import jacobians, read_states, response, zero_delta
from tests.condwrap.helpers import central_differences

# PyTorch itself scripts what forward mode imports
pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit.script.* is deprecated:DeprecationWarning"
)


def jacobian(policy, obs, select="default", chunk_size=100):
    states = read_states(obs, select)
    return torch.cat(list(jacobians(policy, states, select, chunk_size)))


class Recurrent(nn.Module):
    """A vector for each step of a sequence."""

    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(4, 6, batch_first=True)

    def forward(self, obs):
        return self.gru(obs)[0]


def mlp(n=4, m=3):
    return nn.Sequential(nn.Linear(n, 16), nn.Tanh(), nn.Linear(16, m))


def conv():
    return nn.Sequential(
        nn.Conv2d(2, 4, 3), nn.Tanh(), nn.AvgPool2d(2), nn.Flatten(), nn.Linear(16, 3)
    )


POLICIES = {
    "tall": (lambda: mlp(3, 7), (3,)),
    "wide": (lambda: mlp(7, 3), (7,)),
    "square": (lambda: mlp(4, 4), (4,)),
    "matrix observations": (lambda: nn.Sequential(nn.Flatten(), mlp(6)), (2, 3)),
    "scalar observations": (lambda: torch.sin, ()),
    "conv": (conv, (2, 6, 6)),
    "gru": (Recurrent, (5, 4)),
}


# --- values -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", POLICIES)
def test_a_jacobian_is_that_of_central_differences(name):
    make, shape = POLICIES[name]
    policy, obs = make(), torch.randn(5, *shape, dtype=torch.float64)
    policy = policy.double() if isinstance(policy, nn.Module) else policy
    got = jacobian(policy, obs).detach().numpy()
    np.testing.assert_allclose(got, central_differences(policy, obs), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_jacobian_worked_out_by_hand(dtype):
    obs = torch.tensor([[2.0, 3.0], [-1.0, 5.0]], dtype=dtype)
    got = jacobian(lambda x: torch.stack([x[:, 0] * x[:, 1], 4 * x[:, 0], x[:, 1] ** 2], 1), obs)
    expected = [[[3, 2], [4, 0], [0, 6]], [[5, -1], [4, 0], [0, 10]]]
    assert got.dtype == dtype
    assert got.tolist() == expected


@pytest.mark.parametrize("output", [lambda x: torch.ones(len(x), 2), lambda x: 0 * x[:, :2]])
def test_a_constant_has_a_jacobian_of_0(output):
    got = jacobian(output, torch.randn(3, 4))
    assert got.shape == (3, 2, 4)
    assert got.eq(0).all()


def test_the_default_device_plays_no_part():
    """All is made where the states are, so that a policy on a GPU needs no default device."""
    policy, obs = mlp(), torch.randn(5, 4)
    expected = jacobian(policy, obs)
    with torch.device("meta"):
        got = jacobian(policy, obs)
    assert got.device.type == "cpu"
    assert torch.equal(got, expected)


def test_a_jacobian_can_be_differentiated():
    obs = torch.randn(3, 2, dtype=torch.float64)
    weight = torch.randn(4, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: jacobian(lambda x: torch.tanh(x @ w.T), obs), weight)


@pytest.mark.parametrize("enabled", [True, False])
def test_a_jacobian_carries_a_gradient_where_gradients_are_enabled(enabled):
    with torch.set_grad_enabled(enabled):
        got = jacobian(mlp(), torch.randn(3, 4))
    assert got.requires_grad == enabled
    assert got.abs().sum() > 0


def test_under_bf16_autocast_a_jacobian_is_that_of_float32():
    policy, obs = mlp(), torch.randn(8, 4)
    expected = jacobian(policy, obs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = jacobian(policy, obs)
        assert torch.is_autocast_enabled("cpu")
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-7)


# --- observations and answers -----------------------------------------------------------------


class Mixed(nn.Module):
    """Linear in an image and a vector; the mode chooses the weight of the vector."""

    def __init__(self):
        super().__init__()
        self.image = nn.Linear(4, 5)
        self.vector = nn.Parameter(torch.randn(2, 5, 3))

    def forward(self, obs):
        moved = torch.einsum("bmn,bn->bm", self.vector[obs["mode"]], obs["vector"])
        return self.image(obs["image"].flatten(1) / 255) + moved


def test_columns_are_the_perturbed_leaves_in_the_order_of_the_dict():
    policy = Mixed()
    obs = {
        "image": torch.randint(0, 256, (3, 2, 2), dtype=torch.uint8),
        "mode": torch.tensor([0, 1, 0]),
        "vector": torch.randn(3, 3),
    }
    expected = torch.cat(
        [policy.image.weight.expand(3, 5, 4), policy.vector[obs["mode"]]], -1
    ).detach()
    torch.testing.assert_close(jacobian(policy, obs).detach(), expected, rtol=1e-4, atol=1e-6)
    swapped = {key: obs[key] for key in ("vector", "mode", "image")}
    torch.testing.assert_close(
        jacobian(policy, swapped).detach(), expected.roll(3, -1), rtol=1e-4, atol=1e-6
    )


def test_uint8_images_are_measured_in_the_units_after_division():
    net, image = conv(), torch.randint(0, 256, (4, 2, 6, 6), dtype=torch.uint8)
    got = jacobian(lambda obs: net(obs / 255), image)
    torch.testing.assert_close(got, jacobian(net, image / 255), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("output", "tensor", "select"),
    [
        (lambda x: td.Normal(x, 1.0), lambda x: x, "default"),
        (lambda x: td.Independent(td.Normal(x, 1.0), 1), lambda x: x, "mean"),
        (lambda x: td.Categorical(logits=x), lambda x: x.log_softmax(-1), "default"),
        (lambda x: td.Categorical(logits=x), lambda x: x.softmax(-1), "probs"),
        (lambda x: (td.Normal(x, 1.0), 2 * x), lambda x: torch.cat([x, 2 * x], -1), "default"),
        (lambda x: {"pi": x, "v": x[:, 0]}, lambda x: x[:, :1], lambda output: output["v"]),
    ],
)
def test_rows_are_the_outputs_that_count(output, tensor, select):
    net, obs = mlp(), torch.randn(4, 4)
    got = jacobian(lambda x: output(net(x)), obs, select)
    torch.testing.assert_close(got, jacobian(lambda x: tensor(net(x)), obs))


@pytest.mark.parametrize(
    ("obs", "n", "dtype"),
    [
        (torch.ones(3, 2, 5), 10, torch.float32),
        (torch.ones(3, 4, dtype=torch.float64), 4, torch.float64),
        (torch.ones(3, 4, dtype=torch.uint8), 4, torch.float32),
        ({"a": torch.ones(3, 2), "b": torch.ones(3), "c": torch.ones(3).long()}, 3, torch.float32),
    ],
)
def test_delta_has_a_number_for_each_that_moves(obs, n, dtype):
    delta = zero_delta(read_states(obs, "default"))
    assert delta.shape == (3, n)
    assert delta.dtype == dtype
    assert delta.eq(0).all()


def test_the_response_is_the_output_at_the_moved_observations():
    net, obs, delta = mlp(), torch.randn(4, 4), torch.randn(4, 4)
    respond = response(lambda x: td.Normal(net(x), 1.0), read_states(obs, "default"), "mean")
    assert torch.equal(respond(torch.zeros(4, 4)), net(obs))
    assert torch.equal(respond(delta), net(obs + delta))


# --- chunks -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chunk_size", "sizes"), [(1, [1] * 7), (3, [3, 3, 1]), (7, [7]), (100, [7])]
)
def test_chunks_bound_the_batch_and_change_no_number(chunk_size, sizes):
    net, seen, obs = mlp(), [], {"x": torch.randn(7, 4), "mode": torch.arange(7)}

    def policy(obs):
        seen.append(len(obs["x"]))
        return net(obs["x"]) * obs["mode"][:, None]

    expected = jacobian(policy, obs)
    seen.clear()
    parts = jacobians(policy, read_states(obs, "default"), "default", chunk_size)
    assert seen == []  # computed one at a time, when asked for
    parts = list(parts)
    assert seen == sizes == [len(part) for part in parts]
    torch.testing.assert_close(torch.cat(parts), expected)


# --- no trace ---------------------------------------------------------------------------------


def test_a_jacobian_sees_one_dropout_mask():
    net = nn.Sequential(nn.Linear(4, 32), nn.Dropout(), nn.Linear(32, 3)).double()
    obs = torch.randn(5, 4, dtype=torch.float64)

    def seeded(obs):
        torch.manual_seed(7)
        return net(obs)

    expected = central_differences(seeded, obs)
    torch.manual_seed(7)
    state = torch.get_rng_state()
    got = jacobian(net, obs).detach().numpy()
    np.testing.assert_allclose(got, expected, atol=1e-9)
    assert torch.equal(torch.get_rng_state(), state)
    without = jacobian(copy.deepcopy(net).eval(), obs).detach().numpy()
    assert np.abs(got - without).max() > 0.01


def test_batch_norm_in_training_runs_on_its_statistics_and_keeps_them():
    net = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Tanh(), nn.Linear(8, 3))
    for _ in range(5):
        net(torch.randn(32, 4))
    obs, before = torch.randn(6, 4), copy.deepcopy(net.state_dict())
    got = jacobian(net, obs)
    assert net[1].training
    assert all(torch.equal(net.state_dict()[k], v) for k, v in before.items())
    assert all(p.grad is None for p in net.parameters())
    torch.testing.assert_close(got, jacobian(copy.deepcopy(net).eval(), obs))
    torch.testing.assert_close(jacobian(net, obs[2:4]), got[2:4])


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("obs", "select", "error", "message"),
    [
        (torch.ones(3, 4).long(), "default", TypeError, "obs must be floating or uint8"),
        (torch.ones(0, 4), "default", ValueError, "obs must not be empty, got shapes [(0, 4)]"),
        (torch.ones(3, 4) * math.nan, "default", ValueError, "obs must be finite, got NaN"),
        (torch.ones(()), "default", ValueError, "obs needs batch_ndim=1 leading axes"),
        (np.ones((3, 4)), "default", TypeError, "must be a Tensor or a dict of Tensors"),
        (torch.ones(3, 4), "variance", ValueError, "select must be one of"),
        (torch.ones(3, 4), None, TypeError, "select must be a name or a callable, got NoneType"),
    ],
)
def test_what_cannot_be_read_is_refused(obs, select, error, message):
    with pytest.raises(error, match=re.escape(message)):
        read_states(obs, select)


@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (lambda x: x.mean(0), ValueError, "begin with the batch axes (3,) of the observations"),
        (lambda x: x.argmax(-1), TypeError, "output must be floating, got torch.int64"),
        (lambda x: td.Gamma(x.exp(), 1.0), TypeError, "no default output for Gamma"),
    ],
)
def test_an_output_is_refused(policy, error, message):
    with pytest.raises(error, match=re.escape(message)):
        jacobian(policy, torch.ones(3, 4))
