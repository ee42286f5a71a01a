"""JAX and Flax: the pure functions in a compiled loss."""

from __future__ import annotations

import pytest
import torch

from condwrap import ConditioningRegularizer
from tests.integrations import running

running.require("jax", "flax", "optax")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
example = running.load("jax_ppo")

import flax  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402


def test_the_example_learns_and_returns_psi_of_every_update():
    _, rows = example.train(updates=100)
    assert rows["conditioning/psi"].shape == (100,)
    assert rows["reward"][-10:].mean() > rows["reward"][:10].mean() + 0.1


def plain(params, obs, action, logprob, advantage, *_):
    """The loss without the penalty."""
    mean = example.actor.apply(params, obs)
    ratio = jnp.exp(-0.5 * jnp.square(action - mean).sum(-1) - logprob)
    loss = -jnp.minimum(ratio * advantage, ratio.clip(0.8, 1.2) * advantage).mean()
    return loss, 0.0


@pytest.mark.parametrize("jit", [True, False])
def test_coefficient_0_trains_as_without_condwrap(jit, monkeypatch):
    with jax.disable_jit(not jit):
        measured, _ = example.train(0.0, updates=5)
        regularized, _ = example.train(0.1, updates=5)
        monkeypatch.setattr(example, "loss_of", plain)
        expected, _ = example.train(updates=5)
    both = [jax.tree.leaves(state.params) for state in (measured, expected, regularized)]
    for one, other, penalized in zip(*both, strict=True):
        if jit:  # XLA sums the longer program in another order
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-7)
        else:
            np.testing.assert_array_equal(one, other)
        assert np.abs(penalized - other).max() > 1e-6


def test_a_large_coefficient_moves_psi():
    psi = [example.train(x, updates=50)[1]["conditioning/psi"][-1] for x in (0.0, 10.0)]
    assert psi[1] < psi[0] - 0.02


def test_saving_and_loading():
    trained, _ = example.train(updates=3)
    fresh, _ = example.train(updates=1)
    loaded = flax.serialization.from_bytes(fresh, flax.serialization.to_bytes(trained))
    jax.tree.map(np.testing.assert_array_equal, loaded.params, trained.params)


def test_the_gradient_is_pytorchs():
    rng = np.random.default_rng(0)
    obs, delta, action = rng.normal(size=(3, 32, 2)).astype(np.float32)
    logprob, advantage = rng.normal(size=(2, 32)).astype(np.float32)
    params = example.actor.init(jax.random.key(2), jnp.ones(2))
    compiled = jax.jit(jax.grad(example.loss_of, has_aux=True))
    found, psi = compiled(params, obs, action, logprob, advantage, delta, 0.3)

    net = torch.nn.Sequential(torch.nn.Linear(2, 64), torch.nn.Tanh(), torch.nn.Linear(64, 2))
    for i, layer in enumerate(("layers_0", "layers_2")):
        values = params["params"][layer]
        net[2 * i].weight.data = torch.tensor(np.asarray(values["kernel"])).T
        net[2 * i].bias.data = torch.tensor(np.asarray(values["bias"]))
    obs, action, logprob, advantage, delta = map(
        torch.tensor, (obs, action, logprob, advantage, delta)
    )
    ratio = (-0.5 * (action - net(obs)).square().sum(-1) - logprob).exp()
    loss = -torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    conditioning = ConditioningRegularizer(0.3)(net, obs, delta=delta)
    (loss + conditioning.penalty).backward()

    assert float(psi) == pytest.approx(conditioning.psi.mean().item(), rel=1e-5)
    for i, layer in enumerate(("layers_0", "layers_2")):
        kernel = np.asarray(found["params"][layer]["kernel"]).T
        np.testing.assert_allclose(kernel, net[2 * i].weight.grad, rtol=1e-4, atol=1e-6)
        bias = np.asarray(found["params"][layer]["bias"])
        np.testing.assert_allclose(bias, net[2 * i].bias.grad, rtol=1e-4, atol=1e-6)
