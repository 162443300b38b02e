"""The sampled loop as it is wired, linearised: the map from just before one control sample to just before the next.

All state that feeds back is in it: the plant's (its attitude as a small rotation), the controller's and its
estimator's, delays, actuators. Its columns are differences on a context of the closed loop, so every controller, plant,
and block with discrete state of the control period is covered without a formula for any of them; a block with other
state is refused. What a law holds (``ControlLaw.held``: gains under adaptation, sign terms) is held. Noise is off;
quantisation and limits, which have no derivative, are left out.

The update at the sample and the motion up to the next are differenced apart, which is several times faster: the motion
depends only on the plant's state and on the few held values that reach it.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import RandomSource

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.common.lifetime import untie
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.scenario import Actuation, PerCoordinate, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, rotation_error
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import Factory

# Of a difference: rad, m, and per s; of other states relative to their size.
_STEP = 1e-7
# Control samples on the plan before the map is taken: by then every memory holds what was measured.
_WARM_UP = 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mode:
    """A mode of the loop: a real pole, or a conjugate pair."""

    pole: complex  # z, per control sample; of a pair the one with the positive imaginary part
    frequency: float  # rad/s, natural
    damping: float  # ratio; negative where the mode grows
    coordinates: PerCoordinate  # coordinate -> share of the plant's motion in the mode, largest first


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LinearLoop:
    """x+ = A x near one instant of the planned motion; x begins with the plant's e and its rate (2 nv)."""

    coordinates: Coordinates
    time: float  # s
    sample_time: float  # s
    a: np.ndarray

    @property
    def poles(self) -> np.ndarray:
        """Poles of what feeds back, per control sample, the largest first; one infinite where A is not finite."""
        return self._eigen[0]

    @property
    def spectral_radius(self) -> float:
        """Largest pole magnitude; the loop is stable below 1."""
        return float(np.abs(self.poles[0]))

    def modes(self, count: int = 6) -> list[Mode]:
        """The slowest modes, those that grow first."""
        names, found = self.coordinates.names, list[Mode]()
        if not np.isfinite(self.poles).all():
            return found
        for pole, vector in zip(self.poles.tolist(), self._eigen[1].T, strict=True):
            if pole.imag < 0.0 or abs(pole) < 1e-6 or len(found) == count:
                continue
            exponent = np.log(complex(pole)) / self.sample_time
            weight = np.abs(vector[: len(names)])
            share = weight / weight.sum()
            found.append(
                Mode(
                    pole=complex(pole),
                    frequency=float(abs(exponent)),
                    damping=float(-exponent.real / abs(exponent)) if exponent else 0.0,
                    coordinates={names[i]: float(share[i]) for i in np.argsort(-share, kind="stable")},
                )
            )
        return found

    @functools.cached_property
    def _eigen(self) -> tuple[np.ndarray, np.ndarray]:
        """Poles, largest first, and right eigenvectors of the part of the loop that feeds back."""
        if not np.isfinite(self.a).all():
            return np.full(1, np.inf), np.ones((len(self.a), 1))
        keep = self._feeds_back()
        poles, vectors = np.linalg.eig(self.a[np.ix_(keep, keep)])
        order = np.argsort(-np.abs(poles), kind="stable")
        return poles[order], vectors[:, order]

    def _feeds_back(self) -> np.ndarray:
        """Mask of the entries of x that act on the plant and that the plant acts on."""
        arrows = self.a != 0.0
        acting = np.zeros(len(arrows), dtype=bool)
        acting[: 2 * len(self.coordinates.names)] = True
        driven = acting
        for _ in range(len(arrows)):
            acting, driven = acting | (arrows[acting].any(axis=0)), driven | (arrows[:, driven].any(axis=1))
        return acting & driven


