"""What to know of a policy's conditioning, in a short table."""

from __future__ import annotations

import copy
import dataclasses
import html
import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from condwrap.observation import States
from condwrap.policy import Policy
from condwrap.policy import _modules as modules_of
from condwrap.regularizer import ConditioningRegularizer
from condwrap.sensitivity import measure_spectrum, name_values

SHOWN = 5  # observed values that are named


@dataclasses.dataclass(frozen=True)
class Summary:
    """What `summary` returns: printed, it is a table; in a notebook too; `to_dict` is for a log."""

    states: int
    """how many states it was measured on"""
    inputs: int
    """perturbed numbers of one observation, n"""
    outputs: int
    """numbers of the output that count, m"""
    lambda_min: float
    lambda_max: float
    """the range that psi is of"""
    quotient: tuple[float, float, float]
    """quantiles of J: 5%, 50%, 95%"""
    psi: float
    """mean over the states"""
    fraction_below: float
    fraction_above: float
    largest: float
    """median over the states of the Jacobian's largest singular value"""
    root_mean_square: float
    """root of the mean squared singular value, √(mean ‖Jacobian‖²_F / min(m, n))"""
    smallest: float
    """median of the smallest; NaN where the estimate is matrix-free"""
    condition_number: float
    """median of largest over smallest; NaN where the estimate is matrix-free"""
    exact: bool
    """whether the Jacobians were computed, or estimated without holding them"""
    most_sensitive: tuple[tuple[str, float], ...]
    """observed values with the largest root-mean-square ‖column of the Jacobian‖, largest first"""
    inert: tuple[str, ...]
    """observed values that move nothing in any state"""
    suggested_range: tuple[float, float]
    """5% and 95% of J: with it the penalty acts on the tenth of the states at the ends"""
    share: float
    """of the loss's gradient that `coefficient` is for"""
    coefficient: float | None
    """at which ‖gradient of the penalty‖ = share · ‖gradient of the loss‖; None without a loss, or
    where psi has no gradient"""

    def to_dict(self, prefix: str = "summary/") -> dict[str, float]:
        """Its numbers under names that begin with `prefix`, for a logger."""
        low, median, high = self.quotient
        found = {
            "quotient_q05": low,
            "quotient_q50": median,
            "quotient_q95": high,
            "psi": self.psi,
            "fraction_below": self.fraction_below,
            "fraction_above": self.fraction_above,
            "singular_value_max": self.largest,
            "singular_value_rms": self.root_mean_square,
            "singular_value_min": self.smallest,
            "condition_number": self.condition_number,
            "inert": float(len(self.inert)),
        }
        if self.coefficient is not None:
            found["coefficient"] = self.coefficient
        return {f"{prefix}{name}": value for name, value in found.items()}

    @property
    def rows(self) -> list[tuple[str, str]]:
        """What the table shows: a name and a text."""
        low, median, high = map(_short, self.quotient)
        how = "" if self.exact else " (estimated)"
        rows = [
            ("J", f"5% {low}   median {median}   95% {high}"),
            (
                f"psi for [{self.lambda_min:g}, {self.lambda_max:g}]",
                f"{_short(self.psi)}; {self.fraction_below:.0%} of the states below, "
                f"{self.fraction_above:.0%} above",
            ),
            ("singular values", f"{self._singular_values}{how}"),
            ("most sensitive to", _join(f"{name} {_short(x)}" for name, x in self.most_sensitive)),
            ("moved by nothing in", _join(self.inert)),
            ("suggested range", "[{}, {}]".format(*map(_short, self.suggested_range))),
        ]
        if self.exact:
            rows.insert(3, ("condition number", _short(self.condition_number)))
        if self.coefficient is not None:
            what = f"gives the penalty {self.share:.0%} of the loss's gradient"
            rows.append(("coefficient", f"{_short(self.coefficient)} {what}"))
        return [(name, text) for name, text in rows if text]

    @property
    def _singular_values(self) -> str:
        found = {"largest": self.largest, "root mean square": self.root_mean_square}
        if self.exact:
            found["smallest"] = self.smallest
        return "   ".join(f"{name} {_short(value)}" for name, value in found.items())

    def __str__(self) -> str:
        width = max(len(name) for name, _ in self.rows)
        lines = [f"{name:<{width}}  {text}" for name, text in self.rows]
        return "\n".join([self._title, *lines])

    def _repr_html_(self) -> str:
        cells = [
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
            for name, text in self.rows
        ]
        return f"<table><caption>{html.escape(self._title)}</caption>{''.join(cells)}</table>"

    @property
    def _title(self) -> str:
        return (
            f"Conditioning on {self.states} states: {self.inputs} observed values, "
            f"{self.outputs} outputs"
        )


