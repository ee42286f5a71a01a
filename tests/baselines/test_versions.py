"""The numbers of a short run of each baseline, pinned: they change with its VERSION alone.

Where a change of the numbers is meant, raise the baseline's VERSION and pin what the failure shows.
"""

from __future__ import annotations

import pytest

from baselines import ppo_reg, ppo_reg_population, trpo_reg, trpo_reg_population
from tests.baselines.helpers import name, read_metrics

COLUMNS = (
    "charts/episodic_return",
    "losses/value_loss",
    "losses/entropy",
    "losses/explained_variance",
    "conditioning/psi",
    "conditioning/quotient_q50",
)
PINNED = {
    ppo_reg: (2, [-1317.422, 0.3849326, 1.418972, -3.906939, 0.9181402, 0.04137731]),
    trpo_reg: (2, [-1329.296, 0.3662902, 1.414507, -3.706142, 0.8958539, 0.05227669]),
}
POPULATIONS = {ppo_reg: ppo_reg_population, trpo_reg: trpo_reg_population}
PAIRS = [(single, x) for single in PINNED for x in (single, POPULATIONS[single])]


@pytest.mark.parametrize(("single", "program"), PAIRS, ids=lambda x: name(x))
def test_the_numbers_change_with_the_version_alone(single, program, tmp_path):
    version, pinned = PINNED[single]
    several = {} if program is single else {"num_agents": 2}
    path = tmp_path / "a0" if program is single else tmp_path / "a{agent}"
    settings = {"env_id": "Pendulum-v1", "num_steps": 100, "num_minibatches": 4}
    program.train(program.Args(**settings, total_timesteps=200, run_dir=path, **several))
    rows = read_metrics(tmp_path / "a0")
    found = [float(rows[-1][column]) for column in COLUMNS]
    assert version == program.VERSION
    # other processors round otherwise, and two short updates make little of it
    assert found == pytest.approx(pinned, rel=1e-3, abs=1e-4)
