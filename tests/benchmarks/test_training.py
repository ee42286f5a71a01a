"""PPO and TRPO, steps a second: rollout, update and psi, beside SB3's and the bare environment.

Ours play the fast tasks, the peers the stock ones, which take the same steps. The peers come with
`make bench`; without them their part is skipped.
"""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
import torch

from baselines import ppo_reg, ppo_reg_population, trpo_reg, trpo_reg_population

pytestmark = pytest.mark.slow

TASKS = ("Hopper", "Humanoid", "InvertedDoublePendulum")
AGENTS = 10
GOALS = {  # times SB3's speed
    ("PPO", "Hopper"): 4.0, ("PPO", "Humanoid"): 2.7, ("PPO", "InvertedDoublePendulum"): 5.0,
    ("TRPO", "Hopper"): 3.0, ("TRPO", "Humanoid"): 2.3, ("TRPO", "InvertedDoublePendulum"): 3.0,
}  # fmt: skip


ENVIRONMENT_SHARES = {"Hopper": 0.75, "Humanoid": 0.85}  # of the fast environment's own speed
PENALTY_SHARE = 0.9  # of the speed without the penalty


def shares(name: str, task: str, coefficient: float) -> dict[str, float]:
    """Goals for a benchmark's speed as a share of that of others, by their names."""
    found = {name.format("0.0"): PENALTY_SHARE} if coefficient else {}
    if coefficient and "population[PPO" in name and task in ENVIRONMENT_SHARES:
        found[f"test_environment_alone[fast-{task}]"] = ENVIRONMENT_SHARES[task]
    return found


def fast(task: str) -> str:
    return f"harness.envs.fast_bullet:Fast{task}BulletEnv-v0"


def run(benchmark, algorithm: str, task: str, iterate, steps: int, **about) -> None:
    benchmark.group = f"{algorithm}, {task}"
    benchmark.extra_info.update(steps=steps, **about)
    torch.set_num_threads(1)
    benchmark.pedantic(iterate, rounds=3, warmup_rounds=1)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algorithm", ["PPO", "TRPO"])
def test_peer(benchmark, algorithm, task):
    library = pytest.importorskip("stable_baselines3" if algorithm == "PPO" else "sb3_contrib")
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    env_id = f"pybullet_envs_gymnasium:{task}BulletEnv-v0"
    venv = VecNormalize(DummyVecEnv([lambda: Monitor(gym.make(env_id))]))
    model = getattr(library, algorithm)("MlpPolicy", venv, device="cpu", seed=1)

    def iterate():
        model.learn(2048, reset_num_timesteps=False)

    run(benchmark, algorithm, task, iterate, 2048, peer=True)
    venv.close()


@contextlib.contextmanager
def single_iteration(baseline, task, **settings):
    args = baseline.Args(env_id=fast(task), **settings)
    learner = baseline.Learner(args)
    envs = baseline.make_envs(args, learner.stats)
    state = {"obs": envs.reset(seed=1)[0]}

    def iterate():
        data = baseline.rollout(args, learner, envs, state["obs"])
        learner.update += 1
        baseline.update(args, learner, data)
        state["obs"] = data.next_obs
        learner.probe.measure(learner.update, learner.actor, data.clean_obs)

    with contextlib.closing(envs):
        yield iterate, args.batch_size


@pytest.mark.parametrize("coefficient", [0.0, 1e-3])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algorithm", ["PPO", "TRPO"])
def test_single(benchmark, algorithm, task, coefficient):
    baseline = ppo_reg if algorithm == "PPO" else trpo_reg
    about = {"goal": 1.5} if algorithm == "PPO" else {}
    about["shares"] = shares(f"test_single[{algorithm}-{task}-{{}}]", task, coefficient)
    with single_iteration(baseline, task, coefficient=coefficient) as (iterate, steps):
        run(benchmark, algorithm, task, iterate, steps, **about)


@pytest.mark.parametrize("coefficient", [0.0, 1e-3])
@pytest.mark.parametrize("task", TASKS)
def test_compiled(benchmark, task, coefficient):
    torch.compiler.reset()
    settings = {"coefficient": coefficient, "compile": True}
    about = {"goal": 1.5, "shares": shares(f"test_compiled[{task}-{{}}]", task, coefficient)}
    with single_iteration(ppo_reg, task, **settings) as (iterate, steps):
        run(benchmark, "PPO", task, iterate, steps, **about)


@contextlib.contextmanager
def population_iteration(algorithm, task, coefficient, agents):
    program = ppo_reg_population if algorithm == "PPO" else trpo_reg_population
    population = program.population
    args = program.Args(env_id=fast(task), coefficient=coefficient, num_agents=agents)
    learners = [args.single.Learner(each) for each in args.runs]
    envs = population.Environments(args, learners)
    state = {"obs": envs.reset(seed=list(range(agents)))[0]}

    def iterate():
        rollouts, _ = population.iterate(args, learners, envs, state["obs"], program.update)
        state["obs"] = np.concatenate([data.next_obs for data in rollouts])
        for learner, data in zip(learners, rollouts, strict=True):
            learner.probe.measure(learner.update, learner.actor, data.clean_obs)

    with contextlib.closing(envs):
        yield iterate, agents * args.batch_size


@pytest.mark.parametrize("coefficient", [0.0, 1e-3])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algorithm", ["PPO", "TRPO"])
def test_population(benchmark, algorithm, task, coefficient):
    about = {"goal": GOALS[algorithm, task]}
    about["shares"] = shares(f"test_population[{algorithm}-{task}-{{}}]", task, coefficient)
    with population_iteration(algorithm, task, coefficient, AGENTS) as (iterate, steps):
        run(benchmark, algorithm, task, iterate, steps, **about)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kind", ["stock", "fast"])
def test_environment_alone(benchmark, kind, task):
    env = gym.make(fast(task) if kind == "fast" else f"pybullet_envs_gymnasium:{task}BulletEnv-v0")
    env.reset(seed=1)
    env.action_space.seed(1)

    def iterate():
        for _ in range(2000):
            _, _, ended, cut, _ = env.step(env.action_space.sample())
            if ended or cut:
                env.reset()

    run(benchmark, "PPO", task, iterate, 2000)
    env.close()
