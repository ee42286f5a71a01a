"""DrAC's regularizer by hand and by finite differences, and where the values may come from."""

import math

import pytest
import torch
from torch import distributions as td
from torch import nn

from condwrap.penalties import AugmentationConsistency
from tests.condwrap.penalties.helpers import Discrete, Gaussian, gradcheck, linear, mlp

F64 = torch.float64
OBS = torch.tensor([[1.0, 0.0, -1.0], [0.5, 2.0, 0.0]], dtype=F64)


def reverse(obs):
    return obs.flip(-1)


class Shared(nn.Module):
    """(distribution, V) from one trunk."""

    def __init__(self):
        super().__init__()
        self.trunk = mlp(3, 3)

    def forward(self, obs):
        hidden = self.trunk(obs)
        return td.Categorical(logits=hidden[:, :2]), hidden[:, 2:]


def test_values_worked_out_by_hand():
    # obs 0 becomes 1: logits (0, 0) and (ln 3, 0), so KL((½, ½) ‖ (¾, ¼)) = ½ ln(4/3);
    # V goes from 0 to 4, so ½ 4² = 8
    policy = Discrete(linear([[math.log(3.0)], [0.0]]))
    obs = torch.zeros(2, 1, dtype=F64)
    penalty = AugmentationConsistency(augment=lambda x: x + 1)
    result = penalty(policy, obs, value=linear([[4.0]]))
    assert result.metrics() == {
        "penalty/drac_policy": pytest.approx(0.5 * math.log(4 / 3)),
        "penalty/drac_value": pytest.approx(8.0),
    }
    assert result.penalty.item() == pytest.approx(0.1 * (0.5 * math.log(4 / 3) + 8.0))


@pytest.mark.parametrize("independent", [False, True])
def test_a_gaussian_by_hand(independent):
    # KL of two Normals that share σ = 2: ½ Σ (Δμ / 2)², Δμ = (3, 4), summed over the actions
    mean = linear([[3.0], [4.0]])

    def policy(obs):
        normal = td.Normal(mean(obs), 2.0)
        return td.Independent(normal, 1) if independent else normal

    penalty = AugmentationConsistency(1.0, lambda x: x + 1, value_term=False)
    result = penalty(policy, torch.zeros(3, 1, dtype=F64))
    assert result.penalty.item() == pytest.approx(0.5 * 25 / 4)


@pytest.mark.parametrize("policy", [Discrete(mlp()), Gaussian(mlp(), [0.1, -0.3])])
def test_the_gradient_is_that_of_finite_differences(policy):
    # the clean side is a target without a gradient, so it is held fixed for the differences too
    with torch.no_grad():
        target = policy(OBS)
    penalty = AugmentationConsistency(1.0, reverse, value_term=False)
    assert gradcheck(policy, lambda p: penalty(p, OBS, output=target))


def test_the_gradient_of_values_is_that_of_finite_differences():
    shared = Shared()
    with torch.no_grad():
        target, value = shared(OBS)
    penalty = AugmentationConsistency(1.0, reverse)
    assert gradcheck(shared, lambda p: penalty(p, OBS, output=(target, value), value=value))


def test_the_clean_side_has_no_gradient():
    # of the critic, and of a policy whose output is known with its graph
    policy, critic = Discrete(mlp()), mlp(3, 1)
    fixed = reverse(OBS)  # the clean observations: then s̃ = OBS is where the gradient is taken
    first = AugmentationConsistency(1.0, lambda x: OBS)(policy, fixed, value=critic).penalty
    known = AugmentationConsistency(1.0, lambda x: OBS)(
        policy, fixed, value=critic, output=policy(fixed)
    ).penalty
    assert torch.equal(first, known)
    weights = [*policy.parameters(), *critic.parameters()]
    one, other = (torch.autograd.grad(x, weights) for x in (first, known))
    new, old = critic(OBS), critic(fixed).detach()
    target = policy(fixed).probs.detach()
    divergence = -(target * policy(OBS).logits).sum(-1).mean()  # up to a constant
    by_hand = torch.autograd.grad(divergence + (new - old).square().mean() / 2, weights)
    for got in (one, other):
        for x, y in zip(got, by_hand, strict=True):
            torch.testing.assert_close(x, y)


