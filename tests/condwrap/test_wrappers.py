"""The observation wrappers, alone and over every kind of vector environment."""

import functools
import inspect
import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorWrapper

from condwrap.wrappers import PerturbObservation, VectorPerturbObservation

SPACES = {
    "vector": spaces.Box(-0.5, 0.5, (3,), np.float32),
    "float64": spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
    "image": spaces.Box(0, 255, (4, 4, 3), np.uint8),
    "dark image": spaces.Box(10, 60, (4, 4), np.uint8),
    "dict": spaces.Dict(
        {
            "vector": spaces.Box(-0.5, 0.5, (3,), np.float32),
            "mode": spaces.Discrete(3),
            "inner": spaces.Dict(
                {
                    "image": spaces.Box(0, 255, (2, 2), np.uint8),
                    "count": spaces.Box(0, 9, (2,), np.int64),
                }
            ),
        }
    ),
}
every_space = pytest.mark.parametrize("space", SPACES)
every_mode = pytest.mark.parametrize("mode", list(AutoresetMode))


class Random(gym.Env):
    """Random observations in episodes of random length, all from the environment's generator."""

    def __init__(self, space):
        self.observation_space = space
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 6))
        return self.observe(), {"left": self.left}

    def step(self, action):
        self.left -= 1
        over = self.left == 0
        return self.observe(), float(action), over and action == 0, over, {"left": self.left}

    def observe(self):
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample()


def perturbed(space="vector", **options):
    return PerturbObservation(Random(SPACES[space]), **options)


def episode(env, seed, steps=4):
    """(observation, info) of a reset and some steps; resets without a seed where one ends."""
    seen = [env.reset(seed=seed)]
    for t in range(steps):
        obs, _, terminated, truncated, info = env.step(t % 2)
        seen.append((obs, info))
        if terminated or truncated:
            seen.append(env.reset())
    return seen


def observations(seen):
    return [obs for obs, _ in seen]


def clean(seen):
    return [info["clean_obs"] for _, info in seen]


def same(a, b):
    return data_equivalence(a, b, exact=True)


# --- one environment --------------------------------------------------------------------------


def test_delta_has_the_length_of_the_radius():
    for obs, info in episode(perturbed("float64", radius=0.3), seed=0, steps=20):
        assert np.linalg.norm(obs - info["clean_obs"]) == pytest.approx(0.3)


def test_delta_is_drawn_anew_at_each_step():
    seen = episode(perturbed("float64"), seed=0, steps=5)
    deltas = [obs - info["clean_obs"] for obs, info in seen]
    assert len({delta.tobytes() for delta in deltas}) == len(deltas)


@every_space
def test_observations_stay_in_the_space(space):
    env = perturbed(space, radius=3.0)
    seen = episode(env, seed=0, steps=20)
    assert all(obs in env.observation_space for obs in observations(seen))
    assert all(obs in env.observation_space for obs in clean(seen))
    assert not any(same(obs, info["clean_obs"]) for obs, info in seen)


def test_bounds_are_reached_and_kept():
    seen = episode(perturbed("vector", radius=3.0), seed=0, steps=20)
    coordinates = np.stack(observations(seen))
    assert coordinates.min() == -0.5
    assert coordinates.max() == 0.5


def test_images_are_perturbed_in_units_of_255_and_rounded():
    # every pixel moves by 255 · 0.1 = 25.5, which rounds to the even neighbour
    env = perturbed("image", perturbation=lambda noise: np.full_like(noise, 0.1))
    for obs, info in episode(env, seed=0, steps=20):
        before = info["clean_obs"].astype(float)
        assert obs.dtype == np.uint8
        np.testing.assert_array_equal(obs, np.clip(np.round(before + 25.5), 0, 255))
        np.testing.assert_array_less(before - 0.5, obs)


def test_a_dict_shares_one_delta_and_other_leaves_pass():
    env = perturbed("dict", perturbation=lambda noise: np.arange(len(noise)) / 255)
    for obs, info in episode(env, seed=0):
        before = info["clean_obs"]
        assert obs["mode"] == before["mode"]
        np.testing.assert_array_equal(obs["inner"]["count"], before["inner"]["count"])
        # the image's key comes first: it has coordinates 0 to 3, the vector 4 to 6
        image = before["inner"]["image"].flatten() + np.arange(4.0)
        np.testing.assert_array_equal(obs["inner"]["image"].flatten(), image.clip(0, 255))
        vector = before["vector"] + np.arange(4, 7) / 255
        np.testing.assert_allclose(obs["vector"], vector.clip(-0.5, 0.5), rtol=1e-6)


