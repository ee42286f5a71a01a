"""PPO with JAX and Flax, all of it compiled. The line marked condwrap regularizes."""

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax.training.train_state import TrainState

from condwrap import clamping_penalty, conditioning_quotient

actor = nn.Sequential([nn.Dense(64), nn.tanh, nn.Dense(2)])


def loss_of(params, obs, action, logprob, advantage, delta, coefficient):
    mean, perturbed_mean = [actor.apply(params, states) for states in (obs, obs + delta)]
    ratio = jnp.exp(-0.5 * jnp.square(action - mean).sum(-1) - logprob)
    loss = -jnp.minimum(ratio * advantage, ratio.clip(0.8, 1.2) * advantage).mean()
    psi = clamping_penalty(conditioning_quotient(mean, perturbed_mean, delta)).mean()
    return loss + coefficient * psi, psi  # condwrap


def train(coefficient=1e-2, updates=200):
    def update(state, key):  # of a task whose episodes have one step
        obs, noise, delta = jax.random.normal(key, (3, 256, 2))
        action = actor.apply(state.params, obs) + noise
        reward = -jnp.square(action - jnp.sin(obs)).sum(-1)
        data = (obs, action, -0.5 * jnp.square(noise).sum(-1), reward - reward.mean(), delta)
        for _ in range(4):
            (_, psi), gradients = losses(state.params, *data, coefficient)
            state = state.apply_gradients(grads=gradients)
        return state, {"reward": reward.mean(), "conditioning/psi": psi}

    losses = jax.value_and_grad(loss_of, has_aux=True)
    params = actor.init(jax.random.key(0), jnp.ones(2))
    state = TrainState.create(apply_fn=actor.apply, params=params, tx=optax.adam(1e-3))
    return jax.lax.scan(update, state, jax.random.split(jax.random.key(1), updates))


if __name__ == "__main__":
    print(train()[1])  # reward and psi of each update
