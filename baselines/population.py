"""What ppo_reg_population.py and trpo_reg_population.py share: N agents of one single file at once.

Environments that are normalized as the single file's wrappers would, networks whose parameters are
stacked so that one call evaluates or steps all, rollouts, and a training loop that keeps for each
agent the files of a single run. Its `charts/SPS` counts the steps of all. `args.single` is the
single file's module.
"""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from condwrap.functional import conditioning_quotient  # condwrap
from condwrap.wrappers import VectorPerturbObservation  # condwrap


@dataclasses.dataclass(frozen=True)
class PopulationArgs:
    """To be derived from together with the `Args` of a single file, its module as `single`."""

    num_agents: int = 10
    """agents to train, numbered from `agent` on; {agent} in run_dir stands for the number"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_agents < 1:
            raise ValueError(f"num_agents must be at least 1, got {self.num_agents}")
        if self.num_agents > 1 and self.run_dir and "{agent}" not in str(self.run_dir):
            raise ValueError(f"run_dir must hold {{agent}}, a folder for each, got {self.run_dir}")
        if getattr(self, "compile", False):
            raise ValueError(f"compile is for agents trained singly, by {self.single_file}")
        if self.track:
            raise ValueError(f"track follows one run: train agents singly, by {self.single_file}")

    @property
    def single_file(self) -> str:
        return Path(self.single.__file__).name

    @property
    def runs(self) -> list[Any]:
        """What the single file would be given for each agent."""
        fields = dataclasses.fields(self.single.Args)
        settings = {field.name: getattr(self, field.name) for field in fields}
        runs = []
        for agent in range(self.agent, self.agent + self.num_agents):
            path = self.run_dir and Path(str(self.run_dir).replace("{agent}", str(agent)))
            runs.append(self.single.Args(**{**settings, "agent": agent, "run_dir": path}))
        return runs


# --- environments ---------------------------------------------------------------------------------


class Environments(VectorEnv):
    """The environments of all agents, E of each, in turn: what make_envs makes for one of them.

    Bit for bit the same, statistics and all, without the cost of N stacks of Gymnasium's wrappers.
    """

    def __init__(self, args: PopulationArgs, checkpoint: int, learners: list[Any]) -> None:
        self.learners, self.agents = learners, (args.num_agents, args.num_envs)
        make, self.clip = args.single.make_env, args.single.CLIP
        self.envs = [make(run, i, checkpoint) for run in args.runs for i in range(args.num_envs)]
        self.num_envs, space = len(self.envs), self.envs[0].observation_space
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.obs = np.zeros((self.num_envs, *space.shape), space.dtype)
        self.stats = {name: stack_stats(learners, name) for name in learners[0].stats}
        if "obs_rms" in self.stats:
            space = gym.spaces.Box(-self.clip, self.clip, space.shape, np.float32)
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
        """As NormalizeObservation does, by the statistics of these agents."""
        if "obs_rms" not in self.stats:
            return obs
        mean, var = (getattr(self.stats["obs_rms"], name)[agent] for name in ("mean", "var"))
        scaled = (obs - mean) / np.sqrt(var + 1e-8)
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)

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


def make_envs(args: PopulationArgs, checkpoint: int, learners: list[Any]) -> VectorEnv:
    """The environments until the next checkpoint, which continue the agents' statistics."""
    envs: VectorEnv = Environments(args, checkpoint, learners)
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
    """One network of all agents as rows `[N, P]`, and gradients as rows alike.

    The leaves `[N, ...]`, in the order of the network's parameters, are views into the rows.
    """

    def __init__(self, networks: list[nn.Module]) -> None:
        self.networks = networks
        self.shapes = [p.shape for p in networks[0].parameters()]
        self.sizes = [shape.numel() for shape in self.shapes]
        self.rows = torch.stack([parameters_to_vector(n.parameters()) for n in networks]).detach()
        self.grads = torch.zeros_like(self.rows)
        self.leaves, self.gradients = (self.parts(x) for x in (self.rows, self.grads))

    def parts(self, rows: Tensor) -> list[Tensor]:
        """Such rows as views `[N, ...]` in the parameters' shapes."""
        parts = zip(rows.split(self.sizes, 1), self.shapes, strict=True)
        return [part.unflatten(1, shape) for part, shape in parts]

    def store(self) -> None:
        """Give each agent its parameters back."""
        for network, row in zip(self.networks, self.rows, strict=True):
            for p, value in zip(network.parameters(), row.split(self.sizes), strict=True):
                p.data.copy_(value.view_as(p))


