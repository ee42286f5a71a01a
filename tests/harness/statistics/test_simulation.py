"""What the verdicts do where nothing is true, and where something is: thousands of data sets.

Every data set passes through the functions that the report calls. A false word is a "win", "loss",
"supported" or "contradicted" anywhere in a claim on which nothing is true. The bound is the upper
end of the 95% interval of its rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from scipy import stats

from harness.report.cost import LIMIT
from harness.statistics import (
    ALPHA,
    compare_success,
    holm,
    sign_flip_interval,
    sign_flip_test,
    spearman,
)
from harness.statistics.judgements import associate, compare_arms

pytestmark = pytest.mark.slow

SETS = 10_000
AT_ONCE = 250
ALLOWED = 0.06
Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.normal(size=shape)


def tenth(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A tenth of the agents succeed: they have 10, and the rest about 0."""
    return 10.0 * (rng.random(shape) < 0.1) + 0.1 * rng.normal(size=shape)


def scores(
    rng: np.random.Generator, draw: Draw, sets: int, tasks: int, arms: int, n: int
) -> np.ndarray:
    """Scores `[sets, tasks, arms, n]` of arms that differ in nothing.

    Tasks have scales of their own. What a (seed, agent) shares between the arms makes pairs alike:
    from not at all on the first task to half of the variance on the last.
    """
    share = np.linspace(0.0, 0.5, tasks)[:, None, None]
    shared = draw(rng, (sets, tasks, 1, n))
    own = draw(rng, (sets, tasks, arms, n))
    scale = 10.0 ** np.linspace(0, 3, tasks)[:, None, None]
    return scale * (np.sqrt(share) * shared + np.sqrt(1 - share) * own)


