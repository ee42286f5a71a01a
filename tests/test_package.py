"""What is installed, and what a user of it meets."""

from __future__ import annotations

import inspect
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import condwrap
from condwrap import spectrum, wrappers

ROOT = Path(__file__).parents[1]
PUBLIC = [getattr(condwrap, name) for name in condwrap.__all__]
PUBLIC += [
    member
    for module in (spectrum, wrappers)
    for name, member in vars(module).items()
    if not name.startswith("_") and getattr(member, "__module__", None) == module.__name__
]


@pytest.mark.parametrize("member", PUBLIC, ids=lambda member: member.__name__)
def test_every_public_name_has_an_example(member):
    assert ">>>" in inspect.getdoc(member)


def test_the_wheel_ships_condwrap_alone_with_its_types(tmp_path):
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, ROOT]
    subprocess.run([sys.executable, *words], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    packages = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert packages == {"condwrap"}
    assert "condwrap/py.typed" in names
    assert {f"condwrap/{p.name}" for p in (ROOT / "condwrap").glob("*.py")} <= set(names)


def test_importing_it_imports_no_framework_that_it_does_not_need():
    code = "import sys, condwrap; print({'gymnasium', 'jax', 'scipy'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert out.stdout.strip() == "set()"
