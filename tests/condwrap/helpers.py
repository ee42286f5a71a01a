"""What several test files measure, and measure against."""

from __future__ import annotations

import torch
from torch import nn


def stochastic():
    """Batch norm and dropout, both in training mode, with statistics of some data."""
    net = nn.Sequential(
        nn.Linear(4, 16), nn.BatchNorm1d(16), nn.Tanh(), nn.Dropout(0.5), nn.Linear(16, 3)
    )
    for _ in range(5):
        net(torch.randn(32, 4))
    return net


def central_differences(policy, obs, step=1e-5):
    """[B, m, n] of a policy that maps a float64 tensor to one, states apart."""
    columns = []
    for k in range(obs[0].numel()):
        shift = torch.zeros(len(obs), obs[0].numel(), dtype=obs.dtype)
        shift[:, k] = step
        shift = shift.reshape(obs.shape)
        change = policy(obs + shift) - policy(obs - shift)
        columns.append(change.reshape(len(obs), -1) / (2 * step))
    return torch.stack(columns, -1).detach().numpy()
