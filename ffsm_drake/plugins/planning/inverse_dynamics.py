"""Inverse dynamics of many states at once, with derivatives, for optimization.

A base attitude is a rotation vector phi from a fixed attitude R_0, in the world frame: R_WB =
exp(phi) R_0. So a motion is a curve in R^nv without a constraint, z = [phi, p_WB, joints], in the
order of v. It is unique while |phi| < pi.

Drake's own inverse dynamics takes one state at a time, about 1 ms each with automatic
differentiation; here NumPy evaluates all states of a motion in one recursion (Newton-Euler, from
the base outward and back), with complex-step derivatives. The tests compare it with Drake's. No
gravity.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import Joint

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.so3 import attitude_motion, cross
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, joints_of
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_body

_STEP = 1e-30  # complex step: its truncation error is below rounding
_COLUMNS = 600  # states in one pass: as many as fit the processor's cache


def complex_step(
    calc: Callable[..., np.ndarray],
    motion: tuple[np.ndarray, np.ndarray, np.ndarray],
    wanted: list[tuple[int, int]],
) -> tuple[np.ndarray, np.ndarray]:
    """calc(z, rate, acceleration) (m, n) of a motion (size, n each), and derivatives (3, m, size,
    n; row, column).

    Args: a function of complex arrays, column by column; the variables to differentiate by, (order,
    index), other derivatives being zero.
    """
    size, count = motion[0].shape
    share = max(1, _COLUMNS // count)
    value, derivative = np.empty(0), np.empty(0)
    for start in range(0, len(wanted), share):
        some = wanted[start : start + share]
        given = [np.repeat(part[:, None].astype(complex), len(some), axis=1) for part in motion]
        for column, (which, i) in enumerate(some):
            given[which][i, column] += 1j * _STEP
        found = calc(*(part.reshape(size, -1) for part in given)).reshape(-1, len(some), count)
        if not derivative.size:
            derivative = np.zeros((3, len(found), size, count))
        for column, (which, i) in enumerate(some):
            derivative[which, :, i] = found[:, column].imag / _STEP
        value = found[:, 0].real
    return value, derivative


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Link:
    """A rigid group of bodies, in the frame of its joint."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray  # (3, 3), about the centre of mass
    parent: int = -1
    rotation: np.ndarray  # (3, 3), joint frame in the parent's
    place: np.ndarray  # (3,), joint frame in the parent's, m
    axis: np.ndarray
    slides: bool = False
    damping: float = 0.0  # N m s/rad or N s/m
    rotor: float = 0.0  # kg m^2 or kg; rotor inertia of the joint's drive, as seen at the joint


