"""Torque against H: full base torque against the stack's angular momentum, without a plan.

Base torque alone needs at least |H| / tau_max to remove the angular momentum H about the centre of
mass, and exactly that if it always points against H (Aghili, "Optimal control of a space
manipulator for detumbling of a target satellite", ICRA 2009). The joints hold the arm's posture;
the base's pose is not controlled.
"""

import dataclasses
from typing import Any, Self

import numpy as np

from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.free_floating import center_of_mass
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, field_values, gain
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class TorqueAgainstMomentum(ControlLaw):
    """Full base torque against the angular momentum H; computed torque holds the joints.

    The base torque is -tau_max H / |H|, and proportional to H at the end. The base force is zero.
    """

    label = "Torque against H"
    model: PlantModel
    torque: float = gain(10.0, "N m", "size of the base torque tau_max", scalar=True, positive=True)
    decay: float = gain(
        0.2,
        "s",
        "time constant of the decay of momentum below torque * decay",
        scalar=True,
        positive=True,
    )
    k_p: float = gain(
        4.0, "1/s^2", "gain on the distance of the joints from their initial positions", scalar=True
    )
    k_d: float = gain(4.0, "1/s", "gain on the rates of the joints", scalar=True)
    # of its joints among those of the spacecraft
    places: Any = dataclasses.field(default_factory=lambda: slice(None))

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw."""
        own = setup.craft.coordinates.indices(setup.coordinates.names, key="controller")
        places = own[NUM_BASE_VELOCITIES:] - NUM_BASE_VELOCITIES
        return cls(**field_values(cls, setup, places=places))

    def initial_state(self) -> State:
        return {"held_joints": np.zeros(len(self.model.coordinates.joints))}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        base, arm = slice(None, NUM_BASE_VELOCITIES), slice(NUM_BASE_VELOCITIES, None)
        joints = sample.q[NUM_BASE_POSITIONS:][self.places]
        held = joints.copy() if sample.is_first else state["held_joints"]
        H, C = self.model.calc_mass_matrix(sample.q), self.model.calc_bias(sample.q, sample.v)
        momentum = angular_momentum(H, sample.v)
        size = np.maximum(np.sqrt((momentum * momentum).sum()), self.torque * self.decay)
        on_base = np.concatenate([-self.torque / size * momentum, np.zeros_like(momentum)])
        wanted = self.k_p * (held - joints) - self.k_d * sample.v[arm]
        # Solves H [a; wanted] + C = [on_base; tau] for a and tau.
        a = np.linalg.solve(H[base, base], on_base - C[base] - H[base, arm].dot(wanted))
        tau = H[arm, base].dot(a) + H[arm, arm].dot(wanted) + C[arm]
        return np.concatenate([on_base, tau]), {"held_joints": held}


def angular_momentum(mass_matrix: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Angular momentum (3) of all bodies about their centre of mass, world axes, N m s."""
    momentum = mass_matrix.dot(v)
    return momentum[:3] - np.cross(center_of_mass(mass_matrix), momentum[3:6])
