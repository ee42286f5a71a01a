"""PPO (Schulman et al., 2017, arXiv 1707.06347) on CoinRun and Procgen's other games, to copy.

    python ppo_reg_coinrun.py --network impala --seed 1

Settings are those of Lee et al. (2020, arXiv 1910.05396): 500 levels, hard, velocity painted.
Lines marked so are the conditioning penalty (Asadulaev et al., arXiv 1906.05437):  # condwrap
`--coefficient 0` computes bit for bit what the file computes without them.  # condwrap
They need condwrap installed, with its extras `baselines` and `coinrun`.  # condwrap

On a GPU add `--bf16 --compile`. A run's directory holds metrics.csv (a row for each update),
TensorBoard events and checkpoint.pt; `--resume` continues a run, on the CPU as if never stopped.
"""

from __future__ import annotations

import csv
import ctypes
import dataclasses
import functools
import importlib.util
import math
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

from condwrap import ConditioningRegularizer  # condwrap

try:
    from baselines import headless_qt
except ImportError:  # this file was copied alone, and needs the system's libGL and GLib
    headless_qt = None


class RunError(Exception):
    """A run that cannot start, and what to do."""


@dataclasses.dataclass(frozen=True)
class Args:
    env_id: str = "coinrun"
    """coinrun, or another of Procgen's 16 games"""
    seed: int = 1
    """seed of the run"""
    agent: int = 0
    """number of the agent, for several of one seed"""
    total_timesteps: int = 50_000_000
    """steps to train for, rounded down to whole updates; those that EnvPool spends on resets count
    here, and not in global_step"""
    num_levels: int = 500
    """levels to train on; 0: without bound"""
    start_level: int = 0
    """seed of the first of them"""
    distribution_mode: Literal["easy", "hard"] = "hard"
    """how hard the levels are"""
    paint_vel_info: bool = True
    """paint the agent's velocity into the frame, as the original CoinRun does"""
    backend: Literal["envpool", "procgen"] = "envpool"
    """engine: EnvPool's, or OpenAI's original one (pip install procgen-mirror)"""
    num_envs: int = 32
    """environments; Lee et al. use 32 in each worker"""
    num_groups: int = 2
    """groups of environments: the network acts for one while another's simulators step"""
    num_threads: int = 0
    """CPU threads; 0: as many as PyTorch takes (OMP_NUM_THREADS, or all cores)"""
    num_steps: int = 256
    """steps of each environment between two updates"""
    num_minibatches: int = 8
    """minibatches in an epoch"""
    update_epochs: int = 3
    """passes over the rollout"""
    learning_rate: float = 5e-4
    """Adam's step size"""
    anneal: bool = True
    """let the step size and clip_coef fall linearly to 0"""
    gamma: float = 0.999
    """discount"""
    gae_lambda: float = 0.95
    """lambda of generalized advantage estimation"""
    clip_coef: float = 0.2
    """PPO's epsilon: how far the probability ratio may move from 1"""
    ent_coef: float = 0.01
    """c3: factor of the entropy bonus"""
    vf_coef: float = 0.5
    """c2: factor of half the critic's squared error"""
    max_grad_norm: float = 0.5
    """length that the gradient is clipped to"""
    network: Literal["nature", "impala", "impala_large"] = "nature"
    """convolutions of Mnih et al. (2015) or Espeholt et al. (2018), the latter in two sizes"""
    l2: float = 0.0
    """factor of half the squared weights, biases not counted; Lee et al. take 1e-4"""
    dropout: float = 0.0
    """share of the last hidden layer left out, the same in a whole batch; Lee et al. take 0.1"""
    norm_reward: bool = False
    """divide rewards, for learning only, by the running deviation of the discounted return"""
    coefficient: float = 1e-3  # condwrap
    """c1: factor of the conditioning penalty; 0 is plain PPO, psi still measured"""  # condwrap
    lambda_min: float = 1.0  # condwrap
    """lower end of the range that J is kept in"""  # condwrap
    lambda_max: float = 20.0  # condwrap
    """upper end of the range that J is kept in"""  # condwrap
    perturbation: str = "sphere"  # condwrap
    """kind of delta: sphere, gaussian or uniform"""  # condwrap
    radius: float = 1.0  # condwrap
    """size of delta, of pixels in [0, 1]"""  # condwrap
    probe_fraction: float = 0.125  # condwrap
    """share of each rollout's states, evenly spaced, that psi is logged from"""  # condwrap
    eval_interval: int = 100
    """updates between two evaluations on training and on unseen levels; 0: never"""
    eval_envs: int = 64
    """episodes of each evaluation, one in each environment"""
    device: str = "auto"
    """cpu, cuda or cuda:1; auto: a GPU if there is one"""
    bf16: bool = False
    """compute in bfloat16, except for the penalty"""
    compile: bool = False
    """compile acting, into CUDA graphs on a GPU, and the loss"""
    run_dir: Path | None = None
    """where the run's files go; by default runs/<game>__<this file>__s<seed>__a<agent>"""
    resume: bool = False
    """continue from the run directory's checkpoint, if it has one"""
    checkpoint_interval: int = 50
    """updates between two checkpoints; the environments are rebuilt at each"""
    track: bool = False
    """log to Weights & Biases too (needs wandb; WANDB_PROJECT names the project)"""

    def __post_init__(self) -> None:
        if self.env_id not in GAMES:
            raise ValueError(f"env_id must be one of {', '.join(GAMES)}, got {self.env_id!r}")
        for name, least in AT_LEAST.items():
            if not least <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name in ("learning_rate", "clip_coef", "max_grad_norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and above 0, got {getattr(self, name)}")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {self.dropout}")
        if self.num_envs % self.num_groups:
            raise ValueError(
                f"num_groups must divide num_envs = {self.num_envs}, got {self.num_groups}"
            )
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
        # condwrap: the regularizer's own checks
        self.regularizer(self.coefficient, torch.Generator(), self.probe_fraction)  # condwrap

    @property
    def batch_size(self) -> int:
        return self.num_envs * self.num_steps

    @property
    def num_updates(self) -> int:
        return self.total_timesteps // self.batch_size

    def regularizer(  # condwrap
        self, coefficient: float, rng: torch.Generator, fraction: float = 1.0  # condwrap
    ) -> ConditioningRegularizer:  # condwrap  # fmt: skip
        sizes = {"perturbation": self.perturbation, "radius": self.radius}  # condwrap
        return ConditioningRegularizer(  # condwrap
            coefficient, self.lambda_min, self.lambda_max,  # condwrap
            **sizes, fraction=fraction, generator=rng,  # condwrap
        )  # condwrap  # fmt: skip

    @property
    def path(self) -> Path:
        name = f"{self.env_id.split(':')[-1]}__{Path(__file__).stem}__s{self.seed}__a{self.agent}"
        return self.run_dir or Path("runs", name)


