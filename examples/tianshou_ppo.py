"""PPO with Tianshou. The line marked condwrap regularizes; psi goes to Tianshou's logger."""

import gymnasium as gym
import tianshou as ts
import torch
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch.distributions import Independent, Normal
from torch.utils.tensorboard import SummaryWriter

from condwrap import ConditioningRegularizer
from condwrap.integrations.tianshou import attach


def train(coefficient=1e-2, epochs=5, steps=2048, log_dir="runs/tianshou_ppo"):
    torch.manual_seed(1)
    envs = ts.env.DummyVectorEnv([lambda: gym.make("Pendulum-v1") for _ in range(4)])
    envs.seed(1)
    nets = [Net(state_shape=3, hidden_sizes=[64]) for _ in range(2)]
    actor = ContinuousActorProbabilistic(preprocess_net=nets[0], action_shape=1, unbounded=True)
    more = {"action_space": envs.action_space[0], "dist_fn": lambda x: Independent(Normal(*x), 1)}
    policy = ProbabilisticActorPolicy(actor=actor, **more)
    critic = ContinuousCritic(preprocess_net=nets[1])
    algorithm = ts.algorithm.PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3))
    penalty = ConditioningRegularizer(coefficient, select=lambda output: output[0][0])  # mean
    handle = attach(actor, penalty)  # condwrap
    log = ts.utils.TensorboardLogger(SummaryWriter(log_dir))
    data = ts.data.Collector(algorithm, envs, ts.data.VectorReplayBuffer(steps, 4))
    cfg = ts.trainer.OnPolicyTrainerParams(training_collector=data, logger=log, max_epochs=epochs)
    cfg.epoch_num_steps = steps
    cfg.collection_step_num_env_steps = steps // 4
    cfg.training_fn = lambda _, step: log.write("update/env_step", step, handle.metrics())
    algorithm.run_training(cfg)
    return algorithm


if __name__ == "__main__":
    train()
