"""The summary of a policy: values worked out by hand, and what is shown of them."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import nn

from condwrap import ConditioningRegularizer, summary
from condwrap.observation import States
from condwrap.sensitivity import name_values
from condwrap.summary import SHOWN


def linear(matrix) -> nn.Module:
    weight = torch.as_tensor(matrix, dtype=torch.float32)
    policy = nn.Linear(weight.shape[1], weight.shape[0], bias=False)
    policy.weight.data = weight
    return policy


WIDE = linear([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])


def test_by_hand():
    found = summary(WIDE, torch.ones(8, 3))
    assert (found.states, found.inputs, found.outputs) == (8, 3, 2)
    assert found.largest == pytest.approx(3.0)
    assert found.smallest == pytest.approx(2.0)
    assert found.condition_number == pytest.approx(1.5)
    assert found.root_mean_square == pytest.approx(math.sqrt((9 + 4) / 2))
    assert [name for name, _ in found.most_sensitive] == ["[0]", "[2]"]
    assert [x for _, x in found.most_sensitive] == pytest.approx([3.0, 2.0])
    assert found.inert == ("[1]",)
    assert found.exact


def test_quotient_and_psi_are_the_regularizers():
    found = summary(linear([[0.5]]), torch.ones(8, 1))
    assert found.quotient == pytest.approx((0.5, 0.5, 0.5))
    assert found.psi == pytest.approx(0.25)
    assert (found.fraction_below, found.fraction_above) == (1.0, 0.0)

    narrow = ConditioningRegularizer(lambda_min=0.1, lambda_max=0.4)
    found = summary(linear([[0.5]]), torch.ones(8, 1), narrow)
    assert (found.lambda_min, found.lambda_max) == (0.1, 0.4)
    assert found.psi == pytest.approx(0.01)
    assert (found.fraction_below, found.fraction_above) == (0.0, 1.0)


def test_the_suggested_range_leaves_out_a_tenth_of_the_states():
    """pi(s) = s³ with δ of length 1e-3 either way: J = 3 s² within 1e-3."""
    obs = torch.linspace(0.5, 1.5, 201)[:, None]
    regularizer = ConditioningRegularizer(radius=1e-3)
    found = summary(lambda s: s**3, obs.double(), regularizer)
    assert found.suggested_range == pytest.approx((3 * 0.55**2, 3 * 1.45**2), abs=0.01)


def test_the_coefficient_by_hand():
    """Loss 3 w, psi (w - 1)²: gradients 3 and -1 at w = 0.5, so 10% of the loss's is 0.3."""
    policy = linear([[0.5]])
    obs = torch.ones(8, 1)
    loss = 3 * policy(obs).mean()
    assert summary(policy, obs, loss=loss).coefficient == pytest.approx(0.3)
    assert summary(policy, obs, loss=loss, share=0.5).coefficient == pytest.approx(1.5)
    assert summary(policy, obs).coefficient is None
    loss.backward()  # its graph is kept
    assert policy.weight.grad.item() == pytest.approx(3.0)


def test_where_psi_does_not_act_there_is_no_coefficient():
    policy = linear([[2.0]])
    obs = torch.ones(8, 1)
    assert summary(policy, obs, loss=policy(obs).mean()).coefficient is None


def test_many_outputs_are_estimated_and_the_table_says_so():
    diagonal = torch.linspace(0.0, 1.0, 100)
    found = summary(lambda x: x * diagonal, torch.ones(4, 100))
    assert not found.exact
    assert found.largest == pytest.approx(1.0, rel=1e-4)
    assert found.root_mean_square == pytest.approx(diagonal.square().mean().sqrt().item(), rel=1e-5)
    assert math.isnan(found.smallest)
    assert found.inert == ("[0]",)
    assert "(estimated)" in str(found)
    assert "condition number" not in str(found)
    assert "smallest" not in str(found)


def test_estimates_of_a_network_are_near_the_exact_ones(monkeypatch):
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(6, 32), nn.Tanh(), nn.Linear(32, 8))
    obs = torch.randn(64, 6)
    exact = summary(net, obs)
    monkeypatch.setattr("condwrap.sensitivity.EXACT_OUTPUTS", 0)
    found = summary(net, obs)
    assert found.largest == pytest.approx(exact.largest, rel=1e-4)
    assert found.root_mean_square == pytest.approx(exact.root_mean_square, rel=0.05)
    assert dict(found.most_sensitive) == pytest.approx(dict(exact.most_sensitive), rel=0.1)


