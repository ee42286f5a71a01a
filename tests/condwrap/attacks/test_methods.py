"""The attacks against exact maxima, enumeration and noise, and what they must leave alone."""

import copy
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import distributions as td
from torch import nn

from condwrap.attacks import critic, mad, random, robust_sarsa
from tests.condwrap.helpers import stochastic

PROPERTY = settings(derandomize=True, deadline=None, max_examples=15)
SIZES = {"linf": math.inf, "l2": 2}
norms = pytest.mark.parametrize("norm", SIZES)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def mlp(n=4, m=3):
    return nn.Sequential(nn.Linear(n, 16), nn.Tanh(), nn.Linear(16, m)).double()


def q_of(obs, actions):
    return -(actions.tanh() * obs[:, :1].cos()).sum(-1)


def sarsa(policy, obs, radius, norm="linf", **options):
    return robust_sarsa(policy, obs, radius, norm, action_value=q_of, **options)


def value_of(policy, obs, radius, norm="linf", **options):
    return critic(lambda x: policy(x).sum(-1), obs, radius, norm, **options)


ATTACKS = {"random": random, "mad": mad, "critic": value_of, "robust_sarsa": sarsa}
GRADIENT = {name: attack for name, attack in ATTACKS.items() if name != "random"}
every_attack = pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
gradient_attacks = pytest.mark.parametrize("attack", GRADIENT.values(), ids=GRADIENT)


def change(policy, obs, delta):
    with torch.no_grad():
        return (policy(obs + delta) - policy(obs)).square().sum(-1)


# --- exact maxima of linear policies ----------------------------------------------------------


def test_one_output_gives_the_exact_maximum_in_linf():
    for seed in range(20):
        weight = torch.randn(1, 30, dtype=torch.float64, generator=seeded(seed))
        obs = torch.randn(8, 30, dtype=torch.float64)
        delta = mad(lambda x, w=weight: x @ w.T, obs, 0.3, "linf", restarts=1, generator=seeded())
        best = (0.3 * weight.abs().sum()) ** 2  # |w · delta| <= radius · ‖w‖_1
        torch.testing.assert_close(
            change(lambda x, w=weight: x @ w.T, obs, delta), best.expand(8), rtol=1e-12, atol=0
        )


@pytest.mark.parametrize("m", [1, 2, 6])
def test_several_outputs_give_the_largest_singular_value_in_l2(m):
    weight = torch.randn(m, 12, dtype=torch.float64)
    obs = torch.randn(8, 12, dtype=torch.float64)
    delta = mad(lambda x: x @ weight.T, obs, 0.3, "l2", steps=200, generator=seeded())
    sigma = np.linalg.svd(weight.numpy(), compute_uv=False)[0]
    best = torch.tensor((0.3 * sigma) ** 2).expand(8)
    torch.testing.assert_close(change(lambda x: x @ weight.T, obs, delta), best, rtol=1e-6, atol=0)


def test_a_gaussian_policy_counts_each_output_in_its_sigmas():
    """The output whose sigma is small decides, though the other one moves more."""
    weight = torch.tensor([[1.0, 0.1], [0.0, 3.0]])

    def policy(x):
        return td.Independent(td.Normal(x @ weight.T, torch.tensor([0.01, 10.0])), 1)

    delta = mad(policy, torch.zeros(1, 2), 1.0, "l2", steps=50, generator=seeded())
    expected = torch.tensor([[1.0, 0.1]]) / math.hypot(1, 0.1)
    delta = delta * delta[:, :1].sign()
    torch.testing.assert_close(delta, expected, atol=1e-3, rtol=0)
    plain = mad(lambda x: policy(x).mean, torch.zeros(1, 2), 1.0, "l2", generator=seeded())
    assert plain[0, 1].abs() > 0.99


def test_a_categorical_policy_is_driven_apart():
    policy = nn.Linear(3, 4).double()
    obs = torch.randn(6, 3).double()
    delta = mad(lambda x: td.Categorical(logits=policy(x)), obs, 1.0, generator=seeded())
    corners = torch.tensor(list(itertools.product([-1.0, 1.0], repeat=3))).double()

    def kl(shift):
        clean, moved = (td.Categorical(logits=policy(x)) for x in (obs, obs + shift))
        return td.kl_divergence(clean, moved).detach()

    best = torch.stack([kl(corner) for corner in corners]).amax(0)  # KL is convex in the logits
    torch.testing.assert_close(kl(delta), best)


