"""PPO (Schulman et al., 2017, arXiv 1707.06347) for continuous actions, to copy and change.

    python ppo_reg.py --env-id HopperBulletEnv-v0 --seed 1

The lines marked as condwrap's add the conditioning penalty of Asadulaev et al. (arXiv 1906.05437).
`--coefficient 0` computes bit for bit what the file computes without them. They need condwrap
installed, and the file its extras `baselines` and `bullet`.

A run's directory holds metrics.csv (a row for each update), TensorBoard events and checkpoint.pt;
`--resume` continues a run as if it had never stopped.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import json
import math
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import ClipReward, NormalizeReward, RecordEpisodeStatistics
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torch.utils.tensorboard import SummaryWriter

from condwrap.rivals import RivalArgs  # condwrap

VERSION = 2  # raised whenever the numbers of a run change
OBS_CLIP = 10.0  # bound of normalized observations
MAY_CHANGE = {"run_dir", "resume", "extend", "track"}  # when a run is resumed


class RunError(Exception):
    """A run that cannot start, and what to do."""


class DivergedError(Exception):
    """Training produced NaN or infinity: a result (exit status 3), not a crash."""


@dataclasses.dataclass(frozen=True)
class Args(
    RivalArgs,  # condwrap
):
    env_id: str = "HopperBulletEnv-v0"  # a Gymnasium task with a Box of actions, or "module:id"
    seed: int = 1  # seed of the run
    agent: int = 0  # number of the agent: the paper trains 10 for each seed
    total_timesteps: int = 5_000_000  # steps to train for, rounded down to whole updates

    num_envs: int = 1  # environments, stepped in turn
    num_steps: int = 2000  # steps of each environment between two updates
    num_minibatches: int = 40  # minibatches in an epoch: 40 of 2000 steps hold 50 each
    update_epochs: int = 10  # passes over the rollout by the policy
    learning_rate: float = 3e-4  # Adam's step size for the policy
    vf_epochs: int = 10  # passes over the rollout by the critic
    vf_learning_rate: float = 3e-4  # Adam's step size for the critic, which has its own optimizer
    vf_coef: float = 0.5  # c2, of the critic's squared error: acts only where gradients are clipped
    anneal_lr: bool = False  # let both step sizes fall linearly to 0
    gamma: float = 0.99  # discount
    gae_lambda: float = 0.95  # lambda of generalized advantage estimation
    clip_coef: float = 0.2  # PPO's epsilon: how far the probability ratio may move from 1
    ent_coef: float = 0.0  # c3, of the entropy bonus
    max_grad_norm: float = 0.5  # length that the policy's and the critic's gradients are clipped to
    target_kl: float | None = None  # end the policy's epochs once the mean KL of one exceeds this

    hidden_sizes: tuple[int, ...] = (64, 64)  # widths of the policy's and of the critic's layers
    activation: Literal["tanh", "relu"] = "tanh"  # what follows each hidden layer
    output_gain: float = 0.01  # of the policy's orthogonal output layer: small for actions near 0
    log_std_init: float = 0.0  # log of the policy's standard deviation at the start

    norm_obs: bool = True  # normalize observations by running statistics, clipped to [-10, 10]
    norm_reward: bool = True  # divide rewards by the running deviation of the discounted return
    reward_clip: float = 10.0  # clip normalized rewards to [-reward_clip, reward_clip]; 0: do not

    run_dir: Path | None = None  # default: runs/<environment>__<this file>__s<seed>__a<agent>
    resume: bool = False  # continue from the run directory's checkpoint, if it has one
    extend: bool = False  # let a resumed run train for more timesteps than it was begun with
    checkpoint_interval: int = 50  # updates between two checkpoints; each rebuilds the environments
    compile: bool = False  # compile the loss with a C++ compiler: 12 s, then up to 1.4 times faster
    track: bool = False  # log to Weights & Biases too (needs wandb; WANDB_PROJECT: the project)

    def __post_init__(self) -> None:
        counts = ("num_envs", "num_steps", "num_minibatches", "update_epochs", "vf_epochs")
        for name in (*counts, "checkpoint_interval"):
            self.require(name, getattr(self, name) >= 1, "be at least 1")
        for name in ("seed", "agent", "reward_clip"):
            self.require(name, getattr(self, name) >= 0, "be at least 0")

        positive = ("learning_rate", "vf_learning_rate", "clip_coef", "max_grad_norm")
        for name in (*positive, "output_gain"):
            self.require(name, 0 < getattr(self, name) < math.inf, "be finite and above 0")
        for name in ("gamma", "gae_lambda"):
            self.require(name, 0 <= getattr(self, name) <= 1, "be in [0, 1]")
        self.require("hidden_sizes", min(self.hidden_sizes, default=1) >= 1, "be at least 1")

        batch = f"num_envs * num_steps = {self.batch_size}"
        size, rest = divmod(self.batch_size, self.num_minibatches)
        parts = f"divide {batch} into parts of 2 or more"
        self.require("num_minibatches", size > 1 and not rest, parts)
        self.require("total_timesteps", self.num_updates >= 1, f"be at least {batch}")

        needed = "be False, since a run with anneal_lr depends on its length"
        self.require("extend", not (self.extend and self.anneal_lr), needed)
        self.check_conditioning()  # condwrap

    def require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} must {what}, got {getattr(self, name)!r}")

    @property
    def batch_size(self) -> int:
        return self.num_envs * self.num_steps

    @property
    def num_updates(self) -> int:
        return self.total_timesteps // self.batch_size

    @property
    def path(self) -> Path:
        name = f"{self.env_id.split(':')[-1]}__{Path(__file__).stem}__s{self.seed}__a{self.agent}"
        return self.run_dir or Path("runs", name)


# --- environment ----------------------------------------------------------------------------------


class RunningMoments(RunningMeanStd):
    """RunningMeanStd, faster for one environment: the mean is its sample, the variance 0."""

    def update(self, x: np.ndarray) -> None:
        if len(x) == 1:
            self.update_from_moments(x[0], 0.0, 1)
        else:
            super().update(x)


class NormalizeObservation(VectorWrapper):
    """(obs - mean) / std by running statistics, clipped, `final_obs` too.

    Gymnasium's own raises where environments are reset in the same step. The statistics are the
    caller's: they outlive the environments, and `update=False` freezes them.
    """

    def __init__(self, env: VectorEnv, rms: RunningMeanStd, update: bool = True) -> None:
        super().__init__(env)
        self.rms = rms
        self.update = update

        shape = env.single_observation_space.shape
        self.single_observation_space = gym.spaces.Box(-OBS_CLIP, OBS_CLIP, shape, np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        obs, info = self.env.reset(**kwargs)
        return self.observe(obs), info

    def step(self, actions: np.ndarray) -> tuple:
        obs, *rewards_and_ends, info = self.env.step(actions)
        for i in np.flatnonzero(info.get("_final_obs", ())):
            info["final_obs"][i] = self.normalize(info["final_obs"][i])
        return self.observe(obs), *rewards_and_ends, info

    def observe(self, obs: np.ndarray) -> np.ndarray:
        if self.update:
            self.rms.update(obs)
        return self.normalize(obs)

    def normalize(self, obs: np.ndarray) -> np.ndarray:
        scaled = (obs - self.rms.mean) / np.sqrt(self.rms.var + 1e-8)
        return scaled.clip(-OBS_CLIP, OBS_CLIP).astype(np.float32)


def make_env(args: Args) -> gym.Env:
    bullet = "Bullet" in args.env_id and ":" not in args.env_id
    env = gym.make(f"pybullet_envs_gymnasium:{args.env_id}" if bullet else args.env_id)
    if not isinstance(env.action_space, gym.spaces.Box):
        raise RunError(f"env_id must name a task with a Box of actions, got {env.action_space}")

    flat = len(env.observation_space.shape or ()) == 1
    return env if flat else gym.wrappers.FlattenObservation(env)


def make_envs(args: Args, stats: dict[str, RunningMeanStd]) -> VectorEnv:
    """The environments until the next checkpoint, with `stats` to normalize by (filled if empty).

    A simulator's state cannot be saved. So every run builds new environments at each checkpoint,
    and an interrupted run sees the same episodes as an undisturbed one.
    """
    makers = [functools.partial(make_env, args)] * args.num_envs
    envs: VectorEnv = SyncVectorEnv(makers, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)
    envs = RecordEpisodeStatistics(envs)

    if args.norm_obs:
        shape = envs.single_observation_space.shape
        envs = NormalizeObservation(envs, stats.setdefault("obs_rms", RunningMoments(shape=shape)))

    if args.norm_reward:
        envs = NormalizeReward(envs, gamma=args.gamma)
        envs.return_rms = stats.setdefault("return_rms", RunningMoments())
        if args.reward_clip:
            envs = ClipReward(envs, -args.reward_clip, args.reward_clip)

    return envs


def env_seeds(args: Args, checkpoint: int) -> list[int]:
    sequence = np.random.SeedSequence((args.seed, args.agent, checkpoint))
    return sequence.generate_state(args.num_envs).tolist()


# --- agent ----------------------------------------------------------------------------------------


def make_mlp(args: Args, n_in: int, n_out: int, gain: float, rng: torch.Generator) -> nn.Sequential:
    """Layers with orthogonal weights, `gain` at the output, drawn from `rng` alone."""
    activation = nn.Tanh if args.activation == "tanh" else nn.ReLU
    layers: list[nn.Module] = []
    sizes = (n_in, *args.hidden_sizes, n_out)
    for i, size in enumerate(sizes[1:]):
        is_output = i == len(sizes) - 2
        linear = nn.utils.skip_init(nn.Linear, sizes[i], size)
        nn.init.orthogonal_(linear.weight, gain if is_output else math.sqrt(2), rng)
        nn.init.zeros_(linear.bias)
        layers += [linear, activation()]

    return nn.Sequential(*layers[:-1])


class Actor(nn.Module):
    """Gaussian policy: a mean for each observation, one log-std for each action."""

    def __init__(self, args: Args, obs_dim: int, action_dim: int, rng: torch.Generator) -> None:
        super().__init__()
        self.mean = make_mlp(args, obs_dim, action_dim, args.output_gain, rng)
        self.log_std = nn.Parameter(torch.full((action_dim,), args.log_std_init))

    def forward(self, obs: Tensor) -> Independent:
        mean = self.mean(obs)
        normal = Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False)
        return Independent(normal, 1, validate_args=False)


class Learner:
    """All that changes while training, and so all that a checkpoint holds."""

    def __init__(self, args: Args) -> None:
        self.stats: dict[str, RunningMeanStd] = {}
        envs = make_envs(args, self.stats)
        obs_dim = math.prod(envs.single_observation_space.shape)
        space = envs.single_action_space
        action_dim = math.prod(space.shape)
        envs.close()

        # each use of randomness has its own stream
        names = ("init", "action", "minibatch", "penalty", "probe")
        streams = np.random.SeedSequence((args.seed, args.agent)).spawn(len(names))
        numbers = [int(stream.generate_state(1, np.uint64)[0]) for stream in streams]
        seeds = dict(zip(names, numbers, strict=True))
        self.generators = {x: torch.Generator().manual_seed(seeds[x]) for x in names[:3]}

        self.actor = Actor(args, obs_dim, action_dim, self.generators["init"])
        self.critic = make_mlp(args, obs_dim, 1, 1.0, self.generators["init"])
        adam = functools.partial(torch.optim.Adam, eps=1e-5, fused=True)
        self.actor_optimizer = adam(self.actor.parameters(), args.learning_rate)
        self.critic_optimizer = adam(self.critic.parameters(), args.vf_learning_rate)
        self.actor_loss = torch.compile(actor_loss) if args.compile else actor_loss

        self.regularizer = args.make_penalty(seeds["penalty"])  # condwrap
        self.probe = args.make_probe(seeds["probe"], action_space=space)  # condwrap
        self.update = 0  # how many there have been

    @property
    def weights(self) -> Tensor:
        return nn.utils.parameters_to_vector([*self.actor.parameters(), *self.critic.parameters()])

    @property
    def parts(self) -> dict[str, Any]:
        """What saves and restores its own state: networks, optimizers and the like."""
        return {name: x for name, x in vars(self).items() if hasattr(x, "load_state_dict")}

    def state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = {name: part.state_dict() for name, part in self.parts.items()}
        for name, rms in self.stats.items():
            state[name] = {k: torch.tensor(x, dtype=torch.float64) for k, x in vars(rms).items()}
        state["generators"] = {name: x.get_state() for name, x in self.generators.items()}
        state["update"] = self.update
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in self.parts.items():
            part.load_state_dict(state[name])
        for name, rms in self.stats.items():
            vars(rms).update({key: x.numpy() for key, x in state[name].items()})
        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name])
        self.update = state["update"]


# --- PPO ------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """T steps of N environments, and what they led to."""

    obs: Tensor  # [T, N, obs_dim]
    after: Tensor  # [T, N, obs_dim], what the step led to, which next_obs is not at an end
    actions: Tensor  # [T, N, action_dim], before they are clipped to the action space
    rewards: Tensor  # [T, N], scaled for learning
    dones: Tensor  # [T, N], 1 where an episode ended or was cut
    values: Tensor  # [T, N]
    next_values: Tensor  # [T, N], V of what the step led to: 0 at an end, V(final_obs) at a cut
    next_obs: np.ndarray  # [N, obs_dim]
    returns: list[float]  # of the episodes that ended, in raw rewards
    lengths: list[int]
    clean_obs: Tensor  # condwrap: [T · N, obs_dim], before they were perturbed


@torch.no_grad()
def rollout(args: Args, learner: Learner, envs: VectorEnv, next_obs: np.ndarray) -> Rollout:
    """Step the environments. They are reset in the same step, so every transition counts."""
    actor = learner.actor
    space = envs.single_action_space
    shape = (args.num_steps, envs.num_envs)
    obs = np.empty((*shape, next_obs.shape[-1]), np.float32)
    after = np.empty_like(obs)
    clean_obs = np.empty_like(obs)  # condwrap
    rewards = np.empty(shape, np.float32)
    ends = np.empty(shape, np.float32)
    dones = np.empty(shape, np.float32)
    returns: list[float] = []
    lengths: list[int] = []

    # a_t = mean(s_t) + std · noise_t, the noise of all steps drawn at once
    noise = torch.randn((*shape, len(actor.log_std)), generator=learner.generators["action"])
    actions = noise * actor.log_std.exp()

    for t in range(args.num_steps):
        obs[t] = next_obs
        clean_obs[t] = envs.clean_obs if args.perturb_obs else next_obs  # condwrap
        actions[t] += actor.mean(torch.from_numpy(obs[t]))

        # the environment executes the action clipped to its space
        action = actions[t].numpy().reshape(-1, *space.shape).clip(space.low, space.high)
        next_obs, rewards[t], ends[t], cuts, info = envs.step(action)
        dones[t] = np.maximum(ends[t], cuts)

        # what the step led to is the last observation of the episode, not the first of the next
        after[t] = next_obs
        for i in np.flatnonzero(dones[t]):
            after[t, i] = info["final_obs"][i]
        if "episode" in info:
            returns += info["episode"]["r"][info["_episode"]].tolist()
            lengths += info["episode"]["l"][info["_episode"]].tolist()

    values = learner.critic(torch.from_numpy(obs)).squeeze(-1)
    next_values = learner.critic(torch.from_numpy(after)).squeeze(-1)
    return Rollout(
        obs=torch.from_numpy(obs),
        after=torch.from_numpy(after),
        actions=actions,
        rewards=torch.from_numpy(rewards),
        dones=torch.from_numpy(dones),
        values=values,
        next_values=next_values.masked_fill(torch.from_numpy(ends) == 1, 0),
        next_obs=next_obs,
        returns=returns,
        lengths=lengths,
        clean_obs=torch.from_numpy(clean_obs).flatten(0, 1),  # condwrap
    )


def gae(data: Rollout, gamma: float, gae_lambda: float) -> Tensor:
    """Generalized advantage estimation (Schulman et al., 2016, arXiv 1506.02438), `[T, N]`."""
    # TD error: d_t = r_t + gamma · V(s_{t+1}) - V(s_t)
    errors = (data.rewards + gamma * data.next_values - data.values).numpy()
    decays = (gamma * gae_lambda * (1 - data.dones)).numpy()

    # A_t = d_t + gamma · lambda · (1 - done_t) · A_{t+1}
    advantages = np.empty_like(errors)
    advantage = np.zeros_like(errors[0])
    for t in reversed(range(len(errors))):
        advantage = errors[t] + decays[t] * advantage
        advantages[t] = advantage

    return torch.from_numpy(advantages)


def actor_loss(
    args: Args,
    learner: Learner,
    obs: Tensor,
    actions: Tensor,
    old_logprobs: Tensor,
    advantages: Tensor,
    *drawn: Tensor,  # condwrap: what the penalty needs besides
) -> tuple[Tensor, Tensor]:
    """The policy's terms of the loss that `update` minimizes, and what is logged of them."""
    actor = learner.actor
    policy = actor(obs)
    entropy = policy.entropy().mean()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

    # L_CLIP = E[min(ratio · A, clip(ratio, 1 - epsilon, 1 + epsilon) · A)]
    logratio = policy.log_prob(actions) - old_logprobs
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    pg_loss = -torch.min(advantages * ratio, advantages * clipped).mean()

    # -L_CLIP - c3 · entropy + c1 · mean(psi)
    loss = pg_loss - args.ent_coef * entropy
    if drawn:  # condwrap
        loss += args.penalize(learner, obs, actions, policy, drawn)  # condwrap

    # KL(old‖new) is estimated by E[ratio - 1 - log ratio]
    kl = (ratio - 1 - logratio).mean()
    clipfrac = (ratio != clipped).float().mean()
    return loss, torch.stack([pg_loss, entropy, kl, clipfrac]).detach()


