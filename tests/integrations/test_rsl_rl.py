"""rsl-rl with a penalty that is chosen by class_name."""

from __future__ import annotations

import pytest
import torch

from condwrap import ConditioningRegularizer, attach
from tests.integrations import running

running.require("rsl_rl", "tensorboard")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
example = running.load("rsl_rl_ppo")


def weights(runner):
    models = {"actor": runner.alg.actor, "critic": runner.alg.critic}
    return {f"{a}.{b}": x for a, m in models.items() for b, x in running.weights(m).items()}


def logged(folder, name="conditioning/psi"):
    return running.tensorboard(folder, f"Loss/{name}")


@pytest.fixture
def change(monkeypatch):
    """Train the example with another configuration."""

    def use(edit):
        runner = example.OnPolicyRunner

        def changed(env, cfg, log_dir):
            edit(cfg)
            return runner(env, cfg, log_dir)

        monkeypatch.setattr(example, "OnPolicyRunner", changed)

    return use


def test_the_example_learns_and_logs_psi_of_every_update(tmp_path):
    example.train(log_dir=str(tmp_path))
    assert len(logged(tmp_path)) == 20
    assert all(0 < psi < 1 for psi in logged(tmp_path))
    assert logged(tmp_path, "attach/backwards") == [20.0] * 20  # 5 epochs of 4 minibatches
    reward = running.tensorboard(tmp_path, "Train/mean_reward")
    assert reward[-1] > reward[0] + 10


def test_coefficient_0_trains_as_rsl_rls_own_class(tmp_path, change):
    size = {"iterations": 3}
    measured = weights(example.train(0.0, log_dir=str(tmp_path / "0"), **size))
    regularized = weights(example.train(0.1, log_dir=str(tmp_path / "1"), **size))
    change(lambda cfg: cfg.update(algorithm={"class_name": "PPO"}))
    plain = weights(example.train(log_dir=str(tmp_path / "2"), **size))
    running.assert_same_bits(measured, plain)
    assert len(logged(tmp_path / "0")) == 3

    with pytest.raises(AssertionError):  # so that the comparison can fail
        running.assert_same_bits(regularized, plain)


def test_without_its_configuration_it_is_rsl_rls_own_class(tmp_path, change):
    change(lambda cfg: cfg["algorithm"].pop("conditioning_cfg"))
    runner = example.train(iterations=1, log_dir=str(tmp_path))
    assert runner.alg.penalty is None
    with pytest.raises(KeyError):
        logged(tmp_path)


def test_a_large_coefficient_moves_psi(tmp_path):
    for coefficient in (0.0, 1000.0):
        example.train(coefficient, iterations=4, log_dir=str(tmp_path / str(coefficient)))
    assert logged(tmp_path / "1000.0")[-1] < logged(tmp_path / "0.0")[-1] - 0.2


def test_saving_and_loading(tmp_path, change):
    trained = example.train(iterations=2, log_dir=str(tmp_path / "1"))
    trained.save(str(tmp_path / "model.pt"))
    change(lambda cfg: cfg.update(algorithm={"class_name": "PPO"}))
    fresh = example.train(iterations=1, log_dir=str(tmp_path / "2"))
    fresh.load(str(tmp_path / "model.pt"))
    running.assert_same_bits(weights(trained), weights(fresh))
    script = torch.jit.script(trained.alg.get_policy().as_jit())
    assert script(torch.zeros(3, 2)).shape == (3, 2)


@pytest.mark.parametrize("distribution", ["Gaussian", "HeteroscedasticGaussian"])
def test_the_gradient_is_the_explicit_penaltys(distribution, tmp_path, change):
    name = {"class_name": f"{distribution}Distribution"}
    change(lambda cfg: cfg["actor"].update(distribution_cfg=name, obs_normalization=True))
    change(lambda cfg: cfg["algorithm"]["conditioning_cfg"].update(coefficient=0.3))
    runner = example.train(iterations=1, log_dir=str(tmp_path))
    actor = runner.alg.actor
    obs = runner.env.get_observations()

    def loss():
        actor(obs, stochastic_output=True)
        return -actor.get_output_log_prob(torch.ones(64, 2)).mean()

    actor.zero_grad()
    with attach(actor.mlp, runner.alg.penalty):
        runner.alg.penalty.generator.manual_seed(2)
        loss().backward()
    found = running.gradients(actor)
    latent = actor.get_latent(obs)

    def mean(x):
        return actor.mlp(x) if distribution == "Gaussian" else actor.mlp(x)[..., 0, :]

    penalty = ConditioningRegularizer(0.3, seed=2)(mean, latent).penalty
    (loss() + penalty).backward()
    running.assert_close(found, running.gradients(actor))


def test_an_actor_whose_mlp_sees_a_latent_is_refused(tmp_path, change):
    change(lambda cfg: cfg["actor"].update(class_name="RNNModel"))
    with pytest.raises(ValueError, match=r"must be an MLPModel, got RNNModel.*leave"):
        example.train(iterations=1, log_dir=str(tmp_path))


def test_compiled_models_are_refused(tmp_path, change):
    change(lambda cfg: cfg.update(torch_compile_mode="default"))
    with pytest.raises(ValueError, match=r"torch_compile_mode='default' does not go with"):
        example.train(iterations=1, log_dir=str(tmp_path))