def test_three_boxes_take_their_parts_in_order():
    names = ("a", "b", "c")
    boxes = [spaces.Box(-9, 9, (n,), np.float64) for n in (1, 2, 3)]
    env = Random(spaces.Dict(dict(zip(names, boxes, strict=True))))
    shown, info = PerturbObservation(env, perturbation=lambda x: np.arange(6.0) / 6).reset(seed=0)
    expected = {"a": [0], "b": [1, 2], "c": [3, 4, 5]}
    for name in names:
        moved = info["clean_obs"][name] + np.array(expected[name]) / 6
        np.testing.assert_allclose(shown[name], moved.clip(-9, 9))


@every_space
def test_the_environments_own_trajectory_is_not_changed(space):
    plain = episode(Random(SPACES[space]), seed=5, steps=20)
    seen = episode(perturbed(space), seed=5, steps=20)
    assert same(clean(seen), observations(plain))
    assert all(
        {k: v for k, v in info.items() if k != "clean_obs"} == expected
        for (_, info), (_, expected) in zip(seen, plain, strict=True)
    )


def test_resets_of_a_real_environment_are_not_changed():
    plain, wrapped = gym.make("CartPole-v1"), PerturbObservation(gym.make("CartPole-v1"))
    for seed in (3, None, None):
        obs, _ = plain.reset(seed=seed)
        _, info = wrapped.reset(seed=seed)
        assert same(info["clean_obs"], obs)


def test_the_same_seed_gives_the_same_perturbations():
    env = perturbed()
    first, again, other = (observations(episode(env, seed)) for seed in (1, 1, 2))
    assert same(first, again)
    assert same(first, observations(episode(perturbed(), 1)))
    assert not same(first, other)


def test_without_a_seed_the_stream_continues():
    env = perturbed("float64")
    env.reset(seed=1)
    states = []
    for _ in range(2):
        obs, info = env.reset()
        states.append(obs - info["clean_obs"])
    rng = np.random.default_rng(np.random.SeedSequence(1, spawn_key=(0x636F6E64,)))
    expected = [rng.standard_normal(4) for _ in range(3)][1:]
    for delta, noise in zip(states, expected, strict=True):
        np.testing.assert_allclose(delta.flatten(), noise / np.linalg.norm(noise))


def test_the_environment_is_given_the_options_of_a_reset():
    given = []

    class Listening(Random):
        def reset(self, *, seed=None, options=None):
            given.append(options)
            return super().reset(seed=seed)

    PerturbObservation(Listening(SPACES["vector"])).reset(seed=1, options={"level": 3})
    assert given == [{"level": 3}]


def test_two_environments_never_seeded_differ():
    deltas = [obs - info["clean_obs"] for obs, info in (perturbed("float64").reset() for _ in "ab")]
    assert not same(*deltas)


@every_space
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*observation space (min|max)imum value is -?infinity")
def test_the_environment_checker_passes(space):
    check_env(perturbed(space), skip_render_check=True)


WRAPPERS = [PerturbObservation, VectorPerturbObservation]


def wrap(wrapper, space, **options):
    env = Random(space)
    vector = wrapper is VectorPerturbObservation
    return wrapper(SyncVectorEnv([lambda: env]) if vector else env, **options)


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_every_constructor_argument_is_recorded(wrapper):
    parameters = list(inspect.signature(wrapper.__init__).parameters)[2:]
    assert parameters == ["perturbation", "radius"]
    options = {"perturbation": "uniform", "radius": 0.25}
    assert wrap(wrapper, SPACES["vector"], **options)._saved_kwargs == options


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_a_sphere_of_length_1_is_the_default(wrapper):
    env = wrap(wrapper, SPACES["float64"])
    obs, info = env.reset(seed=0)
    assert np.linalg.norm(obs - info["clean_obs"]) == pytest.approx(1.0)
    assert env._saved_kwargs == {"perturbation": "sphere", "radius": 1.0}


