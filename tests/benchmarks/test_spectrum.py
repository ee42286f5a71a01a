"""What the Jacobian's singular values cost, exactly and matrix-free, without gradients.

The peer is what one would write with PyTorch alone. Groups are one network and batch each; a run's
log takes 2,000 states of an MLP.
"""

from __future__ import annotations

import pytest
import torch
from torch.func import jacrev, vmap

from condwrap import spectrum
from tests.benchmarks.test_penalty import impala, mlp


def jacrev_and_svdvals(policy, obs):
    return torch.linalg.svdvals(vmap(jacrev(lambda x: policy(x[None])[0]))(obs).flatten(2))


METHODS = [
    jacrev_and_svdvals,
    spectrum.jacobian_singular_values,
    spectrum.mean_squared_singular_value,
    spectrum.largest_singular_value,
    spectrum.squared_frobenius_norm,
]
SETTINGS = [(mlp, 64), (mlp, 2000), pytest.param((impala, 16), marks=pytest.mark.slow)]


@pytest.mark.parametrize("setting", SETTINGS, ids=["mlp-64", "mlp-2000", "impala-16"])
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__name__)
def test_spectrum(benchmark, setting, method):
    torch.set_num_threads(1)
    make, batch = setting
    policy, shape = make()
    obs = torch.randn(batch, *shape, generator=torch.Generator().manual_seed(0))
    benchmark.group = f"singular values, {make.__name__}, B={batch}"
    benchmark.extra_info["peer"] = method is jacrev_and_svdvals
    with torch.no_grad():
        if make is impala:  # seconds each
            values = benchmark.pedantic(method, (policy, obs), rounds=2)
        else:
            values = benchmark(method, policy, obs)
    assert values.isfinite().all()
