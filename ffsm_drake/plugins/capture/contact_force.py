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
    """A gripper from its first contact on, or several in rows."""

    closing: Closing
    compliance: Compliance
    start: np.ndarray  # (..., 6) offset at the first contact
    friction: np.ndarray | None = None  # (...) coefficient of each; None: that of ``closing``

    def __post_init__(self) -> None:
        gripper, axis = self.compliance, np.array(self.closing.axis, dtype=float)
        fill = object.__setattr__
        fill(self, "_K", np.repeat([gripper.rotational_stiffness, gripper.stiffness], 3))
        fill(self, "_D", np.repeat([gripper.rotational_damping, gripper.damping], 3))
        fill(self, "_palm", np.concatenate([np.zeros(3), axis / np.linalg.norm(axis)]))

    _K: np.ndarray = dataclasses.field(init=False, repr=False)
    _D: np.ndarray = dataclasses.field(init=False, repr=False)
    _palm: np.ndarray = dataclasses.field(init=False, repr=False)

    def closed(self, time: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The share (0 to 1) to which the jaws are closed at times (...; s) since the first
        contact, and its rate.
        """
        x = np.clip(np.asarray(time) / self.closing.time, 0.0, 1.0)
        return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / self.closing.time

    def limits(self, time: float | np.ndarray) -> np.ndarray:
        """The largest torque (N m) and force (N) that friction bears (..., 2)."""
        friction = self.closing.friction if self.friction is None else self.friction
        force = 2.0 * friction * self.closing.preload * self.closed(time)[0]
        return np.maximum(np.stack([force * self.closing.radius, force], axis=-1), _LEAST)

    def act(
        self,
        time: float | np.ndarray,
        step: float,
        *,
        offset: np.ndarray,
        rate: np.ndarray,
        slid: np.ndarray,
        mobility: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force on the target over a step, and s at its end.

        Args:
          time: of the step's end since the first contact (...), s.
          step: s.
          offset, rate: x and x' (..., 6) at its start, gripper axes.
          slid: s (..., 6) at its start.
          mobility: (..., 6, 6) from an impulse between gripper and target to a change of rate.

        Returns: (..., 6) torque and force, gripper axes, N m and N; s (..., 6).
        """
        closed, closing = (np.atleast_1d(each)[:, None] for each in self.closed(time))
        start, offset, rate, slid_by = (
            np.atleast_2d(each) for each in (self.start, offset, rate, slid)
        )
        center, center_rate = (1.0 - closed) * start, -closing * start
        K, D, palm = self._K, self._D, self._palm
        implicit = (step * D + step * step * K)[:, None] * mobility.reshape(-1, 6, 6)
        free = -K * (offset + step * rate - center - slid_by) - D * (rate - center_rate)

        def along(vectors: np.ndarray) -> np.ndarray:
            """Components (..., 1) along the palm's axis."""
            found: np.ndarray = (vectors * palm).sum(axis=-1, keepdims=True)
            return found

        # The palm first retracts with the initial penetration.
        depth, sinks = np.minimum(along(start), 0.0), along(offset + step * rate)
        face = (1.0 - closed) * depth
        pushed = -K[3] * (sinks - face) - D[3] * (along(rate) + closing * depth)
        stiff = step * D[3] + step * step * K[3]
        limits = np.repeat(np.atleast_2d(self.limits(time)), 3, axis=-1)
        yields = (K + D / step) / (limits * limits)  # slip by force, along the normal
        # for each, equations of the jaws' force and the palm's
        matrix, wanted = np.zeros((len(offset), 7, 7)), np.hstack([free, pushed])
        matrix[:, :6, :6] = implicit + np.eye(6)
        matrix[:, :6, 6] = along(implicit)[..., 0]
        on_palm = stiff * (mobility.reshape(-1, 6, 6) * palm[:, None]).sum(axis=-2)
        matrix[:, 6, :6], matrix[:, 6, 6] = on_palm, 1.0 + along(on_palm)[:, 0]

        def without_palm(rows: np.ndarray) -> None:
            matrix[rows, 6, :6], matrix[rows, 6, 6], wanted[rows, 6] = 0.0, 1.0, 0.0

        def solve(slip: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """The jaws' force and the palm's (n, 7), and the share of the limit (n), for sizes of
            slips (n) in rows.
            """
            a = matrix[rows]
            a[:, range(6), range(6)] += slip[:, None] * yields[rows]
            solved = np.linalg.solve(a, wanted[rows][..., None])[..., 0]
            return solved, np.sqrt(((solved[:, :6] / limits[rows]) ** 2).sum(axis=-1))

        without_palm(np.flatnonzero((pushed <= 0.0) | (sinks >= face)))
        slip, forces = _slip(solve, np.arange(len(offset)))
        if (pulls := np.flatnonzero(forces[:, 6] < 0.0)).size:  # the palm does not hold
            without_palm(pulls)
            slip[pulls], forces[pulls] = _slip(solve, pulls)
        force = forces[:, :6]
        slid_by = slid_by - slip[:, None] * yields * force / (K + D / step)
        return (force + forces[:, 6:] * palm).reshape(slid.shape), slid_by.reshape(slid.shape)


def _slip(
    solve: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The sizes of the slips (n) on the limit surface, and the resulting forces (n, 7), of rows.
    The search uses that the inverse of the share is nearly linear in the size.
    """
    now = np.zeros(len(rows))
    forces, shares = solve(now, rows)
    going = np.flatnonzero(shares > 1.0)
    now[going], before, excess = 1.0, now.copy(), 1.0 / shares - 1.0
    for _ in range(_ROUNDS):
        if not going.size:
            break
        forces[going], shares = solve(now[going], rows[going])
        left = 1.0 / shares - 1.0
        goes_on = (np.abs(left) >= 1e-9) & (left != excess[going])
        going, left = going[goes_on], left[goes_on]
        last, way = now[going], now[going] - before[going]
        now[going] = np.maximum(last - left * way / (left - excess[going]), 0.0)
        before[going], excess[going] = last, left
    return now, forces
