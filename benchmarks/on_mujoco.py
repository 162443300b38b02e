"""What (c) and (d) of rollout.py share: the arm as a model file, and the law in NumPy; and (c)
itself, on MuJoCo.
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from ffsm_drake.common.so3 import rotation_error_rate
from ffsm_drake.mission import make_mission
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, position_errors
from ffsm_drake.systems.controllers import gain_vectors
from ffsm_drake.systems.reference import make_motion

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


class Arm(NamedTuple):
    """A base and a serial arm, links along z, with the payload ahead of the last: what the models
    below describe.
    """

    masses: Sequence[float]  # kg
    lengths: Sequence[float]  # m
    axes: Sequence[str]
    # kg m^2, moment of inertia of a joint's drive, which its link carries, about any axis
    drive: float = 0.0

    @classmethod
    def of(cls, joints: int) -> "Arm":
        """The shipped arm for five joints; for any other number one of its mass and length, in
        equal links.

        Those get drives: without, so short and slender links hardly have inertia about the axes
        between them, the disturbance throws them about, and what is compared is how it is sampled.
        """
        if joints == 5:
            return cls(
                (3.0, 10.0, 10.0, 1.5, 1.5),
                (0.18, 0.62, 0.62, 0.09, 0.09),
                ("z", "y", "y", "y", "x"),
            )
        axes = [("z", "y", "y", "x")[i % 4] for i in range(joints)]
        return cls((26.0 / joints,) * joints, (1.6 / joints,) * joints, axes, drive=0.5)

    def parts(self) -> Iterator[tuple[float, float, float, str, float, float]]:
        """Of each link: place along the link before, mass, length, axis, moment of inertia across
        and along.
        """
        for place, mass, length, axis in zip(
            (1.0, *self.lengths), self.masses, self.lengths, self.axes, strict=False
        ):
            across, along = mass * length**2 / 12, mass * 0.05**2 / 2
            yield place, mass, length, axis, across + self.drive, along + self.drive

    def urdf(self) -> str:
        def body(name: str, mass: float, z: float, across: float, along: float) -> str:
            moments = f'ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"'
            origin, inertia = f'<origin xyz="0 0 {z}"/>', f"<inertia {moments}/>"
            return (
                f'<link name="{name}"><inertial>{origin}<mass '
                f'value="{mass}"/>{inertia}</inertial></link>'
            )

        def joint(name: str, kind: str, parent: str, child: str, z: float, axis: str) -> str:
            ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 {z}"/>'
            return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="{_AXES[axis]}"/></joint>'

        text, before = body("base", 400.0, 0.0, 266.0, 266.0), "base"
        for i, (place, mass, length, axis, across, along) in enumerate(self.parts(), start=1):
            text += body(f"link_{i}", mass, length / 2, across, along)
            text += joint(f"joint_{i}", "revolute", before, f"link_{i}", place, axis)
            before = f"link_{i}"
        text += body("payload", 100.0, 0.0, 16.7, 16.7)
        text += joint("grasp", "fixed", before, "payload", self.lengths[-1] + 0.5, "z")
        return f'<robot name="arm">{text}</robot>'

    def mjcf(self, payload: MassProperties, *, actuated: bool = False) -> str:
        """The model; with ``actuated``, an actuator for every velocity, in Drake's order and world
        axes.
        """

        def inertial(mass: float, z: float, moments: Sequence[float]) -> str:
            return (
                f'<inertial pos="0 0 {z}" mass="{mass}" '
                f'diaginertia="{" ".join(map(str, moments))}"/>'
            )

        text = inertial(payload.mass, 0.0, payload.inertia)
        text = f'<body name="payload" pos="0 0 {self.lengths[-1] + 0.5}">{text}</body>'
        for i, (place, mass, length, axis, across, along) in reversed(
            list(enumerate(self.parts(), start=1))
        ):
            joint = f'<joint name="joint_{i}" type="hinge" axis="{_AXES[axis]}"/>'
            text = joint + inertial(mass, length / 2, (across, across, along)) + text
            text = f'<body name="link_{i}" pos="0 0 {place}">{text}</body>'
        text = (
            '<body name="base"><freejoint '
            f'name="base"/>{inertial(400.0, 0.0, (266.0,) * 3)}{text}</body>'
        )
        option = '<option gravity="0 0 0" integrator="RK4" timestep="0.01"/>'
        actuators = ""
        if actuated:
            # MuJoCo has a free joint's translation first
            for i, axis in enumerate((3, 4, 5, 0, 1, 2), start=1):
                gear = " ".join("1" if k == axis else "0" for k in range(6))
                actuators += f'<general name="base_{i}" jointinparent="base" gear="{gear}"/>'
            for i in range(1, len(self.masses) + 1):
                actuators += f'<general name="joint_{i}" joint="joint_{i}"/>'
        world = f"<worldbody>{text}</worldbody>"
        return f"<mujoco>{option}{world}<actuator>{actuators}</actuator></mujoco>"


class NumpyLaw:
    """TDE-AISMC and the disturbance, in NumPy, for a simulation with MuJoCo's state.

    MuJoCo's angular velocity is in body axes and its position comes first; the law works as ours
    does, in world axes and Drake's order, so that gains mean the same. Its mass matrix is that of a
    second model, with the nominal payload.
    """

    def __init__(self, scenario: Scenario, coordinates: Coordinates) -> None:
        self.period = scenario.sample_time
        self.nominal = mujoco.MjModel.from_xml_string(
            Arm.of(len(coordinates.joints)).mjcf(scenario.payload.nominal)
        )
        self.nominal_data = mujoco.MjData(self.nominal)
        self.motion = make_motion(make_mission(scenario))
        self.gains = gain_vectors(scenario, coordinates)
        harmonics = scenario.disturbance.harmonics
        self.harmonics = [
            coordinates.vector(
                {n: getattr(h, field) for n, h in harmonics.items()}, key=field, default=0.0
            )
            for field in ("amplitude", "frequency", "phase", "bias")
        ]
        start = self.motion.rows(np.zeros(1))[0]
        self.start = np.concatenate([start[4:7], start[:4], start[7 : self.nominal.nq]])  # qpos
        self.turn = np.empty(9)
        self.to_world = self.turn.reshape(3, 3)  # the base's rotation matrix at the last sample
        self.errors = np.empty((0, self.nominal.nv))  # (n, nv) at every sample

    def known(self, num_samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Plan [q_d; v_d] (n, 2 nv + 1), its acceleration and the disturbance (n, nv), which are
        known beforehand.

        Forces are held over a step, so the disturbance is that of the step's middle.
        """
        times = self.period * np.arange(num_samples)
        plan, acceleration = np.split(self.motion.rows(times), [2 * self.nominal.nv + 1], axis=1)
        amplitude, frequency, phase, bias = self.harmonics
        disturbance = amplitude * np.sin(frequency * (times[:, None] + 0.5 * self.period) + phase)
        return plan, acceleration, disturbance + bias

    def samples(self, noise: np.ndarray) -> Generator[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Take (qpos, qvel) of every sample, give the force (nv) to hold until the next.

        ``noise`` (n, nv) is what the sensors add to the velocities. The generator is ready after
        one ``next``.
        """
        nominal, nominal_data, turn, to_world = (
            self.nominal,
            self.nominal_data,
            self.turn,
            self.to_world,
        )
        num_samples, nv = noise.shape
        plan, plan_acceleration, disturbances = self.known(num_samples)
        memory = Memory(self.gains, self.period, noise.shape)
        self.errors = memory.errors
        positions, velocities, forces = (np.empty((num_samples, nv + i)) for i in (1, 0, 0))
        force = np.zeros(nv)
        inverse, difference, rotation = np.empty(4), np.empty(4), np.empty(3)
        change, product, v, e = np.empty(nv), np.empty(nv), np.empty(nv), np.empty(nv)
        qpos, qvel = yield np.zeros(nv)
        for k in range(num_samples):
            mujoco.mju_quat2Mat(turn, qpos[3:7])
            v[:3], v[3:6], v[6:] = to_world.dot(qvel[3:6]), qvel[:3], qvel[6:]
            # The rotation vector, in the world, from the attitude to the planned one.
            mujoco.mju_negQuat(inverse, qpos[3:7])
            mujoco.mju_mulQuat(difference, plan[k, :4], inverse)
            mujoco.mju_quat2Vel(rotation, difference, 1.0)
            e[:3], e[3:6], e[6:] = rotation, plan[k, 4:7] - qpos[:3], plan[k, 7 : nv + 1] - qpos[7:]
            measured = v + noise[k]
            e_dot = plan[k, nv + 1 :] - measured
            e_dot[:3] = rotation_error_rate(
                tuple(rotation.tolist()), plan[k, nv + 1 : nv + 4], measured[:3]
            )
            positions[k], velocities[k] = qpos, v
            u = memory.step(k, e, e_dot, plan_acceleration[k], measured)
            # Hhat (u - a), with the rotation turned into body axes and back.
            nominal_data.qpos[:] = qpos
            mujoco.mj_kinematics(nominal, nominal_data)
            mujoco.mj_comPos(nominal, nominal_data)
            mujoco.mj_makeM(nominal, nominal_data)
            change[:3], change[3:6], change[6:] = u[3:6], u[:3].dot(to_world), u[6:]
            mujoco.mj_mulM(nominal, nominal_data, product, change)
            force[:3] += to_world.dot(product[3:6])
            force[3:6] += product[:3]
            force[6:] += product[6:]
            forces[k] = force
            qpos, qvel = yield force + disturbances[k]


class Memory:
    """What TDE-AISMC remembers and records, of one run (n, nv), or of several at once (n, B,
    nv).
    """

    def __init__(
        self, gains: Mapping[str, np.ndarray | float], period: float, shape: tuple[int, ...]
    ) -> None:
        """Args: the gains, the control period (s), and the shape of what is recorded."""
        self.gains, self.period = gains, period
        self.k_s, self.g = gains["k_s_initial"], gains["g_initial"]
        self.integral, self.previous = np.zeros(shape[1:]), None
        self.errors, self.sliding, self.reaching, self.switching = (
            np.empty(shape) for _ in range(4)
        )

    def step(
        self, k: int, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, measured: np.ndarray
    ) -> np.ndarray:
        """The commanded acceleration of sample k minus the last one's (..., nv), for an error, its
        rate, the plan's acceleration and the measured velocity.
        """
        k_d, k_p, alpha, beta, phi, epsilon, k_s_max = (
            self.gains[name]
            for name in ("k_d", "k_p", "alpha", "beta", "phi", "epsilon", "k_s_max")
        )
        k_s, g, period = self.k_s, self.g, self.period
        s = e_dot + k_d * e + k_p * self.integral
        u = a_d + k_d * e_dot + k_p * e + k_s * s + g * np.sign(s)
        self.errors[k], self.sliding[k], self.reaching[k], self.switching[k] = e, s, k_s, g
        magnitude = np.abs(s)
        largest = magnitude.max(axis=-1, keepdims=True)
        rate = np.where(g > 0.0, np.sign(largest - epsilon) * phi * magnitude, epsilon * phi)
        self.k_s = np.clip(
            k_s + period * alpha * magnitude * np.sign(magnitude - k_s / beta), 0.0, k_s_max
        )
        self.g = np.maximum(g + period * rate, 0.0)
        self.integral = self.integral + period * e
        if self.previous is not None:
            u = u - (measured - self.previous) / period
        self.previous = measured
        return u


class MujocoLoop:
    """(c)."""

    def __init__(self, scenario: Scenario, coordinates: Coordinates) -> None:
        self.law = NumpyLaw(scenario, coordinates)
        arm = Arm.of(len(coordinates.joints))
        self.model = mujoco.MjModel.from_xml_string(arm.mjcf(scenario.payload.truth))
        self.data = mujoco.MjData(self.model)

    def run(self, noise: np.ndarray) -> np.ndarray:
        """The error (n, nv) at every sample; for ``noise`` see the law."""
        model, data, to_world = self.model, self.data, self.law.to_world
        law = self.law.samples(noise)
        next(law)
        mujoco.mj_resetData(model, data)
        data.qpos[:] = self.law.start
        qpos, qvel, applied = data.qpos, data.qvel, data.qfrc_applied
        for k in range(len(noise)):
            if k > 0:
                mujoco.mj_step(model, data)
            total = law.send((qpos, qvel))
            # Of a free joint the translation comes first, and the torque is in body axes.
            applied[:3], applied[3:6], applied[6:] = total[3:6], total[:3].dot(to_world), total[6:]
        return self.law.errors


class MujocoBatch:
    """Several runs of (c) at once, which differ in noise: an ``MjData`` each, the law on arrays (B,
    nv).

    The engine is still called for each run. What Python does between two of its steps is done once
    for all runs.
    """

    def __init__(self, scenario: Scenario, coordinates: Coordinates, copies: int) -> None:
        """Args: the scenario, its coordinates, and the number of runs B."""
        self.loop = MujocoLoop(scenario, coordinates)
        self.data, self.nominal_data = (
            [mujoco.MjData(model) for _ in range(copies)]
            for model in (self.loop.model, self.loop.law.nominal)
        )

    def run(self, noise: np.ndarray) -> np.ndarray:
        """The errors (n, B, nv) at every sample; ``noise`` (n, B, nv) is added to velocities."""
        model, nominal, law = self.loop.model, self.loop.law.nominal, self.loop.law
        num_samples, copies, nv = noise.shape
        plan, plan_acceleration, disturbances = law.known(num_samples)
        memory = Memory(law.gains, law.period, noise.shape)
        positions, forces = np.empty((num_samples, copies, nv + 1)), np.empty_like(noise)
        velocities, force = np.empty_like(noise), np.zeros((copies, nv))
        qvel, v = np.empty((copies, nv)), np.empty((copies, nv))
        change, product, applied = (np.empty((copies, nv)) for _ in range(3))
        to_world = np.empty((copies, 3, 3))
        turn = to_world.reshape(copies, 9)
        # views, because looking one up takes as long as the copy
        every = [
            (data, data.qpos, data.qvel, other, other.qpos, other.xmat[1])
            for data, other in zip(self.data, self.nominal_data, strict=True)
        ]
        runs_applied = [data.qfrc_applied for data in self.data]
        for data in self.data:
            mujoco.mj_resetData(model, data)
            data.qpos[:] = law.start
        for k in range(num_samples):
            qpos = positions[k]
            for b, (data, own_qpos, own_qvel, other, other_qpos, matrix) in enumerate(every):
                if k > 0:
                    mujoco.mj_step(model, data)
                qpos[b], qvel[b], other_qpos[:] = own_qpos, own_qvel, own_qpos
                mujoco.mj_kinematics(nominal, other)
                mujoco.mj_comPos(nominal, other)
                mujoco.mj_makeM(nominal, other)
                turn[b] = matrix
            v[:, :3], v[:, 3:6], v[:, 6:] = (
                _turned(to_world, qvel[:, 3:6]),
                qvel[:, :3],
                qvel[:, 6:],
            )
            q = np.hstack([qpos[:, 3:7], qpos[:, :3], qpos[:, 7:]])
            e = position_errors(plan[k : k + 1, : nv + 1], q)
            measured = v + noise[k]
            e_dot = plan[k, nv + 1 :] - measured
            e_dot[:, :3] = _rotation_error_rates(
                e[:, :3], plan[k, nv + 1 : nv + 4], measured[:, :3]
            )
            velocities[k] = v
            u = memory.step(k, e, e_dot, plan_acceleration[k], measured)
            change[:, :3], change[:, 6:] = u[:, 3:6], u[:, 6:]
            change[:, 3:6] = _turned(to_world.swapaxes(1, 2), u[:, :3])
            for other, row, result in zip(self.nominal_data, change, product, strict=True):
                mujoco.mj_mulM(nominal, other, result, row)
            force[:, :3] += _turned(to_world, product[:, 3:6])
            force[:, 3:6] += product[:, :3]
            force[:, 6:] += product[:, 6:]
            forces[k] = force
            total = force + disturbances[k]
            applied[:, :3], applied[:, 6:] = total[:, 3:6], total[:, 6:]
            applied[:, 3:6] = _turned(to_world.swapaxes(1, 2), total[:, :3])
            for row, own in zip(applied, runs_applied, strict=True):
                own[:] = row
        return memory.errors


def _turned(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Products of matrices (B, 3, 3) and vectors (B, 3)."""
    products: np.ndarray = np.matmul(matrices, vectors[:, :, None])[:, :, 0]
    return products


def _rotation_error_rates(e: np.ndarray, w_d: np.ndarray, w: np.ndarray) -> np.ndarray:
    """``rotation_error_rate`` for errors (B, 3), one w_d (3) and velocities w (B, 3)."""
    square = (e * e).sum(axis=1, keepdims=True)
    half = 0.5 * np.sqrt(np.maximum(square, 1e-2))
    series = 1.0 / 12.0 + square * (1.0 / 720.0 + square / 30240.0)
    c = np.where(square < 1e-2, series, 0.25 * (1.0 - half / np.tan(half)) / (half * half))
    difference = w_d - w
    return difference + _cross(e, c * _cross(e, difference) - 0.5 * (w_d + w))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (B, 3), faster than NumPy's."""
    products: np.ndarray = a[:, _NEXT] * b[:, _LAST] - a[:, _LAST] * b[:, _NEXT]
    return products
