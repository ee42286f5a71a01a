"""The fast PyBullet tasks against the stock ones: equal bit for bit, wherever episodes go."""

from __future__ import annotations

import hashlib
import importlib
import inspect

import gymnasium as gym
import numpy as np
import pybullet
import pytest
import torch

from baselines.ppo_reg import Args, train
from harness.envs import fast_bullet

TASKS = [f"{name}BulletEnv-v0" for name in fast_bullet.NAMES]
LOCOMOTION = [name for name in TASKS if not name.startswith(("Reacher", "Inverted"))]

# pybullet_envs_gymnasium 0.6.0: the first digits of each source's SHA-256.
STOCK = {
    "env_bases": "3e35d69ad38c5742",
    "gym_locomotion_envs": "04f8c9630acc5d14",
    "gym_manipulator_envs": "5a524d8cf4f1fe62",
    "gym_pendulum_envs": "51f14f0a13a8c709",
    "robot_bases": "e135bb58fe721397",
    "robot_locomotors": "a4537ed03ef101c4",
    "robot_manipulators": "6e34147aa9157966",
    "robot_pendula": "a5979a599e7d7c1f",
    "scene_abstract": "aa8bd3c43f820ad3",
    "scene_stadium": "9b75c0778026528f",
}


@pytest.mark.parametrize("name", STOCK)
def test_the_stock_package_is_the_one_that_the_fast_tasks_follow(name):
    module = importlib.import_module(f"pybullet_envs_gymnasium.{name}")
    digest = hashlib.sha256(inspect.getsource(module).encode()).hexdigest()
    assert digest[:16] == STOCK[name], (
        f"{module.__file__} is not that of pybullet_envs_gymnasium 0.6.0. Read what changed, let "
        f"harness/envs/fast_bullet.py follow, run `pytest -m slow {__file__}`, then record "
        f"{digest[:16]} here."
    )


@pytest.fixture
def make():
    """Makes environments that are closed when the test is over."""
    made = []

    def make_env(env_id, **kwargs):
        made.append(gym.make(env_id, **kwargs))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


@pytest.fixture
def pair(make):
    """Makes the stock task and the fast one, with the same seed."""

    def make_pair(task, seed=0, **kwargs):
        stock, fast = make(task, **kwargs), make(f"{fast_bullet.__name__}:Fast{task}", **kwargs)
        assert_same(stock.reset(seed=seed), fast.reset(seed=seed))
        return stock, fast

    return make_pair


def assert_same(stock, fast):
    """Equal answers of `reset` or `step`: bits, types and shapes."""
    assert fast[0].dtype == stock[0].dtype == np.float32
    assert fast[0].shape == stock[0].shape
    assert fast[0].tobytes() == stock[0].tobytes(), fast[0] - stock[0]
    assert fast[1:] == stock[1:]
    assert [type(x) for x in fast[1:]] == [type(x) for x in stock[1:]]


def step(stock, fast, action):
    """Step both with their own copy of the action; what they answer is the same."""
    before = action.copy()
    answers = stock.step(action), fast.step(action)
    assert_same(*answers)
    assert fast.unwrapped.rewards == stock.unwrapped.rewards
    assert np.array_equal(action, before)
    return answers[0]


def play(pair, steps, act, *, past_termination=False):
    """Step both; at an episode's end reset both, unseeded. Returns how many ended, and were cut."""
    stock, fast = pair
    terminations = truncations = 0
    obs = None
    for i in range(steps):
        obs, _, terminated, truncated, _ = step(stock, fast, act(i, obs))
        terminations, truncations = terminations + terminated, truncations + truncated
        if truncated or (terminated and not past_termination):
            answers = stock.reset(), fast.reset()
            assert_same(*answers)
            obs = answers[0][0]
    return terminations, truncations


def play_random(pair, steps):
    space = pair[0].action_space
    space.seed(0)
    return play(pair, steps, lambda i, obs: space.sample())


@pytest.mark.parametrize("task", TASKS)
def test_random_steps_and_resets(pair, task):
    terminations, truncations = play_random(pair(task), 1_000)
    assert terminations + truncations > 0


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_20000_random_steps_and_resets(pair, task):
    play_random(pair(task, seed=1), 20_000)


