"""What the tests of the library share."""

import pytest
import torch


@pytest.fixture(autouse=True)
def _fresh() -> None:
    """Each test starts from the same global random state and with nothing compiled."""
    torch.manual_seed(0)
    torch.compiler.reset()