class InverseDynamics:
    """Generalized force tau = H dv/dt + C + d v of a motion, d being the joints' damping."""

    turns = False  # True if the base's rotation is a coordinate of the motion

    def __init__(self, model: PlantModel, first: RotationMatrix) -> None:
        """Args:
        model: the plant with its payload.
        first: the attitude R_0, the origin of rotation vectors.
        """
        plant, context = model.plant, model.context
        q = np.zeros(plant.num_positions())
        q[0] = 1.0
        plant.SetPositions(context, q)
        self._first = first.matrix()
        joints, base = joints_of(plant), base_body(plant)
        link_of = {body.index(): 0 for body in plant.GetBodiesWeldedTo(base)}
        for number, joint in enumerate(joints, start=1):
            link_of |= {
                body.index(): number for body in plant.GetBodiesWeldedTo(joint.child_body())
            }
        frames = [base.body_frame(), *(joint.frame_on_child() for joint in joints)]
        rotors = {
            actuator.joint().index(): actuator.calc_reflected_inertia(context)
            for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
        }
        self._links = []
        for number, frame in enumerate(frames):
            bodies = [index for index, link in link_of.items() if link == number]
            spatial = plant.CalcSpatialInertia(context, frame, bodies)
            central = spatial.Shift(spatial.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
            link = _Link(
                mass=spatial.get_mass(), com=spatial.get_com(), inertia=central,
                rotation=np.eye(3), place=np.zeros(3), axis=np.zeros(3),
            )  # fmt: skip
            if number:
                joint = joints[number - 1]
                own = self._joint(joint, link_of, frames, context)
                link = dataclasses.replace(link, **own, rotor=rotors.get(joint.index(), 0.0))
            self._links.append(link)

    @property
    def mass(self) -> float:
        """Mass of the whole spacecraft, kg."""
        return sum(link.mass for link in self._links)

    @staticmethod
    def _joint(
        joint: Joint, link_of: dict[Any, int], frames: list[Any], context: object
    ) -> dict[str, Any]:
        parent = link_of[joint.parent_body().index()]
        place = joint.frame_on_parent().CalcPose(context, frames[parent])
        slides = joint.type_name() == "prismatic"
        if joint.type_name() not in ("prismatic", "revolute"):
            raise ModelError(
                f"joint '{joint.name()}': a {joint.type_name()} joint cannot be planned for"
            )
        return {
            "parent": parent,
            "rotation": place.rotation().matrix(),
            "place": place.translation(),
            "axis": joint.translation_axis() if slides else joint.revolute_axis(),
            "slides": slides,
            "damping": joint.default_damping(),
        }

    def force(self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """tau (nv, n), world axes, for z and its time derivatives (nv, n)."""
        turned, w, alpha = attitude_motion(z[:3], rate[:3], acceleration[:3])
        rotations = [np.einsum("ijn,jk->ikn", turned, self._first)]
        rates, accelerations, linear = [w], [alpha], [acceleration[3:6]]
        # from the parent's origin to the joint
        arms, axes = [np.zeros_like(w)], [np.zeros_like(w)]
        for number, link in enumerate(self._links[1:], start=NUM_BASE_VELOCITIES):
            parent, joint_rate = link.parent, rate[number]
            frame = np.einsum("ijn,jk->ikn", rotations[parent], link.rotation)
            arm, axis = (
                np.einsum("ijn,j->in", rotations[parent], v)
                for v in (link.place, link.rotation @ link.axis)
            )
            w, alpha = rates[parent], accelerations[parent]
            if link.slides:
                arm = arm + axis * z[number]
                own = axis * acceleration[number] + 2 * cross(w, axis * joint_rate)
            else:
                own = 0.0
                x, y, v = link.axis
                skew = np.array([[0, -v, y], [v, 0, -x], [-y, x, 0]])
                sine, versine = np.sin(z[number]), 1 - np.cos(z[number])
                turn = (
                    np.eye(3)[:, :, None]
                    + sine * skew[:, :, None]
                    + versine * (skew @ skew)[:, :, None]
                )
                frame = np.einsum("ijn,jkn->ikn", frame, turn)
                alpha = alpha + axis * acceleration[number] + cross(w, axis * joint_rate)
            linear.append(
                linear[parent] + cross(accelerations[parent], arm) + cross(w, cross(w, arm)) + own
            )
            rates.append(w if link.slides else w + axis * joint_rate)
            accelerations.append(alpha)
            rotations.append(frame)
            arms.append(arm)
            axes.append(axis)
        forces, moments = [], []
        for link, rotation, w, alpha, a in zip(
            self._links, rotations, rates, accelerations, linear, strict=True
        ):
            com = np.einsum("ijn,j->in", rotation, link.com)
            w_own, alpha_own = (np.einsum("jin,jn->in", rotation, vector) for vector in (w, alpha))
            force = link.mass * (a + cross(alpha, com) + cross(w, cross(w, com)))
            moment = link.inertia @ alpha_own + cross(w_own, link.inertia @ w_own)
            forces.append(force)
            moments.append(np.einsum("ijn,jn->in", rotation, moment) + cross(com, force))
        tau = np.empty(z.shape, dtype=z.dtype)
        for number in range(len(self._links) - 1, 0, -1):
            link, row = self._links[number], number + NUM_BASE_VELOCITIES - 1
            along = forces[number] if link.slides else moments[number]
            own = link.damping * rate[row] + link.rotor * acceleration[row]
            tau[row] = (axes[number] * along).sum(axis=0) + own
            forces[link.parent] = forces[link.parent] + forces[number]
            moments[link.parent] = (
                moments[link.parent] + moments[number] + cross(arms[number], forces[number])
            )
        tau[:3], tau[3:6] = moments[0], forces[0]
        return tau

    def linearized(
        self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """tau (nv, n), and its derivatives by z, rate and acceleration (3, nv, nv, n; row,
        column).
        """
        size = len(z)
        # the force does not depend on position and its rate
        inner = [i for i in range(size) if not 3 <= i < NUM_BASE_VELOCITIES]
        wanted = [(0, i) for i in inner] + [(1, i) for i in inner] + [(2, i) for i in range(size)]
        return complex_step(self.force, (z, rate, acceleration), wanted)
