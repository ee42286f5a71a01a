"""The 8 PyBullet tasks of the paper, bit for bit those of pybullet_envs_gymnasium, but faster.

    gym.make("harness.envs.fast_bullet:FastHopperBulletEnv-v0")

importing this module registers each stock task once more, its id prefixed by `Fast`.

The stock tasks ask Bullet for every joint and link by a call of its own, several times over. Here a
robot reads all joints in one call and all links in another, and writes all torques in a third;
NumPy's reductions and small arrays give way to plain floats. What a user sees stays equal:

- Bullet gets the same commands with the same values in the same order; reading changes nothing.
- Floats are computed by the same operations in the same order and precision. Where NumPy and the
  math library, or two ways to sum, may differ in the last bit, the stock tasks' way is taken: sums
  over an array (pairwise), dot products (BLAS, which may fuse), sin, cos and arctan2 of NumPy. Types
  decide precision: a Python float times a float32 is a float32, times a float64 it is a float64.
- Simulation, scene, loading, rewards' weights, rendering and closing are inherited.

All this holds for the sources that `tests/harness/envs/test_fast_bullet.py` records by their hash.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
import pybullet_envs_gymnasium  # noqa: F401  (registers the stock tasks)
from pybullet_envs_gymnasium import gym_locomotion_envs, gym_manipulator_envs, gym_pendulum_envs
from pybullet_envs_gymnasium import robot_locomotors as locomotors
from pybullet_envs_gymnasium.robot_bases import Joint, MJCFBasedRobot
from pybullet_envs_gymnasium.robot_manipulators import Reacher
from pybullet_envs_gymnasium.robot_pendula import InvertedDoublePendulum

LOW, HIGH = np.array(-5, np.float32), np.array(5, np.float32)
Step = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


def body_of(item: Any) -> int:
    """The id of the body that a joint or a part of a robot belongs to."""
    return item.bodies[item.bodyIndex]


def finite(a: np.ndarray) -> list[float]:
    """The action as Python floats, refused by the stock tasks' error if one is not finite."""
    values = a.tolist()
    assert all(map(math.isfinite, values))
    return values


def clip(a: np.ndarray) -> list[float]:
    return [-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in finite(a)]


class Joints:
    """Joints of one body, read and driven together."""

    def __init__(self, joints: list[Joint]) -> None:
        p, body = joints[0]._p, body_of(joints[0])
        indices = [joint.jointIndex for joint in joints]
        self._limits = [(joint.lowerLimit, joint.upperLimit - joint.lowerLimit) for joint in joints]
        self.states = functools.partial(p.getJointStates, body, indices)
        self._drive = functools.partial(
            p.setJointMotorControlArray, body, indices, pybullet.TORQUE_CONTROL
        )

    def set_torques(self, torques: list[float]) -> None:
        self._drive(forces=torques)

    def relative_states(self) -> list[float]:
        """Each joint's position, scaled to [-1, 1] between its limits, and a tenth of its speed."""
        relative: list[float] = []
        for (position, speed, _, _), (low, span) in zip(self.states(), self._limits, strict=True):
            relative += 2 * (position - low) / span - 1.0, 0.1 * speed
        return relative


class FastRobot(MJCFBasedRobot):
    """Binds its calls of Bullet once an episode, when its bodies are in the scene."""

    def robot_specific_reset(self, bullet_client: Any) -> None:
        super().robot_specific_reset(bullet_client)
        self.bind()

    def bind(self) -> None:
        raise NotImplementedError


class FastEnv(gym.Env):
    """Puts a fast robot into a stock task."""

    robot_class: type[FastRobot]

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.robot = self.robot_class()
        self.robot.np_random = self.np_random

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        obs, info = super().reset(seed=seed, options=options)
        self.robot.bind()  # by now the stadium's floor is among the robot's parts
        self._simulate = self._p.stepSimulation
        return obs, info


# --- locomotion -----------------------------------------------------------------------------------


