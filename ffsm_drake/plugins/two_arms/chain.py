"""The closed chain: a plant's tree, and the loops of the contacts beside its weld.

A contact that closes a loop holds a hand's frame E at a fixed pose in the target's frame G. Its
constraint is A v = 0, where A v is the twist of E in G, without the directions in which no posture
of the two arms can move it: six rows in space, three in a plane.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import counted
from ffsm_drake.common.so3 import quaternion_of
from ffsm_drake.scenario import HELD, Grip, Scenario
from ffsm_drake.scenario.contacts import Contact, closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_body, find_frame

_LEAST = 1e-9  # singular value below which no posture moves a direction, of the largest
_POSTURES = 4  # drawn postures at which the directions are looked for
_NEWTON, _CLOSED = 60, 1e-14  # steps to close a loop, and the gap then (m, rad)
_LONGEST_STEP = 0.3  # rad or m, of a joint in one of these steps
_FARTHEST = 1e-9  # gap (m, rad) of a loop that is closed, but for rounding


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Closure:
    """How a loop holds a hand; quantities of a plant's model, on numbers or symbols."""

    hand: Frame
    grasp: Frame
    # (r, 6) directions of the twist of the hand that postures can move; constants of compiled code
    rows: tuple[tuple[float, ...], ...]
    held: np.ndarray  # (7) pose of the hand's frame in the target's, when closed: quaternion, m

    def along(self, twist: Any) -> Any:
        """The parts (r, ...) of twists (6, ...) along the directions."""
        return twist if len(self.rows) == 6 else np.array(self.rows) @ twist

    def jacobian(self, model: PlantModel, q: Any) -> Any:
        """A (r, nv) in a configuration q (nq): the twist [w; v] of the hand's frame in the
        target's, in its axes; rad/s, m/s.
        """
        jacobian = model.calc_jacobian(q, self.hand, self.grasp)
        jacobian[:, :NUM_BASE_VELOCITIES] = 0.0  # but for rounding
        return self.along(jacobian)

    def bias(self, model: PlantModel, q: Any, v: Any) -> Any:
        """dA/dt v (r); rad/s^2, m/s^2."""
        return self.along(model.calc_bias_acceleration(q, v, self.hand, self.grasp))

    def gap(self, model: PlantModel, q: Any) -> Any:
        """The gap (r): rotation vector and position of the hand's frame from where it would be,
        in the target's axes; rad, m.
        """
        still = np.zeros(6)
        pose = np.concatenate([model.calc_frame_pose(q, self.hand, self.grasp), still])
        gap, _ = model.calc_tracking_errors(pose, np.concatenate([self.held, still]), 7)
        return self.along(gap)

    def met(self, model: PlantModel, q: np.ndarray) -> "Closure":
        """The loop that holds the hand where it is."""
        return dataclasses.replace(self, held=model.calc_frame_pose(q, self.hand, self.grasp))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Constraints:
    """A v = 0 for the loops of a plant, in configurations q (nq); on numbers or symbols."""

    model: PlantModel
    closures: tuple[Closure, ...]

    def jacobian(self, q: Any) -> Any:
        """A (m, nv)."""
        none = np.empty((0, q.size - 1))
        return _stacked(none, [each.jacobian(self.model, q) for each in self.closures])

    def bias(self, q: Any, v: Any) -> Any:
        """dA/dt v (m)."""
        return _stacked(v[:0], [each.bias(self.model, q, v) for each in self.closures])

    def gap(self, q: Any) -> Any:
        """The gaps (m)."""
        return _stacked(q[:0], [each.gap(self.model, q) for each in self.closures])

    def moved(self, body: Frame, lies: RigidTransform | None) -> Self:
        """Return the loops on a target whose frame lies at X_QP from the frame ``body`` of the
        model. None: it is there.
        """
        closures = list[Closure]()
        for each in self.closures if lies is not None else ():
            X_QG = each.grasp.CalcPose(self.model.context, body)
            X_GE = RigidTransform(Quaternion(each.held[:4]), each.held[4:])
            found = X_QG.inverse() @ lies @ X_QG @ X_GE
            held = np.array([*found.rotation().ToQuaternion().wxyz(), *found.translation()])
            closures.append(dataclasses.replace(each, held=held))
        return dataclasses.replace(self, closures=tuple(closures)) if closures else self

    def least_wrench(self, q: Any, force: Any, weight: np.ndarray) -> Any:
        """F (m) with the least sum of weight (tau + A' F)^2 over the velocities.

        F = -(A W A')^-1 A W tau, in a configuration q (nq), of the tree's force tau (nv) and its
        weights W (nv). It acts on the target; tau + A' F moves the chain as tau does.
        """
        A = self.jacobian(q)
        weighted = A * weight
        return -np.linalg.solve(weighted @ A.T, weighted @ force)

    def wrench(self, along: Any) -> Any:
        """(6 for each loop) from what is along the constraints (m)."""
        return along if self.is_spatial else self.wrench_map @ along

    @functools.cached_property
    def size(self) -> int:
        """m, the number of constraints."""
        return sum(len(each.rows) for each in self.closures)

    @functools.cached_property
    def is_spatial(self) -> bool:
        """Whether the target can move in all six directions: ``wrench_map`` is the identity."""
        return self.size == 6 * len(self.closures)

    @functools.cached_property
    def wrench_map(self) -> np.ndarray:
        """(6 loops, m): the wrench on the hand of each loop, from the multipliers of A'."""
        from scipy.linalg import block_diag  # slow to import

        return block_diag(*(np.array(each.rows).T for each in self.closures))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """A contact that closes a loop, in a plant."""

    name: str
    contact: Contact
    joints: np.ndarray  # indices in v of its arm's own joints, from the base outwards
    closure: Closure


