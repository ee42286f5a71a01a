"""The finite difference and its limit, against a Jacobian by float64 autograd."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from condwrap import ConditioningRegularizer
from condwrap.estimators import ESTIMATORS
from condwrap.observation import States

# forward mode imports decompositions that PyTorch itself scripts
pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit.script.* is deprecated:DeprecationWarning"
)

estimators = pytest.mark.parametrize("estimator", ESTIMATORS)


def mlp():
    return nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 3)).double()


def convolutional():
    return nn.Sequential(
        nn.Unflatten(1, (1, 4, 4)), nn.Conv2d(1, 3, 2), nn.Tanh(), nn.MaxPool2d(2), nn.Flatten()
    ).double()


class Recurrent(nn.Module):
    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(4, 5, batch_first=True).double()

    def forward(self, obs):
        return self.gru(obs)[0]


POLICIES = {"mlp": (mlp, (4,)), "conv": (convolutional, (16,)), "gru": (Recurrent, (3, 4))}
policies = pytest.mark.parametrize("policy", POLICIES)


def make(name, batch=5):
    build, shape = POLICIES[name]
    return build(), torch.randn(batch, *shape, dtype=torch.float64)


def jacobian_quotient(policy, obs, delta):
    """‖Jacobian · delta‖ / ‖delta‖ by reverse-mode autograd, state by state."""
    quotients = []
    for state, shift in zip(obs, delta, strict=True):
        full = torch.autograd.functional.jacobian(lambda x: policy(x[None])[0], state)
        change = torch.tensordot(full, shift, shift.ndim)
        quotients.append(change.norm() / shift.norm())
    return torch.stack(quotients)


@policies
def test_jvp_is_the_jacobian_times_delta(policy):
    policy, obs = make(policy)
    regularizer = ConditioningRegularizer(estimator="jvp")
    delta = regularizer.sample_delta(obs)
    quotient = regularizer(policy, obs, delta=delta).quotient
    torch.testing.assert_close(quotient, jacobian_quotient(policy, obs, delta))


@policies
def test_difference_converges_to_the_jacobian_as_the_radius_shrinks(policy):
    policy, obs = make(policy)
    direction = ConditioningRegularizer().sample_delta(obs)
    limit = jacobian_quotient(policy, obs, direction)
    errors = []
    for radius in (1e-1, 1e-3, 1e-5):
        quotient = ConditioningRegularizer()(policy, obs, delta=radius * direction).quotient
        errors.append((quotient - limit).abs().max().item())
    assert errors[0] > 1e-5
    assert errors[1] < 0.05 * errors[0]  # first order: 0.01 and a margin
    assert errors[2] < 1e-5


@policies
def test_difference_is_the_policy_evaluated_twice(policy):
    policy, obs = make(policy)
    regularizer = ConditioningRegularizer()
    delta = regularizer.sample_delta(obs)
    change = (policy(obs) - policy(obs + delta)).flatten(1).norm(dim=1)
    quotient = regularizer(policy, obs, delta=delta).quotient
    torch.testing.assert_close(quotient, (change / delta.flatten(1).norm(dim=1)).detach())


@estimators
def test_both_estimators_are_exact_for_a_linear_policy(estimator):
    policy = nn.Linear(4, 3).double()
    obs = torch.randn(6, 4, dtype=torch.float64)
    regularizer = ConditioningRegularizer(estimator=estimator, radius=3.0)
    delta = regularizer.sample_delta(obs)
    expected = (delta @ policy.weight.T).norm(dim=1) / 3.0
    quotient = regularizer(policy, obs, delta=delta).quotient
    torch.testing.assert_close(quotient, expected.detach())


@estimators
@policies
def test_gradients_reach_every_parameter_that_matters(estimator, policy):
    policy, obs = make(policy)
    ConditioningRegularizer(estimator=estimator)(policy, obs).penalty.backward()
    for name, parameter in policy.named_parameters():
        if estimator == "jvp" and name == "2.bias":  # the last bias is no part of the Jacobian
            continue
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
    weights = [p.grad for p in policy.parameters() if p.ndim > 1]
    assert all(g.abs().sum() > 0 for g in weights)


@estimators
def test_gradient_matches_a_finite_difference_of_the_penalty(estimator):
    policy, obs = make("mlp")
    regularizer = ConditioningRegularizer(coefficient=2.0, estimator=estimator)
    delta = regularizer.sample_delta(obs)

    def penalty(weight):
        def moved(x):
            return torch.func.functional_call(policy, {"0.weight": weight}, (x,))

        return regularizer(moved, obs, delta=delta).penalty

    weight = policy[0].weight.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(penalty, (weight,))


@estimators
def test_both_measure_without_gradients(estimator):
    policy, obs = make("mlp")
    expected = ConditioningRegularizer(estimator=estimator)(policy, obs).quotient
    for context in (torch.no_grad, torch.inference_mode):
        with context():
            conditioning = ConditioningRegularizer(estimator=estimator)(policy, obs)
        torch.testing.assert_close(conditioning.quotient, expected)
        assert not conditioning.penalty.requires_grad


@estimators
def test_batch_norm_is_evaluated_with_running_statistics(estimator):
    norm = nn.BatchNorm1d(4)
    norm.running_var.fill_(4.0)
    conditioning = ConditioningRegularizer(estimator=estimator)(norm, torch.randn(6, 4))
    torch.testing.assert_close(conditioning.quotient, torch.full((6,), 0.5), rtol=1e-4, atol=0.0)
    assert norm.training
    assert norm.num_batches_tracked == 0


def test_both_halves_of_the_difference_share_their_dropout_masks():
    obs = torch.ones(64, 32)
    states = States.read(obs, None, 1)
    policy = nn.Dropout(0.5)
    clean, moved = ESTIMATORS["difference"](policy, policy, states, torch.ones(64, 32), None)
    assert 0.4 < (clean == 0).float().mean() < 0.6
    torch.testing.assert_close(moved, 2 * clean)


def test_the_vmapped_pair_of_compiled_code_equals_two_evaluations(monkeypatch):
    policy = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Dropout(), nn.Linear(8, 3))
    obs = torch.randn(6, 4)
    expected = ConditioningRegularizer()(policy, obs).quotient
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    torch.testing.assert_close(ConditioningRegularizer()(policy, obs).quotient, expected)


def attention(obs):
    """Four tokens of 8 attend to each other."""
    tokens = obs.reshape(-1, 1, 4, 8)
    return F.scaled_dot_product_attention(tokens, tokens, tokens)


def test_jvp_names_flash_attention_as_what_it_cannot_differentiate():
    regularizer = ConditioningRegularizer(coefficient=0, estimator="jvp")
    obs = torch.randn(2, 32)
    delta = regularizer.sample_delta(obs)
    with pytest.raises(
        NotImplementedError, match=r"(?s)estimator='jvp' needs .* For attention use"
    ):
        regularizer(attention, obs, delta=delta)
    with sdpa_kernel(SDPBackend.MATH):
        by_limit = regularizer(attention, obs, delta=delta).quotient
    by_difference = ConditioningRegularizer(coefficient=0)(
        attention, obs, delta=1e-2 * delta
    ).quotient
    torch.testing.assert_close(by_limit, by_difference, rtol=0.02, atol=0)
