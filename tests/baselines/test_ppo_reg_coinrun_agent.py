"""The agent of the CoinRun baseline: its networks, its dropout, and how it samples."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from baselines.ppo_reg_coinrun import Agent, Args, Learner, Residual, sample


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# --- acting --------------------------------------------------------------------------------------


class Logits(nn.Module):
    def __init__(self, logprobs) -> None:
        super().__init__()
        self.logprobs = logprobs

    def forward(self, frames):
        return self.logprobs.expand(len(frames), -1), torch.zeros(len(frames))


def test_sampled_actions_are_distributed_as_the_policy():
    logprobs = torch.randn(15, generator=seeded()).mul(1.5).log_softmax(-1)
    noise = torch.empty(200_000, 15).exponential_(generator=seeded(1))
    actions, taken, _ = sample(Logits(logprobs), torch.empty(200_000, 0), noise)
    assert torch.equal(taken, logprobs[actions])
    expected = 200_000 * logprobs.exp().double()
    chi_square = ((actions.bincount(minlength=15) - expected).square() / expected).sum()
    assert chi_square < 36.1  # 99.9% of a chi-square of 14 degrees of freedom


# --- networks ------------------------------------------------------------------------------------

NATURE = 3 * 32 * 64 + 32 + 32 * 64 * 16 + 64 + 64 * 64 * 9 + 64 + 1024 * 512 + 512


def impala_parameters(channels, side) -> int:
    convolutions = sum(
        9 * n_in * n + n + 4 * (9 * n * n + n)
        for n_in, n in zip((3, *channels), channels, strict=False)
    )
    return convolutions + channels[-1] * side**2 * 256 + 256


@pytest.mark.parametrize(
    ("network", "features", "count"),
    [
        ("nature", 512, NATURE),
        ("impala", 256, impala_parameters((16, 32, 32), 8)),
        ("impala_large", 256, impala_parameters((32, 64, 64, 64, 64), 2)),
    ],
)
def test_networks_have_the_papers_sizes(network, features, count):
    agent = Agent(Args(network=network), seeded())
    assert sum(p.numel() for p in agent.network.parameters()) == count
    assert sum(p.numel() for p in agent.parameters()) == count + (features + 1) * 16
    assert agent.mask.tolist() == [1.0] * features
    frames = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8, generator=seeded())
    logprobs, values = agent(frames)
    assert (logprobs.shape, values.shape) == ((5, 15), (5,))
    torch.testing.assert_close(logprobs.exp().sum(-1), torch.ones(5))
    # the policy begins nearly uniform, and the value near the rewards' size
    assert (logprobs.exp() - 1 / 15).abs().max() < 0.01
    assert values.abs().max() < 5
    assert torch.equal(agent.logprobs(frames), logprobs)


def test_a_residual_block_begins_as_the_identity():
    x = torch.randn(2, 8, 5, 5, generator=seeded())
    block = Residual(8, seeded())
    assert torch.equal(block(x), x)
    nn.init.ones_(block.body[3].bias)
    assert torch.equal(block(x), x + 1)


def test_weights_are_orthogonal_and_biases_0():
    agent = Agent(Args(), seeded())
    for name, p in agent.named_parameters():
        if name.endswith("bias"):
            assert not p.any()
    w = agent.policy.weight.double()
    torch.testing.assert_close(w @ w.T, 1e-4 * torch.eye(15).double(), atol=1e-8, rtol=1e-4)


def test_a_dropout_mask_is_for_all_states_and_only_while_training():
    args = Args(dropout=0.5)
    learner = Learner(args)
    agent, frames = learner.agent, torch.zeros(2, 3, 64, 64, dtype=torch.uint8)
    learner.draw_mask(args)
    assert set(agent.mask.tolist()) == {0.0, 2.0}
    assert 0.4 < (agent.mask == 0).float().mean() < 0.6
    first = agent.mask.clone()
    nn.init.ones_(agent.network[7].bias)  # hidden features of black frames are then 1
    nn.init.ones_(agent.value.weight)
    assert agent(frames)[1].tolist() == [first.sum().item()] * 2
    agent.eval()
    assert agent(frames)[1].tolist() == [512.0] * 2
    learner.draw_mask(args)
    assert not torch.equal(agent.mask, first)


def test_without_dropout_nothing_is_drawn_and_the_mask_is_1():
    args = Args()
    learner = Learner(args)
    before = learner.generators["dropout"].get_state()
    learner.draw_mask(args)
    assert torch.equal(learner.generators["dropout"].get_state(), before)
    assert learner.agent.mask.eq(1).all()
