"""Two hands on one target: the place of the second hand, and postures in which both hold the
target.

The second hand holds a cube at the middle of another face, or next to the first hand on the same
face, with z into the cube. The rotation about z is free. A target from a file has its own frame for
the second hand.
"""

import copy
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.files import write_text
from ffsm_drake.common.numbers import counted
from ffsm_drake.common.so3 import cross, rotation_error
from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.remarks import plan_clearance
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.opening import open_capture, openings
from ffsm_drake.plugins.new.postures import CLEAR, Postures
from ffsm_drake.plugins.new.room import Room
from ffsm_drake.plugins.new.urdf.formats.building import text
from ffsm_drake.plugins.new.urdf.target import SECOND, Target
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.plant import find_frame
from ffsm_drake.systems.reference import make_motion

_CONTACTS = ("first", "second")  # their names
_CHOSEN = (
    "initial_posture",
    "contacts",
    "capture",
    "reference",
)  # sections that a motion determines
# Postures of the first arm; draws for each, until one is clear; ways to hold, the best ones first.
_DRAWN, _DRAWS, _HELD = 300, 10, 4
# Postures of the second arm: drawn, and tried from for each place of its hand, if near enough.
_KNOWN, _TRIALS, _NEAR = 2000, 2, 0.6
_STEPS, _LONGEST = 25, 0.3  # steps of the inverse kinematics; rad or m
_SLOW = 5, 0.7  # steps that leave more than this share of a distance: out of reach
_MOST_STEPS, _MOST_MOTIONS = 40_000, 3  # of the search for one size of the target; for one hold
_REACHED, _ALIGNED = 1e-11, 1e-6  # rad and m
_DEXTROUS = 0.08  # least singular value of an arm, with its reach as the unit of length
_SHARES = (1.0, 0.7, 0.45, 0.3, 0.2)  # shares of the step to an initial posture
_STEP, _WAYS, _INSTANTS = 0.4, 6, 61  # rad or m; initial postures for each share; of a motion
_SLACK = 1e-6  # rad or m, of a joint's limit
_BESIDE = 0.4  # shares of the side, from the middle of the first hand's face


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Hold:
    joints: np.ndarray  # rad or m
    place: RigidTransform  # pose of the second hand in the target's frame
    dexterity: float
    distance: float  # m, of the parts
    room: float  # m, of base and target before the grasp


