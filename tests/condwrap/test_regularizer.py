"""The regularizer as a training loop uses it."""

import copy
import functools
import math
import re

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import distributions as td
from torch import nn
from torch.nn.utils import parametrizations

from condwrap import Conditioning, ConditioningRegularizer, sphere
from tests.condwrap.helpers import stochastic

# PyTorch itself scripts what forward mode and inductor import
pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit.script.* is deprecated:DeprecationWarning"
)

COMPILED = {"fullgraph": True, "backend": "aot_eager"}


def mlp(scale=1.0):
    net = nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 3))
    with torch.no_grad():
        net[2].weight.mul_(scale)
    return net


def no_delta(noise):
    return 0 * noise


def linear(weight):
    policy = nn.Linear(2, 2, bias=False)
    policy.weight.data = torch.tensor(weight)
    return policy


# --- values -----------------------------------------------------------------------------------

DIAGONAL = [[30.0, 0.0], [0.0, 0.5]]
DELTA = torch.tensor([[2.0, 0.0], [0.0, 2.0], [0.3, 0.4], [0.0, 0.0]])
# the third: ‖(9, 0.2)‖ / 0.5; the fourth has no delta
QUOTIENT = [30.0, 0.5, 2 * math.hypot(9.0, 0.2), 0.0]


def test_values_worked_out_by_hand():
    policy = linear(DIAGONAL)
    regularizer = ConditioningRegularizer(coefficient=0.1)
    conditioning = regularizer(policy, torch.zeros(2, 2), delta=DELTA[:2])
    assert conditioning.quotient.tolist() == [30.0, 0.5]
    assert conditioning.psi.tolist() == [100.0, 0.25]
    assert conditioning.penalty.item() == pytest.approx(0.1 * 100.25 / 2)
    assert conditioning.fraction_below == conditioning.fraction_above == 0.5
    conditioning.penalty.backward()
    # 0.1 / 2 · 2 (J - clip J) dJ/dW, and dJ/dW is 1 for the weight that delta meets
    torch.testing.assert_close(policy.weight.grad, torch.tensor([[1.0, 0.0], [0.0, -0.05]]))


def test_every_state_has_its_quotient():
    conditioning = ConditioningRegularizer()(linear(DIAGONAL), torch.ones(4, 2), delta=DELTA)
    torch.testing.assert_close(conditioning.quotient, torch.tensor(QUOTIENT))
    assert conditioning.fraction_below == 0.5
    assert conditioning.fraction_above == 0.25


def test_quotient_batch_gives_one_value_for_the_batch():
    regularizer = ConditioningRegularizer(coefficient=1.0, reduction="batch")
    conditioning = regularizer(linear(DIAGONAL), torch.ones(2, 2), delta=DELTA[:2])
    # changes 60 and 1 over deltas 2 and 2
    expected = math.sqrt((60**2 + 1) / 8)
    assert conditioning.quotient.shape == conditioning.psi.shape == ()
    assert conditioning.quotient.item() == pytest.approx(expected)
    assert conditioning.penalty.item() == pytest.approx((expected - 20) ** 2, rel=1e-5)
    assert conditioning.fraction_above == 1


@pytest.mark.parametrize(
    ("lambda_min", "lambda_max", "psi"),
    [(1.0, 20.0, [100.0, 0.25]), (0.0, math.inf, [0.0, 0.0]), (2.0, 2.0, [784.0, 2.25])],
)
def test_the_range_is_the_range_asked_for(lambda_min, lambda_max, psi):
    regularizer = ConditioningRegularizer(lambda_min=lambda_min, lambda_max=lambda_max)
    conditioning = regularizer(linear(DIAGONAL), torch.zeros(2, 2), delta=DELTA[:2])
    assert conditioning.psi.tolist() == psi


def test_a_quotient_at_a_bound_is_neither_below_nor_above():
    regularizer = ConditioningRegularizer(lambda_min=0.5, lambda_max=30.0)
    conditioning = regularizer(linear(DIAGONAL), torch.zeros(2, 2), delta=DELTA[:2])
    assert conditioning.quotient.tolist() == [30.0, 0.5]
    assert conditioning.fraction_below == conditioning.fraction_above == 0.0


def test_the_penalty_is_proportional_to_the_coefficient():
    penalties = [
        ConditioningRegularizer(coefficient)(mlp_of_seed(1), torch.ones(8, 4)).penalty
        for coefficient in (1.0, 0.25)
    ]
    torch.testing.assert_close(penalties[1], 0.25 * penalties[0])