@pytest.mark.parametrize("task", TASKS)
def test_to_the_time_limit_with_smooth_actions_beyond_their_bounds(pair, task):
    """Played on past their ends, episodes go where random ones never do; robots stay equal too."""
    envs = pair(task)
    phase = np.linspace(0, 5, envs[0].action_space.shape[0])
    seen = {
        name: set() for name in ("joints_at_limit", "feet_contact", "walk_target_x", "body_xyz")
    }

    def act(i, obs):
        stock, fast = (vars(env.unwrapped.robot) for env in envs)
        for name in seen.keys() & stock.keys():
            assert np.array_equal(stock[name], fast[name]), name
            seen[name].update(np.ravel(stock[name]))
        return (2 * np.sin(0.1 * i + phase)).astype(np.float32)

    # Over 600 steps past a fall even two stock Humanoids part in the last bits, if rarely.
    steps = 500 if "Humanoid" in task else envs[0].spec.max_episode_steps + 50
    _, truncations = play(envs, steps, act, past_termination=True)
    assert truncations >= ("Humanoid" not in task)
    if task in LOCOMOTION:
        assert seen["feet_contact"] == {0.0, 1.0}
        assert len(seen["joints_at_limit"]) > 1
    if "Flagrun" in task:
        assert len(seen["walk_target_x"]) > steps // 150  # a flag stands for 150 steps


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_a_trained_policys_episodes(pair, tmp_path, task):
    """With its noise, and deterministic, after a short training on the fast task."""
    env_id = f"{fast_bullet.__name__}:Fast{task}"
    learner = train(Args(env_id=env_id, total_timesteps=10_000, run_dir=tmp_path))
    rms, noise = learner.stats["obs_rms"], torch.Generator().manual_seed(0)

    @torch.no_grad()
    def act(i, obs):
        obs = np.zeros_like(rms.mean) if obs is None else (obs - rms.mean) / np.sqrt(rms.var)
        mean = learner.actor(torch.as_tensor(obs, dtype=torch.float32)).mean
        return (mean + (i < 2_000) * torch.randn(mean.shape, generator=noise)).numpy()

    play(pair(task), 4_000, act)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_decide_the_precision(pair, task, dtype):
    stock, fast = pair(task)
    rng = np.random.default_rng(0)
    for _ in range(10):
        step(stock, fast, rng.uniform(-1.5, 1.5, stock.action_space.shape).astype(dtype))


@pytest.mark.parametrize("task", TASKS)
def test_reset_amid_an_episode_and_to_an_old_seed(pair, task):
    stock, fast = pair(task)
    for seed in (None, 7, None, 0):
        for _ in range(5):
            step(stock, fast, stock.action_space.sample())
        assert_same(stock.reset(seed=seed), fast.reset(seed=seed))


@pytest.mark.parametrize("task", TASKS)
def test_actions_that_are_not_finite_are_refused(pair, task):
    envs = pair(task)
    for bad in (np.nan, np.inf):
        for env in envs:
            action = np.zeros(env.action_space.shape, np.float32)
            action[-1] = bad
            with pytest.raises(AssertionError):
                env.step(action)
    step(*envs, envs[0].action_space.sample())


def test_a_flag_that_is_reached_is_moved(pair):
    envs = pair("HumanoidFlagrunBulletEnv-v0")
    for env in envs:
        robot = env.unwrapped.robot
        robot.walk_target_x, robot.walk_target_y, _ = robot.body_xyz
        robot.flag_timeout = 100
    step(*envs, envs[0].action_space.sample())
    assert [env.unwrapped.robot.flag_timeout for env in envs] == [150, 150]
    play_random(envs, 50)


def test_a_state_that_is_not_a_number_ends_the_episode(pair, capsys):
    envs = pair("HalfCheetahBulletEnv-v0")
    for env in envs:
        env.unwrapped.robot.initial_z = np.nan
    capsys.readouterr()
    answers = [env.unwrapped.step(np.zeros(6, np.float32)) for env in envs]  # no checker warns
    assert [answer[2] for answer in answers] == [True, True]
    assert answers[0][0].tobytes() == answers[1][0].tobytes()
    assert capsys.readouterr().out.count("~INF~") == 2


