"""The flight software's look at faults: a stage of sensing that reads what was applied and what is
seen, says what is broken, and gives the controller measurements without the broken sensors.

A sensor that falls silent says so. One that repeats a value though its noise would change it is
frozen. A measurement that jumps by more than noise and applied forces explain is biased; a joint's
rate only where its angle does not follow. A wheel whose momentum does not change by the torque told
stops. Thrusters: ``systems.residuals``. A joint that stands still while the plan moves it is
jammed.

A frozen or silent position is carried on by its velocity, a velocity is estimated from its
position and the told forces, a bias is taken off. Shut is the valve upstream of a thruster that
gives too much or nothing; one that gives less is counted on for less. A fault that is not isolated
within 2 s, or that leaves some wrench without actuators, raises ``abort_request``, and so does a
joint that jams before a grasp.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.primitives import Demultiplexer

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import Fault, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, position_error
from ffsm_drake.systems.actuation import make_base_actuators
from ffsm_drake.systems.actuation.base import working
from ffsm_drake.systems.controllers.estimators import assumed_noise
from ffsm_drake.systems.faults import first_sample
from ffsm_drake.systems.faulty_sensors import SILENT, entries_in_state, sensors_of
from ffsm_drake.systems.part import TIMELINE, Figure, Metric, Part, Signal, View
from ffsm_drake.systems.residuals import Observer, ThrusterBank, moved
from ffsm_drake.systems.sensing import measurement_times
from ffsm_drake.systems.setup import BlockSetup

_EVERY = 5  # control samples from one look at thrusters and joints to the next
_REPEATED = 5  # measurements that show the same before a sensor is frozen
_JUMP = 9.0  # standard deviations of a measurement that is no noise
_USUAL = 2.0  # s, over which residuals are averaged
_SLOW = 3.0  # windows, over which the external force is averaged
_IMPULSE = 0.2  # share of a wheel's largest torque that it may be off
_JAM_WINDOW, _JAM_MOVE, _JAM_SHARE = 0.5, 1e-3, 0.1  # s; rad or m of the plan; of it
_CONFIRMED = 0.1  # s, after which a joint's rate is compared with its angle
_PATIENCE = 2.0  # s from detection to abort_request
_BANDWIDTH = {"base_rotation": 8.0, "base_position": 2.0, "joints": 10.0}  # rad/s


class FaultDetection(Part):
    """The section ``faults`` of a scenario, as flight software sees it."""

    title = "Faults"
    section = "Faults"
    about = "What broke, and when the residuals of applied against seen told."

    @classmethod
    def of(cls, scenario: Scenario) -> "FaultDetection | None":
        """That of a scenario."""
        return None if scenario.faults is None else cls()
