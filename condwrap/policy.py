"""Evaluate a policy without leaving a trace in it, and choose the tensor that its answer means.

Any callable is a policy. Running it a second time on perturbed observations must change nothing
that training depends on, nor must its own randomness or its batch statistics count as sensitivity.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch import distributions as td
from torch.nn.modules.batchnorm import _NormBase

Policy = Callable[[Any], Any]  # obs -> Tensor | Distribution | tuple, list or dict of them
Output = str | Callable[[Any], Any]

OUTPUTS = ("default", "mean", "logits", "probs")
_MEAN = (td.Normal, td.MultivariateNormal, td.LowRankMultivariateNormal)
_LOGITS = (td.Categorical, td.OneHotCategorical, td.Bernoulli)


def check_output(output: Output) -> None:
    """Raise unless `output` is a known name or a callable."""
    if not (isinstance(output, str) or callable(output)):
        raise TypeError(f"output must be a name or a callable, got {type(output).__name__}")
    if isinstance(output, str) and output not in OUTPUTS:
        raise ValueError(
            f"output must be one of {list(OUTPUTS)} or a callable answer -> tensor, got {output!r}"
        )


def flat_output(answer: Any, output: Output, batch: torch.Size, known: bool = False) -> Tensor:
    """The policy's answer as one floating tensor `[*batch, m]`.

    Args:
        answer: What the policy returned; the members of a tuple, list or dict are joined.
        output: "default" takes a tensor as it is, the mean of a Gaussian and the logits of a
            Categorical (normalized by PyTorch, so they are log-probabilities), OneHotCategorical
            or Bernoulli. "mean", "logits" and "probs" ask for that attribute of a distribution. A
            callable picks from the answer; what it returns is read as "default" does.
        batch: The leading axes that every tensor must have.
        known: The answer was computed elsewhere, so perhaps under autocast.

    Raises:
        TypeError: An answer that cannot be read, or an integer tensor.
        ValueError: The selector returned nothing, a tensor lost the batch axes, or a known answer
            is in half precision.
    """
    if callable(output):
        answer = output(answer)
        if answer is None:
            raise ValueError("the output selector returned None: it must return a tensor")
        output = "default"
    tensors = list(_tensors(answer, output))
    if not tensors:
        raise ValueError(
            f"the policy's answer holds no tensor: got an empty {type(answer).__name__}"
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
                f"answer must be float32 at least, got {x.dtype}, whose rounding would pass for "
                "sensitivity: leave answer out"
            )
    # bf16 and fp16 differences would lose J to rounding
    wide = (x if x.dtype == torch.float64 else x.float() for x in tensors)
    return torch.cat(
        [x.flatten(len(batch)) if x.ndim > len(batch) else x[..., None] for x in wide], -1
    )


def _tensors(answer: Any, output: str) -> Iterator[Tensor]:
    if isinstance(answer, Tensor):
        yield answer
    elif isinstance(answer, td.Distribution):
        yield _parameter(answer, output)
    elif isinstance(answer, Mapping):
        for value in answer.values():
            yield from _tensors(value, output)
    elif isinstance(answer, tuple | list):
        for value in answer:
            yield from _tensors(value, output)
    else:
        raise TypeError(
            "a policy must return a Tensor, a Distribution, or a tuple, list or dict of these, got "
            f"{type(answer).__name__}: pass output=lambda answer: ... to select the tensor"
        )


def _parameter(distribution: td.Distribution, output: str) -> Tensor:
    base = distribution.base_dist if isinstance(distribution, td.Independent) else distribution
    if output == "default":
        output = (
            "mean" if isinstance(base, _MEAN) else "logits" if isinstance(base, _LOGITS) else ""
        )
    try:
        value = getattr(base, output, None) if output else None
    except NotImplementedError:  # a mean that has no closed form
        value = None
    if value is None or (output == "mean" and isinstance(base, td.Categorical)):  # that is NaN
        raise TypeError(
            f"no {output or 'default output'} for {type(base).__name__}: "
            "pass output=lambda answer: ... to select the tensor"
        )
    return value  # type: ignore[no-any-return]


def check_reusable(policy: Policy) -> None:
    """Raise if a module would answer otherwise in `untouched`: dropout and batch norm in training.

    Dropout by a function, such as `F.dropout`, cannot be seen.
    """
    for module in _modules(policy):
        rate = getattr(module, "dropout", 0.0)  # of recurrent layers and attention
        drops = isinstance(rate, float) and rate > 0
        kinds = (_NormBase, nn.modules.dropout._DropoutNd)
        if module.training and (drops or isinstance(module, kinds)):
            raise ValueError(
                f"answer cannot be used with {type(module).__name__} in training mode, which would "
                "count as sensitivity: leave answer out"
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
            with _copied_buffers(found), torch.random.fork_rng(devices):
                yield
    finally:
        for norm in norms:
            norm.training = True


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
    elif depth and not torch.compiler.is_compiling():  # dynamo cannot look into a function
        if isinstance(policy, functools.partial):
            depth += 1  # it only adds arguments
            held = [policy.func, *policy.args, *policy.keywords.values()]
        elif inspect.ismethod(policy):
            held = [policy.__self__]
        elif inspect.isfunction(policy):
            names = policy.__code__.co_names
            held = [policy.__globals__[name] for name in names if name in policy.__globals__]
            for cell in policy.__closure__ or ():
                with contextlib.suppress(ValueError):  # a cell that is not yet filled
                    held.append(cell.cell_contents)
        else:
            held = list(getattr(policy, "__dict__", {}).values())
        for item in held:
            if not (isinstance(item, type) or inspect.ismodule(item)):
                yield from _reachable(item, depth - 1)
