"""What ppo_reg_population.py and trpo_reg_population.py share: training N agents at once.

Each agent is trained as the single file would train it, and has the files of a single run. The
environments are normalized as the single file's wrappers would normalize them. The parameters of
all agents are stacked, so that one call evaluates or steps all networks. `charts/SPS` counts the
steps of all agents. `args.single` is the single file's module.

An agent whose own numbers become non-finite is frozen: zeros take its place in the stacked
arithmetic, which keeps its shapes, so that the others end bit for bit as they would without it.
"""

from __future__ import annotations

import copy
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
        if getattr(self, "penalty", "conditioning") != "conditioning":
            raise ValueError(
                f"penalty {self.penalty} is for agents trained singly, by {self.single_file}"
            )
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

    Bit for bit the same, statistics included, without the cost of N stacks of Gymnasium's wrappers.
    They continue the learners' statistics, which `store` gives back.
    """

    def __init__(self, args: PopulationArgs, learners: list[Any]) -> None:
        self.args = args
        self.learners = learners
        self.agents = (args.num_agents, args.num_envs)
        self.num_envs = args.num_agents * args.num_envs
        self.envs = [args.single.make_env(args) for _ in range(self.num_envs)]
        self.live = list(range(self.num_envs))  # those that are stepped
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

        self.obs_clip = args.single.OBS_CLIP
        self.stats = {name: stack_stats(learners, name) for name in learners[0].stats}
        raw_space = self.envs[0].observation_space
        self.single_observation_space = raw_space
        if "obs_rms" in self.stats:
            self.single_observation_space = gym.spaces.Box(
                -self.obs_clip, self.obs_clip, raw_space.shape, np.float32
            )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = self.envs[0].action_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        self.obs = np.zeros((self.num_envs, *raw_space.shape), raw_space.dtype)
        self.returns = np.zeros(self.num_envs)
        self.lengths = np.zeros(self.num_envs, int)
        self.discounted = np.zeros(self.num_envs, np.float32)  # returns, as NormalizeReward has it
        for agent, learner in enumerate(learners):
            if is_frozen(learner):
                self.freeze(agent)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict]:
        for i in self.live:
            self.obs[i], _ = self.envs[i].reset(seed=seed[i])
        return self.observe(), {}

    def step(self, actions: np.ndarray) -> tuple:
        rewards = np.zeros(self.num_envs)
        ends = np.zeros(self.num_envs, np.bool_)
        cuts = np.zeros(self.num_envs, np.bool_)
        finals = np.full(self.num_envs, None)
        for i in self.live:
            obs, rewards[i], ends[i], cuts[i], _ = self.envs[i].step(actions[i])
            if ends[i] or cuts[i]:
                finals[i] = obs
                obs, _ = self.envs[i].reset()
            self.obs[i] = obs

        self.returns += rewards
        self.lengths += 1
        done = ends | cuts
        info = self.end_episodes(done, finals) if done.any() else {}
        obs = self.observe()
        return obs, self.scale(rewards, ends, done), ends, cuts, info

    def end_episodes(self, done: np.ndarray, finals: np.ndarray) -> dict[str, Any]:
        """What the step says of the episodes that are done, as Gymnasium's wrappers would."""
        for i in np.flatnonzero(done):
            finals[i] = self.normalize(finals[i], i // self.args.num_envs)

        episode = {"r": self.returns.copy(), "l": self.lengths.copy()}
        self.returns[done] = 0
        self.lengths[done] = 0
        return {"episode": episode, "_episode": done, "final_obs": finals, "_final_obs": done}

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
        rms = self.stats["obs_rms"]
        scaled = (obs - rms.mean[agent]) / np.sqrt(rms.var[agent] + 1e-8)
        return scaled.clip(-self.obs_clip, self.obs_clip).astype(np.float32)

    def scale(self, rewards: np.ndarray, ends: np.ndarray, done: np.ndarray) -> np.ndarray:
        """As Gymnasium's NormalizeReward does, its float32 included, and then its ClipReward."""
        if "return_rms" not in self.stats:
            return rewards
        rms = self.stats["return_rms"]
        self.discounted[:] = self.discounted * self.args.gamma * (1 - ends) + rewards
        update_stats(rms, self.discounted.reshape(self.agents))
        self.discounted[done] = 0

        scaled = (rewards.reshape(self.agents) / np.sqrt(rms.var + 1e-8)[:, None]).ravel()
        bound = self.args.reward_clip
        return scaled.clip(-bound, bound) if bound else scaled

    def freeze(self, agent: int) -> None:
        """Step an agent's environments no more: they show zeros from now on."""
        own = np.arange(self.num_envs) // self.args.num_envs == agent
        self.live = [i for i in self.live if not own[i]]
        for numbers in (self.obs, self.returns, self.lengths, self.discounted):
            numbers[own] = 0
        for rms in self.stats.values():
            rms.mean[agent] = 0
            rms.var[agent] = 1

    def store(self) -> None:
        """Give each agent its statistics back."""
        for name, rms in self.stats.items():
            moments = zip(rms.mean.copy(), rms.var.copy(), rms.count.ravel(), strict=True)
            for learner, (mean, var, count) in zip(self.learners, moments, strict=True):
                vars(learner.stats[name]).update(mean=mean, var=var, count=count)

    def close_extras(self, **kwargs: Any) -> None:
        for env in self.envs:
            env.close()


def stack_stats(learners: list[Any], name: str) -> RunningMeanStd:
    """The agents' statistics as one, which Gymnasium's own formula updates."""
    each = [learner.stats[name] for learner in learners]
    rms = RunningMeanStd()
    rms.mean = np.stack([x.mean for x in each])
    rms.var = np.stack([x.var for x in each])
    rms.count = np.array([x.count for x in each]).reshape(-1, *[1] * (rms.mean.ndim - 1))
    return rms


def update_stats(rms: RunningMeanStd, x: np.ndarray) -> None:
    """RunningMeanStd.update for each agent's environments, `[N, E, ...]`."""
    count = x.shape[1]
    if count == 1:  # moments of one number need no arithmetic, and would take the most time
        rms.update_from_moments(x[:, 0], 0.0, 1)
    else:
        rms.update_from_moments(x.mean(1), x.var(1), count)


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
        weight = layers[i]
        bias = layers[i + 1]
        x = torch.baddbmm(bias[:, None], x, weight.mT)

        is_output = i == len(layers) - 2
        if not is_output and activation == "tanh":
            np.tanh(x.numpy(), out=x.numpy())
        elif not is_output:
            x.relu_()
        inputs.append(x)
    return inputs


def through_activation(grad: Tensor, x: Tensor, activation: str) -> Tensor:
    """The gradient times the activation's slope, where x is what the activation gave; in place.

    tanh' = 1 - x², and relu' = 1 where x > 0.
    """
    return grad.addcmul_(grad * x, x, value=-1) if activation == "tanh" else grad.mul_(x > 0)


def backward(stack: Stack, inputs: list[Tensor], grad: Tensor, activation: str) -> None:
    """From the gradient of the output, fill in those of the last leaves, the layers."""
    first = len(stack.leaves) % 2  # the policy's log-std, which no layer holds
    layers = stack.leaves[first:]
    gradients = stack.gradients[first:]
    for i in reversed(range(0, len(layers), 2)):
        x = inputs[i // 2]

        # weight: gradᵀ x. With its longer side last the product takes a fourth of the time
        wide = layers[i].shape[1] > layers[i].shape[2]
        gradients[i].copy_(torch.bmm(x.mT, grad).mT if wide else torch.bmm(grad.mT, x))

        # bias: the sum over the states
        torch.sum(grad, 1, out=gradients[i + 1])

        # what the layer took: grad · weight, through the activation before it
        if i:
            grad = through_activation(torch.bmm(grad, layers[i]), x, activation)


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
        self.leaves = self.parts(self.rows)
        self.gradients = self.parts(self.grads)

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
    """A stack that Adam steps, each agent by its own clipped gradient and count of steps.

    With `together` all agents are stepped in one piece wherever they have taken equally many steps,
    which is faster. Where agents stop at a KL divergence of their own that would tie how one is
    rounded to when the others stop.
    """

    def __init__(
        self,
        networks: list[nn.Module],
        optimizers: list[torch.optim.Adam],
        together: bool = True,
    ) -> None:
        super().__init__(networks)
        self.optimizers = optimizers
        self.together = together
        self.moments = {key: torch.zeros_like(self.rows) for key in ("exp_avg", "exp_avg_sq")}
        self.steps = np.zeros(len(networks))
        self.learns = np.zeros(len(networks), bool)
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

        in_one = self.together and learns.all() and len(set(self.steps)) == 1
        pieces = [slice(None)] if in_one else [slice(i, i + 1) for i in np.flatnonzero(learns)]
        rows = [self.rows[i] for i in pieces]
        group = self.optimizers[0].param_groups[0]
        settings = {name: group[name] for name in ("lr", "betas", "eps")}
        self.optimizer = torch.optim.Adam(rows or [torch.zeros(0)], fused=True, **settings)
        for i, row in zip(pieces, rows, strict=True):
            row.grad = self.grads[i]
            step = torch.tensor(self.steps[i][0], dtype=torch.float32)
            moments = {key: x[i] for key, x in self.moments.items()}
            self.optimizer.state[row] = {"step": step, **moments}

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


# --- rollouts and steps ---------------------------------------------------------------------------


@torch.no_grad()
def rollout(
    args: PopulationArgs, learners: list[Any], envs: VectorEnv, next_obs: np.ndarray
) -> list[Any]:
    """Step the environments of all agents; what each saw, as the single file's rollout gives it."""
    space = envs.single_action_space
    agents = (args.num_agents, args.num_envs)
    shape = (args.num_steps, envs.num_envs)
    obs = np.empty((*shape, next_obs.shape[-1]), np.float32)
    after = np.empty_like(obs)
    clean_obs = np.empty_like(obs)  # condwrap
    rewards = np.empty(shape, np.float32)
    ends = np.empty(shape, np.float32)
    dones = np.empty(shape, np.float32)
    returns: list[list[float]] = [[] for _ in learners]
    lengths: list[list[int]] = [[] for _ in learners]

    # a_t = mean(s_t) + std · noise_t, the noise of all steps drawn at once: [T, N, E, action_dim]
    log_stds, *actor = stack([learner.actor for learner in learners])
    size = (args.num_steps, args.num_envs, log_stds.shape[1])
    noise = [torch.randn(size, generator=learner.generators["action"]) for learner in learners]
    actions = torch.stack(noise, 1) * log_stds.exp()[:, None]

    for t in range(args.num_steps):
        obs[t] = next_obs
        clean_obs[t] = envs.clean_obs if args.perturb_obs else next_obs  # condwrap
        states = torch.from_numpy(obs[t]).view(*agents, -1)
        actions[t] += forward(actor, states, args.activation)[-1]

        # the environment executes the action clipped to its space
        action = actions[t].numpy().reshape(-1, *space.shape).clip(space.low, space.high)
        next_obs, rewards[t], ends[t], cuts, info = envs.step(action)
        dones[t] = np.maximum(ends[t], cuts)

        # what the step led to is the last observation of the episode, not the first of the next
        after[t] = next_obs
        for i in np.flatnonzero(dones[t]):
            after[t, i] = info["final_obs"][i]
            returns[i // args.num_envs].append(info["episode"]["r"][i].item())
            lengths[i // args.num_envs].append(info["episode"]["l"][i].item())

    def by_agent(x: np.ndarray) -> Tensor:  # [T, N · E, ...] to [T, N, E, ...]
        return torch.from_numpy(x).unflatten(1, agents)

    values = value(args, learners, by_agent(obs))
    next_values = value(args, learners, by_agent(after)).masked_fill(by_agent(ends) == 1, 0)
    columns = {
        "obs": by_agent(obs),
        "after": by_agent(after),
        "actions": actions,
        "rewards": by_agent(rewards),
        "dones": by_agent(dones),
        "values": values,
        "next_values": next_values,
    }
    return [
        args.single.Rollout(
            **{name: x[:, i] for name, x in columns.items()},
            next_obs=next_obs.reshape(*agents, -1)[i],
            returns=returns[i],
            lengths=lengths[i],
            clean_obs=by_agent(clean_obs)[:, i].flatten(0, 1),  # condwrap
        )
        for i in range(args.num_agents)
    ]


def value(args: PopulationArgs, learners: list[Any], obs: Tensor) -> Tensor:
    """What each agent's critic says of its observations: `[T, N, E, n]` to `[T, N, E]`."""
    critic = stack([learner.critic for learner in learners])
    values = forward(critic, flatten_steps(obs), args.activation)[-1]  # [N, T · E, 1]
    return values.view(args.num_agents, args.num_steps, args.num_envs).transpose(0, 1)


def flatten_steps(x: Tensor) -> Tensor:
    """`[T, N, E, ...]` to `[N, T · E, ...]`, each agent's steps in the single file's order."""
    return x.transpose(0, 1).flatten(1, 2).contiguous()


def flatten(args: PopulationArgs, rollouts: list[Any]) -> tuple[Tensor, ...]:
    """Observations, actions, advantages and the critics' targets, `[N, B, ...]`.

    And the critics' explained variance, `[N]`.
    """
    fields = ("obs", "actions", "rewards", "dones", "values", "next_values")
    columns = {name: torch.stack([getattr(x, name) for x in rollouts], 1) for name in fields}
    data = rollouts[0]._replace(**columns)  # [T, N, E, ...]

    advantages = flatten_steps(args.single.gae(data, args.gamma, args.gae_lambda))
    values = flatten_steps(data.values)
    targets = advantages + values
    explained = 1 - (targets - values).var(1) / targets.var(1)
    return flatten_steps(data.obs), flatten_steps(data.actions), advantages, targets, explained


def shuffled(args: PopulationArgs, learners: list[Any]) -> Tensor:
    """An epoch's rows of the flattened batch, each agent's in an order of its own: `[M, N, b]`."""
    size = args.batch_size
    orders = [torch.randperm(size, generator=x.generators["minibatch"]) for x in learners]
    rows = torch.stack(orders) + size * torch.arange(args.num_agents)[:, None]
    return rows.view(args.num_agents, args.num_minibatches, -1).transpose(0, 1)


def log_prob(means: Tensor, log_std: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probabilities of a Gaussian, `[N, B]`; and the actions in standard deviations."""
    scaled = (actions - means) * (-log_std).exp()[:, None]
    constant = log_std.sum(-1, keepdim=True) + 0.5 * math.log(2 * math.pi) * log_std.shape[-1]
    return -0.5 * scaled.square().sum(-1) - constant, scaled


def value_step(args: PopulationArgs, critic: AdamStack, obs: Tensor, targets: Tensor) -> Tensor:
    """One step of each critic; its squared error before it, `[N]`."""
    *inputs, values = forward(critic.leaves, obs, args.activation)
    errors = values - targets[..., None]

    # c2 · L_VF = c2 · E[(V - target)²], whose slope in V is 2 · c2 · (V - target) / B
    grad = (2 * args.vf_coef / errors.shape[1]) * errors
    backward(critic, inputs, grad, args.activation)
    critic.step(args.max_grad_norm)
    return errors.square().mean((1, 2))


def draw_delta(learners: list[Any], obs: Tensor, learns: np.ndarray) -> Tensor:  # condwrap
    """What the learning agents' regularizers draw for the observations, `[N, B, n]`."""  # condwrap
    delta = torch.ones_like(obs)  # condwrap: that of the others does not matter
    for i in np.flatnonzero(learns):  # condwrap
        delta[i] = learners[i].regularizer.sample_delta(obs[i])  # condwrap
    return delta  # condwrap


def penalty_slope(args: Any, output: Tensor, delta: Tensor) -> Tensor:  # condwrap
    """Slope of c1 · mean(psi) in pi(S); in pi(S + delta) it is the opposite."""  # condwrap
    # J = ‖pi(S) - pi(S + delta)‖ / ‖delta‖, for each state or for an agent's whole batch
    moved = torch.sub(*output.split(delta.shape[1], 1))  # condwrap: pi(S) - pi(S + delta)
    axes = 2 if args.reduction == "sample" else (1, 2)  # condwrap
    change = torch.linalg.vector_norm(moved, dim=axes, keepdim=True)  # condwrap
    length = torch.linalg.vector_norm(delta, dim=axes, keepdim=True)  # condwrap
    quotient = change / length  # condwrap

    # psi = excess², and dJ / d pi(S) = (pi(S) - pi(S + delta)) / (change · length)
    excess = quotient - quotient.clamp(args.lambda_min, args.lambda_max)  # condwrap
    factor = 2 * args.coefficient * (-1 if args.printed_sign else 1) / excess.shape[1]  # condwrap
    return (factor * excess / (change * length)).masked_fill(change == 0, 0) * moved  # condwrap


# --- agents that diverge --------------------------------------------------------------------------


def is_frozen(learner: Any) -> bool:
    """Whether the agent has diverged and is trained no more."""
    return getattr(learner, "frozen", False)


def has_diverged(run: Any) -> bool:
    """Whether an earlier part of the run says so."""
    return run.resume and (run.path / "diverged.json").exists()


def freeze_diverged(
    args: PopulationArgs, learners: list[Any], envs: VectorEnv, numbers: list[dict[str, Tensor]]
) -> None:
    """Name and freeze the agents whose numbers are not finite. DivergedError if all are frozen."""
    for i, (run, learner) in enumerate(zip(args.runs, learners, strict=True)):
        if is_frozen(learner):
            continue
        try:
            args.single.check_finite(run, learner.update, **numbers[i])
        except args.single.DivergedError as error:
            print(f"agent {run.agent} is frozen, the others go on: {error}")
            learner.frozen = True
            envs.unwrapped.freeze(i)

    blank_frozen(args, learners)


def blank_frozen(args: PopulationArgs, learners: list[Any]) -> None:
    """Put zeros in the place of the agents that are frozen."""
    live = [learner for learner in learners if not is_frozen(learner)]
    if not live:
        raise args.single.DivergedError("every agent has diverged")
    for learner in learners:
        if is_frozen(learner):
            blank(learner, like=live[0])


def blank(learner: Any, like: Any) -> None:
    """Weights and moments of 0, statistics of mean 0 and variance 1; counters as a live agent's."""
    learner.update = like.update
    for p in [*learner.actor.parameters(), *learner.critic.parameters()]:
        p.data.zero_()

    for name, part in learner.parts.items():
        if isinstance(part, torch.optim.Optimizer):
            part.load_state_dict(copy.deepcopy(like.parts[name].state_dict()))
            for state in part.state.values():
                state["exp_avg"].zero_()
                state["exp_avg_sq"].zero_()

    for rms in learner.stats.values():
        vars(rms).update(vars(RunningMeanStd(shape=rms.mean.shape)))


def without_frozen(learners: list[Any], rollouts: list[Any]) -> list[Any]:
    """The rollouts, with zeros and no episode in the place of those of frozen agents."""
    pairs = zip(learners, rollouts, strict=True)
    return [blank_rollout(data) if is_frozen(learner) else data for learner, data in pairs]


def blank_rollout(data: Any) -> Any:
    tensors = {name: x for name, x in data._asdict().items() if isinstance(x, Tensor)}
    zeros = {name: torch.zeros_like(x) for name, x in tensors.items()}
    next_obs = np.zeros_like(data.next_obs)
    return data._replace(**zeros, next_obs=next_obs, returns=[], lengths=[])


# --- training -------------------------------------------------------------------------------------


def load_checkpoints(args: PopulationArgs) -> list[dict[str, Any] | None]:
    """Each agent's newest checkpoint, or that of an update which all have: a kill may part them.

    None for an agent that has none yet, or has diverged.
    """
    single = args.single
    saved = [None if has_diverged(run) else single.load_checkpoint(run) for run in args.runs]
    live = [i for i, run in enumerate(args.runs) if not has_diverged(run)]
    updates = {i: saved[i]["learner"]["update"] if saved[i] else 0 for i in live}
    least = min(updates.values(), default=0)
    ahead = [i for i in live if updates[i] > least]

    begun = all((args.runs[i].path / "metrics.csv").exists() for i in live)  # none is a newcomer
    for i in ahead:
        if previous_update(args.runs[i]) != least or not begun:
            steps = ", ".join(f"{updates[i]} (agent {args.runs[i].agent})" for i in live)
            how = f"resume each by {args.single_file}"
            raise single.RunError(f"the agents are at updates {steps}: {how}")

    for i in ahead:
        path = args.runs[i].path / "checkpoint.pt"
        if least:
            path.with_suffix(".previous.pt").replace(path)
        else:
            path.unlink()
        saved[i] = single.load_checkpoint(args.runs[i])
    return saved


def previous_update(run: Any) -> int:
    """The update of the checkpoint before the newest, 0 without one."""
    path = run.path / "checkpoint.previous.pt"
    return torch.load(path, weights_only=True)["learner"]["update"] if path.exists() else 0


def make_learners(args: PopulationArgs, saved: list[dict[str, Any] | None]) -> list[Any]:
    """The agents as they were saved, or at their beginning."""
    learners = []
    for run, state in zip(args.runs, saved, strict=True):
        learner = args.single.Learner(run)
        learner.frozen = has_diverged(run)
        if state:
            learner.load_state_dict(state["learner"])
        learners.append(learner)

    blank_frozen(args, learners)
    return learners


def iterate(
    args: PopulationArgs,
    learners: list[Any],
    envs: VectorEnv,
    next_obs: np.ndarray,
    update: Callable[..., Any],
) -> tuple[list[Any], list[dict[str, float]]]:
    """A rollout and an update of every agent, those that diverge frozen; rollouts and losses."""
    rollouts = rollout(args, learners, envs, next_obs)
    for learner in learners:
        learner.update += 1
    seen = [{"observation": data.obs, "reward": data.rewards} for data in rollouts]
    freeze_diverged(args, learners, envs, seen)

    rollouts = without_frozen(learners, rollouts)
    losses = update(args, learners, rollouts)
    freeze_diverged(args, learners, envs, [{"loss": x.weights} for x in learners])
    return without_frozen(learners, rollouts), losses


def train(args: PopulationArgs, update: Callable[..., Any]) -> list[Any]:
    """Train, or continue to train, every agent until `total_timesteps`."""
    single = args.single
    runs = args.runs
    saved = load_checkpoints(args)
    learners = make_learners(args, saved)
    if learners[0].update >= args.num_updates:
        print(f"{', '.join(str(run.path) for run in runs)}: finished")
        return learners

    live = [i for i, learner in enumerate(learners) if not is_frozen(learner)]
    writers = {i: single.open_logs(runs[i], saved[i]) for i in live}
    steps = 0
    started = time.monotonic()
    printed = -math.inf
    while learners[0].update < args.num_updates:  # from one checkpoint to the next
        checkpoint = learners[0].update // args.checkpoint_interval
        envs: VectorEnv = Environments(args, learners)
        envs = args.perturb(envs)  # condwrap
        seeds = [seed for run in runs for seed in single.env_seeds(run, checkpoint)]
        next_obs, _ = envs.reset(seed=seeds)

        for _ in range(min(args.checkpoint_interval, args.num_updates - learners[0].update)):
            rollouts, losses = iterate(args, learners, envs, next_obs, update)
            next_obs = np.concatenate([data.next_obs for data in rollouts])

            now = time.monotonic()
            live = [i for i in live if not is_frozen(learners[i])]
            steps += args.batch_size * len(live)
            speed = steps / (now - started)
            rows = []
            for i in live:
                numbers = {"charts/SPS": speed, **losses[i]}
                row = single.log_update(runs[i], learners[i], writers[i], rollouts[i], numbers)
                rows.append(row)
            if now - printed > 10 or learners[0].update == args.num_updates:
                printed = now
                print_progress(args, learners[0].update, rows)

        envs.unwrapped.store()
        envs.close()
        for i in live:
            writers[i].flush()
            single.save_checkpoint(runs[i], learners[i])

    for writer in writers.values():
        writer.close()
    return learners


def print_progress(args: PopulationArgs, update: int, rows: list[dict[str, float]]) -> None:
    returns = np.array([row["charts/episodic_return"] for row in rows])
    mean = math.nan if np.isnan(returns).all() else np.nanmean(returns)
    print(f"update {update}/{args.num_updates}  {rows[0]['charts/SPS']:.0f} steps/s of "
          f"{len(rows)} agents  return {mean:.1f}")  # fmt: skip


def run(args_class: type, train: Callable[[Any], Any], description: str) -> None:
    """The program: train with the arguments of the command line."""
    torch.set_num_threads(1)  # more do not help networks this small
    sys.stdout.reconfigure(line_buffering=True)  # progress shows in a log file too
    for stop in (signal.SIGTERM, signal.SIGINT):  # a background job may begin with SIGINT ignored
        signal.signal(stop, signal.default_int_handler)

    single = args_class.single
    try:
        train(tyro.cli(args_class, description=description))
    except single.DivergedError as error:
        print(error)
        sys.exit(3)
    except (single.RunError, gym.error.Error, ModuleNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: --resume continues from the last checkpoint, if there is one yet")
