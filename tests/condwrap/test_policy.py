"""Which tensor an output means, and that evaluating a policy leaves no trace in it."""

import contextlib
import functools
import re

import pytest
import torch
from torch import distributions as td
from torch import nn
from torch.nn.utils import parametrizations

from condwrap.policy import check_select, flat_output, untouched

BATCH = torch.Size([4])
CPU = torch.device("cpu")
X = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
DIAGONAL = torch.eye(3)

DEFAULTS = {
    "tensor": (X, X),
    "no output axis": (X[:, 0], X[:, :1]),
    "matrix": (X.reshape(4, 3, 1), X),
    "Normal": (td.Normal(X, 2.0), X),
    "Independent": (td.Independent(td.Normal(X, 2.0), 1), X),
    "MultivariateNormal": (td.MultivariateNormal(X, DIAGONAL), X),
    "LowRank": (td.LowRankMultivariateNormal(X, DIAGONAL[:, :1], torch.ones(3)), X),
    "Categorical": (td.Categorical(logits=X), X.log_softmax(-1)),
    "OneHotCategorical": (td.OneHotCategorical(logits=X), X.log_softmax(-1)),
    "Bernoulli": (td.Bernoulli(logits=X), X),
    "Independent Bernoulli": (td.Independent(td.Bernoulli(logits=X), 1), X),
    "tuple": ((X, td.Normal(2 * X, 1.0), X[:, 0]), torch.cat([X, 2 * X, X[:, :1]], -1)),
    "list": ([X, 2 * X], torch.cat([X, 2 * X], -1)),
    "dict": ({"pi": td.Normal(X, 1.0), "more": (X,)}, torch.cat([X, X], -1)),
}


@pytest.mark.parametrize("name", DEFAULTS)
def test_default_output(name):
    output, expected = DEFAULTS[name]
    torch.testing.assert_close(flat_output(output, "default", BATCH), expected)


@pytest.mark.parametrize(
    ("output", "select", "expected"),
    [
        (td.Normal(X, 2.0), "mean", X),
        (td.Beta(X.exp(), X.exp()), "mean", torch.full((4, 3), 0.5)),
        (td.Independent(td.Normal(X, 2.0), 1), "mean", X),
        (td.OneHotCategorical(logits=X), "mean", X.softmax(-1)),
        (td.Categorical(logits=X), "logits", X.log_softmax(-1)),
        (td.Categorical(logits=X), "probs", X.softmax(-1)),
        (td.Bernoulli(logits=X), "probs", X.sigmoid()),
        ((td.Categorical(logits=X), X), "probs", torch.cat([X.softmax(-1), X], -1)),
        (td.Normal(X, X.exp()), lambda output: output.stddev, X.exp()),
        (("logged", X, "too"), lambda output: output[1], X),
        ((X, td.Normal(X, 1.0)), lambda output: output[1], X),
    ],
)
def test_chosen_output(output, select, expected):
    torch.testing.assert_close(flat_output(output, select, BATCH), expected)


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [
        (torch.bfloat16, torch.float32),
        (torch.float16, torch.float32),
        (torch.float32, torch.float32),
        (torch.float64, torch.float64),
    ],
)
def test_output_is_at_least_float32(dtype, expected):
    assert flat_output(X.to(dtype), "default", BATCH).dtype == expected


def test_output_keeps_every_batch_axis():
    assert flat_output(torch.ones(2, 4, 3, 5), "default", torch.Size([2, 4])).shape == (2, 4, 15)


def test_tensors_are_joined_behind_every_batch_axis():
    pair = (torch.zeros(2, 4, 3), torch.ones(2, 4))
    joined = flat_output(pair, "default", torch.Size([2, 4]))
    assert joined.tolist() == [[[0.0, 0.0, 0.0, 1.0]] * 4] * 2


class Unreadable:
    pass


