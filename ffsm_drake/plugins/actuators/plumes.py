"""The plumes of a scenario's thrusters, as a force in the closed loop."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.numbers import percent, usable
from ffsm_drake.plugins.actuators.plume import PlumeField, returned_shares
from ffsm_drake.scenario import Scenario, thrusters_of
from ffsm_drake.spacecraft.coordinates import BASE_POSITION
from ffsm_drake.systems.part import HELD_FORCE, STEPS, Figure, Metric, Part, Signal, View
from ffsm_drake.systems.setup import BlockSetup

_TELLING = 0.05  # share of its thrust from which a thruster's plume is reported


class Plumes(Part):
    """The section ``actuation.thrusters.plume`` of a scenario."""

    title = "Plumes"
    section = "Actuators"
    about = "Force of the thrusters' plumes on the spacecraft's own bodies."

    @classmethod
    def of(cls, scenario: Scenario) -> "Plumes | None":
        """None if plumes push nothing."""
        settings = scenario.actuation.thrusters
        return None if settings is None or settings.plume is None else cls()

    def build(self, setup: BlockSetup) -> LeafSystem:
        """The force."""
        return _PlumeForce(setup)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """The generalized force of all plumes."""
        return (
            Signal(
                name="plume_force",
                unit="N m, N",
                meaning="generalized force of all plumes from this sample to the next",
                components=setup.coordinates.names,
                dimension="coordinate",
                role=HELD_FORCE,
                heading="Plumes",
                panels=dict.fromkeys(BASE_POSITION, "N"),
                chart=STEPS,
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """Impulse of the plumes, and what share of its thrust each thruster's returns."""

        def returned(run: View) -> dict[str, float]:
            shares = returned_shares(run.scenario)
            return {name: share for name, share in shares.items() if share > _TELLING}

        return (
            Metric(
                key="plume.impulse",
                unit="N s",
                label="Impulse of the plumes on the spacecraft",
                of=lambda run: (
                    run.scenario.sample_time
                    * float(np.linalg.norm(run["plume_force"][:-1, 3:6], axis=1).sum())
                ),
            ),
            Metric(
                key="plume.returned",
                unit="1",
                label="Thrust returned by the plume",
                column="",
                shown="%",
                of=returned,
            ),
        )

    def sentence(self, figures: Sequence[Figure]) -> str | None:
        """The thrusters that push the spacecraft most."""
        (shares,) = (each.value for each in figures if each.key == "plume.returned")
        assert isinstance(shares, dict)
        most = sorted(shares, key=lambda name: -shares[name])[:3]
        if not most:
            return None
        named = ", ".join(f"{name} {percent(shares[name])}" for name in most)
        return f"plumes return thrust: {named}; set actuation.thrusters.plume.ban to exclude them"


class _PlumeForce(LeafSystem):
    """The force of the plumes, from the thrusters' mean force in a control sample and the
    configuration at its start.

    Inputs: ``state`` (nq + nv), ``thruster_force`` (n); unconnected, as in linear loops, the force
    is 0. State (discrete): the configuration (nq). Outputs, equal: ``generalized_force`` (nv),
    ``plume_force`` (nv); they change once a sample.
    """

    def __init__(self, setup: BlockSetup) -> None:
        super().__init__()
        scenario, coordinates = setup.scenario, setup.coordinates
        settings = scenario.actuation.thrusters
        assert settings is not None
        assert settings.plume is not None
        units = thrusters_of(settings)
        model = setup.true
        self._field = PlumeField(
            settings.plume,
            [*units.values()],
            model,
            scenario.model,
            without=None if setup.grip.holds else scenario.payload.body,
        )
        self._nq, nv = len(coordinates.position_names), len(coordinates.names)
        self._state = self.DeclareVectorInputPort("state", self._nq + nv)
        self._thrust = self.DeclareVectorInputPort("thruster_force", len(units))
        self._held = self.DeclareDiscreteState(self._nq)
        self._last = b"", np.zeros(nv)  # a cache: evaluated in every stage of the integrator
        changes = {
            self.discrete_state_ticket(self._held),
            self.input_port_ticket(self._thrust.get_index()),
        }
        for name in ("generalized_force", "plume_force"):
            self.DeclareVectorOutputPort(name, nv, weak_callback(self._calc), changes)
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, weak_callback(self._hold))
        untie(self)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Begin at a known state [q; v] (nq + nv) of the plant."""
        context.SetDiscreteState(self._held, state[: self._nq])

    def _hold(self, context: Context, new: DiscreteValues) -> None:
        new.set_value(self._held, self._state.Eval(context)[: self._nq])

    def _calc(self, context: Context, output: BasicVector) -> None:
        q, thrust = context.get_discrete_state().value(self._held), np.zeros(0)
        if self._thrust.HasValue(context):
            thrust = self._thrust.Eval(context)
        if not (usable(q[None])[0] and thrust.any()):
            output.SetFromVector(np.zeros(output.size()))
            return
        key = q.tobytes() + thrust.tobytes()
        if self._last[0] != key:
            self._last = key, self._field.calc(q, thrust)[0]
        output.SetFromVector(self._last[1])
