"""Small policies in float64, and a comparison of a penalty's gradient with finite differences."""

import torch
from torch import distributions as td
from torch import nn
from torch.func import functional_call


def linear(rows, dtype=torch.float64):
    """x -> W x, the rows of W as given."""
    layer = nn.Linear(len(rows[0]), len(rows), bias=False, dtype=dtype)
    layer.weight.data = torch.tensor(rows, dtype=dtype)
    return layer


def mlp(n=3, m=2):
    net = nn.Sequential(nn.Linear(n, 5), nn.Tanh(), nn.Linear(5, m))
    return net.double()


class Gaussian(nn.Module):
    """Normal(mean(obs), exp(log_std)), as the baselines' actor is."""

    def __init__(self, mean, log_std):
        super().__init__()
        self.mean = mean
        self.log_std = nn.Parameter(torch.tensor(log_std, dtype=torch.float64))

    def forward(self, obs):
        mean = self.mean(obs)
        return td.Independent(td.Normal(mean, self.log_std.exp().expand_as(mean)), 1)


class Discrete(nn.Module):
    def __init__(self, logits):
        super().__init__()
        self.logits = logits

    def forward(self, obs):
        return td.Categorical(logits=self.logits(obs))


def gradcheck(module, penalize):
    """Compare d penalty / d weights with central differences; `penalize` draws anew each time.

    penalize: policy -> result of a penalty that was made inside, so that it draws the same noise.
    """
    names = [name for name, _ in module.named_parameters()]
    weights = tuple(p.detach().clone().requires_grad_() for p in module.parameters())

    def penalty(*given):
        parameters = dict(zip(names, given, strict=True))
        return penalize(lambda obs: functional_call(module, parameters, (obs,))).penalty

    assert penalty(*weights) > 0  # a constant would agree with anything
    return torch.autograd.gradcheck(penalty, weights, eps=1e-6, atol=1e-7, rtol=1e-4)
