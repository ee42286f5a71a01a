"""Memory over a million steps: that of a long run must not grow."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STEPS = 1_000_000  # of all agents, with few epochs, so that the environments take most of the time
SETTINGS = {
    "ppo_reg": ["--env-id=harness.envs.fast_bullet:FastReacherBulletEnv-v0"],
    "ppo_reg_population": [
        "--env-id=harness.envs.fast_bullet:FastHopperBulletEnv-v0", "--num-agents=10",
    ],
}  # fmt: skip


def resident(process: subprocess.Popen) -> float:
    """Memory of a running process, in MiB."""
    pages = Path(f"/proc/{process.pid}/statm").read_text().split()
    return int(pages[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20 if pages else 0.0


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("program", SETTINGS)
def test_memory_stays_flat_over_a_million_steps(tmp_path, program):
    agents = 10 if program.endswith("population") else 1
    updates = STEPS // agents // 2000
    where = tmp_path / ("agent_{agent}" if agents > 1 else "agent_0")
    command = [sys.executable, "-m", f"baselines.{program}", *SETTINGS[program]]
    command += [f"--total-timesteps={STEPS // agents}", "--num-minibatches=4", "--update-epochs=1"]
    command += ["--vf-epochs=1", "--checkpoint-interval=5", f"--run-dir={where}"]
    metrics, seen = tmp_path / "agent_0" / "metrics.csv", {}
    with open(tmp_path / "log.txt", "wb") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)
        try:
            while process.poll() is None:
                if metrics.exists():
                    done = metrics.read_text().count("\n") - 1
                    seen[done] = max(seen.get(done, 0.0), resident(process))
                time.sleep(0.2)
        finally:
            process.kill()
    assert process.returncode == 0, (tmp_path / "log.txt").read_text()
    half = max(mib for done, mib in seen.items() if done <= updates / 2)
    end = max(mib for done, mib in seen.items() if done > 0.9 * updates)
    # 64 bytes a step; what the allocator keeps varies by 20 MiB
    assert end < half + 32, seen