def batches(seed: int, sets: int = SETS) -> Iterator[tuple[np.random.Generator, int]]:
    rng = np.random.default_rng(seed)
    for _ in range(sets // AT_ONCE):
        yield rng, AT_ONCE


def bound(false: int, sets: int = SETS) -> float:
    """Upper end of the two-sided 95% interval of a rate (Clopper and Pearson)."""
    return float(stats.beta.ppf(0.975, false + 1, sets - false))


def check(name: str, false: int, sets: int = SETS) -> None:
    print(
        f"{name}: false words in {100 * false / sets:.2f}%, at most {100 * bound(false, sets):.2f}%"
    )
    assert bound(false, sets) <= ALLOWED, name


def contrasts(arms: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First and second arms of claims (b) and (c), of PPO, PPO reg, TRPO and TRPO reg."""
    ppo, ppo_reg, trpo, trpo_reg = np.moveaxis(arms, -2, 0)
    return (
        np.stack([ppo, trpo], axis=1), np.stack([ppo_reg, trpo_reg], axis=1),
        np.stack([ppo, ppo_reg], axis=1), np.stack([trpo, trpo_reg], axis=1),
    )  # fmt: skip


def any_word(headline: np.ndarray, tasks: np.ndarray) -> int:
    """Data sets with a word anywhere in the claim."""
    told = (headline != 0).any(axis=-1) | (tasks != 0).any(axis=(-2, -1))
    return int(told.sum())


# --- nothing is true ------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [10, 30])
@pytest.mark.parametrize("draw", [normal, tenth])
def test_claims_b_and_c_of_equal_arms(n, draw):
    """table1: 8 tasks, 4 algorithms."""
    false = {"b": 0, "c": 0}
    for rng, sets in batches(seed=n):
        b_first, b_second, c_first, c_second = contrasts(scores(rng, draw, sets, 8, 4, n))
        for letter, first, second in (("b", b_first, b_second), ("c", c_first, c_second)):
            found = compare_arms(first, second)
            false[letter] += any_word(found.headline.word, found.tasks.word)
    for letter, count in false.items():
        check(f"({letter}) table1, {draw.__name__}, n = {n}", count)


def unrelated(
    rng: np.random.Generator, draw: Draw, sets: int, tasks: int, settings: int, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """psi `[sets, 2, rows, n]` and score `[sets, rows, n]` that have nothing to do with each other.

    Settings have effects of their own on both, and agents of one (seed, agent) are alike in all
    settings of a task. Early psi is half of late psi.
    """
    effects = 3 * rng.normal(size=(2, sets, tasks, settings, 1))
    shared = [draw(rng, (sets, tasks, 1, n)) for _ in range(2)]
    score = effects[0] + shared[0] + draw(rng, (sets, tasks, settings, n))
    late = effects[1] + shared[1] + draw(rng, (sets, tasks, settings, n))
    early = late + draw(rng, (sets, tasks, settings, n))
    rows = (sets, tasks * settings, n)
    return np.stack([late.reshape(rows), early.reshape(rows)], axis=1), score.reshape(rows)


@pytest.mark.parametrize("n", [10, 30])
@pytest.mark.parametrize("draw", [normal, tenth])
@pytest.mark.parametrize(("tasks", "settings"), [(4, 4), (8, 2)], ids=["figure1", "table1"])
def test_claim_a_of_unrelated_psi(n, draw, tasks, settings):
    """figure1: 4 tasks, 4 settings. table1: 8 tasks, PPO and TRPO."""
    false = 0
    numbers = np.repeat(np.arange(tasks), settings)
    for rng, sets in batches(seed=n):
        found = associate(*unrelated(rng, draw, sets, tasks, settings, n), numbers)
        false += any_word(found.headline.word, found.tasks.word)
    check(f"(a) {tasks} tasks x {settings} settings, {draw.__name__}, n = {n}", false)


@pytest.mark.parametrize("n", [10, 30])
def test_claim_a_of_drifting_psi_and_reward(n):
    """psi and reward both drift as an agent learns, each for reasons of its own."""
    updates = 20
    false = 0
    over_training = 0
    numbers = np.repeat(np.arange(4), 4)
    for rng, sets in batches(seed=n):
        steps = rng.normal(size=(2, sets, 16, n, updates)) + 0.3  # both rise
        psi, reward = steps.cumsum(axis=-1)
        late = psi[..., -2:].mean(axis=-1)
        early = psi[..., :2].mean(axis=-1)
        score = reward[..., -2:].mean(axis=-1)
        found = associate(np.stack([late, early], axis=1), score, numbers)
        false += any_word(found.headline.word, found.tasks.word)
        together = spearman(np.diff(psi, axis=-1), np.diff(reward, axis=-1)).mean(axis=1)
        over_training += int((sign_flip_test(together) <= ALPHA).sum())
    check(f"(a) drifting, n = {n}", false)
    check(f"(a) over training, reported, n = {n}", over_training)


@pytest.mark.parametrize("runs", [5, 10])
def test_claim_d_of_equal_agents(runs):
    """Four pairs of agents on seen and unseen levels; runs and levels vary, and repeats do."""
    levels = 60
    false = 0
    for rng, sets in batches(seed=runs):
        shape = (sets, 8, 2, runs, levels)
        ability = 0.5 * rng.normal(size=(sets, 8, 2, runs, 1))
        difficulty = 1.5 * rng.normal(size=(sets, 8, 1, 1, levels))
        taste = 0.5 * rng.normal(size=(sets, 8, 2, 1, levels))  # of an arm for a level
        chance = 1 / (1 + np.exp(-(ability + difficulty + taste + 0.3 * rng.normal(size=shape))))
        rates = rng.binomial(20, chance) / 20
        found = compare_success(rates[:, :, 1] - rates[:, :, 0])
        false += int((holm(found.p) <= ALPHA).any(axis=-1).sum())
    check(f"(d) {runs} training runs", false)


@pytest.mark.parametrize("repetitions", [6, 10, 16])
def test_claim_e_at_its_limit(repetitions):
    """The penalty adds exactly the limit; repetitions are noisy."""
    rng = np.random.default_rng(repetitions)
    added = LIMIT + 0.02 * rng.normal(size=(SETS, repetitions))
    low, high = sign_flip_interval(added)
    check(f"(e) {repetitions} repetitions", int(((high <= LIMIT) | (low > LIMIT)).sum()))


# --- something is true ----------------------------------------------------------------------------


def power(n: int, effect: float, sets: int = 1000) -> tuple[float, float, float]:
    """How often one headline, one task, and more than half of the tasks are found.

    The effect is in standard deviations of an arm, on every task, for PPO and TRPO alike.
    """
    headline = task = most = 0.0
    for rng, drawn in batches(seed=n, sets=sets):
        arms = scores(rng, normal, drawn, 8, 4, n)
        deviation = 10.0 ** np.linspace(0, 3, 8)[:, None]
        first, second, _, _ = contrasts(arms)
        found = compare_arms(first, second + effect * deviation)
        headline += (found.headline.word == 1).mean()
        task += (found.tasks.word == 1).mean()
        most += ((found.tasks.word == 1).sum(axis=-1) > 4).mean()
    parts = sets // AT_ONCE
    print(f"n = {n}, effect {effect}: headline {headline / parts:.0%}, task {task / parts:.0%}, "
          f"on most tasks {most / parts:.0%}")  # fmt: skip
    return headline / parts, task / parts, most / parts


def test_one_deviation_is_found_on_most_tasks_by_thirty_agents():
    headline, task, most = power(30, 1.0)
    assert headline > 0.99
    assert task > 0.9
    assert most > 0.95


def test_one_deviation_is_found_by_the_headline_of_ten_agents():
    headline, _, _ = power(10, 1.0)
    assert headline > 0.99
    power(10, 0.5)  # printed: what ten agents can and cannot tell


@pytest.mark.parametrize("n", [12, 30])
def test_what_could_have_been_found_is_found_four_times_in_five(n):
    """An effect of the size that a task's finding states, one of 16 where no test is decided."""
    rng = np.random.default_rng(n)
    arms = scores(rng, normal, 1000, 8, 4, n)
    first, second, _, _ = contrasts(arms)
    stated = np.median(compare_arms(first, second).tasks.detectable, axis=0)[..., None]
    found = compare_arms(first, second + stated)
    rate = (found.tasks.p <= ALPHA / 5 / 16).mean()
    print(f"n = {n}: an effect of the stated size is found in {rate:.0%}")
    assert 0.7 < rate < 0.9


@pytest.mark.parametrize("n", [10, 30])
def test_a_headline_finds_what_it_states_four_times_in_five(n):
    rng = np.random.default_rng(n)
    deviation = 10.0 ** np.linspace(0, 3, 8)[:, None]
    first, second, _, _ = contrasts(scores(rng, normal, 1000, 8, 4, n))
    stated = np.median(compare_arms(first, second).headline.detectable)
    found = compare_arms(first, second + stated * deviation)
    rate = (found.headline.p <= ALPHA * 4 / 5 / 2).mean()
    print(f"n = {n}: a headline of the stated size is found in {rate:.0%}")
    assert 0.7 < rate < 0.9
