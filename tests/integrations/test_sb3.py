"""Penalties in the real Stable-Baselines3 and sb3-contrib; `make integrations` installs both."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import gymnasium
import sb3_contrib
import stable_baselines3 as sb3
import torch
from gymnasium import spaces
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.logger import KVWriter, Logger
from torch import nn

from condwrap import ConditioningRegularizer
from condwrap.__main__ import main
from condwrap.disk import DiskError, read_policy
from condwrap.integrations.sb3 import attach
from condwrap.integrations.sb3_actors import log_probabilities
from condwrap.integrations.sb3_trpo import TRPO
from condwrap.policy import flat_output

EXAMPLES = Path(__file__).parents[2] / "examples"
LARGE = 10.0

torch.set_num_threads(1)


class Walk(gymnasium.Env):
    """Random observations, and episodes of 7 to 13 steps; the first half of the actions pays."""

    def __init__(self, obs_space=None, action_space=None):
        self.observation_space = obs_space or spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.action_space = action_space or spaces.Discrete(4)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            super().reset(seed=seed)
            self.observation_space.seed(seed)
        self.steps = int(self.np_random.integers(7, 14))
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps -= 1
        reward = float(np.asarray(action).flat[0] < 2)
        return self.observation_space.sample(), reward, self.steps == 0, False, {}

    def action_masks(self):
        space = self.action_space
        sizes = space.nvec if isinstance(space, spaces.MultiDiscrete) else [space.n]
        masks = []
        for size in sizes:
            allowed = np.arange(size) != self.steps % size  # one action is forbidden
            masks.append(allowed)
        return np.concatenate(masks)


@dataclasses.dataclass(frozen=True)
class Case:
    """An algorithm, and a training of it that takes a second or two."""

    algorithm: type
    env: str = "Pendulum-v1"
    steps: int = 256
    policy: str = "MlpPolicy"
    arguments: dict = dataclasses.field(default_factory=dict)
    net_arch: object = (32,)

    def make(self, seed=0):
        arch = self.net_arch if isinstance(self.net_arch, dict) else list(self.net_arch)
        arguments = {"policy_kwargs": {"net_arch": arch}, "learning_rate": 3e-3}
        arguments |= {"seed": seed, "device": "cpu"}
        env = Walk() if self.env == "walk" else self.env
        return self.algorithm(self.policy, env, **(arguments | self.arguments))

    def train(self, coefficient=None, **arguments):
        """The trained model and the penalty's handle, None without a coefficient."""
        model = self.make()
        handle = None
        if coefficient is not None:
            handle = attach(model, ConditioningRegularizer(coefficient, **arguments))
        model.learn(self.steps, log_interval=1)
        return model, handle


ON_POLICY = {"n_steps": 64, "n_epochs": 8, "batch_size": 32}
OFF_POLICY = {"learning_starts": 50, "batch_size": 32}
VALUES = OFF_POLICY | {"train_freq": 1}
QUANTILES = {"policy_kwargs": {"net_arch": [32], "n_quantiles": 8}}
NETS = {"pi": [32], "qf": [32]}

CASES = [
    Case(sb3.PPO, arguments=ON_POLICY),
    Case(sb3.A2C, "CartPole-v1", steps=512),
    Case(sb3.SAC, net_arch=NETS, arguments=OFF_POLICY),
    Case(sb3.TD3, net_arch=NETS, arguments=OFF_POLICY),
    Case(sb3.DDPG, net_arch=NETS, arguments=OFF_POLICY),
    Case(sb3.DQN, "CartPole-v1", arguments=VALUES),
    Case(sb3_contrib.TQC, net_arch=NETS, arguments=OFF_POLICY),
    Case(sb3_contrib.QRDQN, "CartPole-v1", arguments=VALUES | QUANTILES),
    Case(sb3_contrib.CrossQ, net_arch=NETS, arguments=OFF_POLICY),
    Case(sb3_contrib.MaskablePPO, "walk", arguments=ON_POLICY),
    Case(
        sb3_contrib.RecurrentPPO,
        "CartPole-v1",
        policy="MlpLstmPolicy",
        arguments=ON_POLICY | {"policy_kwargs": {"lstm_hidden_size": 16}},
    ),
    Case(TRPO, arguments={"n_steps": 64, "batch_size": 32, "target_kl": 0.05}),
]
EACH = pytest.mark.parametrize("case", CASES, ids=lambda case: case.algorithm.__name__)