def step(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_grad_norm)
    optimizer.step()


def update(args: Args, learner: Learner, data: Rollout) -> dict[str, float]:
    """Epochs of minibatches over one rollout: equation (3) of the paper, minimized.

    The paper maximizes L_CLIP + c1·psi - c2·L_VF + c3·entropy, which would reward bad conditioning;
    its text says penalty. So -L_CLIP + c1·mean(psi) + c2·L_VF - c3·entropy is minimized here, the
    policy's terms and the critic's each by an optimizer of their own, since they share no weights.
    """
    # step sizes fall linearly to 0
    if args.anneal_lr:
        left = 1 - (learner.update - 1) / args.num_updates
        learner.actor_optimizer.param_groups[0]["lr"] = left * args.learning_rate
        learner.critic_optimizer.param_groups[0]["lr"] = left * args.vf_learning_rate

    # flatten [T, N, ...] to [T · N, ...]; the critic's targets are A_t + V(s_t)
    obs = data.obs.flatten(0, 1)
    actions = data.actions.flatten(0, 1)
    advantages = gae(data, args.gamma, args.gae_lambda).flatten()
    values = data.values.flatten()
    targets = advantages + values
    with torch.no_grad():
        old_logprobs = learner.actor(obs).log_prob(actions)
    batch = [obs, actions, old_logprobs, advantages]

    def plain_loss() -> Tensor:  # condwrap
        return actor_loss(args, learner, *batch)[0]  # condwrap

    share = learner.probe.gradient_share(learner.update, learner.actor, obs, plain_loss)  # condwrap

    policy_logs: list[Tensor] = []
    value_losses: list[Tensor] = []
    policy_learns = True
    for epoch in range(max(args.update_epochs, args.vf_epochs)):
        policy_learns = policy_learns and epoch < args.update_epochs
        columns = list(batch)
        if args.coefficient > 0 and policy_learns:  # condwrap
            columns += args.draw(learner, data)  # condwrap

        order = torch.randperm(len(obs), generator=learner.generators["minibatch"])
        for i in order.split(len(obs) // args.num_minibatches):
            if policy_learns:
                loss, logs = learner.actor_loss(args, learner, *[x[i] for x in columns])
                step(learner.actor_optimizer, loss, args.max_grad_norm)
                policy_logs.append(logs)

            # L_VF = E[(V(s_t) - target_t)²]
            if epoch < args.vf_epochs:
                value_loss = (learner.critic(obs[i]).squeeze(-1) - targets[i]).square().mean()
                step(learner.critic_optimizer, args.vf_coef * value_loss, args.max_grad_norm)
                value_losses.append(value_loss.detach())

        # stop the policy once it has moved too far from the one that acted
        if policy_learns and args.target_kl is not None:
            _, _, kls, _ = torch.stack(policy_logs[-args.num_minibatches :]).unbind(1)
            policy_learns = bool(kls.mean() <= args.target_kl)

    pg_loss, entropy, kl, clipfrac = torch.stack(policy_logs).mean(0).tolist()
    return {
        "charts/learning_rate": learner.actor_optimizer.param_groups[0]["lr"],
        "losses/policy_loss": pg_loss,
        "losses/entropy": entropy,
        "losses/approx_kl": kl,
        "losses/clipfrac": clipfrac,
        "losses/value_loss": torch.stack(value_losses).mean().item(),
        "losses/explained_variance": (1 - (targets - values).var() / targets.var()).item(),
        **share,  # condwrap
    }


# --- files ----------------------------------------------------------------------------------------


def open_logs(args: Args, saved: dict[str, Any] | None) -> SummaryWriter:
    """Cut metrics.csv back to the checkpoint, and go on with TensorBoard's events from there."""
    args.path.mkdir(parents=True, exist_ok=True)
    size = saved["metrics_size"] if saved else 0
    with open(args.path / "metrics.csv", "a") as metrics:
        if metrics.tell() < size:
            raise RunError(f"{metrics.name} lacks rows: remove its folder to start again")
        metrics.truncate(size)  # later rows are computed again
    (args.path / "diverged.json").unlink(missing_ok=True)  # and may now stay finite

    first = saved["learner"]["update"] if saved else 0
    writer = SummaryWriter(str(args.path), purge_step=first * args.batch_size + 1)
    rows = "".join(f"\n|{name}|{value}|" for name, value in vars(args).items())
    writer.add_text("hyperparameters", f"|parameter|value|\n|-|-|{rows}")
    return writer


def log_update(
    args: Args, learner: Learner, writer: SummaryWriter, data: Rollout, numbers: dict[str, float]
) -> dict[str, float]:
    """Write the update's row of metrics.csv, and the same as TensorBoard scalars."""
    row = {
        "global_step": learner.update * args.batch_size,
        "charts/episodic_return": float(np.mean(data.returns or math.nan)),
        "charts/episodic_length": float(np.mean(data.lengths or math.nan)),
        "charts/episodes": len(data.returns),
        **numbers,
        **learner.probe.measure(learner.update, learner.actor, data.clean_obs),  # condwrap
    }
    with open(args.path / "metrics.csv", "a", newline="") as file:
        table = csv.DictWriter(file, row)
        if file.tell() == 0:
            table.writeheader()
        table.writerow(row)

    for name, value in row.items():
        if not math.isnan(value):
            writer.add_scalar(name, value, row["global_step"])
    return row


def save_checkpoint(args: Args, learner: Learner) -> None:
    """Write a temporary file, then rename: a crash never leaves half a checkpoint."""
    path = args.path / "checkpoint.pt"
    new = path.with_suffix(".tmp")
    with open(args.path / "metrics.csv", "rb") as metrics, open(new, "wb") as file:
        os.fsync(metrics.fileno())
        content = {
            "version": VERSION,
            "args": {k: v for k, v in vars(args).items() if k not in MAY_CHANGE},
            "learner": learner.state_dict(),
            "metrics_size": os.fstat(metrics.fileno()).st_size,
        }
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())

    if path.exists():
        path.replace(path.with_suffix(".previous.pt"))
    new.replace(path)


