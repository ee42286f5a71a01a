"""Run an example of a framework, with condwrap and without it."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from types import ModuleType

import pytest
import torch

EXAMPLES = Path(__file__).parents[2] / "examples"


def require(*names: str) -> None:
    """Skip this file unless the packages are there. Warnings of their imports are theirs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in names:
            pytest.importorskip(name)


def load(name: str) -> ModuleType:
    """The example as a module of its own."""
    path = EXAMPLES / f"{name}.py"
    assert len(path.read_text().splitlines()) <= 40, "an example has at most 40 lines"
    assert path.read_text().count("# condwrap\n") == 1, "one line regularizes"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spec.loader.exec_module(module)
    return module


class Nothing:
    """In the place of `attach` it leaves everything as it is."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        pass

    def metrics(self) -> dict[str, float]:
        return {}


def weights(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Copies of the module's tensors; some frameworks keep the optimizers' states beside them."""
    state = module.state_dict().items()
    return {name: x.detach().clone() for name, x in state if isinstance(x, torch.Tensor)}


def assert_same_bits(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    assert len(one) > 0
    for name, x in one.items():
        assert torch.equal(x, other[name]), name


def tensorboard(folder: Path | str, tag: str = "conditioning/psi") -> list[float]:
    """What was written under a tag, in order."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return [event.value for event in events.Scalars(tag)]


def gradients(module: torch.nn.Module) -> list[torch.Tensor]:
    """The gradients, taken away from the parameters."""
    found = [x.grad for x in module.parameters() if x.grad is not None]
    for parameter in module.parameters():
        parameter.grad = None
    assert found
    return found


def assert_close(found: list[torch.Tensor], expected: list[torch.Tensor]) -> None:
    """In float32: the same numbers, summed in another order."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
