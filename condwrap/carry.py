"""An identity node whose backward pass adds a penalty's gradient: what `condwrap.attach` uses."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, distributions, nn
from torch.utils import _pytree as pytree

from condwrap.policy import Policy, check_reusable


@dataclasses.dataclass(frozen=True)
class Call:
    """One call of the module, for its backward pass."""

    module: nn.Module
    which: int | str
    """which argument is the observation, by position or name"""
    measure: Callable[[Policy, Any, Any], Tensor]
    """the scaled penalty of a policy, an observation and its known output, or None"""
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    output: Any
    carried: list[Tensor]
    """tensors of the output, those with a gradient"""
    inputs: list[Tensor]
    """tensors among the arguments, those that require a gradient"""
    parameters: dict[str, Tensor]
    """what the module had for its parameters during the call"""
    buffers: dict[str, Tensor]
    """the same for its buffers"""

    @property
    def learnt(self) -> list[Tensor]:
        """The parameters that require a gradient."""
        return [x for x in self.parameters.values() if x.requires_grad]

    def gradients(self) -> Sequence[Tensor | None]:
        """Of the scaled penalty: for carried, inputs and learnt parameters."""
        carried = [x.detach().requires_grad_() for x in self.carried]
        inputs = [x.detach().requires_grad_() for x in self.inputs]
        args, kwargs = replace_tensors((self.args, self.kwargs), self.inputs, inputs)
        obs = find_observation(args, kwargs, self.which)
        output = None
        if _is_reusable(self.module, carried):  # then pi(S) needs no second evaluation
            output = replace_tensors(self.output, self.carried, carried)

        own = dict(self.module.named_parameters())
        lent = any(own.get(name) is not x for name, x in self.parameters.items())

        def policy(obs: Any) -> Any:
            given, named = _with_obs(args, kwargs, self.which, obs)
            if not lent:
                return self.module(*given, **named)
            # functional_call lends parameters for one call: a call in backward has to lend them
            buffers = {name: x.clone() for name, x in self.buffers.items()}
            state = self.parameters | buffers
            return torch.func.functional_call(self.module, state, given, named)

        with torch.enable_grad():
            penalty = self.measure(policy, obs, output)
            leaves = [*carried, *inputs, *self.learnt]
            if not penalty.requires_grad:  # a coefficient of 0
                return [None] * len(leaves)
            return torch.autograd.grad(penalty, leaves, allow_unused=True)


class Carry(torch.autograd.Function):
    """The identity on `carried`, whose backward adds the penalty's gradient."""

    @staticmethod
    def forward(ctx: Any, call: Call, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.call = call
        ctx.set_materialize_grads(False)
        return tuple(x.view_as(x) for x in tensors[: len(call.carried)])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "an attached penalty cannot be differentiated twice: create_graph=True would count "
                "it in Hessian-vector products. Remove the handle, or put the module in eval mode, "
                "for this call; add the penalty to the loss to differentiate it twice"
            )
        of_penalty = ctx.call.gradients()
        of_loss = [*gradients, *[None] * (len(of_penalty) - len(gradients))]
        return None, *[_add(x, y) for x, y in zip(of_loss, of_penalty, strict=True)]


def _add(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    if one is None:
        return other
    return one if other is None else one + other


def _is_reusable(module: nn.Module, output: list[Tensor]) -> bool:
    """Whether the penalty can take the output of the loop's own call for pi(S)."""
    try:
        check_reusable(module)
    except ValueError:  # dropout or batch norm in training mode
        return False
    return all(x.dtype in (torch.float32, torch.float64) for x in output)


def find_observation(args: tuple[Any, ...], kwargs: dict[str, Any], which: int | str) -> Any:
    """The argument that is the observation."""
    try:
        return kwargs[which] if isinstance(which, str) else args[which]
    except (KeyError, IndexError):
        raise ValueError(
            f"obs={which!r} names no argument of the module's call, which had {len(args)} by "
            f"position and {', '.join(kwargs) or 'none'} by name: pass attach(..., obs=...)"
        ) from None


def _with_obs(
    args: tuple[Any, ...], kwargs: dict[str, Any], which: int | str, obs: Any
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments with another observation."""
    if isinstance(which, str):
        return args, {**kwargs, which: obs}
    return (*args[:which], obs, *args[which + 1 :]), kwargs


# --- tensors in a structure ----------------------------------------------------------------------


def tensors_in(structure: Any) -> list[Tensor]:
    """Each tensor of a tuple, list, dict or Distribution, once."""
    found: dict[int, Tensor] = {}
    for leaf in pytree.tree_leaves(structure):
        if isinstance(leaf, Tensor):
            found[id(leaf)] = leaf
        elif isinstance(leaf, distributions.Distribution):
            found |= {id(x): x for x in tensors_in(vars(leaf))}
    return list(found.values())


def replace_tensors(structure: Any, old: Sequence[Tensor], new: Sequence[Tensor]) -> Any:
    """The structure with new tensors in the place of old ones; a Distribution is copied."""
    table = {id(x): y for x, y in zip(old, new, strict=True)}

    def replace(leaf: Any) -> Any:
        if isinstance(leaf, distributions.Distribution):
            copied = copy.copy(leaf)
            vars(copied).update(pytree.tree_map(replace, vars(leaf)))
            return copied
        return table.get(id(leaf), leaf)

    return pytree.tree_map(replace, structure)
