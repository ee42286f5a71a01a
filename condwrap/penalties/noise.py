"""The randomness of a penalty: a generator of its own, so that training's noise stays as it is."""

from __future__ import annotations

import torch
from torch import Tensor


class Noise:
    """Draws from a generator of its own and never from the global one.

    So a regularized run meets the same environment and action noise as its plain twin, and
    `state_dict` lets a resumed run draw what it would have drawn.

    Args:
        seed: Of the generator, on the CPU.
        generator: A generator to use instead, such as one on the GPU, where noise is then drawn.

    Example:
        >>> import torch
        >>> noise, resumed = Noise(seed=0), Noise(seed=1)
        >>> resumed.load_state_dict(noise.state_dict())
        >>> torch.equal(noise.normal((3,), torch.zeros(1)), resumed.normal((3,), torch.zeros(1)))
        True
    """

    def __init__(self, seed: int = 0, generator: torch.Generator | None = None) -> None:
        self.generator = generator or torch.Generator().manual_seed(seed)

    def normal(self, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Standard-normal noise in the dtype and on the device of `like`."""
        device = self.generator.device
        noise = torch.randn(shape, generator=self.generator, device=device, dtype=like.dtype)
        return noise.to(like.device)

    def uniform(self, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Uniform noise in [0, 1) in the dtype and on the device of `like`."""
        device = self.generator.device
        noise = torch.rand(shape, generator=self.generator, device=device, dtype=like.dtype)
        return noise.to(like.device)

    def state_dict(self) -> dict[str, Tensor]:
        """The generator's state, so that a resumed run draws the same noise."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self.generator.set_state(state_dict["generator"].cpu())
