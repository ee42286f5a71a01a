"""TRPO (Schulman et al., 2015, arXiv 1502.05477) for continuous actions, to copy and change.

    python trpo_reg.py --env-id HopperBulletEnv-v0 --seed 1

Lines marked so are the conditioning penalty (Asadulaev et al., arXiv 1906.05437):  # condwrap
`--coefficient 0` computes bit for bit what the file computes without them.  # condwrap
They need condwrap installed, with its extras `baselines` and `bullet`.  # condwrap

A run's directory holds metrics.csv (a row for each update), TensorBoard events and checkpoint.pt;
`--resume` continues a run as if it had never stopped.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import math
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import NormalizeReward, RecordEpisodeStatistics
from torch import Tensor, nn
from torch.distributions import Independent, Normal, kl_divergence
from torch.nn.utils import parameters_to_vector
from torch.utils.tensorboard import SummaryWriter

from condwrap import ConditioningRegularizer  # condwrap
from condwrap.spectrum import jacobian_singular_values  # condwrap
from condwrap.wrappers import VectorPerturbObservation  # condwrap


class RunError(Exception):
    """A run that cannot start, and what to do."""


@dataclasses.dataclass(frozen=True)
class Args:
    env_id: str = "HopperBulletEnv-v0"
    """any Gymnasium task with a Box of actions; "module:id" imports the module first"""
    seed: int = 1
    """seed of the run"""
    agent: int = 0
    """number of the agent: the paper trains 10 for each seed"""
    total_timesteps: int = 5_000_000
    """environment steps to train for, rounded down to whole updates"""
    num_envs: int = 1
    """environments, stepped in turn"""
    num_steps: int = 2000
    """steps of each environment between two updates"""
    num_minibatches: int = 16
    """minibatches in an epoch of the critic: 16 of 2000 steps hold 125 each"""
    target_kl: float = 0.01
    """bound on the mean KL divergence of a step"""
    cg_steps: int = 10
    """conjugate-gradient steps towards the natural gradient"""
    cg_damping: float = 0.1
    """added to the diagonal of the Fisher matrix"""
    line_search_steps: int = 10
    """fractions of the full step that are tried"""
    line_search_shrink: float = 0.8
    """each fraction over the one before it"""
    vf_epochs: int = 10
    """passes over the rollout by the critic"""
    vf_learning_rate: float = 1e-3
    """Adam's step size for the critic"""
    vf_coef: float = 0.5
    """c2: factor of the critic's squared error"""
    gamma: float = 0.99
    """discount"""
    gae_lambda: float = 0.95
    """lambda of generalized advantage estimation"""
    max_grad_norm: float = 0.5
    """length that the gradient of the critic is clipped to"""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """widths of the hidden layers, of the policy and of the critic"""
    activation: Literal["tanh", "relu"] = "tanh"
    """what follows each hidden layer"""
    log_std_init: float = 0.0
    """log of the policy's standard deviation at the start"""
    norm_obs: bool = True
    """normalize observations by their running mean and variance, clipped to [-10, 10]"""
    norm_reward: bool = True
    """divide rewards, for learning only, by the running deviation of the discounted return"""
    coefficient: float = 1e-3  # condwrap
    """c1: factor of the conditioning penalty; 0 is plain TRPO, psi still measured"""  # condwrap
    lambda_min: float = 1.0  # condwrap
    """lower end of the range that J is kept in"""  # condwrap
    lambda_max: float = 20.0  # condwrap
    """upper end of the range that J is kept in"""  # condwrap
    perturbation: str = "sphere"  # condwrap
    """kind of delta: sphere, gaussian or uniform"""  # condwrap
    radius: float = 1.0  # condwrap
    """size of delta, in the normalized observations' units"""  # condwrap
    perturb_obs: bool = False  # condwrap
    """train on perturbed observations; with --coefficient 0, the penalty's rival"""  # condwrap
    log_spectrum: int = 0  # condwrap
    """updates between two logs of the Jacobian's singular values; 0: never"""  # condwrap
    run_dir: Path | None = None
    """where the run's files go; by default runs/<environment>__<this file>__s<seed>__a<agent>"""
    resume: bool = False
    """continue from the run directory's checkpoint, if it has one"""
    checkpoint_interval: int = 50
    """updates between two checkpoints; the environments are rebuilt at each"""
    capture_video: bool = False
    """record episodes of the first environment (needs moviepy)"""
    track: bool = False
    """log to Weights & Biases too (needs wandb; WANDB_PROJECT names the project)"""

    def __post_init__(self) -> None:
        for name, least in AT_LEAST.items():
            values = getattr(self, name) if name == "hidden_sizes" else [getattr(self, name)]
            if not all(value >= least for value in values):
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name in ("target_kl", "cg_damping", "vf_learning_rate", "max_grad_norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and above 0, got {getattr(self, name)}")
        for name in ("gamma", "gae_lambda", "line_search_shrink"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        batch = f"num_envs * num_steps = {self.batch_size}"
        if self.batch_size % self.num_minibatches or self.batch_size == self.num_minibatches:
            raise ValueError(
                f"num_minibatches must divide {batch} into parts of 2 or more, "
                f"got {self.num_minibatches}"
            )
        if self.total_timesteps < self.batch_size:
            raise ValueError(
                f"total_timesteps must be at least {batch}, got {self.total_timesteps}"
            )
        self.regularizer(self.coefficient, seed=0)  # condwrap: its own checks

    @property
    def batch_size(self) -> int:
        return self.num_envs * self.num_steps

    @property
    def num_updates(self) -> int:
        return self.total_timesteps // self.batch_size

    def regularizer(self, coefficient: float, seed: int) -> ConditioningRegularizer:  # condwrap
        sizes = {"perturbation": self.perturbation, "radius": self.radius}  # condwrap
        lambdas = (self.lambda_min, self.lambda_max)  # condwrap
        return ConditioningRegularizer(coefficient, *lambdas, **sizes, seed=seed)  # condwrap

    @property
    def path(self) -> Path:
        name = f"{self.env_id.split(':')[-1]}__{Path(__file__).stem}__s{self.seed}__a{self.agent}"
        return self.run_dir or Path("runs", name)


AT_LEAST = {"seed": 0, "agent": 0, "num_envs": 1, "num_steps": 1, "num_minibatches": 1}
AT_LEAST |= {
    "cg_steps": 1,
    "line_search_steps": 1,
    "vf_epochs": 1,
    "checkpoint_interval": 1,
    "hidden_sizes": 1,
}
AT_LEAST |= {"log_spectrum": 0}  # condwrap
CLIP = 10.0  # of normalized observations
MAY_CHANGE = {"run_dir", "resume", "capture_video", "track"}  # when a run is resumed


# --- environment ----------------------------------------------------------------------------------


class RunningMoments(RunningMeanStd):
    """RunningMeanStd, faster for a batch of one: its mean is itself and its variance 0."""

    def update(self, x: np.ndarray) -> None:
        if len(x) == 1:
            self.update_from_moments(x[0], 0.0, 1)
        else:
            super().update(x)


class NormalizeObservation(VectorWrapper):
    """(obs - mean) / std by running statistics, clipped; `final_obs` too, unlike Gymnasium's own.

    The statistics are the caller's: they outlive the environments, and `update=False` freezes them.
    """

    def __init__(self, env: VectorEnv, rms: RunningMeanStd, update: bool = True) -> None:
        super().__init__(env)
        self.rms, self.update = rms, update
        box = gym.spaces.Box(-CLIP, CLIP, env.single_observation_space.shape, np.float32)
        self.single_observation_space = box
        self.observation_space = gym.vector.utils.batch_space(box, env.num_envs)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        obs, info = self.env.reset(**kwargs)
        return self.observe(obs), info

    def step(self, actions: np.ndarray) -> tuple:
        obs, rewards, terminations, truncations, info = self.env.step(actions)
        for i in np.flatnonzero(info.get("_final_obs", ())):
            info["final_obs"][i] = self.normalize(info["final_obs"][i])
        return self.observe(obs), rewards, terminations, truncations, info

    def observe(self, obs: np.ndarray) -> np.ndarray:
        if self.update:
            self.rms.update(obs)
        return self.normalize(obs)

    def normalize(self, obs: np.ndarray) -> np.ndarray:
        scaled = (obs - self.rms.mean) / np.sqrt(self.rms.var + 1e-8)
        return scaled.clip(-CLIP, CLIP).astype(np.float32)


def make_env(args: Args, index: int, checkpoint: int) -> gym.Env:
    bullet = "Bullet" in args.env_id and ":" not in args.env_id
    env_id = f"pybullet_envs_gymnasium:{args.env_id}" if bullet else args.env_id
    video = args.capture_video and index == 0
    env = gym.make(env_id, **({"render_mode": "rgb_array"} if video else {}))
    if not isinstance(env.action_space, gym.spaces.Box):
        raise RunError(f"env_id must name a task with a Box of actions, got {env.action_space}")
    if video:
        folder, prefix = str(args.path / "videos"), f"checkpoint-{checkpoint}"
        env = gym.wrappers.RecordVideo(env, folder, name_prefix=prefix)
    flat = len(env.observation_space.shape or ()) == 1
    return env if flat else gym.wrappers.FlattenObservation(env)


def make_envs(args: Args, checkpoint: int, stats: dict[str, RunningMeanStd]) -> VectorEnv:
    """The environments until the next checkpoint, with `stats` to normalize by (filled if empty).

    The state of a simulator cannot be saved. So every run builds its environments anew at each
    scheduled checkpoint, and an interrupted run sees the same episodes as an undisturbed one.
    """
    makers = [functools.partial(make_env, args, i, checkpoint) for i in range(args.num_envs)]
    envs: VectorEnv = SyncVectorEnv(makers, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)
    envs = RecordEpisodeStatistics(envs)
    if args.norm_obs:
        shape = envs.single_observation_space.shape
        envs = NormalizeObservation(envs, stats.setdefault("obs_rms", RunningMoments(shape=shape)))
    if args.norm_reward:
        envs = NormalizeReward(envs, gamma=args.gamma)
        envs.return_rms = stats.setdefault("return_rms", RunningMoments())
    if args.perturb_obs:  # condwrap
        envs = VectorPerturbObservation(envs, args.perturbation, args.radius)  # condwrap
    return envs


def env_seeds(args: Args, checkpoint: int) -> list[int]:
    sequence = np.random.SeedSequence((args.seed, args.agent, checkpoint))
    return sequence.generate_state(args.num_envs).tolist()


# --- agent ----------------------------------------------------------------------------------------


ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}


