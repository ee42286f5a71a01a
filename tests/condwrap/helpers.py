"""Policies that several test files measure."""

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
