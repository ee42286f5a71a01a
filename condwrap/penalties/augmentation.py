"""DrAC's regularizer: the same actions and values for an observation and its augmentation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch import distributions as td
from torch.utils import _pytree as pytree

from condwrap.jacobian import read_states
from condwrap.observation import States
from condwrap.penalties.checks import check_weight, read_value, require
from condwrap.penalties.distributions import detached, find_distribution, per_state
from condwrap.penalties.evaluation import evaluate
from condwrap.penalties.noise import Noise
from condwrap.penalties.protocol import Penalized, penalized
from condwrap.penalties.random_shift import RandomShift
from condwrap.policy import Policy, check_reusable


class AugmentationConsistency(Noise):
    """coefficient · mean [KL(π(· | s) ‖ π(· | s̃)) + ½ (V(s) - V(s̃))²], s̃ an augmentation of s.

    From Raileanu et al., "Automatic Data Augmentation for Generalization in Reinforcement
    Learning" (2021, arXiv 2006.12862): DrAC, with 0.1. π(· | s) and V(s) are targets without a
    gradient. Their code has the ½ and estimates the KL up to a constant by -log π(a | s̃), a drawn
    from π(· | s); here it is exact.

    Args:
        coefficient: α_r, at least 0. With 0 it is measured and nothing reaches the loss.
        augment: obs -> obs of the same batch size. By default `RandomShift(pad=4)`, for images
            `[B, channels, height, width]`, which draws from the penalty's generator.
        value_term: Whether values count.
        seed: Of the penalty's own generator, on the CPU.
        generator: A generator to use instead.

    A call needs a policy that returns a distribution, and with a value term `value`: either the
    critic, a callable obs -> V, or V(s) as a tensor. In that case the policy must return
    (distribution, V), as a network with one trunk does, and V(s̃) is read from its answer. V is
    `[B]` or `[B, 1]`. It uses `output`. Its metrics are `drac_policy` and `drac_value`, the means
    of the KL and of the halved square.

    Raises:
        TypeError, ValueError: An argument outside what is stated above or missing, or at a call
            what `ConditioningRegularizer` refuses.

    Example:
        >>> logits = torch.nn.Linear(2, 3)
        >>> policy = lambda obs: torch.distributions.Categorical(logits=logits(obs))
        >>> penalty = AugmentationConsistency(augment=lambda obs: obs, value_term=False)
        >>> penalty(policy, torch.ones(4, 2)).metrics()
        {'penalty/drac_policy': 0.0}
    """

    def __init__(
        self,
        coefficient: float = 0.1,
        augment: Callable[[Any], Any] | None = None,
        *,
        value_term: bool = True,
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(seed, generator)
        self.coefficient = check_weight("coefficient", coefficient)
        self.augment = augment or RandomShift(generator=self.generator)
        self.value_term = value_term

    @property
    def needs(self) -> tuple[str, ...]:
        return ("value",) if self.value_term else ()

    def __call__(
        self,
        policy: Policy,
        obs: Any,
        *,
        output: Any = None,
        next_obs: Any = None,
        dones: Tensor | None = None,
        actions: Tensor | None = None,
        value: Any = None,
    ) -> Penalized:
        """The penalty on these observations, `[B, *obs_shape]`; the class says what it needs."""
        if self.value_term:
            reason = "pass the critic or V(obs), or set value_term=False"
            require("AugmentationConsistency", reason, value=value)
        states = read_states(obs, "default")
        with torch.no_grad():
            augmented = read_states(self.augment(obs), "default")
            if augmented.batch != states.batch:
                sizes = f"{augmented.batch[0]} of {states.batch[0]}"
                raise ValueError(f"augment must keep the number of states, got {sizes}")
            if output is None:
                output = evaluate(policy, states)
            else:
                check_reusable(policy)
        target = detached(find_distribution(output, states, "AugmentationConsistency"))

        with torch.set_grad_enabled(self.coefficient > 0 and torch.is_grad_enabled()):
            answer = evaluate(policy, augmented)
            moved = find_distribution(answer, augmented, "AugmentationConsistency")
            divergence = per_state(td.kl_divergence(target, moved)).mean()
            terms = {"drac_policy": (self.coefficient, divergence)}
            if self.value_term:
                old, new = values(value, states, augmented, answer)
                terms["drac_value"] = (self.coefficient, (old - new).square().mean() / 2)
            return penalized(terms)


def values(value: Any, states: States, augmented: States, answer: Any) -> tuple[Tensor, Tensor]:
    """V of the states, without a gradient, and of their augmentations, `[B]` each."""
    if callable(value):
        with torch.no_grad():
            old = read_value(evaluate(value, states), states, "value(obs)")
        return old, read_value(evaluate(value, augmented), states, "value(obs)")

    beside = [x for x in pytree.tree_leaves(answer) if isinstance(x, Tensor)]
    if len(beside) != 1:
        raise TypeError(
            "value was given as a tensor, so the policy must return (distribution, V), got "
            f"{len(beside)} tensors beside the distribution: pass the critic, a callable, instead"
        )
    old = read_value(value, states, "value")
    return old.detach(), read_value(beside[0], states, "V beside the distribution")