@pytest.mark.parametrize(
    "options", [{}, {"perturbation": "uniform", "radius": 0.25}, {"perturbation": "gaussian"}]
)
def test_an_environment_is_rebuilt_from_its_spec(options):
    env = PerturbObservation(gym.make("CartPole-v1"), **options)
    rebuilt = gym.make(env.spec)
    assert isinstance(rebuilt, PerturbObservation)
    assert same(observations(episode(rebuilt, 1)), observations(episode(env, 1)))


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"radius": 0.0}, ValueError, "radius must be finite and above 0, got 0.0"),
        ({"perturbation": "cube"}, ValueError, "perturbation must be one of"),
        ({"perturbation": None}, TypeError, "perturbation must be a name or a callable"),
        ({"perturbation": abs, "radius": 2.0}, ValueError, "radius=2.0 goes with a named"),
    ],
)
def test_an_argument_is_refused(wrapper, options, error, message):
    with pytest.raises(error, match=re.escape(message)):
        wrap(wrapper, SPACES["vector"], **options)


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3),
        spaces.Box(0, 9, (2,), np.int64),
        spaces.Dict({"mode": spaces.Discrete(3)}),
    ],
)
def test_a_space_without_floating_or_uint8_boxes_is_refused(wrapper, space):
    message = f"a floating or uint8 Box, or a Dict that holds one, got {space}: scale integer"
    with pytest.raises(TypeError, match=re.escape(message)):
        wrap(wrapper, space)


# --- vector environments ----------------------------------------------------------------------

NUM_ENVS = 3


def drive(envs, mode, seed=3, steps=15):
    """(observation, info, which environments these are new for) of a reset and some steps."""
    everyone = np.ones(NUM_ENVS, dtype=bool)
    obs, info = envs.reset(seed=seed)
    seen = [(obs, info, everyone)]
    for t in range(steps):
        obs, _, terminations, truncations, info = envs.step(np.full(NUM_ENVS, t % 2))
        seen.append((obs, info, everyone))
        over = terminations | truncations
        if mode == AutoresetMode.DISABLED and over.any():
            obs, info = envs.reset(options={"reset_mask": over.copy()})
            seen.append((obs, info, over))
    return seen


def row(space, values, i):
    """Of environment i: from an array of objects, an array, or a dict of arrays."""
    if isinstance(values, dict):
        return {key: row(inner, values[key], i) for key, inner in space.spaces.items()}
    return values[i]


def final_rows(space, info):
    """The clean and the perturbed last observation of each environment whose episode ended."""
    if "final_obs" not in info:
        return []
    over = info["_final_obs"]
    assert same(over, info["final_info"]["_clean_obs"])
    return [
        (i, info["final_obs"][i], row(space, info["final_info"]["clean_obs"], i))
        for i in np.flatnonzero(over).tolist()
    ]


def sync(space, mode, wrap_each=False, **options):
    def make():
        env = Random(SPACES[space])
        return PerturbObservation(env, **options) if wrap_each else env

    return SyncVectorEnv([make] * NUM_ENVS, autoreset_mode=mode)


@every_mode
@every_space
def test_the_vector_wrapper_equals_a_vector_of_wrapped_environments(space, mode):
    options = {"perturbation": "gaussian", "radius": 0.2}
    outside = drive(VectorPerturbObservation(sync(space, mode), **options), mode)
    inside = drive(sync(space, mode, wrap_each=True, **options), mode)
    ended = 0
    for (obs, info, new), (expected, expected_info, _) in zip(outside, inside, strict=True):
        assert same(obs, expected)
        assert same(info["_clean_obs"], expected_info["_clean_obs"])
        for i in np.flatnonzero(new):
            kept = (row(SPACES[space], x["clean_obs"], i) for x in (info, expected_info))
            assert same(*kept)
        final = final_rows(SPACES[space], info)
        assert same(final, final_rows(SPACES[space], expected_info))
        ended += len(final)
        assert info.keys() == expected_info.keys()
    assert (ended > 0) == (mode == AutoresetMode.SAME_STEP)


@every_mode
@every_space
def test_clean_observations_are_those_of_the_unwrapped_vector(space, mode):
    plain = drive(sync(space, mode), mode)
    wrapped = drive(VectorPerturbObservation(sync(space, mode)), mode)
    for (obs, info, _), (expected, expected_info, _) in zip(wrapped, plain, strict=True):
        assert same(info["clean_obs"], expected)
        assert not same(obs, expected)
        assert same(info.get("_final_obs"), expected_info.get("_final_obs"))
        for i, shown, before in final_rows(SPACES[space], info):
            assert same(before, expected_info["final_obs"][i])
            assert not same(shown, before)


