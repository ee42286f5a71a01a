"""python -m condwrap summary: the conditioning of a policy that lies on disk."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from condwrap.disk import DiskError, Found, read_policy
from condwrap.regularizer import ConditioningRegularizer
from condwrap.summary import summary
from condwrap.visits import collect


def main(words: list[str] | None = None) -> None:
    """Read the command line, measure, print."""
    args = make_parser().parse_args(words)
    if args.states < 1:
        sys.exit(f"error: --states must be at least 1, got {args.states}")
    try:
        found = read_policy(args.source, args.trust)
        obs, where = observe(found, args)
        regularizer = ConditioningRegularizer(
            1.0, args.lambda_min, args.lambda_max, radius=args.radius, seed=args.seed
        )
        shown = summary(found.policy, obs, regularizer, max_states=args.states)
    except (TypeError, ValueError) as error:  # each says what is wrong and what to do
        sys.exit(f"error: {error}")

    if args.json:
        numbers = {k: v if math.isfinite(v) else None for k, v in shown.to_dict(prefix="").items()}
        print(json.dumps(numbers, indent=2))
    else:
        print(f"{found.about}; observations of {where}")
        print(shown)


def make_parser() -> argparse.ArgumentParser:
    """What the command takes."""
    parser = argparse.ArgumentParser(prog="python -m condwrap", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="summary")
    command = commands.add_parser(
        "summary",
        help="how sensitive a policy's output is to its observations",
        description="Print a policy's conditioning: quantiles of J, psi, singular values, the "
        "observed values that it is most sensitive to, and a range to start from.",
    )
    command.add_argument(
        "source",
        help="module:callable, a checkpoint of ppo_reg or trpo_reg or its run's folder, a "
        "TorchScript file, a Stable-Baselines3 model (.zip), a torch.export file (.pt2)",
    )
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--env-id", help="play this Gymnasium environment for observations; where the source names "
        "its own, that is the default",
    )  # fmt: skip
    where.add_argument("--obs", type=Path, help=".npy file of observations, [B, *obs_shape]")
    command.add_argument("--states", type=int, default=256, help="how many are measured")
    command.add_argument("--lambda-min", type=float, default=1.0, help="lower end of psi's range")
    command.add_argument("--lambda-max", type=float, default=20.0, help="upper end of psi's range")
    command.add_argument("--radius", type=float, default=1.0, help="length of delta")
    command.add_argument("--seed", type=int, default=0, help="of delta and of the environment")
    command.add_argument("--json", action="store_true", help="print the numbers as JSON")
    command.add_argument(
        "--trust", action="store_true", help="load files that can execute code when they are read"
    )
    return parser


def observe(found: Found, args: Any) -> tuple[torch.Tensor, str]:
    """The observations that were asked for, as the policy sees them, and where they are from."""
    if args.obs is not None:
        try:
            obs = torch.as_tensor(np.load(args.obs, allow_pickle=False))
        except (OSError, ValueError) as error:
            raise DiskError(f"{args.obs} is no .npy file of numbers: {error}") from error
        obs = found.normalize(obs)
        return obs.float() if obs.dtype == torch.float64 else obs, str(args.obs)

    env_id = args.env_id or found.env_id
    if env_id is None:
        raise DiskError("name where observations come from: --env-id ID or --obs FILE.npy")
    return collect(found, env_id, args.states, args.seed)


if __name__ == "__main__":
    main()
