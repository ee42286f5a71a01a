"""What the penalty costs: forward and backward of a policy with it, beside the same without.

Groups are one network and batch size each, so that ratios are read off one run.
"""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.func import functional_call, jacrev, vmap

from condwrap import ConditioningRegularizer, clamping_penalty

OBS, ACTIONS = 44, 17  # Humanoid's


@pytest.fixture(params=[64, 2048], ids="B={}".format)
def setting(request):
    torch.set_num_threads(1)
    policy = nn.Sequential(
        nn.Linear(OBS, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, ACTIONS)
    )
    obs = torch.randn(request.param, OBS, generator=torch.Generator().manual_seed(0))
    return policy, obs, f"forward and backward, MLP {OBS}-64-64-{ACTIONS}, B={request.param}"


def no_penalty(policy, obs):
    return 0.0


def difference(policy, obs, regularizer=ConditioningRegularizer()):  # noqa: B008
    return regularizer(policy, obs).penalty


def jvp(policy, obs, regularizer=ConditioningRegularizer(estimator="jvp")):  # noqa: B008
    return regularizer(policy, obs).penalty


def quarter(policy, obs, regularizer=ConditioningRegularizer(fraction=0.25)):  # noqa: B008
    return regularizer(policy, obs).penalty


def exact_svd(policy, obs):
    """The clamping penalty on the exact singular values of each state's Jacobian."""
    parameters = dict(policy.named_parameters())
    jacobian = vmap(jacrev(lambda x: functional_call(policy, parameters, (x,))))(obs)
    return clamping_penalty(torch.linalg.svdvals(jacobian)).mean()


@pytest.mark.parametrize("penalty", [no_penalty, difference, jvp, quarter, exact_svd])
def test_penalty(benchmark, setting, penalty):
    policy, obs, benchmark.group = setting

    def step():
        policy.zero_grad()
        (policy(obs).square().mean() + penalty(policy, obs)).backward()

    benchmark(step)
    assert all(p.grad.isfinite().all() for p in policy.parameters())