def test_the_critics_exact_minimum_of_a_linear_value():
    value = nn.Linear(5, 1).double()
    obs = torch.randn(4, 5).double()
    weight = value.weight.detach()
    delta = critic(value, obs, 0.2, "linf", generator=seeded())
    assert torch.equal(delta, (-0.2 * weight.sign()).expand(4, 5))
    delta = critic(value, obs, 0.2, "l2", steps=20, generator=seeded())
    expected = (-0.2 * weight / weight.norm()).expand(4, 5)
    torch.testing.assert_close(delta, expected, rtol=0, atol=1e-6)


def test_robust_sarsa_values_actions_at_the_true_state():
    """Q(s, a) = s·a of pi(s) = s is least at s + delta with delta = -radius · sign(s)."""
    obs = torch.tensor([[2.0], [-3.0]])
    delta = robust_sarsa(
        nn.Identity(), obs, 0.5, action_value=lambda s, a: (s * a).sum(-1), generator=seeded()
    )
    assert delta.tolist() == [[-0.5], [0.5]]
    # Q(s + delta, a) = (s + delta) · s would be least there too; of Q = a - 2 s it would not
    delta = robust_sarsa(
        nn.Identity(), obs, 0.5, action_value=lambda s, a: a - 2 * s, generator=seeded()
    )
    assert delta.tolist() == [[-0.5], [-0.5]]


def test_robust_sarsa_takes_a_distributions_mean():
    delta = robust_sarsa(
        lambda x: td.Normal(x, 1.0), torch.zeros(2, 1), 0.5,
        action_value=lambda s, a: a, generator=seeded(),
    )  # fmt: skip
    assert delta.tolist() == [[-0.5], [-0.5]]


# --- against enumeration and noise ------------------------------------------------------------


def test_corners_missed_with_more_and_more_restarts():
    """The maximum of a convex function lies in a corner. 12 inputs have 4,096 of them."""
    corners = torch.tensor(list(itertools.product([-1.0, 1.0], repeat=12))).double()
    weight = torch.randn(200, 6, 12, dtype=torch.float64, generator=seeded())
    best = torch.einsum("pmn,cn->pcm", weight, corners).square().sum(-1).amax(1)
    obs = torch.zeros(200, 12, dtype=torch.float64)

    def missed(restarts):
        copies = weight.repeat(restarts, 1, 1)

        def policy(x):  # a policy of its own for each state
            own = copies if len(x) == len(copies) else weight
            return torch.einsum("bmn,bn->bm", own, x)

        delta = mad(policy, obs, 1.0, restarts=restarts, generator=seeded(1))
        found = change(policy, obs, delta)
        assert (found <= best * (1 + 1e-9)).all()
        return (found < best * (1 - 1e-9)).double().mean().item()

    assert 0.6 < missed(1) < 0.9
    assert missed(20) < 0.12
    assert missed(64) < 0.03


@norms
@pytest.mark.parametrize("radius", [0.05, 1.0])
def test_mad_is_at_least_as_strong_as_many_draws(norm, radius):
    policy = mlp(6, 4)
    for _ in range(3):
        nn.init.orthogonal_(policy[0].weight, 3.0)
    obs = torch.randn(20, 6).double()
    delta = mad(policy, obs, radius, norm, generator=seeded())
    draws = seeded(1)
    tried = [random(policy, obs, radius, norm, generator=draws) for _ in range(2000)]
    noise = torch.stack([change(policy, obs, shift) for shift in tried]).amax(0)
    assert (change(policy, obs, delta) >= noise).all()


@gradient_attacks
def test_more_restarts_from_the_same_draws_are_no_weaker(attack):
    """The first of several starts are those of the few, so that the best can only grow."""
    policy = mlp()
    obs = torch.randn(1, 4).double()
    goals = {
        mad: lambda d: change(policy, obs, d),
        value_of: lambda d: -policy(obs + d).sum(-1),
        sarsa: lambda d: -q_of(obs, policy(obs + d)),
    }
    heights = [
        goals[attack](attack(policy, obs, 2.0, restarts=k, generator=seeded())).item()
        for k in (1, 2, 4, 8)
    ]
    assert heights == sorted(heights)


