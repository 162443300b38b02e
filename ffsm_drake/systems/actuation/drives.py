"""Drives of the joints: what force they give at what rate, and their friction.

A motor with a limited current gives its full torque up to some speed; from there the voltage that
is left above the back-EMF falls linearly, to nothing at its no-load speed (the torque-speed line of
a DC motor). It brakes at any speed. Friction is that of Armstrong-Helouvry, Dupont and Canudas de
Wit (Automatica 30, 1994), with tanh in place of the sign:

    F(v) = -((F_c + (F_s - F_c) exp(-(v / v_s)^2)) tanh(v / v_0) + b v)

with Coulomb friction F_c, static friction F_s, Stribeck rate v_s, smoothing rate v_0 and viscous
friction b. A joint that it holds against a force F < F_c creeps at v_0 artanh(F / F_c).
"""

import numpy as np
from pydrake.symbolic import Expression, MakeVectorVariable, exp, tanh
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.primitives import Demultiplexer, SymbolicVectorSystem

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import Drives, PerCoordinate
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, Coordinates

_KEY = "actuation.drives"
# the system whose state is friction's work, from which nothing feeds back
FRICTION = "friction_of_drives"
FRICTION_FORCE, FRICTION_WORK = "friction_force", "friction_work"  # its outputs


class DriveSet:
    """Force and friction of a set of drives: pure functions of arrays, by joint (n) in the order of
    v.
    """

    def __init__(
        self, settings: Drives, limit: PerCoordinate | None, coordinates: Coordinates
    ) -> None:
        """Args: the drives; ``actuation.limit``; the coordinates.

        Raises ScenarioError: a value for what is no joint, static friction below Coulomb, a rate
        limit without a force.
        """

        def of_joints(name: str, default: float) -> np.ndarray:
            return coordinates.joint_vector(
                getattr(settings, name) or {}, key=f"{_KEY}.{name}", default=default
            )

        self.names = coordinates.joints
        self.coulomb, self.viscous = (
            of_joints("coulomb_friction", 0.0),
            of_joints("viscous_friction", 0.0),
        )
        self.static = (
            self.coulomb
            if settings.static_friction is None
            else of_joints("static_friction", np.nan)
        )
        self.static = np.where(np.isnan(self.static), self.coulomb, self.static)
        self.stribeck_rate, self.smoothing_rate = (
            of_joints("stribeck_rate", 0.01),
            of_joints("smoothing_rate", 1e-3),
        )
        self.rate_limit, self.knee = of_joints("rate_limit", np.inf), of_joints("knee", 0.9)
        self.force_limit = coordinates.vector(limit or {}, key="actuation.limit", default=np.inf)[
            NUM_BASE_VELOCITIES:
        ]
        for name, coulomb, static in zip(self.names, self.coulomb, self.static, strict=True):
            if static < coulomb:
                problem = f"{name} has {static:g}, less than its coulomb_friction, {coulomb:g}"
                raise ScenarioError(f"{_KEY}.static_friction", problem)
        for name, rate, force in zip(self.names, self.rate_limit, self.force_limit, strict=True):
            if np.isfinite(rate) and not np.isfinite(force):
                problem = (
                    f"{name} has no actuation.limit, from which its force would fall to "
                    "nothing; give it one"
                )
                raise ScenarioError(f"{_KEY}.rate_limit", problem)

    @property
    def has_friction(self) -> bool:
        """Whether any joint has."""
        return bool(self.static.any() or self.viscous.any())

    @property
    def has_rate_limit(self) -> bool:
        """Whether any joint has."""
        return bool(np.isfinite(self.rate_limit).any())

    def friction(self, rate: np.ndarray) -> np.ndarray:
        """The force of friction at joint rates (..., n), N m or N."""
        stribeck = (self.static - self.coulomb) * np.exp(-((rate / self.stribeck_rate) ** 2))
        return -(
            (self.coulomb + stribeck) * np.tanh(rate / self.smoothing_rate) + self.viscous * rate
        )

    def available(self, rate: np.ndarray) -> np.ndarray:
        """The largest force (..., n) with the motion at joint rates (..., n), N m or N; infinite
        without a limit.
        """
        with np.errstate(invalid="ignore"):  # without limits
            share = (1.0 - np.abs(rate) / self.rate_limit) / (1.0 - self.knee)
            return np.where(
                np.isfinite(self.rate_limit),
                self.force_limit * np.clip(share, 0.0, 1.0),
                self.force_limit,
            )

    def give(self, force: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """What comes of a wanted force (n) at joint rates (n): the part with the motion is cut, N m
        or N.
        """
        most = self.available(rate)
        return np.clip(
            force, np.where(rate < 0.0, -most, -np.inf), np.where(rate > 0.0, most, np.inf)
        )

    def time_constant(self, inverse_inertia: np.ndarray) -> tuple[float, str]:
        """The shortest time constant, s, with which friction slows a joint near rest, and that
        joint.

        Args:
          inverse_inertia: accelerations of the joints by forces on them (n, n).
        """
        slope = self.static / self.smoothing_rate + self.viscous
        root = np.sqrt(slope)
        rates, modes = np.linalg.eigh(root[:, None] * inverse_inertia * root)
        joint = self.names[int(np.argmax(np.abs(modes[:, -1])))]
        return (1.0 / float(rates[-1]) if rates[-1] > 0.0 else np.inf), joint


class RateLimit(LeafSystem):
    """Cuts the forces on joints to what their drives give at the rates of the last control sample.

    Inputs: ``force`` (nv) and ``state`` [q; v] (nq + nv). Output: ``limited`` (nv), which changes
    at control samples only. Discrete state, updated every control sample: the joint rates (n).
    """

    def __init__(self, drives: DriveSet, coordinates: Coordinates, *, sample_time: float) -> None:
        super().__init__()
        self._drives, nv = drives, len(coordinates.names)
        self._force = self.DeclareVectorInputPort("force", nv)
        self._state = self.DeclareVectorInputPort("state", 2 * nv + 1)
        self.DeclareDiscreteState(len(drives.names))
        # Not on the plant's state: while the command is held, the integrator's stages read the
        # cached value.
        depends = {self.input_port_ticket(self._force.get_index()), self.xd_ticket()}
        self.DeclareVectorOutputPort("limited", nv, weak_callback(self._calc), depends)
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        values.set_value(self._state.Eval(context)[-len(self._drives.names) :])

    def _calc(self, context: Context, output: BasicVector) -> None:
        force = self._force.Eval(context).copy()
        joints = force[NUM_BASE_VELOCITIES:]
        joints[:] = self._drives.give(joints, context.get_discrete_state_vector().value())
        output.SetFromVector(force)


class JointFriction(Diagram):
    """Friction as a continuous force on the plant, and its work. All of it runs in C++.

    Input: ``state`` [q; v] of the plant. Outputs: ``friction_force`` (nv), N m or N, and
    ``friction_work`` (nv), its integral of force times rate since the start, J, which is integrated
    with the plant.
    """

    def __init__(self, drives: DriveSet, coordinates: Coordinates) -> None:
        super().__init__()
        nv, count = len(coordinates.names), len(drives.names)
        builder = DiagramBuilder()
        state = builder.AddNamedSystem("state", Demultiplexer([NUM_BASE_POSITIONS + nv, count]))
        rates, work = (MakeVectorVariable(count, name) for name in ("v", "w"))
        base = [Expression(0.0)] * NUM_BASE_VELOCITIES
        force = [self._force(drives, i, rate) for i, rate in enumerate(rates)]
        friction = SymbolicVectorSystem(
            state=work,
            input=rates,
            dynamics=[one * rate for one, rate in zip(force, rates, strict=True)],
            output=[*base, *force, *base, *work],
        )
        builder.AddNamedSystem(FRICTION, friction)
        outputs = builder.AddNamedSystem("outputs", Demultiplexer([nv, nv]))
        builder.ExportInput(state.get_input_port(), "state")
        builder.Connect(state.get_output_port(1), friction.get_input_port())
        builder.Connect(friction.get_output_port(), outputs.get_input_port())
        for index, name in enumerate((FRICTION_FORCE, FRICTION_WORK)):
            builder.ExportOutput(outputs.get_output_port(index), name)
        builder.BuildInto(self)

    @staticmethod
    def _force(drives: DriveSet, i: int, rate: Expression) -> Expression:
        """As ``DriveSet.friction``; what a joint lacks costs nothing."""
        dry = Expression(drives.coulomb[i])
        if drives.static[i] > drives.coulomb[i]:
            slow = rate * (1.0 / drives.stribeck_rate[i])
            dry += (drives.static[i] - drives.coulomb[i]) * exp(-slow * slow)
        force = (
            Expression(0.0)
            if drives.static[i] == 0.0
            else -dry * tanh(rate * (1.0 / drives.smoothing_rate[i]))
        )
        return force if drives.viscous[i] == 0.0 else force - drives.viscous[i] * rate
