"""PPO with the conditioning penalty for N agents at once, each as ppo_reg.py would train it.

    python ppo_reg_population.py --env-id HopperBulletEnv-v0 --seed 1 --num-agents 10

Agent i has the initial weights, seeds, noise, statistics and files of `ppo_reg.py --agent i`, and
either program resumes the other's runs. Stacked is the arithmetic: one call acts for all agents,
one updates all. Live runs of the two part in time, as the last bit of an action moves the physics.

Lines marked so are the penalty (Asadulaev et al., arXiv 1906.05437):  # condwrap
Needs ppo_reg.py, beside this file or in the package `baselines`.
"""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from condwrap.functional import clamping_penalty, conditioning_quotient  # condwrap
from condwrap.wrappers import VectorPerturbObservation  # condwrap

if __package__:
    from baselines import ppo_reg as single
else:  # run as a file, the other beside it
    import ppo_reg as single


@dataclasses.dataclass(frozen=True)
class Args(single.Args):
    num_agents: int = 10
    """agents to train, numbered from `agent` on; {agent} in run_dir stands for the number"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_agents < 1:
            raise ValueError(f"num_agents must be at least 1, got {self.num_agents}")
        if self.num_agents > 1 and self.run_dir and "{agent}" not in str(self.run_dir):
            raise ValueError(f"run_dir must hold {{agent}}, a folder for each, got {self.run_dir}")
        if self.track:
            raise ValueError(f"track follows one run: train agents singly, by {SINGLE}")

    @property
    def runs(self) -> list[single.Args]:
        """What the single file would be given for each agent."""
        settings = {f.name: getattr(self, f.name) for f in dataclasses.fields(single.Args)}
        runs = []
        for agent in range(self.agent, self.agent + self.num_agents):
            path = self.run_dir and Path(str(self.run_dir).replace("{agent}", str(agent)))
            runs.append(single.Args(**{**settings, "agent": agent, "run_dir": path}))
        return runs


SINGLE = Path(single.__file__).name


# --- environments ---------------------------------------------------------------------------------


class Environments(VectorEnv):
    """The environments of all agents, E of each, in turn: what make_envs makes for one of them.

    Bit for bit the same, statistics and all, without the cost of N stacks of Gymnasium's wrappers.
    """

    def __init__(self, runs: list[single.Args], checkpoint: int, learners: list[Any]) -> None:
        args, self.learners, self.agents = runs[0], learners, (len(runs), runs[0].num_envs)
        self.envs = [single.make_env(r, i, checkpoint) for r in runs for i in range(r.num_envs)]
        self.num_envs, space = len(self.envs), self.envs[0].observation_space
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.obs = np.zeros((self.num_envs, *space.shape), space.dtype)
        self.stats = {name: stack_stats(learners, name) for name in learners[0].stats}
        if "obs_rms" in self.stats:
            space = gym.spaces.Box(-single.CLIP, single.CLIP, space.shape, np.float32)
        self.single_observation_space = space
        self.observation_space = batch_space(space, self.num_envs)
        self.single_action_space = self.envs[0].action_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.gamma, self.returns = args.gamma, np.zeros(self.num_envs)
        self.lengths = np.zeros(self.num_envs, int)
        self.discounted = np.zeros(self.num_envs, np.float32)  # returns, as NormalizeReward has it

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict]:
        for i, env in enumerate(self.envs):
            self.obs[i], _ = env.reset(seed=seed[i])
        return self.observe(), {}

    def step(self, actions: np.ndarray) -> tuple:
        rewards, finals = np.empty(self.num_envs), np.full(self.num_envs, None)
        ends, cuts = (np.empty(self.num_envs, np.bool_) for _ in range(2))
        for i, env in enumerate(self.envs):
            obs, rewards[i], ends[i], cuts[i], _ = env.step(actions[i])
            if ends[i] or cuts[i]:
                finals[i] = obs
                obs, _ = env.reset()
            self.obs[i] = obs
        self.returns += rewards
        self.lengths += 1
        done, info = ends | cuts, {}
        if done.any():
            episode = {"r": self.returns.copy(), "l": self.lengths.copy()}
            info = {"episode": episode, "_episode": done, "final_obs": finals, "_final_obs": done}
            self.returns[done] = self.lengths[done] = 0
            for i in np.flatnonzero(done):
                finals[i] = self.normalize(finals[i], i // self.agents[1])
        obs = self.observe()
        return obs, self.scale(rewards, ends, done), ends, cuts, info

    def observe(self) -> np.ndarray:
        if "obs_rms" not in self.stats:
            return self.obs.copy()
        obs = self.obs.reshape(*self.agents, -1)
        update_stats(self.stats["obs_rms"], obs)
        return self.normalize(obs, np.s_[:, None]).reshape(self.obs.shape)

    def normalize(self, obs: np.ndarray, agent: Any) -> np.ndarray:
        """As single.NormalizeObservation does, by the statistics of these agents."""
        if "obs_rms" not in self.stats:
            return obs
        mean, var = (getattr(self.stats["obs_rms"], name)[agent] for name in ("mean", "var"))
        scaled = (obs - mean) / np.sqrt(var + 1e-8)
        return np.clip(scaled, -single.CLIP, single.CLIP).astype(np.float32)

    def scale(self, rewards: np.ndarray, ends: np.ndarray, done: np.ndarray) -> np.ndarray:
        """As Gymnasium's NormalizeReward does, its float32 included."""
        if "return_rms" not in self.stats:
            return rewards
        rms = self.stats["return_rms"]
        self.discounted[:] = self.discounted * self.gamma * (1 - ends) + rewards
        update_stats(rms, self.discounted.reshape(self.agents))
        self.discounted[done] = 0
        return (rewards.reshape(self.agents) / np.sqrt(rms.var + 1e-8)[:, None]).ravel()

    def store(self) -> None:
        """Give each agent its statistics back."""
        for name, rms in self.stats.items():
            moments = zip(rms.mean.copy(), rms.var.copy(), rms.count.ravel(), strict=True)
            for learner, (mean, var, count) in zip(self.learners, moments, strict=True):
                vars(learner.stats[name]).update(mean=mean, var=var, count=count)

    def close_extras(self, **kwargs: Any) -> None:
        for env in self.envs:
            env.close()