def test_a_known_output_is_a_target_too():
    gaussian, shared = Gaussian(mlp(), [0.1, -0.3]), Shared()
    cases = [(gaussian, {"value_term": False}), (shared, {})]
    for policy, options in cases:
        gradients = []
        for track in (True, False):
            with torch.set_grad_enabled(track):
                output = policy(OBS)
            value = output[1] if policy is shared else None
            penalty = AugmentationConsistency(1.0, reverse, **options)
            result = penalty(policy, OBS, output=output, value=value)
            gradients.append(torch.autograd.grad(result.penalty, list(policy.parameters())))
        for x, y in zip(*gradients, strict=True):
            torch.testing.assert_close(x, y, rtol=0, atol=0)


def test_values_come_from_a_critic_or_from_beside_the_distribution():
    shared = Shared()
    value = shared(OBS)[1]
    penalty = AugmentationConsistency(augment=reverse)
    beside = penalty(shared, OBS, value=value).penalty
    critic = penalty(shared, OBS, value=lambda obs: shared(obs)[1].squeeze(-1)).penalty
    assert torch.equal(beside, critic)


def test_one_evaluation_is_enough_where_both_are_known():
    shared, calls = Shared(), []

    def policy(obs):
        calls.append(obs)
        return shared(obs)

    output = shared(OBS)
    AugmentationConsistency(augment=reverse)(policy, OBS, output=output, value=output[1])
    assert len(calls) == 1
    assert torch.equal(calls[0], reverse(OBS))


def test_nothing_changes_nothing_costs():
    penalty = AugmentationConsistency(augment=lambda obs: obs)
    assert penalty(Discrete(mlp()), OBS, value=mlp(3, 1)).penalty.item() == 0.0
    flat = Discrete(linear([[0.0] * 3] * 2))
    penalty = AugmentationConsistency(augment=reverse, value_term=False)
    assert penalty(flat, OBS).penalty.item() == 0.0


def test_images_are_shifted_by_default():
    images = torch.randint(0, 256, (6, 3, 8, 8), dtype=torch.uint8)
    net = nn.Sequential(nn.Flatten(), nn.Linear(192, 4))
    seen = []

    def policy(obs):
        seen.append(obs)
        return td.Categorical(logits=net(obs / 255))

    penalty = AugmentationConsistency(value_term=False)
    result = penalty(policy, images)
    assert result.penalty > 0
    assert seen[1].shape == images.shape
    assert not torch.equal(*seen)
    again = AugmentationConsistency(value_term=False)(policy, images)
    assert torch.equal(again.penalty, result.penalty)  # the default shift draws from the seed
    assert penalty(policy, images).penalty != result.penalty


def test_it_names_what_it_lacks():
    assert AugmentationConsistency().needs == ("value",)
    assert AugmentationConsistency(value_term=False).needs == ()
    with pytest.raises(ValueError, match="AugmentationConsistency needs value: pass the critic"):
        AugmentationConsistency(augment=reverse)(Discrete(mlp()), OBS)
    with pytest.raises(TypeError, match=r"must return \(distribution, V\), got 0 tensors"):
        AugmentationConsistency(augment=reverse)(Discrete(mlp()), OBS, value=torch.zeros(2))
    with pytest.raises(TypeError, match="needs a policy that returns one torch"):
        AugmentationConsistency(augment=reverse, value_term=False)(mlp(), OBS)
    with pytest.raises(ValueError, match="pass augment="):
        AugmentationConsistency(value_term=False)(Discrete(mlp()), OBS)
    with pytest.raises(ValueError, match="augment must keep the number of states, got 1 of 2"):
        AugmentationConsistency(augment=lambda x: x[:1], value_term=False)(Discrete(mlp()), OBS)


@pytest.mark.parametrize("coefficient", [-1.0, math.nan])
def test_a_bad_coefficient_is_refused(coefficient):
    with pytest.raises(ValueError, match="coefficient must be finite and at least 0"):
        AugmentationConsistency(coefficient)
