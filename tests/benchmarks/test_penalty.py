"""What the penalty costs: forward and backward of a policy with it, beside the same without.

Groups are one network and batch size each, so that ratios are read off one run.
"""

from __future__ import annotations

import os

import pytest
import torch
from torch import nn
from torch.func import functional_call, jacrev, vmap

from baselines import ppo_reg_coinrun
from condwrap import ConditioningRegularizer, clamping_penalty

OBS, ACTIONS = 44, 17  # Humanoid's


def mlp() -> tuple[nn.Module, tuple[int, ...]]:
    sizes = nn.Linear(OBS, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, ACTIONS)
    return nn.Sequential(*sizes), (OBS,)


def impala() -> tuple[nn.Module, tuple[int, ...]]:
    args = ppo_reg_coinrun.Args(network="impala")
    agent = ppo_reg_coinrun.Agent(args, torch.Generator().manual_seed(0))
    return nn.Sequential(agent.network, agent.policy), (3, 64, 64)


MEMORY = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30  # GiB
SETTINGS = [
    (mlp, 64),
    (mlp, 2048),
    (impala, 64),
    pytest.param((impala, 2048), marks=pytest.mark.slow),
]


@pytest.fixture(params=SETTINGS, ids=["mlp-64", "mlp-2048", "impala-64", "impala-2048"])
def setting(request):
    torch.set_num_threads(1)
    make, batch = request.param
    if make is impala and batch > 64 and MEMORY < 12:
        pytest.skip("takes up to 9 GiB")
    policy, shape = make()
    obs = torch.randn(batch, *shape, generator=torch.Generator().manual_seed(0))
    return policy, obs, f"forward and backward with a penalty, {make.__name__}, B={batch}"


def no_penalty(policy, obs, output):
    return 0.0


def difference(policy, obs, output, regularizer=ConditioningRegularizer()):  # noqa: B008
    return regularizer(policy, obs).penalty


def jvp(policy, obs, output, regularizer=ConditioningRegularizer(estimator="jvp")):  # noqa: B008
    return regularizer(policy, obs).penalty


def quarter(policy, obs, output, regularizer=ConditioningRegularizer(fraction=0.25)):  # noqa: B008
    return regularizer(policy, obs).penalty


def with_answer(policy, obs, output, regularizer=ConditioningRegularizer()):  # noqa: B008
    return regularizer(policy, obs, output=output).penalty


def jacobian_regularization(policy, obs, output):
    """Hoffman et al. (2019, arXiv 1908.02729): ‖v · Jacobian‖² for a random unit v, by autograd."""
    obs = obs.clone().requires_grad_()
    output = policy(obs)
    v = torch.randn_like(output)
    v = v / v.norm(dim=1, keepdim=True)
    (gradient,) = torch.autograd.grad(output, obs, v, create_graph=True)
    return output.shape[1] * gradient.square().sum() / len(obs) / 2


def exact_svd(policy, obs, output):
    """The clamping penalty on the exact singular values of each state's Jacobian."""
    parameters = dict(policy.named_parameters())
    jacobian = vmap(jacrev(lambda x: functional_call(policy, parameters, (x,))))(obs)
    return clamping_penalty(torch.linalg.svdvals(jacobian)).mean()


def step(policy, obs, penalty):
    """Forward and backward of a loss with the penalty."""
    policy.zero_grad()
    output = policy(obs)  # the loss's own
    (output.square().mean() + penalty(policy, obs, output)).backward()


PENALTIES = [no_penalty, difference, with_answer, jvp, quarter, jacobian_regularization, exact_svd]


@pytest.mark.parametrize("penalty", PENALTIES)
def test_penalty(benchmark, setting, penalty):
    policy, obs, benchmark.group = setting
    if penalty is exact_svd and obs.ndim > 2:
        pytest.skip("the Jacobian of images is too large to hold")
    benchmark.extra_info["peer"] = penalty is no_penalty

    if obs.nelement() > 1e7:  # seconds each
        benchmark.pedantic(step, (policy, obs, penalty), rounds=2)
    else:
        benchmark(step, policy, obs, penalty)
    assert all(p.grad.isfinite().all() for p in policy.parameters())