class ClosedChain:
    """The loops of a plant; quantities in configurations q (nq) of it."""

    def __init__(
        self, model: PlantModel, scenario: Scenario, grip: Grip = HELD, *, true: bool
    ) -> None:
        """Args:
          model: the plant, with flexible parts or without.
          scenario: the scenario, which names the contacts.
          grip: the hands that hold the target.
          true: whether the contacts have their calibration errors.

        Raises:
          ModelError: a frame does not exist.
          ScenarioError: an arm has two contacts, or too few joints; a frame is not on the target.
        """
        self.model = model
        closing = closing_contacts(scenario, grip)
        paths = {
            name: joints_to(
                model.plant,
                find_frame(model.plant, contact.effector, key=f"contacts.{name}.effector"),
            )
            for name, contact in scenario.contacts.items()
        }
        _check_apart(scenario, paths)
        weld = scenario.model.end_effector
        first = next(name for name, each in scenario.contacts.items() if each.effector == weld)
        self.carrying = paths[first]  # indices in v of the joints of the arm with the weld
        self.loops = tuple(
            self._loop(name, contact, np.setdiff1d(paths[name], self.carrying), true=true)
            for name, contact in closing.items()
        )
        for loop in self.loops:
            self._check_joints(loop, first, np.setdiff1d(self.carrying, paths[loop.name]))
            self._check_joints(loop, loop.name, loop.joints)
        closures = tuple(loop.closure for loop in self.loops)
        of = self.constraints = Constraints(model=model, closures=closures)
        self.jacobian, self.bias, self.gap = of.jacobian, of.bias, of.gap

    def _loop(self, name: str, contact: Contact, joints: np.ndarray, *, true: bool) -> Loop:
        key, plant, off = f"contacts.{name}", self.model.plant, np.zeros((2, 3))
        if true:
            off[:] = contact.rotation_error, contact.position_error
        closure = Closure(
            hand=find_frame(plant, contact.effector, key=f"{key}.effector"),
            grasp=find_frame(plant, contact.frame, key=f"{key}.frame"),
            rows=_as_rows(np.eye(6)),
            held=np.concatenate([quaternion_of(off[0]), off[1]]),
        )
        if not np.array_equal(joints_to(plant, closure.grasp), self.carrying):
            raise ScenarioError(f"{key}.frame", f"'{contact.frame}' is not fixed to the target")
        seen = np.hstack(list(self._drawn_jacobians(closure)))
        directions, sizes, _ = np.linalg.svd(seen, full_matrices=False)
        found = directions[:, sizes > _LEAST * sizes[0]].T
        if len(found) < 6:
            closure = dataclasses.replace(closure, rows=_as_rows(found))
        return Loop(name=name, contact=contact, joints=joints, closure=closure)

    def _drawn_jacobians(self, closure: Closure) -> Iterable[np.ndarray]:
        """Jacobians (r, nv) at drawn postures."""
        plant, generator = self.model.plant, np.random.default_rng(0)
        q = plant.GetPositions(plant.CreateDefaultContext())
        for _ in range(_POSTURES):
            q[7:] = generator.uniform(-1.5, 1.5, q.size - 7)
            yield closure.jacobian(self.model, q)

    def _check_joints(self, loop: Loop, name: str, joints: np.ndarray) -> None:
        """Raise ScenarioError unless an arm's joints move its hand in all directions of a loop."""
        seen = [each[:, joints] for each in self._drawn_jacobians(loop.closure)]
        rank = max(np.linalg.matrix_rank(each, tol=1e-6) for each in seen)
        wanted = len(loop.closure.rows)
        if rank < wanted:
            raise ScenarioError(
                f"contacts.{name}",
                f"its arm has {counted(len(joints), 'joint')} and {rank} of the {wanted} degrees "
                "of freedom of the target; use an arm with all of them (6 joints in space, 3 in a "
                "plane)",
            )

    def followers(self, q: np.ndarray) -> list[np.ndarray]:
        """Of each loop, indices in v of as many of its joints as it has constraints: those that the
        others move the least, in a configuration q (nq) near to a closed one.
        """
        q, found = self.closed(q), list[np.ndarray]()
        for loop in self.loops:
            jacobian, chosen = loop.closure.jacobian(self.model, q)[:, loop.joints], list[int]()
            for _ in range(len(jacobian)):  # the longest column, and the rest across it
                longest = int(np.argmax(np.linalg.norm(jacobian, axis=0)))
                along = jacobian[:, longest] / np.linalg.norm(jacobian[:, longest])
                jacobian = jacobian - np.outer(along, along @ jacobian)
                chosen.append(int(loop.joints[longest]))
            found.append(np.array(chosen))
        return found

    def closed(self, q: np.ndarray, loops: Sequence[Loop] | None = None) -> np.ndarray:
        """The configuration q (nq) with the joints of the closing arms moved until the loops, all
        or some, are closed. Raises ScenarioError: they are out of reach.
        """
        q = q.copy()
        for loop in self.loops if loops is None else loops:
            places = loop.joints + 1  # the quaternion has one entry more
            found = loop.closure.gap(self.model, q)
            for _ in range(_NEWTON):
                if np.abs(found).max() < _CLOSED:
                    break
                jacobian = loop.closure.jacobian(self.model, q)[:, loop.joints]
                q[places] += newton_step(jacobian, -found)
                found = loop.closure.gap(self.model, q)
            if not np.abs(found).max() < _FARTHEST:
                raise ScenarioError(
                    f"contacts.{loop.name}",
                    f"its hand does not reach '{loop.contact.frame}' from the given joints "
                    f"(gap {np.abs(found).max():.2g} m or rad); change the joints of "
                    "one of the arms in the posture",
                )
        return q


