"""The TRPO baseline: its mathematics, and what its natural-gradient step promises."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import runpy

import numpy as np
import pytest
import torch
from torch.autograd.functional import hessian
from torch.func import functional_call

from baselines import ppo_reg, trpo_reg
from baselines.trpo_reg import (
    Args,
    conjugate_gradient,
    fisher_product,
    gae,
    line_search,
    natural_step,
    update,
)
from condwrap.settings import ConditioningArgs
from tests.baselines.helpers import check_refusal, flat, pendulum, read_metrics
from tests.baselines.test_ppo_reg import STANDARD, Fixed, normal_logprob, run_main

# --- conjugate gradient --------------------------------------------------------------------------


def positive_definite(size: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A matrix with eigenvalues from 1 to 100, and a right-hand side, in float64."""
    generator = torch.Generator().manual_seed(seed)
    square = torch.randn(size, size, generator=generator, dtype=torch.float64)
    q, _ = torch.linalg.qr(square)
    matrix = q @ torch.diag(torch.logspace(0, 2, size, dtype=torch.float64)) @ q.T
    return matrix, torch.randn(size, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("size", [1, 2, 7, 30])
@pytest.mark.parametrize("seed", [0, 1])
def test_conjugate_gradient_agrees_with_a_dense_solve(size, seed):
    matrix, b = positive_definite(size, seed)
    x, residual = conjugate_gradient(lambda v: matrix @ v, b, 3 * size, tolerance=1e-22)
    torch.testing.assert_close(x, torch.linalg.solve(matrix, b), rtol=1e-8, atol=1e-9)
    assert residual < 1e-9


def test_conjugate_gradient_by_hand():
    matrix = torch.tensor([[4.0, 1.0], [1.0, 3.0]], dtype=torch.float64)
    b = torch.tensor([1.0, 2.0], dtype=torch.float64)
    # b·b = 5 and b·A b = 20, so x = b/4, and b - A x = [-1/2, 1/4] is 1/4 as long as b
    x, residual = conjugate_gradient(lambda v: matrix @ v, b, 1)
    assert x.tolist() == [0.25, 0.5]
    assert residual == pytest.approx(0.25)
    x, residual = conjugate_gradient(lambda v: matrix @ v, b, 2)
    assert x.tolist() == pytest.approx([1 / 11, 7 / 11])
    assert residual == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("steps", [1, 3, 6])
def test_the_residual_is_that_of_the_x_returned(steps):
    matrix, b = positive_definite(10, seed=2)
    x, residual = conjugate_gradient(lambda v: matrix @ v, b, steps)
    assert residual == pytest.approx(((b - matrix @ x).norm() / b.norm()).item(), rel=1e-8)
    assert residual > 1e-3


def test_conjugate_gradient_stops_at_negative_curvature_with_the_x_so_far():
    diagonal = torch.tensor([2.0, -1.0], dtype=torch.float64)
    b = torch.tensor([2.0, 1.0], dtype=torch.float64)
    # b·b = 5 and b·A b = 7: x = 5/7 b; along the second direction, [30, 120]/49, A is negative
    x, residual = conjugate_gradient(lambda v: diagonal * v, b, 10)
    assert x.tolist() == pytest.approx([10 / 7, 5 / 7])
    assert residual == pytest.approx(6 / 7)


def test_conjugate_gradient_stops_where_there_is_no_curvature():
    x, residual = conjugate_gradient(lambda v: 0 * v, torch.tensor([3.0, 4.0]), 10)
    assert x.tolist() == [0, 0]
    assert residual == 1


def test_conjugate_gradient_stops_at_nan_with_the_x_so_far():
    matrix, b = positive_definite(5, seed=3)
    calls = []

    def product(v):
        calls.append(v)
        return matrix @ v * (math.nan if len(calls) > 2 else 1.0)

    x, residual = conjugate_gradient(product, b, 10)
    expected = conjugate_gradient(lambda v: matrix @ v, b, 2)
    assert torch.equal(x, expected[0])
    assert residual == expected[1]
    assert len(calls) == 3


def test_conjugate_gradient_solves_for_0_without_a_division_by_0():
    matrix, b = positive_definite(4, seed=4)
    calls = []

    def product(v):
        calls.append(v)
        return matrix @ v

    x, residual = conjugate_gradient(product, 0 * b, 10)
    assert x.tolist() == [0, 0, 0, 0]
    assert residual == 0
    assert calls == []  # 0 needs no product


@pytest.mark.parametrize(("spread", "products"), [(0.9e-5, 1), (1.1e-5, 2)])
def test_conjugate_gradient_ends_once_the_residual_is_small(spread, products):
    """After a step the residual is spread times as long as b; the bound on its square is 1e-10."""
    diagonal = torch.tensor([1 - spread, 1 + spread], dtype=torch.float64)
    calls = []

    def product(v):
        calls.append(v)
        return diagonal * v

    conjugate_gradient(product, torch.ones(2, dtype=torch.float64), 10)
    assert len(calls) == products


# --- a small problem in float64 ------------------------------------------------------------------


class Problem:
    """A surrogate and a KL divergence around a random policy, each written out by hand."""

    def __init__(self, seed: int = 0, **changes) -> None:
        settings = {"hidden_sizes": (4,), "cg_steps": 100, **changes}
        self.args = Args(**settings)
        self.generator = torch.Generator().manual_seed(seed)
        self.actor = trpo_reg.Actor(self.args, 3, 2, self.generator).double()
        for p in self.actor.parameters():
            p.data = 0.5 * self.randn(*p.shape)
        self.parameters = list(self.actor.parameters())
        self.obs, self.advantages = self.randn(32, 3), self.randn(32)
        with torch.no_grad():
            self.old_mean, self.old_log_std = self.mean_and_log_std()
        self.actions = self.old_mean + self.old_log_std.exp() * self.randn(32, 2)
        self.old = flat(self.actor).clone()

    def randn(self, *shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def mean_and_log_std(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.actor.mean(self.obs), self.actor.log_std.clone()

    def logprobs(self, mean, log_std):
        return (-((self.actions - mean) / log_std.exp()).square() / 2 - log_std).sum(1)

    def objective(self) -> torch.Tensor:
        new, old = self.mean_and_log_std(), (self.old_mean, self.old_log_std)
        return ((self.logprobs(*new) - self.logprobs(*old)).exp() * self.advantages).mean()

    def kl(self, mean, log_std) -> torch.Tensor:
        """KL(old ‖ new) of diagonal Gaussians, the mean over the states."""
        squares = (2 * self.old_log_std).exp() + (self.old_mean - mean).square()
        terms = log_std - self.old_log_std + squares / (2 * (2 * log_std).exp()) - 0.5
        return terms.sum(1).mean()

    def mean_kl(self) -> torch.Tensor:
        return self.kl(*self.mean_and_log_std())

    def fisher(self) -> torch.Tensor:
        """The explicit Hessian of the KL divergence at the old policy."""
        names = [n for n, _ in self.actor.named_parameters()]
        shapes = [p.shape for p in self.parameters]

        def kl(vector):
            parts = vector.split([s.numel() for s in shapes])
            new = {n: x.view(s) for n, x, s in zip(names, parts, shapes, strict=True)}
            answer = functional_call(self.actor, new, self.obs)
            return self.kl(answer.base_dist.loc, new["log_std"])

        return hessian(kl, self.old)

    def gradient(self) -> torch.Tensor:
        return torch.cat(
            [g.flatten() for g in torch.autograd.grad(self.objective(), self.parameters)]
        )

    def move_to(self, vector: torch.Tensor) -> None:
        parts = vector.split([p.numel() for p in self.parameters])
        for p, x in zip(self.parameters, parts, strict=True):
            p.data = x.view(p.shape).clone()

    def at_old(self) -> bool:
        return torch.equal(flat(self.actor), self.old)

    def step(self) -> dict[str, float]:
        return natural_step(self.args, self.actor, self.objective, self.mean_kl)


@pytest.mark.parametrize("damping", [0.0, 0.1])
@pytest.mark.parametrize("seed", [0, 1])
def test_fisher_product_is_the_explicit_hessian_of_the_kl_divergence(seed, damping):
    problem = Problem(seed)
    product = fisher_product(problem.mean_kl(), problem.parameters, damping)
    identity = torch.eye(len(problem.old), dtype=torch.float64)
    built = torch.stack([product(v) for v in identity])
    torch.testing.assert_close(built, problem.fisher() + damping * identity)
    torch.testing.assert_close(built, built.T)
    assert torch.linalg.eigvalsh(built).min() > damping - 1e-12
    assert built.abs().max() > 0.1


# --- the natural-gradient step -------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_full_step_is_that_of_a_dense_solve(seed):
    problem = Problem(seed)
    gradient, damped = problem.gradient(), problem.fisher()
    damped += 0.1 * torch.eye(len(damped), dtype=torch.float64)
    direction = torch.linalg.solve(damped, gradient)
    full_step = (2 * 0.01 / (direction @ damped @ direction)).sqrt() * direction
    logs = problem.step()
    moved = flat(problem.actor) - problem.old
    torch.testing.assert_close(moved, logs["step_fraction"] * full_step, rtol=1e-3, atol=1e-5)
    assert logs["expected_improvement"] == pytest.approx((gradient @ full_step).item(), rel=1e-4)
    assert logs["accepted"] == 1


def test_the_step_does_not_depend_on_the_scale_of_the_objective():
    plain, small = Problem(), Problem()
    objective = small.objective
    small.objective = lambda: 1e-8 * objective()
    assert plain.step()["accepted"] == small.step()["accepted"] == 1
    torch.testing.assert_close(flat(plain.actor), flat(small.actor), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("cg_steps", [1, 3, 100])
def test_the_full_step_meets_the_bound_in_the_quadratic_model_however_rough(cg_steps):
    problem = Problem(cg_steps=cg_steps)
    damped = problem.fisher() + 0.1 * torch.eye(len(problem.old), dtype=torch.float64)
    logs = problem.step()
    full_step = (flat(problem.actor) - problem.old) / logs["step_fraction"]
    assert (full_step @ damped @ full_step / 2).item() == pytest.approx(0.01, rel=1e-6)
    assert logs["kl"] == pytest.approx(problem.mean_kl().item())


def test_expected_and_actual_improvement_agree_for_small_steps():
    errors = []
    for target_kl in (1e-2, 1e-4, 1e-6):
        problem = Problem(target_kl=target_kl)
        before = problem.objective().item()
        logs = problem.step()
        assert logs["actual_improvement"] == pytest.approx(problem.objective().item() - before)
        expected = logs["step_fraction"] * logs["expected_improvement"]
        errors.append(abs(logs["actual_improvement"] / expected - 1))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.01


def shrinking(problem: Problem) -> None:
    """A smaller deviation costs more KL divergence than its quadratic model says."""
    problem.objective = lambda: -problem.actor.log_std.sum() + 0 * flat_sum(problem)


def overshooting(problem: Problem) -> None:
    """Better at first along its gradient, then worse."""
    start = problem.old_log_std.sum()

    def objective():
        moved = problem.actor.log_std.sum() - start
        return moved - 20 * moved**2 + 0 * flat_sum(problem)

    problem.objective = objective


def flat_sum(problem: Problem) -> torch.Tensor:
    return sum(p.sum() for p in problem.parameters)


@pytest.mark.parametrize(("change", "target_kl"), [(shrinking, 1.0), (overshooting, 0.01)])
def test_the_first_fraction_accepted_is_the_largest_admissible(change, target_kl):
    problem = Problem(target_kl=target_kl)
    change(problem)
    before = problem.objective().item()
    logs = problem.step()
    full_step = (flat(problem.actor) - problem.old) / logs["step_fraction"]

    def admissible(fraction: float) -> bool:
        problem.move_to(problem.old + fraction * full_step)
        with torch.no_grad():
            return bool(problem.mean_kl() <= target_kl and problem.objective() > before)

    tried = [0.8**i for i in range(10)]
    allowed = [fraction for fraction in tried if admissible(fraction)]
    assert logs["step_fraction"] == pytest.approx(max(allowed))
    assert logs["step_fraction"] < 1


def test_the_parameters_share_no_memory_after_a_step():
    """Views into one vector are aligned otherwise than loaded weights, and so round otherwise."""
    problem = Problem()
    assert problem.step()["accepted"] == 1
    storages = {p.untyped_storage().data_ptr() for p in problem.parameters}
    assert len(storages) == len(problem.parameters)


# --- the line search -----------------------------------------------------------------------------


def search(kl, objective=None, **changes) -> tuple[dict[str, float], float, list[float]]:
    """A search from 0 to 1 for one number: the logs, where it ends, and what was tried."""
    args = Args(**{"target_kl": 0.25, "line_search_shrink": 0.5, **changes})
    number = torch.nn.Parameter(torch.zeros(1, dtype=torch.float64))
    tried = []

    def value():
        tried.append(number.item())
        return (objective or torch.sum)(number)

    full_step = torch.ones(1, dtype=torch.float64)
    before = torch.zeros((), dtype=torch.float64)
    logs = line_search(args, [number], full_step, before, value, lambda: kl(number))
    return logs, number.item(), tried


def test_a_step_that_meets_the_bound_exactly_is_accepted():
    logs, end, tried = search(lambda x: torch.full_like(x, 0.25).sum())
    assert logs == {"kl": 0.25, "step_fraction": 1.0, "accepted": 1.0, "actual_improvement": 1.0}
    assert end == 1.0
    assert tried == [1.0]


def test_a_step_just_beyond_the_bound_is_shortened():
    # KL x² is 0.25 at a half: the full step is beyond it, a half meets it
    logs, end, tried = search(lambda x: x.square().sum())
    assert (logs["step_fraction"], logs["kl"], end) == (0.5, 0.25, 0.5)
    assert tried == [1.0, 0.5]
    above = math.nextafter(0.25, 1)
    assert search(lambda x: torch.full_like(x, above).sum())[:2] == ({}, 0.0)


def test_a_step_that_changes_nothing_is_not_accepted():
    logs, end, tried = search(lambda x: 0 * x.sum(), objective=lambda x: 0 * x.sum())
    assert (logs, end) == ({}, 0.0)
    assert tried == [0.5**i for i in range(10)]


@pytest.mark.parametrize("line_search_steps", [1, 3])
def test_no_more_fractions_are_tried_than_said(line_search_steps):
    beyond = {"line_search_steps": line_search_steps, "line_search_shrink": 0.25}
    _, end, tried = search(lambda x: 1 + x.sum(), **beyond)
    assert tried == [1.0, 0.25, 0.0625][:line_search_steps]
    assert end == 0.0


def nan_gradient(problem, objective, kl):
    return lambda: objective() * math.nan, kl


def infinite_gradient(problem, objective, kl):
    return lambda: objective() * math.inf, kl


def partly_infinite_gradient(problem, objective, kl):
    """Infinite for the log-stds, 0 for all weights."""
    return lambda: objective() * 0 + problem.actor.log_std.sum() * math.inf, kl


def zero_gradient(problem, objective, kl):
    return lambda: objective() * 0, kl


def infinite_everywhere(problem, objective, kl):
    return lambda: objective() + math.inf, kl


def infinite_before_the_step(problem, objective, kl):
    return lambda: objective() - (math.inf if problem.at_old() else 0), kl


def infinite_after_the_step(problem, objective, kl):
    return lambda: objective() + (0 if problem.at_old() else math.inf), kl


def worsening(problem, objective, kl):
    return lambda: objective() - 2 * objective().detach(), kl


def negative_curvature(problem, objective, kl):
    return lambda: problem.actor.log_std.sum() + 0 * objective(), lambda: -kl()


def nan_curvature(problem, objective, kl):
    return objective, lambda: kl() * math.nan


def nan_kl_after_the_step(problem, objective, kl):
    return objective, lambda: kl() + (0 if problem.at_old() else math.nan)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (nan_gradient, "the gradient is not finite"),
        (infinite_gradient, "the gradient is not finite"),
        (partly_infinite_gradient, "the gradient is not finite"),
        (zero_gradient, "the gradient is 0"),
        (infinite_everywhere, "no fraction of it improves the objective within the KL bound"),
        (infinite_before_the_step, "no fraction of it improves the objective within the KL bound"),
        (infinite_after_the_step, "no fraction of it improves the objective within the KL bound"),
        (worsening, "no fraction of it improves the objective within the KL bound"),
        (negative_curvature, "no positive curvature"),
        (nan_curvature, "no positive curvature"),
        (nan_kl_after_the_step, "no fraction of it improves the objective within the KL bound"),
    ],
)
def test_a_rejected_step_leaves_the_policy_bit_for_bit_and_says_why(change, reason, capsys):
    problem = Problem()
    logs = natural_step(
        problem.args, problem.actor, *change(problem, problem.objective, problem.mean_kl)
    )
    assert problem.at_old()
    said = capsys.readouterr().out.splitlines()
    assert said == [f"step rejected: {reason}"]
    zero = {"kl", "step_fraction", "accepted", "actual_improvement"}
    assert set(logs) == {*zero, "cg_residual", "expected_improvement"}  # as after a step
    assert {logs[key] for key in zero} == {0}
    assert all(math.isfinite(value) for value in logs.values()), logs


# --- an update -----------------------------------------------------------------------------------


def by_hand(args, x, actions, advantages) -> dict[str, float]:
    """A policy of mean 2 x and log-std 0.5 steps as `update` should step it, in float64."""
    std = math.exp(0.5)
    noise = (actions - 2 * x) / std
    scaled = (advantages - advantages.mean()) / advantages.std(ddof=1)

    # d log pi / d w = noise · x / std, d log pi / d log_std = noise² - 1, and J = w
    gradient = np.array([(scaled * noise * x / std).mean(), (scaled * (noise**2 - 1)).mean()])
    plain = np.linalg.norm(gradient)
    gradient[0] -= args.coefficient * 2 * (2 - args.lambda_min)
    fisher = np.array([(x**2).mean() / std**2, 2.0]) + args.cg_damping
    direction = gradient / fisher
    full_step = math.sqrt(2 * args.target_kl / (direction * fisher * direction).sum()) * direction

    for i in range(args.line_search_steps):
        fraction = args.line_search_shrink**i
        w, log_std = np.array([2.0, 0.5]) + fraction * full_step
        new = (actions - w * x) / math.exp(log_std)
        ratio = np.exp((noise**2 - new**2) / 2 + 0.5 - log_std)
        psi = min(w - args.lambda_min, 0) ** 2 - (2 - args.lambda_min) ** 2
        gain = (ratio * scaled).mean() - args.coefficient * psi
        squares = std**2 + ((w - 2) * x) ** 2
        kl = (log_std - 0.5 + squares / (2 * math.exp(2 * log_std)) - 0.5).mean()
        if kl <= args.target_kl and gain > 0:
            break
    return {
        "w": w, "log_std": log_std, "kl": kl, "step_fraction": fraction, "accepted": 1.0,
        "expected_improvement": (gradient * full_step).sum(), "actual_improvement": gain,
        "cg_residual": 0.0, "share": 2 * args.coefficient * (args.lambda_min - 2) / plain,
    }  # fmt: skip


def small_rollout() -> trpo_reg.Rollout:
    """Four steps, of which the third ends an episode; values 3 · obs."""
    obs = torch.tensor([0.0, 1.0, 2.0, -1.0])[:, None]
    column = {
        "rewards": [1.0, -2.0, 0.5, 4.0],
        "dones": [0.0, 0.0, 1.0, 0.0],
        "next_values": [3.0, 6.0, 0.0, 7.0],
    }
    return trpo_reg.Rollout(
        obs=obs[..., None],
        after=None,
        actions=torch.tensor([0.5, 1.0, 6.0, -1.0])[:, None, None],
        values=3 * obs,
        next_obs=None,
        returns=[],
        lengths=[],
        clean_obs=None,
        **{name: torch.tensor(x)[:, None] for name, x in column.items()},
    )


def small_learner(args: Args) -> trpo_reg.Learner:
    """Mean 2 · obs, log-std 0.5, value 3 · obs; the critic learns by plain gradient descent."""
    learner = trpo_reg.Learner(dataclasses.replace(args, env_id="MountainCarContinuous-v0"))
    learner.actor = Fixed()
    learner.critic = torch.nn.Linear(1, 1, bias=False)
    learner.critic.weight.data.fill_(3.0)
    learner.critic_optimizer = torch.optim.SGD(learner.critic.parameters(), 0.01)
    return learner


SMALL_STEP = {"num_steps": 4, "num_minibatches": 1, "vf_epochs": 1, "gamma": 0.9}
SMALL_STEP |= {"gae_lambda": 0.8, "max_grad_norm": 1e9, "vf_coef": 0.7}


@pytest.mark.parametrize(
    ("target_kl", "shortened"), [(0.01, False), (1.0, True)], ids=["full step", "shortened"]
)
def test_one_update_by_hand(target_kl, shortened):
    args = Args(**SMALL_STEP, coefficient=0.9, lambda_min=2.5, cg_damping=0.3, target_kl=target_kl)
    learner = small_learner(args)
    data = small_rollout()
    learner.update = 25
    logs = update(args, learner, data)

    x = data.obs.flatten().double().numpy()
    actions = data.actions.flatten().double().numpy()
    errors = [1 + 0.9 * 3 - 0, -2 + 0.9 * 6 - 3, 0.5 - 6, 4 + 0.9 * 7 + 3]
    third = errors[2]
    second = errors[1] + 0.72 * third
    raw = np.array([errors[0] + 0.72 * second, second, third, errors[3]])
    expected = by_hand(args, x, actions, raw)
    assert (expected["step_fraction"] < 1) == shortened
    assert learner.actor.weight.item() == pytest.approx(expected.pop("w"), rel=1e-5)
    assert learner.actor.log_std.item() == pytest.approx(expected.pop("log_std"), rel=1e-5)
    assert logs["conditioning/gradient_share"] == pytest.approx(expected.pop("share"), rel=1e-4)
    for name, value in expected.items():
        assert logs[f"losses/{name}"] == pytest.approx(value, rel=1e-4, abs=1e-5), name

    targets = raw + 3 * x
    critic_grad = 0.7 * (2 * (3 * x - targets) * x).mean()
    assert learner.critic.weight.item() == pytest.approx(3.0 - 0.01 * critic_grad, rel=1e-5)
    assert logs["losses/value_loss"] == pytest.approx((raw**2).mean(), rel=1e-5)
    explained = 1 - raw.var() / targets.var()
    assert logs["losses/explained_variance"] == pytest.approx(explained, rel=1e-4)
    entropy = 0.5 * math.log(2 * math.pi * math.e) + 0.5  # of the old policy
    assert logs["losses/entropy"] == pytest.approx(entropy)


def test_the_critics_gradient_is_clipped_to_the_given_length():
    args = Args(**{**SMALL_STEP, "max_grad_norm": 0.25})
    learner = small_learner(args)
    update(args, learner, small_rollout())
    assert abs(learner.critic.weight.item() - 3.0) == pytest.approx(0.01 * 0.25, rel=1e-3)


def test_the_surrogate_by_hand():
    """Ratios 1.5 and 0.5; the slope is 2 and lambda_max 1.5, so psi is 0.25 in every state."""
    args = Args(coefficient=3.0, lambda_min=0.0, lambda_max=1.5)
    obs = torch.tensor([[1.0], [2.0]])
    actions = torch.tensor([[1.0], [6.0]])
    logprobs = [normal_logprob(1.0, 2.0, 0.5), normal_logprob(6.0, 4.0, 0.5)]
    old = torch.tensor(logprobs) - torch.tensor([1.5, 0.5]).log()
    advantages = torch.tensor([2.0, -3.0])
    for sign, own in ((1, args), (-1, dataclasses.replace(args, printed_sign=True))):
        learner = small_learner(own)
        plain = trpo_reg.surrogate(learner, obs, actions, old, advantages)
        penalized = trpo_reg.surrogate(learner, obs, actions, old, advantages, torch.ones(2, 1))
        assert plain.item() == pytest.approx((1.5 * 2 - 0.5 * 3) / 2, rel=1e-5)
        assert (plain - penalized).item() == pytest.approx(sign * 3.0 * 0.25, rel=1e-5)


def test_advantages_that_hardly_differ_stay_small(monkeypatch):
    """Deviation d: they are divided by d + 1e-8, and so hardly grow where d is far below."""
    seen = []
    surrogate = trpo_reg.surrogate

    def spy(learner, obs, actions, old_logprobs, advantages, *delta):
        seen.append(advantages)
        return surrogate(learner, obs, actions, old_logprobs, advantages, *delta)

    monkeypatch.setattr(trpo_reg, "surrogate", spy)
    args = Args(**SMALL_STEP)
    rewards = torch.tensor([3e-9, -1e-9, -1e-9, -1e-9])[:, None]
    zero = torch.zeros(4, 1)
    ends = torch.ones(4, 1)  # so that a reward is its step's advantage
    data = small_rollout()._replace(rewards=rewards, values=zero, next_values=zero, dones=ends)
    update(args, small_learner(args), data)
    expected = [x / (2e-9 + 1e-8) for x in (3e-9, -1e-9, -1e-9, -1e-9)]
    assert seen[0].tolist() == pytest.approx(expected, rel=1e-5)


class Spy:
    """A regularizer that notes what it is asked."""

    def __init__(self, regularizer) -> None:
        self.regularizer, self.drawn, self.calls = regularizer, [], []

    def sample_delta(self, obs):
        self.drawn.append(self.regularizer.sample_delta(obs))
        return self.drawn[-1].clone()

    def __call__(self, policy, obs, *, delta, output):
        self.calls.append((obs.clone(), delta.clone()))
        return self.regularizer(policy, obs, delta=delta, output=output)


def collected(**changes):
    """Arguments, a learner whose regularizer is a spy, and a rollout."""
    args = pendulum(trpo_reg, None, **changes)
    learner = trpo_reg.Learner(args)
    learner.regularizer = Spy(learner.regularizer)
    envs = trpo_reg.make_envs(args, learner.stats)
    next_obs, _ = envs.reset(seed=trpo_reg.env_seeds(args, 0))
    data = trpo_reg.rollout(args, learner, envs, next_obs)
    envs.close()
    return args, learner, data


def psi_by_hand(args, actor, obs, delta) -> torch.Tensor:
    with torch.no_grad():
        quotient = (actor.mean(obs + delta) - actor.mean(obs)).norm(dim=1) / delta.norm(dim=1)
    low, high = (args.lambda_min - quotient).relu(), (quotient - args.lambda_max).relu()
    return low.square() + high.square()


@pytest.mark.parametrize("coefficient", [0.0, 1e-3, 1.0, 1e4])
def test_no_step_violates_the_bound_or_worsens_the_penalised_surrogate(coefficient):
    accepted = 0
    for seed in range(8):
        args, learner, data = collected(coefficient=coefficient, seed=seed)
        with torch.no_grad():
            learner.actor.mean[-1].weight *= 10 ** (seed % 3)
        old = copy.deepcopy(learner.actor).double()
        logs = update(args, learner, data)
        new = copy.deepcopy(learner.actor).double()
        accepted += logs["losses/accepted"]
        obs, actions = data.obs.flatten(0, 1).double(), data.actions.flatten(0, 1).double()
        with torch.no_grad():
            before, after = old(obs), new(obs)
            kl = torch.distributions.kl_divergence(before, after).mean().item()
            ratio = (after.log_prob(actions) - before.log_prob(actions)).exp()
        advantages = gae(data, args.gamma, args.gae_lambda).flatten().double()
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        gain = ((ratio - 1) * advantages).mean().item()
        scale = 1.0
        if coefficient:
            delta = learner.regularizer.drawn[0].double()
            psi = [psi_by_hand(args, actor, obs, delta).mean().item() for actor in (old, new)]
            gain -= coefficient * (psi[1] - psi[0])
            scale += coefficient * psi[0]
        rounding = 1e-6 * scale
        assert kl <= args.target_kl * (1 + 1e-3)
        assert kl == pytest.approx(logs["losses/kl"], rel=1e-3, abs=1e-6)
        assert gain > -rounding
        assert gain == pytest.approx(logs["losses/actual_improvement"], rel=1e-3, abs=rounding)
    assert accepted >= 6


def test_the_penalty_is_the_mean_psi_of_the_whole_trajectory(monkeypatch):
    objectives = []

    def spy(args, actor, objective, mean_kl):
        objectives.append((objective().item(), mean_kl().item()))
        return {}

    monkeypatch.setattr(trpo_reg, "natural_step", spy)
    args, learner, data = collected(coefficient=0.5, num_envs=2)
    update(args, learner, data)
    obs, delta = data.obs.flatten(0, 1), learner.regularizer.drawn[0]
    assert delta.shape == obs.shape == (128, 3)
    psi = psi_by_hand(args, learner.actor, obs, delta)
    assert psi.mean() > 0.1
    # the ratios are 1 and the normalized advantages have mean 0: the penalty is what remains
    assert objectives == [(pytest.approx(-0.5 * psi.mean().item(), abs=1e-6), 0.0)]


def test_delta_is_held_through_an_update_and_drawn_anew_for_the_next():
    args, learner, data = collected(coefficient=0.5, target_kl=30.0, cg_damping=1e-3)
    spy = learner.regularizer
    for number in (1, 2):
        spy.calls.clear()
        update(args, learner, data)
        assert len(spy.drawn) == number
        assert len(spy.calls) > 2, "the gradient and a line search of several fractions"
        for obs, delta in spy.calls:
            assert torch.equal(obs, data.obs.flatten(0, 1))
            assert torch.equal(delta, spy.drawn[-1])
    assert not torch.equal(*spy.drawn)


def test_coefficient_0_draws_nothing_for_the_penalty():
    args, learner, data = collected(coefficient=0.0)
    update(args, learner, data)
    assert learner.regularizer.drawn == learner.regularizer.calls == []


def test_every_parameter_of_the_policy_moves_and_log_std_is_among_them():
    args, learner, data = collected()
    before = copy.deepcopy(learner.actor)
    assert update(args, learner, data)["losses/accepted"] == 1
    moved = [
        name
        for (name, old), new in zip(
            before.named_parameters(), learner.actor.parameters(), strict=True
        )
        if not torch.equal(old, new)
    ]
    assert "log_std" in moved
    assert len(moved) == 7


def test_the_critic_passes_vf_epochs_times_over_the_whole_rollout():
    args, learner, data = collected(vf_epochs=3)
    seen = []
    learner.critic.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    update(args, learner, data)
    assert [len(batch) for batch in seen] == [16] * 12
    everything = sorted(data.obs.flatten(0, 1).tolist())
    for epoch in range(3):
        assert sorted(torch.cat(seen[4 * epoch :][:4]).tolist()) == everything


def test_more_epochs_of_the_critic_fit_it_better_and_leave_the_policy_as_it_is():
    errors, actors = [], []
    for vf_epochs in (1, 20):
        args, learner, data = collected(vf_epochs=vf_epochs)
        update(args, learner, data)
        targets = gae(data, args.gamma, args.gae_lambda) + data.values
        with torch.no_grad():
            errors.append((learner.critic(data.obs).squeeze(-1) - targets).square().mean().item())
        actors.append(flat(learner.actor))
    assert errors[1] < 0.8 * errors[0]
    assert torch.equal(*actors)


# --- settings ------------------------------------------------------------------------------------


def test_the_defaults_are_the_standard_setting():
    """PPO's, but for the step and for what PPO alone has."""
    own = {
        "target_kl": 0.01,
        "cg_steps": 10,
        "cg_damping": 0.1,
        "line_search_steps": 10,
        "line_search_shrink": 0.8,
    }
    of_ppo_alone = {"update_epochs", "learning_rate", "anneal_lr", "clip_coef", "ent_coef"}
    of_ppo_alone |= {"compile"}
    expected = {k: v for k, v in STANDARD.items() if k not in of_ppo_alone}
    conditioning = dataclasses.asdict(ConditioningArgs())
    assert dataclasses.asdict(Args()) == {**expected, **own, **conditioning}


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("num_envs", [0], [1]),
        ("num_steps", [0], [2000]),
        ("num_minibatches", [0, 3, 2000], [1, 1000]),
        ("vf_epochs", [0], [1]),
        ("checkpoint_interval", [0], [1]),
        ("cg_steps", [0], [1]),
        ("line_search_steps", [0], [1]),
        ("seed", [-1], [0]),
        ("agent", [-1], [0]),
        ("reward_clip", [-0.1, math.nan], [0.0]),
        ("hidden_sizes", [(0,), (8, 0)], [(1,), ()]),
        ("target_kl", [0.0, -1.0, math.inf, math.nan], [0.5]),
        ("cg_damping", [0.0, -1.0, math.inf, math.nan], [0.5]),
        ("vf_learning_rate", [0.0, -1.0, math.inf, math.nan], [0.5]),
        ("max_grad_norm", [0.0, math.inf], [0.5]),
        ("output_gain", [0.0, math.inf], [0.5]),
        ("gamma", [-0.1, 1.1, math.nan], [0.0, 1.0]),
        ("gae_lambda", [-0.1, 1.1, math.nan], [0.0, 1.0]),
        ("line_search_shrink", [-0.1, 1.1, math.nan], [0.0, 1.0]),
        ("total_timesteps", [1999], [2000]),
        ("lambda_min", [-1.0], [0.0]),
    ],
)
def test_each_setting_has_its_range(name, refused, taken):
    for value in refused:
        with pytest.raises(ValueError, match=f"^{name} must|the range needs 0 <= {name}"):
            Args(**{name: value})
    for value in taken:
        assert getattr(Args(**{name: value}), name) == value