def test_two_in_one_process_do_not_interfere(make):
    env_id = f"{fast_bullet.__name__}:FastHumanoidBulletEnv-v0"

    def episode(env, seed):
        rng = np.random.default_rng(seed)
        yield env.reset(seed=seed)[0]
        for _ in range(60):
            obs, _, ended, _, _ = env.step(rng.uniform(-1, 1, 17).astype(np.float32))
            yield env.reset()[0] if ended else obs

    alone = [list(episode(make(env_id), seed)) for seed in (0, 1)]
    together = zip(*(episode(make(env_id), seed) for seed in (0, 1)), strict=True)
    for one, other in zip(together, zip(*alone, strict=True), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_limits_and_ids(make, task):
    stock, fast = make(task), make(f"{fast_bullet.__name__}:Fast{task}")
    assert fast.observation_space == stock.observation_space
    assert fast.action_space == stock.action_space
    assert fast.metadata == stock.metadata
    assert fast.spec.max_episode_steps == stock.spec.max_episode_steps
    assert fast.spec.reward_threshold == stock.spec.reward_threshold
    assert stock.spec.entry_point.startswith("pybullet_envs_gymnasium")
    assert isinstance(fast.unwrapped, type(stock.unwrapped))


@pytest.mark.parametrize("task", TASKS)
def test_frames(pair, task):
    envs = pair(task, render_mode="rgb_array")
    step(*envs, envs[0].action_space.sample())
    frame, same = (env.render() for env in envs)
    assert frame.shape == (240, 320, 3)
    assert np.ptp(frame) > 0
    assert np.array_equal(frame, same)


@pytest.mark.parametrize("task", TASKS)
def test_close_frees_the_simulation(pair, make, task):
    for env in pair(task):
        client, action = env.unwrapped.physicsClientId, env.action_space.sample()
        env.close()
        assert not pybullet.isConnected(client)
        other = make(task)
        other.reset()
        assert other.unwrapped.physicsClientId == client  # Bullet gives the id to the next
        with pytest.raises(pybullet.error, match="Not connected"):
            env.step(action)


# --- HalfCheetah as pybullet-gym has it -----------------------------------------------------------

FALLING = f"{fast_bullet.__name__}:FastHalfCheetahPyBulletEnv-v0"
PLAYING_ON = f"{fast_bullet.__name__}:FastHalfCheetahBulletEnv-v0"


class Cheetah:
    """The cheetah as Bullet itself knows it, without the task's or the robot's own numbers."""

    def __init__(self, env):
        self.client = env.unwrapped.physicsClientId
        bodies = range(pybullet.getNumBodies(self.client))
        links = {body: self.names(body, 12) for body in bodies}
        self.body = next(body for body in bodies if "bthigh" in links[body])
        self.links, self.joints = links[self.body], self.names(self.body, 1)

    def names(self, body, which):
        joints = range(pybullet.getNumJoints(body, self.client))
        return [pybullet.getJointInfo(body, i, self.client)[which].decode() for i in joints]

    def pitch(self):
        link = self.links.index("torso")
        turned = pybullet.getLinkState(self.body, link, physicsClientId=self.client)[1]
        return pybullet.getEulerFromQuaternion(turned)[1]

    def grounded(self):
        """The links that touch another body: there is none but the floor."""
        contacts = pybullet.getContactPoints(self.body, physicsClientId=self.client)
        return {self.links[c[3]] for c in contacts if c[2] != self.body}

    def place(self, height, pitch):
        """Hold it up in the air, so that it touches nothing."""
        for name, value in (("ignorez", height), ("ignorey", pitch)):
            joint = self.joints.index(name)
            pybullet.resetJointState(self.body, joint, value, physicsClientId=self.client)


def test_the_cheetahs_episode_ends_by_the_written_rule(make):
    """|pitch| >= 1, or a shin or thigh on the ground after the step before."""
    env = make(FALLING)
    env.reset(seed=0)
    cheetah, rng = Cheetah(env), np.random.default_rng(0)
    legs = {"fshin", "fthigh", "bshin", "bthigh"}
    blamed, lengths, returns = set(), [], []
    for _ in range(30):
        down, total, steps = set(), 0.0, 0
        env.reset()
        while steps < 1000:
            action = rng.normal(size=6).clip(-1, 1).astype(np.float32)  # as a new policy acts
            _, reward, terminated, truncated, _ = env.step(action)
            expected = abs(cheetah.pitch()) >= 1 or bool(down)
            assert (terminated, truncated) == (expected, False)
            assert env.unwrapped.rewards[0] == (-1.0 if expected else 1.0)
            steps, total = steps + 1, total + reward
            if terminated:
                break
            down = cheetah.grounded() & legs
        blamed |= down
        lengths.append(steps)
        returns.append(total)
    assert len(blamed) >= 2
    assert 10 < np.mean(lengths) < 30  # the stock task plays 1000, for about -1300
    assert -8 < np.mean(returns) < 4


@pytest.mark.parametrize(
    ("pitch", "ends"), [(0.9, False), (1.1, True), (-0.9, False), (-1.1, True)]
)
def test_a_cheetah_that_turns_over_in_the_air_is_down(make, pitch, ends):
    env = make(FALLING)
    env.reset(seed=0)
    cheetah = Cheetah(env)
    cheetah.place(3.0, pitch)
    _, _, terminated, _, _ = env.step(np.zeros(6, np.float32))
    assert cheetah.pitch() == pytest.approx(pitch, abs=0.05)
    assert not cheetah.grounded()
    assert terminated is ends


def test_both_cheetahs_are_alike_until_one_is_down(make):
    falling, on = make(FALLING), make(PLAYING_ON)
    rng = np.random.default_rng(1)
    for seed in range(10):
        assert_same(on.reset(seed=seed), falling.reset(seed=seed))
        terminated = False
        while not terminated:
            action = rng.uniform(-1, 1, 6).astype(np.float32)
            stock, fast = on.step(action), falling.step(action)
            assert fast[0].tobytes() == stock[0].tobytes()
            assert fast[1] == stock[1]
            assert falling.unwrapped.rewards == on.unwrapped.rewards
            assert stock[2] is False
            terminated = fast[2]


def test_the_falling_cheetah_is_registered_as_the_other_is(make):
    falling, on = make(FALLING), make(PLAYING_ON)
    assert falling.observation_space == on.observation_space
    assert falling.action_space == on.action_space
    assert (falling.spec.max_episode_steps, falling.spec.reward_threshold) == (1000, 3000.0)
    assert falling.spec.id == "FastHalfCheetahPyBulletEnv-v0"
