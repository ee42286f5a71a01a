"""The flags of a training loop that regularizes conditioning, for a dataclass to inherit."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import torch

from condwrap.probe import PAPER, ConditioningProbe
from condwrap.regularizer import ConditioningRegularizer

Device = torch.device | str


@dataclasses.dataclass(frozen=True)
class PenaltyArgs:
    """Settings of the conditioning penalty and of what is logged of it.

    Derive a training script's frozen dataclass of arguments from this one, and a command-line
    parser such as tyro shows these flags beside the script's own. `make_regularizer` returns the
    penalty that they describe and `make_probe` what logs the policy's conditioning.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Args(PenaltyArgs):
        ...     seed: int = 1
        >>> args = Args(coefficient=0.01)
        >>> args.make_regularizer(seed=args.seed).coefficient
        0.01
    """

    coefficient: float = 1e-3
    """c1: factor of the conditioning penalty; 0 trains without it and still measures psi"""
    lambda_min: float = 1.0
    """lower end of the range that J is kept in"""
    lambda_max: float = 20.0
    """upper end of the range that J is kept in"""
    reduction: Literal["sample", "batch"] = "sample"
    """one J for each state (sample) or one for the whole minibatch (batch)"""
    perturbation: Literal["sphere", "gaussian", "uniform"] = "sphere"
    """kind of delta"""
    radius: float = 1.0
    """root-mean-square length of delta, in the units of the observations that the policy sees"""
    printed_sign: bool = False
    """reward bad conditioning: the sign of c1 as equation (3) of the paper is printed"""
    probe_fraction: float = 1.0
    """share of each rollout that psi and J are logged from"""
    log_spectrum: int = 0
    """updates between two logs of the Jacobian's singular values; 0: never"""

    def check_conditioning(self) -> None:
        """Raise ValueError for a setting outside its range."""
        self.make_regularizer(seed=0)

        if not 0 < self.probe_fraction <= 1:
            raise ValueError(f"probe_fraction must be in (0, 1], got {self.probe_fraction}")
        if self.log_spectrum < 0:
            raise ValueError(f"log_spectrum must be at least 0, got {self.log_spectrum}")

    def make_regularizer(self, seed: int, device: Device = "cpu") -> ConditioningRegularizer:
        """The penalty, with a generator of its own on `device`."""
        return ConditioningRegularizer(
            self.coefficient,
            self.lambda_min,
            self.lambda_max,
            reduction=self.reduction,
            perturbation=self.perturbation,
            radius=self.radius,
            printed_sign=self.printed_sign,
            generator=torch.Generator(device).manual_seed(seed),
        )

    def make_probe(
        self, seed: int, device: Device = "cpu", action_space: Any = None
    ) -> ConditioningProbe:
        """What logs the policy's conditioning.

        Args:
            seed: Of the probe's own noise.
            device: Where that noise is drawn.
            action_space: The Box that actions are clipped to before they are executed: anything
                with bounds `low` and `high`. None where they are not clipped.
        """
        bounds = None if action_space is None else (action_space.low, action_space.high)
        return ConditioningProbe(
            self.make_regularizer(seed, device),
            own_is_paper=all(getattr(self, name) == value for name, value in PAPER.items()),
            seed=seed,
            device=device,
            fraction=self.probe_fraction,
            log_spectrum=self.log_spectrum,
            action_bounds=bounds,
        )


@dataclasses.dataclass(frozen=True)
class ConditioningArgs(PenaltyArgs):
    """`PenaltyArgs`, and its rival: training on perturbed observations.

    Example:
        >>> import gymnasium as gym
        >>> args = ConditioningArgs(coefficient=0.0, perturb_obs=True, radius=0.1)
        >>> envs = args.perturb(gym.make_vec("Pendulum-v1", 2))
        >>> envs.reset(seed=0)[0].shape
        (2, 3)
    """

    perturb_obs: bool = False
    """train on observations perturbed by delta; with --coefficient 0, the penalty's rival"""

    def perturb(self, envs: Any) -> Any:
        """The Gymnasium vector environment, perturbed if `perturb_obs` says so.

        Its attribute `clean_obs` then holds what the environments said.
        """
        if not self.perturb_obs:
            return envs
        from condwrap.wrappers import VectorPerturbObservation  # needs Gymnasium

        return VectorPerturbObservation(envs, self.perturbation, self.radius)
