"""The 8 PyBullet tasks of the paper, bit for bit those of pybullet_envs_gymnasium, but faster.

    gym.make("harness.envs.fast_bullet:FastHopperBulletEnv-v0")

Importing this module registers each stock task once more, `Fast` before its id. The ids differ, so
that stock and fast tasks can be made side by side, and a run's id says which of them it used.

A stock task asks Bullet for each joint and each link by a call of its own, several times over. Here
one call reads all joints, one all links, one all contacts, and one sets all torques; plain floats
replace small arrays. What a user sees stays equal:

- Bullet gets the stock task's commands with the same values in the same order, but for those that
  only read. Scenes, episodes' starts, rewards' weights, rendering and closing are inherited.
- Numbers come of the same operations in the same order and precision. Where two ways may differ in
  the last bit, the stock task's is kept: NumPy's sine, cosine, arctan2 and dot product; its sums
  over one axis (pairwise); and the type of a Python float times a NumPy scalar, the scalar's.

One more task has no stock counterpart: FastHalfCheetahPyBulletEnv-v0, whose episodes end when the
cheetah falls, as in pybullet-gym, the paper's simulator. But for `Fast` its id is the one there.

This holds for the sources of the stock tasks that tests/harness/envs/test_fast_bullet.py names by
their hashes; the same file compares the two, step by step.
"""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pybullet
from pybullet_envs_gymnasium import gym_locomotion_envs as tasks
from pybullet_envs_gymnasium import robot_locomotors as robots
from pybullet_envs_gymnasium.env_bases import MJCFBaseBulletEnv
from pybullet_envs_gymnasium.gym_manipulator_envs import ReacherBulletEnv
from pybullet_envs_gymnasium.gym_pendulum_envs import InvertedDoublePendulumBulletEnv
from pybullet_envs_gymnasium.robot_bases import BodyPart, Joint, MJCFBasedRobot
from pybullet_envs_gymnasium.robot_manipulators import Reacher
from pybullet_envs_gymnasium.robot_pendula import InvertedDoublePendulum

NAMES = ["Humanoid", "Hopper", "Ant", "Reacher", "InvertedDoublePendulum", "Walker2D"]
NAMES += ["HumanoidFlagrun", "HalfCheetah"]

LOW, HIGH, LIMIT = (np.array(x, np.float32) for x in (-5, 5, 0.99))  # NumPy converts no arrays
Step = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


def body_of(item: BodyPart | Joint) -> int:
    return item.bodies[item.bodyIndex]


def clip(a: np.ndarray) -> list[float]:
    values = a.tolist()
    assert all(map(math.isfinite, values))  # as in the stock tasks
    return [-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in values]


def mean(x: np.ndarray) -> float:
    return float(np.add.reduce(x) / len(x))


class Joints:
    """Joints of one body, read and driven together."""

    def __init__(self, *joints: Joint) -> None:
        p, body, indices = joints[0]._p, body_of(joints[0]), [j.jointIndex for j in joints]
        self.limits = [(j.lowerLimit, j.upperLimit - j.lowerLimit) for j in joints]
        self.states = functools.partial(p.getJointStates, body, indices)
        torque = pybullet.TORQUE_CONTROL
        self.drive = functools.partial(p.setJointMotorControlArray, body, indices, torque)

    def relative_states(self) -> list[float]:
        """Each joint's position, scaled to [-1, 1] between its limits, and a tenth of its speed."""
        relative: list[float] = []
        for (position, speed, _, _), (low, span) in zip(self.states(), self.limits, strict=True):
            relative += 2 * (position - low) / span - 1.0, 0.1 * speed
        return relative


class FastRobot(MJCFBasedRobot):
    """A robot whose `bind` prepares its calls of Bullet, and whose `read_state` makes them."""

    bound_parts = 0

    def calc_state(self) -> np.ndarray:
        if self.bound_parts != len(self.parts):  # just loaded, or the floor was added
            self.bound_parts = len(self.parts)
            self.bind()
        return self.read_state()


