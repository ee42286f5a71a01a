"""Evaluate a policy without leaving a trace in it, and choose the tensor that its output means.

Any callable is a policy. Running it a second time on perturbed observations must change nothing
that training depends on, nor must its own randomness or its batch statistics count as sensitivity.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch import distributions as td
from torch.nn.modules.batchnorm import _NormBase

Policy = Callable[[Any], Any]  # obs -> Tensor | Distribution | tuple, list or dict of them
Select = str | Callable[[Any], Any]

_measuring = contextvars.ContextVar("measuring", default=False)

SELECTIONS = ("default", "mean", "logits", "probs")
_MEAN = (td.Normal, td.MultivariateNormal, td.LowRankMultivariateNormal)
_LOGITS = (td.Categorical, td.OneHotCategorical, td.Bernoulli)


def check_select(select: Select) -> None:
    """Raise unless `select` is a known name or a callable."""
    if not (isinstance(select, str) or callable(select)):
        raise TypeError(f"select must be a name or a callable, got {type(select).__name__}")
    if isinstance(select, str) and select not in SELECTIONS:
        raise ValueError(
            f"select must be one of {list(SELECTIONS)} or a callable output -> tensor, "
            f"got {select!r}"
        )


def flat_output(output: Any, select: Select, batch: torch.Size, known: bool = False) -> Tensor:
    """The policy's output as one floating tensor `[*batch, m]`.

    Args:
        output: What the policy returned; the members of a tuple, list or dict are joined.
        select: "default" takes a tensor as it is, the mean of a Gaussian and the logits of a
            Categorical (normalized by PyTorch, so they are log-probabilities), OneHotCategorical
            or Bernoulli. "mean", "logits" and "probs" ask for that attribute of a distribution. A
            callable picks from the output; what it returns is read as "default" does.
        batch: The leading axes that every tensor must have.
        known: The output was computed elsewhere, so perhaps under autocast.

    Raises:
        TypeError: An output that cannot be read, or an integer tensor.
        ValueError: The selector returned nothing, a tensor lost the batch axes, or a known output
            is in half precision.
    """
    if callable(select):
        output = select(output)
        if output is None:
            raise ValueError("select returned None: it must return a tensor")
        select = "default"

    tensors = list(_tensors(output, select))
    if not tensors:
        raise ValueError(
            f"the policy's output holds no tensor: got an empty {type(output).__name__}"
        )
    for x in tensors:
        if x.shape[: len(batch)] != batch:
            raise ValueError(
                f"the policy's output must begin with the batch axes {tuple(batch)} of the "
                f"observations, got shape {tuple(x.shape)}"
            )
        if not x.is_floating_point():
            raise TypeError(
                f"the policy's output must be floating, got {x.dtype}: "
                "select the distribution's mean or logits, not the sampled action"
            )
        if known and x.dtype in (torch.bfloat16, torch.float16):
            raise ValueError(
                f"output must be float32 at least, got {x.dtype}, whose rounding would pass for "
                "sensitivity: leave output out"
            )

    # bf16 and fp16 differences would lose J to rounding
    wide = (x if x.dtype == torch.float64 else x.float() for x in tensors)
    return torch.cat(
        [x.flatten(len(batch)) if x.ndim > len(batch) else x[..., None] for x in wide], -1
    )


def _tensors(output: Any, select: str) -> Iterator[Tensor]:
    if isinstance(output, Tensor):
        yield output
    elif isinstance(output, td.Distribution):
        yield _parameter(output, select)
    elif isinstance(output, Mapping):
        for value in output.values():
            yield from _tensors(value, select)
    elif isinstance(output, tuple | list):
        for value in output:
            yield from _tensors(value, select)
    else:
        raise TypeError(
            "a policy must return a Tensor, a Distribution, or a tuple, list or dict of these, got "
            f"{type(output).__name__}: pass select=lambda output: ... to select the tensor"
        )


def _parameter(distribution: td.Distribution, select: str) -> Tensor:
    base = distribution.base_dist if isinstance(distribution, td.Independent) else distribution
    if select == "default" and isinstance(base, _MEAN):
        select = "mean"
    if select == "default" and isinstance(base, _LOGITS):
        select = "logits"

    try:
        value = getattr(base, select, None)
    except NotImplementedError:  # a mean that has no closed form
        value = None
    if value is None or (select == "mean" and isinstance(base, td.Categorical)):  # that is NaN
        raise TypeError(
            f"no {'default output' if select == 'default' else select} for {type(base).__name__}: "
            "pass select=lambda output: ... to select the tensor"
        )
    return value  # type: ignore[no-any-return]


def check_reusable(policy: Policy) -> None:
    """Raise if `untouched` would change the output: dropout or batch norm in training mode.

    Dropout by a function, such as `F.dropout`, cannot be seen.
    """
    for module in _modules(policy):
        rate = getattr(module, "dropout", 0.0)  # of recurrent layers and attention
        drops = isinstance(rate, float) and rate > 0
        kinds = (_NormBase, nn.modules.dropout._DropoutNd)
        if module.training and (drops or isinstance(module, kinds)):
            raise ValueError(
                f"output cannot be used with {type(module).__name__} in training mode, which would "
                "count as sensitivity: leave output out"
            )


@contextlib.contextmanager
def untouched(policy: Policy, device: torch.device) -> Iterator[None]:
    """Evaluate inside this, and the policy and the global generators are as they were.

    Batch norm runs on its running statistics: training-mode batch norm makes J depend on the other
    states. Buffers are replaced by copies for the time. The global generators are restored, so two
    evaluations, each in a context of its own, draw the same dropout masks. A compiled region can
    do neither of the last two.
    """
    found = _modules(policy)
    norms = [m for m in found if isinstance(m, _NormBase) and m.training]
    for norm in norms:
        if norm.running_mean is None:
            raise ValueError(
                f"{type(norm).__name__} without running statistics makes J depend on the other "
                "states of the batch: use track_running_stats=True, or put it in eval mode"
            )
    for norm in norms:
        norm.training = False
    try:
        if torch.compiler.is_compiling():
            yield
        else:
            devices = [device] if device.type == "cuda" else []
            with _copied_buffers(found), torch.random.fork_rng(devices), measuring():
                yield
    finally:
        for norm in norms:
            norm.training = True


def is_measuring() -> bool:
    """Whether a penalty or a diagnostic evaluates a policy: that is no call of a training loop."""
    return _measuring.get()


@contextlib.contextmanager
def measuring() -> Iterator[None]:
    """Mark evaluations, so that attached penalties leave them alone; `untouched` does it too."""
    token = _measuring.set(True)
    try:
        yield
    finally:
        _measuring.reset(token)


@contextlib.contextmanager
def _copied_buffers(modules: list[nn.Module]) -> Iterator[None]:
    kept = [(m, dict(m._buffers)) for m in modules if m._buffers]
    for module, buffers in kept:
        module._buffers.update({k: b if b is None else b.clone() for k, b in buffers.items()})
    try:
        yield
    finally:
        for module, buffers in kept:
            module._buffers.update(buffers)


def _modules(policy: Policy) -> list[nn.Module]:
    return list({id(m): m for root in _reachable(policy) for m in root.modules()}.values())


def _reachable(policy: Any, depth: int = 2) -> Iterator[nn.Module]:
    """The modules a callable holds: itself, its owner's, or those that it closes over or names."""
    if isinstance(policy, nn.Module):
        yield policy
        return
    if not depth or torch.compiler.is_compiling():  # dynamo cannot look into a function
        return

    below = depth if isinstance(policy, functools.partial) else depth - 1  # it only adds arguments
    for item in _held(policy):
        if not (isinstance(item, type) or inspect.ismodule(item)):
            yield from _reachable(item, below)


def _held(policy: Any) -> list[Any]:
    """What a callable holds directly."""
    if isinstance(policy, functools.partial):
        return [policy.func, *policy.args, *policy.keywords.values()]
    if inspect.ismethod(policy):
        return [policy.__self__]
    if not inspect.isfunction(policy):
        return list(getattr(policy, "__dict__", {}).values())

    names = policy.__code__.co_names
    held = [policy.__globals__[name] for name in names if name in policy.__globals__]
    for cell in policy.__closure__ or ():
        with contextlib.suppress(ValueError):  # a cell that is not yet filled
            held.append(cell.cell_contents)
    return held
