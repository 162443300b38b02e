"""The activity of barriers in a record."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import EFFORT, STEPS, Signal, View
from ffsm_drake.systems.setup import BlockSetup

# Signals, and parts of the law's memory.
CHANGE, SLACK = "barrier_force", "barrier_slack"
_ROUNDING = 1e-6  # rad/s^2 or m/s^2; slack of a solved program


@dataclasses.dataclass(frozen=True, kw_only=True)
class BarrierActivity(Part):
    """What barriers change, and what they cannot keep."""

    title: ClassVar[str] = "Barriers"
    section: ClassVar[str] = "Barriers"
    about: ClassVar[str] = "Change of the commanded force by control barrier functions."
    joints: tuple[str, ...]

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """The change of the force, and the slack of the conditions."""
        return (
            Signal(
                name=CHANGE, unit=EFFORT, chart=STEPS, components=self.joints,
                meaning="change of the commanded force by the barriers",
            ),
            Signal(
                name=SLACK, unit="rad/s^2 or m/s^2", chart=STEPS,
                meaning="acceleration by which the barriers' conditions are violated, because the "
                "limits of the force do not permit them",
            ),
        )  # fmt: skip

    def metrics(self) -> Sequence[Metric]:
        """Shares of the control samples."""
        return (
            Metric(key="barriers.active", unit="1", label="Barriers active", of=_active),
            Metric(
                key="barriers.infeasible", unit="1", label="Barriers infeasible", of=_infeasible
            ),
        )


def _active(run: View) -> float:
    return float((np.abs(run[CHANGE]) > 0.0).any(axis=1).mean())


def _infeasible(run: View) -> float:
    return float((run[SLACK] > _ROUNDING).mean())
