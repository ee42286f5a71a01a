"""How often the interval of a mean holds the mean: the table in harness.statistics.intervals."""

from __future__ import annotations

import numpy as np
import pytest

from harness.statistics import estimate_mean

pytestmark = pytest.mark.slow

SETS = 10_000


def draw(name: str, rng: np.random.Generator, n: int) -> tuple[np.ndarray, float]:
    """Scores of a distribution, and its mean."""
    if name == "normal":
        return rng.normal(size=n), 0.0
    if name == "exponential":
        return rng.exponential(size=n), 1.0
    if name == "lognormal":
        return rng.lognormal(size=n), float(np.exp(0.5))
    share = float(name)  # have 1, the others 0, and a grain of noise
    return 1.0 * (rng.random(n) < share) + 0.01 * rng.normal(size=n), share


@pytest.mark.parametrize(
    ("name", "percents"),
    [
        ("normal", (95, 95, 95)),
        ("exponential", (91, 93, 95)),
        ("lognormal", (86, 89, 93)),
        ("0.5", (94, 98, 97)),
        ("0.3", (83, 97, 97)),
        ("0.1", (41, 65, 95)),
    ],
)
def test_intervals_hold_the_mean_as_often_as_the_table_says(name, percents):
    for n, percent in zip((5, 10, 30), percents, strict=True):
        rng = np.random.default_rng(n)
        held = 0
        furthest = 0.0
        for _ in range(SETS):
            values, truth = draw(name, rng, n)
            _, low, high, _ = estimate_mean(values, skewed=False)
            held += low <= truth <= high
            outside = max(values.min() - low, high - values.max())
            furthest = max(furthest, outside / np.ptp(values))
        print(f"{name}, n = {n}: {held / SETS:.1%}, at most {furthest:.2f} ranges outside")
        assert 100 * held / SETS == pytest.approx(percent, abs=1.2)
        assert furthest < 0.3
