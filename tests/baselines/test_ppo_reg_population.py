"""The PPO population: each agent is as the single file would train it, its files as well."""

from __future__ import annotations

import copy
import dataclasses
import os
import shutil
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines import population, ppo_reg, ppo_reg_population
from tests.baselines.helpers import (
    FLAGS,
    SMALL,
    check_refusal,
    read_metrics,
    without_speed,
)


def arguments(folder=None, **changes) -> ppo_reg_population.Args:
    """Arguments of a run of 3 agents and 5 short updates."""
    settings = {"env_id": "Pendulum-v1", "total_timesteps": 320, "num_agents": 3, **SMALL[ppo_reg]}
    path = folder and folder / "a{agent}"
    return ppo_reg_population.Args(**{**settings, "run_dir": path, **changes})


def seeds_of(args, checkpoint: int = 0) -> list[int]:
    return [seed for run in args.runs for seed in ppo_reg.env_seeds(run, checkpoint)]


def learners_of(args) -> list[ppo_reg.Learner]:
    return [ppo_reg.Learner(run) for run in args.runs]


def recorded(args) -> tuple[list[ppo_reg.Learner], list[ppo_reg.Rollout]]:
    """Each agent's learner and a rollout of its own, by the single file."""
    learners, rollouts = learners_of(args), []
    for run, learner in zip(args.runs, learners, strict=True):
        envs = ppo_reg.make_envs(run, 0, learner.stats)
        next_obs, _ = envs.reset(seed=ppo_reg.env_seeds(run, 0))
        rollouts.append(ppo_reg.rollout(run, learner, envs, next_obs))
        envs.close()
    return learners, rollouts


def state_of(learner) -> dict[str, torch.Tensor]:
    """All that a checkpoint holds, by name."""
    found = {}

    def walk(name, value) -> None:
        if isinstance(value, dict | list):
            pairs = value.items() if isinstance(value, dict) else enumerate(value)
            for key, x in pairs:
                walk(f"{name}.{key}", x)
        else:
            found[name] = value

    walk("", learner.state_dict())
    return found


def check_close(learner, other, tolerance: float) -> None:
    ours, theirs = state_of(learner), state_of(other)
    assert list(ours) == list(theirs)
    for name, value in theirs.items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            torch.testing.assert_close(
                ours[name], value, rtol=0, atol=tolerance, msg=lambda m, n=name: f"{n}: {m}"
            )
        elif isinstance(value, torch.Tensor):
            assert torch.equal(ours[name], value), name
        else:
            assert ours[name] == value, name


# --- an update -----------------------------------------------------------------------------------

CASES = {
    "plain": {"coefficient": 0.0},
    "penalty": {"coefficient": 0.5},
    "wide range": {"coefficient": 1e-3, "lambda_min": 0.0, "lambda_max": 0.01, "radius": 0.1},
    "gaussian": {"coefficient": 0.1, "perturbation": "gaussian"},
    "more of the policy": {"update_epochs": 4, "vf_epochs": 1, "ent_coef": 0.01},
    "more of the critic": {"update_epochs": 1, "vf_epochs": 4, "vf_coef": 1.0},
    "relu": {"hidden_sizes": (33, 17, 8), "activation": "relu", "log_std_init": -1.0},
    "environments": {"num_envs": 3, "total_timesteps": 960, "max_grad_norm": 0.05},
    "annealed": {"anneal_lr": True, "num_agents": 2},
    "one": {"num_agents": 1, "agent": 4, "seed": 7},
    "bullet": {"env_id": "HopperBulletEnv-v0"},
}


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_two_updates_are_those_of_the_single_file(changes, dtype, tolerance):
    args = arguments(**changes)
    learners, rollouts = recorded(args)
    rollouts = [r._replace(**{k: x.to(dtype) for k, x in r._asdict().items()
                              if isinstance(x, torch.Tensor)}) for r in rollouts]  # fmt: skip
    for learner in learners:
        learner.actor.to(dtype), learner.critic.to(dtype)
    alone = copy.deepcopy(learners)
    for number in range(2):  # the second begins with Adam's moments
        ours = ppo_reg_population.update(args, learners, rollouts)
        for i, run in enumerate(args.runs):
            theirs = ppo_reg.update(run, alone[i], rollouts[i])
            assert ours[i] == pytest.approx(theirs, abs=10 * tolerance)
            assert list(ours[i]) == list(theirs)
            learners[i].update = alone[i].update = number + 1
            check_close(learners[i], alone[i], tolerance)


