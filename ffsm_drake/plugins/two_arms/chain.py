"""The closed chain: a plant's tree, and the loops of the contacts beside its weld.

A contact that closes a loop holds a hand's frame E at a fixed pose in the target's frame G. Its
constraint is A v = 0, where A v is the twist of E in G, without the directions in which no posture
of the two arms can move it: six rows in space, three in a plane.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, JacobianWrtVariable
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import counted
from ffsm_drake.common.so3 import matrix_of, quaternion_of
from ffsm_drake.scenario import HELD, Grip, Scenario
from ffsm_drake.scenario.contacts import Contact, closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.plant import base_body, find_frame

_ORIGIN = np.zeros(3)
_LEAST = 1e-9  # singular value below which no posture moves a direction, of the largest
_POSTURES = 4  # drawn postures at which the directions are looked for
_NEWTON, _CLOSED = 60, 1e-14  # steps to close a loop, and the gap then (m, rad)
LONGEST_STEP = 0.3  # rad or m, of a joint in one of these steps
_FARTHEST = 1e-9  # gap (m, rad) of a loop that is closed, but for rounding


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """A contact that closes a loop, in a plant."""

    name: str
    contact: Contact
    hand: Frame
    grasp: Frame
    joints: np.ndarray  # indices in v of its arm's own joints, from the base outwards
    rows: np.ndarray  # (r, 6) directions of the twist of the hand that postures can move
    # pose of the hand's frame in the target's, when closed: rotation (None: the identity), and
    # position, m
    turn: np.ndarray | None
    place: tuple[float, ...]


class ClosedChain:
    """The loops of a plant; quantities at the state in a context of it."""

    def __init__(
        self, plant: MultibodyPlant, scenario: Scenario, grip: Grip = HELD, *, true: bool
    ) -> None:
        """Args:
          plant: the plant, with flexible parts or without.
          scenario: the scenario, which names the contacts.
          grip: the hands that hold the target.
          true: whether the contacts have their calibration errors.

        Raises:
          ModelError: a frame does not exist.
          ScenarioError: an arm has two contacts, or too few joints; a frame is not on the target.
        """
        self.plant = plant
        closing = closing_contacts(scenario, grip)
        paths = {
            name: _joints_to(
                plant, find_frame(plant, contact.effector, key=f"contacts.{name}.effector")
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

    def _loop(self, name: str, contact: Contact, joints: np.ndarray, *, true: bool) -> Loop:
        key, error = f"contacts.{name}", np.array(contact.rotation_error)
        loop = Loop(
            name=name,
            contact=contact,
            hand=find_frame(self.plant, contact.effector, key=f"{key}.effector"),
            grasp=find_frame(self.plant, contact.frame, key=f"{key}.frame"),
            joints=joints,
            rows=np.eye(6),
            turn=matrix_of(quaternion_of(error)) if true and error.any() else None,
            place=tuple(contact.position_error) if true else (0.0, 0.0, 0.0),
        )
        if not np.array_equal(_joints_to(self.plant, loop.grasp), self.carrying):
            raise ScenarioError(f"{key}.frame", f"'{contact.frame}' is not fixed to the target")
        seen = np.hstack(list(self._drawn_jacobians(loop)))
        directions, sizes, _ = np.linalg.svd(seen, full_matrices=False)
        found = directions[:, sizes > _LEAST * sizes[0]].T
        return loop if len(found) == 6 else dataclasses.replace(loop, rows=found)

    def _drawn_jacobians(self, loop: Loop) -> Iterable[np.ndarray]:
        """Jacobians (r, nv) at drawn postures."""
        context, generator = self.plant.CreateDefaultContext(), np.random.default_rng(0)
        q = self.plant.GetPositions(context)
        for _ in range(_POSTURES):
            q[7:] = generator.uniform(-1.5, 1.5, q.size - 7)
            self.plant.SetPositions(context, q)
            yield self.jacobian_of(loop, context)

    def _check_joints(self, loop: Loop, name: str, joints: np.ndarray) -> None:
        """Raise ScenarioError unless an arm's joints move its hand in all directions of a loop."""
        seen = [each[:, joints] for each in self._drawn_jacobians(loop)]
        rank = max(np.linalg.matrix_rank(each, tol=1e-6) for each in seen)
        wanted = len(loop.rows)
        if rank < wanted:
            raise ScenarioError(
                f"contacts.{name}",
                f"its arm has {counted(len(joints), 'joint')} and {rank} of the {wanted} degrees "
                "of freedom of the target; use an arm with all of them (6 joints in space, 3 in a "
                "plane)",
            )

    def jacobian_of(self, loop: Loop, context: Context) -> np.ndarray:
        """A (r, nv) of a loop: the twist [w; v] of the hand's frame in the target's, in its axes;
        rad/s, m/s.
        """
        jacobian = self.plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, loop.hand, _ORIGIN, loop.grasp, loop.grasp
        )
        jacobian[:, :NUM_BASE_VELOCITIES] = 0.0  # but for rounding
        return jacobian if len(loop.rows) == 6 else loop.rows @ jacobian

    def bias_of(self, loop: Loop, context: Context) -> np.ndarray:
        """dA/dt v (r) of a loop; rad/s^2, m/s^2."""
        bias = self.plant.CalcBiasSpatialAcceleration(
            context, JacobianWrtVariable.kV, loop.hand, _ORIGIN, loop.grasp, loop.grasp
        ).get_coeffs()
        return bias if len(loop.rows) == 6 else loop.rows @ bias

    def gap_of(self, loop: Loop, context: Context) -> np.ndarray:
        """The gap (r): rotation vector and position of the hand's frame from where it would be,
        in the target's axes; rad, m.
        """
        X = self.plant.CalcRelativeTransform(context, loop.grasp, loop.hand)
        turn = X.rotation().matrix()
        if loop.turn is not None:
            turn = turn @ loop.turn.T
        x, y, z = X.translation().tolist()
        a, b, c = loop.place
        gap = np.array([*_rotation_vector(turn.tolist()), x - a, y - b, z - c])
        return gap if len(loop.rows) == 6 else loop.rows @ gap

    def meet(self, context: Context) -> None:
        """Let the loops hold the hands where they are."""
        loops = list[Loop]()
        for loop in self.loops:
            X = self.plant.CalcRelativeTransform(context, loop.grasp, loop.hand)
            turn, place = X.rotation().matrix(), tuple(X.translation().tolist())
            loops.append(dataclasses.replace(loop, turn=turn, place=place))
        self.loops = tuple(loops)

    def jacobian(self, context: Context) -> np.ndarray:
        """A (m, nv) of all loops."""
        if not self.loops:
            return np.empty((0, self.plant.num_velocities()))
        return _stacked([self.jacobian_of(loop, context) for loop in self.loops])

    def bias(self, context: Context) -> np.ndarray:
        """dA/dt v (m) of all loops."""
        return _stacked([self.bias_of(loop, context) for loop in self.loops])

    def gap(self, context: Context) -> np.ndarray:
        """The gaps (m) of all loops."""
        return _stacked([self.gap_of(loop, context) for loop in self.loops] or [np.empty(0)])

    @functools.cached_property
    def size(self) -> int:
        """m, the number of constraints."""
        return sum(len(loop.rows) for loop in self.loops)

    @functools.cached_property
    def is_spatial(self) -> bool:
        """Whether the target can move in all six directions: ``wrench_map`` is the identity."""
        return self.size == 6 * len(self.loops)

    @functools.cached_property
    def wrench_map(self) -> np.ndarray:
        """(6 loops, m): the wrench on the hand of each loop, from the multipliers of A'."""
        found = np.zeros((6 * len(self.loops), self.size))
        column = 0
        for k, loop in enumerate(self.loops):
            found[6 * k : 6 * k + 6, column : column + len(loop.rows)] = loop.rows.T
            column += len(loop.rows)
        return found

    def closed(
        self, q: np.ndarray, context: Context, loops: Sequence[Loop] | None = None
    ) -> np.ndarray:
        """The configuration q (nq) with the joints of the closing arms moved until the loops, all
        or some, are closed. Raises ScenarioError: they are out of reach.
        """
        q = q.copy()
        for loop in self.loops if loops is None else loops:
            places = _positions(self.plant, loop.joints)

            def gap(at: np.ndarray = q, loop: Loop = loop) -> np.ndarray:
                self.plant.SetPositions(context, at)
                return self.gap_of(loop, context)

            found = gap()
            for _ in range(_NEWTON):
                if np.abs(found).max() < _CLOSED:
                    break
                jacobian = self.jacobian_of(loop, context)[:, loop.joints]
                step = np.linalg.lstsq(jacobian, -found, rcond=1e-10)[0]
                q[places] += step * min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-300))
                found = gap()
            if not np.abs(found).max() < _FARTHEST:
                raise ScenarioError(
                    f"contacts.{loop.name}",
                    f"its hand does not reach '{loop.contact.frame}' from the given joints "
                    f"(gap {np.abs(found).max():.2g} m or rad); change the joints of "
                    "one of the arms in the posture",
                )
        return q


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _rotation_vector(turn: list[list[float]]) -> tuple[float, float, float]:
    """The rotation vector of a rotation matrix, in plain floats for speed; not of half a turn."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-6 and a + e + i > 0.0:
        return x, y, z
    factor = math.atan2(sine, 0.5 * (a + e + i - 1.0)) / max(sine, 1e-300)
    return factor * x, factor * y, factor * z


def _joints_to(plant: MultibodyPlant, frame: Frame) -> np.ndarray:
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


def _positions(plant: MultibodyPlant, joints: np.ndarray) -> np.ndarray:
    """Indices in q of joints (indices in v)."""
    return np.asarray(joints) + plant.num_positions() - plant.num_velocities()


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