def case_of(algorithm):
    (found,) = [case for case in CASES if case.algorithm is algorithm]
    return found


def assert_equal(one, other):
    """Every number of two models is the same."""
    for name, value in one.policy.state_dict().items():
        assert torch.equal(value, other.policy.state_dict()[name]), name
    for name in ("log_ent_coef",):
        if hasattr(one, name):
            assert torch.equal(getattr(one, name), getattr(other, name))
    assert one.num_timesteps == other.num_timesteps


def observations(model, rows=64):
    space = model.observation_space
    space.seed(0)
    return model.policy.obs_to_tensor(np.stack([space.sample() for _ in range(rows)]))[0]


def output_of(model, obs):
    """What should count, by SB3's own methods and from the raw observation."""
    policy = model.policy
    name = type(model).__name__
    if name == "RecurrentPPO":
        rows = len(obs)
        size = policy.lstm_actor.hidden_size
        states = (torch.zeros(1, rows, size), torch.zeros(1, rows, size))
        return policy.get_distribution(obs, states, torch.zeros(rows))[0].distribution.logits
    if name in ("PPO", "A2C", "MaskablePPO", "TRPO"):
        return policy.get_distribution(obs).distribution
    if name in ("SAC", "TQC", "CrossQ"):
        return policy.actor.get_action_dist_params(obs)[0]
    if name in ("TD3", "DDPG"):
        return policy.actor(obs)
    if name == "DQN":
        return policy.q_net(obs)
    return policy.quantile_net(obs).mean(1)


def psi_of(model):
    model.policy.set_training_mode(False)
    penalty = ConditioningRegularizer(0.0)
    return penalty(lambda obs: output_of(model, obs), observations(model)).metrics()[
        "conditioning/psi"
    ]


# --- training ------------------------------------------------------------------------------------


@EACH
def test_coefficient_0_changes_no_bit_and_is_measured(case):
    plain, _ = case.train()
    measured, handle = case.train(coefficient=0.0)
    assert_equal(plain, measured)
    found = handle.metrics()
    assert 0 < found["conditioning/psi"] < 1
    assert found["attach/forwards"] == found["attach/backwards"] > 0


@EACH
def test_a_large_coefficient_lowers_psi(case):
    plain, _ = case.train()
    regularized, _ = case.train(LARGE)
    assert psi_of(regularized) < 0.9 * psi_of(plain)


class Memory(KVWriter):
    """Keeps what a logger dumps."""

    def __init__(self):
        self.dumped = []

    def write(self, values, excluded, step=0):
        self.dumped.append(dict(values))

    def close(self):
        pass


@EACH
def test_psi_is_in_the_models_logger(case):
    model = case.make()
    memory = Memory()
    model.set_logger(Logger(None, [memory]))
    handle = attach(model, ConditioningRegularizer(0.0))
    model.learn(case.steps, log_interval=1)
    logged = [
        values["conditioning/psi"] for values in memory.dumped if "conditioning/psi" in values
    ]
    assert logged
    assert all(0 < psi <= 1 for psi in logged)
    assert "conditioning/quotient_q50" in memory.dumped[-1] | dict(model.logger.name_to_value)
    handle.remove()


@EACH
def test_saved_and_loaded_it_trains_on_and_can_be_regularized_again(case, tmp_path):
    model, _ = case.train(LARGE)
    model.save(tmp_path / "model.zip")
    env = model.get_env()
    loaded = case.algorithm.load(tmp_path / "model.zip", env=env, device="cpu")
    assert_equal(model, loaded)
    handle = attach(loaded, ConditioningRegularizer(LARGE))
    loaded.learn(case.steps, reset_num_timesteps=False)
    assert handle.metrics()["attach/backwards"] > 0

    obs = observations(loaded, rows=1)[0].numpy()
    handle.remove()
    assert loaded.predict(obs, deterministic=True)[0] is not None


@EACH
def test_removed_it_leaves_the_model_as_it_was(case):
    plain, _ = case.train()
    model = case.make()
    with attach(model, ConditioningRegularizer(LARGE)):
        pass
    model.learn(case.steps, log_interval=1)
    assert_equal(plain, model)
    for module in model.policy.modules():
        assert not module._forward_hooks
        assert not module._forward_pre_hooks
    assert "evaluate_actions" not in vars(model.policy)
    assert "get" not in vars(getattr(model, "rollout_buffer", model))


