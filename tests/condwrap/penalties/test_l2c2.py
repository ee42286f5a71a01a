"""L2C2 by hand, on a batch in which an episode ends, and by finite differences."""

import math

import pytest
import torch
from torch import nn

from condwrap.penalties import L2C2, PENALTIES
from tests.condwrap.penalties.helpers import gradcheck, linear, mlp

F64 = torch.float64

# row 1 ends an episode: its successor is the first state of the next one, far away
OBS = torch.tensor([[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]], dtype=F64)
NEXT_OBS = torch.tensor([[1.0, 0.0], [90.0, 90.0], [2.0, 1.0]], dtype=F64)
DONES = torch.tensor([False, True, False])


def call(penalty, policy, **options):
    given = {"next_obs": NEXT_OBS, "dones": DONES, **options}
    return penalty(policy, OBS, **given)


def test_a_value_worked_out_by_hand():
    # one output, |Δμ|² = (3 Δx)² = 9 u₀² in row 0 and 0 in row 2, where y alone moves:
    # mean Δμ² = 9 u₀² / 2, mean Δs² = (u₀² + u₂²) / 4
    u0, _, u2 = L2C2().uniform((3, 1), OBS).flatten().tolist()
    result = call(L2C2(coefficient=0.5), linear([[3.0, 0.0]]))
    want = (9 * u0**2 / 2) / ((u0**2 + u2**2) / 4)
    assert result.metrics()["penalty/l2c2_policy"] == pytest.approx(want)
    assert result.penalty.item() == pytest.approx(want / 2)


@pytest.mark.parametrize("u_min", [-1.0, 0.0, 0.5])
def test_u_lies_in_its_range_and_scales_the_whole_step(u_min):
    seen = []
    obs, next_obs = torch.zeros(2000, 2, dtype=F64), torch.ones(2000, 2, dtype=F64)
    dones = torch.zeros(2000)

    def policy(x):
        seen.append(x)
        return layer(x)

    layer = linear([[1.0, 0.0]])
    L2C2(u_min=u_min)(policy, obs, next_obs=next_obs, dones=dones)
    u = seen[-1]
    assert torch.equal(u[:, 0], u[:, 1])
    assert u_min <= u.min() < u_min + 0.02
    assert 0.98 < u.max() < 1


def test_what_follows_an_end_reaches_neither_value_nor_gradient():
    net = mlp(2)
    changed = NEXT_OBS.clone()
    changed[1] = math.nan
    penalties = [call(L2C2(), net, next_obs=x).penalty for x in (NEXT_OBS, changed)]
    assert penalties[0] == penalties[1]
    gradients = [torch.autograd.grad(x, net[0].weight)[0] for x in penalties]
    assert torch.equal(*gradients)


def test_a_linear_policy_is_bounded_by_its_singular_values():
    # as many outputs as inputs: the ratio is between the squares of the least and the largest
    policy = linear([[2.0, 0.0], [0.0, 3.0]])
    ratio = call(L2C2(), policy).metrics()["penalty/l2c2_policy"]
    assert 4 < ratio < 9
    double = call(L2C2(), lambda x: 2 * policy(x)).metrics()["penalty/l2c2_policy"]
    assert double == pytest.approx(4 * ratio)


def test_the_critic_term_by_hand():
    # V = 5 x + 5 y: |ΔV|² = 25 u² in both rows, mean Δs² = u² / 2 each, so the ratio is 50
    critic = nn.Sequential(linear([[5.0, 5.0]]), nn.Flatten(0))
    for value in (critic, critic[0]):  # [B] and [B, 1]
        result = call(L2C2(0.0, critic_coefficient=0.1), mlp(2), value=value)
        assert result.metrics() == {"penalty/l2c2_critic": pytest.approx(50.0)}
        assert result.penalty.item() == pytest.approx(5.0)


@pytest.mark.parametrize(("dones", "next_obs"), [(torch.ones(3), NEXT_OBS), (torch.zeros(3), OBS)])
def test_where_nothing_moves_it_costs_nothing(dones, next_obs):
    result = call(L2C2(), mlp(2), dones=dones, next_obs=next_obs)
    assert result.penalty.item() == 0.0
    result.penalty.backward()


def test_a_constant_policy_costs_nothing():
    assert call(L2C2(), linear([[0.0, 0.0]])).penalty.item() == 0.0


def test_the_gradient_is_that_of_finite_differences():
    assert gradcheck(mlp(2), lambda policy: call(L2C2(), policy))
    both = lambda policy: call(L2C2(0.5, 0.1), policy, value=policy)  # noqa: E731
    assert gradcheck(mlp(2, 1), both)


def test_the_divisor_is_a_constant_for_the_gradient():
    # where observations are learned: 9 u² (s' - s)² / u² (s' - s)², the divisor held, has the
    # slope -18 / (s' - s) in s
    obs = torch.zeros(1, 1, dtype=F64, requires_grad=True)
    next_obs = torch.full((1, 1), 2.0, dtype=F64)
    result = L2C2()(linear([[3.0]]), obs, next_obs=next_obs, dones=torch.zeros(1))
    (gradient,) = torch.autograd.grad(result.penalty, obs)
    assert gradient.item() == pytest.approx(-9.0)


def test_images_are_measured_in_units_of_255():
    images = torch.zeros(2, 1, 2, 2, dtype=torch.uint8)
    brighter = images + 255
    seen = []
    policy = nn.Sequential(nn.Flatten(), nn.Linear(4, 4, bias=False))
    policy[0].register_forward_pre_hook(lambda module, args: seen.append(*args))
    policy[1].weight.data = torch.eye(4) * (2 / 255)
    result = L2C2()(policy, images, next_obs=brighter, dones=torch.zeros(2))
    assert result.metrics()["penalty/l2c2_policy"] == pytest.approx(4.0)
    assert 1 < seen[1].max() <= 255  # between the two images


def test_a_known_output_gives_the_same():
    net = mlp(2)
    assert torch.equal(call(L2C2(), net, output=net(OBS)).penalty, call(L2C2(), net).penalty)


def test_it_names_what_it_lacks():
    assert L2C2().needs == ("next_obs", "dones")
    assert L2C2(critic_coefficient=0.1).needs == ("next_obs", "dones", "value")
    with pytest.raises(ValueError, match="L2C2 needs next_obs and dones: it looks between"):
        L2C2()(mlp(2), OBS)
    with pytest.raises(ValueError, match="L2C2 needs value: its critic term"):
        call(L2C2(critic_coefficient=0.1), mlp(2))
    with pytest.raises(TypeError, match="L2C2 evaluates value at new states: pass a callable"):
        call(L2C2(critic_coefficient=0.1), mlp(2), value=torch.zeros(3))
    with pytest.raises(ValueError, match=r"value\(obs\) must be a tensor of shape \(3,\) or"):
        call(L2C2(critic_coefficient=0.1), mlp(2), value=mlp(2))


@pytest.mark.parametrize("u_min", [-1.1, 1.0, math.nan])
def test_a_bad_range_is_refused(u_min):
    with pytest.raises(ValueError, match=r"u_min must be in \[-1, 1\), got"):
        L2C2(u_min=u_min)
    with pytest.raises(ValueError, match="critic_coefficient must be finite"):
        PENALTIES["l2c2"](critic_coefficient=-1.0)
