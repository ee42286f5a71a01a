"""PPO (Schulman et al., 2017, arXiv 1707.06347) on CoinRun and Procgen's other games, to copy.

    python ppo_reg_coinrun.py --network impala --seed 1

The lines marked as condwrap's add the conditioning penalty of Asadulaev et al. (arXiv 1906.05437).
`--coefficient 0` computes bit for bit what the file computes without them. They need condwrap
installed, and the file its extras `baselines` and `coinrun`.

The settings are those of Lee et al. (2020, arXiv 1910.05396). On a GPU add `--bf16 --compile`. A
run's directory holds metrics.csv (a row for each update), TensorBoard events and checkpoint.pt;
`--resume` continues a run, on the CPU as if it had never stopped.
"""

from __future__ import annotations

import csv
import ctypes
import dataclasses
import functools
import importlib.util
import json
import math
import os
import signal
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

from condwrap.settings import PenaltyArgs  # condwrap

try:
    from baselines import headless_qt
except ImportError:  # this file was copied alone, and needs the system's libGL and GLib
    headless_qt = None

VERSION = 2  # raised whenever the numbers of a run change
GAMES = ("bigfish", "bossfight", "caveflyer", "chaser", "climber", "coinrun", "dodgeball",
         "fruitbot", "heist", "jumper", "leaper", "maze", "miner", "ninja", "plunder",
         "starpilot")  # fmt: skip
ACTIONS = 15
MAY_CHANGE = {"run_dir", "resume", "extend", "track", "device", "num_threads"}  # when resumed


class RunError(Exception):
    """A run that cannot start, and what to do."""


class DivergedError(Exception):
    """Training produced NaN or infinity: a result (exit status 3), not a crash."""