@EACH
def test_a_copy_of_the_policy_is_without_the_penalty(case):
    model = case.make()
    handle = attach(model, ConditioningRegularizer(LARGE))
    copied = copy.deepcopy(model.policy)
    pickled = pickle.loads(pickle.dumps(model.policy.state_dict()))
    copied.load_state_dict(pickled)
    original = model.policy
    model.policy = copied
    copied.set_training_mode(True)
    obs = observations(model)
    output = output_of(model, obs)
    tensor = output if isinstance(output, torch.Tensor) else output.log_prob(output.sample())
    tensor.sum().backward()
    assert handle.metrics()["attach/forwards"] == 0
    model.policy = original


# --- the gradient --------------------------------------------------------------------------------


def loss_of(model, obs):
    """A loss that calls the actor as the algorithm's own update does."""
    policy = model.policy
    name = type(model).__name__
    if name == "RecurrentPPO":
        size = policy.lstm_actor.hidden_size
        zeros = torch.zeros(1, len(obs), size)
        states = RNNStates((zeros, zeros), (zeros, zeros))
        actions = torch.zeros(len(obs))
        values, logprob, entropy = policy.evaluate_actions(
            obs, actions, states, torch.zeros(len(obs))
        )
        return (values.mean() + logprob.mean() - entropy.mean()) / 3
    if name in ("PPO", "A2C", "MaskablePPO"):
        rows = len(next(iter(obs.values()))) if isinstance(obs, dict) else len(obs)
        actions = torch.zeros(rows, *model.action_space.shape)
        values, logprob, entropy = policy.evaluate_actions(obs, actions)
        return values.mean() + logprob.mean() - entropy.mean()
    if name in ("SAC", "TQC", "CrossQ"):
        actions, logprob = model.actor.action_log_prob(obs)
        return actions.square().mean() + logprob.mean()
    return output_of(model, obs).square().mean()


def gradients_of(model, loss):
    model.policy.zero_grad()
    loss.backward()
    return {
        name: p.grad.clone() for name, p in model.policy.named_parameters() if p.grad is not None
    }


def assert_close(found, expected):
    """Within 0.1% of a parameter's largest gradient: SB3 computes in float32."""
    for name, value in expected.items():
        error = (found[name] - value).abs().max()
        assert error <= 1e-3 * max(float(value.abs().max()), 1e-3), name


def assert_gradient_is_explicit(model, **arguments):
    """Attached, the gradient is that of loss + penalty, with the policy by SB3's own methods."""
    obs = observations(model, rows=8)
    model.policy.set_training_mode(True)
    if hasattr(model, "actor") and hasattr(model.actor, "set_bn_training_mode"):
        model.actor.set_bn_training_mode(False)  # as CrossQ has it in its backward pass
    torch.manual_seed(1)
    loss = loss_of(model, obs)
    plain = gradients_of(model, loss)
    penalty = ConditioningRegularizer(LARGE, seed=3, **arguments)
    torch.manual_seed(1)
    loss = loss_of(model, obs) + penalty(lambda obs: output_of(model, obs), obs).penalty
    expected = gradients_of(model, loss)

    with attach(model, ConditioningRegularizer(LARGE, seed=3, **arguments)):
        torch.manual_seed(1)
        found = gradients_of(model, loss_of(model, obs))
    assert found.keys() == expected.keys()
    assert any((expected[name] - plain[name]).abs().max() > 1e-2 for name in plain)
    assert_close(found, expected)


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.algorithm is not TRPO], ids=lambda c: c.algorithm.__name__
)
def test_the_gradient_is_that_of_loss_plus_penalty(case):
    assert_gradient_is_explicit(case.make())


@pytest.mark.parametrize("algorithm", [sb3.A2C, sb3_contrib.MaskablePPO])
def test_the_gradient_with_some_of_the_states(algorithm):
    assert_gradient_is_explicit(algorithm("MlpPolicy", Walk(), device="cpu"), fraction=0.5)


@pytest.mark.parametrize("shared", [True, False])
def test_images_are_perturbed_in_units_of_255(shared):
    """The explicit penalty sees bytes, the attached one what SB3 makes of them."""
    env = Walk(spaces.Box(0, 255, (3, 36, 36), np.uint8))
    extractor = {"features_extractor_kwargs": {"features_dim": 8}}
    arguments = extractor | {"share_features_extractor": shared}
    assert_gradient_is_explicit(sb3.PPO("CnnPolicy", env, policy_kwargs=arguments, device="cpu"))