def test_what_else_is_said_of_a_final_step_is_kept():
    mode = AutoresetMode.SAME_STEP
    wrapped = drive(VectorPerturbObservation(sync("vector", mode)), mode)
    plain = drive(sync("vector", mode), mode)
    kept = [(info, own) for (_, info, _), (_, own, _) in zip(wrapped, plain, strict=True)]
    kept = [(info["final_info"], own["final_info"]) for info, own in kept if "final_info" in own]
    assert kept
    for final_info, own in kept:
        assert own.keys() >= {"left", "_left"}
        assert same({name: final_info[name] for name in own}, own)


def test_final_observations_without_further_infos_are_perturbed_too():
    class Bare(VectorWrapper):
        def step(self, actions):
            *results, info = self.env.step(actions)
            return *results, {k: v for k, v in info.items() if k != "final_info"}

    mode = AutoresetMode.SAME_STEP
    seen = drive(VectorPerturbObservation(Bare(sync("float64", mode)), radius=0.3), mode)
    rows = [r for _, info, _ in seen for r in final_rows(SPACES["float64"], info)]
    assert rows
    for _, shown, clean in rows:
        assert np.linalg.norm(shown - clean) == pytest.approx(0.3)


@every_mode
def test_worker_processes_give_the_same(mode):
    make = functools.partial(gym.make, "CartPole-v1", max_episode_steps=4)
    seen = []
    # fresh processes: forking one that runs threads is unsafe
    for vector in (SyncVectorEnv, functools.partial(AsyncVectorEnv, context="spawn")):
        envs = VectorPerturbObservation(vector([make] * NUM_ENVS, autoreset_mode=mode), radius=0.1)
        seen.append(drive(envs, mode, steps=8))
        envs.close()
    for (obs, info, _), (expected, expected_info, _) in zip(*seen, strict=True):
        assert same(obs, expected)
        assert same(info, expected_info)


def test_a_masked_reset_leaves_the_other_environments_as_they_were():
    mode = AutoresetMode.DISABLED
    envs = VectorPerturbObservation(sync("float64", mode))
    before, _ = envs.reset(seed=0)
    mask = np.array([False, True, False])
    after, info = envs.reset(seed=[7, 8, 9], options={"reset_mask": mask.copy()})
    assert [same(a, b) for a, b in zip(before, after, strict=True)] == [True, False, True]
    assert same(info["_clean_obs"], mask)
    # only the environment that was reset took its seed
    alone = VectorPerturbObservation(sync("float64", mode))
    expected, _ = alone.reset(seed=[7, 8, 9])
    assert same(after[1], expected[1])
    still_first, _ = envs.reset(seed=[0, None, None], options={"reset_mask": ~mask})
    assert same(still_first[0], before[0])
    assert not same(still_first[2], before[2])


def test_the_callers_mask_can_be_used_again():
    """What `info` says of a reset stays when the caller writes the next mask into its array."""
    envs = VectorPerturbObservation(sync("float64", AutoresetMode.DISABLED))
    envs.reset(seed=0)
    mask = np.array([False, True, False])
    _, info = envs.reset(options={"reset_mask": mask})
    mask[:] = True
    assert info["_clean_obs"].tolist() == [False, True, False]


def test_seeds_of_environments_that_are_not_reset_change_nothing():
    shown = []
    for seed in ([7, 8, 9], [None, 8, None]):
        envs = VectorPerturbObservation(sync("float64", AutoresetMode.DISABLED))
        envs.reset(seed=0)
        envs.reset(seed=seed, options={"reset_mask": np.array([False, True, False])})
        obs, *_ = envs.step(np.zeros(NUM_ENVS, dtype=int))
        shown.append(obs)
    assert same(*shown)


def test_seeds_are_as_the_vector_environment_spreads_them():
    envs = VectorPerturbObservation(sync("vector", AutoresetMode.NEXT_STEP))
    by_int, _ = envs.reset(seed=5)
    by_list, _ = envs.reset(seed=[5, 6, 7])
    assert same(by_int, by_list)
    without, _ = envs.reset()
    assert not same(without, by_list)


@every_space
def test_vector_observations_stay_in_the_space(space):
    mode = AutoresetMode.SAME_STEP
    envs = VectorPerturbObservation(sync(space, mode), radius=3.0)
    for obs, info, _ in drive(envs, mode):
        assert obs in envs.observation_space
        assert info["clean_obs"] in envs.observation_space
        for _, shown, _ in final_rows(SPACES[space], info):
            assert shown in envs.single_observation_space
