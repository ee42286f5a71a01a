"""Attacks: the perturbation of a state, in a ball, that an adversary would choose.

`random`, `mad`, `critic` and `robust_sarsa` map (policy, obs, radius, norm) to a delta for each
state of the batch. They leave the policy, its gradients and the global random state as they were,
and work where the caller has turned gradients off. What the agent sees is obs + delta.
"""

from condwrap.attacks.critics import critic, robust_sarsa
from condwrap.attacks.methods import mad, random
from condwrap.attacks.sarsa import Transitions, fit_action_value

__all__ = ["Transitions", "critic", "fit_action_value", "mad", "random", "robust_sarsa"]