def make_envs(args: Args, checkpoint: int, learners: list[Any]) -> VectorEnv:
    """The environments until the next checkpoint, which continue the agents' statistics."""
    envs: VectorEnv = Environments(args.runs, checkpoint, learners)
    if args.perturb_obs:  # condwrap
        envs = VectorPerturbObservation(envs, args.perturbation, args.radius)  # condwrap
    return envs


def stack_stats(learners: list[Any], name: str) -> RunningMeanStd:
    """The agents' statistics as one, which Gymnasium's own formula updates."""
    each, rms = [vars(learner.stats[name]) for learner in learners], RunningMeanStd()
    rms.mean, rms.var = (np.stack([x[key] for x in each]) for key in ("mean", "var"))
    rms.count = np.array([x["count"] for x in each]).reshape(-1, *[1] * (rms.mean.ndim - 1))
    return rms


def update_stats(rms: RunningMeanStd, x: np.ndarray) -> None:
    """RunningMeanStd.update for each agent's environments, `[N, E, ...]`."""
    count = x.shape[1]
    # of one number they need no arithmetic, and take the most time
    moments = (x[:, 0], 0.0) if count == 1 else (x.mean(1), x.var(1))
    rms.update_from_moments(*moments, count)


# --- agents ---------------------------------------------------------------------------------------


def stack(networks: list[nn.Module]) -> list[Tensor]:
    """The networks' parameters, each as one leaf `[N, ...]`."""
    parameters = zip(*[network.parameters() for network in networks], strict=True)
    return [torch.stack(each).detach() for each in parameters]