def load_checkpoint(args: Args) -> dict[str, Any] | None:
    """The newest checkpoint that can be read, if the run may be resumed and there is one."""
    path = args.path / "checkpoint.pt"
    found = [p for p in (path, path.with_suffix(".previous.pt")) if p.exists()]
    if not args.resume and (found or (args.path / "metrics.csv").exists()):
        raise RunError(f"{args.path} holds a run: --resume it, or name another --run-dir")

    for candidate in found:
        try:
            saved = torch.load(candidate, map_location="cpu", weights_only=True)
        except Exception as error:  # a torn file can raise almost anything
            print(f"{candidate} cannot be read: {error!r}")
        else:
            check_same(args, saved)
            return saved

    if found:
        raise RunError(f"{args.path} holds no readable checkpoint: remove it to start again")
    return None


def check_same(args: Args, saved: dict[str, Any]) -> None:
    """Raise RunError unless the run was begun with these settings, or can be extended to them."""
    now = {"VERSION": VERSION, **vars(args)}
    begun = {"VERSION": saved.get("version", 1), **saved["args"]}
    longer = args.extend and args.total_timesteps > begun["total_timesteps"]
    for name, value in begun.items():
        if value != now.get(name) and not (longer and name == "total_timesteps"):
            raise RunError(f"{args.path} was run with {name}={value}, not {now.get(name)}")

    # a longer run would rebuild its environments at the next multiple, not here
    updates = saved["learner"]["update"]
    if longer and updates % args.checkpoint_interval:
        of = f"not a multiple of checkpoint_interval={args.checkpoint_interval}"
        raise RunError(f"{args.path} cannot be extended: its {updates} updates are {of}")


