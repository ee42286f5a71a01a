"""How many small changes to a module do its tests notice? `make mutate` prints a table of it.

    python tests/mutation --sample 60 condwrap/functional.py

Each mutant runs against the test file that mirrors its module and the module's doctests, and each
one that passes is printed. The changes are mutmut's, but not the runner: mutmut changes no defaults
of dataclasses, no decorated functions and no code outside functions, and `torch.compile` cannot
trace its trampolines. Here a mutant is written to a copy of the tree and tested in a fork of this
process, which finds PyTorch and the like already imported.

equivalent.txt lists the survivors that a reader found to compute the same, as they are printed.
They are left out of the count.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import pytest
from changes import make_mutants

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent.txt").read_text().splitlines()
PRELOAD = ("torch._dynamo", "gymnasium.vector", "hypothesis", "jax.numpy", "tyro", "pandas",
           "matplotlib.pyplot", "scipy.stats", "torch.utils.tensorboard")  # fmt: skip
PYTEST = ["-x", "-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
ALSO = {  # tests of a module beside the file that mirrors it
    "baselines/trpo_reg.py": [
        "tests/baselines/test_shared.py",  # what is ppo_reg's is tested there
        "tests/baselines/test_pinned.py::test_numbers_change_only_with_the_version[trpo_reg]",
    ],
    "condwrap/estimators.py": ["tests/condwrap/test_known_output.py"],
    "condwrap/policy.py": ["tests/condwrap/test_known_output.py"],
    "condwrap/regularizer.py": ["tests/condwrap/test_known_output.py"],
}


def find_tests(module: Path) -> list[str]:
    """The file that mirrors the module, or else the folder; what stands beside; the doctests."""
    folder = Path("tests", module.parent)
    mirror = folder / f"test_{module.stem}.py"
    tests = mirror if (ROOT / mirror).exists() else folder
    return [str(tests), *ALSO.get(str(module), []), str(module)]


def copy_tree(to: Path) -> None:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(command, cwd=ROOT, text=True).splitlines():
        if (ROOT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)


def passes(tests: list[str], limit: float, log: Path) -> bool:
    """Whether the tests pass in a fork of this process; one that exceeds the limit fails."""
    child = os.fork()
    if child == 0:
        try:
            os.setsid()
            output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            os._exit(pytest.main([*PYTEST, *tests]))
        finally:
            traceback.print_exc()
            os._exit(70)

    end = time.monotonic() + limit
    status = None
    while status is None and time.monotonic() < end:
        done, code = os.waitpid(child, os.WNOHANG)
        status = code if done else None
        time.sleep(0.02)

    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what the tests left running, too
    if status is None:
        os.waitpid(child, 0)
    return status == 0


def measure(module: Path, tree: Path, sample: int, seed: int) -> tuple[int, int]:
    """Mutants of a module that are not equivalent, and how many survived."""
    source = (tree / module).read_text()
    mutants = make_mutants(source)
    names = [name for name in mutants if f"{module}: {name}" not in EQUIVALENT]
    if 0 < sample < len(names):
        names = random.Random(seed).sample(names, sample)
    if not names:
        return 0, 0

    tests = find_tests(module)
    log = tree / "mutation.log"
    started = time.monotonic()
    if not passes(tests, 3600, log):
        sys.exit(f"the tests of {module} fail without a mutant:\n{log.read_text()}")
    limit = 30 + 5 * (time.monotonic() - started)

    survived = 0
    for name in names:
        (tree / module).write_text(mutants[name])
        if passes(tests, limit, log):
            survived += 1
            print(f"{module}: {name}", flush=True)
    (tree / module).write_text(source)
    return len(names), survived


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="+", help="files, or folders for all files in them")
    parser.add_argument("--sample", type=int, default=0, help="mutants of a module; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    args = parser.parse_args()

    modules: list[Path] = []
    for name in args.modules:
        modules += sorted(Path(name).rglob("*.py")) if Path(name).is_dir() else [Path(name)]

    rows = ["| module | mutants | survived | score |", "|---|--:|--:|--:|"]
    with tempfile.TemporaryDirectory() as folder:
        copy_tree(Path(folder))
        os.chdir(folder)
        sys.path[0] = folder  # in place of tests/mutation
        os.environ["PYTHONPATH"] = folder
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        sys.dont_write_bytecode = True  # two mutants of one second and size would share it
        for name in PRELOAD:
            importlib.import_module(name)

        for module in modules:
            count, survived = measure(module, Path(folder), args.sample, args.seed)
            if count:
                rows.append(f"| {module} | {count} | {survived} | {1 - survived / count:.1%} |")
                print(rows[-1], flush=True)
    print("\n".join(rows))


if __name__ == "__main__":
    main()
