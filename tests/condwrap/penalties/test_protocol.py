"""What holds for every penalty: one call, one result, and no trace in the training."""

import inspect

import pytest
import torch
from torch import distributions as td
from torch import nn

from condwrap import ConditioningRegularizer, attach, penalties
from condwrap.penalties import (
    PENALTIES,
    AugmentationConsistency,
    ConditioningPenalty,
    Penalty,
    augmentation,
    jacobian_norm,
    lipschitz_policy,
    spectral,
    state_adversarial,
)
from condwrap.penalties.protocol import penalized
from tests.condwrap.penalties.helpers import Gaussian, mlp

F64 = torch.float64
DRAWN = ["conditioning", "jacobian", "caps", "l2c2", "sa", "drac"]
every_penalty = pytest.mark.parametrize("name", PENALTIES)


def make(name, **options) -> Penalty:
    if name == "drac":
        options["augment"] = options.get("augment", lambda obs: obs.flip(-1))
    return PENALTIES[name](**options)


def batch():
    """All that a training loop has."""
    obs = torch.randn(6, 3, dtype=F64)
    return obs, {
        "next_obs": obs + 0.1,
        "dones": torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
        "actions": torch.randn(6, 2, dtype=F64),
        "value": nn.Sequential(nn.Linear(3, 1, dtype=F64)),
    }


@every_penalty
def test_a_loop_passes_all_that_it_has(name):
    policy = Gaussian(mlp(), [0.0, 0.0])
    obs, given = batch()
    result = make(name)(policy, obs, output=policy(obs), **given)
    assert result.penalty.shape == ()
    result.penalty.backward()
    assert any(p.grad is not None and p.grad.any() for p in policy.parameters())
    metrics = result.metrics()
    assert metrics
    prefix = "conditioning/" if name == "conditioning" else "penalty/"
    assert all(key.startswith(prefix) and type(x) is float for key, x in metrics.items())


@every_penalty
def test_what_it_needs_is_what_it_cannot_do_without(name):
    policy = Gaussian(mlp(), [0.0, 0.0])
    obs, given = batch()
    penalty = make(name)
    needed = {key: given[key] for key in penalty.needs}
    penalty(policy, obs, **needed)
    for lacking in penalty.needs:
        with pytest.raises(ValueError, match=f"needs {lacking}:"):
            penalty(policy, obs, **{**needed, lacking: None})


@every_penalty
def test_a_weight_of_zero_adds_nothing(name):
    weights = {
        "conditioning": {"regularizer": ConditioningRegularizer(coefficient=0.0)},
        "caps": {"temporal": 0.0, "spatial": 0.0},
    }
    penalty = make(name, **weights.get(name, {"coefficient": 0.0}))
    obs, given = batch()
    result = penalty(Gaussian(mlp(), [0.0, 0.0]), obs, **given)
    assert result.penalty.item() == 0.0
    assert not result.penalty.requires_grad
    assert bool(result.metrics()) == (name not in ("caps", "l2c2"))


def test_a_weight_of_zero_does_not_multiply():
    result = penalized({"a": (0.0, torch.tensor(torch.inf)), "b": (0.0, torch.ones(()))})
    assert result.penalty.item() == 0.0
    assert result.metrics("x/") == {"x/a": torch.inf, "x/b": 1.0}


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("jacobian", jacobian_norm),
        ("lcp", lipschitz_policy),
        ("sa", state_adversarial),
        ("spectral", spectral),
        ("drac", augmentation),
    ],
)
def test_a_weight_of_zero_builds_no_graph(name, module, monkeypatch):
    def spy(weighted):
        assert not any(term.requires_grad for _, term in weighted.values())
        return penalized(weighted)

    monkeypatch.setattr(module, "penalized", spy)
    obs, given = batch()
    make(name, coefficient=0.0)(Gaussian(mlp(), [0.0, 0.0]), obs, **given)


@pytest.mark.parametrize("name", [name for name in PENALTIES if name != "lcp"])
def test_training_draws_the_same_noise_as_without_it(name):
    obs, given = batch()
    policy = Gaussian(mlp(), [0.0, 0.0])
    state = torch.get_rng_state()
    make(name)(policy, obs, **given)
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize("name", DRAWN)
def test_a_resumed_penalty_draws_what_it_would_have_drawn(name):
    images = torch.randint(0, 256, (4, 1, 6, 6), dtype=torch.uint8)
    net = nn.Sequential(nn.Flatten(), nn.Linear(36, 2))

    def policy(obs):
        return td.Normal(net(obs / 255), 1.0)

    options = {"value_term": False} if name == "drac" else {}
    given = {"next_obs": images.flip(-1), "dones": torch.zeros(4)}
    first, resumed = PENALTIES[name](**options), PENALTIES[name](**options)
    first(policy, images, **given)
    resumed.load_state_dict(first.state_dict())
    after = first(policy, images, **given).penalty
    assert torch.equal(after, resumed(policy, images, **given).penalty)
    assert not torch.equal(after, PENALTIES[name](**options)(policy, images, **given).penalty)


@pytest.mark.parametrize("name", ["jacobian", "caps", "l2c2", "spectral", "conditioning"])
def test_dropout_and_batch_norm_leave_no_trace(name):
    net = nn.Sequential(nn.Linear(3, 8), nn.BatchNorm1d(8), nn.Dropout(0.5), nn.Linear(8, 2))
    net = net.double()
    obs, given = batch()
    net(obs)
    before = {k: x.clone() for k, x in net.state_dict().items()}
    make(name)(net, obs, **given)
    assert net.training
    assert all(torch.equal(x, before[k]) for k, x in net.state_dict().items())
    # both evaluations share their masks: nothing moved, so nothing changed
    still = {**given, "next_obs": obs}
    if name == "caps":
        assert PENALTIES["caps"](spatial=0.0)(net, obs, **still).penalty.item() == 0.0


