"""What a compiled run reads of a supervisor.

``tests/plugins/compiled/contracts.py`` shows mypy that the plug-in ``capture`` has it.
"""

from typing import Protocol, runtime_checkable

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup


class Watch(Protocol):
    """The mode logic, which is a ``Sampled`` block, too. It may be one with symbols."""

    @property
    def sample_time(self) -> float:
        """The control period, s."""

    def start(self) -> Arrays:
        """See Sampled."""

    def modes(self, times: np.ndarray, plan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return its phases at times (s) along a new plan (or zeros)."""

    def follow(self, memory: Arrays, plan: Arrays) -> Arrays:
        """Return the plan that the law follows. Args: memory before a sample; its plan."""

    def give(self, memory: Arrays, force: np.ndarray) -> np.ndarray:
        """Return the command. Args: memory after a sample; the law's force."""


class Supervisor(Protocol):
    """The mode logic with its plans."""

    @property
    def block(self) -> Watch:
        """The mode logic."""

    @property
    def mission(self) -> Mission:
        """The mission."""

    def answered(self, memory: Arrays, state: np.ndarray, time: float) -> dict[str, np.ndarray]:
        """Return the memory before a sample that asks, with a plan from its measured state."""

    def motions(self, plan: np.ndarray) -> list[PlannedMotion]:
        """Return the motion of a plan, by the time since its begin, and the motion of a frame if
        one is prescribed.
        """


@runtime_checkable
class Supervised(Protocol):
    """A part that has a supervisor."""

    def supervisor(self, setup: BlockSetup) -> Supervisor:
        """Return the supervisor."""