def mlp_of_seed(seed):
    torch.manual_seed(seed)
    return mlp()


def test_only_the_penalty_carries_a_gradient():
    conditioning = ConditioningRegularizer()(mlp(), torch.randn(8, 4))
    carries = {name: x.requires_grad for name, x in vars(conditioning).items()}
    assert [name for name, carried in carries.items() if carried] == ["penalty"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_have_the_dtype_of_the_observations(dtype):
    conditioning = ConditioningRegularizer()(mlp().to(dtype), torch.randn(8, 4, dtype=dtype))
    assert conditioning.penalty.dtype == conditioning.quotient.dtype == dtype


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_where_no_state_responds_the_gradient_is_0_and_finite(estimator):
    policy = mlp(scale=0.0)
    conditioning = ConditioningRegularizer(estimator=estimator)(policy, torch.randn(8, 4))
    assert conditioning.quotient.eq(0).all()
    assert conditioning.fraction_below == 1
    conditioning.penalty.backward()
    for parameter in policy.parameters():
        assert parameter.grad is None or parameter.grad.eq(0).all()


@pytest.mark.parametrize("scale", [0.01, 300.0])
@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_learning_brings_an_ill_conditioned_policy_into_the_range(scale, estimator):
    policy, obs = mlp(scale), torch.randn(64, 4)
    regularizer = ConditioningRegularizer(coefficient=1.0, estimator=estimator, radius=0.1)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.1)
    before = regularizer(policy, obs)
    assert before.fraction_below + before.fraction_above > 0.9
    for _ in range(100):
        optimizer.zero_grad()
        regularizer(policy, obs).penalty.backward()
        optimizer.step()
    after = regularizer(policy, obs)
    assert after.fraction_below + after.fraction_above < 0.1
    assert 1 <= after.quotient.median() <= 20
    assert after.psi.mean() < 0.01 * before.psi.mean()


# --- coefficient 0 ----------------------------------------------------------------------------


def test_coefficient_0_measures_and_adds_a_constant_0():
    policy, obs = mlp(scale=100.0), torch.randn(8, 4)
    measured = ConditioningRegularizer(coefficient=0)(policy, obs)
    penalized = ConditioningRegularizer(coefficient=1)(policy, obs)
    assert measured.penalty == 0
    assert not measured.penalty.requires_grad
    assert torch.equal(measured.psi, penalized.psi)
    assert measured.psi.mean() > 0


@pytest.mark.parametrize(("coefficient", "expected"), [(0.0, False), (1.0, True)])
def test_coefficient_0_builds_no_graph(coefficient, expected):
    policy, graph = mlp(), []

    def recording(obs):
        output = policy(obs)
        graph.append(output.requires_grad)
        return output

    ConditioningRegularizer(coefficient)(recording, torch.randn(8, 4))
    assert graph == [expected, expected]
    assert torch.is_grad_enabled()


def test_coefficient_0_adds_0_even_where_psi_is_infinite():
    conditioning = ConditioningRegularizer(coefficient=0)(lambda obs: 1e30 * obs, torch.ones(3, 2))
    assert conditioning.psi.isinf().all()
    assert conditioning.penalty == 0


def test_training_with_coefficient_0_is_bit_identical_to_training_without():
    def train(regularizer):
        torch.manual_seed(0)
        policy = stochastic()
        optimizer = torch.optim.Adam(policy.parameters())
        for _ in range(5):
            obs = torch.randn(8, 4)
            loss = policy(obs).square().mean()
            if regularizer is not None:
                loss = loss + regularizer(policy, obs).penalty
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return policy.state_dict()

    plain, measured = train(None), train(ConditioningRegularizer(coefficient=0))
    penalized = train(ConditioningRegularizer(coefficient=1.0))
    assert all(torch.equal(plain[k], measured[k]) for k in plain)
    assert not all(torch.equal(plain[k], penalized[k]) for k in plain)


# --- policies and observations ----------------------------------------------------------------

