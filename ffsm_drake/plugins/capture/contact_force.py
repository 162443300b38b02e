"""The contact of a closing gripper with a free target: elastic, limited by friction, with a palm.

The offset x (6; rotation vector, position; gripper axes) of the target's grasp frame from the
gripper's is drawn to c(t), which goes from the offset at the first contact to zero while the jaws
close. Springs and dampers act from a sliding reference,

    f = -K (x - c - s) - D (x' - c' - s'),    |force|^2 + |torque / r|^2 <= (2 mu N(t))^2,

with two jaws of preload N, the coefficient of friction mu and the lever r. Within the limit s
stays; at the limit it slides along its normal, with f on the limit surface: an elastic, perfectly
plastic element with the ellipsoidal limit surface of an area in friction. The palm pushes along its
axis only, as long as the target is in it, with the same spring and damper.

A step takes the force implicitly, with the mobility L = M_T^-1 + J M_s^-1 J^T of the grasp frames:
the springs are stiff for the bare wrist (0.004 kg m^2 at 1e4 N m/rad: 1600 rad/s, damping within
10 us), and stay stable in steps of a millisecond.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from ffsm_drake.scenario.capture import Closing, Compliance

_ROUNDS = 50  # iterations of the search for the slip of a step
_LEAST = 1e-6  # N m, N; of a limit


@dataclasses.dataclass(frozen=True, kw_only=True)
class Jaws:
    """A gripper from its first contact on."""

    closing: Closing
    compliance: Compliance
    start: np.ndarray  # (6) offset at the first contact

    def __post_init__(self) -> None:
        gripper, axis = self.compliance, np.array(self.closing.axis, dtype=float)
        fill = object.__setattr__
        fill(self, "_K", np.repeat([gripper.rotational_stiffness, gripper.stiffness], 3))
        fill(self, "_D", np.repeat([gripper.rotational_damping, gripper.damping], 3))
        fill(self, "_palm", np.concatenate([np.zeros(3), axis / np.linalg.norm(axis)]))

    _K: np.ndarray = dataclasses.field(init=False, repr=False)
    _D: np.ndarray = dataclasses.field(init=False, repr=False)
    _palm: np.ndarray = dataclasses.field(init=False, repr=False)

    def closed(self, time: float) -> tuple[float, float]:
        """The share (0 to 1) to which the jaws are closed at a time (s) since the first contact,
        and its rate.
        """
        x = min(max(time / self.closing.time, 0.0), 1.0)
        return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / self.closing.time

    def limits(self, time: float) -> np.ndarray:
        """The largest torque (N m) and force (N) that friction bears (2)."""
        force = 2.0 * self.closing.friction * self.closing.preload * self.closed(time)[0]
        return np.maximum([force * self.closing.radius, force], _LEAST)

    def act(
        self,
        time: float,
        step: float,
        *,
        offset: np.ndarray,
        rate: np.ndarray,
        slid: np.ndarray,
        mobility: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force on the target over a step, and s at its end.

        Args:
          time: of the step's end since the first contact, s.
          step: s.
          offset, rate: x and x' (6) at its start, gripper axes.
          slid: s (6) at its start.
          mobility: (6, 6) from an impulse between gripper and target to a change of rate.

        Returns: (6) torque and force, gripper axes, N m and N; s (6).
        """
        (closed, closing), start = self.closed(time), self.start
        K, D, palm = self._K, self._D, self._palm
        implicit = (step * D + step * step * K)[:, None] * mobility
        free = -K * (offset + step * rate - (1.0 - closed) * start - slid)
        free -= D * (rate + closing * start)
        # The palm first retracts with the initial penetration.
        depth, sinks = min(_sum(start * palm), 0.0), _sum((offset + step * rate) * palm)
        face = (1.0 - closed) * depth
        pushed = -K[3] * (sinks - face) - D[3] * (_sum(rate * palm) + closing * depth)
        stiff = step * D[3] + step * step * K[3]
        limits = np.repeat(self.limits(time), 3)
        yields = (K + D / step) / (limits * limits)  # slip by force, along the normal
        # equations of the jaws' force and the palm's
        matrix, wanted = np.zeros((7, 7)), np.append(free, pushed)
        matrix[:6, :6] = implicit + np.eye(6)
        matrix[:6, 6] = (implicit * palm).sum(axis=-1)
        matrix[6, :6] = stiff * (mobility * palm[:, None]).sum(axis=0)
        matrix[6, 6] = 1.0 + _sum(matrix[6, :6] * palm)

        def without_palm() -> None:
            matrix[6, :6], matrix[6, 6], wanted[6] = 0.0, 1.0, 0.0

        def solve(slip: float) -> tuple[np.ndarray, float]:
            """The jaws' force and the palm's (7), and the share of the limit, for a slip's size."""
            a = matrix.copy()
            a[range(6), range(6)] += slip * yields
            solved = np.linalg.solve(a, wanted)
            return solved, math.sqrt(_sum((solved[:6] / limits) ** 2))

        if pushed <= 0.0 or sinks >= face:
            without_palm()
        slip, forces = _slip(solve)
        if forces[6] < 0.0:  # the palm does not hold
            without_palm()
            slip, forces = _slip(solve)
        force = forces[:6]
        return force + forces[6] * palm, slid - slip * yields * force / (K + D / step)


def _sum(values: np.ndarray) -> float:
    return float(values.sum())


def _slip(solve: Callable[[float], tuple[np.ndarray, float]]) -> tuple[float, np.ndarray]:
    """The size of the slip on the limit surface, and the resulting forces (7). The search uses that
    the inverse of the share is nearly linear in the size.
    """
    now, before = 0.0, 0.0
    forces, share = solve(now)
    if share <= 1.0:
        return now, forces
    now, excess = 1.0, 1.0 / share - 1.0
    for _ in range(_ROUNDS):
        forces, share = solve(now)
        left = 1.0 / share - 1.0
        if abs(left) < 1e-9 or left == excess:
            break
        last, way = now, now - before
        now = max(last - left * way / (left - excess), 0.0)
        before, excess = last, left
    return now, forces
