"""What a training loop logs of its policy: worked out by hand, and free of side effects."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal

from condwrap import ConditioningRegularizer
from condwrap.probe import ConditioningProbe

YARDSTICK = [
    "psi",
    "quotient_q05",
    "quotient_q50",
    "quotient_q95",
    "quotient_squared",
    "fraction_below",
    "fraction_above",
]
SPECTRUM = [
    "singular_value_max",
    "singular_value_mean",
    "frobenius_squared_per_input",
    "condition_number",
]


class Slopes(nn.Module):
    """One observed number and one action, with a slope of its own in each state.

    The state's sign and size choose it, so J is known: 0.5, 3 or 30, whatever delta of length 1.
    """

    def __init__(self, slopes: list[float]) -> None:
        super().__init__()
        self.slopes = torch.tensor(slopes)

    def forward(self, obs):
        place = (obs / 100).round()  # states are 100 apart, and delta has length 1
        return self.slopes[place.long()] * (obs - 100 * place)


def states(n: int) -> torch.Tensor:
    return 100.0 * torch.arange(n)[:, None]


def probe(own: ConditioningRegularizer | None = None, **settings) -> ConditioningProbe:
    own_is_paper = own is None
    own = own or ConditioningRegularizer(coefficient=1e-3)
    return ConditioningProbe(own, own_is_paper=own_is_paper, seed=0, **settings)


def linear(*rows: list[float]) -> nn.Linear:
    layer = nn.Linear(len(rows[0]), len(rows), bias=False)
    layer.weight.data = torch.tensor(rows)
    return layer


def test_the_yardstick_by_hand():
    """J of 0.5, 3, 3 and 30: psi of 0.25, 0, 0 and 100, one below the range and one above."""
    policy = Slopes([0.5, 3.0, 3.0, 30.0])
    got = probe().measure(1, policy, states(4))
    assert got["conditioning/psi"] == pytest.approx(100.25 / 4)
    assert got["conditioning/quotient_q50"] == pytest.approx(3.0)
    # between the first two and the last two of four sorted values, at 0.15 and 2.85
    assert got["conditioning/quotient_q05"] == pytest.approx(0.5 + 0.15 * 2.5)
    assert got["conditioning/quotient_q95"] == pytest.approx(3.0 + 0.85 * 27.0)
    assert got["conditioning/quotient_squared"] == pytest.approx((0.25 + 9 + 9 + 900) / 4)
    assert got["conditioning/fraction_below"] == 0.25
    assert got["conditioning/fraction_above"] == 0.25


@pytest.mark.parametrize(
    ("lambda_min", "lambda_max", "psi", "below", "above"),
    [(0.0, 2.0, (0 + 1 + 1 + 28**2) / 4, 0.0, 0.75), (4.0, 40.0, (12.25 + 1 + 1) / 4, 0.75, 0.0)],
)
def test_own_settings_stand_beside_the_yardstick(lambda_min, lambda_max, psi, below, above):
    own = ConditioningRegularizer(1e-3, lambda_min, lambda_max)
    got = probe(own).measure(1, Slopes([0.5, 3.0, 3.0, 30.0]), states(4))
    assert got["conditioning/own_psi"] == pytest.approx(psi)
    assert got["conditioning/own_fraction_below"] == below
    assert got["conditioning/own_fraction_above"] == above
    assert got["conditioning/psi"] == pytest.approx(100.25 / 4)


def test_the_yardstick_does_not_depend_on_the_own_settings():
    policy, obs = nn.Linear(5, 2), torch.randn(30, 5)
    own = ConditioningRegularizer(
        1.0, 0.0, 3.0, reduction="batch", perturbation="gaussian", radius=7.0
    )
    plain = probe().measure(1, policy, obs)
    other = probe(own).measure(1, policy, obs)
    for name in YARDSTICK:
        assert other[f"conditioning/{name}"] == plain[f"conditioning/{name}"]
    assert other["conditioning/own_psi"] != plain["conditioning/own_psi"]


def test_paper_settings_are_not_measured_twice():
    calls = []

    def policy(obs):
        calls.append(obs)
        return obs * 2

    got = probe().measure(1, policy, torch.randn(6, 3))
    assert len(calls) == 2
    for name in YARDSTICK:
        assert got[f"conditioning/own_{name}"] == got[f"conditioning/{name}"]


def test_the_executed_action_is_clipped():
    """Actions of 0, 15 and -15 in a box of ±1: the executed one moves in the first state alone."""
    obs = torch.tensor([[0.0], [30.0], [-30.0]])
    policy = linear([0.5])
    got = probe(action_bounds=([-1.0], [1.0])).measure(1, policy, obs)
    assert got["conditioning/quotient_q50"] == pytest.approx(0.5, rel=1e-5)
    assert got["conditioning/quotient_executed"] == 0.0
    wide = probe(action_bounds=([-100.0], [100.0])).measure(1, policy, obs)
    assert wide["conditioning/quotient_executed"] == pytest.approx(0.5, rel=1e-5)


def test_both_quotients_are_of_one_delta():
    """Where nothing is clipped, the executed action moves exactly as the policy's output does."""
    policy, obs = nn.Linear(4, 2), torch.randn(9, 4)
    got = probe(action_bounds=([-100.0] * 2, [100.0] * 2)).measure(1, policy, obs)
    assert got["conditioning/quotient_executed"] == got["conditioning/quotient_q50"]