@dataclasses.dataclass(frozen=True)
class Args(
    PenaltyArgs,  # condwrap
):
    env_id: str = "coinrun"  # or another of Procgen's 16 games
    seed: int = 1  # seed of the run
    agent: int = 0  # number of the agent, for several of one seed
    # EnvPool spends steps on resets: they count in total_timesteps, and not in global_step
    total_timesteps: int = 50_000_000  # steps to train for, rounded down to whole updates

    num_levels: int = 500  # levels to train on; 0: an unlimited set
    start_level: int = 0  # seed of the first of them
    distribution_mode: Literal["easy", "hard"] = "hard"  # how hard the levels are
    paint_vel_info: bool = True  # paint the velocity into the frame, as the original CoinRun does
    restrict_themes: bool = False  # show one theme each of player, ground, crates and enemies
    num_envs: int = 32  # environments; Lee et al. use 32 in each worker
    num_groups: int = 2  # groups of environments: the network acts for one while others step
    num_threads: int = 0  # CPU threads; 0: as many as PyTorch takes (OMP_NUM_THREADS, or all cores)

    num_steps: int = 256  # steps of each environment between two updates
    num_minibatches: int = 8  # minibatches in an epoch
    update_epochs: int = 3  # passes over the rollout
    learning_rate: float = 5e-4  # Adam's step size
    anneal: bool = True  # let the step size and clip_coef fall linearly to 0
    anneal_timesteps: int = 0  # steps to reach 0 in: 256,000,000 in Lee et al.; 0: the run's length
    gamma: float = 0.999  # discount
    gae_lambda: float = 0.95  # lambda of generalized advantage estimation
    clip_coef: float = 0.2  # PPO's epsilon: how far the probability ratio may move from 1
    ent_coef: float = 0.01  # c3, of the entropy bonus
    vf_coef: float = 0.5  # c2, of half the critic's squared error
    max_grad_norm: float = 0.5  # length that the gradient is clipped to

    network: Literal["nature", "impala", "impala_large"] = "nature"  # Mnih et al.'s or Espeholt's
    l2: float = 0.0  # factor of half the squared weights, without biases; Lee et al. take 1e-4
    # Dropped features are the same in a whole batch. Lee et al. drop 0.1 of them after each
    # convolution of IMPALA, and none of NatureCNN, which here drops those of its last layer.
    dropout: float = 0.0  # share of features left out, as in Lee et al.'s code
    eval_dropout: bool = False  # leave out those of the last update in evaluation too, as they do
    probe_fraction: float = 0.125  # condwrap
    """share of each rollout that psi and J are logged from"""  # condwrap
    eval_interval: int = 100  # updates between evaluations on training and unseen levels; 0: never
    eval_envs: int = 64  # episodes of each evaluation, one in each environment

    device: str = "auto"  # cpu, cuda or cuda:1; auto: a GPU if there is one
    bf16: bool = False  # compute in bfloat16, except for the penalty
    compile: bool = False  # compile acting, into CUDA graphs on a GPU, and the loss
    run_dir: Path | None = None  # default: runs/<game>__<this file>__s<seed>__a<agent>
    resume: bool = False  # continue from the run directory's checkpoint, if it has one
    extend: bool = False  # let a resumed run train for more timesteps than it was begun with
    checkpoint_interval: int = 50  # updates between two checkpoints; each rebuilds the environments
    track: bool = False  # log to Weights & Biases too (needs wandb; WANDB_PROJECT: the project)

    def __post_init__(self) -> None:
        self.require("env_id", self.env_id in GAMES, f"be one of {', '.join(GAMES)}")
        modes = ("easy", "hard")
        self.require("distribution_mode", self.distribution_mode in modes, "be easy or hard")

        counts = ("num_envs", "num_groups", "num_steps", "num_minibatches", "update_epochs")
        for name in (*counts, "eval_envs", "checkpoint_interval"):
            self.require(name, getattr(self, name) >= 1, "be at least 1")
        from_0 = ("seed", "agent", "num_levels", "start_level", "num_threads", "eval_interval")
        for name in (*from_0, "anneal_timesteps", "l2", "ent_coef", "vf_coef"):
            self.require(name, 0 <= getattr(self, name) < math.inf, "be at least 0")

        for name in ("learning_rate", "clip_coef", "max_grad_norm"):
            self.require(name, 0 < getattr(self, name) < math.inf, "be finite and above 0")
        for name in ("gamma", "gae_lambda"):
            self.require(name, 0 <= getattr(self, name) <= 1, "be in [0, 1]")
        self.require("dropout", 0 <= self.dropout < 1, "be in [0, 1)")

        whole = self.num_envs % self.num_groups == 0
        self.require("num_groups", whole, f"divide num_envs = {self.num_envs}")
        batch = f"num_envs * num_steps = {self.batch_size}"
        size, rest = divmod(self.batch_size, self.num_minibatches)
        parts = f"divide {batch} into parts of 2 or more"
        self.require("num_minibatches", size > 1 and not rest, parts)
        self.require("total_timesteps", self.num_updates >= 1, f"be at least {batch}")

        too_short = 0 < self.anneal_timesteps < self.total_timesteps
        needed = f"be 0 or at least total_timesteps = {self.total_timesteps}"
        self.require("anneal_timesteps", not too_short, needed)

        anneals_to_its_end = self.anneal and not self.anneal_timesteps
        needed = "be False, since a run that anneals over its own length depends on it"
        self.require("extend", not (self.extend and anneals_to_its_end), needed)
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


@functools.cache
def load_qt() -> None:
    """EnvPool's Procgen needs Qt 5's libraries: the system's, or those in the wheel PyQt5-Qt5."""
    gui = "libQt5Gui.so.5"  # it loads libQt5Core.so.5
    wheel = importlib.util.find_spec("PyQt5")
    places = wheel.submodule_search_locations if wheel else []
    in_wheel = [f"{place}/Qt5/lib/{gui}" for place in places]

    load = functools.partial(ctypes.CDLL, mode=ctypes.RTLD_GLOBAL)
    attempts = [(load, path) for path in [gui, *in_wheel]]
    if headless_qt is not None:
        attempts += [(headless_qt.load_headless_qt, path) for path in in_wheel]

    failures = []
    for attempt, path in attempts:
        try:
            attempt(path)
            break
        except OSError as error:
            failures.append(str(error))
    else:
        raise RunError(
            "EnvPool needs Qt 5: pip install PyQt5-Qt5, which needs the system's libGL.so.1 and "
            f"libgthread-2.0.so.0 (Debian: libgl1, libglib2.0-0). {'; '.join(failures)}"
        )

    if getattr(sys.modules.get("envpool.procgen"), "_PROCGEN_IMPORT_ERROR", None):
        del sys.modules["envpool.procgen"]  # it was imported before Qt was there, and gave up