OUTPUTS = {
    "Normal": (lambda x: td.Normal(x, 1.0), lambda x: x),
    "Independent": (lambda x: td.Independent(td.Normal(x, 1.0), 1), lambda x: x),
    "MultivariateNormal": (lambda x: td.MultivariateNormal(x, torch.eye(3)), lambda x: x),
    "Categorical": (lambda x: td.Categorical(logits=x), lambda x: x.log_softmax(-1)),
    "Bernoulli": (lambda x: td.Bernoulli(logits=x), lambda x: x),
    "tuple": (lambda x: (td.Normal(x, 1.0), 2 * x), lambda x: torch.cat([x, 2 * x], -1)),
    "dict": (lambda x: {"pi": x, "v": x[..., 0]}, lambda x: torch.cat([x, x[..., :1]], -1)),
}


class Answering(nn.Module):
    """The net's output, read by `output`."""

    def __init__(self, net, output):
        super().__init__()
        self.net = net
        self.output = output

    def forward(self, obs):
        return self.output(self.net(obs))


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_any_output_is_measured_as_its_tensor(name, estimator):
    net, obs = mlp(), torch.randn(8, 4)
    output, tensor = OUTPUTS[name]
    regularizer = ConditioningRegularizer(coefficient=1.0, estimator=estimator)
    delta = regularizer.sample_delta(obs)
    got = regularizer(Answering(net, output), obs, delta=delta)
    expected = regularizer(Answering(net, tensor), obs, delta=delta)
    torch.testing.assert_close(got.quotient, expected.quotient)
    got.penalty.backward()
    assert net[0].weight.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("select", "tensor"),
    [
        ("default", lambda x: x.log_softmax(-1)),
        ("logits", lambda x: x.log_softmax(-1)),
        ("probs", lambda x: x.softmax(-1)),
        (lambda output: output.logits.exp(), lambda x: x.softmax(-1)),
    ],
)
def test_output_selects_what_counts(select, tensor):
    net, obs = mlp(), torch.randn(8, 4)
    policy = Answering(net, lambda x: td.Categorical(logits=x))
    got = ConditioningRegularizer(select=select)(policy, obs)
    expected = ConditioningRegularizer()(Answering(net, tensor), obs)
    torch.testing.assert_close(got.quotient, expected.quotient)


