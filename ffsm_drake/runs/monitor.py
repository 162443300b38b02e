"""Detection of divergence during a run or several, and a run's progress."""

import dataclasses
import math
from collections.abc import Callable, Collection

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from ffsm_drake.common.guard import callers_own
from ffsm_drake.loop.closed_loop import ClosedLoop


@dataclasses.dataclass
class Monitor:
    """Detects divergence and reports progress; as a simulator's monitor, it stops a run that
    diverges.
    """

    loop: ClosedLoop
    progress: Callable[[float, float], None] | None
    message: str = ""
    coordinate: str = ""
    next_report: float = 0.0

    def __post_init__(self) -> None:
        self._bound = self.loop.scenario.divergence_speed
        self._first_velocity = len(self.loop.coordinates.position_names)

    def __call__(self, context: Context) -> EventStatus:
        if not self.check(context):
            return EventStatus.ReachedTermination(self.loop.diagram, self.message)
        return EventStatus.DidNothing()

    def report(self, context: Context) -> None:
        """Report the progress, every whole second once."""
        if self.progress is not None and context.get_time() >= self.next_report - 1e-9:
            self.next_report += 1.0
            with callers_own():
                self.progress(context.get_time(), self.loop.scenario.duration)

    def bounded(self, states: np.ndarray) -> np.ndarray:
        """Whether every velocity of each known state [q; v] is within the bound."""
        # false for NaN too
        within: np.ndarray = np.abs(states[..., self._first_velocity :]).max(axis=-1) <= self._bound
        return within

    def check(self, context: Context) -> bool:
        """True if every velocity is within the bound; otherwise ``message`` and ``coordinate`` are
        set.
        """
        plant = self.loop.plant
        whole = plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(context))
        return self.judge(context.get_time(), self.loop.split.known_part(whole))

    def judge(self, time: float, state: np.ndarray) -> bool:
        """Same as ``check``, for a known state [q; v] at a time, s."""
        if self.bounded(state).all():
            return True
        velocity = state[self._first_velocity :]
        # The first that is not finite, else the fastest.
        worst = int(np.argmax(np.where(np.isfinite(velocity), np.abs(velocity), np.inf)))
        coordinates = self.loop.coordinates
        self._note(
            time,
            worst,
            f"{coordinates.names[worst]} moves at {velocity[worst]:.3g} "
            f"{coordinates.units[worst]}/s, "
            f"beyond divergence_speed = {self._bound:g}",
        )
        return False

    def check_force(self, context: Context) -> bool:
        """True if the controller's force is finite; otherwise as ``check``."""
        diagram = self.loop.diagram
        force = diagram.GetOutputPort("generalized_force").Eval(context)
        return self.judge_force(context.get_time(), force)

    def judge_force(self, time: float, force: np.ndarray) -> bool:
        """Same as ``check_force``, for a force (nv) at a time, s."""
        if np.isfinite(force).all():
            return True
        worst = int(np.argmin(np.isfinite(force)))
        self._note(
            time, worst, f"the force on {self.loop.coordinates.names[worst]} is {force[worst]:g}"
        )
        return False

    def _note(self, time: float, worst: int, what: str) -> None:
        self.coordinate = self.loop.coordinates.names[worst]
        self.message = f"diverged at t = {time:.2f} s: {what}"


_SKIPS = 3  # steps without a check
_SLOW = 0.1  # share of the bound; slower copies cannot exceed it within so many steps


class CopiesMonitor:
    """Parks diverging copies of the spacecraft to keep the others unaffected: a copy is reset to
    its start a step after it left its bounds (so the log has the update of its last sample), and
    again whenever it leaves them. As a simulator's monitor, it stops a run when all are parked.

    While all are slow it checks every fourth step only, if the log can show the steps in between.
    """

    message = ""

    def __init__(
        self, loop: ClosedLoop, parked: Collection[int] = (), *, every_step: bool = True
    ) -> None:
        """Args:
        loop: a loop of several copies.
        parked: copies parked from the start.
        every_step: whether every step is checked.
        """
        if loop.copies is None:
            raise ValueError("the loop has one copy of the spacecraft")
        self.loop, self.copies = loop, loop.copies
        self.parked = set(parked)
        self._looked = -math.inf  # time at which a copy was beyond its bounds, s
        self._leaving = set[int]()  # copies to be parked after a step
        self.lost = set[int]()  # copies parked before the update of their last sample
        self._bounds = np.array([scenario.divergence_speed for scenario in loop.scenarios])
        self._least = float(self._bounds.min())
        self._skips, self._skipped = 0 if every_step else _SKIPS, 0
        self._nothing = EventStatus.DidNothing()
        self._first: tuple[Context, np.ndarray] | None = None  # the plant's context, and its start

    def __call__(self, context: Context) -> EventStatus:
        if self._skipped:
            self._skipped -= 1
        elif not self.check(context):
            return EventStatus.ReachedTermination(self.loop.diagram, self.message)
        return self._nothing

    def report(self, context: Context) -> None:
        """Several runs report no progress."""

    def check(self, context: Context) -> bool:
        """Park those that diverge. True unless all are parked."""
        if self._first is None:
            own = self.loop.plant.GetMyMutableContextFromRoot(context)
            start = self.copies.rows(self.loop.plant.GetPositionsAndVelocities(own))
            self._first = own, start
        plant_context, start = self._first
        velocity = self.loop.plant.GetVelocities(plant_context)
        square = velocity.dot(velocity)
        if square <= self._least**2:  # surely within
            slow = square <= (_SLOW * self._least) ** 2 and not self.parked
            self._skipped = self._skips if slow else 0
            return True
        if context.get_time() == self._looked:  # once in a step
            return True
        self._looked = context.get_time()
        known = self.loop.split.known_velocities(velocity.reshape(self.copies.number, -1))
        within = np.abs(known).max(axis=1) <= self._bounds  # false for NaN too
        beyond = set(np.flatnonzero(~within).tolist())
        lost = set(np.flatnonzero(~np.isfinite(known).all(axis=1)).tolist())
        due = self._leaving | (beyond & self.parked) | lost
        self.lost |= lost - self.parked
        self._leaving = beyond - self.parked - lost
        self.parked |= beyond
        if len(self.parked) == self.copies.number:
            self.message = "all runs diverge"
            return False
        if due:
            self._park(context, plant_context, start, sorted(due))
        return True

    def check_force(self, context: Context) -> bool:
        """True: failure and divergence are not distinguished, because separate runs follow."""
        return True

    def _park(
        self, context: Context, plant_context: Context, start: np.ndarray, parked: list[int]
    ) -> None:
        plant = self.loop.plant
        rows = self.copies.rows(plant.GetPositionsAndVelocities(plant_context))
        rows[parked] = start[parked]
        plant.SetPositionsAndVelocities(plant_context, self.copies.whole(rows))
        for block in self.loop.blocks.values():
            if hasattr(block, "park"):
                own = block.GetMyMutableContextFromRoot(context)
                for copy in parked:
                    block.park(own, copy)