def import_envpool() -> ModuleType:
    load_qt()
    try:
        import envpool
    except ImportError as error:
        raise RunError(f"CoinRun needs EnvPool: pip install envpool ({error})") from None
    return envpool


class Procgen(VectorEnv):
    """A game of Procgen in EnvPool: frames `[N, 3, 64, 64]`, uint8, and 15 actions.

    When episodes end, `info` holds their return and length (`episode`), `success` and `level_seed`,
    and `_episode` says which they are. EnvPool spends a step on beginning the next episode, and
    ignores its action: `info["reset"]` says where. A level is determined by its seed and the
    actions. `options` are EnvPool's own.
    """

    def __init__(self, game: str, mode: str, num_envs: int, **options: Any) -> None:
        self.task = f"{game.capitalize()}{mode.capitalize()}-v0"
        self.num_envs = num_envs
        self.options = options
        self.pool: Any = None

        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        batch_space = functools.partial(gym.vector.utils.batch_space, n=num_envs)
        self.single_observation_space = gym.spaces.Box(0, 255, (3, 64, 64), np.uint8)
        self.single_action_space = gym.spaces.Discrete(ACTIONS)
        self.observation_space = batch_space(self.single_observation_space)
        self.action_space = batch_space(self.single_action_space)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        """Build the pool again, which takes about 20 ms: it cannot return to a seed otherwise."""
        super().reset(seed=seed)
        self.close_extras()
        own = {"num_envs": self.num_envs, "seed": int(self.np_random.integers(2**31))}
        self.pool = import_envpool().make(self.task, env_type="gymnasium", **own, **self.options)

        self.ended = np.zeros(self.num_envs, bool)
        self.returns = np.zeros(self.num_envs)
        self.lengths = np.zeros(self.num_envs, np.int64)
        return self.pool.reset()[0], {}

    def step(self, actions: np.ndarray) -> tuple:
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: np.ndarray) -> None:
        """Let the simulators step while the caller does something else, until `step_wait`."""
        if self.pool is None:
            raise gym.error.ResetNeeded("reset the environments before stepping them")
        self.pool.send(np.asarray(actions, np.int32))

    def step_wait(self) -> tuple:
        frames, rewards, terminations, truncations, said = self.pool.recv()
        reset = self.ended
        self.returns = np.where(reset, 0, self.returns) + rewards
        self.lengths = np.where(reset, 0, self.lengths + 1)
        self.ended = terminations | truncations

        info: dict[str, Any] = {"reset": reset}
        if self.ended.any():
            info["episode"] = {"r": self.returns, "l": self.lengths}
            info["_episode"] = self.ended
            info["success"] = said["prev_level_complete"] != 0
            info["level_seed"] = said["level_seed"]
        return frames, rewards, terminations, truncations, info

    def close_extras(self, **kwargs: Any) -> None:
        if self.pool is not None:
            self.pool.close()
        self.pool = None


def make_env(args: Args, num_envs: int, start_level: int) -> Procgen:
    return Procgen(
        args.env_id,
        args.distribution_mode,
        num_envs,
        num_levels=args.num_levels,
        start_level=start_level,
        paint_vel_info=args.paint_vel_info,
        restrict_themes=args.restrict_themes,
        num_threads=min(args.num_threads or torch.get_num_threads(), num_envs),
    )


def env_seeds(args: Args, checkpoint: int) -> list[int]:
    sequence = np.random.SeedSequence((args.seed, args.agent, checkpoint))
    return sequence.generate_state(args.num_envs).tolist()


def make_envs(args: Args, checkpoint: int) -> tuple[list[Procgen], list[np.ndarray]]:
    """The groups of environments until the next checkpoint, and their first frames.

    The state of a simulator cannot be saved. So every run builds new environments at each scheduled
    checkpoint, and an interrupted run sees the same episodes as an undisturbed one.
    """
    size = args.num_envs // args.num_groups
    envs = [make_env(args, size, args.start_level) for _ in range(args.num_groups)]
    seeds = env_seeds(args, checkpoint)
    frames = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=False)]
    return envs, frames


# --- agent ----------------------------------------------------------------------------------------