def test_each_action_has_its_own_bounds():
    class Gaussian(nn.Module):
        def __init__(self):
            super().__init__()
            self.mean = linear([3.0], [4.0])

        def forward(self, obs):
            return Independent(Normal(self.mean(obs), 1.0), 1)

    bounds = ([-100.0, -0.5], [100.0, -0.5])  # the second action is held
    got = probe(action_bounds=bounds).measure(1, Gaussian(), torch.zeros(3, 1))
    assert got["conditioning/quotient_q50"] == pytest.approx(5.0)
    assert got["conditioning/quotient_executed"] == pytest.approx(3.0)


def test_singular_values_by_hand_and_only_when_due():
    policy = linear([3.0, 0.0, 0.0], [0.0, 0.0, 2.0])
    measured = probe(log_spectrum=4)
    got = measured.measure(8, policy, torch.randn(5, 3))
    expected = [3.0, 2.5, 13 / 3, 1.5]
    assert [got[f"conditioning/{name}"] for name in SPECTRUM] == pytest.approx(expected)
    between = measured.measure(9, policy, torch.randn(5, 3))
    assert all(math.isnan(between[f"conditioning/{name}"]) for name in SPECTRUM)
    assert got.keys() == between.keys()


def test_three_singular_values_of_a_single_state_by_hand():
    policy = linear([4.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    got = probe(log_spectrum=1).measure(1, policy, torch.ones(1, 4))
    expected = [4.0, 7 / 3, 21 / 4, 4.0]
    assert [got[f"conditioning/{name}"] for name in SPECTRUM] == pytest.approx(expected)


def test_the_median_of_the_condition_numbers_is_logged():
    """Condition numbers of 2, 3 and 100: a mean would be 35."""

    def policy(obs):
        second = torch.tensor([2.0, 3.0, 100.0])[obs[:, 0].detach().long()]
        return torch.stack([obs[:, 0], obs[:, 1] * second], -1)

    obs = torch.tensor([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]])
    got = probe(log_spectrum=1).measure(1, policy, obs)
    assert got["conditioning/condition_number"] == pytest.approx(3.0, rel=1e-5)
    assert got["conditioning/singular_value_max"] == pytest.approx(35.0, rel=1e-5)


def test_the_yardstick_draws_from_the_probes_seed():
    policy, obs = nn.Linear(4, 2), torch.randn(9, 4)
    got = probe_of_seed(5).measure(1, policy, obs)
    expected = ConditioningRegularizer(coefficient=0.0, seed=5)(policy, obs).metrics()
    assert {name: got[name] for name in expected} == expected
    assert got != probe_of_seed(6).measure(1, policy, obs)


def probe_of_seed(seed: int) -> ConditioningProbe:
    return ConditioningProbe(ConditioningRegularizer(), own_is_paper=True, seed=seed)


def test_mean_squared_quotient_tends_to_the_frobenius_norm_per_input():
    policy, obs = nn.Linear(4, 3), torch.randn(20_000, 4)
    got = probe(log_spectrum=1).measure(1, policy, obs)
    expected = policy.weight.square().sum().item() / 4
    assert got["conditioning/frobenius_squared_per_input"] == pytest.approx(expected, rel=1e-5)
    assert got["conditioning/quotient_squared"] == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("fraction", "expected"), [(1.0, 30.0), (0.5, 5.0)])
