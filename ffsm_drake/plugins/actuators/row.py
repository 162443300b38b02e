"""Actuators: from the commanded to the applied force. Saturation, quantisation, delay, drives,
wheels, thrusters.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, System
from pydrake.systems.primitives import DiscreteTimeDelay, PassThrough, Saturation

from ffsm_drake.plugins.actuators.base import BaseActuators, BaseBlock, Hit
from ffsm_drake.plugins.actuators.drives import FRICTION, DriveSet, JointFriction, RateLimit
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.thrusters import ThrusterSet
from ffsm_drake.plugins.actuators.wheels import Gyroscopic, WheelSet
from ffsm_drake.scenario import Actuation, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.continuous import Continuous, ContinuousSystem
from ffsm_drake.systems.faults import detects, first_sample, hits
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.quantization import Quantizer
from ffsm_drake.systems.sampled import Sampled, SampledSystem
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock


class Actuators(CompositeBlock):
    """Systems in a row from ``commanded_force`` to ``applied_force``, and some beside them.

    The first ports of those in the row are forces; what else they and the others put out are
    outputs, by name, and all may read ``state``. Of several copies of the spacecraft the ports hold
    copy after copy.
    """

    def __init__(
        self, row: Mapping[str, System], beside: Mapping[str, System], *, copies: int = 1
    ) -> None:
        super().__init__()
        self._copies = copies
        builder, chain = DiagramBuilder(), list(row.values())
        readers = list[InputPort]()
        for name, system in (*row.items(), *beside.items()):
            builder.AddNamedSystem(name, system)
            for index in range(int(name in row), system.num_output_ports()):
                port = system.get_output_port(index)
                builder.ExportOutput(port, port.get_name())
            if system.HasInputPort("state"):
                readers.append(system.GetInputPort("state"))
            if system.HasInputPort("isolated"):
                builder.ExportInput(system.GetInputPort("isolated"), "isolated")
        for before, after in itertools.pairwise(chain):
            builder.Connect(before.get_output_port(0), after.get_input_port(0))
        builder.ExportInput(chain[0].get_input_port(0), "commanded_force")
        builder.ExportOutput(chain[-1].get_output_port(0), "applied_force")
        for port in readers[:1]:
            builder.ExportInput(port, "state")
        for port in readers[1:]:
            builder.ConnectInput("state", port)
        builder.BuildInto(self)
        self.set_name("actuation")

    def park(self, context: Context, copy: int) -> None:
        """Put a copy's memory to its start (``loop.side_by_side``)."""
        for system in self.GetSystems():
            own = self.GetMutableSubsystemContext(system, context)
            start = system.CreateDefaultContext()
            # A delay holds the forces of all copies at one sample, then those at the next.
            width = system.get_input_port(0).size() if isinstance(system, DiscreteTimeDelay) else -1
            for index in range(own.num_discrete_state_groups()):
                values = own.get_discrete_state(index).value().copy()
                if values.size > 1:  # one number is shared
                    first = start.get_discrete_state(index).value()
                    self._put_back(values, first, copy, width=width)
                    own.SetDiscreteState(index, values)
            if own.num_continuous_states():
                values = own.get_continuous_state_vector().CopyToVector()
                self._put_back(values, np.zeros(values.size), copy)
                own.SetContinuousState(values)

    def _put_back(
        self, values: np.ndarray, start: np.ndarray, copy: int, *, width: int = -1
    ) -> None:
        """Set a copy's entries to those of the start, in vectors with all copies in each width."""
        shape = (-1 if width > 0 else 1, self._copies, max(width // self._copies, -1))
        values.reshape(shape)[:, copy] = start.reshape(shape)[:, copy]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActuatorRow(Part):
    """The section ``actuation``; its thrusters, wheels and drives are parts of their own."""

    def build(self, setup: BlockSetup) -> Actuators | None:
        """The actuators; None of ideal ones."""
        return self.build_wide([setup])

    def build_wide(self, setups: Sequence[BlockSetup]) -> Actuators | None:
        """The actuators of several copies of the spacecraft, see ``systems.side_by_side``; None if
        they are ideal, or differ in more than limits of the force and quantisation.
        """
        settings = [allocated(setup.scenario) for setup in setups]
        first = settings[0]
        if any(dataclasses.replace(each, **_by_copy(first)) != first for each in settings):
            return None
        scenario, step = setups[0].scenario, setups[0].sample_time
        return _make_actuation(
            settings,
            setups[0].coordinates,
            sample_time=step,
            faults=_faults(scenario),
            detects=detects(scenario),
        )


def _by_copy(settings: Actuation) -> dict[str, Any]:
    """Settings that may differ between copies of the spacecraft; the drives' torque falls from the
    limit.
    """
    alike = settings.drives is not None
    return {name: getattr(settings, name) for name in ("limit", "quantization")[alike:]}


def make_actuation(
    settings: Actuation,
    coordinates: Coordinates,
    *,
    sample_time: float,
    base: System | None = None,
) -> Actuators | None:
    """Build a diagram from ``commanded_force`` to ``applied_force``, both (nv): N m and N; None if
    they are equal.

    With thrusters, wheels or drives it has the input ``state`` and outputs for the signals of their
    parts; with wheels ``gyroscopic_force`` (nv), also applied to the plant, and
    ``stored_momentum``; with friction of the drives ``friction_force`` (nv), also applied to the
    plant, and ``friction_work`` (nv).

    Args:
      settings: settings of the actuators.
      coordinates: names of the forces' components.
      sample_time: s.
      base: from force to force (nv), in place of thrusters and wheels.

    Raises:
      ScenarioError: a value is given for an unknown coordinate; thrusters or wheels cannot give
        every wrench.
    """
    return _make_actuation([settings], coordinates, sample_time=sample_time, base=base)


def _make_actuation(
    of_copies: Sequence[Actuation],
    coordinates: Coordinates,
    *,
    sample_time: float,
    base: System | None = None,
    faults: Sequence[Hit] = (),
    detects: bool = False,
) -> Actuators | None:
    """``make_actuation`` for several settings; differences are within ``_by_copy``."""
    settings, copies = of_copies[0], len(of_copies)
    row, beside = _make_limits(of_copies, coordinates, sample_time=sample_time), dict[str, System]()
    acting, flowing = _acting(
        settings,
        coordinates,
        sample_time,
        faults=faults,
        detects=detects,
        has_base=base is not None,
    )
    for block in acting:
        if isinstance(block, BaseActuators):
            row["base"] = BaseBlock(block, copies=copies)
        else:
            row["rate_limit"] = SampledSystem(
                [block], name="rate_limit", sample_time=sample_time, copies=copies
            )
    for each in flowing:
        if isinstance(each, JointFriction):
            beside["friction"] = ContinuousSystem(each, name=FRICTION, copies=copies)
    if base is not None:
        row["base"] = base
    if beside and not row:
        row["as_commanded"] = PassThrough(copies * len(coordinates.names))
    return Actuators(row, beside, copies=copies) if row else None


def _acting(
    settings: Actuation,
    coordinates: Coordinates,
    sample_time: float,
    *,
    faults: Sequence[Hit] = (),
    detects: bool = False,
    has_base: bool = False,
) -> tuple[list[Sampled], list[Continuous]]:
    """The blocks in a row after saturation, quantisation and delay, and those beside them; without
    thrusters and wheels if there ``has_base`` another block in their place.
    """
    row, beside, nv = list[Sampled](), list[Continuous](), len(coordinates.names)
    if settings.drives is not None:
        drives = DriveSet(settings.drives, settings.limit, coordinates)
        if drives.has_rate_limit:
            row.append(RateLimit(drives=drives, num_velocities=nv))
        if drives.has_friction:
            beside.append(JointFriction(drives=drives, num_velocities=nv))
    if not has_base and (settings.thrusters is not None or settings.wheels is not None):
        base = make_base_actuators(
            settings, coordinates, sample_time=sample_time, faults=faults, detects=detects
        )
        row.append(base)
        if base.wheels is not None:
            beside.append(Gyroscopic(momentum=base.wheels.initial, num_velocities=nv))
    return row, beside


def acting_blocks(
    scenario: Scenario, coordinates: Coordinates
) -> tuple[list[Sampled], list[Continuous]]:
    """Return the blocks of a scenario's actuators in a row, after saturation, quantisation and
    delay, and those beside them. Raises the errors of ``make_actuation``.
    """
    return _acting(
        allocated(scenario), coordinates, scenario.sample_time, faults=_faults(scenario),
        detects=detects(scenario),
    )  # fmt: skip


def _faults(scenario: Scenario) -> list[Hit]:
    return [
        (unit, fault, first_sample(fault, scenario.sample_time))
        for part in ("thrusters", "wheels")
        for unit, fault in hits(scenario, part)
    ]


def _make_limits(
    of_copies: Sequence[Actuation], coordinates: Coordinates, *, sample_time: float
) -> dict[str, System]:
    """Saturation, quantisation and delay, by name; those that there are."""
    settings = of_copies[0]
    limit, resolution = (
        np.concatenate(
            [
                coordinates.vector(
                    getattr(each, name) or {}, key=f"actuation.{name}", default=default
                )
                for each in of_copies
            ]
        )
        for name, default in (("limit", np.inf), ("quantization", 0.0))
    )
    row: dict[str, System] = {}
    if np.isfinite(limit).any():
        row["saturation"] = Saturation(-limit, limit)
    if resolution.any():
        row["quantizer"] = Quantizer(resolution)
    if settings.delay > 0:
        # A delay block reads its input before the controller's update of the same instant: one
        # sample late by itself.
        row["delay"] = DiscreteTimeDelay(sample_time, settings.delay - 1, limit.size)
    return row


def make_base_actuators(
    settings: Actuation,
    coordinates: Coordinates,
    *,
    sample_time: float,
    faults: Sequence[Hit] = (),
    detects: bool = False,
) -> BaseActuators:
    """Thrusters and wheels as one block, with their faults and an input for detected faults. Raises
    the errors of ``make_actuation``.
    """
    thrusters, wheels = None, None
    if settings.thrusters is not None:
        thrusters = ThrusterSet(settings.thrusters, sample_time=sample_time)
    if settings.wheels is not None:
        wheels = WheelSet(settings.wheels, sample_time=sample_time, alone=thrusters is None)
    return BaseActuators(
        thrusters=thrusters,
        wheels=wheels,
        num_velocities=len(coordinates.names),
        sample_time=sample_time,
        faults=faults,
        detects=detects,
    )
