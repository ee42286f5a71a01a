"""Populations learn as single runs do: the comparison, and a short run of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.baselines.agreement import compare, curves, returns

ROOT = Path(__file__).parents[2]


def write_runs(folder: Path, ends: list[float], updates: int = 20) -> None:
    """Runs whose returns rise from 0 and stay at their ends for the second half."""
    for agent, end in enumerate(ends):
        path = folder / "suite" / f"ppo__Hopper__s1__a{agent}" / "metrics.csv"
        path.parent.mkdir(parents=True)
        values = np.minimum(np.arange(updates) * 2 * end / updates, end)
        rows = "".join(f"{i},{x}\n" for i, x in enumerate(values))
        path.write_text("global_step,charts/episodic_return\n" + rows)


def test_returns_are_means_of_the_last_updates_up_to_a_share(tmp_path):
    write_runs(tmp_path, [10.0, 20.0])
    got = curves(tmp_path, "ppo__Hopper")
    assert returns(got, 0.1).tolist() == [0.5, 1.0]  # of updates 0 and 1, the only ones so far
    assert returns(got, 0.5).tolist() == [7.0, 14.0]  # of 5 to 9
    assert returns(got, 1.0).tolist() == [10.0, 20.0]


def test_samples_that_differ_are_told_from_samples_that_do_not(tmp_path):
    rng = np.random.default_rng(0)
    write_runs(tmp_path / "together", rng.normal(100, 5, 10).tolist())
    write_runs(tmp_path / "alone", rng.normal(100, 5, 10).tolist())
    write_runs(tmp_path / "broken", rng.normal(50, 5, 10).tolist())
    table = compare(tmp_path / "together", tmp_path / "alone")
    assert table["p"].min() > 0.05
    assert table["of training"].tolist() == ["10%", "25%", "50%", "100%"]
    assert compare(tmp_path / "together", tmp_path / "broken")["p"].max() < 1e-4


def test_unfinished_runs_are_not_compared(tmp_path):
    write_runs(tmp_path, [10.0])
    write_runs(tmp_path / "suite_2", [10.0], updates=10)
    (tmp_path / "suite_2" / "suite").rename(tmp_path / "other")
    with pytest.raises(SystemExit, match="not finished"):
        curves(tmp_path, "ppo__Hopper")


def test_runs_of_other_lengths_are_not_compared(tmp_path):
    write_runs(tmp_path / "together", [10.0, 12.0])
    write_runs(tmp_path / "alone", [10.0, 12.0], updates=10)
    with pytest.raises(SystemExit, match="2 of 20 together, 2 of 10 alone"):
        compare(tmp_path / "together", tmp_path / "alone")


@pytest.mark.slow
def test_ten_agents_together_return_what_ten_alone_do(tmp_path):
    """Of 20 updates, in which a double pendulum learns to stand several times as long."""
    suite = str(ROOT / "tests" / "baselines" / "agreement.toml")
    command = [sys.executable, "-m", "harness", "run-all", "--suite", suite, "--seeds=1"]
    command += ["--env=InvertedDoublePendulum", "--total-timesteps=40_000"]
    for folder, flags in (("together", []), ("alone", ["--plain"])):
        where = f"--results-dir={tmp_path / folder}"
        subprocess.run([*command, where, *flags], cwd=ROOT, check=True, capture_output=True)
    table = compare(tmp_path / "together", tmp_path / "alone")
    assert (table["p"] > 1e-3).all(), table
    for kind in ("ppo-reg", "trpo-reg"):
        kind += "__InvertedDoublePendulum"
        together, alone = (curves(tmp_path / name, kind) for name in ("together", "alone"))
        np.testing.assert_allclose(together[:, 0], alone[:, 0], rtol=1e-4)  # not yet parted
        assert returns(together, 1.0).mean() > 2 * returns(together, 0.1).mean()
