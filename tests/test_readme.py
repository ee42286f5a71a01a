"""What the README says is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
BLOCKS = re.findall(r"```python\n(.*?)```", PAGES[0].read_text(), re.DOTALL)


@pytest.mark.parametrize("code", BLOCKS, ids=range(len(BLOCKS)))
def test_its_code_runs(code):
    names: dict[str, object] = {}
    exec(code, names)
    if "loss" in names:
        names["loss"].backward()
        assert names["policy"].weight.grad.abs().sum() > 0
    elif "row" in names:
        assert 0 <= names["row"]["conditioning/psi"] <= 1
        if "handle" in names:
            assert names["row"]["attach/backwards"] == 1
        else:
            assert names["regularizer"].coefficient == 1e-2
    else:
        assert names["info"]["clean_obs"].shape == names["obs"].shape


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_it_names_exists(page):
    text = page.read_text()
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"\bmake ([a-z]+)", text)) <= targets
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if not link.startswith("http")]
    files = re.findall(r"`((?:baselines|harness|tests|condwrap)/[\w./]*)`", text)
    for name in files:
        assert (ROOT / name).exists(), name
    for link in links:
        assert (page.parent / link).exists(), link


def test_every_public_name_is_in_it():
    import condwrap

    text = PAGES[0].read_text()
    public = {name for name in condwrap.__all__ if name != "Conditioning"}
    assert all(f"`{name}`" in text for name in public)
