"""Images moved by a few pixels: the default augmentation of `AugmentationConsistency`."""

from __future__ import annotations

import torch
from torch import Tensor

from condwrap.penalties.checks import check_count
from condwrap.penalties.noise import Noise


class RandomShift(Noise):
    """Pad each image by its border and crop it at random to its size: a shift of up to `pad`.

    Kostrikov, Yarats and Fergus (2020, arXiv 2004.13649) use pad 4; Raileanu et al.'s "crop" is
    this with pad 12. Each image has a shift of its own, uniform over whole pixels, shared by its
    channels.

    Args:
        pad: Largest shift along either axis, at least 1, in pixels.
        seed: Of its own generator, on the CPU.
        generator: A generator to use instead.

    Raises:
        TypeError, ValueError: A pad below 1, or a call with something other than images.

    Example:
        >>> images = torch.arange(6, dtype=torch.uint8).reshape(1, 1, 2, 3)
        >>> RandomShift(pad=1)(images).shape
        torch.Size([1, 1, 2, 3])
    """

    def __init__(
        self, pad: int = 4, *, seed: int = 0, generator: torch.Generator | None = None
    ) -> None:
        super().__init__(seed, generator)
        self.pad = check_count("pad", pad)

    def __call__(self, images: Tensor) -> Tensor:
        """The images, `[B, channels, height, width]` of any dtype, each shifted."""
        if not isinstance(images, Tensor):
            raise TypeError(
                f"RandomShift takes images, a Tensor, got {type(images).__name__}: pass augment="
            )
        if images.ndim != 4:
            raise ValueError(
                "RandomShift takes images of shape [B, channels, height, width], got "
                f"{tuple(images.shape)}: pass augment="
            )
        size = len(images)
        shifts = torch.randint(
            -self.pad,
            self.pad + 1,
            (2, size, 1),
            generator=self.generator,
            device=self.generator.device,
        ).to(images.device)

        # an index beyond the border is the border's: padding by replication
        height, width = images.shape[2:]
        rows = (torch.arange(height, device=images.device) + shifts[0]).clamp(0, height - 1)
        columns = (torch.arange(width, device=images.device) + shifts[1]).clamp(0, width - 1)
        which = torch.arange(size, device=images.device)[:, None, None]
        moved = images.movedim(1, -1)[which, rows[:, :, None], columns[:, None, :]]
        return moved.movedim(-1, 1)  # [B, height, width, channels] -> [B, channels, height, width]