@pytest.mark.parametrize(
    ("output", "select", "error", "message"),
    [
        (X, lambda output: None, ValueError, "select returned None"),
        ((), "default", ValueError, "the policy's output holds no tensor: got an empty tuple"),
        ({}, "default", ValueError, "got an empty dict"),
        (X, lambda output: [], ValueError, "got an empty list"),
        (X.sum(), "default", ValueError, "must begin with the batch axes (4,)"),
        (X.mean(0), "default", ValueError, "got shape (3,)"),
        ((X, X[:2]), "default", ValueError, "got shape (2, 3)"),
        (td.Normal(torch.zeros(3), 1.0), "default", ValueError, "got shape (3,)"),
        (X.argmax(-1), "default", TypeError, "must be floating, got torch.int64"),
        (X.argmax(-1), "default", TypeError, "not the sampled action"),
        (Unreadable(), "default", TypeError, "got Unreadable: pass select=lambda output: ..."),
        ((X, None), "default", TypeError, "got NoneType"),
        (td.Beta(X.exp(), 1.0), "default", TypeError, "no default output for Beta"),
        (td.Normal(X, 1.0), "logits", TypeError, "no logits for Normal"),
        (td.Normal(X, 1.0), "probs", TypeError, "no probs for Normal"),
        (td.Categorical(logits=X), "mean", TypeError, "no mean for Categorical"),
        (
            td.TransformedDistribution(td.Normal(X, 1.0), td.TanhTransform()),
            "mean",
            TypeError,
            "no mean for TransformedDistribution",
        ),
    ],
)
def test_an_output_is_refused(output, select, error, message):
    with pytest.raises(error, match=re.escape(message)):
        flat_output(output, select, BATCH)


def test_output_must_be_a_known_name_or_callable():
    for known in ("default", "mean", "logits", "probs", lambda output: output):
        check_select(known)
    with pytest.raises(ValueError, match=re.escape("['default', 'mean', 'logits', 'probs'] or a")):
        check_select("variance")
    with pytest.raises(TypeError, match="select must be a name or a callable, got int"):
        check_select(0)


class Agent:
    """A policy that is no module: it holds one, and answers by method or by call."""

    def __init__(self, net):
        self.net = net

    def act(self, obs):
        return self.net(obs)

    __call__ = act


GLOBAL_NET = nn.BatchNorm1d(3)


def by_global_name(obs):
    return GLOBAL_NET(obs)


def closing_over(net):
    def policy(obs):
        return net(obs)

    return policy


HOLDERS = {
    "module": lambda net: net,
    "nested module": lambda net: nn.Sequential(nn.Sequential(net)),
    "bound method of a module": lambda net: net.forward,
    "bound method": lambda net: Agent(net).act,
    "callable object": Agent,
    "lambda": lambda net: lambda obs: net(obs),
    "closure": closing_over,
    "lambda over an agent": lambda net: (lambda agent: lambda obs: agent.act(obs))(Agent(net)),
    "partial": lambda net: functools.partial(lambda module, obs: module(obs), net),
    "partial by keyword": lambda net: functools.partial(
        lambda obs, module: module(obs), module=net
    ),
    "partial of a method": lambda net: functools.partial(Agent(net).act),
    "partial of a closure": lambda net: functools.partial(closing_over(net)),
    "global": lambda net: by_global_name,
}


@pytest.mark.parametrize("holder", HOLDERS)
def test_batch_norm_is_found_in_any_callable(holder):
    net = GLOBAL_NET if holder == "global" else nn.BatchNorm1d(3)
    net.reset_running_stats()
    policy = HOLDERS[holder](net)
    with untouched(policy, CPU):
        assert not net.training
        torch.testing.assert_close(policy(X), X, rtol=1e-4, atol=1e-4)  # mean 0, variance 1
    assert net.training
    assert net.num_batches_tracked == 0


def test_the_search_goes_two_steps_deep_and_partials_are_free():
    """A function that holds an agent that holds a module; what lies deeper is the agent's own."""

    def is_found(policy):
        with untouched(policy, CPU):
            found = not net.training
        assert net.training
        return found

    net = nn.BatchNorm1d(3)
    two = (lambda agent: lambda obs: agent.act(obs))(Agent(net))
    three = (lambda policy: lambda obs: policy(obs))(two)
    partial = functools.partial
    assert is_found(two)
    assert is_found(partial(partial(partial(two))))
    assert not is_found(three)
    assert not is_found(partial(three))


