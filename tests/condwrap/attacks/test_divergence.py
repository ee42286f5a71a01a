"""What counts of a policy's output, and how far two outputs are apart."""

import re

import pytest
import torch
from torch import distributions as td

from condwrap.attacks.divergence import choose, divergence

BATCH = torch.Size([2])


def normal(mean, sigma):
    return td.Independent(td.Normal(torch.tensor(mean), torch.tensor(sigma)), 1)


# --- values worked out by hand ----------------------------------------------------------------


def test_tensors_by_hand():
    clean, moved = torch.zeros(2, 2), torch.tensor([[3.0, 4.0], [0.0, 1.0]])
    assert divergence(clean, moved).tolist() == [25, 1]


def test_gaussians_by_hand_with_the_clean_sigma():
    clean = normal([[0.0, 0.0], [1.0, 1.0]], [[1.0, 2.0], [1.0, 1.0]])
    moved = normal([[3.0, 4.0], [1.0, 1.0]], [[9.0, 9.0], [9.0, 9.0]])
    assert divergence(clean, moved).tolist() == [0.5 * (9 + 4), 0]


@pytest.mark.parametrize("independent", [True, False])
def test_gaussians_of_one_sigma_have_pytorchs_divergence(independent):
    sigma = torch.rand(5, 3) + 0.1
    p, q = (td.Normal(torch.randn(5, 3), sigma) for _ in range(2))
    expected = td.kl_divergence(p, q).sum(-1)
    if independent:
        p, q = td.Independent(p, 1), td.Independent(q, 1)
    torch.testing.assert_close(divergence(p, q), expected)


@pytest.mark.parametrize("low_rank", [True, False])
def test_full_covariances_have_pytorchs_divergence(low_rank):
    factor = torch.randn(5, 3, 3)
    options = {"covariance_matrix": factor @ factor.mT + torch.eye(3)}
    kind = td.MultivariateNormal
    if low_rank:
        kind = td.LowRankMultivariateNormal
        options = {"cov_factor": factor, "cov_diag": torch.ones(5, 3)}
    p, q = (kind(torch.randn(5, 3), **options) for _ in range(2))
    torch.testing.assert_close(divergence(p, q), td.kl_divergence(p, q), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", [td.Categorical, td.OneHotCategorical])
def test_categorical_by_hand(kind):
    clean = kind(probs=torch.tensor([[0.5, 0.5], [0.25, 0.75]]))
    moved = kind(probs=torch.tensor([[0.25, 0.75], [0.25, 0.75]]))
    half = 0.5 * torch.log(torch.tensor(2.0)) + 0.5 * torch.log(torch.tensor(2 / 3))
    torch.testing.assert_close(divergence(clean, moved), torch.stack([half, torch.tensor(0.0)]))


def test_masked_actions_count_for_nothing_and_keep_gradients_finite():
    mask = torch.tensor([0.0, 0.0, -torch.inf])
    logits = torch.tensor([[0.5, 0.1, 7.0]], requires_grad=True)
    clean = td.Categorical(logits=torch.tensor([[0.0, 0.0, 3.0]]) + mask)
    found = divergence(clean, td.Categorical(logits=logits + mask))
    two = td.kl_divergence(
        td.Categorical(logits=torch.zeros(1, 2)), td.Categorical(logits=logits[:, :2].detach())
    )
    torch.testing.assert_close(found.detach(), two)
    (gradient,) = torch.autograd.grad(found.sum(), logits)
    assert gradient.isfinite().all()
    assert gradient[0, 2] == 0


def test_other_distributions_have_pytorchs_divergence():
    p, q = (td.Independent(td.Beta(torch.rand(2, 3) + 1, torch.rand(2, 3) + 1), 1) for _ in "pq")
    torch.testing.assert_close(divergence(p, q), td.kl_divergence(p, q))
    one = td.Bernoulli(torch.tensor([0.25, 0.5]))
    other = td.Bernoulli(torch.tensor([0.5, 0.5]))
    torch.testing.assert_close(divergence(one, other), td.kl_divergence(one, other))


def test_a_distribution_without_divergence_is_refused():
    p = td.StudentT(torch.ones(2, 1))
    with pytest.raises(TypeError, match="no KL divergence of StudentT: pass select"):
        divergence(p, p)


# --- what counts ------------------------------------------------------------------------------


def test_a_distribution_counts_alone_beside_a_value():
    policy = normal([[0.0], [1.0]], [[1.0], [1.0]])
    for output in ((policy, torch.ones(2, 1)), {"value": torch.ones(2), "action": [policy]}):
        assert choose(output, "default", BATCH) is policy


def test_select_chooses_and_makes_tensors():
    policy = td.Categorical(probs=torch.tensor([[0.5, 0.5], [0.25, 0.75]]))
    assert choose((policy, torch.ones(2)), lambda output: output[1], BATCH).shape == (2, 1)
    assert torch.equal(choose(policy, "probs", BATCH), policy.probs)


@pytest.mark.parametrize(
    ("output", "kinds"),
    [
        ((torch.ones(2), torch.ones(2)), "Tensor, Tensor"),
        ([td.Bernoulli(torch.ones(2)), td.Bernoulli(torch.ones(2))], "Bernoulli, Bernoulli"),
        ({}, "nothing"),
    ],
)
def test_several_or_none_are_refused(output, kinds):
    with pytest.raises(ValueError, match=f"must hold one tensor or distribution, got {kinds}: "):
        choose(output, "default", BATCH)


def test_a_distribution_without_the_batch_axis_is_refused():
    text = re.escape("must begin with the batch axes (2,) of the observations, got shape (3, 1)")
    with pytest.raises(ValueError, match=text):
        choose(td.Normal(torch.zeros(3, 1), 1.0), "default", BATCH)


def test_an_output_that_is_no_tensor_is_refused():
    with pytest.raises(TypeError, match="a policy must return a Tensor"):
        choose("left", "default", BATCH)