class FastEnv(MJCFBaseBulletEnv):
    """A stock task whose robot is a fast one."""

    fast_robot: ClassVar[type[FastRobot]]

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.robot = self.fast_robot()
        self.robot.np_random = self.np_random

    def simulate(self, a: np.ndarray) -> np.ndarray:
        if self.physicsClientId < 0:  # closed: by now the id may be another's
            raise pybullet.error("Not connected to physics server.")
        self.robot.apply_action(a)
        pybullet.stepSimulation(self.physicsClientId)
        return self.robot.calc_state()


class Walker(FastRobot, robots.WalkerBase):
    def bind(self) -> None:
        p, torso, parts = self._p, self.robot_body, self.parts.values()
        body = body_of(torso)
        links = [part.bodyPartIndex for part in parts if body_of(part) == body]
        self.torso_at = links.index(torso.bodyPartIndex)
        self.torso_is_base = torso.bodyPartIndex == -1  # which to Bullet is no link
        if self.torso_is_base:
            del links[self.torso_at]
        self.floor = [part.current_position() for part in parts if body_of(part) != body]
        self.links = functools.partial(p.getLinkStates, body, links, not self.torso_is_base)
        self.base = functools.partial(p.getBasePositionAndOrientation, body)
        self.base_velocity = functools.partial(p.getBaseVelocity, body)
        self.contacts = functools.partial(p.getContactPoints, body)
        self.feet_links = [foot.bodyPartIndex for foot in self.feet]
        self.joints = Joints(*self.ordered_joints)
        self.gains = [self.power * joint.power_coef for joint in self.ordered_joints]
        self.rotation = np.eye(3)

    def apply_action(self, a: np.ndarray) -> None:
        self.joints.drive(forces=[g * x for g, x in zip(self.gains, clip(a), strict=True)])

    def read_state(self) -> np.ndarray:
        links = self.links()
        positions = [link[0] for link in links]
        if self.torso_is_base:
            position, orientation = self.base()
            positions.insert(self.torso_at, position)
            speed = self.base_velocity()[0]
        else:
            position, orientation, _, _, _, _, (vx, _, vz), (_, _, yaw_rate) = links[self.torso_at]
            speed = vx, yaw_rate, vz  # not vy: the stock task's slip is part of the task
        positions += self.floor
        x, y, _ = zip(*positions, strict=True)
        x, y = np.add.reduce(x) / len(x), np.add.reduce(y) / len(y)
        z = np.float64(position[2])
        self.body_xyz, self.body_real_xyz = (x, y, z), position
        self.body_rpy = roll, pitch, yaw = pybullet.getEulerFromQuaternion(orientation)
        if self.initial_z is None:
            self.initial_z = z

        to_target = self.walk_target_y - y, self.walk_target_x - x
        self.walk_target_theta = np.arctan2(*to_target)
        to_target = np.array(to_target)
        self.walk_target_dist = math.sqrt(to_target.dot(to_target))
        angle_to_target = self.walk_target_theta - yaw
        cos, sin, rotation = np.cos(-yaw), np.sin(-yaw), self.rotation
        rotation[0, 0] = rotation[1, 1] = cos
        rotation[0, 1], rotation[1, 0] = -sin, sin
        vx, vy, vz = rotation.dot(speed).tolist()

        angles = np.sin(angle_to_target), np.cos(angle_to_target)
        pose = z - self.initial_z, *angles, 0.3 * vx, 0.3 * vy, 0.3 * vz, roll, pitch
        joints = self.joints.relative_states()
        state = np.array([*pose, *joints, *self.feet_contact.tolist()], np.float32)
        positions, self.joint_speeds = state[8 : 8 + len(joints)].reshape(-1, 2).T
        self.joints_at_limit = np.count_nonzero(np.abs(positions) > LIMIT)
        return np.minimum(np.maximum(state, LOW), HIGH)

    def feel_ground(self, ground: set[tuple[int, int]]) -> None:
        touching = {contact[3] for contact in self.contacts() if contact[2:5:2] in ground}
        self.feet_contact[:] = [link in touching for link in self.feet_links]