class Hands(Postures):
    """The search for postures in which two hands hold a target, and for a motion between two."""

    def __init__(self, draft: Draft, target: Target) -> None:
        """Prepare the search.

        Args:
          draft: the present scenario (``Draft``).
          target: the target; a target from a file needs a frame for the second hand.

        Raises ScenarioError: an arm has too few joints of its own, or a file has only one frame.
        """
        if target.second is None and target.side is None:
            raise ScenarioError(
                "--target", f"has one frame to hold it by, and two hands need another, '{SECOND}'"
            )
        super().__init__(draft)
        self._draft, self._target = draft, target
        tips = draft.servicer.tip, draft.servicer.second
        self._tips = [tip for tip in tips if tip is not None]
        self._hands = [self._frame(f"servicer::{tip.frame}") for tip in self._tips]
        self._body = self._frame(f"debris::{target.body}")
        self._arms = [
            np.array([self.names.index(name) for name in tip.joints]) for tip in self._tips
        ]
        own = [np.setdiff1d(one, other) for one, other in itertools.permutations(self._arms, 2)]
        self._second = own[1]
        joint = self.plant.GetJointByName(self.names[self._second[0]]) if own[1].size else None
        self._shoulder = self._body if joint is None else joint.frame_on_parent()
        self._room = Room(draft, target, [self.names[k] for k in self._second])
        self.rest = np.round(self.rest, 3)
        self._random = np.random.default_rng(0)
        self._known = self._poses()
        self._drawings = self._steps = self._ways = self._motions = 0  # done so far
        self._problem = ""  # of the last motion
        # directions of the second hand's twist in the target's frame that postures can move
        parts = list[np.ndarray]()
        for _ in range(4):
            self.set(self._drawn())
            parts.append(self.jacobian(self._hands[1], self._body))
        directions, sizes, _ = np.linalg.svd(np.hstack(parts))
        self._rows = directions[:, : int((sizes > 1e-9 * sizes[0]).sum())].T
        for tip, alone in zip(self._tips, own, strict=True):
            rank = max(np.linalg.matrix_rank(part[:, alone], tol=1e-6) for part in parts)
            if rank < len(self._rows):
                raise ScenarioError(
                    "--tips",
                    f"the arm of '{tip.frame}' has {counted(alone.size, 'joint')} of its own and "
                    f"{rank} of the {len(self._rows)} degrees of freedom of the target; use an "
                    "arm with all (6 in space, 3 in a plane)",
                )

    def _frame(self, name: str) -> Frame:
        return find_frame(self.plant, name, key="--tips")

    def place(self) -> bool:
        """Choose contacts, postures and a duration.

        Returns: whether there are any. If not, ``touching`` of the draft gives the reason.
        """
        draft = self._draft
        with step(lambda: f"posture {self._drawings} of {_DRAWN} of both hands"):
            holds = self._best()
        names = "' and '".join(tip.frame for tip in self._tips)
        cube = f" (a cube of {self._target.side:g} m)" if self._target.side else ""
        if not holds:
            draft.touching = (
                f"'{names}' cannot both hold the target{cube}: none of {self._drawings} postures "
                "drawn of the first arm lets the second one reach"
            )
            return False
        file = Path(draft.source).parent / draft.data["model"]["debris"]
        before = file.read_text()
        most = _MOST_MOTIONS * len(holds)
        for hold in holds:
            if self._target.second is None:
                rpy = text(hold.place.rotation().ToRollPitchYaw().vector())
                frame = f'<frame name="{SECOND}" link="{self._target.body}" '
                frame += f'xyz="{text(hold.place.translation())}" rpy="{rpy}"/>'
                write_text(file, before.replace("</robot>", f"  {frame}\n</robot>"))
            frames = self._target.grasp, self._target.second or SECOND
            draft.data["contacts"] = {
                name: {"effector": f"servicer::{tip.frame}", "frame": f"debris::{frame}"}
                for name, tip, frame in zip(_CONTACTS, self._tips, frames, strict=True)
            }
            draft.data["target_posture"]["joints"] = self.by_name(np.round(hold.joints, 4))
            if hold.distance < 0.0:
                draft.touching = "no posture of both hands that is free of contact was found"
            with step(lambda: f"motion {self._motions} of at most {most} of both hands"):
                if self._start(hold):
                    draft.remarks += self._room.remarks(hold.joints)
                    return True
        draft.touching = (
            f"'{names}' cannot move the target{cube} together: none of {self._ways} motions tried "
            f"is within the reach and limits of both arms{self._problem}"
        )
        return False

    def _best(self) -> list[_Hold]:
        """Return some holds without contact, those in which the target tumbles clear of the base
        and the most dexterous first, or else the hold with the largest distance.
        """
        found, nearest = list[_Hold](), list[_Hold]()
        for hold in self._holds():
            if hold.distance >= CLEAR:
                found.append(hold)
            elif not nearest or hold.distance > nearest[0].distance:
                nearest = [hold]
            if sum(each.room >= CLEAR for each in found) == _HELD:
                break
        found.sort(key=lambda each: (-min(each.room, CLEAR), -each.dexterity))
        return found[:_HELD] or nearest

    def _holds(self) -> Iterator[_Hold]:
        first = self._arms[0]
        for self._drawings in range(1, _DRAWN + 1):
            if self._steps >= _MOST_STEPS:
                return
            joints = self.rest.copy()
            for _ in range(_DRAWS):
                joints[first] = np.round(self._drawn()[first], 3)
                if (dexterity := self._least(0, joints)) >= _DEXTROUS and self._room.is_free(
                    joints
                ):
                    break
            else:
                continue
            for X_PG, start in self._starts(joints):
                joints[self._second] = start
                both = self._reached(joints, X_PG, turned=self._target.second is None)
                if both is None or (least := self._least(1, both)) < _DEXTROUS:
                    continue
                place, distance = self._place(), self._room.distance(both)
                yield _Hold(
                    joints=both, place=place, dexterity=min(dexterity, least), distance=distance,
                    room=self._room.tumble(both) if distance >= CLEAR else -np.inf,
                )  # fmt: skip
                if distance >= CLEAR:
                    break

    def _starts(self, joints: np.ndarray) -> list[tuple[RigidTransform, np.ndarray]]:
        """Return places of the second hand, and joints of its arm from which to search for each."""
        self.set(joints)
        X_SP = self._body.CalcPose(self.context, self._shoulder)
        found = list[tuple[RigidTransform, np.ndarray]]()
        for X_PG in self._places():
            goal = X_SP @ X_PG
            off = (self._known[1] - goal.translation()) / self._tips[1].reach
            turned = self._known[2] - goal.rotation().matrix()[:, 2]
            away = np.linalg.norm(off, axis=1) + np.linalg.norm(turned, axis=1)
            near = [k for k in np.argsort(away)[:_TRIALS] if away[k] < _NEAR]
            found += [(X_PG, self._known[0][k]) for k in near]
        return found

    def _poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return drawn joints of the second arm, and places and z axes of its hand from there."""
        found = list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
        for _ in range(_KNOWN):
            self.set(drawn := self._drawn())
            pose = self._hands[1].CalcPose(self.context, self._shoulder)
            found.append((drawn[self._second], pose.translation(), pose.rotation().matrix()[:, 2]))
        first, second, third = map(np.array, zip(*found, strict=True))
        return first, second, third

    def _place(self) -> RigidTransform:
        """Return the pose of the second hand in the frame of the target."""
        pose: RigidTransform = self._hands[1].CalcPose(self.context, self._body)
        return pose

    def _places(self) -> list[RigidTransform]:
        """Return poses of the second hand in the frame of the target at which it may hold it."""
        if self._target.second is not None:
            frame = self._frame(f"debris::{self._target.second}")
            return [frame.CalcPose(self.context, self._body)]
        side = self._target.side or 0.0
        inward = ((0, 0, -1), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0))
        found = [(np.array(z, dtype=float), -0.5 * side * np.array(z)) for z in inward]
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            beside = np.array([_BESIDE * x, _BESIDE * y, -0.5])
            found.append((np.array([0.0, 0.0, 1.0]), side * beside))
        return [RigidTransform(RotationMatrix.MakeFromOneVector(z, 2), p) for z, p in found]

    def _reached(
        self, joints: np.ndarray, X_PG: RigidTransform, *, turned: bool
    ) -> np.ndarray | None:
        """Return the joints, with the second arm moved until its hand is in place; None: out of
        reach.

        Args:
          joints: positions of all joints, rad or m.
          X_PG: pose of the hand in the frame of the target.
          turned: whether the rotation about z is free.
        """
        joints, second, tip = joints.copy(), self._second, self._tips[1]
        R_PG, z = X_PG.rotation(), X_PG.rotation().matrix()[:, 2]
        goal, kept = R_PG.ToQuaternion().wxyz(), np.eye(6)
        if turned:
            kept[:3, :3] -= np.outer(z, z)
        self.set(joints)
        shoulder = self._shoulder.CalcPose(self.context, self._body).translation()
        if np.linalg.norm(X_PG.translation() - shoulder) > tip.reach:
            return None
        sizes = list[float]()
        for _ in range(_STEPS):
            self._steps += 1
            X_PH = self._place()
            if turned:
                now = X_PH.rotation().matrix()[:, 2]
                across = cross(now, z)
                sine = float(np.linalg.norm(across))
                turn = across * (np.arctan2(sine, now @ z) / max(sine, 1e-300))
            else:
                turn = np.array(rotation_error(goal, X_PH.rotation().ToQuaternion().wxyz()))
            off = np.concatenate([turn, X_PG.translation() - X_PH.translation()])
            wanted = self._rows @ off
            if np.abs(wanted).max() < _REACHED:
                left = np.abs(off - self._rows.T @ wanted)  # no posture moves these
                return joints if left[: 3 if turned else 6].max() < _ALIGNED else None
            sizes.append(float(np.linalg.norm(wanted)))
            if len(sizes) > _SLOW[0] and sizes[-1] > _SLOW[1] * sizes[-1 - _SLOW[0]]:
                return None
            jacobian = self._rows @ kept @ self.jacobian(self._hands[1], self._body)[:, second]
            step = np.linalg.lstsq(jacobian, wanted, rcond=1e-6)[0]
            step *= min(1.0, _LONGEST / max(np.abs(step).max(), 1e-300))
            joints[second] = np.clip(joints[second] + step, self.low[second], self.high[second])
            self.set(joints)
        return None

    def _least(self, arm: int, joints: np.ndarray) -> float:
        """Return the least singular value of the motions of an arm."""
        tip = self._tips[arm]
        found = self.dexterity(joints, self._hands[arm], self._arms[arm], tip.reach)
        return float(found[len(self._rows) - 1])

    def _start(self, hold: _Hold) -> bool:
        """Choose an initial posture from which both hands move the target to a hold, and a
        duration.

        The motion is within the joint limits and, if possible, without contact.
        """
        draft, data, best, n = self._draft, self._draft.data, None, hold.joints.size
        before = self._motions
        for k, share in enumerate(np.repeat(_SHARES, _WAYS).tolist()):
            size = _STEP * share * self._random.uniform(0.5, 1.0, n)
            if self._motions == before + _MOST_MOTIONS:
                break
            self._ways += 1
            change = np.round(size * self._random.choice([-1.0, 1.0], n), 3)
            if self._draft.asked.has_approach:
                change *= k > 0  # the motion leaves the posture with the target's velocity
            begin = hold.joints.copy()
            begin[self._arms[0]] += change[self._arms[0]]
            closed = self._reached(begin, hold.place, turned=False)
            if closed is None or not self._is_within(closed):
                continue
            if self._room.distance(closed) < min(CLEAR, hold.distance):
                continue
            data["initial_posture"]["joints"] = self.by_name(np.round(closed, 4))
            self._motions += 1
            try:
                mission = self._opened(closed) if draft.asked.has_approach else draft.mission
                motion = make_motion(mission)
            except ScenarioError as error:
                self._problem = f"; the last one: {error}"
                continue
            rows = motion.rows(np.linspace(0.0, motion.end, _INSTANTS))
            if not self._is_within(rows[:, NUM_BASE_POSITIONS : NUM_BASE_POSITIONS + n]):
                self._problem = "; in the last one, a joint leaves its limits"
                continue
            near = self._room.along(rows[:, : NUM_BASE_POSITIONS + n])
            near = min([near, *(each.distance for each in plan_clearance(mission))])
            if best is None or near > best[0]:
                rates = np.abs(rows[:, -2 * n - NUM_BASE_VELOCITIES :][:, :n]).max(axis=0)
                chosen = copy.deepcopy({key: data[key] for key in _CHOSEN})
                best = near, chosen, rates
            if near >= min(CLEAR, hold.distance):
                break
        if best is None:
            return False
        near, chosen, rates = best
        data |= chosen
        slow = max(rate / draft.rate_of(joint) for joint, rate in self.by_name(rates).items())
        if not draft.asked.has_approach:  # then the tumble determines the largest rates
            data["reference"]["duration"] *= max(1.0, slow)
        if near < 0.0 and not draft.touching:
            draft.touching = f"no motion free of contact was found: parts overlap by {-near:.3g} m"
        return True

    def _opened(self, held: np.ndarray) -> Mission:
        """Return the mission whose approach begins with open hands, from the joints (n) at which
        both hands hold the target.

        Raises ScenarioError: the hands cannot open, or no motion is planned.
        """
        draft, problem = self._draft, ScenarioError("--tips", "the hands cannot open")
        hands = [*zip(self._hands, self._arms, (tip.reach for tip in self._tips), strict=True)]
        hands[1] = (self._hands[1], self._second, self._tips[1].reach)
        for grasp, start in openings(self, held, hands):
            if min(self._room.distance(grasp), self._room.alone(start)) < 0.0:
                continue
            joints = grasp, start
            open_capture(draft, *(self.by_name(np.round(each, 4)) for each in joints))
            unsized = dict(draft.data["actuation"])
            if draft.asked.wheels is not None and draft.asked.wheels.torque is None:
                unsized["wheels"] = None  # they are sized later, for the torque of the thrusters
            try:
                plan_clearance(mission := Mission(draft.with_sections(actuation=unsized)))
            except ScenarioError as error:
                problem = error
            else:
                return mission
        raise problem

    def _is_within(self, joints: np.ndarray) -> bool:
        """Whether joints (..., n) are within their limits."""
        return bool(((joints > self.low - _SLACK) & (joints < self.high + _SLACK)).all())

    def _drawn(self) -> np.ndarray:
        return self._random.uniform(self.low, self.high)
