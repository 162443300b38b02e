"""The distances between parts as one smooth number, for a constraint."""

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable

from ffsm_drake.plugins.planning.curve import Curve
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS

_INFLUENCE = 0.1  # m beyond the clearance; nearer parts are seen by the solver
_SHARP = 100.0  # of the smooth maximum over them


class Nearness:
    """How near parts are at the instants of a curve: 1 or less where they keep a distance."""

    def __init__(self, clearance: Clearance, curve: Curve, kept: float) -> None:
        """Args: the parts; the curve; the distance to keep, m."""
        self._clearance, self._curve, self.kept = clearance, curve, kept
        self._joints = slice(NUM_BASE_POSITIONS - clearance.plant.num_positions(), None)
        self._rows = curve.joints or self._joints
        self._q = np.zeros(clearance.plant.num_positions())
        self._q[0] = 1.0  # it depends on the joints alone

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The values (instants), with their gradient if x has derivatives."""
        joints = self._joints
        values, by = self._curve.evaluate(x)
        found, slope = np.empty(len(values)), np.zeros_like(values[:, self._rows])
        for k, row in enumerate(values[:, self._rows]):
            self._q[joints] = row
            distance, rate = _distances(self._clearance, self._q, self.kept + _INFLUENCE)
            found[k], weight = _nearness(distance, self.kept)
            slope[k] = weight @ rate[:, joints]
        return self._curve.lifted(x, found, np.einsum("kj,kjx->kx", slope, by[:, self._rows]))


def _distances(clearance: Clearance, q: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (n) below ``most`` (m) in a configuration, and their derivatives (n, nv)
    along the plant's velocities.
    """
    plant, context = clearance.plant, clearance.plant_context
    found, rates = list[float](), [np.empty((0, plant.num_velocities()))]
    for distance, points, bodies in clearance.within(q, most):
        first, second = (
            plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(),
                body.EvalPoseInWorld(context).inverse() @ point,
                plant.world_frame(), plant.world_frame(),
            )
            for body, point in zip(bodies, points, strict=True)
        )  # fmt: skip
        found.append(distance)
        away = (points[1] - points[0]) / (distance or np.inf)
        rates.append((away @ (second - first))[None])
    return np.array(found), np.vstack(rates)


def _nearness(distance: np.ndarray, kept: float) -> tuple[float, np.ndarray]:
    """How near parts are: 1 or less where all distances (n, m) are ``kept``, 0 from _INFLUENCE
    beyond it on; and its derivatives (n).
    """
    x = (kept + _INFLUENCE - distance) / _INFLUENCE  # 1 at the bound
    each, slope = np.where(x < 1.0, x * x, 2.0 * x - 1.0), 2.0 * np.minimum(x, 1.0)
    most = each.max(initial=0.0)
    power = np.exp(_SHARP * (each - most))
    total = np.exp(-_SHARP * most) * (1.0 - len(each)) + power.sum()
    return most + np.log(total) / _SHARP, -power / total * slope / _INFLUENCE
