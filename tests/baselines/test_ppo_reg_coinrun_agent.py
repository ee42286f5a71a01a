"""The agent of the CoinRun baseline: its networks, its dropout, and how it samples."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from baselines.ppo_reg_coinrun import Agent, Args, Dropout, Learner, Residual, sample


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
    frames = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8, generator=seeded())
    logprobs, values = agent(frames)
    assert (logprobs.shape, values.shape) == ((5, 15), (5,))
    torch.testing.assert_close(logprobs.exp().sum(-1), torch.ones(5))
    # the policy begins nearly uniform, and the value near the rewards' size
    assert (logprobs.exp() - 1 / 15).abs().max() < 0.01
    assert values.abs().max() < 5
    assert torch.equal(agent.logprobs(frames), logprobs)


def frames_of(seed: int, count: int = 2) -> torch.Tensor:
    return torch.randint(0, 256, (count, 3, 64, 64), dtype=torch.uint8, generator=seeded(seed))


@pytest.mark.parametrize("network", ["nature", "impala"])
def test_weights_are_orthogonal_and_biases_0(network):
    agent = Agent(Args(network=network), seeded())
    gains = {agent.policy: 0.01, agent.value: 1.0}
    gains.update({m.body[4]: 0.0 for m in agent.modules() if isinstance(m, Residual)})
    layers = [m for m in agent.modules() if isinstance(m, nn.Conv2d | nn.Linear)]
    assert len(layers) == {"nature": 6, "impala": 18}[network]
    for layer in layers:
        values = torch.linalg.svdvals(layer.weight.flatten(1))
        gain = gains.get(layer, 2**0.5)
        torch.testing.assert_close(values, torch.full_like(values, gain), atol=1e-5, rtol=1e-4)
        assert not layer.bias.any()


def test_a_residual_block_begins_as_the_identity():
    agent = Agent(Args(network="impala"), seeded())
    block = next(m for m in agent.modules() if isinstance(m, Residual))
    x = torch.randn(2, 16, 32, 32, generator=seeded())
    assert torch.equal(block(x), x)
    nn.init.ones_(block.body[4].bias)
    assert torch.equal(block(x), x + 1)


def test_a_residual_block_by_hand():
    """One channel of one pixel: x + c2 · relu(c1 · relu(x) + b1) + b2 by the kernels' centers."""
    block = Residual(Args(), 1, 1)
    for conv, weight, bias in ((block.body[1], 3.0, -2.0), (block.body[4], 0.5, 0.25)):
        nn.init.constant_(conv.weight, weight)
        nn.init.constant_(conv.bias, bias)
    x = torch.tensor([-1.0, 0.5, 2.0]).view(3, 1, 1, 1)
    # relu(x) = 0, 0.5, 2; relu(3 · that - 2) = 0, 0, 4; half of that and 0.25 are added
    assert block(x).flatten().tolist() == [-0.75, 0.75, 4.25]


def test_impala_pools_windows_of_3_that_overlap():
    """Windows are centered on even rows and columns, so that four of them see pixel (1, 1)."""
    pool = Agent(Args(network="impala"), seeded()).network[2]
    x = torch.zeros(1, 1, 8, 8)
    x[0, 0, 1, 1] = 1.0
    expected = torch.zeros(1, 1, 4, 4)
    expected[0, 0, :2, :2] = 1.0
    assert torch.equal(pool(x), expected)


# --- dropout -------------------------------------------------------------------------------------


def dropouts(agent: Agent) -> list[Dropout]:
    return [m for m in agent.modules() if isinstance(m, Dropout)]


def test_in_impala_dropout_follows_every_convolution():
    """As in Lee et al.'s code: before the pooling of a section and in its residual blocks."""
    agent = Agent(Args(network="impala", dropout=0.1), seeded())
    order = [m for m in agent.modules() if isinstance(m, nn.Conv2d | nn.Linear | Dropout)]
    for first, second in zip(order[:-1:2], order[1::2], strict=False):
        if isinstance(first, nn.Conv2d):
            assert isinstance(second, Dropout)
    sections = [(16, 64), (32, 32), (32, 16)]
    shapes = [
        (1, channels, side, side)
        for channels, begin in sections
        for side in (begin, *[begin // 2] * 4)
    ]
    assert [tuple(m.mask.shape) for m in dropouts(agent)] == shapes
    assert isinstance(agent.network[0], nn.Conv2d)
    assert isinstance(agent.network[1], Dropout)
    assert isinstance(agent.network[2], nn.MaxPool2d)


def test_in_naturecnn_dropout_follows_the_last_hidden_layer():
    agent = Agent(Args(dropout=0.1), seeded())
    assert [tuple(m.mask.shape) for m in dropouts(agent)] == [(1, 512)]
    assert isinstance(agent.network[-1], Dropout)


def test_dropout_by_hand():
    dropout = Dropout(Args(dropout=0.75), 6)
    dropout.draw(seeded())
    kept = torch.rand(1, 6, generator=seeded()) >= 0.75
    x = torch.arange(12.0).view(2, 6)
    assert torch.equal(dropout(x), torch.where(kept, 4 * x, 0.0))
    assert 0 < kept.sum() < 6


@pytest.mark.parametrize("network", ["nature", "impala"])
def test_a_share_of_the_features_is_left_out_of_every_state_alike(network):
    learner = Learner(Args(network=network, dropout=0.25))
    learner.draw_masks()
    masks = [m.mask for m in dropouts(learner.agent)]
    for mask in masks:
        assert mask.unique().tolist() == pytest.approx([0.0, 4 / 3])
        assert 0.15 < (mask == 0).float().mean() < 0.35
    first = [mask.clone() for mask in masks]
    learner.draw_masks()
    assert not any(torch.equal(*pair) for pair in zip(first, masks, strict=True))

    logprobs, _ = learner.agent(frames_of(0))
    alone, _ = learner.agent(frames_of(0)[1:])
    torch.testing.assert_close(logprobs[1:], alone)


@pytest.mark.parametrize("network", ["nature", "impala"])
@pytest.mark.parametrize("eval_dropout", [False, True])
def test_evaluation_is_without_dropout_unless_it_is_asked_for(network, eval_dropout):
    learner = Learner(Args(network=network, dropout=0.5, eval_dropout=eval_dropout))
    plain = Learner(Args(network=network)).agent  # of the same weights
    learner.draw_masks()
    agent = learner.agent
    trained, _ = agent(frames_of(0))
    assert not torch.equal(trained, plain(frames_of(0))[0])
    agent.eval()
    expected = trained if eval_dropout else plain(frames_of(0))[0]
    torch.testing.assert_close(agent(frames_of(0))[0], expected)


def test_without_dropout_nothing_is_drawn_or_kept():
    learner = Learner(Args(network="impala"))
    before = learner.generators["dropout"].get_state()
    learner.draw_masks()
    assert torch.equal(learner.generators["dropout"].get_state(), before)
    assert not any("mask" in name for name in learner.agent.state_dict())