def forward(layers: list[Tensor], x: Tensor, activation: str) -> list[Tensor]:
    """All agents' networks, weights and biases in turn: what each layer takes, and the output.

    `[N, B, n_in]` to `[N, B, n_out]`. Autograd, and PyTorch's tanh, which takes ten times NumPy's,
    would take more of the time than the matrix products.
    """
    inputs = [x]
    for i in range(0, len(layers), 2):
        x = torch.baddbmm(layers[i + 1][:, None], x, layers[i].mT)
        if i < len(layers) - 2:
            np.tanh(x.numpy(), out=x.numpy()) if activation == "tanh" else x.relu_()
        inputs.append(x)
    return inputs


def backward(stack: Stack, inputs: list[Tensor], grad: Tensor, activation: str) -> None:
    """From the gradient of the output, fill in those of the last leaves, the layers."""
    first = len(stack.leaves) % 2  # the policy's log-std, which no layer holds
    layers, gradients = stack.leaves[first:], stack.gradients[first:]
    for i in reversed(range(0, len(layers), 2)):
        x = inputs[i // 2]
        # the product with its longer side last takes a fourth of the time in a narrow layer
        wide = layers[i].shape[1] > layers[i].shape[2]
        gradients[i].copy_(torch.bmm(x.mT, grad).mT if wide else torch.bmm(grad.mT, x))
        torch.sum(grad, 1, out=gradients[i + 1])
        if i:
            grad = torch.bmm(grad, layers[i])
            grad = grad.addcmul_(grad * x, x, value=-1) if activation == "tanh" else grad * (x > 0)


class Stack:
    """One network of all agents as rows `[N, P]`, each with its own norm, clip and Adam step.

    The leaves `[N, ...]` are views into the rows, as their gradients are into the rows of `grads`.
    """

    def __init__(self, networks: list[nn.Module], optimizers: list[torch.optim.Adam]) -> None:
        self.networks, self.optimizers = networks, optimizers
        shapes = [p.shape for p in networks[0].parameters()]
        self.sizes = [shape.numel() for shape in shapes]
        self.rows = torch.stack([parameters_to_vector(n.parameters()) for n in networks]).detach()
        self.grads, self.exp_avg, self.exp_avg_sq = (torch.zeros_like(self.rows) for _ in range(3))
        self.steps, self.learns = np.zeros(len(networks)), np.zeros(len(networks), bool)
        self.leaves, self.gradients = (
            [part.detach().unflatten(1, shape) for part, shape in zip(parts, shapes, strict=True)]
            for parts in (self.rows.split(self.sizes, 1), self.grads.split(self.sizes, 1))
        )
        for i, (_, state) in enumerate(self.states()):
            if state:
                self.steps[i] = state[0]["step"]
                for key in ("exp_avg", "exp_avg_sq"):
                    torch.cat([x[key].flatten() for x in state], out=getattr(self, key)[i])
        self.learn(np.ones(len(networks), bool))

    def states(self) -> Iterator[tuple[list[nn.Parameter], list[dict[str, Tensor]]]]:
        """Each agent's parameters, and what its own Adam holds of them, if it has stepped."""
        for network, optimizer in zip(self.networks, self.optimizers, strict=True):
            parameters = list(network.parameters())
            yield parameters, [optimizer.state[p] for p in parameters if p in optimizer.state]

    def learn(self, learns: np.ndarray) -> None:
        """Step these agents alone from now on."""
        if (learns == self.learns).all():
            return
        self.learns = learns
        # Adam takes all in one piece as long as it has taken equally many steps with each
        alike = learns.all() and len(set(self.steps)) == 1
        pieces = [slice(None)] if alike else [slice(i, i + 1) for i in np.flatnonzero(learns)]
        group, parts = self.optimizers[0].param_groups[0], [self.rows[i] for i in pieces]
        settings = {name: group[name] for name in ("lr", "betas", "eps")}
        self.optimizer = torch.optim.Adam(parts or [torch.zeros(0)], fused=True, **settings)
        for i, part in zip(pieces, parts, strict=True):
            part.grad, step = self.grads[i], torch.tensor(self.steps[i][0], dtype=torch.float32)
            moments = {"exp_avg": self.exp_avg[i], "exp_avg_sq": self.exp_avg_sq[i]}
            self.optimizer.state[part] = {"step": step, **moments}

    def step(self, max_grad_norm: float) -> None:
        """Step each agent down its own gradient."""
        norms = torch.linalg.vector_norm(self.grads, dim=1, keepdim=True)
        self.grads.mul_((max_grad_norm / (norms + 1e-6)).clamp_(max=1))
        self.optimizer.step()
        self.steps += self.learns

    def store(self) -> None:
        """Give each agent its parameters and moments back, as if it had been trained alone."""
        for i, (parameters, _) in enumerate(self.states()):
            rows = zip(
                parameters,
                *(x[i].split(self.sizes) for x in (self.rows, self.exp_avg, self.exp_avg_sq)),
                strict=True,
            )
            for p, value, mean, square in rows:
                p.data.copy_(value.view_as(p))
                self.optimizers[i].state[p] = {
                    "step": torch.tensor(self.steps[i], dtype=torch.float32),
                    "exp_avg": mean.view_as(p).clone(),
                    "exp_avg_sq": square.view_as(p).clone(),
                }


# --- PPO ------------------------------------------------------------------------------------------


@torch.no_grad()
def rollout(
    args: Args, learners: list[Any], envs: VectorEnv, next_obs: np.ndarray
) -> list[single.Rollout]:
    """Step the environments of all agents; what each saw, as the single file's rollout gives it."""
    shape, space = (args.num_steps, args.num_agents, args.num_envs), envs.single_action_space
    flat = (args.num_steps, envs.num_envs)
    obs, after = (torch.empty(*flat, next_obs.shape[-1]) for _ in range(2))
    rewards, ends, dones = (torch.empty(flat) for _ in range(3))
    log_stds, *actor = stack([learner.actor for learner in learners])
    critic = stack([learner.critic for learner in learners])
    noise = [
        torch.randn((args.num_steps, args.num_envs, len(log_std)), generator=x.generators["action"])
        for x, log_std in zip(learners, log_stds, strict=True)
    ]
    actions = torch.stack(noise, 1) * log_stds.exp()[:, None]  # [T, N, E, action_dim]
    episodes: list[tuple[list[float], list[int]]] = [([], []) for _ in learners]
    arrays = [x.numpy() for x in (obs, after, rewards, ends, dones)]
    for t in range(args.num_steps):
        arrays[0][t] = next_obs
        actions[t] += forward(actor, obs[t].view(*shape[1:], -1), args.activation)[-1]
        action = actions[t].numpy().reshape(-1, *space.shape)
        answer = envs.step(np.clip(action, space.low, space.high))
        next_obs, arrays[2][t], arrays[3][t], cut, info = answer
        arrays[1][t], arrays[4][t] = next_obs, np.maximum(arrays[3][t], cut)
        for i in np.flatnonzero(info.get("_episode", ())):
            arrays[1][t, i] = info["final_obs"][i]
            for which, key in enumerate("rl"):
                episodes[i // args.num_envs][which].append(info["episode"][key][i].item())
    values, next_values = (
        forward(critic, by_agent(x.view(*shape, -1)), args.activation)[-1]
        .view(args.num_agents, args.num_steps, args.num_envs)
        .transpose(0, 1)
        for x in (obs, after)
    )
    rewards, ends, dones = (x.view(shape) for x in (rewards, ends, dones))
    columns = (obs.view(*shape, -1), actions, rewards, dones, values, next_values * (1 - ends))
    each_next = next_obs.reshape(*shape[1:], -1)
    return [
        single.Rollout(*[x[:, i] for x in columns], each_next[i], *episodes[i])
        for i in range(args.num_agents)
    ]


def by_agent(x: Tensor) -> Tensor:
    """`[T, N, E, ...]` to `[N, T · E, ...]`, each agent's steps in the single file's order."""
    return x.transpose(0, 1).flatten(1, 2)


class Batch(NamedTuple):
    """What an update learns from, all of it `[N, B, ...]` or a minibatch."""

    obs: Tensor
    actions: Tensor
    logprobs: Tensor  # of the actions, under the policy that took them
    advantages: Tensor
    targets: Tensor  # of the critic


def make_batch(args: Args, actor: Stack, rollouts: list[single.Rollout]) -> tuple[Batch, Tensor]:
    """The agents' rollouts as one batch, and the critics' explained variance."""
    columns = [torch.stack(x, 1) for x in zip(*[r[:6] for r in rollouts], strict=True)]
    data = single.Rollout(*columns, None, [], [])  # [T, N, E, ...]
    advantages = by_agent(single.gae(data, args.gamma, args.gae_lambda))
    obs, actions, values = (by_agent(x) for x in (data.obs, data.actions, data.values))
    targets = advantages + values
    log_std, *layers = actor.leaves
    logprobs, _ = log_prob(forward(layers, obs, args.activation)[-1], log_std, actions)
    explained = 1 - (targets - values).var(1) / targets.var(1)
    return Batch(obs, actions, logprobs, advantages, targets), explained


def log_prob(means: Tensor, log_std: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Of a Gaussian, but for a constant, `[N, B]`; and the actions in standard deviations."""
    scaled = (actions - means) * (-log_std).exp()[:, None]
    return -0.5 * scaled.square().sum(-1) - log_std.sum(-1, keepdim=True), scaled


def minibatches(args: Args, learners: list[Any], batch: Batch) -> Batch:
    """An epoch, each agent's steps in an order of its own: `[minibatches, N, b, ...]`."""
    size, agents = args.batch_size, args.num_agents
    orders = [torch.randperm(size, generator=x.generators["minibatch"]) for x in learners]
    rows = torch.stack(orders) + size * torch.arange(agents)[:, None]
    order = rows.view(agents, args.num_minibatches, -1).transpose(0, 1)
    epoch = Batch(*[x.flatten(0, 1)[order] for x in batch])
    std, mean = torch.std_mean(epoch.advantages, -1, keepdim=True)
    return epoch._replace(advantages=(epoch.advantages - mean) / (std + 1e-8))


def draw_delta(learners: list[Any], obs: Tensor, learns: np.ndarray) -> Tensor:  # condwrap
    """What the regularizers of learning agents would draw in turn, `[M, N, b, n]`."""  # condwrap
    noise = torch.ones_like(obs)  # condwrap
    for agent in np.flatnonzero(learns):  # condwrap
        for x in noise[:, agent]:  # condwrap
            x.normal_(generator=learners[agent].regularizer.generator)  # condwrap
    return learners[0].regularizer.perturbation(noise)  # condwrap


def penalty_gradient(args: Args, output: Tensor, moved: Tensor, delta: Tensor) -> Any:  # condwrap
    """Of each agent's coefficient · mean(psi), with respect to pi(S) and pi(S + delta)."""  # condwrap
    outputs = [x.detach().requires_grad_() for x in (output, moved)]  # condwrap
    with torch.enable_grad():  # condwrap
        quotient = conditioning_quotient(*outputs, delta, batch_ndim=2)  # condwrap
        psi = clamping_penalty(quotient, args.lambda_min, args.lambda_max)  # condwrap
        return torch.autograd.grad(args.coefficient * psi.mean(1).sum(), outputs)  # condwrap


def policy_step(
    args: Args, actor: Stack, part: Batch, delta: Tensor | None
) -> tuple[Tensor, Tensor]:
    """One step down each agent's loss, the single file's; the log-ratios and log-stds before it.

    Of -min(A r, A clip(r)) the slope in log r is -A r where that is the smaller one, else 0.
    """
    (log_std, *layers), states, size = actor.leaves, part.obs, part.obs.shape[1]
    if delta is not None:  # condwrap
        states = torch.cat([states, states + delta], 1)  # condwrap
    *inputs, output = forward(layers, states, args.activation)
    logprob, scaled = log_prob(output[:, :size], log_std, part.actions)
    logratio = logprob - part.logprobs
    ratio = logratio.exp()
    gains = part.advantages * ratio
    unclipped = gains <= part.advantages * ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    slopes = (gains * unclipped * (-1 / size))[..., None]
    grad = slopes * scaled * (-log_std).exp()[:, None]
    torch.sum(slopes * (scaled.square() - 1), 1, out=actor.gradients[0]).sub_(args.ent_coef)
    if delta is not None:  # condwrap
        clean, moved = penalty_gradient(args, output[:, :size], output[:, size:], delta)  # condwrap
        grad = torch.cat([grad + clean, moved], 1)  # condwrap
    before = logratio, log_std.clone()
    backward(actor, inputs, grad, args.activation)
    actor.step(args.max_grad_norm)
    return before


def value_step(args: Args, critic: Stack, part: Batch) -> Tensor:
    """One step of each critic; its squared error before it, `[N]`."""
    *inputs, values = forward(critic.leaves, part.obs, args.activation)
    errors = values - part.targets[..., None]
    backward(critic, inputs, (2 * args.vf_coef / errors.shape[1]) * errors, args.activation)
    critic.step(args.max_grad_norm)
    return errors.square().mean((1, 2))


def policy_logs(args: Args, advantages: Tensor, seen: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Loss, entropy, KL estimate and share of clipped samples in an epoch: `[4, N]`."""
    logratio, log_std = (torch.stack(x) for x in zip(*seen, strict=True))
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    losses = -torch.min(advantages * ratio, advantages * clipped)
    entropies = (0.5 + 0.5 * math.log(2 * math.pi) + log_std).sum(-1, keepdim=True)
    logs = (losses, entropies, ratio - 1 - logratio, (ratio != clipped).to(ratio.dtype))
    return torch.stack([x.mean((0, 2)) for x in logs])


@torch.no_grad()
def update(
    args: Args, learners: list[Any], rollouts: list[single.Rollout]
) -> list[dict[str, float]]:
    """What the single file's update does to each agent with its own rollout."""
    if args.anneal_lr:
        left = 1 - learners[0].update / args.num_updates
        for learner in learners:
            learner.actor_optimizer.param_groups[0]["lr"] = left * args.learning_rate
            learner.critic_optimizer.param_groups[0]["lr"] = left * args.vf_learning_rate
    actor = Stack([x.actor for x in learners], [x.actor_optimizer for x in learners])
    critic = Stack([x.critic for x in learners], [x.critic_optimizer for x in learners])
    batch, explained = make_batch(args, actor, rollouts)
    learns, epochs = np.ones(args.num_agents, bool), np.zeros(args.num_agents, int)
    logs, value_losses = [], []
    for epoch in range(max(args.update_epochs, args.vf_epochs)):
        parts, seen = minibatches(args, learners, batch), []
        learns = learns & (epoch < args.update_epochs)
        actor.learn(learns)
        deltas = [None] * args.num_minibatches
        if args.coefficient > 0 and learns.any():  # condwrap
            deltas = draw_delta(learners, parts.obs, learns)  # condwrap
        for *columns, delta in zip(*parts, deltas, strict=True):
            part = Batch(*columns)
            if learns.any():
                seen.append(policy_step(args, actor, part, delta))
            if epoch < args.vf_epochs:
                value_losses.append(value_step(args, critic, part))
        if learns.any():
            epochs += learns
            logs.append(policy_logs(args, parts.advantages, seen))
            if args.target_kl is not None:
                learns = learns & (logs[-1][2] <= args.target_kl).numpy()
    actor.store()
    critic.store()
    names = ("policy_loss", "entropy", "approx_kl", "clipfrac", "value_loss", "explained_variance")
    policy, value = torch.stack(logs), torch.stack(value_losses).mean(0)  # [epochs, 4, N], [N]
    rows = []
    for i, count in enumerate(epochs):
        means = [*policy[:count, :, i].mean(0), value[i], explained[i]]
        losses = {f"losses/{name}": x.item() for name, x in zip(names, means, strict=True)}
        rate = learners[i].actor_optimizer.param_groups[0]["lr"]
        rows.append({"charts/learning_rate": rate, **losses})
    return rows


# --- training -------------------------------------------------------------------------------------


def load_checkpoints(runs: list[single.Args]) -> list[dict[str, Any] | None]:
    """Each agent's newest checkpoint, or of an update that all have: a kill may part them."""
    saved = [single.load_checkpoint(run) for run in runs]
    updates = [x["learner"]["update"] if x else 0 for x in saved]
    ahead = [i for i, update in enumerate(updates) if update > min(updates)]
    for i in ahead:
        path = runs[i].path / "checkpoint.previous.pt"
        before = torch.load(path, weights_only=True)["learner"]["update"] if path.exists() else 0
        if before != min(updates):
            steps = ", ".join(f"{u} (agent {r.agent})" for u, r in zip(updates, runs, strict=True))
            raise single.RunError(f"the agents are at updates {steps}: resume each by {SINGLE}")
    for i in ahead:
        path = runs[i].path / "checkpoint.pt"
        path.with_suffix(".previous.pt").replace(path) if min(updates) else path.unlink()
        saved[i] = single.load_checkpoint(runs[i])
    return saved


def train(args: Args) -> list[Any]:
    """Train, or continue to train, every agent until `total_timesteps`."""
    runs = args.runs
    saved = load_checkpoints(runs)
    learners = [single.Learner(run) for run in runs]
    for learner, state in zip(learners, saved, strict=True):
        if state:
            learner.load_state_dict(state["learner"])
    first, started, printed = learners[0].update, time.time(), -math.inf
    if first == args.num_updates:
        print(f"{', '.join(str(run.path) for run in runs)}: finished")
        return learners
    writers = [single.open_logs(run, state) for run, state in zip(runs, saved, strict=True)]
    while learners[0].update < args.num_updates:  # from one checkpoint to the next
        checkpoint = learners[0].update // args.checkpoint_interval
        envs = make_envs(args, checkpoint, learners)
        seeds = [seed for run in runs for seed in single.env_seeds(run, checkpoint)]
        next_obs, _ = envs.reset(seed=seeds)
        for _ in range(min(args.checkpoint_interval, args.num_updates - learners[0].update)):
            rollouts = rollout(args, learners, envs, next_obs)
            next_obs = np.concatenate([x.next_obs for x in rollouts])
            losses = update(args, learners, rollouts)
            updates = learners[0].update + 1 - first
            speed = updates * args.batch_size * args.num_agents / (time.time() - started)
            returns = []
            for run, learner, writer, *x in zip(
                runs, learners, writers, rollouts, losses, strict=True
            ):
                learner.update += 1
                row = single.make_row(run, learner, *x, speed)
                single.write_metrics(run, writer, row)
                returns.append(row["charts/episodic_return"])
            if time.time() - printed > 10 or learners[0].update == args.num_updates:
                printed = time.time()
                mean = np.nanmean(returns) if not np.isnan(returns).all() else math.nan
                print(f"update {learners[0].update}/{args.num_updates}  {speed:.0f} steps/s of "
                      f"{args.num_agents} agents  return {mean:.1f}")  # fmt: skip
        envs.unwrapped.store()
        envs.close()
        for run, learner in zip(runs, learners, strict=True):
            single.save_checkpoint(run, learner)
    for writer in writers:
        writer.close()
    return learners


def main() -> None:
    torch.set_num_threads(1)  # more do not pay for networks of this size
    sys.stdout.reconfigure(line_buffering=True)  # progress shows in a log file too
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)
    try:
        train(tyro.cli(Args, description=__doc__))
    except (single.RunError, gym.error.Error, ModuleNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: --resume continues from the last checkpoint, if there is one yet")


if __name__ == "__main__":
    main()