class Walker(FastRobot, locomotors.WalkerBase):
    def bind(self) -> None:
        p, torso = self._p, self.robot_body
        body, parts = body_of(torso), list(self.parts.values())
        links = [part.bodyPartIndex for part in parts if body_of(part) == body]
        self._base_at = links.index(-1) if -1 in links else None  # a base is no link to Bullet
        self._torso_at = links.index(torso.bodyPartIndex)
        self._others = [part.current_position() for part in parts if body_of(part) != body]
        with_speed = int(self._base_at is None)
        links = [link for link in links if link != -1]
        self._links = functools.partial(p.getLinkStates, body, links, with_speed)
        self._base = functools.partial(p.getBasePositionAndOrientation, body)
        self._base_speed = functools.partial(p.getBaseVelocity, body)
        self._contacts = functools.partial(p.getContactPoints, body, linkIndexB=-1)
        self._feet_links = [foot.bodyPartIndex for foot in self.feet]
        self._joints = Joints(self.ordered_joints)
        self._gains = [self.power * joint.power_coef for joint in self.ordered_joints]
        self._rotation = np.eye(3)

    def apply_action(self, a: np.ndarray) -> None:
        self._joints.set_torques([g * x for g, x in zip(self._gains, clip(a), strict=True)])

    def calc_state(self) -> np.ndarray:
        links = self._links()
        if self._base_at is None:
            torso = links[self._torso_at]
            # upstream's y speed is overwritten by the angular speed around z
            speed = torso[6][0], torso[7][2], torso[6][2]
        else:
            torso = self._base()
            links = (*links[: self._base_at], torso, *links[self._base_at :])
            speed = self._base_speed()[0]
        positions = [link[0] for link in links] + self._others
        x = np.add.reduce(np.array([p[0] for p in positions])) / len(positions)
        y = np.add.reduce(np.array([p[1] for p in positions])) / len(positions)
        z = np.float64(torso[0][2])
        self.body_xyz = x, y, z
        self.body_real_xyz = torso[0]
        self.body_rpy = roll, pitch, yaw = pybullet.getEulerFromQuaternion(torso[1])
        if self.initial_z is None:
            self.initial_z = z
        to_target = np.array([self.walk_target_y - y, self.walk_target_x - x])
        self.walk_target_theta = np.arctan2(*to_target)
        self.walk_target_dist = math.sqrt(to_target.dot(to_target))
        angle_to_target = self.walk_target_theta - yaw
        cos, sin, rotation = np.cos(-yaw), np.sin(-yaw), self._rotation
        rotation[0, 0] = rotation[1, 1] = cos
        rotation[0, 1], rotation[1, 0] = -sin, sin
        vx, vy, vz = rotation.dot(speed).tolist()

        relative = self._joints.relative_states()
        end = 8 + len(relative)
        state = np.array(
            [
                z - self.initial_z,
                np.sin(angle_to_target),
                np.cos(angle_to_target),
                0.3 * vx,
                0.3 * vy,
                0.3 * vz,
                roll,
                pitch,
                *relative,
                *self.feet_contact,
            ],
            dtype=np.float32,
        )
        self.joint_speeds = state[9:end:2]
        self.joints_at_limit = np.count_nonzero(np.abs(state[8:end:2]) > 0.99)
        return np.minimum(np.maximum(state, LOW), HIGH)

    def find_contacts(self, ground: set[tuple[int, int]]) -> None:
        """Note which feet touch the ground: (body, link) pairs whose link is a base."""
        touching = {c[3] for c in self._contacts() if (c[2], c[4]) in ground}
        self.feet_contact = [1.0 if link in touching else 0.0 for link in self._feet_links]


class WalkerEnv(FastEnv, gym_locomotion_envs.WalkerBaseBulletEnv):
    def step(self, a: np.ndarray) -> Step:
        robot, a = self.robot, np.asarray(a)
        robot.apply_action(a)
        self._simulate()
        state = robot.calc_state()
        self._alive = float(robot.alive_bonus(state[0] + robot.initial_z, robot.body_rpy[1]))
        done = self._isDone()
        if math.isnan(state.dot(state)):  # clipped, it has no infinities
            print("~INF~", state)
            done = True
        potential_old, self.potential = self.potential, robot.calc_potential()
        robot.find_contacts(self.ground_ids)
        electricity_cost = self.electricity_cost * mean(np.abs(a * robot.joint_speeds))
        electricity_cost += self.stall_torque_cost * mean(np.square(a))
        self.rewards = [
            self._alive,
            float(self.potential - potential_old),
            electricity_cost,
            float(self.joints_at_limit_cost * robot.joints_at_limit),
            0.0,
        ]
        reward = sum(self.rewards)
        self.reward += reward
        return state, reward, bool(done), False, {}


def mean(x: np.ndarray) -> float:
    return float(np.add.reduce(x) / len(x))


class Hopper(Walker, locomotors.Hopper):
    pass


class Walker2D(Walker, locomotors.Walker2D):
    pass


class HalfCheetah(Walker, locomotors.HalfCheetah):
    pass


class Ant(Walker, locomotors.Ant):
    pass


class Humanoid(Walker, locomotors.Humanoid):
    def bind(self) -> None:
        super().bind()
        self._motors = Joints(self.motors)
        self._gains = [power * self.power for power in self.motor_power]

    def apply_action(self, a: np.ndarray) -> None:
        # The product of a Python float and a NumPy scalar has the precision of the action.
        finite(a)
        torques = [float(g * x) for g, x in zip(self._gains, np.clip(a, -1, 1), strict=True)]
        self._motors.set_torques(torques)


class HumanoidFlagrun(Humanoid, locomotors.HumanoidFlagrun):
    def calc_state(self) -> np.ndarray:
        self.flag_timeout -= 1
        state = super().calc_state()
        if self.walk_target_dist < 1 or self.flag_timeout <= 0:
            self.flag_reposition()
            state = super().calc_state()  # towards the new flag
            self.potential = self.calc_potential()
        return state


class FastHopperBulletEnv(WalkerEnv, gym_locomotion_envs.HopperBulletEnv):
    robot_class = Hopper


class FastWalker2DBulletEnv(WalkerEnv, gym_locomotion_envs.Walker2DBulletEnv):
    robot_class = Walker2D


