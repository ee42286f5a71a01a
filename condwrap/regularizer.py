"""The regularizer: perturb the observations, measure J, penalize what lies outside the range."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from condwrap.estimators import ESTIMATORS
from condwrap.functional import check_range, clamping_penalty, conditioning_quotient
from condwrap.observation import States, take_evenly
from condwrap.perturbation import Perturbation, get_perturbation
from condwrap.policy import Policy, Select, check_reusable, check_select, flat_output


@dataclasses.dataclass(frozen=True)
class Conditioning:
    """What a `ConditioningRegularizer` returns; B is the number of states it was estimated on.

    With `reduction="batch"` psi and quotient have shape `[]`.

    Example:
        >>> import torch
        >>> conditioning = ConditioningRegularizer()(torch.nn.Linear(4, 2), torch.ones(8, 4))
        >>> conditioning.quotient.shape, conditioning.psi.requires_grad
        (torch.Size([8]), False)
    """

    penalty: Tensor
    """coefficient · mean(psi), `[]`: add it to the loss. A constant 0 if the coefficient is 0."""
    psi: Tensor
    """Squared distance of J from the range, `[B]`, detached."""
    quotient: Tensor
    """J, `[B]`, detached."""
    fraction_below: Tensor
    """Share of the states with J < lambda_min, `[]`, in [0, 1]."""
    fraction_above: Tensor
    """Share of the states with J > lambda_max, `[]`, in [0, 1]."""

    def metrics(self, prefix: str = "conditioning/") -> dict[str, float]:
        """The numbers to log, as Python floats under names that begin with `prefix`.

        `psi` is the mean of psi, `quotient_q05`, `_q50` and `_q95` are quantiles of J,
        `quotient_squared` is the mean of J², beside `fraction_below` and `fraction_above`.

        Example:
            >>> import torch
            >>> policy = torch.nn.Linear(1, 1, bias=False)
            >>> policy.weight.data = torch.tensor([[0.5]])
            >>> metrics = ConditioningRegularizer()(policy, torch.ones(8, 1)).metrics()
            >>> metrics["conditioning/psi"], metrics["conditioning/quotient_q50"]
            (0.25, 0.5)
        """
        quotient = self.quotient.flatten()
        levels = torch.tensor([0.05, 0.5, 0.95], dtype=quotient.dtype, device=quotient.device)
        q05, q50, q95 = quotient.quantile(levels)
        tensors = {
            "psi": self.psi.mean(),
            "quotient_q05": q05,
            "quotient_q50": q50,
            "quotient_q95": q95,
            "quotient_squared": quotient.square().mean(),
            "fraction_below": self.fraction_below,
            "fraction_above": self.fraction_above,
        }
        numbers = torch.stack([x.to(quotient.dtype) for x in tensors.values()]).tolist()
        return {f"{prefix}{name}": x for name, x in zip(tensors, numbers, strict=True)}


class ConditioningRegularizer:
    """Penalty on the conditioning of a policy: coefficient · mean(psi), equations (1) to (3).

    J = ‖pi(S) - pi(S + delta)‖ / ‖delta‖ for each state, psi its squared distance from
    [lambda_min, lambda_max]. The paper prints equation (3) as maximized with +c1·psi, which would
    reward bad conditioning; here the penalty is added to a loss that is minimized.

    The policy's parameters, buffers, training mode and the global random state are left as they
    were, dropout and batch norm do not count as sensitivity (see `condwrap.policy.untouched`), and
    the noise comes from the regularizer's own generator. With `coefficient=0` psi is measured
    without gradients and nothing reaches the loss.

    Args:
        coefficient: c1, at least 0.
        lambda_min: Lower end of the range, at least 0.
        lambda_max: Upper end of the range, at least `lambda_min`.
        reduction: "sample", one J for each state, or "batch", one J for the whole batch.
        perturbation: "sphere", "gaussian" or "uniform" (see `condwrap.perturbation`), or a map
            from standard-normal noise `[..., n]` to delta.
        radius: Root-mean-square length of a named perturbation, above 0, in units of the policy's
            observation.
        select: Which tensor of the output is pi(S): "default" (a tensor as it is, the mean of a
            Gaussian, the normalized logits of a Categorical or Bernoulli; all members of a tuple
            or dict, joined), "mean", "logits", "probs", or a callable output -> tensor.
        fraction: Share of the states to estimate on, in (0, 1]: evenly spaced, at least one.
        estimator: "difference" (the paper) or "jvp", the limit of a vanishing delta.
        obs_scale: What the policy divides integer observations by; delta then has the units of
            the quotient. By default 255 for uint8, and other integers are refused.
        batch_ndim: Number of leading axes that index states.
        printed_sign: Negate the penalty, which then rewards bad conditioning: equation (3) as it
            is printed. For experiments on the erratum alone.
        seed: Of the regularizer's own generator, on the CPU.
        generator: A generator to use instead, such as one on the GPU, where noise is then drawn.

    Raises:
        TypeError, ValueError: An argument outside what is stated above.

    Example:
        >>> import torch
        >>> policy, obs = torch.nn.Linear(4, 2), torch.ones(8, 4)
        >>> regularizer = ConditioningRegularizer(coefficient=1e-3)
        >>> loss = policy(obs).square().mean() + regularizer(policy, obs).penalty
        >>> loss.backward()
    """

    def __init__(
        self,
        coefficient: float = 1e-3,
        lambda_min: float = 1.0,
        lambda_max: float = 20.0,
        *,
        reduction: str = "sample",
        perturbation: str | Perturbation = "sphere",
        radius: float = 1.0,
        select: Select = "default",
        fraction: float = 1.0,
        estimator: str = "difference",
        obs_scale: float | None = None,
        batch_ndim: int = 1,
        printed_sign: bool = False,
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        if not (coefficient >= 0 and math.isfinite(coefficient)):
            raise ValueError(f"coefficient must be finite and at least 0, got {coefficient}")
        check_range(lambda_min, lambda_max)
        if reduction not in ("sample", "batch"):
            raise ValueError(f"reduction must be 'sample' or 'batch', got {reduction!r}")
        check_select(select)
        if not 0 < fraction <= 1:
            raise ValueError(f"fraction must be in (0, 1], got {fraction}")
        if estimator not in ESTIMATORS:
            raise ValueError(f"estimator must be one of {list(ESTIMATORS)}, got {estimator!r}")
        if obs_scale is not None and not (obs_scale > 0 and math.isfinite(obs_scale)):
            raise ValueError(f"obs_scale must be finite and above 0, got {obs_scale}")
        if batch_ndim < 1:
            raise ValueError(f"batch_ndim must be at least 1, got {batch_ndim}")
        self.coefficient = coefficient
        self.lambda_min = lambda_min
        self.lambda_max = lambda_max
        self.reduction = reduction
        self.perturbation = get_perturbation(perturbation, radius)
        self.select = select
        self.fraction = fraction
        self.estimator = estimator
        self.obs_scale = obs_scale
        self.batch_ndim = batch_ndim
        self.printed_sign = printed_sign
        self.generator = generator or torch.Generator().manual_seed(seed)

    def __call__(
        self, policy: Policy, obs: Any, *, delta: Any = None, output: Any = None
    ) -> Conditioning:
        """Measure the policy's conditioning on a batch of observations.

        Args:
            policy: Any callable obs -> Tensor, Distribution, or tuple or dict of them. It is
                called as in training; uint8 observations reach it as float32, not yet divided.
            obs: `[*batch, *obs_shape]`, floating or uint8, or a dict of these. In float32 at least:
                bf16 would round S + delta.
            delta: A perturbation from `sample_delta` to use instead of drawing one.
            output: `policy(obs)`, where the loss has computed it anyway: a third of the work less.
                In float32 at least, and of a policy without dropout, whose masks would differ.

        Raises:
            TypeError: An observation or output of a kind or dtype that cannot be used.
            ValueError: Empty or (outside compiled code) non-finite observations, a delta that
                does not match, an output that lost the batch axes or has no gradient.
        """
        given = States.read(obs, self.obs_scale, self.batch_ndim)
        states = given.subset(self.fraction)
        flat_delta = self._draw(states) if delta is None else states.flatten(delta)
        known = None if output is None else self._known(policy, output, given)
        learns = self.coefficient > 0 and torch.is_grad_enabled()

        def respond(states_obs: Any) -> Tensor:
            return flat_output(policy(states_obs), self.select, states.batch)

        with (
            torch.set_grad_enabled(learns),
            torch.autocast(states.device.type, enabled=False),  # bf16 loses J to rounding
        ):
            outputs = ESTIMATORS[self.estimator](policy, respond, states, flat_delta, known)
            if learns and not outputs[0].requires_grad:
                raise ValueError(
                    "the policy's output has no gradient: check that its parameters require one "
                    "and that it does not detach, or set coefficient=0 to only measure"
                )
            batch_ndim = self.batch_ndim if self.reduction == "sample" else 0
            quotient = conditioning_quotient(*outputs, flat_delta, batch_ndim=batch_ndim)
            psi = clamping_penalty(quotient, self.lambda_min, self.lambda_max)
            factor = -self.coefficient if self.printed_sign else self.coefficient
            # 0 · infinity is NaN, so a coefficient of 0 does not multiply
            penalty = factor * psi.mean() if factor else psi.new_zeros(())
        quotient = quotient.detach()
        return Conditioning(
            penalty=penalty,
            psi=psi.detach(),
            quotient=quotient,
            fraction_below=(quotient < self.lambda_min).float().mean(),
            fraction_above=(quotient > self.lambda_max).float().mean(),
        )

    def sample_delta(self, obs: Any) -> Any:
        """Draw the next delta for these observations, in their structure.

        For compiled code: `torch.compile(fullgraph=True)` refuses a generator, so draw outside and
        pass `delta`. Where an integer leaf of a dict passes through unperturbed, delta holds None.

        Example:
            >>> import torch
            >>> ConditioningRegularizer(fraction=0.5).sample_delta(torch.ones(8, 3)).shape
            torch.Size([4, 3])
        """
        states = States.read(obs, self.obs_scale, self.batch_ndim).subset(self.fraction)
        return states.unflatten(self._draw(states))

    def state_dict(self) -> dict[str, Tensor]:
        """The generator's state, so that a resumed run draws the same noise."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self.generator.set_state(state_dict["generator"].cpu())

    def _known(self, policy: Policy, output: Any, states: States) -> Tensor:
        check_reusable(policy)
        output = flat_output(output, self.select, states.batch, known=True)
        return take_evenly(output, self.fraction)

    def _draw(self, states: States) -> Tensor:
        noise = torch.randn(
            (*states.batch, sum(states.sizes)),
            generator=self.generator,
            device=self.generator.device,
            dtype=states.dtype,
        ).to(states.device)
        delta = self.perturbation(noise)
        if not (isinstance(delta, Tensor) and delta.shape == noise.shape):
            got = tuple(delta.shape) if isinstance(delta, Tensor) else type(delta).__name__
            raise ValueError(
                f"perturbation must map noise of shape {tuple(noise.shape)} to a delta of that "
                f"shape, got {got}"
            )
        return delta
