"""skrl with a penalty that is attached to an agent."""

from __future__ import annotations

import pytest
import torch

from condwrap import ConditioningRegularizer
from tests.integrations import running

running.require("skrl", "gymnasium", "tensorboard")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
example = running.load("skrl_ppo")

SIZE = {"timesteps": 256, "rollouts": 64}


def logged(agent, tag="conditioning/psi"):
    agent.writer.flush()
    return running.tensorboard(agent.experiment_dir, tag)


def weights(agent):
    found = {"policy": agent.policy, "value": agent.value}
    return {f"{a}.{b}": x for a, m in found.items() for b, x in running.weights(m).items()}


def test_the_example_logs_psi_of_every_update(tmp_path):
    agent = example.train(log_dir=tmp_path, **SIZE)
    assert len(logged(agent)) == 4
    assert all(0 < psi < 1 for psi in logged(agent))
    assert logged(agent, "attach/backwards") == [16.0] * 4  # 4 epochs of 4 minibatches


def test_coefficient_0_trains_as_without_condwrap(tmp_path, monkeypatch):
    measured = example.train(0.0, log_dir=tmp_path / "0", **SIZE)
    regularized = example.train(0.1, log_dir=tmp_path / "1", **SIZE)
    monkeypatch.setattr(example, "attach", running.Nothing)
    plain = example.train(log_dir=tmp_path / "2", **SIZE)
    running.assert_same_bits(weights(measured), weights(plain))
    assert len(logged(measured)) == 4

    with pytest.raises(AssertionError):  # so that the comparison can fail
        running.assert_same_bits(weights(regularized), weights(plain))


def test_a_large_coefficient_moves_psi(tmp_path):
    size = {"timesteps": 1024, "rollouts": 128}
    plain = example.train(0.0, log_dir=tmp_path / "0", **size)
    regularized = example.train(10.0, log_dir=tmp_path / "1", **size)
    assert logged(regularized)[-1] < logged(plain)[-1] - 0.2


def test_saving_and_loading(tmp_path, monkeypatch):
    trained = example.train(log_dir=tmp_path / "1", **SIZE)
    trained.save(tmp_path / "agent.pt")
    monkeypatch.setattr(example, "attach", running.Nothing)
    fresh = example.train(log_dir=tmp_path / "2", timesteps=64, rollouts=64)
    fresh.load(tmp_path / "agent.pt")
    running.assert_same_bits(weights(trained), weights(fresh))


# --- the gradient --------------------------------------------------------------------------------


def stub(policy):
    """As much of an agent as `attach` needs."""
    from skrl.agents.torch.ppo import PPO_CFG

    class Stub:
        def __init__(self):
            self.policy = policy
            self.scaler = torch.amp.GradScaler("cpu", enabled=PPO_CFG().mixed_precision)
            self.tracked = []

        def track_data(self, tag, value):
            self.tracked.append(tag)

        def write_tracking_data(self, *, timestep, timesteps):
            self.tracked.append(timestep)

    return Stub()


def make_policy():
    """A policy in skrl's manner, whose log standard deviation depends on the state too."""
    from gymnasium.spaces import Box
    from skrl.models.torch import GaussianMixin, Model
    from torch import nn

    class Policy(GaussianMixin, Model):
        def __init__(self):
            spaces = {"observation_space": Box(-1, 1, (3,)), "action_space": Box(-1, 1, (2,))}
            Model.__init__(self, **spaces, device="cpu")
            GaussianMixin.__init__(self)
            self.body = nn.Linear(3, 8)
            self.mean = nn.Linear(8, 2)
            self.log_std = nn.Linear(8, 2)

        def compute(self, inputs, role):
            features = torch.tanh(self.body(inputs["observations"]))
            return self.mean(features), {"log_std": self.log_std(features)}

    torch.manual_seed(0)
    return Policy()


OBS = torch.randn(32, 3, generator=torch.Generator().manual_seed(1))


def penalty():
    return ConditioningRegularizer(0.3, seed=2)


def loss_of(policy):
    _, outputs = policy.act({"observations": OBS, "taken_actions": OBS[:, :2]}, role="policy")
    return -outputs["log_prob"].mean() - policy.get_entropy(role="policy").mean()


def test_the_gradient_is_the_explicit_penaltys():
    policy = make_policy()
    mean = penalty()(lambda obs: policy.compute({"observations": obs}, "policy")[0], OBS)
    (loss_of(policy) + mean.penalty).backward()
    expected = running.gradients(policy)

    agent = stub(policy)
    names = policy.state_dict().keys()
    handle = example.attach(agent, penalty())
    assert policy.state_dict().keys() == names
    loss_of(policy).backward()
    running.assert_close(running.gradients(policy), expected)

    agent.write_tracking_data(timestep=7, timesteps=9)
    assert "conditioning/psi" in agent.tracked
    assert agent.tracked[-1] == 7
    assert handle.metrics()["attach/backwards"] == 0.0  # that was written


def test_acting_and_the_value_of_a_shared_model_are_left_alone():
    policy = make_policy()
    handle = example.attach(stub(policy), penalty())
    policy.act({"observations": OBS}, role="value")[0].sum().backward()
    policy.eval()
    loss_of(policy).backward()
    assert handle.metrics()["attach/forwards"] == 0.0


def test_mixed_precision_scales_the_penalty():
    policy = make_policy()
    agent = stub(policy)
    agent.scaler = torch.amp.GradScaler("cpu", init_scale=8.0)
    example.attach(agent, penalty())
    agent.scaler.scale(loss_of(policy)).backward()
    scaled = running.gradients(policy)

    policy = make_policy()
    example.attach(stub(policy), penalty())
    loss_of(policy).backward()
    running.assert_close([x / 8 for x in scaled], running.gradients(policy))


def test_what_has_no_policy_is_refused():
    with pytest.raises(TypeError, match="skrl agent with a policy, got Linear"):
        example.attach(torch.nn.Linear(2, 2), penalty())
