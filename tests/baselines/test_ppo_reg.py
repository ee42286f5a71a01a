"""The PPO baseline: its mathematics, and the promises that its docstring makes."""

from __future__ import annotations

import ast
import csv
import importlib.util
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.utils import RunningMeanStd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines import ppo_reg
from baselines.ppo_reg import Args, NormalizeObservation, Rollout, RunError, gae, policy_loss, train

FILE = Path(ppo_reg.__file__)
SMALL = {"num_steps": 64, "num_minibatches": 4, "update_epochs": 2, "vf_epochs": 2}


class Count(gym.Env):
    """Shows how many steps have been taken; ends in the ways it is told to."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, terminate_at: float = math.inf, truncate_at: float = math.inf) -> None:
        self.terminate_at, self.truncate_at = terminate_at, truncate_at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._obs(), {}

    def step(self, action):
        self.count += 1
        ended = self.count >= self.terminate_at, self.count >= self.truncate_at
        return self._obs(), 1.0, *ended, {}

    def _obs(self):
        return np.array([self.count], np.float32)


def pendulum(path: Path, **changes) -> Args:
    return Args(
        **{"env_id": "Pendulum-v1", "total_timesteps": 320, "run_dir": path, **SMALL, **changes}
    )


def read_metrics(path: Path) -> list[dict[str, str]]:
    with open(path / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def without_speed(path: Path) -> list[dict[str, str]]:
    return [{k: v for k, v in row.items() if k != "charts/SPS"} for row in read_metrics(path)]


def weights(learner) -> torch.Tensor:
    parameters = [*learner.actor.parameters(), *learner.critic.parameters()]
    return torch.cat([p.detach().flatten() for p in parameters])


def load_module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def make_rollout(rewards, values, next_values, dones) -> Rollout:
    columns = [torch.tensor(x, dtype=torch.float32)[:, None] for x in (rewards, dones)]
    values, next_values = (
        torch.tensor(x, dtype=torch.float32)[:, None] for x in (values, next_values)
    )
    return Rollout(None, None, *columns, values, next_values, None, [], [])


# --- mathematics ---------------------------------------------------------------------------------


def test_gae_by_hand():
    # gamma = lambda = 0.5; the second step ends the episode, so nothing flows back over it
    data = make_rollout([1.0, 2.0, 3.0], [0.5, 1.0, 1.5], [1.0, 0.0, 4.0], [0.0, 1.0, 0.0])
    # d = [1 + 0.5 - 0.5, 2 + 0 - 1, 3 + 2 - 1.5] = [1, 1, 3.5]; A_0 = 1 + 0.25 · 1
    assert gae(data, 0.5, 0.5).flatten().tolist() == [1.25, 1.0, 3.5]


def test_gae_with_lambda_1_is_the_discounted_return_minus_the_value():
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=20), rng.normal(size=21)
    data = make_rollout(rewards, values[:-1], values[1:], np.zeros(20))
    returns = [
        sum(0.9 ** (k - t) * rewards[k] for k in range(t, 20)) + 0.9 ** (20 - t) * values[20]
        for t in range(20)
    ]
    expected = torch.tensor(np.array(returns) - values[:-1])
    torch.testing.assert_close(gae(data, 0.9, 1.0).flatten().double(), expected, atol=1e-5, rtol=0)


def test_policy_loss_by_hand():
    # advantages [1, -1] are normalized to ±1/√2; ratios 1.5 and 0.5, clipped to 1.2 and 0.8
    logratio, advantages = torch.tensor([1.5, 0.5]).log(), torch.tensor([1.0, -1.0])
    loss, kl, clipfrac = policy_loss(logratio, advantages, 0.2)
    assert loss.item() == pytest.approx(-(1.2 - 0.8) / math.sqrt(2) / 2, rel=1e-6)
    assert kl.item() == pytest.approx(-(math.log(1.5) + math.log(0.5)) / 2, rel=1e-6)
    assert clipfrac.item() == 1.0


def test_policy_gradient_at_ratio_1_is_that_of_the_plain_objective():
    logratio = torch.zeros(8, requires_grad=True)
    advantages = torch.randn(8, generator=torch.Generator().manual_seed(0))
    policy_loss(logratio, advantages, 0.2)[0].backward()
    normalized = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    torch.testing.assert_close(logratio.grad, -normalized / 8)


# --- environments --------------------------------------------------------------------------------


def count_rollout(num_steps: int = 5, **ends) -> Rollout:
    """A rollout of one Count environment under a critic that says: the value is the count."""
    envs = SyncVectorEnv([lambda: Count(**ends)], autoreset_mode=AutoresetMode.SAME_STEP)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    args = Args(env_id="Pendulum-v1", num_steps=num_steps, num_minibatches=1)
    learner = ppo_reg.Learner(Args(env_id="MountainCarContinuous-v0"))
    learner.actor = ppo_reg.Actor(args, 1, 1, torch.Generator())
    learner.critic = torch.nn.Linear(1, 1, bias=False)
    torch.nn.init.ones_(learner.critic.weight)
    next_obs, _ = envs.reset(seed=0)
    return ppo_reg.rollout(args, learner, envs, next_obs)


def test_a_truncated_episode_bootstraps_from_its_final_observation():
    data = count_rollout(truncate_at=3)
    assert data.obs.flatten().tolist() == [0, 1, 2, 0, 1]
    assert data.dones.flatten().tolist() == [0, 0, 1, 0, 0]
    assert data.next_values.flatten().tolist() == [1, 2, 3, 1, 2]


def test_a_terminated_episode_does_not_bootstrap():
    data = count_rollout(terminate_at=3)
    assert data.next_values.flatten().tolist() == [1, 2, 0, 1, 2]
    assert data.returns == [3.0]
    assert data.lengths == [3]


def test_termination_wins_over_truncation():
    data = count_rollout(terminate_at=3, truncate_at=3)
    assert data.next_values.flatten().tolist() == [1, 2, 0, 1, 2]


def normalized_counts(update: bool = True) -> tuple[NormalizeObservation, RunningMeanStd]:
    envs = SyncVectorEnv(
        [lambda: Count(truncate_at=3), lambda: Count()], autoreset_mode=AutoresetMode.SAME_STEP
    )
    rms = RunningMeanStd(shape=(1,))
    return NormalizeObservation(envs, rms, update=update), rms


def test_normalization_is_by_the_mean_and_variance_of_all_that_was_shown():
    envs, rms = normalized_counts()
    seen = [np.zeros((2, 1))]
    envs.reset(seed=0)
    for _ in range(5):
        obs, *_ = envs.step(np.zeros((2, 1), np.float32))
        raw = obs * np.sqrt(rms.var + 1e-8) + rms.mean
        seen.append(raw)
    everything = np.concatenate(seen)
    np.testing.assert_allclose(rms.mean, everything.mean(0), rtol=1e-3)
    np.testing.assert_allclose(rms.var, everything.var(0), rtol=1e-3)
    assert obs.dtype == np.float32


def test_normalization_maps_final_obs():
    envs, rms = normalized_counts(update=False)
    rms.mean[:], rms.var[:] = 1.0, 4.0
    envs.reset(seed=0)
    for _ in range(3):
        obs, *_, info = envs.step(np.zeros((2, 1), np.float32))
    assert info["final_obs"][0].item() == pytest.approx((3 - 1) / 2)
    assert obs.flatten().tolist() == pytest.approx([(0 - 1) / 2, (3 - 1) / 2])


def test_frozen_statistics_stay():
    envs, rms = normalized_counts(update=False)
    envs.reset(seed=0)
    envs.step(np.zeros((2, 1), np.float32))
    assert (rms.mean.item(), rms.var.item()) == (0.0, 1.0)


def test_observations_are_clipped():
    envs, _ = normalized_counts(update=False)
    assert envs.normalize(np.array([[1e6]])).item() == 10.0


def test_the_critic_and_the_policy_see_perturbed_observations_and_the_statistics_clean_ones(
    tmp_path,
):
    stats_plain, stats_perturbed = {}, {}
    args = pendulum(tmp_path)
    plain = ppo_reg.make_envs(args, 0, stats_plain)
    perturbed = ppo_reg.make_envs(pendulum(tmp_path, perturb_obs=True), 0, stats_perturbed)
    seeds = ppo_reg.env_seeds(args, 0)
    obs, _ = plain.reset(seed=seeds)
    noisy, info = perturbed.reset(seed=seeds)
    np.testing.assert_array_equal(info["clean_obs"], obs)
    assert 0 < np.linalg.norm(noisy - obs) <= 1 + 1e-6
    np.testing.assert_array_equal(stats_plain["obs_rms"].mean, stats_perturbed["obs_rms"].mean)


def test_actions_of_any_shape_are_taken(tmp_path):
    class Square(Count):
        action_space = gym.spaces.Box(-1.0, 1.0, (2, 2), np.float32)

        def step(self, action):
            assert action.shape == (2, 2)
            return super().step(action)

    gym.register("test/Square-v0", Square)
    learner = train(pendulum(tmp_path, env_id="test/Square-v0", total_timesteps=64))
    assert learner.actor.log_std.shape == (4,)


def test_observations_of_any_shape_are_flattened(tmp_path):
    gym.register(
        "test/Image-v0", lambda: gym.wrappers.ReshapeObservation(Count(truncate_at=9), (1, 1))
    )
    train(pendulum(tmp_path, env_id="test/Image-v0", total_timesteps=64))
    assert len(read_metrics(tmp_path)) == 1


# --- the regularizer -----------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "HopperBulletEnv-v0"])
def test_coefficient_0_is_the_file_without_its_condwrap_lines(tmp_path, env_id):
    kept = [line for line in FILE.read_text().splitlines() if "# condwrap" not in line]
    plain_file = tmp_path / "plain_ppo.py"
    plain_file.write_text("\n".join(kept))
    names = {
        node.id
        for node in ast.walk(ast.parse(plain_file.read_text()))
        if isinstance(node, ast.Name)
    }
    assert "ConditioningRegularizer" not in names
    plain = load_module(plain_file)
    changes = {"env_id": env_id, **SMALL, "total_timesteps": 320}
    ours = train(Args(**changes, coefficient=0.0, run_dir=tmp_path / "ours"))
    theirs = plain.train(plain.Args(**changes, run_dir=tmp_path / "plain"))
    assert torch.equal(weights(ours), weights(theirs))
    plain_rows = without_speed(tmp_path / "plain")
    shared = [{k: row[k] for k in plain_rows[0]} for row in read_metrics(tmp_path / "ours")]
    assert shared == plain_rows
    assert len(plain_rows) == 5


def test_the_penalty_changes_the_policy(tmp_path):
    plain = train(pendulum(tmp_path / "plain", coefficient=0.0))
    regularized = train(pendulum(tmp_path / "reg", coefficient=1.0))
    assert not torch.equal(weights(plain), weights(regularized))


def test_a_strong_penalty_brings_the_policy_into_range(tmp_path):
    psi = {}
    for coefficient in (0.0, 10.0):
        path = tmp_path / str(coefficient)
        train(pendulum(path, coefficient=coefficient, update_epochs=20, learning_rate=3e-3))
        psi[coefficient] = float(read_metrics(path)[-1]["conditioning/psi"])
    assert psi[10.0] < psi[0.0] / 4


def test_a_regularized_run_and_its_plain_twin_see_the_same_noise(tmp_path):
    args = [pendulum(tmp_path / str(c), coefficient=c, total_timesteps=64) for c in (0.0, 0.5)]
    learners = [train(a) for a in args]
    rows = [read_metrics(a.path)[0] for a in args]
    assert rows[0]["charts/episodic_return"] == rows[1]["charts/episodic_return"]
    for stream in ("action", "minibatch"):
        assert torch.equal(*[learner.generators[stream].get_state() for learner in learners])
    assert torch.equal(*[learner.probe.generator.get_state() for learner in learners])
    assert not torch.equal(*[learner.regularizer.generator.get_state() for learner in learners])


@pytest.mark.parametrize("coefficient", [0.0, 1e-3])
def test_psi_is_measured_once_per_update_on_the_new_policy_and_the_whole_rollout(
    tmp_path, monkeypatch, coefficient
):
    measured = []
    measure = ppo_reg.measure_conditioning

    def spy(args, learner, obs):
        logs = measure(args, learner, obs)
        measured.append((obs.shape[0], weights(learner), logs))
        return logs

    monkeypatch.setattr(ppo_reg, "measure_conditioning", spy)
    learner = train(pendulum(tmp_path, coefficient=coefficient, total_timesteps=128))
    assert [count for count, *_ in measured] == [64, 64]
    assert torch.equal(measured[-1][1], weights(learner))
    row = read_metrics(tmp_path)[-1]
    assert float(row["conditioning/psi"]) == measured[-1][2]["conditioning/psi"]
    low, median, high = (float(row[f"conditioning/quotient_q{q}"]) for q in ("05", "50", "95"))
    assert 0 <= low <= median <= high
    assert 0 <= float(row["conditioning/fraction_below"]) <= 1
    assert float(row["conditioning/fraction_above"]) == 0.0


# --- seeds ---------------------------------------------------------------------------------------


def test_a_seed_and_an_agent_decide_everything(tmp_path):
    first = train(pendulum(tmp_path / "a"))
    torch.rand(7), np.random.rand(7)  # noqa: NPY002  whatever the global generators do
    again = train(pendulum(tmp_path / "b"))
    other_agent = train(pendulum(tmp_path / "c", agent=1))
    assert torch.equal(weights(first), weights(again))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")
    assert not torch.equal(weights(first), weights(other_agent))


def test_the_global_random_state_is_left_alone(tmp_path):
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    train(pendulum(tmp_path, perturb_obs=True))
    assert torch.equal(torch.get_rng_state(), torch_before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


def test_every_stream_is_different():
    args = [Args(seed=s, agent=a) for s, a in ((1, 0), (0, 1), (1, 1))]
    seeds = [tuple(ppo_reg.env_seeds(a, checkpoint)) for a in args for checkpoint in range(3)]
    learners = [ppo_reg.Learner(a) for a in args]
    generators = [g for learner in learners for g in learner.generators.values()]
    generators += [
        x.generator for learner in learners for x in (learner.regularizer, learner.probe)
    ]
    assert len(set(seeds)) == 9
    assert len({g.initial_seed() for g in generators}) == 15


# --- checkpoints ---------------------------------------------------------------------------------


def interrupted(args: Args, monkeypatch, at_update: int) -> None:
    """Train until Ctrl-C comes in the middle of an update."""
    update = ppo_reg.update

    def stop(args, learner, data):
        if learner.update == at_update:
            raise KeyboardInterrupt
        return update(args, learner, data)

    with monkeypatch.context() as patch:
        patch.setattr(ppo_reg, "update", stop)
        with pytest.raises(KeyboardInterrupt):
            train(args)


RESUMABLE = {"checkpoint_interval": 2, "total_timesteps": 7 * 64, "num_envs": 1}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"perturb_obs": True, "anneal_lr": True},
        {"num_envs": 2},
        {"env_id": "HopperBulletEnv-v0", "log_spectrum": 3},
    ],
)
@pytest.mark.parametrize("at_update", [1, 5])
def test_a_resumed_run_is_bit_for_bit_the_undisturbed_one(
    tmp_path, monkeypatch, changes, at_update
):
    settings = {**RESUMABLE, **changes}
    settings["total_timesteps"] *= settings["num_envs"]
    undisturbed = train(pendulum(tmp_path / "a", **settings))
    interrupted(pendulum(tmp_path / "b", **settings), monkeypatch, at_update)
    assert len(read_metrics(tmp_path / "b")) == at_update
    resumed = train(pendulum(tmp_path / "b", resume=True, **settings))
    assert torch.equal(weights(undisturbed), weights(resumed))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")


def test_a_finished_run_stays_as_it_is(tmp_path):
    train(pendulum(tmp_path))
    before = (tmp_path / "metrics.csv").read_bytes(), (tmp_path / "checkpoint.pt").read_bytes()
    train(pendulum(tmp_path, resume=True))
    assert before == (
        (tmp_path / "metrics.csv").read_bytes(),
        (tmp_path / "checkpoint.pt").read_bytes(),
    )


def test_a_torn_checkpoint_falls_back_on_the_one_before_it(tmp_path, capsys):
    undisturbed = train(pendulum(tmp_path / "a", **RESUMABLE))
    train(pendulum(tmp_path / "b", **RESUMABLE))
    checkpoint = tmp_path / "b" / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    resumed = train(pendulum(tmp_path / "b", resume=True, **RESUMABLE))
    assert "cannot be read" in capsys.readouterr().out
    assert torch.equal(weights(undisturbed), weights(resumed))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")


def test_a_run_without_a_readable_checkpoint_is_not_overwritten(tmp_path):
    train(pendulum(tmp_path))
    (tmp_path / "checkpoint.pt").write_bytes(b"torn")
    with pytest.raises(RunError, match="no readable checkpoint"):
        train(pendulum(tmp_path, resume=True))


def test_a_run_is_not_overwritten_by_another(tmp_path):
    train(pendulum(tmp_path))
    with pytest.raises(RunError, match="holds a run"):
        train(pendulum(tmp_path))
    with pytest.raises(RunError, match=r"was run with gamma=0\.99, not 0\.9"):
        train(pendulum(tmp_path, resume=True, gamma=0.9))


def test_lost_rows_are_noticed(tmp_path, monkeypatch):
    interrupted(pendulum(tmp_path, **RESUMABLE), monkeypatch, at_update=3)
    (tmp_path / "metrics.csv").unlink()
    with pytest.raises(RunError, match="lacks rows"):
        train(pendulum(tmp_path, resume=True, **RESUMABLE))


def test_tensorboard_has_what_metrics_csv_has_after_a_resume(tmp_path, monkeypatch):
    interrupted(pendulum(tmp_path, **RESUMABLE), monkeypatch, at_update=5)
    train(pendulum(tmp_path, resume=True, **RESUMABLE))
    train(pendulum(tmp_path, resume=True, **RESUMABLE))
    events = EventAccumulator(str(tmp_path)).Reload().Scalars("conditioning/psi")
    rows = read_metrics(tmp_path)
    assert [e.step for e in events] == [int(row["global_step"]) for row in rows]
    assert [e.value for e in events] == pytest.approx([float(r["conditioning/psi"]) for r in rows])


def test_a_checkpoint_holds_nothing_but_weights_and_numbers(tmp_path):
    train(pendulum(tmp_path))
    content = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert content["args"]["env_id"] == "Pendulum-v1"
    assert content["learner"]["obs_rms"]["mean"].dtype == torch.float64
    assert content["metrics_size"] == (tmp_path / "metrics.csv").stat().st_size


def test_a_malicious_checkpoint_is_not_executed(tmp_path):
    class Exploit:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    torch.save({"args": Exploit()}, tmp_path / "checkpoint.pt")
    with pytest.raises(RunError, match="no readable checkpoint"):
        train(pendulum(tmp_path, resume=True))
    assert not (tmp_path / "executed").exists()


def test_episodes_in_progress_at_a_checkpoint_are_bootstrapped_not_terminated(tmp_path):
    """Pendulum's episodes last 200 steps: rebuilt each 64, none ends, and none counts."""
    train(pendulum(tmp_path, checkpoint_interval=1))
    assert all(math.isnan(float(row["charts/episodic_return"])) for row in read_metrics(tmp_path))