def test_a_fraction_takes_evenly_spaced_states(fraction, expected):
    policy = Slopes([2.0, 30.0, 5.0, 30.0, 8.0, 30.0])
    got = probe(fraction=fraction).measure(1, policy, states(6))
    # all: 2, 5, 8, 30, 30, 30; half: 2, 5, 8
    median = got["conditioning/quotient_q50"]
    assert median == pytest.approx((8 + 30) / 2 if fraction == 1.0 else expected)


# --- the gradient share --------------------------------------------------------------------------


def test_the_gradient_share_by_hand():
    """pi(s) = w s with w = 3 and no state at risk: psi = (J - 2)², J = |w|, so 2c(|w| - 2)."""
    policy = linear([3.0])
    own = ConditioningRegularizer(coefficient=0.5, lambda_min=0.0, lambda_max=2.0)
    got = probe(own).gradient_share(
        25, policy, torch.randn(8, 1), lambda: 10 * policy.weight.square().sum()
    )
    assert got == {"conditioning/gradient_share": pytest.approx(0.5 * 2 * 1 / (10 * 2 * 3))}


def test_the_gradient_share_counts_the_parameters_that_it_is_given():
    policy = linear([3.0])
    scale = torch.tensor([2.0], requires_grad=True)
    own = ConditioningRegularizer(coefficient=1.0, lambda_min=0.0, lambda_max=2.0)
    got = probe(own).gradient_share(
        0, policy, torch.randn(8, 1), lambda: 4 * scale.sum(), [policy.weight, scale]
    )
    assert got == {"conditioning/gradient_share": pytest.approx(2 / 4)}


@pytest.mark.parametrize("update", [1, 24, 26, 49])
def test_the_share_is_nan_when_it_is_not_due(update):
    def never():
        raise AssertionError("the loss was computed although the share was not due")

    got = probe().gradient_share(update, nn.Linear(2, 2), torch.ones(3, 2), never)
    assert math.isnan(got["conditioning/gradient_share"])


def test_the_share_is_0_without_a_penalty():
    own = ConditioningRegularizer(coefficient=0.0)
    got = probe(own).gradient_share(50, nn.Linear(2, 2), torch.ones(3, 2), lambda: None)
    assert got == {"conditioning/gradient_share": 0.0}


def test_the_share_of_the_printed_sign_is_positive_too():
    policy = linear([3.0])
    shares = [
        probe(ConditioningRegularizer(1.0, 0.0, 2.0, printed_sign=sign)).gradient_share(
            25, policy, torch.ones(4, 1), lambda: policy.weight.sum()
        )
        for sign in (False, True)
    ]
    assert shares[0] == shares[1] == {"conditioning/gradient_share": pytest.approx(2.0)}


# --- no side effects -----------------------------------------------------------------------------


def test_measuring_leaves_gradients_and_global_noise_alone():
    policy, obs = nn.Linear(4, 2), torch.randn(9, 4)
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    measured = probe(ConditioningRegularizer(0.5, 0.0, 0.1), log_spectrum=1)
    measured.measure(1, policy, obs)
    measured.gradient_share(25, policy, obs, lambda: policy(obs).square().mean())
    assert torch.equal(torch.rand(2), expected)
    assert policy.weight.grad is None


def test_a_restored_probe_measures_the_same():
    policy, obs = nn.Linear(4, 2), torch.randn(9, 4)
    own = ConditioningRegularizer(lambda_min=0.3)
    first = probe(own)
    first.measure(1, policy, obs)
    state = first.state_dict()
    expected = first.measure(2, policy, obs)
    second = probe(ConditioningRegularizer(lambda_min=0.3))
    for _ in range(3):  # neither of its streams stands where the first one's did
        second.measure(1, policy, obs)
    assert second.measure(2, policy, obs) != expected
    second.load_state_dict(state)
    assert second.measure(2, policy, obs) == expected