class Linearizer:
    """A closed loop that is built once and linearised at many instants, within a ``with`` block."""

    def __init__(self, scenario: Scenario, *, blocks: Mapping[str, Factory] | None = None) -> None:
        """Args: what to build; factories in place of its blocks.

        Errors as for ``add_closed_loop``; BlockError for a block with continuous or abstract state.
        """
        sensing = dataclasses.replace(scenario.sensing, position_quantization={}, velocity_quantization={})
        actuation = Actuation(delay=scenario.actuation.delay)
        self.scenario = dataclasses.replace(scenario, sensing=sensing, actuation=actuation)
        self.loop = make_closed_loop(self.scenario, blocks=blocks)
        diagram, self._plant = self.loop.diagram, self.loop.plant
        self._simulator = Simulator(diagram)
        ApplySimulatorConfig(self.scenario.simulator_config, self._simulator)
        self._context = self._simulator.get_mutable_context()
        self.loop.initialize(diagram, self._context)
        self._start = self._context.Clone()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        controller = self.loop.blocks["controller"]
        self._held: Mapping[str, tuple[int, float | None]] = getattr(controller, "held_groups", dict)()
        self._controller_context = controller.GetMyMutableContextFromRoot(self._context)
        self._start_of_controller = controller.GetMyContextFromRoot(self._start)
        noise = [leaf for leaf in _leaves(diagram) if isinstance(leaf, RandomSource)]
        heard = {output[0] for output in diagram.connection_map().values()}  # the others only record
        parts = [part for part in diagram.GetSystems() if part in heard]
        leaves = [leaf for part in parts for leaf in _leaves(part) if leaf not in noise]
        for leaf in leaves:
            if leaf is not self._plant and leaf.num_continuous_states() + leaf.num_abstract_states():
                raise BlockError(f"{leaf.get_name()}: continuous or abstract state cannot be linearised, only discrete")
        held = {index for index, _ in self._held.values()}
        self._noise = _Memory(noise, self._context)
        self._memory = _Memory(
            leaves, self._context, leave_out=lambda system, group: system is controller and group in held
        )
        self._motion = make_motion(self.scenario, self.loop.coordinates)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        untie(self.loop.diagram)  # which Drake would otherwise keep

    def at(self, time: float, *, held: Mapping[str, np.ndarray] | None = None) -> LinearLoop:
        """The loop near an instant of the planned motion, with the plant on it.

        Args:
          time: s; a control sample is taken.
          held: of the controller's memory that is held (``ControlLaw.held``), name -> value in place of its own.

        Raises BlockError: a block fails.
        """
        period, first = self.scenario.sample_time, round(time / self.scenario.sample_time)
        held = held or {}
        self._context.SetTimeStateAndParametersFrom(self._start)
        self._context.SetTime(first * period)
        q_d, v_d, _ = self._motion.evaluate(first * period)
        state = np.concatenate([q_d, v_d])
        self._plant.SetPositionsAndVelocities(self._plant_context, state)
        for block in self.loop.blocks.values():
            if hasattr(block, "set_initial_state"):
                block.set_initial_state(block.GetMyMutableContextFromRoot(self._context), state)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                for index in range(first, first + _WARM_UP):
                    self._quiet(held)
                    self._simulator.Initialize()
                    self._simulator.AdvanceTo((index + 1) * period)
                self._quiet(held)
                a = self._map(first + _WARM_UP)
        except FfsmError:
            raise
        except (Exception, SystemExit) as error:  # Drake refuses some numbers that are not finite by SystemExit
            if np.isfinite(self._plant_state()).all():
                reason = f"{type(error).__name__}: {one_line(error)}"
                raise BlockError(f"{self.scenario.controller}: the loop cannot be linearised: {reason}") from error
            a = np.full((2 * len(self.loop.coordinates.names),) * 2, np.nan)  # diverged within the warm-up
        return LinearLoop(coordinates=self.loop.coordinates, time=(first + _WARM_UP) * period, sample_time=period, a=a)

    def _quiet(self, held: Mapping[str, np.ndarray]) -> None:
        """No noise at the next sample, and the controller's held memory at its values."""
        self._noise.write(np.zeros(self._noise.size))
        for name, (group, value) in self._held.items():
            starting = self._start_of_controller.get_discrete_state(group).value()
            given = starting if value is None else np.full_like(starting, value)
            self._controller_context.SetDiscreteState(group, held.get(name, given))

    def _map(self, index: int) -> np.ndarray:
        """A at the control sample ``index``, which the context stands just before."""
        period, nv = self.scenario.sample_time, len(self.loop.coordinates.names)
        before, state = self._context.Clone(), self._plant_state()
        memory = self._memory.read()
        size = 2 * nv + memory.size

        def update(x: np.ndarray) -> np.ndarray:
            """The memory after the sample's update."""
            self._context.SetTimeStateAndParametersFrom(before)
            self._plant.SetPositionsAndVelocities(self._plant_context, _moved(state, x[: 2 * nv]))
            self._memory.write(memory + x[2 * nv :])
            self._simulator.Initialize()
            self._simulator.AdvancePendingEvents()
            return self._memory.read()

        updated = update(np.zeros(size))
        self._context.SetTime((index + 1e-9) * period)  # past the update, so that it is not made again
        after = self._context.Clone()

        def move(x: np.ndarray) -> np.ndarray:
            """[q; v] of the plant at the next sample."""
            self._context.SetTimeStateAndParametersFrom(after)
            self._plant.SetPositionsAndVelocities(self._plant_context, _moved(state, x[: 2 * nv]))
            self._memory.write(updated + x[2 * nv :])
            self._simulator.Initialize()
            self._simulator.AdvanceTo((index + 1) * period)
            return self._plant_state()

        steps = np.concatenate([np.full(2 * nv, _STEP), _STEP * np.maximum(1.0, np.abs(memory))])
        groups = [slice(0, 2 * nv), *(slice(2 * nv + part.start, 2 * nv + part.stop) for part in self._memory.parts)]

        def derivative(function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
            center = function(np.zeros(size))
            jacobian = np.zeros((center.size, size))
            for group in groups:
                trial = np.zeros(size)
                trial[group] = steps[group] * np.linspace(1.0, 2.0, group.stop - group.start)
                if np.array_equal(function(trial), center):
                    continue  # a group that does not matter to it
                for i in range(group.start, group.stop):
                    x = np.zeros(size)
                    x[i] = steps[i]
                    jacobian[:, i] = (function(x) - center) / steps[i]
            return jacobian

        base = move(np.zeros(size))
        if not np.array_equal(self._memory.read(), updated):
            raise BlockError("a block updates between two control samples, which cannot be linearised")
        of_plant, of_memory = derivative(lambda x: _difference(move(x), base)), derivative(update)
        a = np.empty((size, size))
        a[: 2 * nv] = of_plant[:, 2 * nv :] @ of_memory
        a[: 2 * nv, : 2 * nv] += of_plant[:, : 2 * nv]
        a[2 * nv :] = of_memory
        return a

    def _plant_state(self) -> np.ndarray:
        state: np.ndarray = self._plant.GetPositionsAndVelocities(self._plant_context).copy()
        return state


class _Memory:
    """The discrete state of several systems as one vector; ``parts`` says where each group stands."""

    def __init__(
        self,
        systems: Sequence[System],
        root_context: Context,
        *,
        leave_out: Callable[[System, int], bool] = lambda system, group: False,
    ) -> None:
        self.size, self.parts = 0, list[slice]()
        self._groups: list[tuple[Context, int]] = []
        for system in systems:
            context = system.GetMyMutableContextFromRoot(root_context)
            for group in range(context.num_discrete_state_groups()):
                if not leave_out(system, group):
                    width = context.get_discrete_state(group).size()
                    self._groups.append((context, group))
                    self.parts.append(slice(self.size, self.size + width))
                    self.size += width

    def read(self) -> np.ndarray:
        return np.concatenate([context.get_discrete_state(group).value() for context, group in self._groups] or [[]])

    def write(self, values: np.ndarray) -> None:
        for (context, group), part in zip(self._groups, self.parts, strict=True):
            context.SetDiscreteState(group, values[part])


def _leaves(system: System) -> Iterator[System]:
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            yield from _leaves(part)
    else:
        yield system


def _moved(state: np.ndarray, change: np.ndarray) -> np.ndarray:
    """[q; v] moved by e and its rate (2 nv), the attitude by a rotation vector in the world frame."""
    moved, nv = state.copy(), change.size // 2
    w, x, y, z = state[:4]
    a, b, c = 0.5 * change[:3]  # small: the quaternion needs no sine, and its norm does not matter
    moved[:4] += (-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x)
    moved[4 : nv + 1] += change[3:nv]
    moved[nv + 1 :] += change[nv:]
    return moved


def _difference(state: np.ndarray, base: np.ndarray) -> np.ndarray:
    """The change of e and its rate (2 nv) from ``base`` to ``state``, both [q; v]."""
    return np.concatenate([rotation_error(state[:4], base[:4]), state[4:] - base[4:]])