class FastHalfCheetahBulletEnv(WalkerEnv, gym_locomotion_envs.HalfCheetahBulletEnv):
    robot_class = HalfCheetah


class FastAntBulletEnv(WalkerEnv, gym_locomotion_envs.AntBulletEnv):
    robot_class = Ant


class FastHumanoidBulletEnv(WalkerEnv, gym_locomotion_envs.HumanoidBulletEnv):
    robot_class = Humanoid


class FastHumanoidFlagrunBulletEnv(WalkerEnv, gym_locomotion_envs.HumanoidFlagrunBulletEnv):
    robot_class = HumanoidFlagrun


# --- the others -----------------------------------------------------------------------------------


class FastReacher(FastRobot, Reacher):
    def bind(self) -> None:
        p = self._p
        self._arm = Joints([self.central_joint, self.elbow_joint])
        self._target = Joints([self.jdict["target_x"], self.jdict["target_y"]])
        self._tip_link, self._target_link = (
            functools.partial(p.getLinkState, body_of(part), part.bodyPartIndex)
            for part in (self.fingertip, self.target)
        )

    def apply_action(self, a: np.ndarray) -> None:
        self._arm.set_torques([0.05 * x for x in clip(a)])

    def calc_state(self) -> np.ndarray:
        theta, self.theta_dot, self.gamma, self.gamma_dot = self._arm.relative_states()
        (target_x, *_), (target_y, *_) = self._target.states()
        tip, target = self._tip_link()[0], self._target_link()[0]
        x, y, z = (a - b for a, b in zip(tip, target, strict=True))
        self.to_target_vec = np.array([x, y, z])
        return np.array(
            [
                target_x,
                target_y,
                x,
                y,
                np.cos(theta),
                np.sin(theta),
                self.theta_dot,
                self.gamma,
                self.gamma_dot,
            ],
            dtype=np.float32,
        )

    def calc_potential(self) -> float:
        return -100 * math.sqrt(self.to_target_vec.dot(self.to_target_vec))


class FastReacherBulletEnv(FastEnv, gym_manipulator_envs.ReacherBulletEnv):
    robot_class = FastReacher

    def step(self, a: np.ndarray) -> Step:
        robot = self.robot
        robot.apply_action(np.asarray(a))
        self._simulate()
        state = robot.calc_state()
        potential_old, self.potential = self.potential, robot.calc_potential()
        work = abs(a[0] * robot.theta_dot) + abs(a[1] * robot.gamma_dot)
        electricity_cost = -0.10 * work - 0.01 * (abs(a[0]) + abs(a[1]))
        stuck_joint_cost = -0.1 if abs(abs(robot.gamma) - 1) < 0.01 else 0.0
        self.rewards = [self.potential - potential_old, float(electricity_cost), stuck_joint_cost]
        return state, sum(self.rewards), False, False, {}


class FastInvertedDoublePendulum(FastRobot, InvertedDoublePendulum):
    def bind(self) -> None:
        part = self.pole2
        self._pole2 = functools.partial(self._p.getLinkState, body_of(part), part.bodyPartIndex)
        self._joints = Joints([self.slider, self.j1, self.j2])
        self._slider = Joints([self.slider])

    def apply_action(self, a: np.ndarray) -> None:
        self._slider.set_torques([200 * clip(a)[0]])

    def calc_state(self) -> np.ndarray:
        (x, vx, *_), (theta, theta_dot, *_), (gamma, gamma_dot, *_) = self._joints.states()
        self.pos_x, _, self.pos_y = np.array(self._pole2()[0])
        assert math.isfinite(x)
        return np.array(
            [
                x,
                vx,
                self.pos_x,
                np.cos(theta),
                np.sin(theta),
                theta_dot,
                np.cos(gamma),
                np.sin(gamma),
                gamma_dot,
            ],
            dtype=np.float32,
        )


class FastInvertedDoublePendulumBulletEnv(FastEnv, gym_pendulum_envs.InvertedDoublePendulumBulletEnv):
    robot_class = FastInvertedDoublePendulum

    def step(self, a: np.ndarray) -> Step:
        robot = self.robot
        robot.apply_action(np.asarray(a))
        self._simulate()
        state = robot.calc_state()
        dist_penalty = 0.01 * robot.pos_x**2 + (robot.pos_y + 0.3 - 2) ** 2
        done = robot.pos_y + 0.3 <= 1
        self.rewards = [10.0, float(-dist_penalty), 0.0]
        return state, sum(self.rewards), bool(done), False, {}


TASKS = tuple(
    f"{name}BulletEnv-v0"
    for name in (
        "Humanoid",
        "Hopper",
        "Ant",
        "Reacher",
        "InvertedDoublePendulum",
        "Walker2D",
        "HumanoidFlagrun",
        "HalfCheetah",
    )
)

for task in TASKS:
    stock = gym.spec(task)
    gym.register(
        f"Fast{task}",
        f"{__name__}:Fast{stock.name}",
        reward_threshold=stock.reward_threshold,
        max_episode_steps=stock.max_episode_steps,
    )