def test_classes_and_python_modules_are_not_searched():
    class Holder:
        net = nn.BatchNorm1d(3)

    with untouched(lambda obs: (Holder.net, nn.functional)[0](obs), CPU):
        assert Holder.net.training


def test_a_variable_that_is_not_yet_filled_does_no_harm():
    net = nn.BatchNorm1d(3)

    def policy(obs):
        return net(obs) if obs is not None else later

    with untouched(policy, CPU):
        assert not net.training
    later = None


def test_modules_in_eval_mode_stay_in_eval_mode():
    net = nn.Sequential(nn.BatchNorm1d(3), nn.Dropout()).train()
    net[0].eval()
    with untouched(net, CPU):
        assert net[1].training
    assert [m.training for m in net] == [False, True]


@pytest.mark.parametrize("norm", [nn.BatchNorm1d, nn.InstanceNorm1d])
def test_norms_without_running_statistics_are_refused(norm):
    net = nn.Sequential(nn.BatchNorm1d(3), norm(3, track_running_stats=False))
    message = f"{norm.__name__} without running statistics"
    with pytest.raises(ValueError, match=message), untouched(net, CPU):
        pass
    assert all(m.training for m in net)
    with untouched(net.eval(), CPU):
        pass


class Counter(nn.Module):
    """Changes a buffer whenever it answers, as an observation normalizer does."""

    def __init__(self):
        super().__init__()
        self.register_buffer("calls", torch.zeros(()))
        self.register_buffer("unset", None)

    def forward(self, obs):
        self.calls += 1
        return obs * self.calls


@pytest.mark.parametrize("training", [True, False])
def test_buffers_are_restored(training):
    net = Counter().train(training)
    calls = net.calls
    with untouched(net, CPU):
        torch.testing.assert_close(net(X), X)
        assert net.calls == 1
    assert net.calls is calls
    assert net.calls == 0
    assert net.unset is None


def test_spectral_norm_keeps_its_vectors():
    net = parametrizations.spectral_norm(nn.Linear(3, 3))
    net.parametrizations.weight.original.data.normal_()  # the vectors of the old weight are off
    before = {k: v.clone() for k, v in net.state_dict().items()}
    with untouched(net, CPU):
        net(X)
    after = net.state_dict()
    assert all(torch.equal(after[k], v) for k, v in before.items())
    net(X)
    assert not all(torch.equal(net.state_dict()[k], v) for k, v in before.items())


def test_two_evaluations_draw_the_same_and_the_global_state_is_kept():
    state = torch.get_rng_state()
    draws = []
    for _ in range(2):
        with untouched(torch.relu, CPU):
            draws.append(torch.rand(5))
    assert torch.equal(*draws)
    assert torch.equal(torch.get_rng_state(), state)


def test_the_generator_of_the_states_gpu_is_restored_too(monkeypatch):
    restored = []

    @contextlib.contextmanager
    def spy(devices):
        restored.append(devices)
        yield

    monkeypatch.setattr(torch.random, "fork_rng", spy)
    for device in (torch.device("cuda", 1), CPU):
        with untouched(torch.relu, device):
            pass
    assert restored == [[torch.device("cuda", 1)], []]


def test_everything_is_restored_after_an_error():
    net = nn.Sequential(nn.BatchNorm1d(3), Counter())
    calls, state = net[1].calls, torch.get_rng_state()

    def evaluate_and_fail():
        with untouched(net, CPU):
            net(torch.rand(4, 3))
            raise KeyError("in the policy")

    with pytest.raises(KeyError, match="in the policy"):
        evaluate_and_fail()
    assert net[0].training
    assert net[1].calls is calls
    assert torch.equal(torch.get_rng_state(), state)