def test_each_agent_stops_at_its_own_kl():
    """Of three agents at one target, some stop early and some do not; all are as they are alone."""
    changes = {"coefficient": 0.1, "update_epochs": 6, "vf_epochs": 3}
    learners, rollouts = recorded(arguments(**changes))
    epochs = []
    args = arguments(**changes, target_kl=1e-4)
    alone = copy.deepcopy(learners)
    ppo_reg_population.update(args, learners, rollouts)
    for i, run in enumerate(args.runs):
        ppo_reg.update(run, alone[i], rollouts[i])
        check_close(learners[i], alone[i], 1e-5)
        steps = alone[i].actor_optimizer.state_dict()["state"][0]["step"].item()
        epochs.append(steps / args.num_minibatches)
    assert len(set(epochs)) > 1
    assert min(epochs) < 6


def test_delta_is_what_each_agents_regularizer_would_draw():
    args = arguments(coefficient=0.1)
    learners, alone = learners_of(args), learners_of(args)
    for size in (1, 7, 16, 50):  # randn fills in blocks of 16
        obs = torch.zeros(4, 3, size, 3)
        delta = population.draw_delta(learners, obs, np.array([True, False, True]))
        for minibatch in range(4):
            for i in (0, 2):
                expected = alone[i].regularizer.sample_delta(obs[0, i])
                assert torch.equal(delta[minibatch, i], expected)
    assert torch.equal(*[x[1].regularizer.generator.get_state() for x in (learners, alone)])


# --- environments --------------------------------------------------------------------------------


class Drift(gym.Env):
    """Random observations of every size, and episodes that end, are cut, or both at once."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.draw(), {}

    def step(self, action):
        ended, cut = (self.np_random.random(2) < 0.1).tolist()
        return self.draw(), self.np_random.normal() + float(action.sum()), ended, cut, {"x": 1}

    def draw(self):
        scale = 10.0 ** np.arange(-3, 2)
        return (scale * self.np_random.normal(size=5)).astype(np.float32)


class Wide(Drift):
    """One observation, and it is float64."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def draw(self):
        return self.np_random.normal(size=1)


for name, env in (("Drift", Drift), ("Wide", Wide)):
    gym.register(f"test/{name}-v0", env, max_episode_steps=30)


@pytest.mark.parametrize("env_id", ["test/Drift-v0", "test/Wide-v0"])
@pytest.mark.parametrize("num_envs", [1, 2, 9])
@pytest.mark.parametrize(
    "changes", [{}, {"norm_obs": False}, {"norm_reward": False}, {"perturb_obs": True}], ids=str
)
def test_what_agents_see_is_what_the_wrappers_would_show_bit_for_bit(env_id, num_envs, changes):
    args = arguments(env_id=env_id, num_envs=num_envs, total_timesteps=1000, **changes)
    learners, alone = learners_of(args), learners_of(args)
    for checkpoint in range(2):  # the second goes on with the statistics of the first
        ours = population.make_envs(args, checkpoint, learners)
        theirs = [
            ppo_reg.make_envs(run, checkpoint, x.stats)
            for run, x in zip(args.runs, alone, strict=True)
        ]
        obs, _ = ours.reset(seed=seeds_of(args, checkpoint))
        each = [
            envs.reset(seed=ppo_reg.env_seeds(run, checkpoint))[0]
            for envs, run in zip(theirs, args.runs, strict=True)
        ]
        check_equal(obs, np.concatenate(each))
        actions = np.random.default_rng(0).normal(size=(100, 3, num_envs, 2)).astype(np.float32)
        ended = 0
        for action in actions:
            *step, info = ours.step(action.reshape(-1, 2))
            each = [envs.step(a) for envs, a in zip(theirs, action, strict=True)]
            for x, parts in zip(step, zip(*[e[:4] for e in each], strict=True), strict=True):
                check_equal(x, np.concatenate(parts))
            for i, e in enumerate(each):
                for j in np.flatnonzero(e[2] | e[3]):
                    ended += 1
                    k = i * num_envs + j
                    check_equal(info["final_obs"][k], e[4]["final_obs"][j])
                    for key in "rl":
                        check_equal(info["episode"][key][k], e[4]["episode"][key][j])
            done = np.concatenate([e[2] | e[3] for e in each])
            assert ("_episode" in info) == done.any()
            check_equal(info.get("_episode", done), done)
        assert ended > 10
        for envs in (ours, *theirs):
            envs.close()
        ours.unwrapped.store()
        for learner, other in zip(learners, alone, strict=True):
            check_close(learner, other, 0.0)


