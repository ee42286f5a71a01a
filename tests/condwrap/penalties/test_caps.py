"""CAPS by hand, on a batch in which an episode ends, and by finite differences."""

import math

import pytest
import torch
from torch import nn

from condwrap.penalties import CAPS
from tests.condwrap.penalties.helpers import gradcheck, linear, mlp

F64 = torch.float64

# Steps 0 and 1 belong to one episode, which ends with step 1; step 2 begins another. The rows are
# shuffled, as in a minibatch: below row 0 stands another environment's state.
OBS = torch.tensor([[0.0, 0.0], [50.0, 7.0], [1.0, 0.0]], dtype=F64)
NEXT_OBS = torch.tensor([[1.0, 0.0], [50.0, 7.0], [50.0, 7.0]], dtype=F64)
DONES = torch.tensor([0.0, 0.0, 1.0])
POLICY = [[3.0, 0.0], [4.0, 0.0]]  # μ = (3 x, 4 x), ‖Δμ‖ = 5 |Δx|


def call(penalty, policy, **options):
    given = {"next_obs": NEXT_OBS, "dones": DONES, **options}
    return penalty(policy, OBS, **given)


def test_the_end_of_an_episode_does_not_count():
    # pairs: 0 -> 1 costs 5, 50 -> 50 costs 0, and 1 -> 50 is the first state of the next episode
    result = call(CAPS(temporal=0.1, spatial=0.0), linear(POLICY))
    assert result.metrics() == {"penalty/caps_temporal": 2.5}
    assert result.penalty.item() == pytest.approx(0.25)


def test_what_follows_an_end_reaches_neither_value_nor_gradient():
    net = mlp(2)
    changed = NEXT_OBS.clone()
    changed[2] = math.nan
    gradients = []
    for next_obs in (NEXT_OBS, changed):
        penalty = call(CAPS(spatial=0.0), net, next_obs=next_obs).penalty
        gradients.append(torch.autograd.grad(penalty, list(net.parameters()), allow_unused=True))
    for one, other in zip(*gradients, strict=True):
        assert one is other is None or torch.equal(one, other)


def test_an_end_does_not_count_whatever_is_known_of_it():
    policy = linear(POLICY)
    output = policy(OBS) + torch.tensor([[0.0], [0.0], [100.0]])
    result = call(CAPS(spatial=0.0), policy, output=output)
    assert result.metrics() == {"penalty/caps_temporal": 2.5}


def test_a_batch_of_ends_alone_costs_nothing():
    result = call(CAPS(spatial=0.0), mlp(2), dones=torch.ones(3))
    assert result.penalty.item() == 0.0
    result.penalty.backward()


def test_the_spatial_term_by_hand():
    # one observed number, μ = 3 s, so the mean is 3 · 0.2 · mean |ε| = 0.6 √(2/π)
    obs = torch.zeros(40_000, 1, dtype=F64)
    result = CAPS(temporal=0.0, spatial=0.5)(linear([[3.0]]), obs)
    want = 0.6 * math.sqrt(2 / math.pi)
    assert result.metrics()["penalty/caps_spatial"] == pytest.approx(want, rel=0.02)
    assert result.penalty.item() == pytest.approx(want / 2, rel=0.02)


def test_the_gradient_is_that_of_finite_differences():
    assert gradcheck(mlp(2), lambda policy: call(CAPS(), policy))


def test_it_grows_with_the_policy():
    net = mlp(2)
    one, twice = call(CAPS(), net), call(CAPS(), lambda x: 2 * net(x))
    torch.testing.assert_close(twice.penalty, 2 * one.penalty)


def test_a_constant_policy_costs_nothing():
    penalty = call(CAPS(), linear([[0.0, 0.0]])).penalty
    assert penalty.item() == 0.0
    penalty.backward()  # the slope of a norm at 0 is 0, not NaN


def test_a_known_output_gives_the_same():
    net = mlp(2)
    known = call(CAPS(), net, output=net(OBS)).penalty
    assert torch.equal(known, call(CAPS(), net).penalty)
    noisy = nn.Sequential(net, nn.Dropout(0.5))
    with pytest.raises(ValueError, match="output cannot be used with Dropout"):
        call(CAPS(), noisy, output=noisy(OBS))


def test_it_names_what_it_lacks():
    with pytest.raises(ValueError, match="CAPS needs next_obs and dones: its temporal term"):
        CAPS()(mlp(2), OBS)
    with pytest.raises(ValueError, match="CAPS needs dones: its temporal term"):
        CAPS()(mlp(2), OBS, next_obs=NEXT_OBS)
    assert CAPS().needs == ("next_obs", "dones")
    assert CAPS(temporal=0.0).needs == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temporal": -1.0}, "temporal must be finite and at least 0, got -1.0"),
        ({"spatial": math.nan}, "spatial must be finite and at least 0, got nan"),
        ({"std": 0.0}, "std must be finite and above 0, got 0.0"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        CAPS(**options)