# --- properties -------------------------------------------------------------------------------


@every_attack
@PROPERTY
@given(
    norm=st.sampled_from(list(SIZES)),
    radius=st.floats(0, 10),
    batch=st.integers(1, 3),
    seed=st.integers(0, 2**31),
)
def test_delta_never_leaves_the_ball(attack, norm, radius, batch, seed):
    policy = mlp().float()
    obs = 10 * torch.randn(batch, 4, generator=seeded(seed))
    delta = attack(policy, obs, radius, norm, generator=seeded(seed))
    assert delta.shape == obs.shape
    assert delta.dtype == obs.dtype
    size = torch.linalg.vector_norm(delta.double(), ord=SIZES[norm], dim=-1)
    assert (size <= radius * (1 + 1e-6)).all()


@every_attack
@norms
def test_a_radius_of_0_gives_exactly_0(attack, norm):
    delta = attack(mlp(), torch.randn(3, 4).double(), 0, norm)
    assert torch.equal(delta, torch.zeros(3, 4).double())


@gradient_attacks
def test_each_state_has_a_delta_of_its_own(attack):
    """Other states change only what is drawn: without that, the same is found."""
    policy = mlp()
    obs = torch.randn(5, 4).double()
    together = attack(policy, obs, 0.01, restarts=1, steps=50, generator=seeded())
    others = torch.cat([obs[:2], 100 + obs[2:]])
    apart = attack(policy, others, 0.01, restarts=1, steps=50, generator=seeded())
    assert torch.equal(together[:2], apart[:2])
    assert not torch.equal(together[2:], apart[2:])


@every_attack
def test_a_generator_decides_and_the_global_one_is_left_alone(attack):
    policy = mlp()
    obs = torch.randn(3, 4).double()
    options = {} if attack is random else {"restarts": 1, "steps": 1}
    state = torch.get_rng_state()
    once, again = (attack(policy, obs, 0.1, "l2", generator=seeded(7), **options) for _ in "ab")
    other = attack(policy, obs, 0.1, "l2", generator=seeded(8), **options)
    fresh = [attack(policy, obs, 0.1, "l2", **options) for _ in "ab"]
    assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(once, again)
    assert not torch.equal(once, other)
    assert not torch.equal(*fresh)


@every_attack
def test_policy_buffers_and_gradients_stay(attack):
    policy = stochastic()
    policy(torch.randn(8, 4)).sum().backward()
    before = copy.deepcopy(policy.state_dict())
    gradients = [x.grad.clone() for x in policy.parameters()]
    attack(policy, torch.randn(8, 4), 0.1)
    assert policy.training
    assert all(module.training for module in policy)
    assert all(torch.equal(x, before[name]) for name, x in policy.state_dict().items())
    assert all(map(torch.equal, gradients, [x.grad for x in policy.parameters()]))
    assert all(x.requires_grad for x in policy.parameters())


def test_an_action_values_buffers_stay():
    q = nn.Sequential(nn.BatchNorm1d(4), nn.Linear(4, 1))
    before = copy.deepcopy(q.state_dict())
    robust_sarsa(nn.Identity(), torch.randn(8, 4), 0.1, action_value=lambda s, a: q(a))
    assert all(torch.equal(x, before[name]) for name, x in q.state_dict().items())


@every_attack
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_callers_without_gradients_get_the_same(attack, mode):
    policy = mlp()
    obs = torch.randn(3, 4).double()
    expected = attack(policy, obs, 0.1, generator=seeded())
    with mode():
        found = attack(policy, obs.clone(), 0.1, generator=seeded())
        assert torch.is_inference_mode_enabled() == (mode is torch.inference_mode)
        assert not torch.is_grad_enabled()
    assert torch.equal(found, expected)
    assert not found.requires_grad


def test_observations_graph_is_cut():
    obs = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert not mad(mlp(), obs, 0.1).requires_grad
    assert obs.grad is None


@gradient_attacks
def test_autocast_does_not_reach_the_policy(attack):
    policy = mlp().float()
    obs = torch.randn(3, 4)
    expected = attack(policy, obs, 0.1, generator=seeded())
    with torch.autocast("cpu", torch.bfloat16):
        found = attack(policy, obs, 0.1, generator=seeded())
    assert torch.equal(found, expected)