class AdamStack(Stack):
    """A stack that Adam steps, each agent by its own clipped gradient and count of steps."""

    def __init__(self, networks: list[nn.Module], optimizers: list[torch.optim.Adam]) -> None:
        super().__init__(networks)
        self.optimizers = optimizers
        self.moments = {key: torch.zeros_like(self.rows) for key in ("exp_avg", "exp_avg_sq")}
        self.steps, self.learns = np.zeros(len(networks)), np.zeros(len(networks), bool)
        for i, (network, optimizer) in enumerate(zip(networks, optimizers, strict=True)):
            states = [optimizer.state[p] for p in network.parameters() if p in optimizer.state]
            if states:
                self.steps[i] = states[0]["step"]
                for key, rows in self.moments.items():
                    rows[i] = torch.cat([state[key].flatten() for state in states])
        self.learn(np.ones(len(networks), bool))

    def learn(self, learns: np.ndarray) -> None:
        """Step these agents alone from now on."""
        if (learns == self.learns).all():
            return
        self.learns = learns
        # all in one piece as long as Adam has taken equally many steps with each
        alike = learns.all() and len(set(self.steps)) == 1
        pieces = [slice(None)] if alike else [slice(i, i + 1) for i in np.flatnonzero(learns)]
        group, parts = self.optimizers[0].param_groups[0], [self.rows[i] for i in pieces]
        settings = {name: group[name] for name in ("lr", "betas", "eps")}
        self.optimizer = torch.optim.Adam(parts or [torch.zeros(0)], fused=True, **settings)
        for i, part in zip(pieces, parts, strict=True):
            part.grad, step = self.grads[i], torch.tensor(self.steps[i][0], dtype=torch.float32)
            moments = {key: rows[i] for key, rows in self.moments.items()}
            self.optimizer.state[part] = {"step": step, **moments}

    def step(self, max_grad_norm: float) -> None:
        """Step each agent down its own gradient."""
        norms = torch.linalg.vector_norm(self.grads, dim=1, keepdim=True)
        self.grads.mul_((max_grad_norm / (norms + 1e-6)).clamp_(max=1))
        self.optimizer.step()
        self.steps += self.learns

    def store(self) -> None:
        """Give each agent its parameters and moments back, as if it had been trained alone."""
        super().store()
        for i, (network, optimizer) in enumerate(zip(self.networks, self.optimizers, strict=True)):
            moments = [rows[i].split(self.sizes) for rows in self.moments.values()]
            for p, *values in zip(network.parameters(), *moments, strict=True):
                copies = [value.view_as(p).clone() for value in values]
                step = torch.tensor(self.steps[i], dtype=torch.float32)
                state = dict(zip(self.moments, copies, strict=True))
                optimizer.state[p] = {"step": step, **state}


# --- rollouts and steps --------------------------------------------------------------------------


@torch.no_grad()
def rollout(
    args: PopulationArgs, learners: list[Any], envs: VectorEnv, next_obs: np.ndarray
) -> list[Any]:
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
        args.single.Rollout(*[x[:, i] for x in columns], each_next[i], *episodes[i])
        for i in range(args.num_agents)
    ]


def by_agent(x: Tensor) -> Tensor:
    """`[T, N, E, ...]` to `[N, T · E, ...]`, each agent's steps in the single file's order."""
    return x.transpose(0, 1).flatten(1, 2).contiguous()


def flatten(args: PopulationArgs, rollouts: list[Any]) -> tuple[Tensor, ...]:
    """Observations, actions, advantages and the critics' targets, `[N, B, ...]`.

    And the critics' explained variance, `[N]`.
    """
    columns = [torch.stack(x, 1) for x in zip(*[r[:6] for r in rollouts], strict=True)]
    data = args.single.Rollout(*columns, None, [], [])  # [T, N, E, ...]
    advantages = by_agent(args.single.gae(data, args.gamma, args.gae_lambda))
    obs, actions, values = (by_agent(x) for x in (data.obs, data.actions, data.values))
    targets = advantages + values
    explained = 1 - (targets - values).var(1) / targets.var(1)
    return obs, actions, advantages, targets, explained


