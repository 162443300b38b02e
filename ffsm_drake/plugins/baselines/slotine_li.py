"""Adaptive control of Slotine and Li, with the regressor of the grasped payload.

Slotine, Li, "On the adaptive control of robot manipulators", International Journal of Robotics
Research 6 (1987) 49, doi:10.1177/027836498700600303. With v_r = v_d + Lambda e, s = v_r - v and
a_r = dv_r/dt,

    tau = H(theta) a_r + C(theta, q, v) v_r + K_D s,     dtheta/dt = Gamma Y^T s,

where theta holds the payload's ten inertial parameters and Y its regressor (``payload``). With no
disturbance s^T H s / 2 + (theta - true)^T Gamma^-1 (theta - true) / 2 falls at the rate s^T K_D s.

With an undriven base momentum is conserved, and theta follows without accelerations: with the
nominal momentum A v, the regressor W of the difference d of theta to the nominal one, and the
constant momentum p,

    A v + W d = p.

Least squares over all samples gives d and p; the force is that of the reduced dynamics with theta,
H* (dv_r/dt) + C* + K_D s (after Murotsu, Senda, Ozaki, Tsujio, "Parameter identification of unknown
object handled by free-flying space robot", Journal of Guidance, Control, and Dynamics 17 (1994)).
"""

import dataclasses
from collections.abc import Mapping
from typing import Self

import numpy as np

from ffsm_drake.plugins.baselines.payload import SIZE, Payload, force_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.free_floating import FreeFloating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Sample,
    State,
    field_values,
    gain,
)
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlotineLi(ControlLaw):
    """Adaptive control of Slotine and Li, which adapts the payload's mass and inertia.

    tau = H(theta) a_r + C(theta) v_r + K_D s with the adapted parameters theta of the payload.

    The state ``payload_change`` is theta minus its nominal value: kg, kg m (3), kg m^2 (xx, yy, zz,
    xy, xz, yz), about the origin of the payload's frame, in its axes. A linearisation about the
    plan, for example by ``ffsm stability``, holds it constant.
    """

    model: PlantModel
    sample_time: float
    payload: Payload
    slope: np.ndarray = gain(4.0, "1/s", "slope Lambda of the surface")
    k_d: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 300.0, "joints": 60.0},
        "N m s/rad or N s/m",
        "gain K_D on s",
    )
    mass_rate: float = gain(
        1e5,
        "kg^2/(N m)",
        "rate of adaptation of the mass, an entry of Gamma",
        scalar=True,
        feedback=False,
    )
    moment_rate: float = gain(
        1e4,
        "kg^2 m/N",
        "rate of adaptation of mass times centre of mass, an entry of Gamma",
        scalar=True,
        feedback=False,
    )
    inertia_rate: float = gain(
        1e4,
        "kg^2 m^3/N",
        "rate of adaptation of the inertia, an entry of Gamma",
        scalar=True,
        feedback=False,
    )
    momentum_noise: float = gain(
        1e-3,
        "N s, N m s",
        "standard deviation of the measured momentum, used if the base is not driven",
        scalar=True,
        positive=True,
        feedback=False,
    )
    parameter_size: float = gain(
        100.0,
        "kg, kg m, kg m^2, N s, N m s",
        "expected size of the errors of the parameters and of the momentum, used if the base is "
        "not "
        "driven",
        scalar=True,
        positive=True,
        feedback=False,
    )

    @property
    def conserved(self) -> slice:
        """The conserved rows of [angular; linear] momentum; none with the whole base driven."""
        undriven = self.model.coordinates.undriven
        if not undriven:
            return slice(0, 0)
        return slice(0 if "base_rotation" in undriven else 3, NUM_BASE_VELOCITIES)

    def initial_state(self) -> State:
        memory = {"sliding_variable": np.zeros_like(self.k_d), "payload_change": np.zeros(SIZE)}
        rows = self.conserved.stop - self.conserved.start
        if rows:
            size = SIZE + rows
            memory["information"] = (np.eye(size) / self.parameter_size**2).ravel()
            memory["information_vector"] = np.zeros(size)
        return memory

    def held(self) -> Mapping[str, float | None]:
        return {name: None for name in self.initial_state() if name != "sliding_variable"}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        v_r = sample.v_d + self.slope * sample.e
        a_r = sample.a_d + self.slope * sample.e_dot
        if self.model.coordinates.undriven:
            return self._free_floating(sample, state, v_r, a_r)
        s = v_r - sample.v
        regressor = self.payload.force_regressor(sample.q, sample.v, v_r, a_r)
        change = state["payload_change"]
        force = force_of(self.model, sample.q, sample.v, v_r, a_r) + regressor @ change
        rates = np.repeat([self.mass_rate, self.moment_rate, self.inertia_rate], [1, 3, 6])
        change = change + self.sample_time * rates * (regressor.T @ s)
        return force + self.k_d * s, {"sliding_variable": s, "payload_change": change}

    def _free_floating(
        self, sample: Sample, state: State, v_r: np.ndarray, a_r: np.ndarray
    ) -> tuple[np.ndarray, State]:
        q, v, model = sample.q, sample.v, self.payload.model
        driven = self.model.coordinates.driven
        memory = self._identified(q, v, state)
        change = memory["payload_change"]
        mass_matrix = model.calc_mass_matrix(q) + self.payload.added_mass_matrix(q, change)
        added = self.payload.force_regressor(q, v, v, np.zeros_like(v)) @ change
        spacecraft = FreeFloating(mass_matrix=mass_matrix, base_position=q[4:7], driven=driven)
        s = np.zeros_like(v)
        s[driven] = (v_r - v)[driven]
        force = np.zeros_like(v)
        force[driven] = spacecraft.reduced_mass_matrix @ a_r[driven]
        force[driven] += spacecraft.reduced_bias(model.calc_bias(q, v) + added)
        return force + self.k_d * s, {**memory, "sliding_variable": s}

    def _identified(self, q: np.ndarray, v: np.ndarray, state: State) -> dict[str, np.ndarray]:
        """The memory of the least squares after this sample."""
        rows, model = self.conserved, self.payload.model
        whole = FreeFloating(
            mass_matrix=model.calc_mass_matrix(q), base_position=q[4:7], driven=np.arange(v.size)
        )
        momentum = whole.momentum(v)[rows]
        unknown = np.hstack([self.payload.momentum_regressor(q, v)[rows], -np.eye(momentum.size)])
        weight = self.momentum_noise**-2.0
        size = unknown.shape[1]
        information = state["information"].reshape(size, size) + weight * unknown.T @ unknown
        vector = state["information_vector"] - weight * unknown.T @ momentum
        return {
            "payload_change": np.linalg.solve(information, vector)[:SIZE],
            "information": information.ravel(),
            "information_vector": vector,
        }

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ModelError also: the payload's body does not exist."""
        return cls(**field_values(cls, setup, payload=Payload.from_setup(setup)))
