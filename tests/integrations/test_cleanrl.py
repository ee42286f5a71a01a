"""Loops in CleanRL's manner, and the diffs that regularize them."""

from __future__ import annotations

import subprocess
import types

import pytest
import torch

from tests.integrations import running

running.require("gymnasium", "tensorboard")

FOLDER = running.EXAMPLES / "cleanrl"
SIZE = {
    "ppo": {"num_steps": 32, "num_iterations": 2},
    "sac": {"total_timesteps": 102, "learning_starts": 64, "batch_size": 32},
}
EXPLICIT = {
    "ppo": [
        (
            "handle = attach(agent.actor_mean, ConditioningRegularizer(args.coefficient))",
            "penalty = ConditioningRegularizer(args.coefficient)",
        ),
        (
            "loss = pg_loss + 0.5 * v_loss",
            "loss = pg_loss + 0.5 * v_loss + penalty(agent.actor_mean, b_obs[mb_inds]).penalty",
        ),
    ],
    "sac": [
        ("handle = attach(actor, penalty)", ""),
        (
            "actor_optimizer.zero_grad()",
            "actor_loss = actor_loss + penalty(actor, b_obs).penalty; actor_optimizer.zero_grad()",
        ),
    ],
}


@pytest.fixture
def patched(tmp_path):
    """The source of a loop with its diff applied."""

    def apply(name):
        (tmp_path / f"{name}.py").write_text((FOLDER / f"{name}.py").read_text())
        words = ["git", "apply", FOLDER / f"{name}.diff"]
        subprocess.run(words, cwd=tmp_path, check=True, capture_output=True)
        return (tmp_path / f"{name}.py").read_text()

    return apply


def run(source, **args):
    module = types.ModuleType("loop")
    exec(compile(source, "loop", "exec", dont_inherit=True), vars(module))
    return module.main(module.Args(**args))


@pytest.mark.parametrize("name", SIZE)
def test_the_diff_is_short_and_removes_nothing(name):
    lines = (FOLDER / f"{name}.diff").read_text().splitlines()[2:]
    assert len([line for line in lines if line.startswith("+") and line.strip("+ ")]) <= 7
    assert not [line for line in lines if line.startswith("-")]
    assert len([line for line in lines if line.endswith("# condwrap")]) == 1


@pytest.mark.parametrize("name", SIZE)
def test_coefficient_0_trains_as_without_condwrap(name, patched, tmp_path):
    plain = run((FOLDER / f"{name}.py").read_text(), run_dir=f"{tmp_path}/plain", **SIZE[name])
    found = [
        run(patched(name), run_dir=f"{tmp_path}/{x}", coefficient=x, **SIZE[name])
        for x in (0.0, 0.1)
    ]
    running.assert_same_bits(running.weights(plain), running.weights(found[0]))
    assert all(psi > 0 for psi in running.tensorboard(tmp_path / "0.0"))

    with pytest.raises(AssertionError):  # so that the comparison can fail
        running.assert_same_bits(running.weights(plain), running.weights(found[1]))


@pytest.mark.parametrize("name", SIZE)
def test_it_trains_as_with_the_penalty_in_the_loss(name, patched, tmp_path):
    source = patched(name)
    edited = source
    for old, new in EXPLICIT[name]:
        assert edited.count(old) == 1
        edited = edited.replace(old, new)
    edited = edited.replace("handle.metrics()", "{}")
    size = {**SIZE[name], "coefficient": 1.0, "learning_rate": 1e-4}
    found = run(source, run_dir=f"{tmp_path}/found", **size)
    expected = run(edited, run_dir=f"{tmp_path}/expected", **size)
    for key, weight in found.state_dict().items():
        torch.testing.assert_close(weight, expected.state_dict()[key], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", SIZE)
def test_a_large_coefficient_moves_psi(name, patched, tmp_path):
    longer = {
        "ppo": {"num_steps": 32, "num_iterations": 10},
        "sac": {"total_timesteps": 401, "learning_starts": 64, "batch_size": 32},
    }
    last = []
    for coefficient in (0.0, 100.0):
        folder = tmp_path / str(coefficient)
        run(patched(name), run_dir=str(folder), coefficient=coefficient, **longer[name])
        last.append(running.tensorboard(folder)[-1])
    assert last[1] < last[0] - 0.1


def test_acting_with_gradients_is_counted_and_not_penalized(patched, tmp_path):
    run(patched("sac"), run_dir=str(tmp_path / "run"), **SIZE["sac"])
    # steps 64 to 100: one call to act and one for the loss, at each
    assert running.tensorboard(tmp_path / "run", "attach/forwards") == [2.0 * 37]
    assert running.tensorboard(tmp_path / "run", "attach/backwards") == [37.0]


@pytest.mark.parametrize("name", SIZE)
def test_saving_and_loading(name, patched, tmp_path):
    trained = run(patched(name), run_dir=f"{tmp_path}/run", **SIZE[name])
    torch.save(trained.state_dict(), tmp_path / "agent.pt")
    fresh = run((FOLDER / f"{name}.py").read_text(), run_dir=f"{tmp_path}/run", **SIZE[name])
    fresh.load_state_dict(torch.load(tmp_path / "agent.pt"))
    running.assert_same_bits(running.weights(trained), running.weights(fresh))