def newton_step(jacobian: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """The change of joints (n) for what is missing (m), shortened where it is long."""
    step: np.ndarray = np.linalg.lstsq(jacobian, missing, rcond=1e-10)[0]
    return step * min(1.0, _LONGEST_STEP / max(np.abs(step).max(), 1e-300))


def _stacked(none: Any, parts: Sequence[Any]) -> Any:
    return parts[0] if len(parts) == 1 else np.concatenate([none, *parts])


def _as_rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def joints_to(plant: MultibodyPlant, frame: Frame) -> np.ndarray:
    """Indices in v of the joints between the base and a frame, from the base outwards."""
    inboard = {
        joint.child_body().index(): joint for joint in map(plant.get_joint, plant.GetJointIndices())
    }
    base, body = base_body(plant).index(), frame.body().index()
    found = list[int]()
    while body != base and body in inboard:
        joint = inboard[BodyIndex(body)]
        if joint.num_velocities() == 1:
            found.append(joint.velocity_start())
        body = joint.parent_body().index()
    return np.array(found[::-1], dtype=int)


def _check_apart(scenario: Scenario, paths: dict[str, np.ndarray]) -> None:
    """Raise ScenarioError where two contacts are of one arm; two arms may share joints of a torso,
    and each has some of its own.
    """
    for (name, joints), (other, others) in itertools.permutations(reversed(paths.items()), 2):
        if not joints.size:
            raise ScenarioError(
                f"contacts.{name}.effector",
                f"'{scenario.contacts[name].effector}' is on no arm; name an arm's hand",
            )
        if set(joints.tolist()) <= set(others.tolist()):
            raise ScenarioError(
                f"contacts.{name}.effector",
                f"'{scenario.contacts[name].effector}' is on the arm of contact '{other}' too; "
                "name the hand of another arm",
            )
