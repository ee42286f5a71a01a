"""A small SAC in CleanRL's manner, without condwrap. sac.diff regularizes it."""

import copy
import dataclasses
import itertools

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal
from torch.utils.tensorboard import SummaryWriter


@dataclasses.dataclass
class Args:
    run_dir: str = "runs/cleanrl_sac"
    seed: int = 1
    env_id: str = "Pendulum-v1"
    total_timesteps: int = 5_000
    learning_starts: int = 500
    batch_size: int = 256
    learning_rate: float = 1e-3
    gamma: float = 0.99
    tau: float = 0.005
    alpha: float = 0.2


class SoftQNetwork(nn.Module):
    def __init__(self, n_obs, n_actions):
        super().__init__()
        layers = [nn.Linear(n_obs + n_actions, 64), nn.ReLU(), nn.Linear(64, 1)]
        self.net = nn.Sequential(*layers)

    def forward(self, obs, action):
        return self.net(torch.cat([obs, action], -1)).squeeze(-1)


class Actor(nn.Module):
    def __init__(self, n_obs, n_actions, action_scale):
        super().__init__()
        self.fc = nn.Linear(n_obs, 64)
        self.fc_mean = nn.Linear(64, n_actions)
        self.fc_logstd = nn.Linear(64, n_actions)
        self.action_scale = action_scale

    def forward(self, obs):
        hidden = self.fc(obs).relu()
        return self.fc_mean(hidden), -1.5 + 3.5 * self.fc_logstd(hidden).tanh()  # in [-5, 2]

    def get_action(self, obs):
        mean, log_std = self(obs)
        policy = Normal(mean, log_std.exp())
        before_tanh = policy.rsample()
        slope = self.action_scale * (1 - before_tanh.tanh().square()) + 1e-6
        log_prob = (policy.log_prob(before_tanh) - slope.log()).sum(-1)
        return before_tanh.tanh() * self.action_scale, log_prob


def main(args):
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    writer = SummaryWriter(args.run_dir)
    env = gym.make(args.env_id)
    env.action_space.seed(args.seed)
    n_obs = env.observation_space.shape[0]
    n_actions = env.action_space.shape[0]
    actor = Actor(n_obs, n_actions, float(env.action_space.high[0]))
    qfs = [SoftQNetwork(n_obs, n_actions) for _ in range(2)]
    targets = copy.deepcopy(qfs)
    q_parameters = list(itertools.chain(*(qf.parameters() for qf in qfs)))
    q_optimizer = torch.optim.Adam(q_parameters, lr=args.learning_rate)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=args.learning_rate)
    buffer = []

    obs, _ = env.reset(seed=args.seed)
    for step in range(args.total_timesteps):
        if step < args.learning_starts:
            action = env.action_space.sample()
        else:  # with gradients on, as CleanRL's
            action = actor.get_action(torch.as_tensor(obs)[None])[0][0].detach().numpy()
        next_obs, reward, terminated, truncated, _ = env.step(action)
        buffer.append((obs, next_obs, action, np.float32(reward), np.float32(terminated)))
        obs = env.reset()[0] if terminated or truncated else next_obs
        if step < args.learning_starts:
            continue

        picked = [buffer[i] for i in rng.integers(len(buffer), size=args.batch_size)]
        columns = [torch.as_tensor(np.stack(column)) for column in zip(*picked, strict=True)]
        b_obs, b_next_obs, b_actions, b_rewards, b_dones = columns
        with torch.no_grad():
            next_action, next_logprob = actor.get_action(b_next_obs)
            next_q = torch.min(*(target(b_next_obs, next_action) for target in targets))
            next_q = b_rewards + args.gamma * (1 - b_dones) * (next_q - args.alpha * next_logprob)
        q_loss = sum(nn.functional.mse_loss(qf(b_obs, b_actions), next_q) for qf in qfs)
        q_optimizer.zero_grad()
        q_loss.backward()
        q_optimizer.step()

        pi, logprob = actor.get_action(b_obs)
        actor_loss = (args.alpha * logprob - torch.min(*(qf(b_obs, pi) for qf in qfs))).mean()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()

        for qf, target in zip(qfs, targets, strict=True):
            for one, other in zip(qf.parameters(), target.parameters(), strict=True):
                other.data.lerp_(one.data, args.tau)
        if step % 100 == 0:
            writer.add_scalar("losses/actor_loss", actor_loss.item(), step)
    writer.close()
    return actor


if __name__ == "__main__":
    main(Args())