def test_dropout_does_not_count_as_sensitivity():
    """Of a policy that ignores its observations but for dropout, nothing changes."""
    seen = []

    class Dropped(nn.Module):
        def __init__(self):
            super().__init__()
            self.drop = nn.Dropout(0.5)

        def forward(self, x):
            seen.append(self.drop(torch.ones_like(x)).detach())
            return x * seen[-1]

    mad(Dropped(), torch.randn(2, 8), 0.1, restarts=3, steps=2)
    assert len(seen) == 4  # the clean states, two gradients, the last point
    assert all(torch.equal(x, seen[0]) for x in seen)
    assert 0 < (seen[0] == 0).double().mean() < 1


def test_a_dict_with_an_image_and_an_index():
    obs = {
        "image": torch.randint(0, 256, (2, 1, 4, 4), dtype=torch.uint8),
        "speed": torch.randn(2, 3),
        "goal": torch.tensor([0, 1]),
    }

    def policy(x):
        assert not x["goal"].is_floating_point()
        return x["image"].flatten(1).sum(-1, keepdim=True) / 255 + x["speed"].sum(-1, keepdim=True)

    delta = mad(policy, obs, 0.1, generator=seeded())
    assert delta["goal"] is None
    sign = delta["speed"][:, :1].sign()
    torch.testing.assert_close(delta["speed"] * sign, torch.full((2, 3), 0.1))
    image = delta["image"] * sign[..., None, None]
    torch.testing.assert_close(image, torch.full((2, 1, 4, 4), 0.1))  # in units of 255
    assert random(policy, obs, 0.1)["image"].abs().max() <= 0.1


# --- bad inputs -------------------------------------------------------------------------------


@every_attack
def test_bad_observations_and_balls_are_refused(attack):
    policy = mlp()
    obs = torch.randn(3, 4).double()
    with pytest.raises(ValueError, match="radius must be finite and at least 0, got -1"):
        attack(policy, obs, -1, "l2")
    with pytest.raises(ValueError, match="norm must be one of"):
        attack(policy, obs, 0.1, "l1")
    with pytest.raises(TypeError, match="obs must be a Tensor"):
        attack(policy, obs.numpy(), 0.1, "l2")
    with pytest.raises(ValueError, match="obs must be finite"):
        attack(policy, torch.full((2, 4), torch.nan), 0.1, "l2")


@gradient_attacks
@pytest.mark.parametrize("name", ["steps", "restarts"])
def test_counts_below_1_are_refused(attack, name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        attack(mlp(), torch.randn(3, 4).double(), 0.1, "l2", **{name: 0})


@gradient_attacks
@pytest.mark.parametrize("policy", [lambda x: mlp()(x.detach()), lambda x: x.detach()])
def test_a_policy_that_detaches_is_refused(attack, policy):
    with pytest.raises(ValueError, match="no gradient with respect to its observations"):
        attack(policy, torch.randn(3, 4).double(), 0.1, "l2")


@gradient_attacks
def test_outputs_that_are_not_finite_are_refused(attack):
    with pytest.raises(ValueError, match="output must be finite in the ball, got NaN"):
        attack(lambda x: x / 0, torch.randn(3, 4), 0.1, "l2")


def test_values_that_are_not_one_a_state_are_refused():
    obs = torch.randn(3, 4)
    with pytest.raises(ValueError, match=r"value must return one number for each state, got 4"):
        critic(lambda x: x, obs, 0.1)
    with pytest.raises(ValueError, match="action_value must return one number for each state"):
        robust_sarsa(lambda x: x, obs, 0.1, action_value=lambda s, a: a)


def test_unknown_selections_are_refused():
    obs = torch.randn(3, 4)
    with pytest.raises(ValueError, match="select must be one of"):
        mad(lambda x: x, obs, 0.1, select="mode")
    with pytest.raises(ValueError, match="select must be one of"):
        robust_sarsa(lambda x: x, obs, 0.1, action_value=q_of, select="mode")


def test_robust_sarsa_refuses_discrete_policies():
    with pytest.raises(TypeError, match="no mean for Categorical"):
        robust_sarsa(lambda x: td.Categorical(logits=x), torch.randn(3, 4), 0.1, action_value=q_of)