def test_names_of_observed_values():
    obs = {"image": torch.zeros(2, 1, 2, 2), "mask": torch.ones(2, 3, dtype=torch.bool)}
    obs["speed"] = torch.zeros(2, 2)
    names = name_values(States.read(obs, None, 1))
    image = [f"['image'][0, {i}, {j}]" for i in range(2) for j in range(2)]
    assert names == [*image, "['speed'][0]", "['speed'][1]"]
    assert name_values(States.read(torch.zeros(2, 2), None, 1)) == ["[0]", "[1]"]


def test_images_keep_their_kind():
    def policy(obs):
        assert obs.dtype == torch.float32
        return obs.flatten(1)[:, :2] / 255

    obs = torch.randint(0, 255, (4, 1, 2, 2), dtype=torch.uint8)
    found = summary(policy, obs)
    assert found.largest == pytest.approx(1.0)  # in units of 255
    assert found.inert == ("[0, 1, 0]", "[0, 1, 1]")


def test_at_most_so_many_states_are_measured():
    seen = []

    def policy(obs):
        seen.append(len(obs))
        return obs

    assert summary(policy, torch.randn(100, 3), max_states=7).states == 7
    assert set(seen) == {7}
    assert summary(policy, torch.randn(5, 3), max_states=7).states == 5


def test_nothing_is_changed():
    torch.manual_seed(0)
    policy = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Dropout(0.5), nn.Linear(8, 2))
    before = {name: x.clone() for name, x in policy.state_dict().items()}
    regularizer = ConditioningRegularizer(coefficient=0.0, seed=3)
    drawn = regularizer.generator.get_state()
    state = torch.get_rng_state()
    summary(policy, torch.randn(16, 4, generator=torch.Generator().manual_seed(1)), regularizer)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(regularizer.generator.get_state(), drawn)
    assert regularizer.coefficient == 0.0
    assert policy.training
    for name, x in policy.state_dict().items():
        assert torch.equal(x, before[name])


# --- what is shown -------------------------------------------------------------------------------


def test_the_table():
    policy = linear([[0.5]])
    obs = torch.ones(8, 1)
    lines = str(summary(policy, obs, loss=3 * policy(obs).mean())).splitlines()
    assert lines == [
        "Conditioning on 8 states: 1 observed values, 1 outputs",
        "J                  5% 0.5   median 0.5   95% 0.5",
        "psi for [1, 20]    0.25; 100% of the states below, 0% above",
        "singular values    largest 0.5   root mean square 0.5   smallest 0.5",
        "condition number   1",
        "most sensitive to  [0] 0.5",
        "suggested range    [0.5, 0.5]",
        "coefficient        0.3 gives the penalty 10% of the loss's gradient",
    ]


def test_long_lists_are_cut():
    found = summary(lambda x: x[:, :1], torch.ones(4, 20))
    assert len(found.inert) == 19
    assert "[1], [2], [3], [4], [5] and 14 more" in str(found)
    assert len(summary(lambda x: x, torch.ones(4, 20)).most_sensitive) == SHOWN


def test_a_notebook_shows_a_table_and_escapes_keys():
    found = summary(lambda obs: obs["<b>"], {"<b>": torch.ones(4, 1)})
    shown = found._repr_html_()
    assert shown.startswith("<table>")
    assert "[&#x27;&lt;b&gt;&#x27;][0] 1" in shown
    assert "<b>" not in shown


def test_a_logger_gets_numbers():
    policy = linear([[0.5]])
    obs = torch.ones(8, 1)
    found = summary(policy, obs, loss=3 * policy(obs).mean()).to_dict()
    assert found["summary/psi"] == pytest.approx(0.25)
    assert found["summary/coefficient"] == pytest.approx(0.3)
    assert all(type(value) is float for value in found.values())
    assert "coefficient" not in summary(policy, obs).to_dict(prefix="")


# --- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"share": 0.0}, "share must be above 0, got 0.0"),
        ({"share": math.nan}, "share must be above 0, got nan"),
        ({"max_states": 0}, "max_states must be at least 1, got 0"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        summary(WIDE, torch.ones(8, 3), **options)


def test_a_loss_of_other_parameters_is_refused():
    loss = torch.ones((), requires_grad=True) * 2
    with pytest.raises(ValueError, match="loss must depend on the policy's parameters"):
        summary(WIDE, torch.ones(8, 3), loss=loss)


def test_it_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        summary(WIDE, torch.ones(8, 3)).psi = 0.0
