"""The grasp of a run, as its log has it."""

import dataclasses
from typing import Any

import numpy as np

from ffsm_drake.runs.log import GraspLog
from ffsm_drake.spacecraft.coordinates import Coordinates


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MadeGrasp(GraspLog):
    """A grasp in numbers, with its ``contact``, and the target before it."""

    # (6) the target's pose error from P at the grasp: rotation vector, position
    offset: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))
    # (6) of the target from the hand, at its origin: angular velocity, velocity
    mismatch: np.ndarray
    # (3) momentum stored in the actuators, N m s; the grasp does not change it
    stored: np.ndarray | None = None

    def ledger(self, time: np.ndarray, coordinates: Coordinates) -> dict[str, Any] | None:
        """The grasp in plain numbers; ``time`` (n; s) are the samples."""
        assert self.contact is not None
        contact, grasp, compliant = self.contact, self.contact.grasp, self.contact.compliant
        known = contact.split.known_velocities
        named = zip(coordinates.names, known(grasp.brake_impulse).tolist(), strict=True)
        return {
            "time": float(time[self.sample]),
            "impulse": contact.impulse[3:].tolist(),  # on the target, N s
            "angular_impulse": contact.impulse[:3].tolist(),  # about the hand, N m s
            # by joint, N m s or N s
            "brake_impulse": {name: impulse for name, impulse in named if impulse != 0.0},
            "before": self._side(
                coordinates,
                momentum=contact.momentum_before,
                spin=contact.spin_before,
                energy=grasp.energy_before,
                velocity=known(contact.velocity),
            ),
            "after": self._side(
                coordinates,
                momentum=contact.momentum_after,
                spin=contact.spin_after,
                energy=grasp.energy_after,
                velocity=known(grasp.velocity),
            ),
            # angular momentum stored by actuators in the base, N m s
            **({} if self.stored is None else {"stored_momentum": self.stored.tolist()}),
            "compliant": {} if compliant is None else {
                "peak_force": compliant.peak_force,  # N
                "peak_torque": compliant.peak_torque,  # N m
                "peak_stretch": compliant.peak_stretch,  # m
                "time": compliant.time,  # s
            },
            "miss": {
                "position": float(np.linalg.norm(self.offset[3:])),  # m
                "angle": float(np.linalg.norm(self.offset[:3])),  # rad
                "velocity": float(np.linalg.norm(self.mismatch[3:])),  # m/s
                "angular_velocity": float(np.linalg.norm(self.mismatch[:3])),  # rad/s
            },
        }  # fmt: skip

    def _side(
        self,
        coordinates: Coordinates,
        *,
        momentum: np.ndarray,
        spin: np.ndarray,
        energy: float,
        velocity: np.ndarray,
    ) -> dict[str, Any]:
        """Servicer and target together, and the servicer's velocity, on one side of the grasp."""
        return {
            "linear_momentum": momentum[3:].tolist(),  # N s
            # momentum of the bodies, without that stored in actuators, N m s
            "angular_momentum": momentum[:3].tolist(),  # about the origin
            "spin": spin.tolist(),  # about the centre of mass
            "kinetic_energy": energy,  # J
            "velocity": dict(zip(coordinates.names, velocity.tolist(), strict=True)),
        }