class Mixed(nn.Module):
    """Reads a vector, an image and a mode, which chooses a row of an embedding."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(3 + 4, 5)
        self.embedding = nn.Embedding(2, 5)

    def forward(self, obs):
        image = obs["image"].flatten(-2) / 255
        vector = torch.cat([obs["vector"], image], -1)
        return self.linear(vector) + self.embedding(obs["mode"])


def mixed_obs(*batch):
    return {
        "image": torch.randint(0, 256, (*batch, 2, 2), dtype=torch.uint8),
        "mode": torch.randint(0, 2, batch),
        "vector": torch.randn(*batch, 3),
    }


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_dict_observations_share_one_delta(estimator):
    policy, obs = Mixed(), mixed_obs(6)
    regularizer = ConditioningRegularizer(estimator=estimator, radius=2.0)
    delta = regularizer.sample_delta(obs)
    assert list(delta) == list(obs)
    assert delta["mode"] is None
    joined = torch.cat([delta["vector"], delta["image"].flatten(1)], -1)
    torch.testing.assert_close(joined.norm(dim=1), torch.full((6,), 2.0))
    # the policy is linear in vector and image, and the mode drops out
    expected = (joined @ policy.linear.weight.T).norm(dim=1) / 2
    got = regularizer(policy, obs, delta=delta).quotient
    torch.testing.assert_close(got, expected.detach(), rtol=1e-4, atol=1e-5)


def nature():
    return nn.Sequential(
        nn.Conv2d(3, 8, 4, stride=2), nn.ReLU(), nn.Conv2d(8, 8, 3), nn.Flatten(), nn.LazyLinear(5)
    )


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_uint8_images_are_measured_in_the_units_after_division(estimator):
    net, image = nature(), torch.randint(0, 256, (6, 3, 16, 16), dtype=torch.uint8)
    net(image / 255)
    regularizer = ConditioningRegularizer(estimator=estimator)
    delta = regularizer.sample_delta(image)
    got = regularizer(lambda obs: net(obs / 255), image, delta=delta).quotient
    expected = regularizer(net, image / 255, delta=delta).quotient
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-6)


def test_obs_scale_is_what_the_policy_divides_by():
    net, obs = mlp(), torch.randint(0, 1000, (6, 4))
    regularizer = ConditioningRegularizer(obs_scale=1000.0)
    delta = regularizer.sample_delta(obs)
    got = regularizer(lambda x: net(x / 1000), obs, delta=delta).quotient
    expected = ConditioningRegularizer()(net, obs / 1000, delta=delta).quotient
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-6)


def test_extra_leading_axes_index_states():
    policy, obs = mlp(), torch.randn(3, 5, 4)
    regularizer = ConditioningRegularizer(batch_ndim=2)
    delta = regularizer.sample_delta(obs)
    got = regularizer(policy, obs, delta=delta)
    flat = ConditioningRegularizer()(policy, obs.flatten(0, 1), delta=delta.flatten(0, 1))
    assert got.quotient.shape == got.psi.shape == (3, 5)
    torch.testing.assert_close(got.quotient.flatten(), flat.quotient)
    torch.testing.assert_close(got.penalty, flat.penalty)


def test_extra_leading_axes_of_a_dict():
    conditioning = ConditioningRegularizer(batch_ndim=2)(Mixed(), mixed_obs(3, 5))
    assert conditioning.quotient.shape == (3, 5)
    assert (conditioning.quotient > 0).all()


def test_fraction_estimates_on_evenly_spaced_states():
    seen = []
    policy = mlp()

    def recording(obs):
        seen.append(obs.detach())
        return policy(obs)

    obs = torch.randn(10, 4)
    conditioning = ConditioningRegularizer(fraction=0.3)(recording, obs)
    assert conditioning.quotient.shape == conditioning.psi.shape == (3,)
    torch.testing.assert_close(seen[0], obs[[0, 3, 6]])
    whole = ConditioningRegularizer()
    delta = ConditioningRegularizer(fraction=0.3).sample_delta(obs)
    torch.testing.assert_close(
        conditioning.quotient, whole(policy, obs[[0, 3, 6]], delta=delta).quotient
    )


class Recurrent(nn.Module):
    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(4, 6, batch_first=True)
        self.head = nn.Linear(6, 2)

    def forward(self, obs):
        return td.Normal(self.head(self.gru(obs)[0]), 1.0)


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_a_recurrent_policy_is_measured_over_whole_sequences(estimator):
    policy, obs = Recurrent(), torch.randn(3, 7, 4)
    conditioning = ConditioningRegularizer(coefficient=1.0, estimator=estimator)(policy, obs)
    assert conditioning.quotient.shape == (3,)
    assert (conditioning.quotient > 0).all()
    conditioning.penalty.backward()
    assert policy.gru.weight_hh_l0.grad.abs().sum() > 0


# --- noise ------------------------------------------------------------------------------------


@pytest.mark.parametrize("perturbation", ["sphere", "gaussian", "uniform"])
def test_radius_is_the_size_of_a_named_perturbation(perturbation):
    small, large = (
        ConditioningRegularizer(perturbation=perturbation, radius=r).sample_delta(torch.ones(50, 4))
        for r in (0.1, 2.0)
    )
    torch.testing.assert_close(large, 20 * small)


def test_sphere_of_radius_1_is_the_default():
    obs = torch.ones(50, 4)
    default = ConditioningRegularizer().sample_delta(obs)
    torch.testing.assert_close(default.norm(dim=1), torch.ones(50))
    own = ConditioningRegularizer(perturbation=sphere).sample_delta(obs)
    assert torch.equal(default, own)


def test_any_map_of_noise_is_a_perturbation():
    regularizer = ConditioningRegularizer(perturbation=lambda noise: 2 * noise.sign())
    assert regularizer.sample_delta(torch.ones(5, 4)).abs().eq(2).all()


def test_sample_delta_draws_what_a_call_would_have_drawn():
    policy, obs = mlp(), torch.randn(8, 4)
    drawing, given = ConditioningRegularizer(), ConditioningRegularizer()
    first, second = drawing(policy, obs).quotient, drawing(policy, obs).quotient
    assert torch.equal(given(policy, obs, delta=given.sample_delta(obs)).quotient, first)
    assert torch.equal(given(policy, obs, delta=given.sample_delta(obs)).quotient, second)
    assert not torch.equal(first, second)


def test_a_given_delta_draws_no_noise():
    regularizer, obs = ConditioningRegularizer(), torch.randn(8, 4)
    before = regularizer.generator.get_state()
    regularizer(mlp(), obs, delta=torch.ones(8, 4))
    assert torch.equal(regularizer.generator.get_state(), before)


def test_seed_and_generator_choose_the_noise():
    obs = torch.ones(4, 3)
    generator = torch.Generator().manual_seed(7)
    by_seed = ConditioningRegularizer(seed=7).sample_delta(obs)
    assert torch.equal(by_seed, ConditioningRegularizer(generator=generator).sample_delta(obs))
    assert not torch.equal(by_seed, ConditioningRegularizer(seed=8).sample_delta(obs))
    assert not torch.equal(by_seed, ConditioningRegularizer(generator=generator).sample_delta(obs))


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
@pytest.mark.parametrize("coefficient", [0.0, 1.0])
def test_the_default_device_plays_no_part(coefficient, estimator):
    """All is made where the states are, so that a policy on a GPU needs no default device."""
    policy, obs = mlp(), torch.randn(7, 4)
    results = []
    for default in ("cpu", "meta"):
        regularizer = ConditioningRegularizer(coefficient, fraction=0.5, estimator=estimator)
        with torch.device(default):
            conditioning = regularizer(policy, obs)
            results.append((conditioning.penalty.item(), conditioning.metrics()))
    assert results[0] == results[1]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_generator_on_the_gpu_draws_there_for_states_on_either_device():
    for device in ("cuda", "cpu"):
        regularizer = ConditioningRegularizer(generator=torch.Generator("cuda").manual_seed(3))
        drawn = torch.randn(6, 4, generator=torch.Generator("cuda").manual_seed(3), device="cuda")
        obs = torch.ones(6, 4, device=device)
        expected = sphere(drawn).to(device)
        torch.testing.assert_close(regularizer.sample_delta(obs), expected)
        assert regularizer(mlp().to(device), obs).quotient.device.type == device
    state = regularizer.state_dict()
    expected = regularizer.sample_delta(obs)
    regularizer.load_state_dict({name: x.cuda() for name, x in state.items()})
    assert torch.equal(regularizer.sample_delta(obs), expected)


def test_a_saved_regularizer_resumes_the_same_noise(tmp_path):
    obs = torch.ones(4, 3)
    regularizer = ConditioningRegularizer(seed=3)
    regularizer.sample_delta(obs)
    torch.save(regularizer.state_dict(), tmp_path / "regularizer.pt")
    expected = regularizer.sample_delta(obs)
    resumed = ConditioningRegularizer(seed=4)
    resumed.load_state_dict(torch.load(tmp_path / "regularizer.pt", weights_only=True))
    assert torch.equal(resumed.sample_delta(obs), expected)


# --- no trace ---------------------------------------------------------------------------------


def functional_dropout():
    net = mlp()
    return net, lambda obs: F.dropout(net(obs), 0.5, training=True)


def wrapped(wrap):
    net = stochastic()
    return net, wrap(net)


def same(net):
    return net, net


def spectral():
    net = nn.Sequential(parametrizations.spectral_norm(nn.Linear(4, 8)), nn.Linear(8, 3))
    net[0].parametrizations.weight.original.data.normal_()  # the vectors of the old weight are off
    return net


STOCHASTIC = {
    "nn.Dropout": lambda: same(nn.Sequential(nn.Linear(4, 32), nn.Dropout(), nn.Linear(32, 3))),
    "F.dropout": functional_dropout,
    "batch norm": lambda: same(stochastic()),
    "spectral norm": lambda: same(spectral()),
    "bound method": lambda: wrapped(lambda net: net.forward),
    "lambda": lambda: wrapped(lambda net: lambda obs: net(obs)),
    "partial": lambda: wrapped(lambda net: functools.partial(lambda m, obs: m(obs), net)),
}
stochastic_policies = pytest.mark.parametrize("name", STOCHASTIC)


@stochastic_policies
def test_the_policys_own_randomness_is_no_sensitivity(name):
    _, policy = STOCHASTIC[name]()
    obs = torch.randn(16, 4)
    assert ConditioningRegularizer()(policy, obs).quotient.gt(0).all()
    nothing = ConditioningRegularizer(perturbation=no_delta)(policy, obs)
    assert nothing.quotient.eq(0).all()


@stochastic_policies
@pytest.mark.parametrize("estimator", ["difference", "jvp"])
def test_measuring_leaves_no_trace(name, estimator):
    net, policy = STOCHASTIC[name]()
    net[-1].eval()
    before = copy.deepcopy(net.state_dict())
    flags = [m.training for m in net.modules()]
    random_state = torch.get_rng_state()
    ConditioningRegularizer(estimator=estimator)(policy, torch.randn(16, 4, generator=generator()))
    assert torch.equal(torch.get_rng_state(), random_state)
    assert [m.training for m in net.modules()] == flags
    assert net.state_dict().keys() == before.keys()
    assert all(torch.equal(net.state_dict()[k], v) for k, v in before.items())
    assert all(p.grad is None for p in net.parameters())


def generator():
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("name", ["batch norm", "bound method", "lambda", "partial"])
def test_a_state_has_the_same_quotient_in_any_batch(name):
    net, policy = STOCHASTIC[name]()
    net[3].p = 0.0  # dropout masks depend on the place in the batch
    obs = torch.randn(16, 4)
    regularizer = ConditioningRegularizer()
    delta = regularizer.sample_delta(obs)
    whole = regularizer(policy, obs, delta=delta).quotient
    alone = regularizer(policy, obs[3:5], delta=delta[3:5]).quotient
    torch.testing.assert_close(alone, whole[3:5])


# --- precision and compilation ----------------------------------------------------------------


def test_under_bf16_autocast_the_quotient_is_that_of_float32():
    net = nature()
    image = torch.rand(16, 3, 16, 16)
    net(image)
    regularizer = ConditioningRegularizer(coefficient=1.0, radius=0.1)
    delta = regularizer.sample_delta(image)
    expected = regularizer(net, image, delta=delta).quotient
    with torch.autocast("cpu", dtype=torch.bfloat16):
        conditioning = regularizer(net, image, delta=delta)
        naive = (net(image) - net(image + delta)).float().norm(dim=1) / 0.1
        assert torch.is_autocast_enabled("cpu")
    torch.testing.assert_close(conditioning.quotient, expected, rtol=1e-3, atol=0)
    assert ((naive - expected) / expected).abs().mean() > 1e-3
    conditioning.penalty.backward()
    assert net[0].weight.grad.abs().sum() > 0


def test_bf16_observations_are_measured_under_autocast():
    policy, obs = mlp(), torch.randn(8, 4).bfloat16()
    regularizer = ConditioningRegularizer()
    delta = regularizer.sample_delta(obs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        policy(obs)  # autocast lets float32 layers take them
        got = regularizer(policy, obs, delta=delta).quotient
    expected = regularizer(policy, obs.float(), delta=delta).quotient
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=0)


COMPILABLE = {
    "plain": (mlp, lambda: torch.randn(8, 4), {}),
    "one quotient": (mlp, lambda: torch.randn(8, 4), {"reduction": "batch"}),
    "fraction": (mlp, lambda: torch.randn(8, 4), {"fraction": 0.5}),
    "coefficient 0": (mlp, lambda: torch.randn(8, 4), {"coefficient": 0.0}),
    "jvp": (mlp, lambda: torch.randn(8, 4), {"estimator": "jvp"}),
    "Normal": (lambda: Answering(mlp(), OUTPUTS["Normal"][0]), lambda: torch.randn(8, 4), {}),
    "dropout and batch norm": (stochastic, lambda: torch.randn(8, 4), {}),
    "dict": (Mixed, lambda: mixed_obs(8), {}),
    "leading axes": (mlp, lambda: torch.randn(3, 5, 4), {"batch_ndim": 2}),
}


def assert_compiled_equals_eager(name, **compiler):
    make_policy, make_obs, options = COMPILABLE[name]
    policy, obs = make_policy(), make_obs()
    regularizer = ConditioningRegularizer(**{"coefficient": 0.1, **options})
    delta = regularizer.sample_delta(obs)
    before = copy.deepcopy(policy.state_dict())

    @torch.compile(**compiler)
    def step(obs, delta):
        conditioning = regularizer(policy, obs, delta=delta)
        return conditioning.penalty, conditioning.quotient

    def gradients(penalty):
        if not penalty.requires_grad:
            return []
        parameters = list(policy.parameters())
        return torch.autograd.grad(penalty, parameters, allow_unused=True, materialize_grads=True)

    eager = regularizer(policy, obs, delta=delta)
    # both draw the same dropout masks from the same global state
    penalty, quotient = step(obs, delta)
    torch.testing.assert_close(quotient, eager.quotient)
    torch.testing.assert_close(penalty, eager.penalty)
    assert penalty.requires_grad == eager.penalty.requires_grad
    torch.testing.assert_close(gradients(penalty), gradients(eager.penalty))
    assert all(m.training for m in policy.modules())
    assert all(torch.equal(policy.state_dict()[k], v) for k, v in before.items())


@pytest.mark.parametrize("name", COMPILABLE)
def test_compiled_equals_eager(name):
    assert_compiled_equals_eager(name, fullgraph=True, backend="aot_eager")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "dict"])
def test_compiled_by_inductor_equals_eager(name):
    assert_compiled_equals_eager(name, fullgraph=True)


def test_compiled_dropout_is_no_sensitivity():
    policy, obs = stochastic(), torch.randn(8, 4)
    regularizer = ConditioningRegularizer()
    step = torch.compile(lambda x, delta: regularizer(policy, x, delta=delta).quotient, **COMPILED)
    assert step(obs, torch.zeros(8, 4)).eq(0).all()
    assert step(obs, torch.ones(8, 4)).gt(0).all()


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"coefficient": -1e-3},
            ValueError,
            "coefficient must be finite and at least 0, got -0.001",
        ),
        ({"coefficient": math.nan}, ValueError, "at least 0, got nan"),
        ({"coefficient": math.inf}, ValueError, "at least 0, got inf"),
        (
            {"lambda_min": 3.0, "lambda_max": 2.0},
            ValueError,
            "needs 0 <= lambda_min <= lambda_max with lambda_min finite, "
            "got lambda_min=3.0 and lambda_max=2.0",
        ),
        ({"lambda_min": -1.0}, ValueError, "got lambda_min=-1.0"),
        ({"lambda_max": math.nan}, ValueError, "lambda_max=nan"),
        ({"reduction": "state"}, ValueError, "reduction must be 'sample' or 'batch', got 'state'"),
        ({"perturbation": "cube"}, ValueError, "perturbation must be one of"),
        ({"perturbation": 1.0}, TypeError, "perturbation must be a name or a callable, got float"),
        ({"radius": 0.0}, ValueError, "radius must be finite and above 0, got 0.0"),
        ({"radius": -1.0}, ValueError, "radius must be finite and above 0, got -1.0"),
        ({"radius": 2.0, "perturbation": sphere}, ValueError, "a callable sets its own size"),
        ({"select": "variance"}, ValueError, "select must be one of"),
        ({"select": None}, TypeError, "select must be a name or a callable, got NoneType"),
        ({"fraction": 0.0}, ValueError, "fraction must be in (0, 1], got 0.0"),
        ({"fraction": 1.5}, ValueError, "fraction must be in (0, 1], got 1.5"),
        ({"fraction": math.nan}, ValueError, "fraction must be in (0, 1], got nan"),
        (
            {"estimator": "svd"},
            ValueError,
            "estimator must be one of ['difference', 'jvp'], got 'svd'",
        ),
        ({"obs_scale": 0.0}, ValueError, "obs_scale must be finite and above 0, got 0.0"),
        ({"obs_scale": math.inf}, ValueError, "obs_scale must be finite and above 0, got inf"),
        ({"batch_ndim": 0}, ValueError, "batch_ndim must be at least 1, got 0"),
    ],
)
def test_an_argument_is_refused(options, error, message):
    with pytest.raises(error, match=re.escape(message)):
        ConditioningRegularizer(**options)


OBS = torch.ones(6, 4)


@pytest.mark.parametrize(
    ("obs", "error", "message"),
    [
        (torch.ones(0, 4), ValueError, "obs must not be empty, got shapes [(0, 4)]"),
        (OBS * math.nan, ValueError, "obs must be finite, got NaN or infinity"),
        (OBS * math.inf, ValueError, "obs must be finite, got NaN or infinity"),
        (OBS.long(), TypeError, "obs must be floating or uint8, got torch.int64"),
        (OBS.numpy(), TypeError, "obs must be a Tensor or a dict of Tensors, got ndarray"),
        (torch.ones(()), ValueError, "obs needs batch_ndim=1 leading axes"),
    ],
)
def test_observations_are_refused(obs, error, message):
    with pytest.raises(error, match=re.escape(message)):
        ConditioningRegularizer()(mlp(), obs)
    with pytest.raises(error, match=re.escape(message)):
        ConditioningRegularizer().sample_delta(obs)


@pytest.mark.parametrize("estimator", ["difference", "jvp"])
@pytest.mark.parametrize(
    ("output", "error", "message"),
    [
        (lambda x: x.mean(0), ValueError, "begin with the batch axes (6,) of the observations"),
        (lambda x: x.detach(), ValueError, "the policy's output has no gradient"),
        (
            lambda x: x.argmax(-1),
            TypeError,
            "the policy's output must be floating, got torch.int64",
        ),
        (lambda x: "left", TypeError, "a policy must return a Tensor, a Distribution, or a tuple"),
        (lambda x: (), ValueError, "the policy's output holds no tensor"),
        (lambda x: td.Gamma(x.exp(), 1.0), TypeError, "no default output for Gamma"),
    ],
)
def test_an_output_is_refused(estimator, output, error, message):
    with pytest.raises(error, match=re.escape(message)):
        ConditioningRegularizer(estimator=estimator)(Answering(mlp(), output), OBS)


def test_a_policy_without_gradient_can_be_measured():
    policy = mlp().requires_grad_(False)
    with pytest.raises(ValueError, match="or set coefficient=0 to only measure"):
        ConditioningRegularizer()(policy, OBS)
    assert ConditioningRegularizer(coefficient=0)(policy, OBS).quotient.gt(0).all()


def test_a_selector_that_returns_nothing_is_refused():
    with pytest.raises(ValueError, match="select returned None"):
        ConditioningRegularizer(select=lambda output: None)(mlp(), OBS)


@pytest.mark.parametrize(
    ("fraction", "delta", "error", "message"),
    [
        (1.0, torch.ones(6, 3), ValueError, "leaves of shape [(6, 4)], got [(6, 3)]"),
        (0.5, torch.ones(6, 4), ValueError, "leaves of shape [(3, 4)], got [(6, 4)]"),
        (1.0, {"x": torch.ones(6, 4), "y": None}, ValueError, "delta must match"),
        (1.0, torch.ones(6, 4, dtype=torch.int64), TypeError, "delta must be floating"),
    ],
)
def test_a_delta_is_refused(fraction, delta, error, message):
    with pytest.raises(error, match=re.escape(message)):
        ConditioningRegularizer(fraction=fraction)(mlp(), OBS, delta=delta)


@pytest.mark.parametrize(
    ("perturbation", "got"),
    [(lambda noise: noise[:, :2], "got (6, 2)"), (lambda noise: noise.numpy(), "got ndarray")],
)
def test_a_perturbation_must_keep_the_shape(perturbation, got):
    message = "perturbation must map noise of shape (6, 4) to a delta of that shape, " + got
    with pytest.raises(ValueError, match=re.escape(message)):
        ConditioningRegularizer(perturbation=perturbation)(mlp(), OBS)


# --- metrics and the printed sign ----------------------------------------------------------------


def test_metrics_by_hand():
    quotient = torch.tensor([0.5, 2.0, 2.0, 3.0, 25.0])
    conditioning = Conditioning(
        penalty=torch.tensor(0.0),
        psi=torch.tensor([0.25, 0.0, 0.0, 0.0, 25.0]),
        quotient=quotient,
        fraction_below=torch.tensor(0.2),
        fraction_above=torch.tensor(0.2),
    )
    expected = {
        "a/psi": 5.05,
        "a/quotient_q05": 0.5 + 0.2 * 1.5,
        "a/quotient_q50": 2.0,
        "a/quotient_q95": 3.0 + 0.8 * 22.0,
        "a/quotient_squared": (0.25 + 4 + 4 + 9 + 625) / 5,
        "a/fraction_below": 0.2,
        "a/fraction_above": 0.2,
    }
    assert conditioning.metrics("a/") == pytest.approx(expected)
    assert all(name.startswith("conditioning/") for name in conditioning.metrics())


def test_metrics_of_one_quotient_for_the_batch():
    net, obs = mlp(), torch.randn(6, 4)
    conditioning = ConditioningRegularizer(reduction="batch")(net, obs)
    metrics = conditioning.metrics("")
    quotient = conditioning.quotient.item()
    assert metrics["quotient_q05"] == metrics["quotient_q95"] == pytest.approx(quotient)
    assert metrics["psi"] == pytest.approx(conditioning.psi.item())


@pytest.mark.parametrize("coefficient", [0.0, 0.5])
def test_the_printed_sign_negates_the_penalty(coefficient):
    net, obs = mlp(), torch.randn(6, 4)
    penalty = ConditioningRegularizer(coefficient)(net, obs).penalty
    printed = ConditioningRegularizer(coefficient, printed_sign=True)(net, obs).penalty
    assert printed.item() == -penalty.item()
    assert (penalty.item() > 0) == (coefficient > 0)