def make_mlp(args: Args, n_in: int, n_out: int, gain: float, rng: torch.Generator) -> nn.Sequential:
    """Layers with orthogonal weights, `gain` at the output, drawn from no global state."""
    layers: list[nn.Module] = []
    sizes = (n_in, *args.hidden_sizes, n_out)
    for i, size in enumerate(sizes[1:]):
        linear = nn.utils.skip_init(nn.Linear, sizes[i], size)
        nn.init.orthogonal_(linear.weight, gain if i == len(sizes) - 2 else math.sqrt(2), rng)
        nn.init.zeros_(linear.bias)
        layers += [linear, ACTIVATIONS[args.activation]()]
    return nn.Sequential(*layers[:-1])


class Actor(nn.Module):
    """Gaussian policy: a mean for each observation, one log-std for each action."""

    def __init__(self, args: Args, obs_dim: int, action_dim: int, rng: torch.Generator) -> None:
        super().__init__()
        self.mean = make_mlp(args, obs_dim, action_dim, 0.01, rng)
        self.log_std = nn.Parameter(torch.full((action_dim,), args.log_std_init))

    def forward(self, obs: Tensor) -> Independent:
        mean = self.mean(obs)
        normal = Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False)
        return Independent(normal, 1, validate_args=False)


# --- TRPO -----------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """T steps of N environments, and what they led to."""

    obs: Tensor  # [T, N, obs_dim]
    actions: Tensor  # [T, N, action_dim], before they are clipped to the action space
    rewards: Tensor  # [T, N], scaled for learning
    dones: Tensor  # [T, N], 1 where an episode ended or was cut
    values: Tensor  # [T, N]
    next_values: Tensor  # [T, N], V of what the step led to: 0 at an end, V(final_obs) at a cut
    next_obs: np.ndarray  # [N, obs_dim]
    returns: list[float]  # of the episodes that ended, in raw rewards
    lengths: list[int]