def test_dicts_of_observations():
    part = spaces.Box(-1.0, 1.0, (2,), np.float32)
    env = Walk(spaces.Dict({"a": part, "b": part}))
    model = sb3.A2C("MultiInputPolicy", env, device="cpu")
    parts = {"a": torch.rand(8, 2), "b": torch.rand(8, 2)}
    torch.manual_seed(1)
    penalty = ConditioningRegularizer(LARGE)
    explicit = penalty(lambda obs: output_of(model, obs), parts).penalty
    expected = gradients_of(model, loss_of(model, parts) + explicit)
    with attach(model, ConditioningRegularizer(LARGE)):
        found = gradients_of(model, loss_of(model, parts))
    assert_close(found, expected)


def test_one_hot_observations_are_perturbed_after_preprocessing():
    model = sb3.DQN("MlpPolicy", Walk(spaces.Discrete(5)), device="cpu")
    seen = Seen()
    attach(model, seen)
    model.policy.set_training_mode(True)
    model.q_net(torch.tensor([1, 4])).sum().backward()
    assert torch.equal(seen.obs[0], torch.eye(5)[[1, 4]])


class Seen(ConditioningRegularizer):
    """Keeps the observations, the outputs and the quotients that it is given."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.obs = []
        self.outputs = []
        self.known = []

    def __call__(self, policy, obs, *, delta=None, output=None):
        self.obs.append(obs)
        self.outputs.append(policy(obs).detach())
        self.known.append(output)
        return super().__call__(policy, obs, delta=delta, output=output)


@EACH
def test_the_output_of_the_loop_is_what_the_policy_gives(case):
    seen = Seen(0.0)
    model = case.make()
    attach(model, seen)
    model.learn(64 if case.algorithm is not sb3.TD3 else 80)
    if case.algorithm in (sb3_contrib.RecurrentPPO, sb3_contrib.CrossQ):
        assert seen.known == [None] * len(seen.obs)
        return
    for output, known in zip(seen.outputs, seen.known, strict=True):
        torch.testing.assert_close(output, known, rtol=1e-4, atol=1e-5)


def test_acting_and_evaluating_are_not_penalized():
    model = case_of(sb3.PPO).make()
    penalty = ConditioningRegularizer(LARGE)
    before = penalty.generator.get_state()
    handle = attach(model, penalty)
    obs = observations(model)
    model.predict(obs.numpy())
    output_of(model, obs).mean.sum().backward()  # in evaluation mode, as predict leaves it
    assert handle.metrics()["attach/forwards"] == 0
    model.policy.set_training_mode(True)
    model.policy(obs)  # acting with gradients on, but never differentiated
    assert torch.equal(penalty.generator.get_state(), before)


def test_a_gradient_scale_is_taken():
    model = case_of(sb3.DQN).make()
    model.policy.set_training_mode(True)
    obs = observations(model)
    found = []
    for scale in (1.0, 0.5):
        with attach(model, ConditioningRegularizer(LARGE)) as handle:
            handle.scale = scale
            loss = 0.0 * model.q_net(obs).sum()
            found.append(gradients_of(model, loss)["q_net.q_net.0.weight"])
    torch.testing.assert_close(found[0], 2 * found[1])


# --- masks ---------------------------------------------------------------------------------------


def test_log_probabilities_by_hand():
    logits = torch.tensor([[0.0, 0.0, 5.0, 1.0, 1.0]])
    allowed = torch.tensor([[True, True, False, True, False]])
    half = -float(np.log(2))
    expected = torch.tensor([[half, half, 0.0, 0.0, 0.0]])
    torch.testing.assert_close(log_probabilities(logits, allowed, [3, 2]), expected)


def test_where_nothing_is_allowed_nothing_counts():
    logits = torch.tensor([[3.0, 4.0]], requires_grad=True)
    found = log_probabilities(logits, torch.zeros(1, 2, dtype=torch.bool), [2])
    found.sum().backward()
    assert found.tolist() == [[0.0, 0.0]]
    assert logits.grad.tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("space", [spaces.Discrete(4), spaces.MultiDiscrete([3, 2])])
@pytest.mark.parametrize("fraction", [1.0, 0.5])
def test_masked_logits_do_not_count(space, fraction):
    model = sb3_contrib.MaskablePPO("MlpPolicy", Walk(action_space=space), device="cpu")
    policy = model.policy
    policy.set_training_mode(True)
    obs = observations(model, rows=8)
    sizes = [4] if isinstance(space, spaces.Discrete) else [3, 2]
    allowed = torch.rand(8, sum(sizes)) > 0.5
    allowed[:, 0] = True
    allowed[:, -1] = True
    rows = 2 * torch.arange(4) if fraction == 0.5 else torch.arange(8)

    def count(obs):
        latent = policy.mlp_extractor.forward_actor(obs)
        parts = policy.action_net(latent).split(sizes, -1)
        masks = allowed[rows].split(sizes, -1)
        # p_i = exp(x_i) / sum of exp(x_j) over the allowed j
        totals = [(x.exp() * mask).sum(-1, True) for x, mask in zip(parts, masks, strict=True)]
        logs = [x - total.log() for x, total in zip(parts, totals, strict=True)]
        return torch.cat(logs, -1) * allowed[rows]

    penalty = ConditioningRegularizer(LARGE)
    expected = gradients_of(model, penalty(count, obs[rows]).penalty)
    seen = Seen(LARGE, fraction=fraction)
    with attach(model, seen):
        actions = torch.zeros(8, len(sizes)).squeeze(-1)
        _, logprob, _ = policy.evaluate_actions(obs, actions, action_masks=allowed.float())
        found = gradients_of(model, 0.0 * logprob.mean())
    assert_close(found, expected)
    assert (seen.known[0][~allowed] == 0).all()


@pytest.mark.parametrize("algorithm", [sb3.PPO, sb3_contrib.MaskablePPO])
@pytest.mark.parametrize("space", [spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(2)])
def test_several_actions_at_once(algorithm, space):
    model = algorithm(
        "MlpPolicy", Walk(action_space=space), n_steps=32, batch_size=32, device="cpu"
    )
    seen = Seen(LARGE)
    attach(model, seen)
    model.learn(32, **({"use_masking": False} if algorithm is not sb3.PPO else {}))
    counted = seen.known[0]
    if isinstance(space, spaces.MultiDiscrete):
        probabilities = counted.exp()
        torch.testing.assert_close(probabilities[:, :3].sum(-1), torch.ones(32))
        torch.testing.assert_close(probabilities[:, 3:].sum(-1), torch.ones(32))
    else:
        assert counted.shape == (32, 2 if algorithm is sb3.PPO else 4)


# --- sequences -----------------------------------------------------------------------------------


def test_padded_steps_do_not_count():
    """Two sequences, of 3 steps and of 1 with 2 of padding, against each of them alone."""
    model = case_of(sb3_contrib.RecurrentPPO).make()
    policy = model.policy
    policy.set_training_mode(True)
    size = policy.lstm_actor.hidden_size
    obs = torch.randn(6, 4)
    states = (torch.randn(1, 2, size), torch.randn(1, 2, size))
    starts = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # an episode begins within the first
    real = torch.tensor([True, True, True, True, False, False])

    def count(rows):
        found = []
        for sequence, start, which in ((rows[:3], starts[:3], [0]), (rows[3:], starts[3:4], [1])):
            state = tuple(x[:, which] for x in states)
            distribution, _ = policy.get_distribution(sequence, state, start)
            found.append(distribution.distribution.logits)
        return torch.cat(found)

    penalty = ConditioningRegularizer(LARGE)
    expected = gradients_of(model, penalty(count, obs[real]).penalty)
    with attach(model, ConditioningRegularizer(LARGE)) as handle:
        handle.actor.batches.real = real
        both = RNNStates(states, states)
        _, logprob, _ = policy.evaluate_actions(obs, torch.zeros(6), both, starts)
        found = gradients_of(model, 0.0 * logprob.mean())
    assert_close(found, expected)


def test_the_models_own_update_counts_each_step_once():
    model = case_of(sb3_contrib.RecurrentPPO).make()
    seen = Seen(0.0)
    attach(model, seen)
    model.learn(64)
    rows = [len(obs) for obs in seen.obs]
    assert rows == [32] * 2 * ON_POLICY["n_epochs"]
    assert all(obs.abs().sum(-1).min() > 0 for obs in seen.obs)


# --- TRPO ----------------------------------------------------------------------------------------


class Spy(TRPO):
    """Keeps the gradients of each update, and the two objectives around it."""

    def train(self):
        self.kept = {}
        order = np.random.get_state()  # noqa: NPY002
        self.before = self.objectives(order)
        super().train()
        self.after = self.objectives(order)

    def objectives(self, order):
        """The surrogate and the penalty on the same noise, by SB3's own methods."""
        np.random.set_state(order)  # noqa: NPY002
        (batch,) = self.rollout_buffer.get(batch_size=None)
        np.random.set_state(order)  # noqa: NPY002
        distribution = self.policy.get_distribution(batch.observations)
        advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
        ratio = (distribution.log_prob(batch.actions) - batch.old_log_prob).exp()
        penalty = ConditioningRegularizer(LARGE, seed=5)
        policy = self.policy.get_distribution
        found = penalty(lambda obs: policy(obs).distribution, batch.observations)
        return (advantages * ratio).mean(), found.penalty

    def _compute_actor_grad(self, kl_div, policy_objective):
        found = super()._compute_actor_grad(kl_div, policy_objective)
        surrogate, penalty = self.before
        self.kept = {
            "objective": found[1],
            "kl": found[2].detach(),
            "surrogate": flat_gradient(surrogate, found[0]),
            "penalty": flat_gradient(penalty, found[0]),
        }
        return found


