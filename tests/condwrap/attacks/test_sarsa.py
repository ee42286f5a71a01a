"""Q fitted to transitions whose values are known, and the bound on its change."""

import copy
import dataclasses
import re

import pytest
import torch
from torch import nn

from condwrap.attacks import Transitions, fit_action_value, robust_sarsa


class Q(nn.Module):
    def __init__(self, n=1, m=1, width=32):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(n + m, width), nn.Tanh(), nn.Linear(width, 1))

    def forward(self, obs, actions):
        return self.net(torch.cat([obs, actions], -1))


class Table(nn.Module):
    """Q of two states, whatever the action: what Sarsa must find exactly."""

    def __init__(self):
        super().__init__()
        self.values = nn.Parameter(torch.zeros(2))

    def forward(self, obs, actions):
        return self.values[obs[:, 0].long()]


def chain():
    """State 0 pays 1 and leads to state 1, which pays 2 and ends."""
    return Transitions(
        obs=torch.tensor([[0.0], [1.0]]),
        actions=torch.zeros(2, 1),
        rewards=torch.tensor([1.0, 2.0]),
        next_obs=torch.tensor([[1.0], [0.0]]),
        next_actions=torch.zeros(2, 1),
        terminations=torch.tensor([False, True]),
    )


def bandit(count=400):
    """One step each, which pays -(a - s)²."""
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(count, 1, generator=generator)
    actions = obs + 0.5 * torch.randn(count, 1, generator=generator)
    return Transitions(
        obs, actions, -(actions - obs).square()[:, 0], obs, actions,
        torch.ones(count, dtype=torch.bool),
    )  # fmt: skip


def test_the_values_of_a_chain_by_hand():
    q = Table()
    errors = fit_action_value(q, chain(), gamma=0.9, updates=1500, learning_rate=0.01)
    torch.testing.assert_close(q.values.data, torch.tensor([1 + 0.9 * 2, 2.0]), atol=0.02, rtol=0)
    assert errors.shape == (1500,)
    assert errors[0] > 1
    assert errors[-1] < 1e-3


def test_a_time_limit_goes_on():
    endless = dataclasses.replace(
        chain(), next_obs=torch.tensor([[0.0], [1.0]]), terminations=torch.zeros(2)
    )
    q = Table()
    fit_action_value(q, endless, gamma=0.5, updates=1500, learning_rate=0.01)
    torch.testing.assert_close(q.values.data, torch.tensor([2.0, 4.0]), atol=0.02, rtol=0)


def test_the_bound_makes_q_flatter_in_the_action():
    data = bandit()

    def slope(robustness, action_radius=0.3):
        torch.manual_seed(0)
        q = Q()
        fit_action_value(q, data, robustness=robustness, action_radius=action_radius, updates=400)
        actions = data.actions.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(q(data.obs, actions).sum(), actions)
        return gradient.abs().mean().item()

    free, held, firmly = slope(0.0), slope(3.0), slope(100.0)
    assert free > 1.3 * held > 1.3 * 1.3 * firmly
    assert slope(100.0, action_radius=0.0) == pytest.approx(free)  # a ball of one point


def test_its_attack_lowers_the_reward_more_than_it_would_by_chance():
    data = bandit()
    q = Q()
    fit_action_value(q, data, updates=800, robustness=0.01)
    obs = data.obs[:100]
    policy = nn.Linear(1, 1)
    with torch.no_grad():
        policy.weight.fill_(0.8)  # acts at 0.8 s where s is best
        policy.bias.fill_(0.0)
    delta = robust_sarsa(policy, obs, 0.3, action_value=q, generator=torch.Generator())
    far = obs.abs()[:, 0] > 1.0
    assert far.sum() > 10
    # the reward falls where the action moves away from s: towards 0
    assert (delta[far].sign() == -obs[far].sign()).all()


def test_a_generator_decides_and_the_global_one_is_left_alone():
    torch.manual_seed(0)
    first = Q()
    second = copy.deepcopy(first)
    state = torch.get_rng_state()
    with torch.no_grad():
        found = [
            fit_action_value(q, bandit(), updates=5, generator=torch.Generator().manual_seed(3))
            for q in (first, second)
        ]
    assert torch.equal(*found)
    assert torch.equal(state, torch.get_rng_state())
    default = fit_action_value(copy.deepcopy(first), bandit(), updates=5)
    assert torch.equal(default, fit_action_value(copy.deepcopy(first), bandit(), updates=5))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"gamma": 1.5}, "gamma must be in [0, 1], got 1.5"),
        ({"robustness": -1.0}, "robustness must be finite and at least 0, got -1.0"),
        ({"action_radius": -1.0}, "action_radius must be finite and at least 0, got -1.0"),
        ({"updates": 0}, "updates must be at least 1, got 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
    ],
)
def test_bad_settings_are_refused_by_name(options, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        fit_action_value(Q(), bandit(), **options)


def test_transitions_that_do_not_fit_together_are_refused():
    with pytest.raises(ValueError, match=r"one row for each step, got .*'rewards': 3"):
        dataclasses.replace(chain(), rewards=torch.zeros(3))
    with pytest.raises(ValueError, match=r"must have one shape, .N, m., got .2, 1. and .2, 3."):
        dataclasses.replace(chain(), next_actions=torch.zeros(2, 3))
    with pytest.raises(ValueError, match="one row for each step"):
        chain().take(torch.zeros(0, dtype=torch.long))


def test_values_that_are_not_one_a_state_are_refused():
    class Wide(Q):
        def forward(self, obs, actions):
            return super().forward(obs, actions).expand(-1, 2)

    with pytest.raises(ValueError, match="action_value must return one number for each of 256"):
        fit_action_value(Wide(), bandit())
