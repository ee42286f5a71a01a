"""Policies from disk: each kind is read, and nothing is unpickled that was not trusted."""

from __future__ import annotations

import json
import pickle
import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

from baselines import ppo_reg, trpo_reg
from condwrap.__main__ import main
from condwrap.disk import DiskError, Found, read_policy
from condwrap.visits import SPACING, collect


class Scaled(nn.Module):
    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return 2 * obs[:, :1]


@pytest.fixture
def agents(tmp_path, monkeypatch):
    """A module of the working directory with a policy in it."""
    (tmp_path / "my_agents.py").write_text(
        "from torch import nn\nclass Twice(nn.Module):\n    def forward(self, obs):\n"
        "        return 2 * obs[:, :1]\npolicy = Twice()\nnumber = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield "my_agents"
    sys.modules.pop("my_agents", None)


@pytest.fixture(scope="module", params=[ppo_reg, trpo_reg], ids=["ppo", "trpo"])
def run(request, tmp_path_factory):
    """The folder of a real agent after 200 steps of Pendulum, and its baseline."""
    folder = tmp_path_factory.mktemp("run")
    sizes = {"total_timesteps": 200, "num_steps": 100, "num_minibatches": 2}
    args = request.param.Args(env_id="Pendulum-v1", run_dir=folder, **sizes)
    request.param.train(args)
    return folder, request.param, args


# --- what is read --------------------------------------------------------------------------------


def test_a_callable_of_the_users_own(agents):
    found = read_policy(f"{agents}:policy")
    assert found.policy(torch.ones(3, 2)).tolist() == [[2.0]] * 3


def test_a_baselines_agent_is_the_one_that_was_trained(run):
    folder, module, args = run
    learner = module.Learner(args)
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    learner.load_state_dict(saved["learner"])
    rms = learner.stats["obs_rms"]

    obs = np.random.default_rng(0).normal(size=(5, 3)) * [1, 1, 8]
    expected = learner.actor(
        torch.as_tensor(((obs - rms.mean) / np.sqrt(rms.var + 1e-8)).clip(-10, 10)).float()
    ).mean
    for source in (folder, folder / "checkpoint.pt"):
        found = read_policy(str(source))
        assert found.env_id == "Pendulum-v1"
        torch.testing.assert_close(found.policy(found.normalize(torch.as_tensor(obs))), expected)


def test_an_agent_that_saw_raw_observations_of_a_bullet_task(run, tmp_path):
    saved = torch.load(run[0] / "checkpoint.pt", weights_only=True)
    saved["args"] |= {"norm_obs": False, "env_id": "HopperBulletEnv-v0"}
    torch.save(saved, tmp_path / "checkpoint.pt")
    found = read_policy(str(tmp_path))
    assert found.env_id == "pybullet_envs_gymnasium:HopperBulletEnv-v0"
    assert found.normalize(torch.ones(1, 3)).tolist() == [[1.0, 1.0, 1.0]]


def test_torchscript(tmp_path):
    path = tmp_path / "policy.pt"
    with pytest.warns(DeprecationWarning, match=r"torch\.jit"):
        torch.jit.script(Scaled()).save(path)
    assert read_policy(str(path)).policy(torch.ones(3, 2)).tolist() == [[2.0]] * 3


def test_an_exported_program_is_read_when_it_is_trusted(tmp_path):
    path = tmp_path / "policy.pt2"
    batch = torch.export.Dim("batch", min=2, max=100)
    program = torch.export.export(Scaled(), (torch.ones(4, 2),), dynamic_shapes=({0: batch},))
    torch.export.save(program, path)
    with pytest.raises(DiskError, match=r"policy\.pt2 is a file of torch\.export.*--trust"):
        read_policy(str(path))
    assert read_policy(str(path), trust=True).policy(torch.ones(3, 2)).tolist() == [[2.0]] * 3


# --- what is refused -----------------------------------------------------------------------------


class Bomb:
    """A pickle that leaves a file where it is loaded."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def test_a_pickle_is_not_executed(tmp_path):
    path = tmp_path / "checkpoint.pt"
    torch.save({"args": Bomb(tmp_path / "executed")}, path)
    with pytest.raises(DiskError, match="no checkpoint of ppo_reg or trpo_reg"):
        read_policy(str(path))
    path.write_bytes(pickle.dumps(Bomb(tmp_path / "executed")))
    with pytest.raises(DiskError, match="no checkpoint"):
        read_policy(str(path))
    assert not (tmp_path / "executed").exists()


def test_a_model_of_sb3_is_not_read_unless_it_is_trusted(tmp_path):
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("data", "{}")
        file.writestr("policy.pth", "")
    with pytest.raises(DiskError, match=r"a model of Stable-Baselines3.*--trust"):
        read_policy(str(path))


def test_a_model_of_sb3_needs_sb3(tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("data", "{}")
        file.writestr("policy.pth", "")
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(DiskError, match="pip install stable-baselines3"):
        read_policy(str(path), trust=True)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nowhere.pt", "no file nowhere.pt: name a file, or an importable policy"),
        ("no_such_module:policy", "no_such_module:policy cannot be imported"),
        ("my_agents:missing", "my_agents:missing cannot be imported"),
        ("my_agents:number", "must be callable, got int"),
    ],
)
def test_what_is_not_there_is_told(agents, source, message):
    with pytest.raises(DiskError, match=message):
        read_policy(source)


def test_a_folder_without_a_checkpoint(tmp_path):
    with pytest.raises(DiskError, match=r"a folder without checkpoint\.pt"):
        read_policy(str(tmp_path))


# --- observations --------------------------------------------------------------------------------


class Line(gym.Env):
    """Its observation is the last action; an episode has three steps."""

    observation_space = gym.spaces.Box(-9, 9, (1,), np.float64)

    def __init__(self, space: gym.Space) -> None:
        self.action_space = space
        self.seen: list = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1), {}

    def step(self, action):
        self.steps += 1
        self.seen.append(action)
        return np.full(1, float(np.sum(action))), 0.0, self.steps == 3, False, {}


@pytest.fixture
def line(monkeypatch):
    """Makes the environment `Line` with these actions; gives it back."""

    def make(space):
        env = Line(space)
        monkeypatch.setattr(gym, "make", lambda env_id: env)
        return env

    return make


def found(policy) -> Found:
    return Found(policy, "a policy")


def test_the_policy_acts_within_its_box(line):
    env = line(gym.spaces.Box(-1, 1, (1,), np.float32))
    obs, how = collect(found(lambda obs: obs + 0.75), "Line", states=3)
    # 0.75 and, clipped, 1 and 1 in each episode of three steps
    assert [float(action[0]) for action in env.seen[:6]] == [0.75, 1.0, 1.0] * 2
    assert obs.shape == (3, 1)
    assert obs.dtype == torch.float32
    assert obs.flatten().tolist() == [[0.0, 0.75, 1.0][i * SPACING % 3] for i in range(3)]
    assert how == "12 steps of Line with its own actions"


def test_the_largest_output_is_a_discrete_action(line):
    env = line(gym.spaces.Discrete(3, start=5))
    collect(found(lambda obs: torch.tensor([[0.0, 2.0, 1.0]]).expand(len(obs), -1)), "Line", 1)
    assert env.seen == [6] * SPACING


def test_actions_are_random_where_the_output_is_none(line):
    env = line(gym.spaces.Box(-1, 1, (2,), np.float32))
    _, how = collect(found(lambda obs: obs), "Line", 2)
    assert how.endswith("random actions, since its output is not one")
    assert len({action.tobytes() for action in env.seen}) == 2 * SPACING


def test_an_environment_that_is_not_there(monkeypatch):
    with pytest.raises(DiskError, match=r"No-v0 cannot be made.*pybullet_envs_gymnasium:"):
        collect(found(lambda obs: obs), "No-v0", 1)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(DiskError, match=r"needs Gymnasium: pip install 'condwrap\[gymnasium\]'"):
        collect(found(lambda obs: obs), "No-v0", 1)


def test_observations_that_are_no_array(line, monkeypatch):
    env = line(gym.spaces.Discrete(2))
    monkeypatch.setattr(env, "reset", lambda **kwargs: ({"a": 1}, {}))
    with pytest.raises(DiskError, match="observations of dict: pass --obs"):
        collect(found(lambda obs: obs), "Line", 1)


# --- the command ---------------------------------------------------------------------------------


def test_the_command_prints_a_table(run, capsys):
    main(["summary", str(run[0]), "--states", "16"])
    out = capsys.readouterr().out
    assert "an agent of Pendulum-v1, trained for 200 steps; observations of 64 steps" in out
    assert "Conditioning on 16 states: 3 observed values, 1 outputs" in out
    assert "psi for [1, 20]" in out


def test_the_command_prints_numbers_for_given_observations(agents, tmp_path, capsys):
    np.save(tmp_path / "obs.npy", np.ones((8, 1)))
    words = ["summary", f"{agents}:policy", "--obs", str(tmp_path / "obs.npy"), "--json"]
    main([*words, "--lambda-max", "1.5"])
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["quotient_q50"] == pytest.approx(2.0)
    assert numbers["psi"] == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["my_agents:policy"], "name where observations come from: --env-id ID or --obs FILE.npy"),
        (["my_agents:policy", "--obs", "nothing.npy"], "nothing.npy is no .npy file of numbers"),
        (["my_agents:policy", "--env-id", "No-v0"], "No-v0 cannot be made"),
        (["my_agents:policy", "--states", "0"], "--states must be at least 1, got 0"),
        (["my_agents:policy", "--env-id", "Pendulum-v1", "--radius", "0"], "radius must be"),
    ],
)
def test_bad_words_are_refused_in_a_line(agents, words, message):
    with pytest.raises(SystemExit) as stopped:
        main(["summary", *words])
    assert str(stopped.value).startswith(f"error: {message}")
