"""PPO with rsl-rl. The line marked condwrap regularizes; psi is among rsl-rl's logged losses."""

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict


class Reach(VecEnv):  # points that their actions move towards 0
    num_envs, num_actions, max_episode_length, device, cfg = 64, 2, 32, "cpu", {}
    episode_length_buf = torch.zeros(64)
    points = torch.ones(64, 2)

    def get_observations(self):
        return TensorDict({"policy": self.points}, batch_size=[64])

    def step(self, actions):
        points = (self.points + 0.1 * actions).clamp(-3, 3)
        done = self.episode_length_buf == 31
        self.episode_length_buf = (self.episode_length_buf + 1) * ~done
        self.points = torch.where(done[:, None], torch.randn(64, 2), points)
        return self.get_observations(), -points.square().sum(-1), done, {}


def train(coefficient=1e-2, iterations=20, log_dir="runs/rsl_rl_ppo"):
    torch.manual_seed(1)
    net = {"class_name": "MLPModel", "hidden_dims": [64], "activation": "tanh"}
    groups = {"actor": ["policy"], "critic": ["policy"]}
    cfg = {"num_steps_per_env": 32, "save_interval": 100, "obs_groups": groups, "critic": net}
    cfg["actor"] = net | {"distribution_cfg": {"class_name": "GaussianDistribution"}}
    penalty = {"conditioning_cfg": {"coefficient": coefficient}}
    cfg["algorithm"] = {"class_name": "condwrap.integrations.rsl_rl:PPO", **penalty}  # condwrap
    runner = OnPolicyRunner(Reach(), cfg, log_dir)
    runner.learn(iterations)
    return runner


if __name__ == "__main__":
    train()
