"""What holds for every baseline alike: the regularizer, seeds, checkpoints, the program."""

from __future__ import annotations

import ast
import dataclasses
import json
import math
import resource
import signal
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines import ppo_reg, ppo_reg_coinrun, trpo_reg
from condwrap.probe import ConditioningProbe
from tests.baselines.helpers import (
    ALL,
    BASELINES,
    FLAGS,
    OWN_FLAGS,
    Breaking,
    Program,
    check_refusal,
    flat,
    interrupted,
    load_module,
    name,
    pendulum,
    read_metrics,
    short_run,
    weights,
    without_speed,
)


def label(value) -> str | None:
    return name(value) if isinstance(value, ModuleType) else None


@pytest.fixture(params=BASELINES, ids=label)
def baseline(request):
    """A baseline for vectors of numbers."""
    return request.param


every_baseline = pytest.mark.parametrize("baseline", ALL, ids=label)


# --- the regularizer -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("baseline", "changes"),
    [
        *[(baseline, {}) for baseline in ALL],
        *[(baseline, {"env_id": "HopperBulletEnv-v0"}) for baseline in BASELINES],
        (ppo_reg_coinrun, {"network": "impala", "dropout": 0.5, "l2": 1e-4}),
    ],
    ids=label,
)
def test_coefficient_0_is_the_file_without_its_condwrap_lines(baseline, tmp_path, changes):
    code = Path(baseline.__file__).read_text()
    kept = [line for line in code.splitlines() if "# condwrap" not in line]
    plain_file = tmp_path / f"plain_{name(baseline)}.py"
    plain_file.write_text("\n".join(kept))
    names = {
        node.id
        for node in ast.walk(ast.parse(plain_file.read_text()))
        if isinstance(node, ast.Name)
    }
    assert not names & {"ConditioningArgs", "PenaltyArgs"}
    plain = load_module(plain_file)
    args = short_run(baseline, tmp_path / "ours", coefficient=0.0, **changes)
    known = {field.name: getattr(args, field.name) for field in dataclasses.fields(plain.Args)}
    ours = baseline.train(args)
    theirs = plain.train(plain.Args(**{**known, "run_dir": tmp_path / "plain"}))
    assert torch.equal(weights(ours), weights(theirs))
    plain_rows = without_speed(tmp_path / "plain")
    shared = [{k: row[k] for k in plain_rows[0]} for row in without_speed(tmp_path / "ours")]
    assert shared == plain_rows
    assert len(plain_rows) == 5


@every_baseline
def test_the_penalty_changes_the_policy(baseline, tmp_path):
    plain = baseline.train(short_run(baseline, tmp_path / "plain", coefficient=0.0))
    regularized = baseline.train(short_run(baseline, tmp_path / "reg", coefficient=1.0))
    assert not torch.equal(weights(plain), weights(regularized))


@every_baseline
def test_a_regularized_run_and_its_plain_twin_see_the_same_noise(baseline, tmp_path):
    args = [
        short_run(baseline, tmp_path / str(c), coefficient=c, total_timesteps=64)
        for c in (0.0, 0.5)
    ]
    learners = [baseline.train(a) for a in args]
    rows = [read_metrics(a.path)[0] for a in args]
    assert rows[0]["charts/episodic_return"] == rows[1]["charts/episodic_return"]
    for stream in learners[0].generators:
        assert torch.equal(*[learner.generators[stream].get_state() for learner in learners])
    assert torch.equal(*[learner.probe.yardstick.generator.get_state() for learner in learners])
    assert not torch.equal(*[learner.regularizer.generator.get_state() for learner in learners])


class Measured(NamedTuple):
    """A call of the probe: what it was given, its state before, and what it said."""

    update: int
    policy: Any
    obs: torch.Tensor
    state: dict[str, Any]
    metrics: dict[str, float]


@pytest.fixture
def measured(monkeypatch):
    """The calls of every probe, in turn."""
    calls = []
    measure = ConditioningProbe.measure

    def spy(self, update, policy, obs):
        state = self.state_dict()
        metrics = measure(self, update, policy, obs)
        calls.append(Measured(update, policy, obs.clone(), state, metrics))
        return metrics

    monkeypatch.setattr(ConditioningProbe, "measure", spy)
    return calls