@torch.no_grad()
def rollout(args: Args, learner: Learner, envs: VectorEnv, next_obs: np.ndarray) -> Rollout:
    """Step the environments; autoreset is in the same step, so every transition counts."""
    actor, critic, space = learner.actor, learner.critic, envs.single_action_space
    shape = (args.num_steps, envs.num_envs)
    obs, after = (np.empty((*shape, next_obs.shape[-1]), np.float32) for _ in range(2))
    rewards, ends, dones = (np.empty(shape, np.float32) for _ in range(3))
    noise = torch.randn((*shape, len(actor.log_std)), generator=learner.generators["action"])
    actions = noise * actor.log_std.exp()
    returns: list[float] = []
    lengths: list[int] = []
    for t in range(args.num_steps):
        obs[t] = next_obs
        actions[t] += actor.mean(torch.from_numpy(obs[t]))
        action = actions[t].numpy().reshape(-1, *space.shape)
        next_obs, rewards[t], ends[t], cut, info = envs.step(action.clip(space.low, space.high))
        after[t], dones[t] = next_obs, np.maximum(ends[t], cut)
        for i in np.flatnonzero(dones[t]):
            after[t, i] = info["final_obs"][i]
        if "episode" in info:
            returns += info["episode"]["r"][info["_episode"]].tolist()
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    obs, after, rewards, ends, dones = map(torch.from_numpy, (obs, after, rewards, ends, dones))
    values, next_values = critic(obs).squeeze(-1), critic(after).squeeze(-1) * (1 - ends)
    return Rollout(obs, actions, rewards, dones, values, next_values, next_obs, returns, lengths)


