"""Tianshou with a penalty that is attached to an actor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from condwrap import ConditioningRegularizer
from tests.integrations import running

running.require("tianshou", "gymnasium", "tensorboard")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
example = running.load("tianshou_ppo")

SIZE = {"epochs": 1, "steps": 512}


@pytest.fixture
def train(tmp_path):
    """Train the example. Tianshou shuffles by NumPy's global generator."""

    def run(*args, folder=".", **size):
        np.random.seed(0)  # noqa: NPY002
        return example.train(*args, log_dir=tmp_path / folder, **(size or SIZE))

    return run


def logged(folder, name="conditioning/psi"):
    return running.tensorboard(folder, f"update/{name}")


def test_the_example_logs_psi_of_every_update(train, tmp_path):
    train()
    assert len(logged(tmp_path)) == 3  # of 4 updates, each written before the next
    assert all(0 < psi < 1 for psi in logged(tmp_path))
    assert logged(tmp_path, "attach/backwards") == [0.0, 2.0, 2.0, 2.0]  # 2 minibatches of 64


def test_coefficient_0_trains_as_without_condwrap(train, tmp_path, monkeypatch):
    measured = running.weights(train(0.0, folder="0"))
    regularized = running.weights(train(0.1, folder="1"))
    monkeypatch.setattr(example, "attach", running.Nothing)
    plain = running.weights(train(folder="2"))
    running.assert_same_bits(measured, plain)
    assert len(logged(tmp_path / "0")) == 3

    with pytest.raises(AssertionError):  # so that the comparison can fail
        running.assert_same_bits(regularized, plain)


def test_a_large_coefficient_moves_psi(train, tmp_path):
    for coefficient in (0.0, 10.0):
        train(coefficient, folder=str(coefficient), epochs=4, steps=1024)
    assert logged(tmp_path / "10.0")[-1] < logged(tmp_path / "0.0")[-1] - 0.1


def test_saving_and_loading(train, tmp_path, monkeypatch):
    trained = train(folder="1")
    torch.save(trained.state_dict(), tmp_path / "algorithm.pt")
    monkeypatch.setattr(example, "attach", running.Nothing)
    fresh = train(folder="2", epochs=1, steps=128)
    fresh.load_state_dict(torch.load(tmp_path / "algorithm.pt"))
    running.assert_same_bits(running.weights(trained), running.weights(fresh))


def test_the_gradient_is_the_explicit_penaltys():
    from tianshou.utils.net.common import Net
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic

    torch.manual_seed(0)
    net = Net(state_shape=3, hidden_sizes=[16])
    actor = ContinuousActorProbabilistic(preprocess_net=net, action_shape=2, conditioned_sigma=True)
    obs = np.random.default_rng(0).normal(size=(32, 3)).astype(np.float32)

    def loss():
        mean, std = actor(obs, state=None, info={})[0]
        return mean.square().mean() + std.log().mean()

    def penalty():
        return ConditioningRegularizer(0.3, select=lambda output: output[0][0], seed=2)

    (loss() + penalty()(actor, torch.as_tensor(obs)).penalty).backward()
    expected = running.gradients(actor)
    handle = example.attach(actor, penalty())
    loss().backward()
    running.assert_close(running.gradients(actor), expected)
    assert handle.metrics()["attach/backwards"] == 1.0