@pytest.mark.parametrize("coefficient", [0.0, 1e-3])
@every_baseline
def test_psi_is_measured_once_an_update_on_the_new_policy(
    baseline, tmp_path, measured, coefficient
):
    args = short_run(baseline, tmp_path, coefficient=coefficient, total_timesteps=128)
    learner = baseline.train(args)
    rows = read_metrics(tmp_path)
    assert [call.update for call in measured] == [1, 2]
    steps = [int(row["global_step"]) for row in rows]  # those that count: CoinRun masks some
    assert [len(call.obs) for call in measured] == [steps[0], steps[1] - steps[0]]
    assert 120 <= steps[1] <= 128
    for row, call in zip(rows, measured, strict=True):
        logged = {name: float(row[name]) for name in call.metrics}
        assert logged == pytest.approx(call.metrics, rel=1e-12, nan_ok=True)

    # the policy that was measured last has the final weights, so it is measured the same now
    last = measured[-1]
    learner.probe.load_state_dict(last.state)
    assert learner.probe.measure(2, last.policy, last.obs) == last.metrics


def test_the_yardstick_is_the_papers_whatever_the_run_trains_with(baseline, tmp_path, measured):
    settings = {"lambda_min": 0.5, "lambda_max": 3.0, "radius": 0.1, "perturbation": "gaussian"}
    learner = baseline.train(pendulum(baseline, tmp_path, total_timesteps=64, **settings))
    (call,) = measured
    generator = torch.Generator()
    generator.set_state(call.state["yardstick"]["generator"])
    noise = torch.randn(call.obs.shape, generator=generator)
    delta = noise / noise.norm(dim=1, keepdim=True)
    with torch.no_grad():
        change = learner.actor.mean(call.obs + delta) - learner.actor.mean(call.obs)
    quotient = change.norm(dim=1)
    psi = (1 - quotient).relu().square() + (quotient - 20).relu().square()
    row = read_metrics(tmp_path)[0]
    assert float(row["conditioning/psi"]) == pytest.approx(psi.mean().item(), rel=1e-4)
    assert float(row["conditioning/own_psi"]) != pytest.approx(psi.mean().item(), rel=0.1)


def test_log_spectrum_2_logs_the_singular_values_of_every_second_policy(
    baseline, tmp_path, measured
):
    learner = baseline.train(
        pendulum(baseline, tmp_path, env_id="HopperBulletEnv-v0", log_spectrum=2)
    )
    rows = read_metrics(tmp_path)
    names = ("singular_value_max", "singular_value_mean", "condition_number")
    for row in rows[0::2]:
        assert all(math.isnan(float(row[f"conditioning/{name}"])) for name in names)
    for row in rows[1::2]:
        largest, mean, condition = (float(row[f"conditioning/{name}"]) for name in names)
        assert 0 < mean < largest < condition

    # the fifth is not due, so it is measured here, under the number of one that is
    last = measured[-1]
    found = learner.probe.measure(6, last.policy, last.obs)
    jacobians = torch.func.vmap(torch.func.jacrev(learner.actor.mean))(last.obs)  # [64, 3, 15]
    values = torch.linalg.svdvals(jacobians)
    expected = {
        "singular_value_max": values[:, 0].mean(),
        "singular_value_mean": values.mean(),
        "condition_number": (values[:, 0] / values[:, -1]).median(),
        "frobenius_squared_per_input": jacobians.square().sum((1, 2)).mean() / 15,
    }
    for key, value in expected.items():
        assert found[f"conditioning/{key}"] == pytest.approx(value.item(), rel=1e-3)


# --- seeds ---------------------------------------------------------------------------------------


@every_baseline
def test_a_seed_and_an_agent_decide_everything(baseline, tmp_path):
    first = baseline.train(short_run(baseline, tmp_path / "a"))
    torch.rand(7), np.random.rand(7)  # noqa: NPY002  whatever the global generators do
    again = baseline.train(short_run(baseline, tmp_path / "b"))
    other_agent = baseline.train(short_run(baseline, tmp_path / "c", agent=1))
    assert torch.equal(weights(first), weights(again))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")
    assert not torch.equal(weights(first), weights(other_agent))