def check_equal(x, y) -> None:
    np.testing.assert_array_equal(x, y, strict=True)


# --- agents --------------------------------------------------------------------------------------


def test_the_agents_begin_as_their_single_selves_and_go_through_the_same_noise():
    args = arguments(env_id="test/Drift-v0", num_envs=2, total_timesteps=640, agent=5)
    assert [run.agent for run in args.runs] == [5, 6, 7]
    learners, alone = learners_of(args), learners_of(args)
    for learner in (*learners, *alone):
        torch.nn.init.zeros_(learner.actor.mean[-1].weight)  # so that actions are noise alone
    envs = population.make_envs(args, 0, learners)
    next_obs, _ = envs.reset(seed=seeds_of(args))
    for _ in range(2):
        rollouts = population.rollout(args, learners, envs, next_obs)
        next_obs = np.concatenate([r.next_obs for r in rollouts])
    for i, (run, learner) in enumerate(zip(args.runs, alone, strict=True)):
        theirs = ppo_reg.make_envs(run, 0, learner.stats)
        next_obs, _ = theirs.reset(seed=ppo_reg.env_seeds(run, 0))
        for _ in range(2):
            data = ppo_reg.rollout(run, learner, theirs, next_obs)
            next_obs = data.next_obs
        assert data.returns, "some episodes ended"
        for name, value in data._asdict().items():
            ours = getattr(rollouts[i], name)
            if name in ("values", "next_values"):
                torch.testing.assert_close(ours, value, rtol=0, atol=1e-6)
            elif isinstance(value, torch.Tensor):
                assert torch.equal(ours, value), name
            else:
                np.testing.assert_array_equal(ours, value)
        for stream in ("init", "action", "minibatch"):
            states = [x.generators[stream].get_state() for x in (learners[i], learner)]
            assert torch.equal(*states)


def test_actions_are_those_of_each_agents_own_policy():
    args = arguments(env_id="test/Drift-v0")
    learners, alone = learners_of(args), learners_of(args)
    envs = population.make_envs(args, 0, learners)
    next_obs, _ = envs.reset(seed=seeds_of(args))
    rollouts = population.rollout(args, learners, envs, next_obs)
    for data, learner in zip(rollouts, alone, strict=True):
        with torch.no_grad():
            mean = learner.actor.mean(data.obs)
            noise = torch.randn(data.actions.shape, generator=learner.generators["action"])
        torch.testing.assert_close(data.actions, mean + noise, rtol=0, atol=1e-6)


def test_observations_and_actions_of_any_shape(tmp_path):
    class Square(Drift):
        observation_space = gym.spaces.Box(-1.0, 1.0, (2, 3), np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (2, 2), np.float32)

        def draw(self):
            return self.np_random.uniform(size=(2, 3)).astype(np.float32)

        def step(self, action):
            assert action.shape == (2, 2)
            return super().step(action)

    gym.register("test/PopulationSquare-v0", Square)
    args = arguments(tmp_path, env_id="test/PopulationSquare-v0", total_timesteps=64)
    assert ppo_reg_population.train(args)[2].actor.log_std.shape == (4,)


