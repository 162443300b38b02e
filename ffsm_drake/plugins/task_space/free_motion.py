"""Planned motions of an underactuated spacecraft, by conservation of momentum.

Only the pose of the base is integrated, with the momentum at the start and the nominal payload. Its
velocity follows from that momentum, its acceleration from the equations of motion, so inverse
dynamics of the motion gives no force on undriven coordinates.
"""

import abc
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import quaternion_rate
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.free_floating import FreeFloating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.planned_motion import PlannedMotion

# Evaluations of the rate: at most so many, and for each second; motions of half a minute take
# about 1500, of ten minutes 9000.
_MOST, _MOST_PER_SECOND = 10_000, 100
_LEAST_PART = 1.0  # s, integrated at once
_ROUGH = 1e-2  # largest error of a given step
_SAME = 1e-9  # of a part


class MomentumMotion(PlannedMotion, abc.ABC):
    """A planned motion that is integrated; a subclass gives the driven coordinates' motion."""

    accuracy = 1e-11  # relative tolerance of the integration; the absolute one is a hundredth

    def __init__(
        self,
        *,
        model: PlantModel,
        position: np.ndarray,
        velocity: np.ndarray,
        sample_time: float,
        begin: float = 0.0,
        end: float,
        step: float | None = None,
        marks: Sequence[float] = (),
    ) -> None:
        """Args:
        model: the plant with the nominal payload.
        position: q (nq) at the start.
        velocity: v (nv) at the start; only its momentum matters.
        sample_time: the control period, s.
        begin, end: of the motion, s; see ``PlannedMotion``.
        step: integrate in steps of this duration, s, whose errors are smooth in the motion; None:
          with ``accuracy``.
        marks: times, s, at which derivatives of the driven motion jump, where the integration
          begins anew.
        """
        self._model, self._driven = model, model.coordinates.driven
        self._momentum = self._stack(position).momentum(velocity)
        self._first, self._step, self._part = position, step, step or max(end, _LEAST_PART)
        self._marks = np.asarray(marks)
        # Dense solutions q(t) over one part after the other, as far as needed, and the times at
        # which they end. A part ends at a multiple of its longest duration, or at a mark.
        self._parts, self._ends = list[Any](), list[float]()
        coordinates = model.coordinates
        super().__init__(coordinates=coordinates, sample_time=sample_time, begin=begin, end=end)

    @abc.abstractmethod
    def driven_velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        """v_a (na) at a time, s, in a configuration q (nq)."""

    def velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        """v (nv) at a time, s, in a configuration q (nq)."""
        return self._stack(q).velocity(self.driven_velocity(time, q), self._momentum)

    @abc.abstractmethod
    def driven_motion(
        self, times: np.ndarray, q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Configurations q (n, nq), v_a (n, na) and dv_a/dt (n, na) at times (n,), of integrated
        configurations.
        """

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        times = np.maximum(times, 0.0)
        q, v_a, a_a = self.driven_motion(times, self._integrated(times))
        stack = self._stack(q)
        v = stack.velocity(v_a, self._momentum)
        bias = self._model.calc_bias(q, v)[:, stack.undriven, None]
        own = stack.mass_matrix[:, stack.undriven[:, None], stack.undriven]
        a = np.empty_like(v)
        a[:, stack.driven] = a_a
        a[:, stack.undriven] = (stack.following @ a_a[..., None] - np.linalg.solve(own, bias))[
            ..., 0
        ]
        return np.hstack([q, v, a])

    def _stack(self, q: np.ndarray) -> FreeFloating:
        mass_matrix = self._model.calc_mass_matrix(q)
        return FreeFloating(
            mass_matrix=mass_matrix, base_position=q[..., 4:NUM_BASE_POSITIONS], driven=self._driven
        )

    def _rate(self, time: float, q: np.ndarray) -> np.ndarray:
        """q' (nq) = N(q) v, of all velocities in a closed chain."""
        unit = np.concatenate([q[:4] / np.linalg.norm(q[:4]), q[4:]])
        v = self._model.calc_whole_velocity(unit, self.velocity(time, unit))
        return np.concatenate([quaternion_rate(unit[:4], v[:3]), v[3:]])

    def solve(self) -> Any:
        """Return the dense solution q(t) of the next part."""
        from scipy.integrate import solve_ivp  # slow to load, as below wherever SciPy is used

        begin, first = 0.0, self._first
        if self._parts:
            begin = self._ends[-1]
            first = self._parts[-1](begin)
        end = self._part * (math.floor(begin / self._part + _SAME) + 1)
        end = min([end, *self._marks[self._marks > begin]])
        evaluations, most = 0, _MOST + _MOST_PER_SECOND * self._part

        def beyond(time: float) -> ScenarioError:
            what = f"the motion cannot be integrated beyond t = {time:.3g} s"
            return ScenarioError("reference", f"{what}: it is too fast, or its goal out of reach")

        def rate(time: float, q: np.ndarray) -> np.ndarray:
            nonlocal evaluations
            evaluations += 1
            if evaluations > most:
                raise beyond(time)
            return self._rate(time, q)

        accuracy = self.accuracy if self._step is None else _ROUGH
        found = solve_ivp(
            rate,
            (begin, end),
            first,
            method="DOP853",
            dense_output=True,
            rtol=accuracy,
            atol=0.01 * accuracy,
            first_step=self._step and end - begin,
        )
        if not found.success:
            raise beyond(found.t[-1])
        self._ends.append(end)
        return found.sol

    def _integrated(self, times: np.ndarray) -> np.ndarray:
        """q (n, nq) at times (n,)."""
        while not self._ends or self._ends[-1] < times.max():
            self._parts.append(self.solve())
        part = np.searchsorted(self._ends, times)
        q = np.empty((times.size, self._first.size))
        for i in set(part.tolist()):
            q[part == i] = self._parts[i](times[part == i]).T
        q[:, :4] /= np.linalg.norm(q[:, :4], axis=1, keepdims=True)
        return q


class FreeMotion(MomentumMotion):
    """A planned motion of the driven coordinates; its values for the others are ignored."""

    def __init__(
        self,
        wanted: PlannedMotion,
        *,
        model: PlantModel,
        sample_time: float,
        at_rest: bool = False,
    ) -> None:
        """Args:
        wanted: the motion.
        model: the plant with the nominal payload.
        sample_time: the control period, s.
        at_rest: whether there is no momentum, although splines begin at small rates.
        """
        self.wanted = wanted
        coordinates = model.coordinates
        self._columns = np.concatenate(
            [[0] if coordinates.is_driven[0] else [], coordinates.driven + 1]
        ).astype(int)
        q, v, _ = wanted.evaluate(0.0)
        super().__init__(
            model=model,
            position=q,
            velocity=0.0 * v if at_rest else v,
            sample_time=sample_time,
            begin=wanted.begin,
            end=wanted.end,
        )

    def instants(self, count: int) -> np.ndarray:
        """See PlannedMotion."""
        return self.wanted.instants(count)

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion."""
        return self.wanted.shared(times, found, state)

    def remarks(self) -> list[str]:
        """See PlannedMotion."""
        return self.wanted.remarks()

    def driven_velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        return self.wanted.evaluate(np.array([time]))[1][0, self._driven]

    def driven_motion(
        self, times: np.ndarray, q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        wanted, v, a = self.wanted.evaluate(times)
        q[:, self._columns] = wanted[:, self._columns]
        return q, v[:, self._driven], a[:, self._driven]