GAMES = ("bigfish", "bossfight", "caveflyer", "chaser", "climber", "coinrun", "dodgeball")
GAMES += ("fruitbot", "heist", "jumper", "leaper", "maze", "miner", "ninja", "plunder", "starpilot")
AT_LEAST = {"seed": 0, "agent": 0, "num_envs": 1, "num_groups": 1, "num_threads": 0}
AT_LEAST |= {"num_steps": 1, "num_minibatches": 1, "update_epochs": 1}
AT_LEAST |= {"num_levels": 0, "start_level": 0, "eval_interval": 0, "eval_envs": 1}
AT_LEAST |= {"checkpoint_interval": 1, "l2": 0, "ent_coef": 0, "vf_coef": 0}
MAY_CHANGE = {"run_dir", "resume", "track", "device", "num_threads"}  # when a run is resumed


# --- environment ----------------------------------------------------------------------------------


class Procgen(VectorEnv):
    """Procgen's games: frames `[N, 3, 64, 64]`, uint8, and 15 actions.

    `info` has, of the episodes that end in a step (`_episode` says which), `episode` with return
    "r" and length "l", `success` and `level_seed`. `info["reset"]` marks environments that ignored
    the action and began an episode: EnvPool spends a step on that, the original engine does not and
    so never shows an episode's last frame. A level is determined by its seed and the actions.

    Args:
        game: One of GAMES.
        num_envs: Environments.
        backend: "envpool" or "procgen".
        num_levels: Levels to draw from at each episode; 0: without bound, `start_level` unused.
        start_level: Seed of the first level.
        distribution_mode: "easy" or "hard".
        paint_vel_info: Paint the agent's velocity into the frame.
        num_threads: Threads that step the environments; 0: all cores.

    Raises:
        ValueError: An argument that the engine would accept, and misread.
        RunError: The engine or what it needs is not installed.
    """

    def __init__(
        self,
        game: str = "coinrun",
        num_envs: int = 1,
        *,
        backend: str = "envpool",
        num_levels: int = 500,
        start_level: int = 0,
        distribution_mode: str = "hard",
        paint_vel_info: bool = True,
        num_threads: int = 0,
    ) -> None:
        choices = {"game": (game, GAMES), "distribution_mode": (distribution_mode, MODES)}
        for name, (value, known) in {**choices, "backend": (backend, ENGINES)}.items():
            if value not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
        numbers = {"num_levels": num_levels, "start_level": start_level, "num_threads": num_threads}
        for name, number in {**numbers, "num_envs": num_envs}.items():
            if number < AT_LEAST[name]:
                raise ValueError(f"{name} must be at least {AT_LEAST[name]}, got {number}")
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": ENGINES[backend].autoreset_mode}
        self.single_observation_space = gym.spaces.Box(0, 255, (3, 64, 64), np.uint8)
        self.single_action_space = gym.spaces.Discrete(15)
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        levels = {"num_levels": num_levels, "start_level": start_level}
        levels |= {"paint_vel_info": paint_vel_info}
        self.make_engine = functools.partial(
            ENGINES[backend], game, num_envs, distribution_mode, num_threads, levels
        )
        self.engine: EnvPoolEngine | ProcgenEngine | None = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        """Build the engine anew: neither can return to a seed otherwise. It takes about 20 ms."""
        super().reset(seed=seed)
        self.close_extras()
        self.engine = self.make_engine(int(self.np_random.integers(2**31)))
        self.ended = np.zeros(self.num_envs, bool)
        self.returns = np.zeros(self.num_envs)
        self.lengths = np.zeros(self.num_envs, np.int64)
        return self.engine.first_frames(), {}

    def step(self, actions: np.ndarray) -> tuple:
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: np.ndarray) -> None:
        """Let the simulators step while the caller does something else, until `step_wait`."""
        if self.engine is None:
            raise gym.error.ResetNeeded("reset the environments before stepping them")
        self.engine.send(np.asarray(actions, np.int32))

    def step_wait(self) -> tuple:
        frames, rewards, terminations, truncations, success, level_seed = self.engine.receive()
        spends_a_step = self.engine.autoreset_mode == AutoresetMode.NEXT_STEP
        reset = self.ended & spends_a_step
        self.returns = np.where(self.ended, 0, self.returns) + rewards
        self.lengths = np.where(self.ended, 0, self.lengths) + ~reset
        self.ended = terminations | truncations
        info: dict[str, Any] = {"reset": reset}
        if self.ended.any():
            info |= {"episode": {"r": self.returns, "l": self.lengths}, "_episode": self.ended}
            info |= {"success": success(), "_success": self.ended}
            info |= {"level_seed": level_seed(), "_level_seed": self.ended}
        return frames, rewards, terminations, truncations, info

    def close_extras(self, **kwargs: Any) -> None:
        if self.engine is not None:
            self.engine.close()
        self.engine = None


