"""A random shift is padding by replication and a crop."""

import pytest
import torch
from torch import nn

from condwrap.penalties import RandomShift


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_each_image_is_a_crop_of_its_padded_self(dtype):
    images = torch.randint(0, 256, (300, 2, 5, 6)).to(dtype)
    padded = nn.ReplicationPad2d(2)(images.float()).to(dtype)
    moved = RandomShift(pad=2)(images)
    assert moved.dtype == dtype
    crops = {(y, x): padded[:, :, y : y + 5, x : x + 6] for y in range(5) for x in range(5)}
    matches = torch.stack([(crop == moved).flatten(1).all(1) for crop in crops.values()])
    assert (matches.sum(0) == 1).all()  # each is one crop
    assert (matches.sum(1) > 0).all()  # each crop occurs


def test_a_shift_by_hand():
    # which shift the seed draws does not matter: pad 1 of a single row has three outcomes
    row = torch.tensor([[[[1.0, 2.0, 3.0]]]]).expand(60, 1, 1, 3)
    outcomes = {tuple(x) for x in RandomShift(pad=1)(row).flatten(1).tolist()}
    assert outcomes == {(1.0, 1.0, 2.0), (1.0, 2.0, 3.0), (2.0, 3.0, 3.0)}


def test_what_is_no_image_is_refused():
    with pytest.raises(TypeError, match="RandomShift takes images, a Tensor, got dict"):
        RandomShift()({"image": torch.zeros(1, 3, 4, 4)})
    with pytest.raises(ValueError, match=r"RandomShift takes images of shape .*, got \(2, 3\)"):
        RandomShift()(torch.zeros(2, 3))
    with pytest.raises(ValueError, match="pad must be at least 1, got 0"):
        RandomShift(pad=0)
