"""The seed paper's penalty and its rivals, all called in one way: see `Penalty`.

    >>> import torch
    >>> policy, obs = torch.nn.Linear(4, 2), torch.randn(8, 4)
    >>> penalty = PENALTIES["jacobian"](coefficient=0.1)
    >>> loss = policy(obs).square().mean() + penalty(policy, obs).penalty
    >>> loss.backward()

The randomness of each comes from a generator of its own, as that of `ConditioningRegularizer`.
"""

from collections.abc import Callable

from condwrap.penalties.augmentation import AugmentationConsistency
from condwrap.penalties.caps import CAPS
from condwrap.penalties.conditioning import ConditioningPenalty
from condwrap.penalties.jacobian_norm import JacobianNorm
from condwrap.penalties.l2c2 import L2C2
from condwrap.penalties.lipschitz_policy import LipschitzPolicy
from condwrap.penalties.protocol import Penalized, Penalty, Result
from condwrap.penalties.random_shift import RandomShift
from condwrap.penalties.spectral import SpectralPenalty, isometry
from condwrap.penalties.state_adversarial import StateAdversarial

PENALTIES: dict[str, Callable[..., Penalty]] = {
    "conditioning": ConditioningPenalty,
    "jacobian": JacobianNorm,
    "caps": CAPS,
    "lcp": LipschitzPolicy,
    "l2c2": L2C2,
    "sa": StateAdversarial,
    "spectral": SpectralPenalty,
    "drac": AugmentationConsistency,
}
"""By a short name, such as a command line gives."""

__all__ = [
    "CAPS",
    "L2C2",
    "PENALTIES",
    "AugmentationConsistency",
    "ConditioningPenalty",
    "JacobianNorm",
    "LipschitzPolicy",
    "Penalized",
    "Penalty",
    "RandomShift",
    "Result",
    "SpectralPenalty",
    "StateAdversarial",
    "isometry",
]
