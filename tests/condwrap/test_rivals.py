"""A flag chooses the penalty of a training loop, and each gets what it needs."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from torch import distributions as td
from torch import nn

from condwrap import ConditioningRegularizer
from condwrap.penalties import CAPS, L2C2, PENALTIES, JacobianNorm, LipschitzPolicy
from condwrap.rivals import RivalArgs

RIVALS = ("jacobian", "caps", "lcp", "l2c2", "sa", "spectral")


class Actor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.mean = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 2))

    def forward(self, obs: torch.Tensor) -> td.Distribution:
        return td.Independent(td.Normal(self.mean(obs), 0.5), 1)


@pytest.fixture
def data():
    """Four steps of two environments; the third step of the first ends an episode."""
    rng = torch.Generator().manual_seed(1)
    dones = torch.zeros(4, 2)
    dones[2, 0] = 1
    obs, after = torch.randn(2, 4, 2, 3, generator=rng)
    return SimpleNamespace(obs=obs, after=after, dones=dones)


def make_learner(args: RivalArgs) -> SimpleNamespace:
    return SimpleNamespace(
        actor=Actor(), critic=nn.Linear(3, 1), regularizer=args.make_penalty(seed=2)
    )


def penalize(args: RivalArgs, data) -> tuple[torch.Tensor, SimpleNamespace]:
    learner = make_learner(args)
    obs = data.obs.flatten(0, 1)
    actions = torch.ones(8, 2)
    drawn = args.draw(learner, data)
    assert {len(x) for x in drawn} == {8}  # a row for each state
    return args.penalize(learner, obs, actions, learner.actor(obs), drawn), learner


@pytest.mark.parametrize("name", ["conditioning", *RIVALS])
def test_every_penalty_reaches_the_actor(name, data):
    penalty, learner = penalize(RivalArgs(penalty=name, coefficient=0.1), data)
    penalty.backward()
    assert penalty.shape == ()
    found = [x.grad for x in learner.actor.parameters() if x.grad is not None]
    assert all(x.isfinite().all() for x in found)
    assert learner.actor.mean[0].weight.grad.abs().sum() > 0


@pytest.mark.parametrize("name", RIVALS)
def test_the_coefficient_weighs_it(name, data):
    one, _ = penalize(RivalArgs(penalty=name, coefficient=0.1), data)
    ten, _ = penalize(RivalArgs(penalty=name, coefficient=1.0), data)
    torch.testing.assert_close(ten, 10 * one)


def test_the_conditioning_penalty_is_the_regularizers(data):
    args = RivalArgs(coefficient=0.1, lambda_min=0.5)
    found, learner = penalize(args, data)
    expected = ConditioningRegularizer(0.1, lambda_min=0.5, seed=2)
    obs = data.obs.flatten(0, 1)
    assert found == expected(learner.actor, obs).penalty


def test_successors_are_those_of_each_state_and_ends_do_not_count(data):
    found, learner = penalize(RivalArgs(penalty="l2c2", coefficient=1.0), data)
    moved = data.after.clone()
    moved[2, 0] = 99.0  # what would follow an end
    data.after = moved
    assert penalize(RivalArgs(penalty="l2c2", coefficient=1.0), data)[0] == found

    expected = L2C2(1.0, seed=2)(
        learner.actor,
        data.obs.flatten(0, 1),
        next_obs=data.after.flatten(0, 1),
        dones=data.dones.flatten(),
    )
    assert found == expected.penalty


def test_each_is_made_with_its_weights():
    make = {name: RivalArgs(penalty=name, coefficient=0.5).make_penalty(0) for name in RIVALS}
    assert isinstance(make["caps"], CAPS)
    assert (make["caps"].temporal, make["caps"].spatial) == (0.1, 0.5)  # as in its paper
    assert isinstance(make["lcp"], LipschitzPolicy)
    assert isinstance(make["jacobian"], JacobianNorm)
    for name in set(RIVALS) - {"caps"}:
        assert make[name].coefficient == 0.5
        assert type(make[name]) is PENALTIES[name]


def test_the_share_of_the_gradient_is_of_the_conditioning_penalty_only():
    assert RivalArgs(coefficient=0.1).make_probe(0).own.coefficient == 0.1
    assert RivalArgs(penalty="sa", coefficient=0.1).make_probe(0).own.coefficient == 0.0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"penalty": "no"}, "penalty must be one of conditioning, jacobian, .*, got no"),
        ({"penalty": "sa", "printed_sign": True}, "printed_sign is of the conditioning penalty"),
        ({"coefficient": -1.0}, "coefficient must be finite and at least 0"),
    ],
)
def test_bad_settings_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        RivalArgs(**changed).check_conditioning()
    RivalArgs(printed_sign=True).check_conditioning()


def test_a_rival_is_not_compiled():
    @dataclasses.dataclass(frozen=True)
    class Args(RivalArgs):
        compile: bool = True

    Args().check_conditioning()
    with pytest.raises(ValueError, match="compile must be False with the penalty sa"):
        Args(penalty="sa").check_conditioning()