def gae(data: Rollout, gamma: float, gae_lambda: float) -> Tensor:
    """Generalized advantage estimation (Schulman et al., 2016, arXiv 1506.02438), `[T, N]`.

    A_t = d_t + gamma · lambda · (1 - done_t) · A_{t+1},  d_t = r_t + gamma · next_value_t - V_t
    """
    errors = (data.rewards + gamma * data.next_values - data.values).numpy()
    decays = (gamma * gae_lambda * (1 - data.dones)).numpy()
    advantages, advantage = np.empty_like(errors), np.zeros_like(errors[0])
    for t in reversed(range(len(errors))):
        advantages[t] = advantage = errors[t] + decays[t] * advantage
    return torch.from_numpy(advantages)


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance: float = 1e-10
) -> tuple[Tensor, float]:
    """Solve A x = b for a symmetric positive definite A, given by its products with vectors.

    Hestenes and Stiefel (1952). Ends after `steps`, once ‖b - A x‖² <= tolerance · ‖b‖², or where
    the curvature pᵀ A p is not above 0, with the x found so far. Returns x and ‖b - A x‖ / ‖b‖.
    """
    x, residual, direction = torch.zeros_like(b), b.clone(), b.clone()
    squared = start = residual @ residual
    for _ in range(steps):
        if squared <= tolerance * start:
            break
        image = product(direction)
        curvature = direction @ image
        if not curvature > 0:  # NaN too
            break
        size = squared / curvature
        x += size * direction
        residual -= size * image
        squared, before = residual @ residual, squared
        direction = residual + (squared / before) * direction
    return x, (squared / start).sqrt().item() if start else 0.0


def fisher_product(kl: Tensor, parameters: list[nn.Parameter], damping: float) -> Any:
    """The map v -> (F + damping · I) v, F the Hessian of the mean KL divergence: never built."""
    gradient = flat_grad(kl, parameters, create_graph=True)
    return lambda v: flat_grad(gradient @ v, parameters, retain_graph=True) + damping * v


def flat_grad(value: Tensor, parameters: list[nn.Parameter], **kwargs: bool) -> Tensor:
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, parameters, **kwargs)])


def set_parameters(parameters: list[nn.Parameter], vector: Tensor) -> None:
    """Copy the vector in. Views into it (`vector_to_parameters`) round otherwise than what a
    checkpoint loads, since they are aligned otherwise, and a resumed run would not be the same.
    """
    parts = vector.split([p.numel() for p in parameters])
    for parameter, part in zip(parameters, parts, strict=True):
        parameter.data.copy_(part.view_as(parameter))


