"""A small PPO in CleanRL's manner, without condwrap. ppo.diff regularizes it."""

import dataclasses

import gymnasium as gym
import torch
from torch import nn
from torch.distributions import Normal
from torch.utils.tensorboard import SummaryWriter


@dataclasses.dataclass
class Args:
    run_dir: str = "runs/cleanrl_ppo"
    seed: int = 1
    env_id: str = "Pendulum-v1"
    num_envs: int = 4
    num_steps: int = 256
    num_iterations: int = 20
    num_minibatches: int = 4
    update_epochs: int = 4
    learning_rate: float = 1e-3
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_coef: float = 0.2


class Agent(nn.Module):
    def __init__(self, n_obs, n_actions):
        super().__init__()
        self.critic = nn.Sequential(nn.Linear(n_obs, 64), nn.Tanh(), nn.Linear(64, 1))
        self.actor_mean = nn.Sequential(nn.Linear(n_obs, 64), nn.Tanh(), nn.Linear(64, n_actions))
        self.actor_logstd = nn.Parameter(torch.zeros(1, n_actions))

    def get_action_and_value(self, obs, action=None):
        policy = Normal(self.actor_mean(obs), self.actor_logstd.exp())
        action = policy.sample() if action is None else action
        return action, policy.log_prob(action).sum(-1), self.critic(obs).squeeze(-1)


def main(args):
    torch.manual_seed(args.seed)
    writer = SummaryWriter(args.run_dir)
    envs = gym.make_vec(args.env_id, num_envs=args.num_envs)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate)

    next_obs = torch.as_tensor(envs.reset(seed=args.seed)[0])
    for iteration in range(args.num_iterations):
        rows = []
        for _ in range(args.num_steps):
            with torch.no_grad():
                action, logprob, value = agent.get_action_and_value(next_obs)
            obs, reward, terminated, *_ = envs.step(action.numpy())
            reward = torch.as_tensor(reward, dtype=torch.float32)
            rows.append((next_obs, action, logprob, value, reward, torch.as_tensor(terminated)))
            next_obs = torch.as_tensor(obs)
        columns = [torch.stack(column) for column in zip(*rows, strict=True)]
        b_obs, b_actions, b_logprobs, values, rewards, dones = columns

        # GAE; the time limit of the task is not treated apart
        with torch.no_grad():
            next_value = agent.critic(next_obs).squeeze(-1)
        advantage = torch.zeros(args.num_envs)
        advantages = torch.zeros_like(rewards)
        for t in reversed(range(args.num_steps)):
            td_error = rewards[t] + args.gamma * next_value * ~dones[t] - values[t]
            advantage = td_error + args.gamma * args.gae_lambda * advantage * ~dones[t]
            advantages[t] = advantage
            next_value = values[t]

        batch = [b_obs, b_actions, b_logprobs, advantages, advantages + values]
        b_obs, b_actions, b_logprobs, b_advantages, b_returns = (x.flatten(0, 1) for x in batch)
        for _ in range(args.update_epochs):
            for mb_inds in torch.randperm(len(b_obs)).chunk(args.num_minibatches):
                _, newlogprob, newvalue = agent.get_action_and_value(
                    b_obs[mb_inds], b_actions[mb_inds]
                )
                ratio = (newlogprob - b_logprobs[mb_inds]).exp()
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                mb_advantages = b_advantages[mb_inds]
                mb_advantages = (mb_advantages - mb_advantages.mean()) / mb_advantages.std()
                pg_loss = -torch.min(ratio * mb_advantages, clipped * mb_advantages).mean()
                v_loss = 0.5 * (newvalue - b_returns[mb_inds]).square().mean()
                loss = pg_loss + 0.5 * v_loss
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        writer.add_scalar("charts/reward", rewards.mean(), iteration)
    writer.close()
    return agent


if __name__ == "__main__":
    main(Args())