def shuffled(args: PopulationArgs, learners: list[Any]) -> Tensor:
    """An epoch's rows of the flattened batch, each agent's in an order of its own: `[M, N, b]`."""
    size, agents = args.batch_size, args.num_agents
    orders = [torch.randperm(size, generator=x.generators["minibatch"]) for x in learners]
    rows = torch.stack(orders) + size * torch.arange(agents)[:, None]
    return rows.view(agents, args.num_minibatches, -1).transpose(0, 1)


def log_prob(means: Tensor, log_std: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Of a Gaussian, but for a constant, `[N, B]`; and the actions in standard deviations."""
    scaled = (actions - means) * (-log_std).exp()[:, None]
    return -0.5 * scaled.square().sum(-1) - log_std.sum(-1, keepdim=True), scaled


def value_step(args: PopulationArgs, critic: AdamStack, obs: Tensor, targets: Tensor) -> Tensor:
    """One step of each critic; its squared error before it, `[N]`."""
    *inputs, values = forward(critic.leaves, obs, args.activation)
    errors = values - targets[..., None]
    backward(critic, inputs, (2 * args.vf_coef / errors.shape[1]) * errors, args.activation)
    critic.step(args.max_grad_norm)
    return errors.square().mean((1, 2))


def draw_delta(learners: list[Any], obs: Tensor, learns: np.ndarray) -> Tensor:  # condwrap
    """What the learning agents' regularizers draw for the observations, `[N, B, n]`."""  # condwrap
    delta = torch.ones_like(obs)  # of the others it does not matter  # condwrap
    for i in np.flatnonzero(learns):  # condwrap
        delta[i] = learners[i].regularizer.sample_delta(obs[i])  # condwrap
    return delta  # condwrap


def penalty_slope(args: Any, output: Tensor, delta: Tensor) -> Tensor:  # condwrap
    """Of coefficient · mean(psi) in pi(S); in pi(S + delta) the opposite."""  # condwrap
    clean, moved = output.split(delta.shape[1], 1)  # condwrap
    quotient = conditioning_quotient(clean, moved, delta, batch_ndim=2)  # condwrap
    excess = quotient - quotient.clamp(args.lambda_min, args.lambda_max)  # condwrap
    # psi = excess², and dJ / d pi(S) = (pi(S) - pi(S + delta)) / (J ‖delta‖²)
    slopes = excess / (quotient * delta.square().sum(-1))  # condwrap
    slopes *= 2 * args.coefficient / delta.shape[1]  # condwrap
    return slopes.masked_fill_(quotient == 0, 0)[..., None] * (clean - moved)  # condwrap


# --- training -------------------------------------------------------------------------------------


def load_checkpoints(args: PopulationArgs) -> list[dict[str, Any] | None]:
    """Each agent's newest checkpoint, or of an update that all have: a kill may part them."""
    single, runs = args.single, args.runs
    saved = [single.load_checkpoint(run) for run in runs]
    updates = [x["learner"]["update"] if x else 0 for x in saved]
    ahead = [i for i, update in enumerate(updates) if update > min(updates)]
    for i in ahead:
        path = runs[i].path / "checkpoint.previous.pt"
        before = torch.load(path, weights_only=True)["learner"]["update"] if path.exists() else 0
        begun = all((run.path / "metrics.csv").exists() for run in runs)  # none is a newcomer
        if before != min(updates) or not begun:
            steps = ", ".join(f"{u} (agent {r.agent})" for u, r in zip(updates, runs, strict=True))
            how = f"resume each by {args.single_file}"
            raise single.RunError(f"the agents are at updates {steps}: {how}")
    for i in ahead:
        path = runs[i].path / "checkpoint.pt"
        path.with_suffix(".previous.pt").replace(path) if min(updates) else path.unlink()
        saved[i] = single.load_checkpoint(runs[i])
    return saved


def train(args: PopulationArgs, update: Callable[..., Any]) -> list[Any]:
    """Train, or continue to train, every agent until `total_timesteps`."""
    single, runs, saved = args.single, args.runs, load_checkpoints(args)
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


def run(args_class: type, train: Callable[[Any], Any], description: str) -> None:
    """The program: train with the arguments of the command line."""
    torch.set_num_threads(1)  # more do not pay for networks of this size
    sys.stdout.reconfigure(line_buffering=True)  # progress shows in a log file too
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)
    try:
        train(tyro.cli(args_class, description=description))
    except (args_class.single.RunError, gym.error.Error, ModuleNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: --resume continues from the last checkpoint, if there is one yet")