class FastWalkerEnv(FastEnv, tasks.WalkerBaseBulletEnv):
    def step(self, a: np.ndarray) -> Step:
        robot, a = self.robot, np.asarray(a)
        state = self.simulate(a)
        self._alive = float(robot.alive_bonus(state[0] + robot.initial_z, robot.body_rpy[1]))
        done = self._isDone()
        if math.isnan(state.dot(state)):  # clipped, it has no infinities
            print("~INF~", state)
            done = True
        potential_old, self.potential = self.potential, robot.calc_potential()
        robot.feel_ground(self.ground_ids)
        electricity_cost = self.electricity_cost * mean(np.abs(a * robot.joint_speeds))
        electricity_cost += self.stall_torque_cost * mean(np.square(a))
        joints_at_limit_cost = float(self.joints_at_limit_cost * robot.joints_at_limit)
        progress = float(self.potential - potential_old)
        self.rewards = [self._alive, progress, electricity_cost, joints_at_limit_cost, 0.0]
        reward = sum(self.rewards)
        self.reward += reward
        return state, reward, done, False, {}


class Humanoid(Walker, robots.Humanoid):
    def bind(self) -> None:
        super().bind()
        self.motor_joints = Joints(*self.motors)
        self.gains = [power * self.power for power in self.motor_power]

    def apply_action(self, a: np.ndarray) -> None:
        scalar, scaled = a.dtype.type, zip(self.gains, clip(a), strict=True)
        self.motor_joints.drive(forces=[float(g * scalar(x)) for g, x in scaled])


class HumanoidFlagrun(Humanoid, robots.HumanoidFlagrun):
    def calc_state(self) -> np.ndarray:
        self.flag_timeout -= 1
        state = super().calc_state()
        if self.walk_target_dist < 1 or self.flag_timeout <= 0:
            self.flag_reposition()
            state = super().calc_state()
            self.potential = self.calc_potential()
        return state


class FastHopperBulletEnv(FastWalkerEnv, tasks.HopperBulletEnv):
    fast_robot = type("Hopper", (Walker, robots.Hopper), {})


class FastWalker2DBulletEnv(FastWalkerEnv, tasks.Walker2DBulletEnv):
    fast_robot = type("Walker2D", (Walker, robots.Walker2D), {})


class FastHalfCheetahBulletEnv(FastWalkerEnv, tasks.HalfCheetahBulletEnv):
    fast_robot = type("HalfCheetah", (Walker, robots.HalfCheetah), {})


class FastHalfCheetahPyBulletEnv(FastHalfCheetahBulletEnv):
    """HalfCheetah as pybullet-gym has it: the step that earns -1 for being down ends the episode.

    Down is a pitch of 1 or more, or ground under a shin or a thigh after the step before: a step's
    reward is summed up before its contacts are read, there as here. The stock task takes the same
    -1 and plays on to its 1000 steps.
    """

    def _isDone(self) -> bool:  # noqa: N802 - the stock task's name
        return self._alive < 0


class FastAntBulletEnv(FastWalkerEnv, tasks.AntBulletEnv):
    fast_robot = type("Ant", (Walker, robots.Ant), {})


class FastHumanoidBulletEnv(FastWalkerEnv, tasks.HumanoidBulletEnv):
    fast_robot = Humanoid


class FastHumanoidFlagrunBulletEnv(FastWalkerEnv, tasks.HumanoidFlagrunBulletEnv):
    fast_robot = HumanoidFlagrun