def natural_step(
    args: Args, actor: Actor, objective: Callable[[], Tensor], mean_kl: Callable[[], Tensor]
) -> dict[str, float]:
    """One step up the objective within the KL bound, or none.

    The direction is that of the natural gradient, F⁻¹ g; its full length is the one at which the
    quadratic model of the KL divergence meets the bound. Backtracking accepts the first fraction
    that keeps the KL divergence within the bound and improves the objective; where none does, or
    where a number is not finite or the curvature not positive, the old policy stays.
    """
    parameters = list(actor.parameters())
    old = parameters_to_vector(parameters).detach().clone()
    before = objective()
    gradient = flat_grad(before, parameters)
    names = ("kl", "step_fraction", "cg_residual", "accepted")
    logs = dict.fromkeys((*names, "expected_improvement", "actual_improvement"), 0.0)
    if not gradient.isfinite().all() or not gradient.any():
        print(f"step rejected: the gradient is {'0' if not gradient.any() else 'not finite'}")
        return logs
    product = fisher_product(mean_kl(), parameters, args.cg_damping)
    direction, logs["cg_residual"] = conjugate_gradient(product, gradient, args.cg_steps)
    curvature = direction @ product(direction)
    full_step = (2 * args.target_kl / curvature).sqrt() * direction
    if not full_step.isfinite().all():
        print("step rejected: no positive curvature")
        return logs
    logs["expected_improvement"] = (gradient @ full_step).item()
    for i in range(args.line_search_steps):
        fraction = args.line_search_shrink**i
        set_parameters(parameters, old + fraction * full_step)
        with torch.no_grad():
            gain, kl = (objective() - before).item(), mean_kl().item()
        if kl <= args.target_kl and 0 < gain < math.inf:
            return logs | {"kl": kl, "step_fraction": fraction, "accepted": 1.0,
                           "actual_improvement": gain}  # fmt: skip
    set_parameters(parameters, old)
    print("step rejected: no fraction of it improves the objective within the KL bound")
    return logs


def step(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_grad_norm)
    optimizer.step()