class Dropout(nn.Module):
    """Leaves the same features out of every state, until `draw` chooses others."""

    def __init__(self, args: Args, *shape: int) -> None:
        super().__init__()
        self.rate = args.dropout
        self.in_evaluation = args.eval_dropout
        self.register_buffer("mask", torch.ones(1, *shape) if args.dropout else None)

    def draw(self, rng: torch.Generator) -> None:
        uniform = torch.rand(self.mask.shape, generator=rng)
        self.mask.copy_((uniform >= self.rate) / (1 - self.rate))

    def forward(self, x: Tensor) -> Tensor:
        acts = self.mask is not None and (self.training or self.in_evaluation)
        return x * self.mask if acts else x


# layers whose weights are left to `Agent` to draw
Conv = functools.partial(nn.utils.skip_init, nn.Conv2d)
Linear = functools.partial(nn.utils.skip_init, nn.Linear)


class Residual(nn.Module):
    """x + conv(relu(conv(relu(x))))."""

    def __init__(self, args: Args, channels: int, side: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.ReLU(),
            Conv(channels, channels, 3, padding=1),
            Dropout(args, channels, side, side),
            nn.ReLU(),
            Conv(channels, channels, 3, padding=1),
            Dropout(args, channels, side, side),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


def nature(args: Args) -> nn.Sequential:
    """Mnih et al., 2015: three convolutions, 512 features."""
    return nn.Sequential(
        Conv(3, 32, 8, stride=4),
        nn.ReLU(),
        Conv(32, 64, 4, stride=2),
        nn.ReLU(),
        Conv(64, 64, 3),
        nn.ReLU(),
        nn.Flatten(),
        Linear(1024, 512),
        nn.ReLU(),
        Dropout(args, 512),
    )


def impala(args: Args, channels: tuple[int, ...] = (16, 32, 32)) -> nn.Sequential:
    """Espeholt et al., 2018: in each section a convolution, a pooling and two residual blocks."""
    layers: list[nn.Module] = []
    side = 64
    for n_in, n_out in zip((3, *channels), channels, strict=False):
        layers += [Conv(n_in, n_out, 3, padding=1), Dropout(args, n_out, side, side)]
        layers += [nn.MaxPool2d(3, 2, 1)]
        side //= 2
        layers += [Residual(args, n_out, side), Residual(args, n_out, side)]

    features = channels[-1] * side**2
    return nn.Sequential(*layers, nn.ReLU(), nn.Flatten(), Linear(features, 256), nn.ReLU())


NETWORKS = {
    "nature": nature,
    "impala": impala,
    "impala_large": functools.partial(impala, channels=(32, 64, 64, 64, 64)),
}


class Agent(nn.Module):
    """Log-probabilities of the actions and a value, from one network; it divides frames by 255."""

    def __init__(self, args: Args, rng: torch.Generator) -> None:
        super().__init__()
        self.network = NETWORKS[args.network](args)
        features = 512 if args.network == "nature" else 256
        self.policy = Linear(features, ACTIONS)
        self.value = Linear(features, 1)

        # a policy that begins nearly uniform, and residual blocks that begin as the identity: the
        # signal would grow with each of them
        gains = {self.policy: 0.01, self.value: 1.0}
        gains.update({m.body[4]: 0.0 for m in self.modules() if isinstance(m, Residual)})
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.orthogonal_(layer.weight, gains.get(layer, math.sqrt(2)), rng)
                nn.init.zeros_(layer.bias)

    @property
    def device(self) -> torch.device:
        return self.value.weight.device

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        x = frames / 255.0
        if x.is_cuda:
            x = x.contiguous(memory_format=torch.channels_last)
        hidden = self.network(x)
        logprobs = self.policy(hidden).float().log_softmax(-1)  # [B, 15]
        return logprobs, self.value(hidden).float().squeeze(-1)  # [B]

    def logprobs(self, frames: Tensor) -> Tensor:
        return self(frames)[0]


def find_device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise RunError(f"device {name} cannot be used: {str(error).splitlines()[0]}") from None


class Learner:
    """All that changes while training, and so all that a checkpoint holds."""

    def __init__(self, args: Args) -> None:
        self.device = find_device(args.device)
        on_gpu = self.device.type == "cuda"

        # each use of randomness has its own stream
        names = ("init", "action", "minibatch", "dropout", "eval", "penalty", "probe")
        streams = np.random.SeedSequence((args.seed, args.agent)).spawn(len(names))
        numbers = [int(stream.generate_state(1, np.uint64)[0]) for stream in streams]
        seeds = dict(zip(names, numbers, strict=True))
        self.generators = {x: torch.Generator().manual_seed(seeds[x]) for x in names[:5]}

        self.agent = Agent(args, self.generators["init"]).to(self.device)
        if on_gpu:
            self.agent.to(memory_format=torch.channels_last)  # on the CPU it is no faster
        self.optimizer = torch.optim.Adam(
            self.agent.parameters(), args.learning_rate, eps=1e-5, fused=True
        )
        self.regularizer = args.make_regularizer(seeds["penalty"], self.device)  # condwrap
        self.probe = args.make_probe(seeds["probe"], self.device)  # condwrap
        self.update = 0
        self.global_step = 0

        self.sample = sample
        self.total_loss = total_loss
        if args.bf16:
            self.sample = torch.autocast(self.device.type, torch.bfloat16)(sample)
        if args.compile:
            self.sample = torch.compile(self.sample, mode="reduce-overhead")
            self.total_loss = torch.compile(total_loss)

        # a GPU reads a group's frames from pinned memory
        shape = (args.num_groups, args.num_envs // args.num_groups, 3, 64, 64)
        self.staging = torch.empty(shape, dtype=torch.uint8, pin_memory=True) if on_gpu else None
        self.uploading = 0.0  # seconds of the last rollout

    def upload(self, frames: np.ndarray, to: Tensor, group: int) -> None:
        """One copy on the CPU, by NumPy: PyTorch's would wake threads that the simulators need."""
        started = time.perf_counter()
        if self.staging is None:
            np.copyto(to.numpy(), frames)
        else:
            np.copyto(self.staging[group].numpy(), frames)
            to.copy_(self.staging[group], non_blocking=True)
        self.uploading += time.perf_counter() - started

    def draw_masks(self) -> None:
        """Dropout's, for a rollout and its update, so that PPO's ratios begin at 1."""
        for layer in self.agent.modules():
            if isinstance(layer, Dropout) and layer.mask is not None:
                layer.draw(self.generators["dropout"])

    @property
    def weights(self) -> Tensor:
        return torch.cat([x.detach().flatten() for x in self.agent.parameters()])

    @property
    def parts(self) -> dict[str, Any]:
        """What saves and restores its own state: networks, optimizers and the like."""
        return {name: x for name, x in vars(self).items() if hasattr(x, "load_state_dict")}

    def state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = {name: part.state_dict() for name, part in self.parts.items()}
        state["generators"] = {name: x.get_state() for name, x in self.generators.items()}
        state["update"] = self.update
        state["global_step"] = self.global_step
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in self.parts.items():
            part.load_state_dict(state[name])
        for weights, moments in self.optimizer.state.items():  # fused Adam pairs them in memory
            for key in ("exp_avg", "exp_avg_sq"):  # order, which differs between CPU and GPU
                moments[key] = torch.empty_like(weights).copy_(moments[key])
        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name])
        self.update = state["update"]
        self.global_step = state["global_step"]