def summary(
    policy: Policy,
    obs: Any,
    regularizer: ConditioningRegularizer | None = None,
    *,
    loss: Tensor | None = None,
    share: float = 0.1,
    max_states: int = 256,
) -> Summary:
    """Measure a policy's conditioning on a batch of observations.

    J and psi are those of the regularizer, along random directions. The singular values are of the
    Jacobian d output / d observation: exact up to 64 outputs, otherwise estimated without holding
    it. The policy, the regularizer and the global random state are left as they were.

    Args:
        policy: Any callable obs -> tensor, distribution, or tuple or dict of them.
        obs: `[B, *obs_shape]`, floating or uint8, or a dict of these.
        regularizer: Its range, radius and selection are used; by default the paper's.
        loss: A scalar that depends on the policy's parameters, for a coefficient.
        share: Of the loss's gradient that the penalty's should be, above 0.
        max_states: How many states are measured at most, evenly spaced in the batch.

    Raises:
        TypeError, ValueError: As for `ConditioningRegularizer`, or a share or max_states that is
            not above 0, or a loss that does not depend on the policy's parameters.

    Example:
        >>> policy = torch.nn.Linear(3, 2, bias=False)
        >>> policy.weight.data = torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> found = summary(policy, torch.ones(8, 3))
        >>> found.largest, found.condition_number, found.inert
        (3.0, 1.5, ('[1]',))
    """
    if not share > 0:
        raise ValueError(f"share must be above 0, got {share}")
    if max_states < 1:
        raise ValueError(f"max_states must be at least 1, got {max_states}")
    regularizer = _own(regularizer or ConditioningRegularizer())
    states = States.read(obs, regularizer.obs_scale, regularizer.batch_ndim)
    states = states.subset(min(1.0, max_states / states.batch[0]))
    obs = pytree.tree_unflatten(states.tensors, states.spec)

    with torch.no_grad():
        measured = regularizer(policy, obs)
        spectrum = measure_spectrum(policy, obs, regularizer.select)
    quotient = measured.quotient.flatten()
    levels = torch.tensor([0.05, 0.5, 0.95], dtype=quotient.dtype, device=quotient.device)
    low, median, high = quotient.quantile(levels).tolist()
    norms = spectrum.column_norms
    names = name_values(states)
    largest = norms.argsort(descending=True)[:SHOWN].tolist()
    return Summary(
        states=math.prod(states.batch),
        inputs=len(norms),
        outputs=spectrum.outputs,
        lambda_min=regularizer.lambda_min,
        lambda_max=regularizer.lambda_max,
        quotient=(low, median, high),
        psi=measured.psi.mean().item(),
        fraction_below=measured.fraction_below.item(),
        fraction_above=measured.fraction_above.item(),
        largest=spectrum.largest,
        root_mean_square=spectrum.root_mean_square,
        smallest=spectrum.smallest,
        condition_number=spectrum.condition_number,
        exact=spectrum.exact,
        most_sensitive=tuple((names[i], norms[i].item()) for i in largest if norms[i] > 0),
        inert=tuple(name for name, norm in zip(names, norms.tolist(), strict=True) if norm == 0),
        suggested_range=(low, high),
        share=share,
        coefficient=None if loss is None else _coefficient(policy, obs, regularizer, loss, share),
    )


def _coefficient(
    policy: Policy, obs: Any, regularizer: ConditioningRegularizer, loss: Tensor, share: float
) -> float | None:
    """Share · ‖gradient of the loss‖ / ‖gradient of mean psi‖."""
    parameters = [
        x for module in modules_of(policy) for x in module.parameters() if x.requires_grad
    ]
    parameters = list({id(x): x for x in parameters}.values())
    of_loss = torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
    if all(x is None for x in of_loss):
        raise ValueError("loss must depend on the policy's parameters, got one that does not")
    of_psi = torch.autograd.grad(regularizer(policy, obs).penalty, parameters, allow_unused=True)
    length = _norm(of_psi)
    return share * _norm(of_loss) / length if length else None


def _norm(gradients: Iterable[Tensor | None]) -> float:
    return math.sqrt(sum(x.double().square().sum().item() for x in gradients if x is not None))


def _own(regularizer: ConditioningRegularizer) -> ConditioningRegularizer:
    """A copy with coefficient 1 that draws from a generator of its own."""
    found = copy.copy(regularizer)
    found.coefficient = 1.0
    found.fraction = 1.0
    found.printed_sign = False
    found.generator = torch.Generator(regularizer.generator.device)
    found.generator.set_state(regularizer.generator.get_state())
    return found


def _short(value: float) -> str:
    return f"{value:.3g}"


def _join(names: Iterable[str]) -> str:
    """The first names, and how many more there are."""
    found = list(names)
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return ", ".join(found[:SHOWN]) + more