def update(args: Args, learner: Learner, data: Rollout) -> dict[str, float]:
    """One natural-gradient step of the policy over one rollout, then the critic's epochs.

    Maximized is the surrogate E[ratio · A] - c1 · mean(psi), psi over the whole rollout. Its delta
    is held fixed through the gradient and the line search, which so see one function.
    """
    actor, critic = learner.actor, learner.critic
    obs, actions = data.obs.flatten(0, 1), data.actions.flatten(0, 1)
    advantages = gae(data, args.gamma, args.gae_lambda).flatten()
    values = data.values.flatten()
    targets = advantages + values
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    with torch.no_grad():
        old_policy = actor(obs)
        old_logprobs = old_policy.log_prob(actions)
    if args.coefficient > 0:  # condwrap
        delta = learner.regularizer.sample_delta(obs)  # condwrap

    def objective() -> Tensor:
        policy = actor(obs)
        surrogate = ((policy.log_prob(actions) - old_logprobs).exp() * advantages).mean()
        if args.coefficient > 0:  # condwrap
            measured = learner.regularizer(actor, obs, delta=delta, output=policy)  # condwrap
            surrogate = surrogate - measured.penalty  # condwrap
        return surrogate

    def mean_kl() -> Tensor:
        return kl_divergence(old_policy, actor(obs)).mean()

    logs = natural_step(args, actor, objective, mean_kl)
    value_losses = []
    for _ in range(args.vf_epochs):
        order = torch.randperm(len(obs), generator=learner.generators["minibatch"])
        for i in order.split(len(obs) // args.num_minibatches):
            value_loss = (critic(obs[i]).squeeze(-1) - targets[i]).square().mean()
            step(learner.critic_optimizer, args.vf_coef * value_loss, args.max_grad_norm)
            value_losses.append(value_loss.detach())
    logs["value_loss"] = torch.stack(value_losses).mean().item()
    logs["entropy"] = old_policy.entropy().mean().item()
    logs["explained_variance"] = (1 - (targets - values).var() / targets.var()).item()
    return {f"losses/{name}": value for name, value in logs.items()}


def measure_conditioning(args: Args, learner: Learner, obs: Tensor) -> dict[str, float]:  # condwrap
    """How the new policy is conditioned on the whole rollout: one rule in every run."""  # condwrap
    obs = obs.flatten(0, 1)  # condwrap
    measured = learner.probe(learner.actor, obs)  # condwrap
    q05, q50, q95 = measured.quotient.quantile(torch.tensor([0.05, 0.5, 0.95]))  # condwrap
    logs = {"psi": measured.psi.mean(), "quotient_q05": q05, "quotient_q50": q50}  # condwrap
    logs |= {"quotient_q95": q95, "fraction_below": measured.fraction_below}  # condwrap
    logs["fraction_above"] = measured.fraction_above  # condwrap
    if args.log_spectrum:  # condwrap
        values = torch.full((1, 1), math.nan)  # condwrap
        if learner.update % args.log_spectrum == 0:  # condwrap
            with torch.no_grad():  # condwrap
                values = jacobian_singular_values(learner.actor, obs)  # condwrap
        logs["singular_value_max"] = values[:, 0].mean()  # condwrap
        logs["singular_value_mean"] = values.mean()  # condwrap
        logs["squared_singular_value"] = values.square().mean()  # condwrap
        logs["condition_number"] = (values[:, 0] / values[:, -1]).median()  # condwrap
    return {f"conditioning/{name}": x.item() for name, x in logs.items()}  # condwrap


# --- state and files ------------------------------------------------------------------------------


class Learner:
    """All that changes while training, and so all that a checkpoint holds."""

    def __init__(self, args: Args) -> None:
        self.stats: dict[str, RunningMeanStd] = {}
        envs = make_envs(dataclasses.replace(args, capture_video=False), 0, self.stats)
        obs_dim = math.prod(envs.single_observation_space.shape)
        action_dim = math.prod(envs.single_action_space.shape)
        envs.close()
        names = ("init", "action", "minibatch", "penalty", "probe")  # each use has its own stream
        streams = np.random.SeedSequence((args.seed, args.agent)).spawn(len(names))
        seeds = {
            n: int(s.generate_state(1, np.uint64)[0]) for n, s in zip(names, streams, strict=True)
        }
        self.generators = {n: torch.Generator().manual_seed(seeds[n]) for n in names[:3]}
        self.actor = Actor(args, obs_dim, action_dim, self.generators["init"])
        self.critic = make_mlp(args, obs_dim, 1, 1.0, self.generators["init"])
        adam = functools.partial(torch.optim.Adam, eps=1e-5, fused=True)
        self.critic_optimizer = adam(self.critic.parameters(), args.vf_learning_rate)
        self.regularizer = args.regularizer(args.coefficient, seeds["penalty"])  # condwrap
        self.probe = args.regularizer(0.0, seeds["probe"])  # condwrap
        self.update = 0

    def state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = {name: getattr(self, name).state_dict() for name in TRAINED}
        for name, rms in self.stats.items():
            moments = vars(rms).items()
            state[name] = {key: torch.tensor(x, dtype=torch.float64) for key, x in moments}
        generators = {name: generator.get_state() for name, generator in self.generators.items()}
        return {**state, "generators": generators, "update": self.update}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in TRAINED:
            getattr(self, name).load_state_dict(state[name])
        for name, rms in self.stats.items():
            vars(rms).update({key: x.numpy() for key, x in state[name].items()})
        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name])
        self.update = state["update"]


TRAINED = ("actor", "critic", "critic_optimizer")
TRAINED += ("regularizer", "probe")  # condwrap


def open_logs(args: Args, saved: dict[str, Any] | None) -> SummaryWriter:
    """Cut metrics.csv back to the checkpoint, and go on with TensorBoard's events from there."""
    args.path.mkdir(parents=True, exist_ok=True)
    with open(args.path / "metrics.csv", "a") as metrics:
        size = saved["metrics_size"] if saved else 0
        if metrics.tell() < size:
            raise RunError(f"{metrics.name} lacks rows: remove its folder to start anew")
        metrics.truncate(size)  # later rows are computed again
    first = saved["learner"]["update"] if saved else 0
    writer = SummaryWriter(str(args.path), purge_step=first * args.batch_size + 1)
    rows = "".join(f"\n|{name}|{value}|" for name, value in vars(args).items())
    writer.add_text("hyperparameters", f"|parameter|value|\n|-|-|{rows}")
    return writer


def make_row(
    args: Args, learner: Learner, data: Rollout, losses: dict[str, float], speed: float
) -> dict[str, float]:
    """What is logged of an update."""
    return {
        "global_step": learner.update * args.batch_size,
        "charts/episodic_return": float(np.mean(data.returns or math.nan)),
        "charts/episodic_length": float(np.mean(data.lengths or math.nan)),
        "charts/SPS": speed,
        **losses,
        **measure_conditioning(args, learner, data.obs),  # condwrap
    }


