"""Grippers that take time to close (``capture.closing``), as a part of the loop.

The hands that grasp first close on the free target. The target of a hand that closes later
(``contacts.NAME.closes``) is held by the others, and moves with the plant.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ffsm_drake.plugins.capture.closing import MOTION, Closing, hands_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.capture import Compliance
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signal, View
from ffsm_drake.systems.setup import BlockSetup

AXES = ("rotation_x", "rotation_y", "rotation_z", "position_x", "position_y", "position_z")


class Gripper(Part):
    """The section ``capture.closing``. It acts only in the phase in which the gripper closes."""

    title = "Gripper"
    about = "Contact of the gripper with the target while it closes; the gripper's axes."

    def __init__(self, closes: Compliance | None = None, at: float = 0.0) -> None:
        """Args: the compliance with which it closes in this phase; None: it does not close; and the
        hands that close, by their ``closes``, s.
        """
        self._closes, self._at = closes, at
        self.logged = () if closes is None or at else (MOTION,)

    @staticmethod
    def closing(scenario: Scenario, at: float) -> "Gripper":
        """Return the gripper in a phase in which hands close, by their ``closes`` (s)."""
        assert scenario.capture is not None
        return Gripper(scenario.capture.compliance or Compliance(), at)

    @classmethod
    def of(cls, scenario: Scenario) -> "Gripper | None":
        """The gripper of a scenario with ``capture.closing``; None without it."""
        return None if scenario.closing is None else cls()

    def build(self, setup: BlockSetup) -> Any:
        """The force."""
        return Closing.of(setup, self._closes, self._at)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Pose of the target in the gripper, and the force on it."""
        names = [f"{name}_" if name else "" for name in hands_of(setup.scenario)]
        signal = functools.partial(
            Signal,
            components=tuple(f"{name}{axis}" for name in names for axis in AXES),
            dimension="gripper_coordinate",
        )
        return (
            signal(
                name="gripper_offset",
                unit="rad, m",
                meaning="target's grasp frame from the end effector, in contact",
                panels=_by_axis(names, "rad", "m"),
            ),
            signal(
                name="contact_force",
                unit="N m, N",
                meaning="torque and force of the gripper on the target",
                panels=_by_axis(names, "N m", "N"),
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """How often it closed, and the largest contact force and torque."""

        def peak(part: int) -> Callable[[View], float]:
            def of(run: View) -> float:
                force = run["contact_force"]
                pairs = force.reshape(len(force), -1, 2, 3)
                return float(np.linalg.norm(pairs[:, :, part], axis=-1).max(initial=0.0))

            return of

        return (
            Metric(
                key="gripper.closings",
                unit="1",
                label="Closings of the gripper",
                of=_closings,
            ),
            Metric(
                key="gripper.peak_force",
                unit="N",
                label="Largest contact force",
                of=peak(1),
            ),
            Metric(
                key="gripper.peak_torque",
                unit="N m",
                label="Largest contact torque",
                of=peak(0),
            ),
        )


def _closings(run: View) -> int:
    """How often the gripper began to close."""
    closes = run["gripper_offset"].any(axis=1).astype(int)
    return int((np.diff(closes, prepend=0) > 0).sum())


def _by_axis(names: Sequence[str], of_rotation: str, of_position: str) -> dict[str, str]:
    units = zip(AXES, [of_rotation] * 3 + [of_position] * 3, strict=True)
    return {f"{name}{axis}": unit for axis, unit in units for name in names}