@every_baseline
def test_the_global_random_state_is_left_alone(baseline, tmp_path):
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    changes = {} if baseline is ppo_reg_coinrun else {"perturb_obs": True}
    baseline.train(short_run(baseline, tmp_path, **changes))
    assert torch.equal(torch.get_rng_state(), torch_before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


@every_baseline
def test_every_stream_is_different(baseline, tmp_path):
    chosen = ((1, 0), (0, 1), (1, 1))
    args = [short_run(baseline, tmp_path, seed=s, agent=a) for s, a in chosen]
    seeds = [tuple(baseline.env_seeds(a, checkpoint)) for a in args for checkpoint in range(3)]
    learners = [baseline.Learner(a) for a in args]
    generators = [g for learner in learners for g in learner.generators.values()]
    for learner in learners:
        generators += [learner.regularizer.generator, learner.probe.yardstick.generator]
    assert len(set(seeds)) == 9
    assert len({g.initial_seed() for g in generators}) == len(generators) >= 15


# --- checkpoints ---------------------------------------------------------------------------------

RESUMABLE = {"checkpoint_interval": 2, "total_timesteps": 7 * 64, "num_envs": 1}
EVERY_BASELINE = [
    {},
    {"num_envs": 2},
    {"env_id": "HopperBulletEnv-v0", "log_spectrum": 3},
    {"hidden_sizes": (33, 17)},
]


def draw_from(agent, env, seed, rng):
    """Stands in for an evaluation: a rate that tells the agent, the seed and the noise."""
    noise = torch.rand((), generator=rng).item()
    return {"success": np.array([noise + seed + flat(agent).double().sum().item()])}


@pytest.mark.parametrize(
    ("baseline", "changes"),
    [
        *[(baseline, changes) for baseline in BASELINES for changes in EVERY_BASELINE],
        (ppo_reg, {"perturb_obs": True, "anneal_lr": True}),
        (trpo_reg, {"perturb_obs": True}),
        (ppo_reg_coinrun, {"num_envs": 2, "num_groups": 2, "dropout": 0.5, "network": "impala"}),
        (ppo_reg_coinrun, {"distribution_mode": "hard", "num_steps": 64, "eval_interval": 2}),
    ],
    ids=label,
)
@pytest.mark.parametrize("at_update", [1, 5])
def test_a_resumed_run_is_bit_for_bit_the_undisturbed_one(
    tmp_path, monkeypatch, baseline, changes, at_update
):
    monkeypatch.setattr(ppo_reg_coinrun, "play", draw_from)
    settings = {**RESUMABLE, **changes}
    settings["total_timesteps"] *= settings["num_envs"]
    undisturbed = baseline.train(short_run(baseline, tmp_path / "a", **settings))
    interrupted(baseline, short_run(baseline, tmp_path / "b", **settings), monkeypatch, at_update)
    assert len(read_metrics(tmp_path / "b")) == at_update
    resumed = baseline.train(short_run(baseline, tmp_path / "b", resume=True, **settings))
    assert torch.equal(weights(undisturbed), weights(resumed))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")


@every_baseline
def test_a_finished_run_stays_as_it_is(baseline, tmp_path):
    baseline.train(short_run(baseline, tmp_path))
    before = (tmp_path / "metrics.csv").read_bytes(), (tmp_path / "checkpoint.pt").read_bytes()
    baseline.train(short_run(baseline, tmp_path, resume=True))
    assert before == (
        (tmp_path / "metrics.csv").read_bytes(),
        (tmp_path / "checkpoint.pt").read_bytes(),
    )


@every_baseline
def test_a_torn_checkpoint_falls_back_on_the_one_before_it(baseline, tmp_path, capsys):
    undisturbed = baseline.train(short_run(baseline, tmp_path / "a", **RESUMABLE))
    baseline.train(short_run(baseline, tmp_path / "b", **RESUMABLE))
    checkpoint = tmp_path / "b" / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    resumed = baseline.train(short_run(baseline, tmp_path / "b", resume=True, **RESUMABLE))
    assert "cannot be read" in capsys.readouterr().out
    assert torch.equal(weights(undisturbed), weights(resumed))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")


@every_baseline
def test_a_run_without_a_readable_checkpoint_is_not_overwritten(baseline, tmp_path):
    baseline.train(short_run(baseline, tmp_path))
    (tmp_path / "checkpoint.pt").write_bytes(b"torn")
    with pytest.raises(baseline.RunError, match="no readable checkpoint"):
        baseline.train(short_run(baseline, tmp_path, resume=True))


@every_baseline
def test_a_run_is_not_overwritten_by_another(baseline, tmp_path):
    baseline.train(short_run(baseline, tmp_path))
    with pytest.raises(baseline.RunError, match="holds a run"):
        baseline.train(short_run(baseline, tmp_path))
    with pytest.raises(baseline.RunError, match=r"was run with gamma=0\.99\d?, not 0\.9$"):
        baseline.train(short_run(baseline, tmp_path, resume=True, gamma=0.9))


@every_baseline
def test_a_run_of_another_version_is_not_continued(baseline, tmp_path, monkeypatch):
    baseline.train(short_run(baseline, tmp_path))
    monkeypatch.setattr(baseline, "VERSION", 99)
    with pytest.raises(baseline.RunError, match="was run with VERSION=2, not 99"):
        baseline.train(short_run(baseline, tmp_path, resume=True))


@every_baseline
def test_lost_rows_are_noticed(baseline, tmp_path, monkeypatch):
    args = short_run(baseline, tmp_path, **RESUMABLE)
    interrupted(baseline, args, monkeypatch, at_update=3)
    (tmp_path / "metrics.csv").unlink()
    with pytest.raises(baseline.RunError, match="lacks rows"):
        baseline.train(short_run(baseline, tmp_path, resume=True, **RESUMABLE))


@every_baseline
def test_tensorboard_has_what_metrics_csv_has_after_a_resume(baseline, tmp_path, monkeypatch):
    args = short_run(baseline, tmp_path, **RESUMABLE)
    interrupted(baseline, args, monkeypatch, at_update=5)
    baseline.train(short_run(baseline, tmp_path, resume=True, **RESUMABLE))
    baseline.train(short_run(baseline, tmp_path, resume=True, **RESUMABLE))
    events = EventAccumulator(str(tmp_path)).Reload().Scalars("conditioning/psi")
    rows = read_metrics(tmp_path)
    assert [e.step for e in events] == [int(row["global_step"]) for row in rows]
    assert [e.value for e in events] == pytest.approx([float(r["conditioning/psi"]) for r in rows])


LONGER = {"total_timesteps": 6 * 64, "resume": True, "extend": True}


def test_an_extended_run_is_the_longer_run_bit_for_bit(baseline, tmp_path):
    every = {"checkpoint_interval": 2}
    whole = baseline.train(pendulum(baseline, tmp_path / "a", total_timesteps=6 * 64, **every))
    baseline.train(pendulum(baseline, tmp_path / "b", total_timesteps=4 * 64, **every))
    extended = baseline.train(pendulum(baseline, tmp_path / "b", **every, **LONGER))
    assert torch.equal(weights(whole), weights(extended))
    assert without_speed(tmp_path / "a") == without_speed(tmp_path / "b")


def test_a_run_that_ends_between_checkpoints_cannot_be_extended(baseline, tmp_path):
    every = {"checkpoint_interval": 2}
    baseline.train(pendulum(baseline, tmp_path, **every))
    before = (tmp_path / "metrics.csv").read_bytes()
    with pytest.raises(baseline.RunError, match="its 5 updates are not a multiple"):
        baseline.train(pendulum(baseline, tmp_path, **every, **LONGER))
    assert (tmp_path / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize("number", ["nan", "inf"])
@pytest.mark.parametrize("what", ["reward", "observation"])
def test_a_run_that_diverges_says_so_and_stops(baseline, tmp_path, monkeypatch, what, number):
    env_id = f"test/Breaking-{what}-{number}-v0"
    args = pendulum(baseline, tmp_path, env_id=env_id, checkpoint_interval=2)
    (seed,) = baseline.env_seeds(args, 1)  # that of updates 3 and 4
    monkeypatch.setattr(Breaking, "breaks", {seed: 64 + 10})
    with np.errstate(all="ignore"), pytest.raises(baseline.DivergedError, match=what):
        baseline.train(args)
    said = json.loads((tmp_path / "diverged.json").read_text())
    message = f"the {what} became non-finite in update 4"
    assert said == {"update": 4, "what": what, "message": message}
    assert len(read_metrics(tmp_path)) == 3
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert saved["learner"]["update"] == 2


def test_weights_that_become_non_finite_end_the_program_with_3(
    baseline, tmp_path, monkeypatch, capsys
):
    flags = [*FLAGS, *OWN_FLAGS[baseline], "--vf-coef=inf", "--total-timesteps=64"]
    monkeypatch.setattr("sys.argv", ["baseline.py", *flags, f"--run-dir={tmp_path}"])
    with pytest.raises(SystemExit) as stopped:
        baseline.main()
    assert stopped.value.code == 3
    assert "the loss became non-finite in update 1" in capsys.readouterr().out
    assert (tmp_path / "metrics.csv").read_text() == ""


def test_a_checkpoint_holds_nothing_but_weights_and_numbers(baseline, tmp_path):
    baseline.train(pendulum(baseline, tmp_path))
    content = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert content["args"]["env_id"] == "Pendulum-v1"
    assert content["learner"]["obs_rms"]["mean"].dtype == torch.float64
    assert content["metrics_size"] == (tmp_path / "metrics.csv").stat().st_size


@every_baseline
def test_a_malicious_checkpoint_is_not_executed(baseline, tmp_path):
    class Exploit:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    torch.save({"args": Exploit()}, tmp_path / "checkpoint.pt")
    with pytest.raises(baseline.RunError, match="no readable checkpoint"):
        baseline.train(short_run(baseline, tmp_path, resume=True))
    assert not (tmp_path / "executed").exists()


def test_episodes_in_progress_at_a_checkpoint_are_bootstrapped_not_terminated(baseline, tmp_path):
    """Pendulum's episodes last 200 steps: rebuilt each 64, none ends, and none counts."""
    baseline.train(pendulum(baseline, tmp_path, checkpoint_interval=1))
    assert all(math.isnan(float(row["charts/episodic_return"])) for row in read_metrics(tmp_path))


# --- the file as a program -----------------------------------------------------------------------


@every_baseline
def test_it_runs_when_copied_alone_into_an_empty_folder(baseline, tmp_path):
    program = Program(baseline, tmp_path, "--total-timesteps=128")
    output = program.wait()
    assert program.process.returncode == 0, output
    task = "coinrun" if baseline is ppo_reg_coinrun else "Pendulum-v1"
    run = tmp_path / "runs" / f"{task}__{name(baseline)}__s1__a0"
    assert len(read_metrics(run)) == 2
    assert "update 2/2" in output
    assert list(run.glob("events.out.tfevents.*"))


@pytest.mark.parametrize(
    ("baseline", "kill"),
    [
        (ppo_reg, signal.SIGTERM),
        (ppo_reg, signal.SIGINT),
        (ppo_reg, signal.SIGKILL),
        (trpo_reg, signal.SIGTERM),
        (ppo_reg_coinrun, signal.SIGKILL),
    ],
    ids=label,
)
def test_a_killed_process_continues_as_if_undisturbed(tmp_path, baseline, kill):
    flags = ("--total-timesteps=1280", "--resume")
    program = Program(baseline, tmp_path, "--total-timesteps=1280", "--run-dir=killed")
    output = program.kill_after_checkpoint(tmp_path / "killed", kill)
    assert program.process.returncode != 0
    assert ("--resume continues" in output) == (kill != signal.SIGKILL)
    assert len(read_metrics(tmp_path / "killed")) < 20
    for folder in ("killed", "undisturbed"):
        program = Program(baseline, tmp_path, f"--run-dir={folder}", *flags)
        assert "update 20/20" in program.wait()
    assert without_speed(tmp_path / "killed") == without_speed(tmp_path / "undisturbed")


def test_a_full_disk_loses_nothing(baseline, tmp_path):
    flags = ("--total-timesteps=1280", "--run-dir=full", "--resume")
    first = Program(baseline, tmp_path, *flags)
    first.kill_after_checkpoint(tmp_path / "full", signal.SIGKILL)
    before = (tmp_path / "full" / "checkpoint.pt").read_bytes()

    def leave_room_for_half_a_checkpoint() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2,) * 2)

    program = Program(baseline, tmp_path, *flags, preexec_fn=leave_room_for_half_a_checkpoint)
    assert "File too large" in program.wait()
    assert program.process.returncode != 0
    assert (tmp_path / "full" / "checkpoint.pt").read_bytes() == before
    assert "update 20/20" in Program(baseline, tmp_path, *flags).wait()
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
        (["--perturbation", "cube"], "invalid choice 'cube'"),
        (["--env-id", "CartPole-v1"], "a task with a Box of actions"),
    ],
)
def test_bad_flags_are_refused_by_name(baseline, monkeypatch, capsys, tmp_path, flags, message):
    check_refusal(baseline, flags, message, monkeypatch, capsys, tmp_path)
