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
        closed, closing = self.closed(time)
        center, center_rate = (1.0 - closed) * self.start, -closing * self.start
        K, D, palm = self._K, self._D, self._palm
        implicit = (step * D + step * step * K)[:, None] * mobility
        free = -K * (offset + step * rate - center - slid) - D * (rate - center_rate)
        # The palm first retracts with the initial penetration.
        depth, sinks = palm @ self.start, palm @ (offset + step * rate)
        face, face_rate = ((1.0 - closed) * depth, -closing * depth) if depth < 0.0 else (0.0, 0.0)
        pushed = -K[3] * (sinks - face) - D[3] * (palm @ rate - face_rate)
        on_palm = (step * D[3] + step * step * K[3]) * (palm @ mobility)
        limits = np.repeat(self.limits(time), 3)
        yields = (K + D / step) / (limits * limits)  # slip by force, along the normal
        touches = pushed > 0.0 and sinks < face

        def solve(slip: float) -> tuple[np.ndarray, float, float]:
            """The jaws' force, the palm's, and the share of the limit, for a slip's size."""
            a, b = np.eye(7), np.append(free, pushed * touches)
            a[:6, :6] = implicit + np.diag(1.0 + slip * yields)
            a[:6, 6] = implicit @ palm
            if touches:
                a[6, :6], a[6, 6] = on_palm, 1.0 + on_palm @ palm
            solved = np.linalg.solve(a, b)
            return solved[:6], float(solved[6]), float(np.linalg.norm(solved[:6] / limits))

        slip, (force, push, _) = _slip(solve)
        if push < 0.0:  # the palm does not hold
            touches = False
            slip, (force, push, _) = _slip(solve)
        return force + push * palm, slid - slip * yields * force / (K + D / step)


def _slip(
    solve: Callable[[float], tuple[np.ndarray, float, float]],
) -> tuple[float, tuple[np.ndarray, float, float]]:
    """The size of the slip on the limit surface, and the resulting state. The search uses that the
    inverse of the share is nearly linear in the size.
    """
    before, at_rest = 0.0, solve(0.0)
    if at_rest[2] <= 1.0:
        return before, at_rest
    excess, now = 1.0 / at_rest[2] - 1.0, 1.0
    for _ in range(_ROUNDS):
        found = solve(now)
        left = 1.0 / found[2] - 1.0
        if abs(left) < 1e-9 or left == excess:
            break
        before, now, excess = now, max(now - left * (now - before) / (left - excess), 0.0), left
    return now, found