MODES = ("easy", "hard")


class EnvPoolEngine:
    """EnvPool's port: after an episode ends, the next step ignores its action and begins one."""

    autoreset_mode = AutoresetMode.NEXT_STEP

    def __init__(
        self, game: str, num_envs: int, mode: str, num_threads: int, levels: dict, seed: int
    ) -> None:
        load_qt()
        try:
            import envpool
        except ImportError as error:
            message = "backend envpool needs EnvPool: pip install envpool"
            raise RunError(f"{message} ({error})") from None
        self.pool = envpool.make(
            f"{game.capitalize()}{mode.capitalize()}-v0", env_type="gymnasium", num_envs=num_envs,
            num_threads=min(num_threads, num_envs), seed=seed, **levels,
        )  # fmt: skip

    def first_frames(self) -> np.ndarray:
        return self.pool.reset()[0]

    def send(self, actions: np.ndarray) -> None:
        self.pool.send(actions)

    def receive(self) -> tuple:
        frames, rewards, terminations, truncations, info = self.pool.recv()
        success = functools.partial(np.not_equal, info["prev_level_complete"], 0)
        return frames, rewards, terminations, truncations, success, lambda: info["level_seed"]

    def close(self) -> None:
        self.pool.close()


class ProcgenEngine:
    """OpenAI's engine: the step that ends an episode returns the next one's first frame."""

    autoreset_mode = AutoresetMode.SAME_STEP

    def __init__(
        self, game: str, num_envs: int, mode: str, num_threads: int, levels: dict, seed: int
    ) -> None:
        try:
            from procgen import ProcgenGym3Env
        except ImportError as error:
            message = "backend procgen needs OpenAI's engine: pip install procgen-mirror"
            raise RunError(f"{message} ({error})") from None
        self.env = ProcgenGym3Env(
            num=num_envs, env_name=game, distribution_mode=mode, rand_seed=seed,
            num_threads=num_threads or os.cpu_count(), **levels,
        )  # fmt: skip
        self.steps, self.time_limit = np.zeros(num_envs, np.int64), TIME_LIMITS.get(game, 1000)

    def first_frames(self) -> np.ndarray:
        return self.env.observe()[1]["rgb"].transpose(0, 3, 1, 2)

    def send(self, actions: np.ndarray) -> None:
        self.env.act(actions)

    def receive(self) -> tuple:
        rewards, obs, done = self.env.observe()
        self.steps += 1
        late = done & (self.steps >= self.time_limit)
        self.steps[done] = 0

        def read(name: str) -> np.ndarray:
            return np.array([info[name] for info in self.env.get_info()])

        def success() -> np.ndarray:
            return read("prev_level_complete") != 0

        frames = obs["rgb"].transpose(0, 3, 1, 2)
        return frames, rewards, done & ~late, late, success, lambda: read("prev_level_seed")

    def close(self) -> None:
        self.env.close()


