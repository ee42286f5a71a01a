"""PPO with RLlib's new API stack. The line marked condwrap regularizes; psi is in the results."""

from ray.rllib.algorithms.ppo import PPOConfig

from condwrap.integrations.rllib import PPOTorchLearner


def train(coefficient=1e-2, iterations=5, batch=1024, learner=PPOTorchLearner):
    penalty = {"conditioning": {"coefficient": coefficient}}
    config = (
        PPOConfig()
        .environment("Pendulum-v1")
        .env_runners(num_env_runners=0)
        .training(lr=1e-3, train_batch_size_per_learner=batch, minibatch_size=128, num_epochs=4)
        .rl_module(model_config={"fcnet_hiddens": [64], "vf_share_layers": False})
        .learners(learner_class=learner, learner_config_dict=penalty)  # condwrap
        .debugging(seed=1)
    )
    algorithm = config.build_algo()
    rows = [algorithm.train()["learners"]["default_policy"] for _ in range(iterations)]
    return algorithm, rows


if __name__ == "__main__":
    for row in train()[1]:
        print(f"policy loss {row['policy_loss']:.3f}, psi {row['conditioning/psi']:.3f}")
