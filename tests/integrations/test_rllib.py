"""RLlib's new API stack with a penalty in the learner's loss."""

from __future__ import annotations

import pytest
import torch

from condwrap import ConditioningRegularizer
from tests.integrations import running

running.require("ray", "ray.rllib.algorithms.ppo", "gymnasium")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
example = running.load("rllib_ppo")

SIZE = {"iterations": 2, "batch": 256}


@pytest.fixture(scope="module", autouse=True)
def cluster():
    import ray

    ray.init(num_cpus=1, include_dashboard=False, object_store_memory=10**8, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def train():
    """Train the example, and stop its algorithm in the end."""
    made = []

    def run(*args, **kwargs):
        made.append(example.train(*args, **kwargs))
        return made[-1]

    yield run
    for algorithm, _ in made:
        algorithm.stop()


@pytest.fixture
def plain():
    from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner

    return PPOTorchLearner


def learner_of(algorithm):
    return algorithm.learner_group._learner


def module_of(algorithm):
    return learner_of(algorithm).module["default_policy"].unwrapped()


def test_the_example_returns_psi_of_every_iteration(train):
    _, rows = train(**SIZE)
    psi = [float(row["conditioning/psi"]) for row in rows]
    assert len(psi) == 2
    assert all(0 < value < 1 for value in psi)


def test_coefficient_0_trains_as_rllibs_own_class(train, plain):
    measured, rows = train(0.0, **SIZE)
    regularized, _ = train(0.1, **SIZE)
    expected, _ = train(learner=plain, **SIZE)
    weights = [running.weights(module_of(x)) for x in (measured, regularized, expected)]
    running.assert_same_bits(weights[0], weights[2])
    assert float(rows[-1]["conditioning/psi"]) > 0

    with pytest.raises(AssertionError):  # so that the comparison can fail
        running.assert_same_bits(weights[1], weights[2])


def test_a_large_coefficient_moves_psi(train):
    last = [float(train(x, **SIZE)[1][-1]["conditioning/psi"]) for x in (0.0, 1000.0)]
    assert last[1] < last[0] - 0.1


def test_saving_and_loading(train, plain, tmp_path):
    trained, _ = train(**SIZE)
    trained.save_to_path(str(tmp_path / "checkpoint"))
    fresh, _ = train(iterations=0, learner=plain)
    fresh.restore_from_path(str(tmp_path / "checkpoint"))
    running.assert_same_bits(running.weights(module_of(trained)), running.weights(module_of(fresh)))


def make_batch(module):
    noise = torch.Generator().manual_seed(3)
    obs = torch.randn(32, 3, generator=noise)
    with torch.no_grad():
        inputs = module.forward_train({"obs": obs})["action_dist_inputs"]
    return {
        "obs": obs,
        "actions": torch.randn(32, 1, generator=noise),
        "action_dist_inputs": inputs,
        "action_logp": torch.randn(32, generator=noise),
        "advantages": torch.randn(32, generator=noise),
        "value_targets": torch.randn(32, generator=noise),
        "loss_mask": torch.arange(32) < 24,
    }


def gradients_of(learner, batch):
    module = learner.module["default_policy"].unwrapped()
    module.zero_grad()
    loss = learner.compute_loss_for_module(
        module_id="default_policy",
        config=learner.config,
        batch=batch,
        fwd_out=module.forward_train(batch),
    )
    loss.backward()
    return running.gradients(module)


def test_the_gradient_is_the_explicit_penaltys(train, plain):
    learner = learner_of(train(0.3, iterations=0)[0])
    module = learner.module["default_policy"].unwrapped()
    batch = make_batch(module)
    found = gradients_of(learner, batch)

    def mean(obs):
        features = module.encoder.actor_encoder({"obs": obs})["encoder_out"]
        return module.pi(features)[:, :1]  # the other column is the log standard deviation

    penalty = ConditioningRegularizer(0.3)(mean, batch["obs"][:24]).penalty
    penalty_gradients = torch.autograd.grad(penalty, list(module.parameters()), allow_unused=True)
    learner.config.learner_config_dict.clear()  # then it is RLlib's own
    of_loss = gradients_of(learner, batch)
    expected = [
        one if other is None else one + other
        for one, other in zip(of_loss, penalty_gradients, strict=True)
    ]
    running.assert_close(found, expected)
    assert any(x is not None and x.abs().max() > 1e-3 for x in penalty_gradients)


def test_what_has_a_recurrent_state_is_refused(train, monkeypatch):
    learner = learner_of(train(iterations=0)[0])
    module = learner.module["default_policy"].unwrapped()
    batch = make_batch(module)
    monkeypatch.setattr(module, "is_stateful", lambda: True)
    with pytest.raises(ValueError, match=r"'default_policy' has a recurrent state"):
        gradients_of(learner, batch)


def test_an_unknown_distribution_is_refused():
    from condwrap.integrations.rllib import _torch_distribution

    with pytest.raises(ValueError, match=r"no mean or logits are known of RLlib's dict"):
        _torch_distribution({})