# --- the file as a program -----------------------------------------------------------------------

FLAGS = ["--env-id=Pendulum-v1", "--num-steps=64", "--num-minibatches=4", "--checkpoint-interval=2"]


class Program:
    """A copy of the file, run alone in a folder, its output in a log."""

    def __init__(self, folder: Path, *flags: str, **kwargs) -> None:
        copy = shutil.copy(FILE, folder)
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        self.log = folder / "log.txt"
        with open(self.log, "w") as log:
            self.process = subprocess.Popen(
                [sys.executable, copy, *FLAGS, *flags],
                cwd=folder, env=environment, stdout=log, stderr=log, **kwargs,
            )  # fmt: skip

    def wait(self) -> str:
        self.process.wait()
        return self.log.read_text()

    def kill_after_checkpoint(self, run: Path, kill: int) -> str:
        while not (run / "checkpoint.pt").exists():
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.02)
        self.process.send_signal(kill)
        return self.wait()


def test_it_runs_when_copied_alone_into_an_empty_folder(tmp_path):
    program = Program(tmp_path, "--total-timesteps=128")
    output = program.wait()
    assert program.process.returncode == 0, output
    run = tmp_path / "runs" / "Pendulum-v1__ppo_reg__s1__a0"
    assert len(read_metrics(run)) == 2
    assert "update 2/2" in output
    assert list(run.glob("events.out.tfevents.*"))


