"""PPO with skrl. The line marked condwrap regularizes; psi goes to skrl's TensorBoard file."""

import gymnasium as gym
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

from condwrap import ConditioningRegularizer
from condwrap.integrations.skrl import attach


def train(coefficient=1e-2, timesteps=4096, rollouts=256, log_dir="runs"):
    set_seed(1)
    env = wrap_env(gym.make_vec("Pendulum-v1", num_envs=4))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    layers = [{"name": "net", "input": "OBSERVATIONS", "layers": [64], "activations": "tanh"}]
    models = {
        "policy": gaussian_model(**spaces, network=layers, output="ACTIONS"),
        "value": deterministic_model(**spaces, network=layers, output="ONE"),
    }
    cfg = PPO_CFG(rollouts=rollouts, learning_epochs=4, mini_batches=4)
    cfg.observation_preprocessor = RunningStandardScaler
    cfg.observation_preprocessor_kwargs = {"size": env.observation_space}
    cfg.experiment.directory = str(log_dir)
    cfg.experiment.experiment_name = "skrl_ppo"
    cfg.experiment.write_interval = rollouts
    memory = RandomMemory(memory_size=rollouts, num_envs=4)
    agent = PPO(models=models, memory=memory, cfg=cfg, **spaces)
    attach(agent, ConditioningRegularizer(coefficient))  # condwrap
    SequentialTrainer(env=env, agents=agent, cfg={"timesteps": timesteps}).train()
    return agent


if __name__ == "__main__":
    train()