# --- files ---------------------------------------------------------------------------------------

RESUMABLE = {"checkpoint_interval": 2, "total_timesteps": 7 * 64}


def interrupt(args, monkeypatch, at_update: int) -> None:
    """Train until Ctrl-C comes in the middle of an update."""
    update = ppo_reg_population.update

    def stop(args, learners, rollouts):
        if learners[0].update == at_update:
            raise KeyboardInterrupt
        return update(args, learners, rollouts)

    with monkeypatch.context() as patch:
        patch.setattr(ppo_reg_population, "update", stop)
        with pytest.raises(KeyboardInterrupt):
            ppo_reg_population.train(args)


def check_same_runs(one, other, agents: int = 3) -> None:
    for agent in range(agents):
        rows = [without_speed(folder / f"a{agent}") for folder in (one, other)]
        assert rows[0] == rows[1]
        saved = [
            torch.load(folder / f"a{agent}" / "checkpoint.pt", weights_only=True)["learner"]
            for folder in (one, other)
        ]
        assert str(saved[0]) == str(saved[1])
        for network in ("actor", "critic"):
            for key, value in saved[0][network].items():
                assert torch.equal(value, saved[1][network][key])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"env_id": "HopperBulletEnv-v0", "log_spectrum": 3, "target_kl": 1e-4},
        {"env_id": "test/Drift-v0", "num_envs": 2, "total_timesteps": 14 * 64, "anneal_lr": True,
         "hidden_sizes": (33, 17), "perturb_obs": True},
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("at_update", [1, 5])
def test_a_resumed_population_is_bit_for_bit_the_undisturbed_one(
    tmp_path, monkeypatch, changes, at_update
):
    settings = {**RESUMABLE, **changes}
    undisturbed = ppo_reg_population.train(arguments(tmp_path / "x", **settings))
    interrupt(arguments(tmp_path / "y", **settings), monkeypatch, at_update)
    assert len(read_metrics(tmp_path / "y" / "a2")) == at_update
    resumed = ppo_reg_population.train(arguments(tmp_path / "y", resume=True, **settings))
    for one, other in zip(undisturbed, resumed, strict=True):
        check_close(one, other, 0.0)
    check_same_runs(tmp_path / "x", tmp_path / "y")


@pytest.mark.parametrize("saved_of", [0, 1, 2])
@pytest.mark.parametrize("at_update", [2, 4])
def test_a_population_killed_while_it_saves_goes_on_from_what_all_have(
    tmp_path, monkeypatch, saved_of, at_update
):
    undisturbed = arguments(tmp_path / "x", **RESUMABLE)
    ppo_reg_population.train(undisturbed)
    save = ppo_reg.save_checkpoint

    def stop(run, learner) -> None:
        if learner.update == at_update and run.agent == saved_of:
            raise KeyboardInterrupt
        save(run, learner)

    with monkeypatch.context() as patch:
        patch.setattr(ppo_reg, "save_checkpoint", stop)
        for resume in (False, True):  # the second attempt is killed as well
            with pytest.raises(KeyboardInterrupt):
                ppo_reg_population.train(arguments(tmp_path / "y", resume=resume, **RESUMABLE))
    ppo_reg_population.train(arguments(tmp_path / "y", resume=True, **RESUMABLE))
    check_same_runs(tmp_path / "x", tmp_path / "y")


def test_agents_at_different_updates_are_left_as_they_are(tmp_path):
    args = arguments(tmp_path, **RESUMABLE)
    ppo_reg_population.train(dataclasses.replace(args, num_agents=2))
    before = (tmp_path / "a0" / "checkpoint.pt").read_bytes()
    with pytest.raises(ppo_reg.RunError, match=r"at updates 7 \(agent 0\), 7 .*, 0 \(agent 2\)"):
        ppo_reg_population.train(dataclasses.replace(args, resume=True))
    assert (tmp_path / "a0" / "checkpoint.pt").read_bytes() == before


