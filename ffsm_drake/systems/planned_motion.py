"""A planned motion as a function of time."""

import abc
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE
from ffsm_drake.spacecraft.nominal import PlantModel

# control samples computed together: NumPy takes little longer for them than for one; fewer after a
# jump, as those of a linearisation at an instant
_BLOCK, _AFTER_JUMP = 256, 8
# Rows (n, 19) of a frame, from rows of the coordinates.
Moved = Callable[[np.ndarray], np.ndarray]


class Path(Protocol):
    """A curve that ends at rest."""

    @property
    def end(self) -> float:
        """Time at which it comes to rest, s."""

    def rows(self, times: np.ndarray) -> np.ndarray:
        """Its rows (n, size) at times (n,), s."""


class PlannedMotion(abc.ABC):
    """A planned motion as a function of time; a subclass gives ``rows``."""

    path: Path | None = None  # of a frame that it moves

    def __init__(
        self, *, coordinates: Coordinates, sample_time: float, begin: float = 0.0, end: float
    ) -> None:
        """Args: coordinates; control period, s; start and end of the motion after the grasp, s.

        At multiples of ``sample_time`` the motion is read from a precomputed block.
        """
        self.coordinates, self.begin, self.end = coordinates, begin, end
        self._sample_time = sample_time
        # A cache: the motion at the control samples from self._first_sample on.
        self._first_sample = 0
        self._rows = np.empty((0, 0))

    @abc.abstractmethod
    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""

    def frame_rows(self, times: np.ndarray, moved: Moved) -> np.ndarray:
        """Rows (n, 19) of a frame: of the path that this motion follows, or as it moves a frame."""
        return moved(self.rows(times)) if self.path is None else self.path.rows(times)

    def remarks(self) -> list[str]:
        """Deviations of the motion from its specification, a line each."""
        return []

    def instants(self, count: int) -> np.ndarray:
        """Times (n,), s, at which to compare the motion with limits, at least as many as given."""
        return np.linspace(self.begin, self.end, count)

    def demand(
        self, model: PlantModel, times: np.ndarray, push: np.ndarray | float = 0.0
    ) -> dict[str, np.ndarray]:
        """Values (n, k) of what has limits, by quantity, at times (n,) under perfect tracking.

        Args: the plant with its payload; times, s; other forces (n, nv) that act.
        """
        q, v, a = self.evaluate(times)
        force = model.calc_tracking_force(q, v, a) - push
        return self.shared(times, {POSITION: q[:, 1:], RATE: v, FORCE: force}, (q, v, a))

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """``demand`` of the tree, with what the loops of a closed chain change, where the whole
        moves as q, v, a (n, ...).
        """
        return found

    def part(self, share: float) -> float:
        """Time at which a fraction (0 to 1) of the motion with the target held has passed, s."""
        return self.begin + share * (self.end - self.begin)

    def evaluate(self, time: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q_d (..., nq), v_d (..., nv) and dv_d/dt (..., nv) at a time in s, or at times (n,)."""
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        rows = self.rows(time) if isinstance(time, np.ndarray) else self.row(time).copy()
        q_d, v_d, a_d = np.split(rows, [nq, nq + nv], axis=-1)
        return q_d, v_d, a_d

    def row(self, time: float) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (nq + 2 nv) at a time in s; must not be changed in place."""
        sample = round(time / self._sample_time)
        if sample * self._sample_time != time:  # between the control samples
            return self.rows(np.array([time]))[0]
        if not 0 <= sample - self._first_sample < len(self._rows):
            goes_on = sample == self._first_sample + len(self._rows)
            count = _BLOCK if goes_on else _AFTER_JUMP
            self._first_sample = sample
            self._rows = self.rows(self._sample_time * np.arange(sample, sample + count))
        return self._rows[sample - self._first_sample]


class PathMotion(PlannedMotion):
    """The motion along a path."""

    def __init__(self, path: Path, *, coordinates: Coordinates, sample_time: float) -> None:
        """Args: the path; names of the generalized velocities; the control period, s."""
        self._path = path
        super().__init__(coordinates=coordinates, sample_time=sample_time, end=path.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """The rows of the path at times (n,)."""
        return self._path.rows(times)


class InTurn(PlannedMotion):
    """Motions that begin at given times of the run, each where the one before it ends."""

    def __init__(
        self,
        motions: Sequence[tuple[float, PlannedMotion]],
        *,
        begin: float,
        end: float,
        sample_time: float,
    ) -> None:
        self._motions, coordinates = motions, motions[-1][1].coordinates
        super().__init__(coordinates=coordinates, sample_time=sample_time, begin=begin, end=end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        return self._in_turn(times, lambda motion, own: motion.rows(own))

    def frame_rows(self, times: np.ndarray, moved: Moved) -> np.ndarray:
        """See PlannedMotion."""
        return self._in_turn(times, lambda motion, own: motion.frame_rows(own, moved))

    def _in_turn(
        self, times: np.ndarray, of: Callable[[PlannedMotion, np.ndarray], np.ndarray]
    ) -> np.ndarray:
        (first, motion), *later = self._motions
        rows = of(motion, times - first)
        for begin, motion in later:
            rows = np.where((times > begin - 1e-9)[:, None], of(motion, times - begin), rows)
        return rows

    def remarks(self) -> list[str]:
        """See PlannedMotion: of the last motion."""
        return self._motions[-1][1].remarks()

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion: the target is held in the last motion."""
        begin, last = self._motions[-1]
        return last.shared(times - begin, found, state)
