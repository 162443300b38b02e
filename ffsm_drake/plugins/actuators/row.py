"""Actuators: from the commanded to the applied force. Saturation, quantisation, delay, link,
drives, wheels, thrusters.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.systems.framework import System
from pydrake.systems.primitives import DiscreteTimeDelay, PassThrough, Saturation

from ffsm_drake.plugins.actuators.base import BaseActuators
from ffsm_drake.plugins.actuators.continuous_system import ContinuousSystem
from ffsm_drake.plugins.actuators.drives import FRICTION, DriveSet, JointFriction, RateLimit
from ffsm_drake.plugins.actuators.gyroscopic import Gyroscopic
from ffsm_drake.plugins.actuators.link import LossyLink, link_of, lossy_link
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.quantizer import Quantizer
from ffsm_drake.plugins.actuators.thrusters import ThrusterSet
from ffsm_drake.plugins.actuators.wheel_set import WheelSet
from ffsm_drake.scenario import Actuation, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.continuous import Continuous, InstantSystem
from ffsm_drake.systems.faults import Hit, detects, hits
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.sampled import Sampled, SampledSystem
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock


class Actuators(CompositeBlock):
    """Systems in a row from ``commanded_force`` to ``applied_force``, and some beside them.

    The first ports of those in the row are forces. Other ports are connected by name; ``state`` and
    ``isolated`` are inputs.
    """

    def __init__(self, row: Mapping[str, System], beside: Mapping[str, System]) -> None:
        forces = dict[str, dict[str, str]]()
        for name, system in row.items():
            after = "applied_force" if name == [*row][-1] else "commanded_force"
            forces[name] = {
                system.get_input_port(0).get_name(): "commanded_force",
                system.get_output_port(0).get_name(): after,
            }
        inputs = ("commanded_force", "state", "isolated")
        super().__init__("actuation", {**row, **beside}, inputs=inputs, signals=forces)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActuatorRow(Part):
    """The section ``actuation``; its thrusters, wheels and drives are parts of their own."""

    def build(self, setup: BlockSetup) -> Actuators | None:
        """The actuators; None of ideal ones."""
        scenario = setup.scenario
        return make_actuation(
            allocated(scenario),
            setup.coordinates,
            sample_time=setup.sample_time,
            faults=_faults(scenario),
            detects=detects(scenario),
            link=_link(scenario, setup.coordinates),
        )


def make_actuation(
    settings: Actuation,
    coordinates: Coordinates,
    *,
    sample_time: float,
    base: Sampled | None = None,
    faults: Sequence[Hit] = (),
    detects: bool = False,
    link: LossyLink | None = None,
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
      faults: those of thrusters and wheels.
      detects: whether there is an input for detected faults.
      link: from the command to the actuators; None: commands arrive at once.

    Raises:
      ScenarioError: a value is given for an unknown coordinate; thrusters or wheels cannot give
        every wrench.
    """
    row = _make_limits(settings, coordinates, sample_time=sample_time)
    blocks, flowing = acting(
        settings, coordinates, sample_time, base=base, faults=faults, detects=detects
    )
    if link is not None:
        blocks = {"link": link, **blocks}
    for name, block in blocks.items():
        row[name] = SampledSystem(block, name=name, sample_time=sample_time)
    beside = {name: ContinuousSystem(each, name=name) for name, each in flowing.items()}
    if beside and not row:
        row["as_commanded"] = PassThrough(len(coordinates.names))
    return Actuators(row, beside) if row else None


def acting(
    settings: Actuation,
    coordinates: Coordinates,
    sample_time: float,
    *,
    base: Sampled | None = None,
    faults: Sequence[Hit] = (),
    detects: bool = False,
) -> tuple[dict[str, Sampled], dict[str, Continuous]]:
    """Return the blocks in a row after saturation, quantisation and delay, and those beside them,
    by name. Arguments and errors: see ``make_actuation``.
    """
    row, beside = dict[str, Sampled](), dict[str, Continuous]()
    nv = len(coordinates.names)
    if settings.drives is not None:
        drives = DriveSet(settings.drives, settings.limit, coordinates)
        if drives.has_rate_limit:
            row["rate_limit"] = RateLimit(drives=drives, num_velocities=nv)
        if drives.has_friction:
            beside[FRICTION] = JointFriction(drives=drives, num_velocities=nv)
    if base is not None:
        row["base"] = base
    elif settings.thrusters is not None or settings.wheels is not None:
        row["actuators"] = made = make_base_actuators(
            settings, coordinates, sample_time=sample_time, faults=faults, detects=detects
        )
        if made.wheels is not None:
            beside["momentum"] = Gyroscopic(momentum=made.wheels.initial, num_velocities=nv)
    return row, beside


def acting_blocks(
    scenario: Scenario, coordinates: Coordinates
) -> tuple[list[Sampled], list[Continuous]]:
    """Return the blocks of a scenario's actuators in a row, after saturation, quantisation and
    delay, and those beside them. Raises the errors of ``make_actuation``.
    """
    row, beside = acting(
        allocated(scenario), coordinates, scenario.sample_time, faults=_faults(scenario),
        detects=detects(scenario),
    )  # fmt: skip
    link = _link(scenario, coordinates)
    return [*([] if link is None else [link]), *row.values()], [*beside.values()]


def _link(scenario: Scenario, coordinates: Coordinates) -> LossyLink | None:
    """The link of a scenario; None: there is none."""
    settings, step = link_of(scenario), scenario.sample_time
    if settings is None:
        return None
    return lossy_link(settings, coordinates, sample_time=step, seed=scenario.random_seed)


def _faults(scenario: Scenario) -> list[Hit]:
    return [hit for part in ("thrusters", "wheels") for hit in hits(scenario, part)]


def _make_limits(
    settings: Actuation, coordinates: Coordinates, *, sample_time: float
) -> dict[str, System]:
    """Saturation, quantisation and delay, by name; those that there are."""
    limit, resolution = (
        coordinates.vector(getattr(settings, name) or {}, key=f"actuation.{name}", default=default)
        for name, default in (("limit", np.inf), ("quantization", 0.0))
    )
    row: dict[str, System] = {}
    if np.isfinite(limit).any():
        row["saturation"] = Saturation(-limit, limit)
    if resolution.any():
        row["quantizer"] = InstantSystem(Quantizer(resolution=resolution), name="quantizer")
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