def flat_gradient(value, parameters):
    found = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    pairs = zip(found, parameters, strict=True)
    return torch.cat([(torch.zeros_like(p) if g is None else g).flatten() for g, p in pairs])


def spied(coefficient, **arguments):
    torch.manual_seed(0)
    model = Spy(
        "MlpPolicy", "Pendulum-v1", n_steps=128, batch_size=64, seed=0, device="cpu", **arguments
    )
    if coefficient is not None:
        attach(model, ConditioningRegularizer(coefficient, seed=5))
    model.learn(128)
    return model


def test_trpo_climbs_surrogate_minus_penalty():
    plain = spied(None)
    model = spied(LARGE)
    kept = model.kept
    error = kept["objective"] - (kept["surrogate"] - kept["penalty"])
    assert error.abs().max() < 1e-3 * kept["penalty"].abs().max()
    assert kept["penalty"].abs().max() > 1e-2
    assert torch.equal(kept["kl"], plain.kept["kl"])  # what Fisher products are made of


def test_trpos_line_search_accepts_what_improves_the_difference():
    """Here the surrogate alone gets worse, so sb3-contrib's own comparison would refuse it."""
    model = spied(LARGE)
    (surrogate, penalty), (new_surrogate, new_penalty) = model.before, model.after
    assert new_surrogate < surrogate
    assert new_surrogate - new_penalty > surrogate - penalty
    assert model.logger.name_to_value["train/is_line_search_success"] == 1
    logged = model.logger.name_to_value["train/policy_objective"]
    assert logged == pytest.approx(new_surrogate.item(), abs=1e-5)


