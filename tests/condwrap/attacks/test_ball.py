"""The ball: where draws lie, what is nearest, which way is steepest."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from condwrap.attacks.ball import Ball

PROPERTY = settings(derandomize=True, deadline=None, max_examples=40)
norms = pytest.mark.parametrize("norm", ["linf", "l2"])
LIKE = torch.empty(0, dtype=torch.float64)


def lengths(delta, norm):
    return torch.linalg.vector_norm(delta, ord={"linf": math.inf, "l2": 2}[norm], dim=-1)


@PROPERTY
@given(
    norm=st.sampled_from(["linf", "l2"]),
    radius=st.floats(0, 1e3),
    size=st.integers(1, 40),
    scale=st.floats(1e-30, 1e3),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31),
)
def test_draws_and_projections_lie_in_the_ball(norm, radius, size, scale, dtype, seed):
    generator = torch.Generator().manual_seed(seed)
    ball = Ball(radius, norm)
    drawn = ball.draw((20, size), torch.empty(0, dtype=dtype), generator)
    far = scale * torch.randn(20, size, dtype=dtype, generator=generator)
    for delta in (drawn, ball.project(far)):
        assert delta.dtype == dtype
        assert delta.shape == (20, size)
        assert (lengths(delta.double(), norm) <= radius * (1 + 1e-6)).all()


@norms
def test_what_lies_in_the_ball_stays(norm):
    delta = torch.tensor([[0.3, -0.2, 0.1], [0.0, 0.0, 0.0]])
    assert torch.equal(Ball(0.5, norm).project(delta), delta)


def test_projections_by_hand():
    delta = torch.tensor([[3.0, -4.0], [0.1, 2.0]])
    expected = torch.tensor([[1.0, -1.0], [0.1, 1.0]])
    assert torch.equal(Ball(1.0, "linf").project(delta), expected)
    nearest = Ball(1.0, "l2").project(delta[:1])
    torch.testing.assert_close(nearest, torch.tensor([[0.6, -0.8]]))


def test_the_steepest_direction_by_hand():
    gradient = torch.tensor([[3.0, -4.0], [0.0, 0.0]])
    assert Ball(1.0, "linf").steepest(gradient).tolist() == [[1, -1], [0, 0]]
    expected = torch.tensor([[0.6, -0.8], [0.0, 0.0]])
    torch.testing.assert_close(Ball(9.0, "l2").steepest(gradient), expected)


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_tiny_and_huge_gradients_have_a_direction(size):
    gradient = size * torch.tensor([[3.0, -4.0]])  # whose squares float32 cannot hold
    expected = torch.tensor([[0.6, -0.8]])
    torch.testing.assert_close(Ball(1.0, "l2").steepest(gradient), expected)


@norms
@pytest.mark.parametrize("size", [1, 3])
def test_draws_are_uniform_over_the_ball(norm, size):
    """Of a uniform draw, the share within half the radius is half to the power of n."""
    drawn = Ball(2.0, norm).draw((40_000, size), LIKE, torch.Generator().manual_seed(0))
    share = (lengths(drawn, norm) <= 1.0).double().mean().item()
    assert share == pytest.approx(0.5**size, abs=0.01)
    torch.testing.assert_close(drawn.mean(0), torch.zeros(size).double(), atol=0.03, rtol=0)
    assert lengths(drawn, norm).max() > 1.99


@pytest.mark.parametrize(
    ("radius", "norm", "error", "text"),
    [
        (-0.1, "l2", ValueError, "radius must be finite and at least 0, got -0.1"),
        (math.nan, "l2", ValueError, "radius must be finite"),
        (math.inf, "linf", ValueError, "radius must be finite"),
        ("0.1", "linf", TypeError, "radius must be a number, got str"),
        (True, "linf", TypeError, "radius must be a number, got bool"),
        (0.1, "l1", ValueError, "norm must be one of .'linf', 'l2'., got 'l1'"),
    ],
)
def test_bad_balls_are_refused_by_name(radius, norm, error, text):
    with pytest.raises(error, match=text):
        Ball(radius, norm)