# the original engine's own, which it reports as any other end; 1000 in the other games
TIME_LIMITS = {"bigfish": 6000, "bossfight": 4000, "leaper": 500, "maze": 500, "plunder": 4000}
ENGINES = {"envpool": EnvPoolEngine, "procgen": ProcgenEngine}


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


def make_env(args: Args, num_envs: int, start_level: int) -> Procgen:
    return Procgen(
        args.env_id, num_envs, backend=args.backend, num_levels=args.num_levels,
        start_level=start_level, distribution_mode=args.distribution_mode,
        paint_vel_info=args.paint_vel_info,
        num_threads=args.num_threads or torch.get_num_threads(),
    )  # fmt: skip


def make_envs(args: Args, checkpoint: int) -> tuple[list[Procgen], list[np.ndarray]]:
    """The groups of environments until the next checkpoint, and their first frames.

    The engine's state is not saved. So every run builds its environments anew at each scheduled
    checkpoint, and an interrupted run sees the same episodes as an undisturbed one.
    """
    size = args.num_envs // args.num_groups
    envs = [make_env(args, size, args.start_level) for _ in range(args.num_groups)]
    seeds = env_seeds(args, checkpoint)
    return envs, [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=False)]


def env_seeds(args: Args, checkpoint: int) -> list[int]:
    sequence = np.random.SeedSequence((args.seed, args.agent, checkpoint))
    return sequence.generate_state(args.num_envs).tolist()


# --- agent ----------------------------------------------------------------------------------------


def initialize(layer: nn.Module, gain: float, rng: torch.Generator) -> nn.Module:
    """Orthogonal weights, drawn from no global state."""
    nn.init.orthogonal_(layer.weight, gain, rng)
    nn.init.zeros_(layer.bias)
    return layer


def make_linear(n_in: int, n_out: int, gain: float, rng: torch.Generator) -> nn.Module:
    return initialize(nn.utils.skip_init(nn.Linear, n_in, n_out), gain, rng)


def make_conv(
    n_in: int, n_out: int, size: int, rng: torch.Generator, *,
    gain: float = math.sqrt(2), stride: int = 1, padding: int = 0,
) -> nn.Module:  # fmt: skip
    conv = nn.utils.skip_init(nn.Conv2d, n_in, n_out, size, stride=stride, padding=padding)
    return initialize(conv, gain, rng)


class Residual(nn.Module):
    """x + conv(relu(conv(relu(x)))), which begins as x: else the signal grows with each block."""

    def __init__(self, channels: int, rng: torch.Generator) -> None:
        super().__init__()
        first = make_conv(channels, channels, 3, rng, padding=1)
        second = make_conv(channels, channels, 3, rng, padding=1, gain=0.0)
        self.body = nn.Sequential(nn.ReLU(), first, nn.ReLU(), second)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


def nature(rng: torch.Generator) -> nn.Sequential:
    """Mnih et al., 2015: three convolutions, 512 features."""
    layers = [
        make_conv(3, 32, 8, rng, stride=4),
        nn.ReLU(),
        make_conv(32, 64, 4, rng, stride=2),
        nn.ReLU(),
    ]
    layers += [make_conv(64, 64, 3, rng), nn.ReLU(), nn.Flatten()]
    return nn.Sequential(*layers, make_linear(1024, 512, math.sqrt(2), rng), nn.ReLU())


def impala(rng: torch.Generator, channels: tuple[int, ...] = (16, 32, 32)) -> nn.Sequential:
    """Espeholt et al., 2018: in each section a convolution, a pooling and two residual blocks."""
    layers: list[nn.Module] = []
    for n_in, n_out in zip((3, *channels), channels, strict=False):
        layers += [make_conv(n_in, n_out, 3, rng, padding=1), nn.MaxPool2d(3, 2, 1)]
        layers += [Residual(n_out, rng), Residual(n_out, rng)]
    features = channels[-1] * (64 >> len(channels)) ** 2
    linear = make_linear(features, 256, math.sqrt(2), rng)
    return nn.Sequential(*layers, nn.ReLU(), nn.Flatten(), linear, nn.ReLU())


NETWORKS = {"nature": nature, "impala": impala}
NETWORKS |= {"impala_large": functools.partial(impala, channels=(32, 64, 64, 64, 64))}