@dataclasses.dataclass(frozen=True)
class Growing:
    """A penalty that is larger at each call, so that no step improves the difference."""

    values: list = dataclasses.field(default_factory=list)

    def __call__(self, policy, obs, *, output=None):
        self.values.append(1e3 * len(self.values))
        return Grown(output.sum() * 0.0 + self.values[-1])


@dataclasses.dataclass(frozen=True)
class Grown:
    penalty: torch.Tensor

    def metrics(self):
        return {"grown": self.penalty.item()}


def test_trpo_reports_the_surrogate_where_no_step_is_accepted():
    model = Spy("MlpPolicy", "Pendulum-v1", n_steps=128, batch_size=64, seed=0, device="cpu")
    penalty = Growing()
    handle = attach(model, penalty)
    model.learn(128)
    assert len(penalty.values) == 1 + model.line_search_max_iter
    assert handle.metrics()["grown"] == 0  # before the step, and only that
    assert model.logger.name_to_value["train/is_line_search_success"] == 0
    logged = model.logger.name_to_value["train/policy_objective"]
    assert logged == pytest.approx(model.before[0].item(), abs=1e-6)
    assert torch.equal(model.before[1], model.after[1])  # the actor is as it was


def test_trpos_compared_steps_see_the_same_noise():
    model = spied(LARGE)
    handle = model._attached
    assert handle.metrics()["attach/backwards"] == 1
    again = ConditioningRegularizer(LARGE, seed=5)
    again(nn.Linear(3, 1), torch.ones(128, 3))
    assert torch.equal(handle.penalty.generator.get_state(), again.generator.get_state())