@every_penalty
def test_autocast_does_not_round_it(name):
    policy = Gaussian(mlp(), [0.0, 0.0]).float()
    obs, given = batch()
    obs = obs.float()
    given = {key: x.float() for key, x in given.items()}
    want = make(name)(policy, obs, **given)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = make(name)(policy, obs, **given)
    assert got.penalty == want.penalty


@pytest.mark.parametrize("name", [name for name in PENALTIES if name != "lcp"])
def test_a_policy_without_a_gradient_is_refused(name):
    policy = Gaussian(mlp(), [0.0, 0.0]).requires_grad_(False)
    obs, given = batch()
    given["value"].requires_grad_(False)
    with pytest.raises(ValueError, match="output has no gradient"):
        make(name)(policy, obs, **given)


@every_penalty
@pytest.mark.parametrize("bad", ["nan", "empty", "text"])
def test_bad_observations_are_refused(name, bad):
    obs, given = batch()
    wrong = {"nan": obs * torch.nan, "empty": obs[:0], "text": "obs"}[bad]
    with pytest.raises((TypeError, ValueError), match=r"^obs must"):
        make(name)(Gaussian(mlp(), [0.0, 0.0]), wrong, **given)


@pytest.mark.parametrize("name", ["caps", "l2c2"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"next_obs": torch.zeros(5, 3)}, r"next_obs must match obs, .* got \[\(5, 3\)\]"),
        ({"next_obs": {"a": torch.zeros(6, 3)}}, "next_obs must match obs"),
        ({"next_obs": "text"}, r"next_obs must match obs, .* got \['str'\]"),
        ({"dones": torch.zeros(6, 1)}, r"dones must be a tensor of shape \(6,\), .* \(6, 1\)"),
        ({"dones": [False] * 6}, r"dones must be a tensor of shape \(6,\), .* got list"),
        ({"next_obs": torch.full((6, 3), torch.nan)}, "obs must be finite"),
    ],
)
def test_bad_successors_are_refused(name, change, message):
    obs, given = batch()
    with pytest.raises(ValueError, match=message):
        make(name)(mlp(), obs, **{**given, **change})


@pytest.mark.parametrize("name", ["caps", "l2c2"])
def test_dicts_of_observations_follow_each_other(name):
    def policy(obs):
        return net(torch.cat([obs["joints"], obs["speed"]], -1))

    net = mlp()
    obs, given = batch()
    parts = [{"joints": x[:, :2], "speed": x[:, 2:]} for x in (obs, given["next_obs"])]
    flat = make(name)(net, obs, **given).penalty
    apart = make(name)(policy, parts[0], **{**given, "next_obs": parts[1]}).penalty
    torch.testing.assert_close(apart, flat)


def test_a_distribution_that_lost_the_batch_is_refused():
    def policy(obs):
        return td.Normal(mlp()(obs).sum(0), 1.0)

    obs, given = batch()
    with pytest.raises(ValueError, match="must begin with the batch axis"):
        PENALTIES["lcp"]()(policy, obs, **given)


def test_a_distribution_is_found_beside_tensors():
    policy = Gaussian(mlp(), [0.0, 0.0])
    obs, given = batch()
    for name in ("lcp", "sa", "drac"):
        alone = make(name)(policy, obs, **given).penalty
        beside = make(name)(lambda x: {"pi": policy(x), "v": x[:, 0]}, obs, **given).penalty
        assert torch.equal(alone, beside)
    with pytest.raises(TypeError, match=r"returns one .*, got 2 in a tuple"):
        make("sa")(lambda x: (policy(x), policy(x)), obs)


def test_conditioning_is_that_of_its_regularizer():
    policy, (obs, given) = mlp(), batch()
    want = ConditioningRegularizer()(policy, obs)
    got = ConditioningPenalty()(policy, obs, output=policy(obs), **given)
    assert torch.equal(got.penalty, want.penalty)
    jvp = ConditioningPenalty(ConditioningRegularizer(estimator="jvp"))
    assert jvp(policy, obs, output=policy(obs)).penalty > 0  # it has no use for the output


def test_every_public_name_has_an_example():
    members = [getattr(penalties, name) for name in penalties.__all__ if name != "PENALTIES"]
    assert all(">>>" in inspect.getdoc(member) for member in members)
    assert AugmentationConsistency in PENALTIES.values()


@pytest.mark.parametrize("name", ["jacobian", "sa", "spectral", "conditioning"])
def test_what_needs_no_more_can_be_attached(name):
    policy, (obs, _) = Gaussian(mlp(), [0.0, 0.0]), batch()
    loss = policy(obs).mean.square().mean() + make(name)(policy, obs).penalty
    want = torch.autograd.grad(loss, list(policy.parameters()), allow_unused=True)

    with attach(policy, make(name)) as handle:
        policy(obs).mean.square().mean().backward()
    assert handle.metrics()["attach/backwards"] == 1.0
    for parameter, gradient in zip(policy.parameters(), want, strict=True):
        got = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        torch.testing.assert_close(got, torch.zeros_like(got) if gradient is None else gradient)


def test_what_needs_more_is_not_attached():
    with pytest.raises(ValueError, match="CAPS needs next_obs and dones, which a module's call"):
        attach(mlp(), PENALTIES["caps"]())