class FastReacher(FastRobot, Reacher):
    def bind(self) -> None:
        self.arm = Joints(self.central_joint, self.elbow_joint)
        self.targets = Joints(self.jdict["target_x"], self.jdict["target_y"])
        self.ends = [(part.bodyPartIndex, body_of(part)) for part in (self.fingertip, self.target)]
        self.link = self._p.getLinkState

    def apply_action(self, a: np.ndarray) -> None:
        self.arm.drive(forces=[0.05 * x for x in clip(a)])

    def read_state(self) -> np.ndarray:
        theta, self.theta_dot, self.gamma, self.gamma_dot = self.arm.relative_states()
        (target_x, *_), (target_y, *_) = self.targets.states()
        tip, target = (self.link(body, link)[0] for link, body in self.ends)
        x, y, z = (a - b for a, b in zip(tip, target, strict=True))
        self.to_target_vec = np.array([x, y, z])
        joints = np.cos(theta), np.sin(theta), self.theta_dot, self.gamma, self.gamma_dot
        return np.array([target_x, target_y, x, y, *joints], np.float32)

    def calc_potential(self) -> float:
        return -100 * math.sqrt(self.to_target_vec.dot(self.to_target_vec))


class FastReacherBulletEnv(FastEnv, ReacherBulletEnv):
    fast_robot = FastReacher

    def step(self, a: np.ndarray) -> Step:
        robot, a = self.robot, np.asarray(a)
        state = self.simulate(a)
        potential_old, self.potential = self.potential, robot.calc_potential()
        work = abs(a[0] * robot.theta_dot) + abs(a[1] * robot.gamma_dot)
        electricity_cost = float(-0.10 * work - 0.01 * (abs(a[0]) + abs(a[1])))
        stuck_joint_cost = -0.1 if abs(abs(robot.gamma) - 1) < 0.01 else 0.0
        self.rewards = [self.potential - potential_old, electricity_cost, stuck_joint_cost]
        return state, sum(self.rewards), False, False, {}


class FastDoublePendulum(FastRobot, InvertedDoublePendulum):
    def bind(self) -> None:
        pole2, link = body_of(self.pole2), self.pole2.bodyPartIndex
        self.pole2_state = functools.partial(self._p.getLinkState, pole2, link)
        self.joints, self.motor = Joints(self.slider, self.j1, self.j2), Joints(self.slider)

    def apply_action(self, a: np.ndarray) -> None:
        self.motor.drive(forces=[200 * clip(a)[0]])

    def read_state(self) -> np.ndarray:
        (x, vx, *_), (theta, theta_dot, *_), (gamma, gamma_dot, *_) = self.joints.states()
        self.pos_x, _, self.pos_y = np.array(self.pole2_state()[0])
        assert math.isfinite(x)
        hinge = np.cos(theta), np.sin(theta), theta_dot
        hinge2 = np.cos(gamma), np.sin(gamma), gamma_dot
        return np.array([x, vx, self.pos_x, *hinge, *hinge2], np.float32)


class FastInvertedDoublePendulumBulletEnv(FastEnv, InvertedDoublePendulumBulletEnv):
    fast_robot = FastDoublePendulum

    def step(self, a: np.ndarray) -> Step:
        robot, state = self.robot, self.simulate(np.asarray(a))
        distance_penalty = 0.01 * robot.pos_x**2 + (robot.pos_y + 0.3 - 2) ** 2
        self.rewards = [10.0, float(-distance_penalty), 0.0]
        return state, sum(self.rewards), bool(robot.pos_y + 0.3 <= 1), False, {}


def register(name: str, spec: gym.envs.registration.EnvSpec) -> None:
    """Register a task of this module with a stock task's time limit and reward threshold."""
    gym.register(
        f"Fast{name}-v0",
        f"{__name__}:Fast{name}",
        reward_threshold=spec.reward_threshold,
        max_episode_steps=spec.max_episode_steps,
    )


for stock in [gym.spec(f"{name}BulletEnv-v0") for name in NAMES]:
    register(stock.name, stock)
register("HalfCheetahPyBulletEnv", gym.spec("HalfCheetahBulletEnv-v0"))
