"""`output`: what the loss computed anyway, in place of one of the regularizer's two forwards."""

import pytest
import torch
from torch import nn
from torch.distributions import Categorical, Independent, Normal

from condwrap import ConditioningRegularizer


def mlp():
    return nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 3))


def gaussian(net):
    return lambda obs: Independent(Normal(net(obs), 1.0), 1)


def measure(policy, obs, net, output, **settings):
    regularizer = ConditioningRegularizer(1.0, seed=1, **settings)
    measured = regularizer(policy, obs, output=output)
    gradients = torch.autograd.grad(measured.penalty, list(net.parameters()))
    return [measured.penalty, measured.quotient, *gradients]


@pytest.mark.parametrize("fraction", [1.0, 0.3])
@pytest.mark.parametrize("reduction", ["sample", "batch"])
@pytest.mark.parametrize(
    "wrap", [lambda net: net, gaussian, lambda net: lambda obs: Categorical(logits=net(obs))]
)
def test_the_result_and_its_gradients_are_those_without_it(wrap, reduction, fraction):
    net, obs = mlp(), torch.randn(10, 4)
    policy, settings = wrap(net), {"reduction": reduction, "fraction": fraction}
    expected = measure(policy, obs, net, None, **settings)
    torch.testing.assert_close(measure(policy, obs, net, policy(obs), **settings), expected)


def test_it_saves_one_evaluation():
    net, seen = mlp(), []

    def policy(obs):
        seen.append(obs)
        return net(obs)

    obs = torch.randn(5, 4)
    ConditioningRegularizer()(policy, obs, output=net(obs))
    assert len(seen) == 1
    assert not torch.equal(seen[0], obs)


def test_an_output_without_a_gradient_is_refused_where_the_penalty_needs_one():
    net, obs = mlp(), torch.randn(5, 4)
    with torch.no_grad():
        output = net(obs)
    with pytest.raises(ValueError, match="no gradient"):
        ConditioningRegularizer()(net, obs, output=output)
    assert ConditioningRegularizer(0.0)(net, obs, output=output).psi.shape == (5,)


def test_half_precision_is_refused():
    net, obs = mlp(), torch.randn(5, 4)
    with torch.autocast("cpu", torch.bfloat16):
        output = net(obs)
    with pytest.raises(ValueError, match=r"float32 at least, got torch.bfloat16"):
        ConditioningRegularizer()(net, obs, output=output)


@pytest.mark.parametrize("layer", [nn.Dropout(0.5), nn.BatchNorm1d(4)])
def test_a_policy_that_changes_in_training_is_refused(layer):
    policy, obs = nn.Sequential(layer, nn.Linear(4, 2)), torch.randn(5, 4)
    with pytest.raises(ValueError, match=type(layer).__name__):
        ConditioningRegularizer()(policy, obs, output=policy(obs))
    policy.eval()
    assert ConditioningRegularizer()(policy, obs, output=policy(obs)).psi.shape == (5,)


def test_an_output_to_other_observations_is_refused():
    net, obs = mlp(), torch.randn(5, 4)
    with pytest.raises(ValueError, match="batch axes"):
        ConditioningRegularizer()(net, obs, output=net(torch.randn(6, 4)))


def test_jvp_refuses_it():
    net, obs = mlp(), torch.randn(5, 4)
    with pytest.raises(ValueError, match="difference"):
        ConditioningRegularizer(estimator="jvp")(net, obs, output=net(obs))


def test_dropout_inside_a_recurrent_layer_is_refused():
    gru, obs = nn.GRU(4, 4, num_layers=2, dropout=0.5), torch.randn(5, 4)

    def policy(obs):
        return gru(obs[:, None])[0][:, 0]

    with pytest.raises(ValueError, match="GRU"):
        ConditioningRegularizer()(policy, obs, output=policy(obs))


class Counting(nn.Module):
    """Counts its evaluations in a buffer, in training mode and out of it."""

    def __init__(self):
        super().__init__()
        self.net = mlp()
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, obs):
        self.calls += 1
        return self.net(obs)


def test_buffers_are_left_as_they_were():
    policy, obs = Counting(), torch.randn(5, 4)
    output = policy(obs)
    calls = policy.calls
    ConditioningRegularizer()(policy, obs, output=output)
    assert policy.calls is calls
    assert calls == 1


def test_the_global_random_state_is_left_as_it_was():
    net, obs = mlp(), torch.randn(5, 4)

    def noisy(obs):
        return net(obs) + torch.rand(())

    output = noisy(obs)
    state = torch.get_rng_state()
    ConditioningRegularizer()(noisy, obs, output=output)
    assert torch.equal(torch.get_rng_state(), state)