def test_sb3_contribs_own_trpo_is_refused():
    model = sb3_contrib.TRPO("MlpPolicy", "Pendulum-v1", device="cpu")
    with pytest.raises(TypeError, match=r"line search of sb3_contrib.*sb3_trpo\.TRPO"):
        attach(model, ConditioningRegularizer())


# --- refusals ------------------------------------------------------------------------------------


def test_an_algorithm_without_gradients_is_refused():
    model = sb3_contrib.ARS("LinearPolicy", "Pendulum-v1", device="cpu")
    with pytest.raises(TypeError, match=r"must be one of PPO, .*got ARS: it learns without grad"):
        attach(model, ConditioningRegularizer())


def test_a_module_is_refused():
    with pytest.raises(TypeError, match=r"got Linear\. condwrap\.attach\(module"):
        attach(nn.Linear(2, 2), ConditioningRegularizer())


def test_a_policy_without_sb3s_parts_is_refused():
    model = case_of(sb3.DQN).make()
    del model.q_net.q_net
    with pytest.raises(TypeError, match=r"QNetwork must have.*but has no module q_net"):
        attach(model, ConditioningRegularizer())


def test_a_fraction_of_sequences_is_refused():
    model = case_of(sb3_contrib.RecurrentPPO).make()
    with pytest.raises(ValueError, match=r"fraction must be 1 for RecurrentPPO, got 0\.5"):
        attach(model, ConditioningRegularizer(fraction=0.5))
    assert "evaluate_actions" not in vars(model.policy)


def test_a_penalty_that_needs_successors_is_refused():
    model = case_of(sb3_contrib.RecurrentPPO).make()
    penalty = ConditioningRegularizer()
    penalty.needs = ("next_obs",)
    with pytest.raises(ValueError, match="needs next_obs"):
        attach(model, penalty)
    assert "evaluate_actions" not in vars(model.policy)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("sb3_*.py")), ids=lambda path: path.stem)
def test_the_examples_lower_psi(path, capsys):
    assert len(path.read_text().splitlines()) <= 40
    runpy.run_path(str(path), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    numbers = [float(line.split()[-1]) for line in lines if line.startswith("psi")]
    assert numbers[-1] < 0.5 * numbers[0]


# --- models on disk ------------------------------------------------------------------------------

READ = [case for case in CASES if case.algorithm not in (sb3_contrib.MaskablePPO, TRPO)]
READ = [case for case in READ if case.algorithm is not sb3_contrib.RecurrentPPO]


def numbers_of(output):
    return flat_output(output, "default", torch.Size([8]))


@pytest.mark.parametrize("case", READ, ids=lambda case: case.algorithm.__name__)
def test_a_saved_models_policy_is_what_counts(case, tmp_path):
    model = case.make()
    model.save(tmp_path / "model.zip")
    with pytest.raises(DiskError, match="--trust"):
        read_policy(str(tmp_path / "model.zip"))
    found = read_policy(str(tmp_path / "model.zip"), trust=True)

    raw = np.stack([model.observation_space.sample() for _ in range(8)])
    model.policy.set_training_mode(False)
    expected = output_of(model, model.policy.obs_to_tensor(raw)[0])
    output = found.policy(found.normalize(torch.as_tensor(raw)))
    torch.testing.assert_close(numbers_of(output), numbers_of(expected))


@pytest.mark.parametrize("algorithm", [sb3_contrib.MaskablePPO, sb3_contrib.RecurrentPPO])
def test_a_saved_policy_with_a_context_is_refused(algorithm, tmp_path):
    case_of(algorithm).make().save(tmp_path / "model.zip")
    with pytest.raises(DiskError, match="recurrent or masked: load it yourself"):
        read_policy(str(tmp_path / "model.zip"), trust=True)


def test_the_command_measures_a_saved_model(tmp_path, capsys):
    case_of(sb3.PPO).make().save(tmp_path / "model.zip")
    main(["summary", str(tmp_path / "model.zip"), "--trust", "--env-id", "Pendulum-v1"])
    out = capsys.readouterr().out
    assert "a model of PPO, 0 steps; observations of 1024 steps of Pendulum-v1 with its own" in out
    assert "3 observed values, 1 outputs" in out
