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
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.choice import may_be, repeated
from ffsm_drake.scenario.capture import Closing, Compliance, Envelope

_ROUNDS = 50  # iterations of the search for the slip of a step
_LEAST = 1e-6  # N m, N; of a limit
_SAME = 1e-10  # share of the largest force, change of forces that are found


@dataclasses.dataclass(frozen=True, kw_only=True)
class Jaws:
    """A gripper that closes. Its arrays may hold symbols, and so may those of its methods."""

    stiffness: np.ndarray  # (6) N m/rad, N/m
    damping: np.ndarray  # (6) N m s/rad, N s/m
    palm: np.ndarray  # (6) unit vector along which the palm pushes; the first three are zero
    time: np.ndarray  # () s; in which the jaws close
    load: np.ndarray  # () N; force that friction bears between closed jaws
    radius: np.ndarray  # () m; its lever arm

    @classmethod
    def of(cls, closing: Closing, compliance: Compliance) -> "Jaws":
        """Build from settings."""
        axis = np.array(closing.axis, dtype=float)
        return cls(
            stiffness=np.repeat([compliance.rotational_stiffness, compliance.stiffness], 3),
            damping=np.repeat([compliance.rotational_damping, compliance.damping], 3),
            palm=np.concatenate([np.zeros(3), axis / np.linalg.norm(axis)]),
            time=np.array(closing.time),
            load=np.array(2.0 * closing.friction * closing.preload),
            radius=np.array(closing.radius),
        )

    def closed(self, time: Any) -> tuple[Any, Any]:
        """The share (0 to 1) to which the jaws are closed at a time (s) since the first contact,
        and its rate.
        """
        x = np.minimum(np.maximum(time / self.time, 0.0), 1.0)
        return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / self.time

    def limits(self, time: Any) -> np.ndarray:
        """The largest torque (N m) and force (N) that friction bears (2)."""
        force = self.load * self.closed(time)[0]
        return np.maximum(np.stack([force * self.radius, force]), _LEAST)

    def act(
        self,
        time: Any,
        step: Any,
        *,
        start: np.ndarray,
        offset: np.ndarray,
        rate: np.ndarray,
        slid: np.ndarray,
        mobility: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force on the target over a step, and s at its end.

        Args:
          time: of the step's end since the first contact, s.
          step: s.
          start: x (6) at the first contact.
          offset, rate: x and x' (6) at the step's start, gripper axes.
          slid: s (6) at its start.
          mobility: (6, 6) from an impulse between gripper and target to a change of rate.

        Returns: (6) torque and force, gripper axes, N m and N; s (6).
        """
        closed, closing = self.closed(time)
        K, D, palm = self.stiffness, self.damping, self.palm
        implicit = (step * D + step * step * K)[:, None] * mobility
        free = -K * (offset + step * rate - (1.0 - closed) * start - slid)
        free = free - D * (rate + closing * start)
        # The palm first retracts with the initial penetration.
        depth = np.minimum((start * palm).sum(), 0.0)
        sinks = ((offset + step * rate) * palm).sum()
        face = (1.0 - closed) * depth
        pushed = -K[3] * (sinks - face) - D[3] * ((rate * palm).sum() + closing * depth)
        stiff = step * D[3] + step * step * K[3]
        limits = np.repeat(self.limits(time), 3)
        yields = (K + D / step) / (limits * limits)  # slip by force, along the normal
        # equations of the jaws' force and the palm's
        jaws = np.concatenate(
            [implicit + np.eye(6), (implicit * palm).sum(axis=-1)[:, None]], axis=1
        )
        row = stiff * (mobility * palm[:, None]).sum(axis=0)
        row = np.concatenate([row, np.stack([1.0 + (row * palm).sum()])])
        fixed = {"yields": yields, "limits": limits}

        def slip(palm_holds: Any) -> Mapping[str, Any]:
            last = np.where(palm_holds, row, _ALONE)
            wanted = np.concatenate([free, np.stack([np.where(palm_holds, pushed, 0.0)])])
            return _slip({"matrix": np.concatenate([jaws, last[None]]), "wanted": wanted, **fixed})

        holds = np.logical_not((pushed <= 0.0) | (sinks >= face))
        found = slip(holds)
        pulls = holds & (found["forces"][6] < 0.0)
        if may_be(pulls):
            without = slip(holds & np.logical_not(pulls))
            found = {name: np.where(pulls, without[name], found[name]) for name in found}
        force, size = found["forces"][:6], found["slip"]
        slid = slid - size * yields * force / (K + D / step)
        return force + found["forces"][6] * palm, slid


@dataclasses.dataclass(frozen=True, kw_only=True)
class Met:
    """A target at an instant, and how it lies in a gripper."""

    motion: np.ndarray  # (13) [quaternion, p_WP; w_WP, v_WP] of the target's frame, world axes
    offset: np.ndarray  # (6) of the target's grasp frame from the gripper, gripper axes
    rate: np.ndarray  # (6) of the offset
    p_WE: np.ndarray  # (3) place of the gripper, m
    R_WE: np.ndarray  # (3, 3) its attitude
    left: Any  # s; when it was beyond the envelope, infinite if it is not

    @property
    def motion_in(self) -> list[float]:
        """Speeds of the target in the gripper: rad/s, m/s."""
        sizes: list[float] = np.linalg.norm(self.rate.reshape(2, 3), axis=1).tolist()
        return sizes

    def beyond(self, envelope: Envelope) -> str:
        """The part of the miss beyond an envelope; empty: the gripper holds."""
        angle, distance = np.linalg.norm(self.offset.reshape(2, 3), axis=1).tolist()
        rate, speed = self.motion_in
        return envelope.beyond(
            position=distance, angle=angle, velocity=speed, angular_velocity=rate
        )


def together(
    jaws: Jaws, time: Any, step: Any, hands: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Forces (n, 6) on one target and slips (n, 6) of n grippers that act at once; see ``act``.

    Each force follows from the others in turn, until none changes. Every turn lowers one convex
    function of all forces, so the turns converge.

    Args:
      jaws: of each gripper.
      time, step: s.
      hands: ``start``, ``offset``, ``rate``, ``slid`` (n, 6); a first guess of ``force`` (n, 6);
        ``stays`` (n), zero for a gripper without force; ``mobility`` (6 n, 6 n) of all.
    """
    fixed = {**vars(jaws), "at": np.stack([time, step]), **hands}
    state = {
        "goes": hands["stays"][0] * 0.0 + 1.0,
        "force": fixed.pop("force"),
        "slid": hands["slid"],
    }
    if len(state["slid"]) == 1:
        found = _turn(state, fixed)
    else:
        found = repeated(_turn, state, fixed, most=_ROUNDS)
    return found["force"], found["slid"]


def _turn(state: Mapping[str, Any], fixed: Mapping[str, Any]) -> Mapping[str, Any]:
    """The forces and slips after each gripper has acted on the motion under those of the others."""
    jaws = Jaws(**{each.name: fixed[each.name] for each in dataclasses.fields(Jaws)})
    (time, step), mobility = fixed["at"], fixed["mobility"]
    forces, slips = [*state["force"]], [*fixed["slid"]]
    for k in range(len(forces)):
        own, rate = slice(6 * k, 6 * k + 6), fixed["rate"][k]
        for j, other in enumerate(forces):
            if j != k:
                rate = rate + step * (mobility[own, 6 * j : 6 * j + 6] @ other)
        given = {name: fixed[name][k] for name in ("start", "offset", "slid")}
        force, slid = jaws.act(time, step, rate=rate, mobility=mobility[own, own], **given)
        stays = fixed["stays"][k] != 0.0
        forces[k] = np.where(stays, force, 0.0)
        slips[k] = np.where(stays, slid, slips[k])
    made, before = np.stack(forces), state["force"]
    change = abs(made - before).max()
    return {
        "goes": np.where(change > _SAME * np.maximum(abs(made).max(), _LEAST), 1.0, 0.0),
        "force": made,
        "slid": np.stack(slips),
    }


_ALONE = np.array([0.0] * 6 + [1.0])  # equation of a palm without force


def _slip(fixed: Mapping[str, Any]) -> Mapping[str, Any]:
    """The size of the ``slip`` on the limit surface, and the resulting ``forces`` (7): of the jaws
    and the palm. The search uses that the inverse of the share is nearly linear in the size.
    """
    forces, share = _solved(0.0, fixed)
    goes = np.where(share > 1.0, 1.0, 0.0)
    excess = 1.0 / np.maximum(share, 1.0) - 1.0
    state = {"goes": goes, "slip": goes, "before": 0.0 * goes, "excess": excess, "forces": forces}
    return repeated(_nearer, state, fixed, most=_ROUNDS)


def _nearer(state: Mapping[str, Any], fixed: Mapping[str, Any]) -> Mapping[str, Any]:
    """A step of the search."""
    now, excess = state["slip"], state["excess"]
    forces, share = _solved(now, fixed)
    left = 1.0 / share - 1.0
    is_found = (abs(left) < 1e-9) | (left == excess)
    way, slope = now - state["before"], np.where(is_found, 1.0, left - excess)
    after = np.maximum(now - left * way / slope, 0.0)
    return {
        "goes": np.where(is_found, 0.0, 1.0),
        "slip": np.where(is_found, now, after),
        "before": now,
        "excess": left,
        "forces": forces,
    }


def _solved(slip: Any, fixed: Mapping[str, Any]) -> tuple[Any, Any]:
    """The jaws' force and the palm's (7), and the share of the limit, for a slip's size."""
    matrix = fixed["matrix"].copy()
    matrix[range(6), range(6)] += slip * fixed["yields"]
    forces = np.linalg.solve(matrix, fixed["wanted"])
    return forces, np.sqrt(((forces[:6] / fixed["limits"]) ** 2).sum())
