"""PPO with TorchRL. The line marked condwrap regularizes; psi goes to TorchRL's logger."""

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.record import CSVLogger

from condwrap import ConditioningRegularizer, attach


def train(coefficient=1e-2, total=20_480, frames=1024, log_dir="runs"):
    env = GymEnv("Pendulum-v1")
    torch.manual_seed(env.set_seed(1))
    net = nn.Sequential(nn.Linear(3, 64), nn.Tanh(), nn.Linear(64, 2), NormalParamExtractor())
    net = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    pi = ProbabilisticActor(net, net.out_keys, distribution_class=TanhNormal, return_log_prob=True)
    critic = ValueOperator(nn.Sequential(nn.Linear(3, 64), nn.Tanh(), nn.Linear(64, 1)))
    loss = ClipPPOLoss(pi, critic)  # trains a copy of pi
    penalty = ConditioningRegularizer(coefficient, select=lambda output: output[0])  # loc
    handle = attach(loss.actor_network[0].module, penalty)  # condwrap
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    logger = CSVLogger("torchrl_ppo", log_dir)
    data = Collector(env, pi, frames_per_batch=frames, total_frames=total)
    for step, batch in enumerate(data):
        GAE(gamma=0.99, lmbda=0.95, value_network=critic)(batch)
        for rows in torch.cat([torch.randperm(frames) for _ in range(4)]).split(64):
            sum(x for name, x in loss(batch[rows]).items() if name.startswith("loss_")).backward()
            optimizer.step()
            optimizer.zero_grad()
        logger.log_metrics(handle.metrics() | {"reward": batch["next", "reward"].mean()}, step)
    return loss


if __name__ == "__main__":
    train()
