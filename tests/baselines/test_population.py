"""What holds for both populations: each agent is as the single file would train it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines import population, ppo_reg_population
from tests.baselines.helpers import (
    FLAGS,
    SMALL,
    Breaking,
    check_refusal,
    interrupted,
    name,
    read_metrics,
    without_speed,
)
from tests.baselines.population_helpers import (
    POPULATIONS,
    arguments,
    check_close,
    learners_of,
    seeds_of,
    single_of,
)


@pytest.fixture(params=POPULATIONS, ids=name)
def module(request):
    return request.param


# --- environments --------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["test/Drift-v0", "test/Wide-v0"])
@pytest.mark.parametrize("num_envs", [1, 2, 9])
@pytest.mark.parametrize(
    "changes", [{}, {"norm_obs": False}, {"norm_reward": False}, {"perturb_obs": True}], ids=str
)
def test_what_agents_see_is_what_the_wrappers_would_show_bit_for_bit(env_id, num_envs, changes):
    args = arguments(
        ppo_reg_population, env_id=env_id, num_envs=num_envs, total_timesteps=1000, **changes
    )
    learners, alone = learners_of(args), learners_of(args)
    for checkpoint in range(2):  # the second goes on with the statistics of the first
        ours = args.perturb(population.Environments(args, learners))
        theirs = [
            run.perturb(args.single.make_envs(run, x.stats))
            for run, x in zip(args.runs, alone, strict=True)
        ]
        obs, _ = ours.reset(seed=seeds_of(args, checkpoint))
        each = [
            envs.reset(seed=args.single.env_seeds(run, checkpoint))[0]
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


def test_the_agents_begin_as_their_single_selves_and_go_through_the_same_noise(module):
    args = arguments(module, env_id="test/Drift-v0", num_envs=2, total_timesteps=640, agent=5)
    assert [run.agent for run in args.runs] == [5, 6, 7]
    learners, alone = learners_of(args), learners_of(args)
    for learner in (*learners, *alone):
        torch.nn.init.zeros_(learner.actor.mean[-1].weight)  # so that actions are noise alone
    envs = args.perturb(population.Environments(args, learners))
    next_obs, _ = envs.reset(seed=seeds_of(args))
    for _ in range(2):
        rollouts = population.rollout(args, learners, envs, next_obs)
        next_obs = np.concatenate([r.next_obs for r in rollouts])
    for i, (run, learner) in enumerate(zip(args.runs, alone, strict=True)):
        theirs = args.single.make_envs(run, learner.stats)
        next_obs, _ = theirs.reset(seed=args.single.env_seeds(run, 0))
        for _ in range(2):
            data = args.single.rollout(run, learner, theirs, next_obs)
            next_obs = data.next_obs
        assert data.returns, "some episodes ended"
        for field, value in data._asdict().items():
            ours = getattr(rollouts[i], field)
            if field in ("values", "next_values"):
                torch.testing.assert_close(ours, value, rtol=0, atol=1e-6)
            elif isinstance(value, torch.Tensor):
                assert torch.equal(ours, value), field
            else:
                np.testing.assert_array_equal(ours, value)
        for stream in ("init", "action", "minibatch"):
            states = [x.generators[stream].get_state() for x in (learners[i], learner)]
            assert torch.equal(*states)


def test_actions_are_those_of_each_agents_own_policy(module):
    args = arguments(module, env_id="test/Drift-v0")
    learners, alone = learners_of(args), learners_of(args)
    envs = args.perturb(population.Environments(args, learners))
    next_obs, _ = envs.reset(seed=seeds_of(args))
    rollouts = population.rollout(args, learners, envs, next_obs)
    for data, learner in zip(rollouts, alone, strict=True):
        with torch.no_grad():
            mean = learner.actor.mean(data.obs)
            noise = torch.randn(data.actions.shape, generator=learner.generators["action"])
        torch.testing.assert_close(data.actions, mean + noise, rtol=0, atol=1e-6)


def test_observations_and_actions_of_any_shape(module, tmp_path):
    args = arguments(module, tmp_path, env_id="test/DriftingSquare-v0", total_timesteps=64)
    assert module.train(args)[2].actor.log_std.shape == (4,)


# --- files ---------------------------------------------------------------------------------------

RESUMABLE = {"checkpoint_interval": 2, "total_timesteps": 7 * 64}


def interrupt(module, args, monkeypatch, at_update: int) -> None:
    """Train until Ctrl-C comes in the middle of an update."""
    update = module.update
    calls = itertools.count()

    def stop(args, learners, rollouts):
        if next(calls) == at_update:
            raise KeyboardInterrupt
        return update(args, learners, rollouts)

    with monkeypatch.context() as patch:
        patch.setattr(module, "update", stop)
        with pytest.raises(KeyboardInterrupt):
            module.train(args)


def check_same_runs(one, other, agents=range(3)) -> None:
    for agent in agents:
        paths = [folder / f"a{agent}" for folder in (one, other)]
        assert without_speed(paths[0]) == without_speed(paths[1])
        saved = [torch.load(path / "checkpoint.pt", weights_only=True) for path in paths]
        check_close(saved[0]["learner"], saved[1]["learner"], 0.0)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"env_id": "HopperBulletEnv-v0", "log_spectrum": 3, "target_kl": 1e-4},
        {"env_id": "test/Drift-v0", "num_envs": 2, "total_timesteps": 14 * 64,
         "hidden_sizes": (33, 17), "perturb_obs": True},
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("at_update", [1, 5])
def test_a_resumed_population_is_bit_for_bit_the_undisturbed_one(
    module, tmp_path, monkeypatch, changes, at_update
):
    settings = {**RESUMABLE, **changes}
    undisturbed = module.train(arguments(module, tmp_path / "x", **settings))
    interrupt(module, arguments(module, tmp_path / "y", **settings), monkeypatch, at_update)
    assert len(read_metrics(tmp_path / "y" / "a2")) == at_update
    resumed = module.train(arguments(module, tmp_path / "y", resume=True, **settings))
    for one, other in zip(undisturbed, resumed, strict=True):
        check_close(one, other, 0.0)
    check_same_runs(tmp_path / "x", tmp_path / "y")


@pytest.mark.parametrize("saved_of", [0, 1, 2])
@pytest.mark.parametrize("at_update", [2, 4])
def test_a_population_killed_while_it_saves_goes_on_from_what_all_have(
    module, tmp_path, monkeypatch, saved_of, at_update
):
    module.train(arguments(module, tmp_path / "x", **RESUMABLE))
    single = single_of(module)
    save = single.save_checkpoint

    def stop(run, learner) -> None:
        if learner.update == at_update and run.agent == saved_of:
            raise KeyboardInterrupt
        save(run, learner)

    with monkeypatch.context() as patch:
        patch.setattr(single, "save_checkpoint", stop)
        for resume in (False, True):  # the second attempt is killed as well
            with pytest.raises(KeyboardInterrupt):
                module.train(arguments(module, tmp_path / "y", resume=resume, **RESUMABLE))
    module.train(arguments(module, tmp_path / "y", resume=True, **RESUMABLE))
    check_same_runs(tmp_path / "x", tmp_path / "y")


def test_agents_at_different_updates_are_left_as_they_are(module, tmp_path):
    args = arguments(module, tmp_path, **RESUMABLE)
    module.train(dataclasses.replace(args, num_agents=2))
    before = (tmp_path / "a0" / "checkpoint.pt").read_bytes()
    with pytest.raises(
        args.single.RunError, match=r"at updates 7 \(agent 0\), 7 .*, 0 \(agent 2\)"
    ):
        module.train(dataclasses.replace(args, resume=True))
    assert (tmp_path / "a0" / "checkpoint.pt").read_bytes() == before


def test_a_newcomer_does_not_undo_what_others_have(module, tmp_path):
    """Finished agents with a single checkpoint, and one that was never begun beside them."""
    args = arguments(module, tmp_path, **{**RESUMABLE, "checkpoint_interval": 100})
    module.train(dataclasses.replace(args, num_agents=2))
    assert not (tmp_path / "a0" / "checkpoint.previous.pt").exists()
    with pytest.raises(args.single.RunError, match="the agents are at updates"):
        module.train(dataclasses.replace(args, resume=True))
    assert (tmp_path / "a0" / "checkpoint.pt").exists()


def test_either_program_goes_on_where_the_other_was_stopped(module, tmp_path, monkeypatch):
    """From single files to the population and back; as all is saved, only rounding tells."""
    settings = {**RESUMABLE, "env_id": "test/Drift-v0"}
    whole, parts = (
        arguments(module, tmp_path / "x", **settings),
        arguments(module, tmp_path / "y", **settings),
    )
    single = single_of(module)
    undisturbed = [single.train(run) for run in whole.runs]
    for run in parts.runs:
        interrupted(single, run, monkeypatch, at_update=2)
    interrupt(module, dataclasses.replace(parts, resume=True), monkeypatch, 2)
    runs = dataclasses.replace(parts, resume=True).runs
    for i, (run, expected) in enumerate(zip(runs, undisturbed, strict=True)):
        learner = single.train(run)
        check_close(learner, expected, 1e-4)
        rows = [read_metrics(tmp_path / x / f"a{i}") for x in "xy"]
        assert [list(row) for row in rows[0]] == [list(row) for row in rows[1]]
        for one, other in zip(*rows, strict=True):
            one, other = (
                {k: float(v) for k, v in x.items() if "SPS" not in k} for x in (one, other)
            )
            assert one == pytest.approx(other, abs=1e-3, rel=1e-3, nan_ok=True)


def test_a_run_directory_has_the_layout_of_a_single_run(module, tmp_path):
    args = arguments(module, tmp_path / "x", log_spectrum=2)
    module.train(args)
    run = dataclasses.replace(args.runs[1], run_dir=tmp_path / "alone")
    args.single.train(run)
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


def test_a_finished_population_stays_as_it_is(module, tmp_path, capsys):
    module.train(arguments(module, tmp_path))
    files = [
        tmp_path / f"a{i}" / name for i in range(3) for name in ("metrics.csv", "checkpoint.pt")
    ]
    before = [file.read_bytes() for file in files]
    learners = module.train(arguments(module, tmp_path, resume=True))
    assert before == [file.read_bytes() for file in files]
    assert "finished" in capsys.readouterr().out
    assert len(learners) == 3


def test_the_global_random_state_is_left_alone(module, tmp_path):
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    module.train(arguments(module, tmp_path, perturb_obs=True))
    assert torch.equal(torch.get_rng_state(), torch_before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


# --- agents that diverge -------------------------------------------------------------------------

BREAKING = {**RESUMABLE, "num_agents": 3, "checkpoint_interval": 3}
REWARD = "test/Breaking-reward-nan-v0"
SETTINGS = {
    "plain": (0, {}),
    "two environments": (1, {"num_envs": 2, "total_timesteps": 14 * 64}),
    "observed": (1, {"env_id": "test/Breaking-observation-nan-v0"}),
    "infinite": (0, {"env_id": "test/Breaking-reward-inf-v0"}),
    "penalized": (1, {"coefficient": 1.0, "reduction": "batch", "perturb_obs": True}),
    "not normalized": (1, {"norm_obs": False, "norm_reward": False}),
    "bounded": (0, {"target_kl": 3e-3}),
}


def broken(module, folder, monkeypatch, agents=(1,), steps: int = 100, **changes):
    """Arguments of a population in which these agents break, in update 5 by default.

    Updates 4 to 6 are those after the first checkpoint, in whose environments the steps count.
    """
    args = arguments(module, folder, **{**BREAKING, "env_id": REWARD, **changes})
    seeds = [args.single.env_seeds(args.runs[agent], 1)[-1] for agent in agents]
    monkeypatch.setattr(Breaking, "breaks", dict.fromkeys(seeds, steps))
    return args


@pytest.mark.parametrize(("agent", "changes"), SETTINGS.values(), ids=SETTINGS)
def test_the_others_end_bit_for_bit_as_if_one_had_not_diverged(
    module, tmp_path, monkeypatch, capsys, agent, changes
):
    settings = {"env_id": REWARD, **BREAKING, **changes}
    undisturbed = module.train(arguments(module, tmp_path / "x", **settings))
    args = broken(module, tmp_path / "y", monkeypatch, agents=[agent], **changes)
    capsys.readouterr()
    with np.errstate(all="ignore"):
        disturbed = module.train(args)

    others = [i for i in range(3) if i != agent]
    for i in others:
        check_close(undisturbed[i], disturbed[i], 0.0)
    check_same_runs(tmp_path / "x", tmp_path / "y", others)
    for i in others:
        assert not (tmp_path / "y" / f"a{i}" / "diverged.json").exists()

    what = args.env_id.split("-")[1]
    path = tmp_path / "y" / f"a{agent}"
    said = json.loads((path / "diverged.json").read_text())
    message = f"the {what} became non-finite in update 5"
    assert said == {"update": 5, "what": what, "message": message}
    assert (
        f"agent {agent} is frozen, the others go on: {path}: {message}" in capsys.readouterr().out
    )
    assert len(read_metrics(path)) == 4
    assert torch.load(path / "checkpoint.pt", weights_only=True)["learner"]["update"] == 3
    assert not disturbed[agent].weights.any()


def test_an_agent_whose_weights_become_non_finite_is_frozen(module, tmp_path, monkeypatch):
    """After an update whose numbers were finite; nor has that update a row."""
    settings = {**BREAKING, "env_id": "test/Drift-v0"}
    undisturbed = module.train(arguments(module, tmp_path / "x", **settings))
    update = module.update

    def spoil(args, learners, rollouts):
        losses = update(args, learners, rollouts)
        if learners[1].update == 4:
            learners[1].critic[0].weight.data[0, 0] = torch.nan
        return losses

    monkeypatch.setattr(module, "update", spoil)
    disturbed = module.train(arguments(module, tmp_path / "y", **settings))
    for i in (0, 2):
        check_close(undisturbed[i], disturbed[i], 0.0)
    check_same_runs(tmp_path / "x", tmp_path / "y", (0, 2))
    said = json.loads((tmp_path / "y" / "a1" / "diverged.json").read_text())
    assert (said["update"], said["what"]) == (4, "loss")
    assert len(read_metrics(tmp_path / "y" / "a1")) == 3


@pytest.mark.parametrize("at_update", [5, 6])
def test_an_agent_stays_frozen_when_the_population_is_resumed(
    module, tmp_path, monkeypatch, at_update
):
    """From the checkpoint before it diverged, and from the one after."""
    undisturbed = module.train(arguments(module, tmp_path / "x", **BREAKING, env_id=REWARD))
    args = broken(module, tmp_path / "y", monkeypatch)
    with np.errstate(all="ignore"):
        interrupt(module, args, monkeypatch, at_update)
    frozen = [(tmp_path / "y" / "a1" / name).read_bytes() for name in FILES]
    resumed = module.train(dataclasses.replace(args, resume=True))
    for i in (0, 2):
        check_close(undisturbed[i], resumed[i], 0.0)
    check_same_runs(tmp_path / "x", tmp_path / "y", (0, 2))
    assert frozen == [(tmp_path / "y" / "a1" / name).read_bytes() for name in FILES]

    finished = module.train(dataclasses.replace(args, resume=True))
    assert [learner.update for learner in finished] == [7, 7, 7]


FILES = ("metrics.csv", "checkpoint.pt", "diverged.json")


def test_a_population_of_which_every_agent_diverges_ends_with_3(
    module, tmp_path, monkeypatch, capsys
):
    args = broken(module, tmp_path, monkeypatch, agents=(0, 1, 2))
    with np.errstate(all="ignore"), pytest.raises(args.single.DivergedError, match="every agent"):
        module.train(args)
    for i in range(3):
        assert len(read_metrics(tmp_path / f"a{i}")) == 4

    small = SMALL[args.single]
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in small.items()]
    flags += [f"--env-id={REWARD}", "--num-agents=3", "--checkpoint-interval=3", "--resume"]
    flags += [f"--run-dir={tmp_path}/a{{agent}}", "--total-timesteps=448"]
    monkeypatch.setattr("sys.argv", ["population.py", *flags])
    with pytest.raises(SystemExit) as stopped:
        module.main()
    assert stopped.value.code == 3
    assert "every agent has diverged" in capsys.readouterr().out


def test_agents_diverge_one_after_the_other(module, tmp_path, monkeypatch):
    args = broken(module, tmp_path, monkeypatch, agents=(0, 2))
    late = args.single.env_seeds(args.runs[2], 1)[0]
    monkeypatch.setitem(Breaking.breaks, late, 150)
    undisturbed = module.train(arguments(module, tmp_path / "x", **BREAKING, env_id=REWARD))
    assert undisturbed
    with np.errstate(all="ignore"):
        module.train(args)
    rows = [len(read_metrics(tmp_path / f"a{i}")) for i in range(3)]
    assert rows == [4, 7, 5]


# --- longer runs ---------------------------------------------------------------------------------


def test_an_extended_population_is_the_longer_one_bit_for_bit(module, tmp_path):
    settings = {"env_id": "test/Drift-v0", "checkpoint_interval": 2}
    longer = {**settings, "total_timesteps": 6 * 64}
    whole = module.train(arguments(module, tmp_path / "x", **longer))
    module.train(arguments(module, tmp_path / "y", **settings, total_timesteps=4 * 64))
    again = {**longer, "resume": True, "extend": True}
    extended = module.train(arguments(module, tmp_path / "y", **again))
    for one, other in zip(whole, extended, strict=True):
        check_close(one, other, 0.0)
    check_same_runs(tmp_path / "x", tmp_path / "y")


def test_a_population_that_ends_between_checkpoints_cannot_be_extended(module, tmp_path):
    args = arguments(module, tmp_path, checkpoint_interval=2)
    module.train(args)
    longer = dataclasses.replace(args, total_timesteps=640, resume=True)
    with pytest.raises(args.single.RunError, match="was run with total_timesteps=320, not 640"):
        module.train(longer)
    with pytest.raises(args.single.RunError, match="a0 cannot be extended: its 5 updates"):
        module.train(dataclasses.replace(longer, extend=True))


# --- the file as a program -----------------------------------------------------------------------


def start(module, folder, *flags: str, marker: str | None = None) -> subprocess.Popen:
    """The program, copied beside the files that it needs into a folder that holds nothing else.

    Without the lines that hold the marker, if one is given.
    """
    for copied in (population, single_of(module), module):
        lines = Path(copied.__file__).read_text().splitlines()
        kept = [line for line in lines if marker is None or marker not in line]
        (folder / Path(copied.__file__).name).write_text("\n".join(kept))
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    own = ["--env-id=Pendulum-v1", "--num-agents=2"]
    command = [sys.executable, f"{name(module)}.py", *FLAGS, *own, *flags]
    with open(folder / "log.txt", "w") as log:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)


def test_it_runs_when_copied_beside_the_single_file(module, tmp_path):
    ended = start(module, tmp_path, "--total-timesteps=128").wait()
    log = (tmp_path / "log.txt").read_text()
    assert ended == 0, log
    assert "update 2/2" in log
    for agent in range(2):
        run = tmp_path / "runs" / f"Pendulum-v1__{name(single_of(module))}__s1__a{agent}"
        assert len(read_metrics(run)) == 2


def test_coefficient_0_is_the_files_without_their_condwrap_lines(module, tmp_path):
    folders = [tmp_path / "ours", tmp_path / "plain"]
    settings = [(["--coefficient=0"], None), ([], "# condwrap")]
    for folder, (flags, marker) in zip(folders, settings, strict=True):
        folder.mkdir()
        more = ("--total-timesteps=320", "--run-dir=a{agent}", *flags)
        ended = start(module, folder, *more, marker=marker).wait()
        assert ended == 0, (folder / "log.txt").read_text()

    plain_code = (folders[1] / f"{name(module)}.py").read_text()
    assert "penalty" not in plain_code.split('"""', 2)[2]
    for agent in range(2):
        ours, plain = [folder / f"a{agent}" for folder in folders]
        plain_rows = without_speed(plain)
        shared = [{key: row[key] for key in plain_rows[0]} for row in without_speed(ours)]
        assert shared == plain_rows
        saved = [torch.load(x / "checkpoint.pt", weights_only=True) for x in (ours, plain)]
        ours, plain = [each["learner"] for each in saved]
        assert ours.keys() - plain.keys() == {"regularizer", "probe"}
        check_close({key: ours[key] for key in plain}, plain, 0.0)


def test_a_killed_process_continues_as_if_undisturbed(tmp_path):
    module = ppo_reg_population
    flags = ("--total-timesteps=1280", "--resume")
    process = start(module, tmp_path, "--run-dir=killed/a{agent}", *flags)
    while not (tmp_path / "killed" / "a1" / "checkpoint.pt").exists():
        assert process.poll() is None, (tmp_path / "log.txt").read_text()
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert len(read_metrics(tmp_path / "killed" / "a0")) < 20
    for folder in ("killed", "undisturbed"):
        assert start(module, tmp_path, f"--run-dir={folder}/a{{agent}}", *flags).wait() == 0
    check_same_runs(tmp_path / "killed", tmp_path / "undisturbed", agents=range(2))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--num-agents", "0"], "num_agents must be at least 1, got 0"),
        (["--run-dir", "results"], "run_dir must hold {agent}, a folder for each, got results"),
        (["--compile"], "compile is for agents trained singly, by ppo_reg.py"),
        (["--penalty", "sa"], "penalty sa is for agents trained singly, by ppo_reg.py"),
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
    second = ppo_reg_population.Args(num_agents=2).runs[1]
    assert second.path.name == "HopperBulletEnv-v0__ppo_reg__s1__a1"