def write_metrics(args: Args, writer: SummaryWriter, row: dict[str, float]) -> None:
    """A row of metrics.csv for each update, and the same numbers as TensorBoard scalars."""
    with open(args.path / "metrics.csv", "a", newline="") as file:
        table = csv.DictWriter(file, row)
        if file.tell() == 0:
            table.writeheader()
        table.writerow(row)
    for name, value in row.items():
        if not math.isnan(value):
            writer.add_scalar(name, value, int(row["global_step"]))


def save_checkpoint(args: Args, learner: Learner) -> None:
    """Write a temporary file, then rename: a whole checkpoint is there whatever happens."""
    with open(args.path / "metrics.csv", "rb") as metrics:
        os.fsync(metrics.fileno())
        size = os.fstat(metrics.fileno()).st_size
    settings = {k: v for k, v in vars(args).items() if k not in MAY_CHANGE}
    path = args.path / "checkpoint.pt"
    with open(path.with_suffix(".tmp"), "wb") as file:
        torch.save({"args": settings, "learner": learner.state_dict(), "metrics_size": size}, file)
        file.flush()
        os.fsync(file.fileno())
    if path.exists():
        path.replace(path.with_suffix(".previous.pt"))
    path.with_suffix(".tmp").replace(path)


def load_checkpoint(args: Args) -> dict[str, Any] | None:
    """The newest checkpoint that can be read, if the run may be resumed and there is one."""
    path = args.path / "checkpoint.pt"
    found = [p for p in (path, path.with_suffix(".previous.pt")) if p.exists()]
    if not args.resume and (found or (args.path / "metrics.csv").exists()):
        raise RunError(f"{args.path} holds a run: --resume it, or name another --run-dir")
    for candidate in found:
        try:
            saved = torch.load(candidate, map_location="cpu", weights_only=True)
        except Exception as error:  # whatever a torn file makes the reader stumble over
            print(f"{candidate} cannot be read: {error!r}")
            continue
        for name, value in saved["args"].items():
            now = getattr(args, name, None)
            if value != now:
                raise RunError(f"{args.path} was run with {name}={value}, not {now}")
        return saved
    if found:
        raise RunError(f"{args.path} holds no readable checkpoint: remove it to start anew")
    return None


# --- training ------------------------------------------------------------------------------------


def train(args: Args) -> Learner:
    """Train, or continue to train, until `total_timesteps`."""
    saved = load_checkpoint(args)
    learner = Learner(args)
    if saved:
        learner.load_state_dict(saved["learner"])
    if learner.update == args.num_updates:
        print(f"{args.path} is finished")
        return learner
    writer = open_logs(args, saved)
    first, started, printed = learner.update, time.time(), -math.inf
    while learner.update < args.num_updates:  # from one checkpoint to the next
        checkpoint = learner.update // args.checkpoint_interval
        envs = make_envs(args, checkpoint, learner.stats)
        next_obs, _ = envs.reset(seed=env_seeds(args, checkpoint))
        for _ in range(min(args.checkpoint_interval, args.num_updates - learner.update)):
            data = rollout(args, learner, envs, next_obs)
            next_obs, losses = data.next_obs, update(args, learner, data)
            learner.update += 1
            speed = (learner.update - first) * args.batch_size / (time.time() - started)
            row = make_row(args, learner, data, losses, speed)
            write_metrics(args, writer, row)
            if time.time() - printed > 10 or learner.update == args.num_updates:
                printed = time.time()
                print(f"update {learner.update}/{args.num_updates}  {speed:.0f} steps/s  "
                      f"return {row['charts/episodic_return']:.1f}")  # fmt: skip
        envs.close()
        save_checkpoint(args, learner)
    writer.close()
    return learner


def main() -> None:
    torch.set_num_threads(1)  # more do not pay for networks of this size
    sys.stdout.reconfigure(line_buffering=True)  # progress shows in a log file too
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)
    try:
        args = tyro.cli(Args, description=__doc__)
        if args.track:
            import wandb

            wandb.init(name=args.path.name, config=vars(args), sync_tensorboard=True)
        train(args)
    except (RunError, gym.error.Error, ModuleNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: --resume continues from the last checkpoint, if there is one yet")


if __name__ == "__main__":
    main()