class Agent(nn.Module):
    """Logits of the actions and a value, from one network; frames are divided by 255 in it."""

    def __init__(self, args: Args, rng: torch.Generator) -> None:
        super().__init__()
        self.network = NETWORKS[args.network](rng)
        features = next(m.out_features for m in self.network.modules() if isinstance(m, nn.Linear))
        self.policy = make_linear(features, 15, 0.01, rng)
        self.value = make_linear(features, 1, 1.0, rng)
        self.register_buffer("mask", torch.ones(features))  # of dropout, the same for every state

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        x = frames / 255.0
        if x.is_cuda:
            x = x.contiguous(memory_format=torch.channels_last)
        hidden = self.network(x)
        if self.training:
            hidden = hidden * self.mask
        return self.policy(hidden).float().log_softmax(-1), self.value(hidden).float().squeeze(-1)

    def logprobs(self, frames: Tensor) -> Tensor:
        return self(frames)[0]


def sample(agent: Agent, frames: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """An action for each state, its log-probability, and the state's value.

    argmax(log p - log e), e standard exponential, is distributed as p.
    """
    logprobs, values = agent(frames)
    actions = (logprobs - noise.log()).argmax(-1)
    return actions, logprobs.gather(-1, actions[:, None])[:, 0], values


@torch.no_grad()
def play(
    agent: Agent, env: Procgen, seed: int, rng: torch.Generator | None
) -> dict[str, np.ndarray]:
    """The first episode of each environment: success, return, length and level seed, each `[N]`.

    Not the first N episodes to end, of which short ones would be too many. Actions are sampled
    with `rng`, or the likeliest without. Frames go to the agent's device, dropout is off.
    """
    frames, _ = env.reset(seed=seed)
    found = {"success": np.zeros(env.num_envs, bool), "return": np.zeros(env.num_envs)}
    found |= {name: np.zeros(env.num_envs, np.int64) for name in ("length", "level_seed")}
    running, device = np.ones(env.num_envs, bool), agent.mask.device
    agent.eval()
    while running.any():
        logprobs, _ = agent(torch.tensor(frames, device=device))
        logprobs = logprobs.cpu()
        if rng is not None:
            logprobs -= torch.empty_like(logprobs).exponential_(generator=rng).log()
        frames, _, _, _, info = env.step(logprobs.argmax(-1).numpy())
        if "episode" in info:
            over = running & info["_episode"]
            seen = {"success": info["success"], "level_seed": info["level_seed"]}
            seen |= {"return": info["episode"]["r"], "length": info["episode"]["l"]}
            for name, values in seen.items():
                found[name][over] = values[over]
            running &= ~over
    agent.train()
    return found


# --- PPO ------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """T steps of N environments, and what they led to; images are on the network's device."""

    obs: Tensor  # [T, N, 3, 64, 64], uint8
    actions: Tensor  # [T, N]
    logprobs: Tensor  # [T, N]
    rewards: Tensor  # [T, N], scaled for learning
    dones: Tensor  # [T, N], 1 where an episode ended
    values: Tensor  # [T, N]
    next_values: Tensor  # [T, N], V of what the step led to: 0 at an end
    counts: Tensor  # [T, N], False where the step ignored the action and began an episode
    episodes: dict[str, list[float]]  # of those that ended


@torch.no_grad()
def rollout(args: Args, learner: Learner, envs: list[Procgen], frames: list[np.ndarray]) -> Rollout:
    """Step the groups in turn: the network acts for one while the simulators step the others.

    `frames` holds each group's last frames, and is left holding those that follow. Time limits
    count as ends, as they do in the original engine, which does not tell them apart.
    """
    agent, device, shape = learner.agent, learner.device, (args.num_steps, args.num_envs)
    obs = torch.empty((*shape, 3, 64, 64), dtype=torch.uint8, device=device)
    actions = torch.empty(shape, dtype=torch.int64, device=device)
    logprobs, values = torch.empty(shape, device=device), torch.empty(shape, device=device)
    rewards, dones = (np.zeros(shape, np.float32) for _ in range(2))
    counts = np.ones(shape, bool)
    noise = torch.empty((*shape, 15)).exponential_(generator=learner.generators["action"])
    noise = noise.to(device)
    names = ("episodic_return", "episodic_length", "success_rate")
    episodes: dict[str, list[float]] = {name: [] for name in names}
    size = args.num_envs // args.num_groups
    groups = [slice(i * size, (i + 1) * size) for i in range(args.num_groups)]

    def receive(t: int, g: int) -> None:
        frames[g], rewards[t, groups[g]], ended, cut, info = envs[g].step_wait()
        dones[t, groups[g]], counts[t, groups[g]] = ended | cut, ~info["reset"]
        if "episode" in info:
            over = info["_episode"]
            episodes["episodic_return"] += info["episode"]["r"][over].tolist()
            episodes["episodic_length"] += info["episode"]["l"][over].tolist()
            episodes["success_rate"] += info["success"][over].tolist()

    for t in range(args.num_steps):
        for g, group in enumerate(groups):
            if t:
                receive(t - 1, g)
            learner.upload(frames[g], obs[t, group], g)
            acted = learner.sample(agent, obs[t, group], noise[t, group])
            actions[t, group], logprobs[t, group], values[t, group] = acted
            envs[g].step_async(actions[t, group].cpu().numpy())  # the one wait for the device
    for g in range(args.num_groups):
        receive(args.num_steps - 1, g)
    last = torch.cat([agent(torch.tensor(x, device=device))[1] for x in frames])
    next_values = torch.cat([values[1:], last[None]]).cpu() * (1 - torch.from_numpy(dones))
    learner.scale_rewards(args, rewards, dones, counts)
    rewards, dones, counts = map(torch.from_numpy, (rewards, dones, counts))
    return Rollout(
        obs, actions, logprobs, rewards, dones, values.cpu(), next_values, counts, episodes
    )


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


def policy_loss(logratio: Tensor, advantages: Tensor, clip_coef: float) -> tuple[Tensor, ...]:
    """-L_CLIP, the KL estimate E[ratio - 1 - log ratio], and the share of clipped samples."""
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    loss = -torch.min(advantages * ratio, advantages * clipped).mean()
    with torch.no_grad():
        return loss, (ratio - 1 - logratio).mean(), (ratio != clipped).float().mean()


def step(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_grad_norm)
    optimizer.step()


def minibatches(counts: Tensor, size: int, rng: torch.Generator) -> Iterator[Tensor]:
    """Indices of the steps that count, `[T · N]`, in random order, `size` at a time.

    A few come twice, in place of those that do not count, so that all minibatches have one shape.
    """
    valid = counts.flatten().nonzero().squeeze(-1)
    order = valid[torch.randperm(len(valid), generator=rng)]
    yield from order[torch.arange(counts.numel()) % len(order)].split(size)


class Batch(NamedTuple):
    """A minibatch of B steps, on the network's device."""

    obs: Tensor  # [B, 3, 64, 64]
    actions: Tensor  # [B]
    old_logprobs: Tensor  # [B]
    advantages: Tensor  # [B]
    targets: Tensor  # [B]
    delta: Tensor | None = None  # condwrap: [B, 3, 64, 64], of pixels in [0, 1]


def total_loss(
    args: Args, learner: Learner, batch: Batch, clip_coef: Tensor
) -> tuple[Tensor, Tensor]:
    """Equation (3) of the paper, minimized, and its parts.

    The paper maximizes L_CLIP + c1·psi - c2·L_VF + c3·entropy, which would reward bad conditioning;
    its text says penalty. So -L_CLIP + c1·mean(psi) + c2·L_VF - c3·entropy is minimized here.
    """
    agent = learner.agent
    with torch.autocast(batch.obs.device.type, torch.bfloat16, enabled=args.bf16):
        logprobs, values = agent(batch.obs)
    logratio = logprobs.gather(-1, batch.actions[:, None])[:, 0] - batch.old_logprobs
    pg_loss, kl, clipfrac = policy_loss(logratio, batch.advantages, clip_coef)
    entropy = -(logprobs.exp() * logprobs).sum(-1).mean()
    value_loss = 0.5 * (values - batch.targets).square().mean()
    loss = pg_loss + args.vf_coef * value_loss - args.ent_coef * entropy
    if args.l2:
        weights = [p for p in agent.parameters() if p.ndim > 1]
        loss = loss + args.l2 * 0.5 * sum(w.square().sum() for w in weights)
    if batch.delta is not None:  # condwrap
        output = None if args.bf16 else logprobs  # condwrap: rounding would pass for sensitivity
        measured = learner.regularizer(  # condwrap
            agent.logprobs, batch.obs, delta=batch.delta, output=output  # condwrap
        )  # condwrap  # fmt: skip
        loss = loss + measured.penalty  # condwrap
    return loss, torch.stack([pg_loss, entropy, kl, clipfrac, value_loss]).detach()


def update(args: Args, learner: Learner, data: Rollout) -> dict[str, float]:
    """Epochs of minibatches over one rollout."""
    left = 1 - learner.update / args.num_updates if args.anneal else 1.0
    learner.optimizer.param_groups[0]["lr"] = left * args.learning_rate
    clip_coef = torch.tensor(left * args.clip_coef, device=learner.device)
    advantages = gae(data, args.gamma, args.gae_lambda)
    targets = advantages + data.values
    columns = (data.obs, data.actions, data.logprobs, advantages, targets)
    columns = [x.flatten(0, 1).to(learner.device) for x in columns]
    logs = []
    for _ in range(args.update_epochs):
        size, rng = args.batch_size // args.num_minibatches, learner.generators["minibatch"]
        for i in minibatches(data.counts, size, rng):
            batch = Batch(*(x[i.to(learner.device)] for x in columns))
            if args.coefficient > 0:  # condwrap
                delta = learner.regularizer.sample_delta(batch.obs)  # condwrap
                batch = batch._replace(delta=delta)  # condwrap
            loss, parts = learner.total_loss(args, learner, batch, clip_coef)
            step(learner.optimizer, loss, args.max_grad_norm)
            logs.append(parts.clone())  # compiled code may reuse its memory
    explained = 1 - (targets - data.values)[data.counts].var() / targets[data.counts].var()
    names = ("policy_loss", "entropy", "approx_kl", "clipfrac", "value_loss")
    means = dict(zip(names, torch.stack(logs).mean(0).tolist(), strict=True))
    means["explained_variance"] = explained.item()
    losses = {f"losses/{name}": x for name, x in means.items()}
    return {"charts/learning_rate": learner.optimizer.param_groups[0]["lr"], **losses}


def measure_conditioning(args: Args, learner: Learner, obs: Tensor) -> dict[str, float]:  # condwrap
    """How the new policy is conditioned on the rollout: one rule in every run."""  # condwrap
    measured = learner.probe(learner.agent.logprobs, obs.flatten(0, 1))  # condwrap
    levels = torch.tensor([0.05, 0.5, 0.95], device=obs.device)  # condwrap
    q05, q50, q95 = measured.quotient.quantile(levels)  # condwrap
    logs = {"psi": measured.psi.mean(), "quotient_q05": q05, "quotient_q50": q50}  # condwrap
    logs |= {"quotient_q95": q95, "fraction_below": measured.fraction_below}  # condwrap
    logs["fraction_above"] = measured.fraction_above  # condwrap
    return {f"conditioning/{name}": x.item() for name, x in logs.items()}  # condwrap


def evaluate(args: Args, learner: Learner) -> dict[str, float]:
    """Success on training levels and on as many that follow them, every `eval_interval` updates."""
    starts = {"eval/success_seen": args.start_level}
    if args.num_levels:  # without bound, no level is unseen
        starts["eval/success_unseen"] = args.start_level + args.num_levels
    rates = {"eval/success_seen": math.nan, "eval/success_unseen": math.nan}
    if args.eval_interval and learner.update % args.eval_interval == 0:
        for name, start in starts.items():
            env = make_env(args, args.eval_envs, start)
            seed = int(torch.randint(2**31, (), generator=learner.generators["eval"]))
            found = play(learner.agent, env, seed, learner.generators["eval"])
            rates[name] = float(found["success"].mean())
            env.close()
    return rates


# --- state and files ------------------------------------------------------------------------------


class Learner:
    """All that changes while training, and so all that a checkpoint holds."""

    def __init__(self, args: Args) -> None:
        self.device = find_device(args.device)
        self.stats = {"return_rms": RunningMeanStd(shape=())} if args.norm_reward else {}
        self.discounted = np.zeros(args.num_envs)
        names = ("init", "action", "minibatch", "dropout", "eval", "penalty", "probe")
        streams = np.random.SeedSequence((args.seed, args.agent)).spawn(len(names))
        seeds = {
            n: int(s.generate_state(1, np.uint64)[0]) for n, s in zip(names, streams, strict=True)
        }
        self.generators = {n: torch.Generator().manual_seed(seeds[n]) for n in names[:5]}
        self.agent = Agent(args, self.generators["init"]).to(self.device)
        if self.on_gpu:
            self.agent.to(memory_format=torch.channels_last)  # on the CPU it is no faster
        self.optimizer = torch.optim.Adam(
            self.agent.parameters(), args.learning_rate, eps=1e-5, fused=True
        )
        rngs = [torch.Generator(self.device).manual_seed(seeds[n]) for n in names[5:]]  # condwrap
        self.regularizer = args.regularizer(args.coefficient, rngs[0])  # condwrap
        self.probe = args.regularizer(0.0, rngs[1], args.probe_fraction)  # condwrap
        self.update, self.global_step = 0, 0
        self.uploading = 0.0  # seconds
        self.sample, self.total_loss = sample, total_loss
        if args.bf16:
            self.sample = torch.autocast(self.device.type, torch.bfloat16)(sample)
        if args.compile:
            self.sample = torch.compile(self.sample, mode="reduce-overhead")
            self.total_loss = torch.compile(total_loss)
        shape, pin = (args.num_groups, args.num_envs // args.num_groups, 3, 64, 64), self.on_gpu
        self.staging = torch.empty(shape if pin else 0, dtype=torch.uint8, pin_memory=pin)

    @property
    def on_gpu(self) -> bool:
        return self.device.type == "cuda"

    def upload(self, frames: np.ndarray, to: Tensor, group: int) -> None:
        """One copy on the CPU, by NumPy: PyTorch's would wake threads that the simulators need."""
        started = time.perf_counter()
        if self.on_gpu:
            np.copyto(self.staging[group].numpy(), frames)
            to.copy_(self.staging[group], non_blocking=True)
        else:
            np.copyto(to.numpy(), frames)
        self.uploading += time.perf_counter() - started

    def draw_mask(self, args: Args) -> None:
        """Dropout's mask for a rollout and its update: the ratios of PPO begin at 1."""
        if args.dropout:
            uniform = torch.rand(len(self.agent.mask), generator=self.generators["dropout"])
            kept = (uniform >= args.dropout).float() / (1 - args.dropout)
            self.agent.mask.copy_(kept)

    def scale_rewards(
        self, args: Args, rewards: np.ndarray, dones: np.ndarray, counts: np.ndarray
    ) -> None:
        """Divide `[T, N]` rewards by the running deviation of the discounted return, in place."""
        if args.norm_reward:
            for t in range(len(rewards)):
                self.discounted = self.discounted * args.gamma + rewards[t]
                if counts[t].any():
                    self.stats["return_rms"].update(self.discounted[counts[t]])
                rewards[t] /= np.sqrt(self.stats["return_rms"].var + 1e-8)
                self.discounted *= 1 - dones[t]

    def state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = {name: getattr(self, name).state_dict() for name in TRAINED}
        for name, rms in self.stats.items():
            moments = vars(rms).items()
            state[name] = {key: torch.tensor(x, dtype=torch.float64) for key, x in moments}
        generators = {name: generator.get_state() for name, generator in self.generators.items()}
        counters = {"update": self.update, "global_step": self.global_step}
        return {**state, "generators": generators, **counters}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in TRAINED:
            getattr(self, name).load_state_dict(state[name])
        for weights, moments in self.optimizer.state.items():  # fused Adam pairs them in memory
            for key in ("exp_avg", "exp_avg_sq"):  # order, which differs between CPU and GPU
                moments[key] = torch.empty_like(weights).copy_(moments[key])
        for name, rms in self.stats.items():
            vars(rms).update({key: x.numpy() for key, x in state[name].items()})
        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name])
        self.update, self.global_step = state["update"], state["global_step"]


