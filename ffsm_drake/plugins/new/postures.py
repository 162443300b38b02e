"""Positions of the joints of a new servicer: dexterity, and the distances of its parts."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.tree import Frame, JacobianWrtVariable

from ffsm_drake.common.steps import step
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.spacecraft.clearance import Clearance, Nearest
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.plant import base_body, find_frame

CLEAR = 0.05  # m, that parts keep to each other
STARTS, _WAY = 8, 6  # initial postures kept; instants of a way
_LEAST_REACH = 0.05  # m


class Postures:
    """Positions of all joints (n), rad or m, with the base at the origin."""

    def __init__(self, draft: Draft) -> None:
        """Read ranges and resting positions of the joints of a ``Draft``."""
        self.plant, self.context = draft.true.plant, draft.true.context
        self.names, named = draft.coordinates.joints, {j.name: j for j in draft.servicer.joints}
        joints = [named[name] for name in self.names]
        self.rest = np.array([joint.rest for joint in joints])
        self.low, self.high = np.array([joint.range for joint in joints]).T
        self._slides = np.array([joint.unit == "m" for joint in joints])

    @staticmethod
    def whole(joints: np.ndarray) -> np.ndarray:
        """Return the configuration (nq)."""
        return np.concatenate([[1.0], np.zeros(NUM_BASE_POSITIONS - 1), joints])

    def by_name(self, joints: np.ndarray) -> dict[str, float]:
        """Return the positions by the names of the joints."""
        return dict(zip(self.names, joints.tolist(), strict=True))

    def set(self, joints: np.ndarray) -> None:
        """Move the plant."""
        self.plant.SetPositions(self.context, self.whole(joints))

    def jacobian(self, frame: Frame, other: Frame) -> np.ndarray:
        """Return the twist (6) of a frame in another, in its axes, per joint rate; rad/s, m/s."""
        jacobian = self.plant.CalcJacobianSpatialVelocity(
            self.context, JacobianWrtVariable.kV, frame, np.zeros(3), other, other
        )
        found: np.ndarray = jacobian[:, NUM_BASE_VELOCITIES:]
        return found

    def dexterity(
        self, joints: np.ndarray, frame: Frame, moving: np.ndarray, reach: float
    ) -> np.ndarray:
        """Return the singular values of the motions of a frame, the largest first.

        Args:
          joints: positions of all joints (n).
          moving: indices of the joints that move the frame.
          reach: unit of length, m; a metre of stroke counts as a radian.
        """
        self.set(joints)
        jacobian = self.jacobian(frame, base_body(self.plant).body_frame())
        jacobian[3:] /= max(reach, _LEAST_REACH)
        jacobian[:, self._slides] *= max(reach, _LEAST_REACH)
        return np.linalg.svd(jacobian[:, moving], compute_uv=False)


class Arm(Postures):
    """Positions of the joints that move the tip (m). The other joints are at ``Joint.rest``."""

    def __init__(self, draft: Draft) -> None:
        super().__init__(draft)
        model, tip = draft.scenario.model, draft.servicer.tip
        self.clearance = Clearance(model, flexible=True)  # real shapes only
        self._all_shapes = Clearance(model, flexible=True, invented=True)
        self._tip = find_frame(self.plant, f"servicer::{tip.frame}", key="tip")
        self._reach = tip.reach
        self.moving = np.flatnonzero([name in tip.joints for name in self.names])

    def filled(self, values: np.ndarray) -> np.ndarray:
        """Return the positions of all joints (n)."""
        joints = self.rest.copy()
        joints[self.moving] = values
        return joints

    def best(
        self, candidates: Sequence[np.ndarray], *, to: np.ndarray | None = None, count: int = 1
    ) -> list[np.ndarray]:
        """Return the ``count`` most dexterous candidates (m) without contact, also on the way
        ``to`` another.

        If there is none, candidates without contact of real shapes are returned, or else the
        candidate with the largest distance.
        """
        ranked = [np.round(each, 3) for each in sorted(candidates, key=self._stiffness)]
        has_invented = len([*self._all_shapes.placed()]) > len([*self.clearance.placed()])
        for shapes in (self._all_shapes, self.clearance)[not has_invented :]:
            found, distances = list[np.ndarray](), list[float]()
            for each in ranked:
                with step(f"candidate {len(distances) + 1} of {len(ranked)}"):
                    distances.append(
                        self.nearest(each, each if to is None else to, shapes).distance
                    )
                if distances[-1] >= CLEAR:
                    found.append(each)
                if len(found) == count:
                    break
            if found:
                return found
        return [ranked[int(np.argmax(distances))]]

    def nearest(
        self, start: np.ndarray, end: np.ndarray, shapes: Clearance | None = None
    ) -> Nearest:
        """Return the nearest parts on the straight way between two postures (m), by default of real
        shapes.

        Distances above ``CLEAR`` are not computed.
        """
        shares = np.linspace(0.0, 1.0, 1 if np.array_equal(start, end) else _WAY)
        ways = (self.whole(self.filled(start + share * (end - start))) for share in shares)
        found = ((shapes or self.clearance).nearest(q, below=CLEAR) for q in ways)
        return min(found, key=lambda each: each.distance)

    def _stiffness(self, values: np.ndarray) -> float:
        """Return how far a posture (m) is from dexterous and outstretched: the ratio of the
        singular values of the tip, divided by its distance from the base.
        """
        singular = self.dexterity(self.filled(values), self._tip, self.moving, self._reach)
        away = np.linalg.norm(self._tip.CalcPoseInWorld(self.context).translation())
        return float(singular[0] / max(singular[-1] * away, 1e-9))
