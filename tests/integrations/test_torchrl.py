"""TorchRL with an attached penalty."""

from __future__ import annotations

import csv

import pytest
import torch

from condwrap import ConditioningRegularizer, attach
from tests.integrations import running

running.require("torchrl", "gymnasium")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
example = running.load("torchrl_ppo")

SIZE = {"total": 1024, "frames": 256}


def logged(folder, name="conditioning/psi"):
    path = folder / "torchrl_ppo" / "scalars" / f"{name}.csv"
    return [float(row[1]) for row in csv.reader(path.open())]


def test_the_example_logs_psi_of_every_update(tmp_path):
    example.train(log_dir=tmp_path, **SIZE)
    assert len(logged(tmp_path)) == 4
    assert all(0 < psi < 1 for psi in logged(tmp_path))
    assert logged(tmp_path, "attach/backwards") == [16.0] * 4  # 4 epochs of 4 minibatches


def test_coefficient_0_trains_as_without_condwrap(tmp_path, monkeypatch):
    measured = running.weights(example.train(0.0, log_dir=tmp_path / "0", **SIZE))
    regularized = running.weights(example.train(0.1, log_dir=tmp_path / "1", **SIZE))
    monkeypatch.setattr(example, "attach", running.Nothing)
    plain = running.weights(example.train(log_dir=tmp_path / "2", **SIZE))
    running.assert_same_bits(measured, plain)
    assert len(logged(tmp_path / "0")) == 4

    with pytest.raises(AssertionError):  # so that the comparison can fail
        running.assert_same_bits(regularized, plain)


def test_a_large_coefficient_moves_psi(tmp_path):
    for coefficient in (0.0, 10.0):
        example.train(coefficient, log_dir=tmp_path / str(coefficient), total=4096, frames=512)
    assert logged(tmp_path / "10.0")[-1] < logged(tmp_path / "0.0")[-1] - 0.2


def test_saving_and_loading(tmp_path, monkeypatch):
    trained = example.train(log_dir=tmp_path / "1", **SIZE)
    torch.save(trained.state_dict(), tmp_path / "loss.pt")
    monkeypatch.setattr(example, "attach", running.Nothing)
    fresh = example.train(log_dir=tmp_path / "2", total=64, frames=64)
    fresh.load_state_dict(torch.load(tmp_path / "loss.pt"))
    running.assert_same_bits(running.weights(trained), running.weights(fresh))


# --- the gradient --------------------------------------------------------------------------------


def networks():
    """An actor and its inner network, for two actions."""
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torch import nn
    from torchrl.modules import ProbabilisticActor, TanhNormal

    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 4), NormalParamExtractor())
    actor = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        actor, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )


def batch():
    from tensordict import TensorDict

    noise = torch.Generator().manual_seed(1)
    data = {
        "observation": torch.randn(32, 3, generator=noise),
        "action": torch.rand(32, 2, generator=noise) - 0.5,
        "action_log_prob": torch.randn(32, generator=noise),
        "advantage": torch.randn(32, 1, generator=noise),
        "value_target": torch.randn(32, 1, generator=noise),
        "next": {
            "observation": torch.randn(32, 3, generator=noise),
            "reward": torch.randn(32, 1, generator=noise),
            "done": torch.zeros(32, 1, dtype=torch.bool),
            "terminated": torch.zeros(32, 1, dtype=torch.bool),
        },
    }
    return TensorDict(data, batch_size=[32])


def ppo():
    from torch import nn
    from torchrl.modules import ValueOperator
    from torchrl.objectives import ClipPPOLoss

    actor = networks()
    return ClipPPOLoss(actor, ValueOperator(nn.Linear(3, 1)))


def sac():
    from torch import nn
    from torchrl.modules import ValueOperator
    from torchrl.objectives import SACLoss

    class Critic(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = nn.Linear(5, 1)

        def forward(self, obs, action):
            return self.net(torch.cat([obs, action], -1))

    actor = networks()
    critic = ValueOperator(Critic(), in_keys=["observation", "action"])
    loss = SACLoss(actor, critic, target_entropy=-2.0)
    loss.make_value_estimator(gamma=0.99)
    return loss


def penalty():
    return ConditioningRegularizer(0.3, select=lambda output: output[0], seed=2)


@pytest.mark.parametrize("make", [ppo, sac])
def test_the_gradient_is_the_explicit_penaltys(make):
    loss = make()
    torch.manual_seed(3)
    total = sum(x for name, x in loss(batch()).items() if name.startswith("loss_"))
    with loss.actor_network_params.to_module(loss.actor_network):
        total = total + penalty()(loss.actor_network[0].module, batch()["observation"]).penalty
    total.backward()
    expected = running.gradients(loss)

    handle = attach(loss.actor_network[0].module, penalty())
    torch.manual_seed(3)
    sum(x for name, x in loss(batch()).items() if name.startswith("loss_")).backward()
    running.assert_close(running.gradients(loss), expected)
    assert handle.metrics()["attach/backwards"] == 1.0
