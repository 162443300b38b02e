"""The plumes of a scenario's thrusters, as a force in the closed loop."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from ffsm_drake.common.numbers import percent, usable
from ffsm_drake.plugins.actuators.plume import PlumeField, returned_shares
from ffsm_drake.scenario import Scenario, thrusters_of
from ffsm_drake.spacecraft.coordinates import BASE_POSITION
from ffsm_drake.systems.parts.metrics import Figure, Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import HELD_FORCE, STEPS, Signal, View
from ffsm_drake.systems.sampled import Arrays, Now, Sampled, SampledSystem
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

    def build(self, setup: BlockSetup) -> SampledSystem:
        """The force."""
        scenario, settings = setup.scenario, setup.scenario.actuation.thrusters
        assert settings is not None
        assert settings.plume is not None
        units = [*thrusters_of(settings).values()]
        field = PlumeField(
            settings.plume,
            units,
            setup.true,
            scenario.model,
            without=None if setup.grip.holds else scenario.payload.body,
        )
        force = PlumeForce(
            field=field, num_velocities=len(setup.coordinates.names), num_thrusters=len(units)
        )
        return SampledSystem(force, name=setup.name, sample_time=setup.sample_time)

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlumeForce(Sampled):
    """The force of the plumes, from the thrusters' mean force in a control sample and the
    configuration at its start.

    Inputs: ``state`` (nq + nv), ``thruster_force`` (n); unconnected, as in linear loops, the force
    is 0. Outputs, equal: ``generalized_force`` (nv), ``plume_force`` (nv).
    """

    field: PlumeField
    num_velocities: int
    num_thrusters: int
    acts = True
    optional: ClassVar = ("thruster_force",)

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"state": 2 * self.num_velocities + 1, "thruster_force": self.num_thrusters}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return dict.fromkeys(("generalized_force", "plume_force"), self.num_velocities)

    @property
    def latched(self) -> Mapping[str, Sequence[float]]:
        """See Sampled."""
        return {"state": [0.0] * len(self.entries["state"])}

    @property
    def entries(self) -> Mapping[str, Sequence[int]]:
        """See Sampled: the configuration."""
        return {"state": range(self.num_velocities + 1)}

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        q, thrust = inputs["state"], inputs.get("thruster_force", np.zeros(0))
        force = np.zeros(self.num_velocities)
        if usable(q[None])[0] and thrust.any():
            force, _ = self.field.calc(q, thrust)
        return dict.fromkeys(self.outputs, force), memory