@pytest.mark.parametrize("kill", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_killed_process_continues_as_if_undisturbed(tmp_path, kill):
    program = Program(tmp_path, "--total-timesteps=1280", "--run-dir=killed")
    output = program.kill_after_checkpoint(tmp_path / "killed", kill)
    assert program.process.returncode != 0
    assert ("--resume continues" in output) == (kill != signal.SIGKILL)
    assert len(read_metrics(tmp_path / "killed")) < 20
    for folder in ("killed", "undisturbed"):
        program = Program(tmp_path, "--total-timesteps=1280", f"--run-dir={folder}", "--resume")
        assert "update 20/20" in program.wait()
    assert without_speed(tmp_path / "killed") == without_speed(tmp_path / "undisturbed")


def test_a_full_disk_loses_nothing(tmp_path):
    flags = ("--total-timesteps=1280", "--run-dir=full", "--resume")
    Program(tmp_path, *flags).kill_after_checkpoint(tmp_path / "full", signal.SIGKILL)
    before = (tmp_path / "full" / "checkpoint.pt").read_bytes()

    def leave_room_for_half_a_checkpoint() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2,) * 2)

    program = Program(tmp_path, *flags, preexec_fn=leave_room_for_half_a_checkpoint)
    assert "File too large" in program.wait()
    assert program.process.returncode != 0
    assert (tmp_path / "full" / "checkpoint.pt").read_bytes() == before
    assert "update 20/20" in Program(tmp_path, *flags).wait()
    assert len(read_metrics(tmp_path / "full")) == 20


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--gamma", "1.5"], "gamma must be in [0, 1], got 1.5"),
        (["--hidden-sizes", "0"], "hidden_sizes must be at least 1"),
        (["--seed", "-1"], "seed must be at least 0, got -1"),
        (["--env-id", "Hoper-v0"], "Hoper"),
        (["--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["--num-minibatches", "7"], "num_minibatches must divide num_envs * num_steps = 2000"),
        (["--total-timesteps", "10"], "total_timesteps must be at least"),
        (["--coefficient", "-1"], "coefficient must be finite and at least 0, got -1.0"),
        (["--lambda-min", "30"], "lambda_min=30.0 and lambda_max=20.0"),
        (["--perturbation", "cube"], "perturbation must be one of"),
        (["--env-id", "CartPole-v1"], "a task with a Box of actions"),
    ],
)
def test_bad_flags_are_refused_by_name(monkeypatch, capsys, tmp_path, flags, message):
    monkeypatch.setattr(sys, "argv", ["ppo_reg.py", *flags])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        ppo_reg.main()
    captured = capsys.readouterr()
    said = " ".join(f"{captured.out} {captured.err} {stopped.value}".replace("│", " ").split())
    assert message in said
    assert stopped.value.code != 0


def test_target_kl_ends_the_policys_epochs(tmp_path):
    one_epoch = train(pendulum(tmp_path / "a", update_epochs=1))
    stopped = train(pendulum(tmp_path / "b", update_epochs=2, target_kl=1e-9))
    assert torch.equal(weights(one_epoch), weights(stopped))


@pytest.mark.slow
def test_it_learns(tmp_path):
    """An inverted pendulum is balanced for most of its 1000 steps; a random policy holds it ~30."""
    train(Args(env_id="InvertedPendulumBulletEnv-v0", total_timesteps=60_000, run_dir=tmp_path))
    rows = read_metrics(tmp_path)
    assert float(rows[0]["charts/episodic_return"]) < 100
    assert float(rows[-1]["charts/episodic_return"]) > 500


@pytest.mark.slow
def test_videos_are_recorded(tmp_path):
    changes = {"env_id": "ReacherBulletEnv-v0", "num_steps": 200, "total_timesteps": 200}
    train(pendulum(tmp_path, **changes, capture_video=True))
    assert any(v.stat().st_size > 1000 for v in (tmp_path / "videos").glob("*.mp4"))
