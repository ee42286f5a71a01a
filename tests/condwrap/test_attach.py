"""An attached penalty is the explicit one, in whatever way the loop differentiates its loss."""

from __future__ import annotations

import copy
import functools
import os
import pickle

import pytest
import torch
from torch import distributed as dist
from torch import distributions as td
from torch import nn
from torch.utils.checkpoint import checkpoint

from condwrap import ConditioningRegularizer, attach, summary

OBS = torch.randn(16, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def make_net(*between: nn.Module, seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    layers = [nn.Linear(4, 8), *between, nn.Tanh(), nn.Linear(8, 2)]
    return nn.Sequential(*layers).double()


def make_penalty(coefficient: float = 0.3) -> ConditioningRegularizer:
    return ConditioningRegularizer(coefficient, lambda_min=1.0, seed=1)


def gradients(module: nn.Module) -> list[torch.Tensor]:
    found = [parameter.grad for parameter in module.parameters()]
    for parameter in module.parameters():
        parameter.grad = None
    return found


def square(output: torch.Tensor) -> torch.Tensor:
    return output.square().mean()


def explicit(module, loss=square, calls=1, scale=1.0):
    """Gradients of loss + penalty, written out, for so many calls of the module."""
    penalty = make_penalty()
    for _ in range(calls):
        (loss(module(OBS)) + scale * penalty(module, OBS).penalty).backward()
    return gradients(module)


def assert_equal(found, expected):
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


# --- the gradient --------------------------------------------------------------------------------


def test_the_gradient_is_the_explicit_penaltys():
    net = make_net()
    expected = explicit(net)
    plain = make_net()
    plain(OBS).square().mean().backward()
    assert (expected[0] - gradients(plain)[0]).abs().max() > 1e-3  # the penalty matters here

    attach(net, make_penalty())
    net(OBS).square().mean().backward()
    assert_equal(gradients(net), expected)


def test_by_hand():
    """pi(s) = w s with w = 0.5: J = 0.5 whatever delta is, psi = 0.25, d psi / d w = -1."""
    net = nn.Linear(1, 1, bias=False)
    net.weight.data = torch.tensor([[0.5]])
    attach(net, ConditioningRegularizer(coefficient=2.0))
    net(torch.ones(8, 1)).sum().backward()
    assert net.weight.grad.item() == pytest.approx(8.0 - 2.0)


@pytest.mark.parametrize("between", [nn.Dropout(0.5), nn.BatchNorm1d(8)], ids=["dropout", "norm"])
def test_where_the_output_cannot_be_reused_it_is_computed_again(between):
    expected_net = make_net(between)
    found_net = copy.deepcopy(expected_net)
    torch.manual_seed(2)
    expected = explicit(expected_net)
    attach(found_net, make_penalty())
    torch.manual_seed(2)
    loss = found_net(OBS).square().mean()
    loss.backward()
    assert_equal(gradients(found_net), expected)


def test_it_is_returned_by_autograd_grad_and_left_out_of_grad():
    net = make_net()
    expected = explicit(net)
    attach(net, make_penalty())
    found = torch.autograd.grad(net(OBS).square().mean(), list(net.parameters()))
    assert_equal(list(found), expected)
    assert gradients(net) == [None] * 4


class Two(nn.Module):
    """A mean, and a log standard deviation that depends on the state."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = make_net(seed=0)
        self.log_std = make_net(seed=1)

    def forward(self, obs: torch.Tensor) -> td.Distribution:
        return td.Independent(td.Normal(self.mean(obs), self.log_std(obs).exp()), 1)


def test_a_distribution_is_carried_and_only_its_mean_counts():
    net = Two()
    actions = torch.zeros(16, 2, dtype=torch.float64)

    def loss(policy):
        return -policy.log_prob(actions).mean()

    expected = explicit(net, loss=loss)
    attach(net, make_penalty())
    policy = net(OBS)
    assert isinstance(policy, td.Independent)
    loss(policy).backward()
    assert_equal(gradients(net), expected)


def test_a_categorical_is_carried():
    class Discrete(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = make_net()

        def forward(self, obs: torch.Tensor) -> td.Categorical:
            return td.Categorical(logits=self.net(obs))

    net = Discrete()

    def loss(policy):
        return policy.log_prob(torch.ones(16)).mean() + policy.entropy().mean()

    expected = explicit(net, loss=loss)
    attach(net, make_penalty())
    loss(net(OBS)).backward()
    assert_equal(gradients(net), expected)


class Recurrent(nn.Module):
    """Returns an output and the next hidden state, as recurrent policies do."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.cell = nn.GRUCell(4, 5).double()
        self.head = nn.Linear(5, 2).double()

    def forward(self, obs: torch.Tensor, *, hidden: torch.Tensor) -> dict[str, torch.Tensor]:
        hidden = self.cell(obs, hidden)
        return {"mean": self.head(hidden), "hidden": hidden}


def test_a_recurrent_state_is_not_perturbed_and_learns_through_time():
    net = Recurrent()
    start = torch.zeros(16, 5, dtype=torch.float64)
    penalty = ConditioningRegularizer(0.3, select=lambda output: output["mean"], seed=1)

    first = net(OBS, hidden=start)["hidden"]
    loss = net(OBS, hidden=first)["mean"].square().mean()
    for hidden in (first, start):
        loss = loss + penalty(functools.partial(net, hidden=hidden), OBS).penalty
    loss.backward()
    expected = gradients(net)

    attach(net, ConditioningRegularizer(0.3, select=lambda output: output["mean"], seed=1))
    first = net(OBS, hidden=start)["hidden"]
    net(OBS, hidden=first)["mean"].square().mean().backward()  # the last call comes first
    assert_equal(gradients(net), expected)


def test_a_shared_trunk_gets_the_gradient_through_its_features():
    torch.manual_seed(4)
    trunk = nn.Linear(4, 6).double()
    head = nn.Linear(6, 2).double()
    both = nn.ModuleList([trunk, head])
    features = trunk(OBS).tanh()
    (head(features).square().mean() + make_penalty()(head, features).penalty).backward()
    expected = gradients(both)

    attach(head, make_penalty())
    head(trunk(OBS).tanh()).square().mean().backward()
    assert_equal(gradients(both), expected)


def test_parameters_that_are_lent_for_the_call_get_the_gradient():
    """As torch.func.functional_call and TorchRL's loss modules lend them."""
    net = make_net()
    expected = explicit(net)
    empty = copy.deepcopy(net).to("meta")
    handle = attach(empty, make_penalty())
    lent = dict(net.named_parameters())
    torch.func.functional_call(empty, lent, (OBS,)).square().mean().backward()
    assert_equal(gradients(net), expected)
    assert handle.metrics()["attach/backwards"] == 1.0
    assert all(x.is_meta for x in empty.parameters())


class Counting(nn.Module):
    """A network that keeps a running mean of its inputs, as normalizers do."""

    def __init__(self) -> None:
        super().__init__()
        self.net = make_net()
        self.register_buffer("mean", torch.zeros(4, dtype=torch.float64))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        self.mean.add_(obs.detach().mean(0))
        return self.net(obs - self.mean)


def test_buffers_that_are_lent_for_the_call_are_as_after_it():
    net = Counting()
    mean = torch.ones(4, dtype=torch.float64)
    attach(net, make_penalty())
    lent = {name: x.detach().clone().requires_grad_() for name, x in net.named_parameters()}
    torch.func.functional_call(net, {**lent, "mean": mean}, (OBS,)).sum().backward()
    torch.testing.assert_close(mean, 1 + OBS.mean(0))
    assert torch.equal(net.mean, torch.zeros_like(mean))


def test_the_observation_is_found_by_its_name():
    net = Recurrent()
    start = torch.zeros(16, 5, dtype=torch.float64)
    policy = functools.partial(net, hidden=start)
    penalty = ConditioningRegularizer(0.3, select=lambda output: output["mean"], seed=1)
    (square(net(OBS, hidden=start)["mean"]) + penalty(policy, OBS).penalty).backward()
    expected = gradients(net)

    penalty = ConditioningRegularizer(0.3, select=lambda output: output["mean"], seed=1)
    attach(net, penalty, obs="obs")
    square(net(hidden=start, obs=OBS)["mean"]).backward()
    assert_equal(gradients(net), expected)


# --- how loops differentiate ---------------------------------------------------------------------


def test_two_calls_before_one_backward_are_two_penalties():
    net = make_net()
    expected = explicit(net, calls=2)
    handle = attach(net, make_penalty())
    (net(OBS).square().mean() + net(OBS).square().mean()).backward()
    assert_equal(gradients(net), expected)
    assert handle.metrics()["attach/backwards"] == 2.0


def test_accumulated_gradients_take_a_scale():
    net = make_net()
    expected = explicit(net, loss=lambda out: out.square().mean() / 2, calls=2, scale=0.5)
    handle = attach(net, make_penalty())
    handle.scale = 0.5
    for _ in range(2):
        (net(OBS).square().mean() / 2).backward()
    assert_equal(gradients(net), expected)


def test_a_grad_scaler_tells_its_scale():
    net = make_net()
    expected = explicit(net)
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**10)
    optimizer = torch.optim.SGD(net.parameters(), lr=0.0)
    handle = attach(net, make_penalty())
    handle.scale = scaler.get_scale
    scaler.scale(net(OBS).square().mean()).backward()
    scaler.unscale_(optimizer)
    assert_equal(gradients(net), expected)


def test_what_is_differentiated_twice_is_refused():
    net = make_net()
    attach(net, make_penalty())
    with pytest.raises(RuntimeError, match=r"create_graph=True.*Remove the handle"):
        torch.autograd.grad(net(OBS).square().mean(), list(net.parameters()), create_graph=True)


@pytest.mark.parametrize("reentrant", [False, True])
def test_activation_checkpointing(reentrant):
    net = make_net()
    expected = explicit(net)
    handle = attach(net, make_penalty())
    obs = OBS.clone().requires_grad_()  # which reentrant checkpointing needs
    checkpoint(net, obs, use_reentrant=reentrant).square().mean().backward()
    assert_equal(gradients(net), expected)
    assert handle.metrics()["attach/backwards"] == 1.0


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.parametrize("first", ["attach", "compile"])
def test_compiled_code(first):
    net = make_net()
    expected = explicit(net)
    if first == "compile":  # in one graph, the node outside of it
        compiled = torch.compile(net, backend="aot_eager", fullgraph=True)
        attach(compiled, make_penalty())
    else:
        attach(net, make_penalty())
        compiled = torch.compile(net, backend="aot_eager")
    compiled(OBS).square().mean().backward()
    assert_equal(gradients(net), expected)


def test_half_precision_outputs_are_computed_again():
    net = make_net().float()
    handle = attach(net, make_penalty())
    obs = OBS.float()
    with torch.autocast("cpu", torch.bfloat16):
        output = net(obs)
    assert output.dtype == torch.bfloat16
    (output.float().mean() * 0).backward()  # nothing but the penalty is left
    found = gradients(net)
    handle.remove()
    make_penalty()(net, obs).penalty.backward()
    for one, other in zip(found, [p.grad for p in net.parameters()], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


def _train_a_rank(rank: int, folder: str) -> None:
    """One of two processes: half of the batch each, gradients averaged by DDP."""
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    dist.init_process_group("gloo", f"file://{folder}/rendezvous", rank=rank, world_size=2)
    net = make_net()
    attach(net, ConditioningRegularizer(0.3, seed=rank))
    parallel = nn.parallel.DistributedDataParallel(net)
    square(parallel(OBS[rank::2])).backward()
    torch.save(gradients(net), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_two_processes_average_loss_and_penalty(tmp_path):
    net = make_net()
    of_rank = []
    for rank in range(2):
        obs = OBS[rank::2]
        penalty = ConditioningRegularizer(0.3, seed=rank)
        (square(net(obs)) + penalty(net, obs).penalty).backward()
        of_rank.append(gradients(net))
    expected = [(one + other) / 2 for one, other in zip(*of_rank, strict=True)]

    torch.multiprocessing.spawn(_train_a_rank, args=(str(tmp_path),), nprocs=2)
    for rank in range(2):
        assert_equal(torch.load(tmp_path / f"{rank}.pt"), expected)


def test_two_penalties_on_one_module_add_up():
    net = make_net()
    other = ConditioningRegularizer(0.7, lambda_min=0.5, seed=2)
    loss = square(net(OBS)) + make_penalty()(net, OBS).penalty + other(net, OBS).penalty
    loss.backward()
    expected = gradients(net)

    handles = [attach(net, make_penalty())]
    handles.append(attach(net, ConditioningRegularizer(0.7, lambda_min=0.5, seed=2)))
    square(net(OBS)).backward()
    assert_equal(gradients(net), expected)
    assert [handle.metrics()["attach/backwards"] for handle in handles] == [1.0, 1.0]


def test_measuring_a_module_in_training_mode_is_no_call_of_the_loop():
    net = make_net()
    expected = summary(net, OBS)
    handle = attach(net, make_penalty())
    assert summary(net, OBS) == expected
    make_penalty()(net, OBS).penalty.backward()
    assert handle.metrics()["attach/forwards"] == 0.0


# --- what is as it was without it ----------------------------------------------------------------


def test_coefficient_0_changes_no_bit_and_is_measured():
    net = make_net()
    twin = copy.deepcopy(net)
    handle = attach(net, make_penalty(coefficient=0.0))
    output = net(OBS)
    assert torch.equal(output, twin(OBS))
    output.square().mean().backward()
    twin(OBS).square().mean().backward()
    for one, other in zip(gradients(net), gradients(twin), strict=True):
        assert torch.equal(one, other)
    assert 0 < handle.metrics()["conditioning/psi"] < 1


def test_evaluation_and_calls_without_gradients_are_left_alone():
    net = make_net()
    handle = attach(net, make_penalty())
    with torch.no_grad():
        assert not net(OBS).requires_grad
    with torch.inference_mode():
        assert net(OBS).is_inference()
    net.eval()
    net(OBS).square().mean().backward()
    found = gradients(net)
    plain = make_net()
    plain(OBS).square().mean().backward()
    for one, other in zip(found, gradients(plain), strict=True):
        assert torch.equal(one, other)
    assert handle.metrics() == {"attach/forwards": 0.0, "attach/backwards": 0.0}


def test_frozen_modules_and_outputs_without_gradient_are_left_alone():
    net = make_net().requires_grad_(False)
    handle = attach(net, make_penalty())
    assert not net(OBS).requires_grad
    assert handle.metrics()["attach/forwards"] == 0.0


def test_what_is_never_differentiated_draws_no_noise_and_is_counted():
    net, penalty = make_net(), make_penalty()
    handle = attach(net, penalty)
    before = penalty.generator.get_state()
    net(OBS)
    assert torch.equal(penalty.generator.get_state(), before)
    assert handle.metrics() == {"attach/forwards": 1.0, "attach/backwards": 0.0}
    net(OBS).sum().backward()
    assert not torch.equal(penalty.generator.get_state(), before)


def test_the_global_generator_and_the_mode_are_left_alone():
    net = make_net(nn.Dropout(0.5))
    twin = copy.deepcopy(net)
    attach(net, make_penalty())
    states = []
    for module in (net, twin):
        torch.manual_seed(5)
        module(OBS).sum().backward()
        states.append(torch.get_rng_state())
        assert module.training
    assert torch.equal(*states)


def test_copies_and_pickles_are_without_the_penalty():
    net = make_net()
    state = net.state_dict().keys()
    handle = attach(net, make_penalty())
    assert net.state_dict().keys() == state
    for other in (copy.deepcopy(net), pickle.loads(pickle.dumps(net))):
        other(OBS).square().mean().backward()
        plain = make_net()
        plain(OBS).square().mean().backward()
        assert_equal(gradients(other), gradients(plain))
    assert handle.metrics()["attach/forwards"] == 0.0


def test_removing_it_restores_the_module():
    net = make_net()
    with attach(net, make_penalty()) as handle:
        net(OBS).sum().backward()
    assert not net._forward_hooks
    net(OBS).sum().backward()
    assert handle.metrics()["attach/backwards"] == 1.0


def test_metrics_are_means_since_the_last_call():
    net = nn.Linear(1, 1, bias=False)
    handle = attach(net, ConditioningRegularizer())
    for weight in (0.5, 0.0):
        net.weight.data = torch.tensor([[weight]])
        net(torch.ones(8, 1)).sum().backward()
    found = handle.metrics()
    assert found["conditioning/psi"] == pytest.approx((0.25 + 1.0) / 2)
    assert found["conditioning/fraction_below"] == 1.0
    assert "conditioning/psi" not in handle.metrics()


# --- bad input -----------------------------------------------------------------------------------


def test_no_module_is_refused():
    with pytest.raises(TypeError, match=r"must be a torch\.nn\.Module, got function"):
        attach(lambda obs: obs, make_penalty())


def test_a_penalty_that_needs_more_is_refused_with_advice():
    penalty = make_penalty()
    penalty.needs = ("output", "next_obs", "dones")
    with pytest.raises(ValueError, match=r"needs next_obs and dones.*next_obs=\.{3}, dones="):
        attach(make_net(), penalty)


@pytest.mark.parametrize("which", [1, "state"])
def test_an_observation_that_is_not_there_is_refused_where_the_module_is_called(which):
    net = make_net()
    attach(net, make_penalty(), obs=which)
    with pytest.raises(ValueError, match=r"names no argument.* 1 by position and none by name"):
        net(OBS)


def test_an_error_of_the_penalty_is_told_and_does_not_stick():
    net = make_net()
    handle = attach(net, make_penalty())
    bad = OBS.clone()
    bad[0, 0] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        net(bad).sum().backward()
    gradients(net)
    net(OBS).sum().backward()
    assert handle.metrics()["attach/backwards"] == 1.0