# --- training -------------------------------------------------------------------------------------


def check_finite(args: Args, update: int, **numbers: Tensor) -> None:
    """Raise DivergedError, and say so in diverged.json, for the first that is not finite."""
    for what, values in numbers.items():
        if not values.isfinite().all():
            message = f"the {what} became non-finite in update {update}"
            content = {"update": update, "what": what, "message": message}
            (args.path / "diverged.json").write_text(json.dumps(content))
            raise DivergedError(f"{args.path}: {message}")


def train(args: Args) -> Learner:
    """Train, or continue to train, until `total_timesteps`."""
    saved = load_checkpoint(args)
    learner = Learner(args)
    if saved:
        learner.load_state_dict(saved["learner"])
    if learner.update >= args.num_updates:
        print(f"{args.path} is finished")
        return learner

    writer = open_logs(args, saved)
    first = learner.update
    started = time.monotonic()
    printed = -math.inf
    while learner.update < args.num_updates:  # from one checkpoint to the next
        checkpoint = learner.update // args.checkpoint_interval
        envs = make_envs(args, learner.stats)
        envs = args.perturb(envs)  # condwrap
        next_obs, _ = envs.reset(seed=env_seeds(args, checkpoint))

        for _ in range(min(args.checkpoint_interval, args.num_updates - learner.update)):
            data = rollout(args, learner, envs, next_obs)
            next_obs = data.next_obs
            learner.update += 1
            check_finite(args, learner.update, observation=data.obs, reward=data.rewards)
            losses = update(args, learner, data)
            check_finite(args, learner.update, loss=learner.weights)

            now = time.monotonic()
            speed = (learner.update - first) * args.batch_size / (now - started)
            row = log_update(args, learner, writer, data, {"charts/SPS": speed, **losses})
            if now - printed > 10 or learner.update == args.num_updates:
                printed = now
                print(f"update {learner.update}/{args.num_updates}  {speed:.0f} steps/s  "
                      f"return {row['charts/episodic_return']:.1f}")  # fmt: skip

        envs.close()
        writer.flush()
        save_checkpoint(args, learner)

    writer.close()
    return learner


def main() -> None:
    torch.set_num_threads(1)  # more do not help networks this small
    sys.stdout.reconfigure(line_buffering=True)  # progress shows in a log file too
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)

    try:
        args = tyro.cli(Args, description=__doc__)
        if args.track:
            import wandb

            wandb.init(name=args.path.name, config=vars(args), sync_tensorboard=True)
        train(args)
    except DivergedError as error:
        print(error)
        sys.exit(3)
    except (RunError, gym.error.Error, ModuleNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: --resume continues from the last checkpoint, if there is one yet")


if __name__ == "__main__":
    main()
