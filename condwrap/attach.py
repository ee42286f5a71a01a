"""Regularize a module inside a training loop that you do not edit.

The module's output passes through an identity node. In the backward pass the node adds the
penalty's gradient to the loss's, as if the loss had been `loss + penalty`.
"""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from condwrap.carry import Call, Carry, find_observation, replace_tensors, tensors_in
from condwrap.penalties.protocol import Result
from condwrap.policy import Policy, is_measuring, measuring

Scale = float | Callable[[], float]


class Attachable(Protocol):
    """A penalty that needs no more than observations and output."""

    def __call__(self, policy: Policy, obs: Any, *, output: Any = None) -> Result: ...


def attach(module: nn.Module, penalty: Attachable, *, obs: int | str = 0) -> Attached:
    """Add a penalty's gradient to every backward pass through a module.

    Where the loss can be edited, `loss + penalty(policy, obs).penalty` is clearer. Here the loop,
    the loss and the optimizer stay as they are:

    - A call of the module in training mode with gradients is penalized, once for each backward
      pass through its output. In evaluation mode, under `no_grad` and under `inference_mode`
      nothing happens.
    - The gradient is that of loss + scale · penalty, for the module's parameters and for inputs
      that require one, such as the features of a shared trunk. The loss that the loop prints does
      not contain the penalty.
    - The penalty is computed in the backward pass. An output that is never differentiated costs
      nothing and draws no noise.
    - With losses divided by k for gradient accumulation, set `handle.scale = 1 / k`. With a
      GradScaler, set `handle.scale = scaler.get_scale`.
    - A copy and a pickle of the module are without the penalty. An unpickled one needs condwrap.

    Args:
        module: Returns a tensor, a Distribution, or a tuple, list or dict of them. It is the
            policy: the mean or the logits should be what counts of its output.
        penalty: Such as a `ConditioningRegularizer`.
        obs: Which argument of the module is the observation, by position or name. The others,
            such as recurrent states, are not perturbed.

    Returns:
        A handle, which is a context manager too: `metrics()`, `scale`, `remove()`.

    Raises:
        TypeError: `module` is no module.
        ValueError: The penalty needs more than observations and output.
        RuntimeError: In the backward pass, under `create_graph=True`.

    Example:
        >>> import torch
        >>> from condwrap import ConditioningRegularizer, attach
        >>> policy = torch.nn.Linear(4, 2)
        >>> handle = attach(policy, ConditioningRegularizer(coefficient=0.1))
        >>> policy(torch.ones(8, 4)).square().mean().backward()
        >>> handle.metrics()["attach/backwards"]
        1.0
    """
    return Attached(module, penalty, obs)


def _check(module: nn.Module, penalty: Attachable) -> None:
    """Raise unless the penalty can be computed from a call of the module."""
    if not isinstance(module, nn.Module):
        raise TypeError(
            f"module must be a torch.nn.Module, got {type(module).__name__}: pass the policy's "
            "network, or add penalty(policy, obs).penalty to the loss"
        )
    needs = [name for name in getattr(penalty, "needs", ()) if name != "output"]
    if needs:
        raise ValueError(
            f"{type(penalty).__name__} needs {' and '.join(needs)}, which a module's call does not "
            f"tell: add {type(penalty).__name__}(...)(policy, obs, "
            f"{', '.join(f'{name}=...' for name in needs)}).penalty to the loss instead"
        )


class Attached:
    """The handle of an attached penalty; see `attach`."""

    scale: Scale
    """factor of the penalty's gradient, or a callable that gives it at each backward pass"""

    def __init__(self, module: nn.Module, penalty: Attachable, obs: int | str = 0) -> None:
        _check(module, penalty)
        self.module = module
        self.penalty = penalty
        self.obs = obs
        self.scale = 1.0
        self._forwards = 0
        self._sums: dict[str, float] = {}
        self._backwards = 0
        self._hook = module.register_forward_hook(Hook(self._on_call), with_kwargs=True)

    def metrics(self) -> dict[str, float]:
        """Means of the penalty's metrics over the backward passes since the last call.

        `attach/forwards` counts the calls that could have been penalized, and `attach/backwards`
        those that were.
        """
        found = {name: total / self._backwards for name, total in self._sums.items()}
        found["attach/forwards"] = float(self._forwards)
        found["attach/backwards"] = float(self._backwards)

        self._sums = {}
        self._forwards = 0
        self._backwards = 0
        return found

    def remove(self) -> None:
        """Leave the module as it was. Outputs from before are still penalized in backward."""
        self._hook.remove()

    def __enter__(self) -> Attached:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.remove()

    def _on_call(
        self, module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], output: Any
    ) -> Any:
        return self._carry(args, kwargs, output)

    @torch.compiler.disable  # type: ignore[untyped-decorator]
    def _carry(self, args: tuple[Any, ...], kwargs: dict[str, Any], output: Any) -> Any:
        """The output, through a node whose backward adds the penalty's gradient."""
        if is_measuring() or not (self.module.training and torch.is_grad_enabled()):
            return None  # which leaves the output as it is
        carried = [x for x in tensors_in(output) if x.requires_grad]
        if not carried:
            return None

        find_observation(args, kwargs, self.obs)  # an error belongs here, not in the backward pass
        self._forwards += 1
        call = Call(
            module=self.module,
            which=self.obs,
            measure=self._measure,
            args=args,
            kwargs=kwargs,
            output=output,
            carried=carried,
            inputs=[x for x in tensors_in((args, kwargs)) if x.requires_grad],
            parameters=dict(self.module.named_parameters()),
            buffers=dict(self.module.named_buffers()),
        )
        passed = Carry.apply(call, *carried, *call.inputs, *call.learnt)  # type: ignore[no-untyped-call]
        return replace_tensors(output, carried, passed)

    def _measure(self, policy: Policy, obs: Any, output: Any) -> Tensor:
        """The scaled penalty; its metrics are kept."""
        with measuring():
            result = self.penalty(policy, obs, output=output)

        self._record(result.metrics())
        scale = self.scale() if callable(self.scale) else self.scale
        return result.penalty * scale

    def _record(self, metrics: dict[str, float]) -> None:
        """Keep what one backward pass measured."""
        for name, value in metrics.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._backwards += 1


class Hook:
    """A hook of a module. A copy and a pickle of it do nothing."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)

    def __reduce__(self) -> tuple[Callable[[], Any], tuple[()]]:
        return _make_inert, ()


def _make_inert() -> Callable[..., None]:
    return _inert


def _inert(*_: Any) -> None:
    """A forward hook that leaves the output as it is."""