# --- PPO ------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """T steps of N environments, and what they led to; frames are on the network's device."""

    obs: Tensor  # [T, N, 3, 64, 64], uint8
    actions: Tensor  # [T, N]
    logprobs: Tensor  # [T, N]
    rewards: Tensor  # [T, N]
    dones: Tensor  # [T, N], 1 where an episode ended
    values: Tensor  # [T, N]
    next_values: Tensor  # [T, N], V of what the step led to: 0 at an end
    counts: Tensor  # [T, N], False where the step ignored the action and began an episode
    returns: list[float]  # of the episodes that ended
    lengths: list[int]
    successes: list[bool]

    @property
    def states(self) -> Tensor:
        """The frames of the steps that count, `[K, 3, 64, 64]`."""
        return self.obs[self.counts]


def sample(agent: Agent, frames: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """An action for each state, its log-probability, and the state's value."""
    logprobs, values = agent(frames)

    # argmax(log p - log e), with e from the standard exponential distribution, is distributed as p
    actions = (logprobs - noise.log()).argmax(-1)
    return actions, logprobs.gather(-1, actions[:, None])[:, 0], values


@torch.no_grad()
def rollout(args: Args, learner: Learner, envs: list[Procgen], frames: list[np.ndarray]) -> Rollout:
    """Step the groups in turn: the network acts for one while the simulators step the others.

    `frames` holds each group's last frames, and is left holding those that follow. Time limits
    count as ends, as they do in the original engine, which does not tell them apart.
    """
    agent = learner.agent
    device = learner.device
    shape = (args.num_steps, args.num_envs)
    obs = torch.empty((*shape, 3, 64, 64), dtype=torch.uint8, device=device)
    actions = torch.empty(shape, dtype=torch.int64, device=device)
    logprobs = torch.empty(shape, device=device)
    values = torch.empty(shape, device=device)
    rewards = np.empty(shape, np.float32)
    dones = np.empty(shape, np.float32)
    counts = np.empty(shape, bool)
    returns: list[float] = []
    lengths: list[int] = []
    successes: list[bool] = []

    noise = torch.empty((*shape, ACTIONS)).exponential_(generator=learner.generators["action"])
    noise = noise.to(device)
    size = args.num_envs // args.num_groups
    groups = [slice(g * size, (g + 1) * size) for g in range(args.num_groups)]
    learner.uploading = 0.0

    for t in range(args.num_steps + 1):
        for g, group in enumerate(groups):
            # what the group's last actions led to
            if t > 0:
                frames[g], rewards[t - 1, group], ends, cuts, info = envs[g].step_wait()
                dones[t - 1, group] = ends | cuts
                counts[t - 1, group] = ~info["reset"]
                if "episode" in info:
                    over = info["_episode"]
                    returns += info["episode"]["r"][over].tolist()
                    lengths += info["episode"]["l"][over].tolist()
                    successes += info["success"][over].tolist()

            # its next actions; fetching them is the one wait for the device
            if t < args.num_steps:
                learner.upload(frames[g], obs[t, group], g)
                acted = learner.sample(agent, obs[t, group], noise[t, group])
                actions[t, group], logprobs[t, group], values[t, group] = acted
                envs[g].step_async(actions[t, group].cpu().numpy())

    # V(s_{t+1}) is the next step's V(s_t), and the last one's that of the frames that follow
    last = torch.cat([agent(torch.tensor(x, device=device))[1] for x in frames])
    next_values = torch.cat([values[1:], last[None]]).cpu()
    return Rollout(
        obs=obs,
        actions=actions,
        logprobs=logprobs,
        rewards=torch.from_numpy(rewards),
        dones=torch.from_numpy(dones),
        values=values.cpu(),
        next_values=next_values * (1 - torch.from_numpy(dones)),
        counts=torch.from_numpy(counts),
        returns=returns,
        lengths=lengths,
        successes=successes,
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


def total_loss(
    args: Args,
    learner: Learner,
    clip_coef: Tensor,
    obs: Tensor,
    actions: Tensor,
    old_logprobs: Tensor,
    advantages: Tensor,
    targets: Tensor,
    delta: Tensor | None = None,  # condwrap
) -> tuple[Tensor, Tensor]:
    """Equation (3) on a minibatch, and what is logged of it."""
    agent = learner.agent
    with torch.autocast(learner.device.type, torch.bfloat16, enabled=args.bf16):
        logprobs, values = agent(obs)
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

    # L_CLIP = E[min(ratio · A, clip(ratio, 1 - epsilon, 1 + epsilon) · A)]
    logratio = logprobs.gather(-1, actions[:, None])[:, 0] - old_logprobs
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    pg_loss = -torch.min(advantages * ratio, advantages * clipped).mean()

    # entropy = -E[sum of p · log p over the actions], L_VF = E[(V(s_t) - target_t)²] / 2
    entropy = -(logprobs.exp() * logprobs).sum(-1).mean()
    value_loss = 0.5 * (values - targets).square().mean()

    # -L_CLIP + c2 · L_VF - c3 · entropy + l2 · ‖weights‖² / 2 + c1 · mean(psi)
    loss = pg_loss + args.vf_coef * value_loss - args.ent_coef * entropy
    if args.l2:
        weights = [w for w in agent.parameters() if w.ndim > 1]
        loss = loss + args.l2 * 0.5 * sum(w.square().sum() for w in weights)
    if delta is not None:  # condwrap
        known = None if args.bf16 else logprobs  # condwrap: rounding would pass for sensitivity
        measured = learner.regularizer(agent.logprobs, obs, delta=delta, output=known)  # condwrap
        loss += measured.penalty  # condwrap

    # KL(old‖new) is estimated by E[ratio - 1 - log ratio]
    kl = (ratio - 1 - logratio).mean()
    clipfrac = (ratio != clipped).float().mean()
    return loss, torch.stack([pg_loss, entropy, kl, clipfrac, value_loss]).detach()


def step(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_grad_norm)
    optimizer.step()


def update(args: Args, learner: Learner, data: Rollout) -> dict[str, float]:
    """Epochs of minibatches over one rollout: equation (3) of the paper, minimized.

    The paper maximizes L_CLIP + c1·psi - c2·L_VF + c3·entropy, which would reward bad conditioning;
    its text says penalty. So -L_CLIP + c1·mean(psi) + c2·L_VF - c3·entropy is minimized here.
    """
    agent = learner.agent

    # step size and epsilon fall linearly to 0
    left = 1.0
    if args.anneal:
        done = (learner.update - 1) * args.batch_size
        left = 1 - done / (args.anneal_timesteps or args.num_updates * args.batch_size)
    learner.optimizer.param_groups[0]["lr"] = left * args.learning_rate
    clip_coef = torch.tensor(left * args.clip_coef, device=agent.device)

    # the K steps that count, [T, N, ...] to [K, ...]; the critic's targets are A_t + V(s_t)
    advantages = gae(data, args.gamma, args.gae_lambda)
    targets = advantages + data.values
    rows = (data.obs, data.actions, data.logprobs, advantages, targets)
    columns = [x[data.counts].to(agent.device) for x in rows]
    size = args.batch_size // args.num_minibatches

    def plain_loss() -> Tensor:  # condwrap
        return total_loss(args, learner, clip_coef, *[x[:size] for x in columns])[0]  # condwrap

    about = (agent.logprobs, columns[0], plain_loss, agent.parameters())  # condwrap
    share = learner.probe.gradient_share(learner.update, *about)  # condwrap

    logs: list[Tensor] = []
    for _ in range(args.update_epochs):
        # every step once, and a few twice, so that all minibatches have one shape
        order = torch.randperm(len(columns[0]), generator=learner.generators["minibatch"])
        order = order[torch.arange(args.batch_size) % len(order)]

        for i in order.split(size):
            batch = [x[i.to(agent.device)] for x in columns]
            if args.coefficient > 0:  # condwrap
                batch.append(learner.regularizer.sample_delta(batch[0]))  # condwrap
            loss, parts = learner.total_loss(args, learner, clip_coef, *batch)
            step(learner.optimizer, loss, args.max_grad_norm)
            logs.append(parts.clone())  # compiled code may use its memory again

    pg_loss, entropy, kl, clipfrac, value_loss = torch.stack(logs).mean(0).tolist()
    errors = (targets - data.values)[data.counts]
    variance = targets[data.counts].var()
    return {
        "charts/learning_rate": learner.optimizer.param_groups[0]["lr"],
        "losses/policy_loss": pg_loss,
        "losses/entropy": entropy,
        "losses/approx_kl": kl,
        "losses/clipfrac": clipfrac,
        "losses/value_loss": value_loss,
        "losses/explained_variance": (1 - errors.var() / variance).item(),
        **share,  # condwrap
    }


# --- evaluation -----------------------------------------------------------------------------------


@torch.no_grad()
def play(
    agent: Agent, env: Procgen, seed: int, rng: torch.Generator | None
) -> dict[str, np.ndarray]:
    """The first episode of each environment: success, return, length and level seed, each `[N]`.

    Not the first N episodes to end, of which short ones would be too many. Actions are sampled
    with `rng`, or the likeliest without it.
    """
    frames, _ = env.reset(seed=seed)
    found = {
        "success": np.zeros(env.num_envs, bool),
        "return": np.zeros(env.num_envs),
        "length": np.zeros(env.num_envs, np.int64),
        "level_seed": np.zeros(env.num_envs, np.int64),
    }
    running = np.ones(env.num_envs, bool)
    agent.eval()

    while running.any():
        logprobs = agent(torch.tensor(frames, device=agent.device))[0].cpu()
        if rng is not None:  # as in `sample`
            logprobs -= torch.empty_like(logprobs).exponential_(generator=rng).log()
        frames, _, _, _, info = env.step(logprobs.argmax(-1).numpy())

        if "episode" in info:
            over = running & info["_episode"]
            found["success"][over] = info["success"][over]
            found["return"][over] = info["episode"]["r"][over]
            found["length"][over] = info["episode"]["l"][over]
            found["level_seed"][over] = info["level_seed"][over]
            running &= ~over

    agent.train()
    return found


def evaluate(args: Args, learner: Learner) -> dict[str, float]:
    """Success on training levels and on as many that follow them, every `eval_interval` updates."""
    rates = {"eval/success_seen": math.nan, "eval/success_unseen": math.nan}
    if not args.eval_interval or learner.update % args.eval_interval:
        return rates

    starts = {"eval/success_seen": args.start_level}
    if args.num_levels:  # of an unlimited set, no level is unseen
        starts["eval/success_unseen"] = args.start_level + args.num_levels
    for name, start in starts.items():
        env = make_env(args, args.eval_envs, start)
        seed = int(torch.randint(2**31, (), generator=learner.generators["eval"]))
        found = play(learner.agent, env, seed, learner.generators["eval"])
        rates[name] = float(found["success"].mean())
        env.close()
    return rates


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

    first = saved["learner"]["global_step"] if saved else 0
    writer = SummaryWriter(str(args.path), purge_step=first + 1)
    rows = "".join(f"\n|{name}|{value}|" for name, value in vars(args).items())
    writer.add_text("hyperparameters", f"|parameter|value|\n|-|-|{rows}")
    return writer


def log_update(
    args: Args, learner: Learner, writer: SummaryWriter, data: Rollout, numbers: dict[str, float]
) -> dict[str, float]:
    """Write the update's row of metrics.csv, and the same as TensorBoard scalars."""
    row = {
        "global_step": learner.global_step,
        "charts/episodic_return": float(np.mean(data.returns or math.nan)),
        "charts/episodic_length": float(np.mean(data.lengths or math.nan)),
        "charts/success_rate": float(np.mean(data.successes or math.nan)),
        "charts/episodes": len(data.returns),
        **numbers,
        **evaluate(args, learner),
        **learner.probe.measure(learner.update, learner.agent.logprobs, data.states),  # condwrap
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
    torch.set_num_threads(args.num_threads or torch.get_num_threads())
    torch.set_float32_matmul_precision("high")  # TensorFloat-32 on a GPU, as convolutions have it
    learner = Learner(args)
    if saved:
        learner.load_state_dict(saved["learner"])
    if learner.update >= args.num_updates:
        print(f"{args.path} is finished")
        return learner

    import_envpool()  # if it is missing, say so before there is a folder
    writer = open_logs(args, saved)
    first = learner.global_step
    started = time.monotonic()
    printed = -math.inf
    while learner.update < args.num_updates:  # from one checkpoint to the next
        envs, frames = make_envs(args, learner.update // args.checkpoint_interval)

        for _ in range(min(args.checkpoint_interval, args.num_updates - learner.update)):
            learner.draw_masks()
            began = time.monotonic()
            data = rollout(args, learner, envs, frames)
            acted = time.monotonic()
            learner.update += 1
            check_finite(args, learner.update, reward=data.rewards)
            losses = update(args, learner, data)
            check_finite(args, learner.update, loss=learner.weights)

            now = time.monotonic()
            steps = int(data.counts.sum())
            learner.global_step += steps
            speeds = {
                "charts/SPS": (learner.global_step - first) / (now - started),
                "charts/SPS_rollout": steps / (acted - began),
                "charts/SPS_transfer": steps / learner.uploading,
                "charts/SPS_update": steps / (now - acted),
            }
            row = log_update(args, learner, writer, data, {**speeds, **losses})
            if now - printed > 10 or learner.update == args.num_updates:
                printed = now
                print(f"update {learner.update}/{args.num_updates}  {row['charts/SPS']:.0f} steps/s"
                      f"  success {row['charts/success_rate']:.2f}")  # fmt: skip

        for env in envs:
            env.close()
        writer.flush()
        save_checkpoint(args, learner)

    writer.close()
    return learner


def main() -> None:
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
