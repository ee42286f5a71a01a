"""A PPO agent of Stable-Baselines3 with the penalty: `python examples/sb3_ppo.py`, in seconds.

It needs `pip install condwrap stable-baselines3`. The tables that it prints are SB3's own.
"""

import numpy as np
import torch
from stable_baselines3 import PPO

import condwrap
from condwrap.integrations import sb3


def psi(model: PPO) -> float:
    """Of the actor's mean on 256 observations."""
    model.observation_space.seed(0)
    obs = torch.as_tensor(np.stack([model.observation_space.sample() for _ in range(256)]))

    def policy(obs: torch.Tensor) -> torch.distributions.Distribution:
        return model.policy.get_distribution(obs).distribution

    return condwrap.summary(policy, obs).psi


if __name__ == "__main__":
    model = PPO("MlpPolicy", "Pendulum-v1", n_steps=512, learning_rate=1e-3, seed=0, verbose=1)
    before = psi(model)

    # the line that regularizes
    sb3.attach(model, condwrap.ConditioningRegularizer(coefficient=1.0))
    model.learn(4096)

    print(f"psi before {before:.3f}")
    print(f"psi after {psi(model):.3f}")
