"""Detection of divergence during a run, and a run's progress."""

import dataclasses
from collections.abc import Callable

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
        return np.abs(states[..., self._first_velocity :]).max(axis=-1) <= self._bound

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
        """True if the forces of controller and actuators are finite; otherwise as ``check``."""
        ports = map(self.loop.diagram.GetOutputPort, ("generalized_force", "applied_force"))
        return all(self.judge_force(context.get_time(), port.Eval(context)) for port in ports)

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