def test_the_settings_of_a_run_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Args().seed = 2


def test_both_kinds_of_activation_are_to_be_had():
    for activation, kind in (("tanh", torch.nn.Tanh), ("relu", torch.nn.ReLU)):
        learner = trpo_reg.Learner(Args(env_id="Pendulum-v1", activation=activation))
        assert isinstance(learner.actor.mean[1], kind)
        assert isinstance(learner.critic[1], kind)


def test_the_environments_that_give_the_sizes_are_closed(monkeypatch):
    made = []
    make_envs = trpo_reg.make_envs

    def spy(args, stats):
        made.append(make_envs(args, stats))
        return made[-1]

    monkeypatch.setattr(trpo_reg, "make_envs", spy)
    trpo_reg.Learner(Args(env_id="Pendulum-v1"))
    assert [envs.unwrapped.closed for envs in made] == [True]


def test_the_critic_is_ppos():
    """So that claim (c) compares policies: same weights, same optimizer, same minibatches."""
    ours = trpo_reg.Learner(Args(env_id="Pendulum-v1"))
    theirs = ppo_reg.Learner(ppo_reg.Args(env_id="Pendulum-v1"))
    assert torch.equal(flat(ours.critic), flat(theirs.critic))
    assert torch.equal(flat(ours.actor), flat(theirs.actor))
    groups = [x.critic_optimizer.state_dict()["param_groups"] for x in (ours, theirs)]
    assert groups[0] == groups[1]
    states = [x.generators["minibatch"].get_state() for x in (ours, theirs)]
    assert torch.equal(*states)