def test_either_program_goes_on_where_the_other_was_stopped(tmp_path, monkeypatch):
    """From single files to the population and back; as all is saved, only rounding tells."""
    settings = {**RESUMABLE, "env_id": "test/Drift-v0"}
    whole, parts = arguments(tmp_path / "x", **settings), arguments(tmp_path / "y", **settings)
    undisturbed = [ppo_reg.train(run) for run in whole.runs]
    update = ppo_reg.update

    def stop(args, learner, data):
        if learner.update == 2:
            raise KeyboardInterrupt
        return update(args, learner, data)

    with monkeypatch.context() as patch:
        patch.setattr(ppo_reg, "update", stop)
        for run in parts.runs:
            with pytest.raises(KeyboardInterrupt):
                ppo_reg.train(run)
    interrupt(dataclasses.replace(parts, resume=True), monkeypatch, 4)
    runs = dataclasses.replace(parts, resume=True).runs
    for i, (run, expected) in enumerate(zip(runs, undisturbed, strict=True)):
        learner = ppo_reg.train(run)
        check_close(learner, expected, 1e-4)
        rows = [read_metrics(tmp_path / x / f"a{i}") for x in "xy"]
        assert [list(row) for row in rows[0]] == [list(row) for row in rows[1]]
        for one, other in zip(*rows, strict=True):
            one, other = (
                {k: float(v) for k, v in x.items() if "SPS" not in k} for x in (one, other)
            )
            assert one == pytest.approx(other, abs=1e-3, rel=1e-3, nan_ok=True)


def test_a_run_directory_has_the_layout_of_a_single_run(tmp_path):
    args = arguments(tmp_path / "x", log_spectrum=2)
    ppo_reg_population.train(args)
    run = dataclasses.replace(args.runs[1], run_dir=tmp_path / "alone")
    ppo_reg.train(run)
    ours, theirs = tmp_path / "x" / "a1", tmp_path / "alone"
    names = [sorted(x.name.split(".")[0] for x in path.iterdir()) for path in (ours, theirs)]
    assert names[0] == names[1]
    assert [list(row) for row in read_metrics(ours)] == [list(row) for row in read_metrics(theirs)]
    saved = [torch.load(path / "checkpoint.pt", weights_only=True) for path in (ours, theirs)]
    assert saved[0]["args"] == saved[1]["args"]
    assert saved[0]["metrics_size"] == (ours / "metrics.csv").stat().st_size
    sizes = [(path / "checkpoint.pt").stat().st_size for path in (ours, theirs)]
    assert sizes[0] == pytest.approx(sizes[1], abs=100)
    events = [EventAccumulator(str(path)).Reload() for path in (ours, theirs)]
    assert events[0].Tags() == events[1].Tags()
    psi = [e.value for e in events[0].Scalars("conditioning/psi")]
    assert psi == pytest.approx([float(r["conditioning/psi"]) for r in read_metrics(ours)])


def test_a_finished_population_stays_as_it_is(tmp_path, capsys):
    ppo_reg_population.train(arguments(tmp_path))
    files = [
        tmp_path / f"a{i}" / name for i in range(3) for name in ("metrics.csv", "checkpoint.pt")
    ]
    before = [file.read_bytes() for file in files]
    learners = ppo_reg_population.train(arguments(tmp_path, resume=True))
    assert before == [file.read_bytes() for file in files]
    assert "finished" in capsys.readouterr().out
    assert len(learners) == 3