TRAINED = ("agent", "optimizer")
TRAINED += ("regularizer", "probe")  # condwrap


def find_device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise RunError(f"device {name} cannot be used: {str(error).splitlines()[0]}") from None


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
    torch.set_num_threads(args.num_threads or torch.get_num_threads())
    torch.set_float32_matmul_precision("high")  # TensorFloat-32 on a GPU, as convolutions have it
    learner = Learner(args)
    if saved:
        learner.load_state_dict(saved["learner"])
    if learner.update == args.num_updates:
        print(f"{args.path} is finished")
        return learner
    make_envs(args, 0)  # a missing engine is told of before there is a folder
    args.path.mkdir(parents=True, exist_ok=True)
    first, started, printed = learner.global_step, time.time(), -math.inf
    with open(args.path / "metrics.csv", "a") as metrics:
        size = saved["metrics_size"] if saved else 0
        if metrics.tell() < size:
            raise RunError(f"{metrics.name} lacks rows: remove its folder to start anew")
        metrics.truncate(size)  # later rows are computed again
    writer = SummaryWriter(str(args.path), purge_step=first + 1)
    rows = "".join(f"\n|{name}|{value}|" for name, value in vars(args).items())
    writer.add_text("hyperparameters", f"|parameter|value|\n|-|-|{rows}")
    while learner.update < args.num_updates:  # from one checkpoint to the next
        envs, frames = make_envs(args, learner.update // args.checkpoint_interval)
        learner.discounted[:] = 0
        for _ in range(min(args.checkpoint_interval, args.num_updates - learner.update)):
            learner.draw_mask(args)
            learner.uploading, times = 0.0, [time.time()]
            data = rollout(args, learner, envs, frames)
            times.append(time.time())
            losses = update(args, learner, data)
            times.append(time.time())
            learner.update += 1
            steps = int(data.counts.sum())
            learner.global_step += steps
            speed = (learner.global_step - first) / (times[-1] - started)
            ended = {f"charts/{k}": float(np.mean(v or math.nan)) for k, v in data.episodes.items()}
            row = {
                "global_step": learner.global_step,
                **ended,
                "charts/SPS": speed,
                "charts/SPS_rollout": steps / (times[1] - times[0]),
                "charts/SPS_transfer": steps / learner.uploading,
                "charts/SPS_update": steps / (times[2] - times[1]),
                **losses,
                **evaluate(args, learner),
                **measure_conditioning(args, learner, data.obs),  # condwrap
            }
            write_metrics(args, writer, row)
            if time.time() - printed > 10 or learner.update == args.num_updates:
                printed = time.time()
                print(f"update {learner.update}/{args.num_updates}  {speed:.0f} steps/s  "
                      f"success {row['charts/success_rate']:.2f}")  # fmt: skip
        for env in envs:
            env.close()
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
    except (RunError, gym.error.Error, ModuleNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: --resume continues from the last checkpoint, if there is one yet")


if __name__ == "__main__":
    main()