# --- runs ----------------------------------------------------------------------------------------


def test_the_step_of_every_update_is_logged(tmp_path):
    learner = trpo_reg.train(pendulum(trpo_reg, tmp_path, target_kl=0.02, line_search_shrink=0.5))
    rows = read_metrics(tmp_path)
    assert len(rows) == learner.update == 5
    for row in rows:
        logs = {k.split("/")[1]: float(v) for k, v in row.items() if k.startswith("losses/")}
        assert logs["accepted"] == 1
        assert 0 < logs["kl"] <= 0.02
        assert logs["step_fraction"] in {0.5**i for i in range(10)}
        assert 0 < logs["cg_residual"] < 0.1
        assert 0 < logs["actual_improvement"] < 2 * logs["expected_improvement"]
        assert logs["value_loss"] > 0
    first = math.log(2 * math.pi * math.e) / 2  # of a deviation of 1
    assert float(rows[0]["losses/entropy"]) == pytest.approx(first)


def test_a_strong_penalty_brings_the_policy_into_range(tmp_path):
    psi = {}
    settings = {"env_id": "HopperBulletEnv-v0", "total_timesteps": 30 * 64}
    for coefficient in (0.0, 10.0):
        path = tmp_path / str(coefficient)
        trpo_reg.train(pendulum(trpo_reg, path, coefficient=coefficient, **settings))
        psi[coefficient] = float(read_metrics(path)[-1]["conditioning/psi"])
    assert psi[10.0] < psi[0.0] / 4


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--target-kl=0", "target_kl must be finite and above 0, got 0.0"),
        ("--target-kl=inf", "target_kl must be finite and above 0, got inf"),
        ("--cg-steps=0", "cg_steps must be at least 1, got 0"),
        ("--cg-damping=-0.1", "cg_damping must be finite and above 0, got -0.1"),
        ("--line-search-steps=0", "line_search_steps must be at least 1, got 0"),
        ("--line-search-shrink=1.5", "line_search_shrink must be in [0, 1], got 1.5"),
        ("--vf-epochs=0", "vf_epochs must be at least 1, got 0"),
        ("--vf-learning-rate=nan", "vf_learning_rate must be finite and above 0, got nan"),
    ],
)
def test_bad_flags_of_trpo_are_refused_by_name(monkeypatch, capsys, tmp_path, flag, message):
    check_refusal(trpo_reg, [flag], message, monkeypatch, capsys, tmp_path)


def test_the_file_is_a_program_whose_help_shows_every_flag(monkeypatch, capsys):
    run_file = functools.partial(runpy.run_path, trpo_reg.__file__, run_name="__main__")
    with pytest.raises(SystemExit) as stopped:
        run_main(monkeypatch, "--help", main=run_file)
    said = capsys.readouterr().out
    assert stopped.value.code == 0
    assert all(f"--{name.replace('_', '-')}" in said for name in vars(Args()))
    assert "TRPO (Schulman et al., 2015" in said


@pytest.mark.slow
def test_it_learns(tmp_path):
    """An inverted pendulum is balanced for most of its 1000 steps; a random policy holds it ~30."""
    env_id = "InvertedPendulumBulletEnv-v0"
    trpo_reg.train(Args(env_id=env_id, total_timesteps=40_000, run_dir=tmp_path))
    rows = read_metrics(tmp_path)
    assert float(rows[0]["charts/episodic_return"]) < 100
    assert float(rows[-1]["charts/episodic_return"]) > 500