def test_the_global_random_state_is_left_alone(tmp_path):
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    ppo_reg_population.train(arguments(tmp_path, perturb_obs=True))
    assert torch.equal(torch.get_rng_state(), torch_before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


def test_videos_of_every_agent_have_a_folder_of_their_own(tmp_path):
    args = arguments(tmp_path, capture_video=True)
    assert [run.path for run in args.runs] == [tmp_path / f"a{i}" for i in range(3)]
    assert all(run.capture_video for run in args.runs)


# --- the file as a program -----------------------------------------------------------------------


def start(folder, *flags: str) -> subprocess.Popen:
    """The program, copied beside the single file into a folder that holds nothing else."""
    for module in (population, ppo_reg, ppo_reg_population):
        shutil.copy(module.__file__, folder)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = [sys.executable, "ppo_reg_population.py", *FLAGS, "--num-agents=2", *flags]
    with open(folder / "log.txt", "w") as log:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)


def test_it_runs_when_copied_beside_the_single_file(tmp_path):
    assert start(tmp_path, "--total-timesteps=128").wait() == 0, (tmp_path / "log.txt").read_text()
    assert "update 2/2" in (tmp_path / "log.txt").read_text()
    for agent in range(2):
        assert len(read_metrics(tmp_path / f"runs/Pendulum-v1__ppo_reg__s1__a{agent}")) == 2


def test_a_killed_process_continues_as_if_undisturbed(tmp_path):
    flags = ("--total-timesteps=1280", "--resume")
    process = start(tmp_path, "--run-dir=killed/a{agent}", *flags)
    while not (tmp_path / "killed" / "a1" / "checkpoint.pt").exists():
        assert process.poll() is None, (tmp_path / "log.txt").read_text()
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert len(read_metrics(tmp_path / "killed" / "a0")) < 20
    for folder in ("killed", "undisturbed"):
        assert start(tmp_path, f"--run-dir={folder}/a{{agent}}", *flags).wait() == 0
    check_same_runs(tmp_path / "killed", tmp_path / "undisturbed", agents=2)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--num-agents", "0"], "num_agents must be at least 1, got 0"),
        (["--run-dir", "results"], "run_dir must hold {agent}, a folder for each, got results"),
        (["--track"], "track follows one run: train agents singly, by ppo_reg.py"),
        (["--gamma", "1.5"], "gamma must be in [0, 1], got 1.5"),
        (["--coefficient", "-1"], "coefficient must be finite and at least 0, got -1.0"),
        (["--env-id", "Hoper-v0"], "Hoper"),
        (["--env-id", "CartPole-v1"], "a task with a Box of actions"),
    ],
)
def test_bad_flags_are_refused_by_name(monkeypatch, capsys, tmp_path, flags, message):
    check_refusal(ppo_reg_population, flags, message, monkeypatch, capsys, tmp_path)


def test_one_agent_needs_no_placeholder(tmp_path):
    args = ppo_reg_population.Args(num_agents=1, agent=3, run_dir=tmp_path)
    assert [run.path for run in args.runs] == [tmp_path]
    assert (
        ppo_reg_population.Args(num_agents=2).runs[1].path.name
        == "HopperBulletEnv-v0__ppo_reg__s1__a1"
    )


@pytest.mark.slow
def test_the_default_update_is_that_of_the_single_file():
    """400 steps of each network on 2000 states: what rounding makes of it stays below 1e-5."""
    args = ppo_reg_population.Args(num_agents=3)
    learners, rollouts = recorded(args)
    alone = copy.deepcopy(learners)
    ppo_reg_population.update(args, learners, rollouts)
    for i, run in enumerate(args.runs):
        ppo_reg.update(run, alone[i], rollouts[i])
        check_close(learners[i], alone[i], 1e-5)


@pytest.mark.slow
def test_it_learns(tmp_path):
    """An inverted pendulum is balanced for most of its 1000 steps; a random policy holds it ~30."""
    env_id, path = "InvertedPendulumBulletEnv-v0", tmp_path / "a{agent}"
    ppo_reg_population.train(
        ppo_reg_population.Args(env_id=env_id, total_timesteps=60_000, num_agents=3, run_dir=path)
    )
    for agent in range(3):
        rows = read_metrics(tmp_path / f"a{agent}")
        assert float(rows[0]["charts/episodic_return"]) < 100
        assert float(rows[-1]["charts/episodic_return"]) > 500
