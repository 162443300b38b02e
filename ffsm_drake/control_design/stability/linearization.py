"""The sampled loop as it is wired, linearised: the map from just before one control sample to just
before the next.

All state that feeds back is in it: the plant's (its attitude as a small rotation) with its hidden
coordinates, the controller's and its estimator's, delays, actuators. Its columns are differences on
a context of the closed loop, so every controller, plant, and block with discrete state is covered
without a formula for any of them; a block with other state is refused. What a law holds
(``ControlLaw.held``: gains under adaptation, sign terms) is held. Noise is an input. Limits, which
have no derivative, are left out, and quantisation counts as white noise of its sawtooth's variance.

The update at the sample and the motion up to the next are differenced apart, which is several times
faster: the motion depends only on the plant's state and on the few held values that reach it. Where
a block updates less often than the controller, the map is that of their common period, each kind of
sample in it differenced once.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import RandomSource

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.common.lifetime import untie
from ffsm_drake.common.memo import content_of
from ffsm_drake.common.so3 import rotation_error
from ffsm_drake.control_design.stability.linear_loop import LinearLoop, SampleMap
from ffsm_drake.loop.blocks import parts_of
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.scenario import (
    Actuation,
    Drives,
    Estimator,
    MassProperties,
    PerCoordinate,
    Scenario,
    Sensing,
    from_grasp,
)
from ffsm_drake.spacecraft.coordinates import BASE_ROTATION, NUM_BASE_POSITIONS, position_errors
from ffsm_drake.spacecraft.free_floating import FreeFloating
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.actuation import make_actuation
from ffsm_drake.systems.actuation.drives import FRICTION
from ffsm_drake.systems.actuation.mean import make_mean_base
from ffsm_drake.systems.controllers.estimators import assumed_noise
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.reference import make_motion, timed
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.setup import BlockSetup

# Step of a difference: rad, m, and per s; other states: relative to their size.
_STEP = 1e-7
# Control samples on the plan before the map is taken: by then every memory holds what was measured.
_WARM_UP = 5
# Settings of actuation and drives that have no derivative: the linear loop has their defaults, and
# keeps all others.
NOT_LINEAR = {"actuation": ("limit", "quantization"), "drives": ("rate_limit",)}


class Linearizer:
    """A closed loop that is built once and linearised at many instants, within a ``with`` block."""

    def __init__(self, scenario: Scenario, *, blocks: Mapping[str, Factory] | None = None) -> None:
        """Args: what to build; factories in place of its blocks.

        Errors as for ``add_closed_loop``; BlockError for a block with continuous or abstract state.
        """
        # before the actuators' limits are taken away
        self.given = scenario = timed(from_grasp(scenario))
        if has_base_actuators(scenario):
            blocks = {"actuation": _mean_actuation, **(blocks or {})}
        self.scenario = _without_limits(scenario)
        linear: dict[str, Factory] = {
            name: part.linear() for name, part in parts_of(self.scenario, blocks).items()
        }
        self.loop = make_closed_loop(self.scenario, blocks={**(blocks or {}), **linear})
        diagram, self._plant = self.loop.diagram, self.loop.plant
        self._simulator = Simulator(diagram)
        ApplySimulatorConfig(self.scenario.simulator_config, self._simulator)
        self._context = self._simulator.get_mutable_context()
        self.loop.initialize(diagram, self._context)
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        for leaf in _leaves(diagram):  # what starts at random starts without noise
            if leaf is not self._plant:
                leaf.SetDefaultContext(leaf.GetMyMutableContextFromRoot(self._context))
        self.loop.set_blocks(self._context, self._known_state())
        self._start = self._context.Clone()
        controller = self.loop.blocks["controller"]
        self.law: ControlLaw | None = getattr(controller, "law", None)  # None: it is no law
        self._held: Mapping[str, tuple[int, float | None]] = getattr(
            controller, "held_groups", dict
        )()
        self._controller_context = controller.GetMyMutableContextFromRoot(self._context)
        self._start_of_controller = controller.GetMyContextFromRoot(self._start)
        noise = [leaf for leaf in _leaves(diagram) if isinstance(leaf, RandomSource)]
        # the others only record
        heard = {output[0] for output in diagram.connection_map().values()}
        parts = [part for part in diagram.GetSystems() if part in heard]
        leaves = [leaf for part in parts for leaf in _leaves(part) if leaf not in noise]
        for leaf in leaves:
            known = leaf is self._plant or leaf.get_name() == FRICTION
            if not known and leaf.num_continuous_states() + leaf.num_abstract_states():
                raise BlockError(
                    f"{leaf.get_name()}: continuous or abstract state cannot be "
                    "linearised, only discrete"
                )
        held = {index for index, _ in self._held.values()}
        self._force = controller.GetOutputPort("generalized_force")
        self._noise = _Memory(noise, self._context, sample_time=scenario.sample_time)
        self._memory = _Memory(
            leaves,
            self._context,
            sample_time=scenario.sample_time,
            leave_out=lambda system, group: system is controller and group in held,
        )
        # of the plant's part of x
        self._width = 2 * (len(self.loop.coordinates.names) + len(self.loop.split.names))
        groups: Mapping[str, int] = getattr(controller, "memory_groups", dict)()
        self._parts_of_memory = {
            name: slice(self._width + part.start, self._width + part.stop)
            for name, group in groups.items()
            if (part := self._memory.part_of(controller, group)) is not None
        }
        self.motion = make_motion(self.scenario, self.loop.coordinates)
        self._updates = dict[Hashable, tuple[_Update, ...]]()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        untie(self.loop.diagram)  # which Drake would otherwise keep

    def at(
        self,
        time: float,
        *,
        held: Mapping[str, np.ndarray] | None = None,
        truth: MassProperties | None = None,
    ) -> LinearLoop:
        """The loop near an instant of the planned motion, with the plant on it.

        What the update at the sample does is kept: the same instant with another true payload costs
        only its motion, from where the scenario's own has come by then. At rest that changes a
        spectral radius by about 1e-5.

        Args:
          time: s; a control sample is taken.
          held: of the controller's memory that is held (``ControlLaw.held``), name -> value in
            place of its own.
          truth: of the payload, in place of the scenario's.

        Raises BlockError: a block fails.
        """
        period, first = self.scenario.sample_time, round(time / self.scenario.sample_time)
        index = first + _WARM_UP
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                updates = self._updates_from(first, held or {})
                maps = {update: self._map(update, truth) for update in dict.fromkeys(updates)}
                samples = tuple(maps[update] for update in updates)
        except FfsmError:
            raise
        except (Exception, SystemExit) as error:
            # Drake refuses some numbers that are not finite by SystemExit
            if np.isfinite(self._plant_state()).all():
                reason = f"{type(error).__name__}: {one_line(error)}"
                raise BlockError(
                    f"{self.scenario.controller}: the loop cannot be linearised: {reason}"
                ) from error
            unknown = np.full((self._width,) * 2, np.nan)  # diverged within the warm-up
            samples = (SampleMap(a=unknown, b=unknown, c=unknown, d=unknown),)
        return LinearLoop(
            coordinates=self.loop.coordinates,
            time=index * period,
            sample_time=period,
            samples=samples,
            hidden=self.loop.split.names,
            tracks_frame=self.loop.tracks_frame,
            memory=self._parts_of_memory,
            noise={
                source.get_name(): part
                for source, part in zip(self._noise.systems, self._noise.parts, strict=True)
            },
        )

    def follow(
        self, *, held: Mapping[str, np.ndarray] | None = None, samples: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The run without noise: true error at the samples and force from each to the next (n, nv),
        NaN once it fails.

        Args:
          held: as for ``at``.
          samples: how many from the start; None: all.
        """
        count, nv, period = (
            self.scenario.num_control_periods if samples is None else samples,
            len(self.loop.coordinates.names),
            self.scenario.sample_time,
        )
        states, force = np.full((count, nv + 1), np.nan), np.full((count, nv), np.nan)
        desired = self.motion.rows(np.arange(count) * period)[:, : nv + 1]
        context, simulator = self._start.Clone(), self._simulator
        silent = _silence(self._noise.systems, self.loop.diagram, context)
        if silent:  # as a run goes, which is faster
            simulator = Simulator(self.loop.diagram, context)
            ApplySimulatorConfig(self.scenario.simulator_config, simulator)
            context = simulator.get_mutable_context()
            simulator.Initialize()
        else:
            context = self._context
            context.SetTimeStateAndParametersFrom(self._start)
        plant_context = self._plant.GetMyContextFromRoot(context)
        controller = self.loop.blocks["controller"]
        controller_context = controller.GetMyMutableContextFromRoot(context)
        if isinstance(controller, SampledController):  # no sample counts as a first one here
            controller.remember_velocity(controller_context, self.motion.evaluate(0.0)[1])
        with (
            contextlib.suppress(Exception, SystemExit),
            np.errstate(over="ignore", invalid="ignore"),
        ):
            for index in range(count):
                states[index] = self._known_state(plant_context)[: nv + 1]
                self._hold(controller_context, held or {})
                if silent:
                    simulator.AdvanceTo((index + 1) * period)
                else:
                    self._noise.write(np.zeros(self._noise.size))
                    self._memory.update(index)
                    self._move(index)
                force[index] = self._force.Eval(controller_context)
        return position_errors(desired, states), force

    def _quiet(self, held: Mapping[str, np.ndarray]) -> None:
        """No noise at the next sample, and the controller's held memory at its values."""
        self._noise.write(np.zeros(self._noise.size))
        self._hold(self._controller_context, held)

    def _hold(self, controller_context: Context, held: Mapping[str, np.ndarray]) -> None:
        for name, (group, value) in self._held.items():
            starting = self._start_of_controller.get_discrete_state(group).value()
            given = starting if value is None else np.full_like(starting, value)
            controller_context.SetDiscreteState(group, held.get(name, given))

    def _move(self, index: int) -> None:
        """From just after the update at the control sample ``index`` to just before the next."""
        # past the update: it is not made again
        self._context.SetTime((index + 1e-9) * self.scenario.sample_time)
        self._simulator.Initialize()
        self._simulator.AdvanceTo((index + 1) * self.scenario.sample_time)

    def _updates_from(self, first: int, held: Mapping[str, np.ndarray]) -> tuple["_Update", ...]:
        """The updates of one common period, from the end of a warm-up that begins on the plan at a
        control sample.
        """
        key = content_of((first, held))
        if key not in self._updates:
            self._context.SetTimeStateAndParametersFrom(self._start)
            self._context.SetTime(first * self.scenario.sample_time)
            q_d, v_d, _ = self.motion.evaluate(first * self.scenario.sample_time)
            self.loop.set_state(self._context, np.concatenate([q_d, v_d]))
            index = first + _WARM_UP
            for earlier in range(first, index):
                self._quiet(held)
                self._memory.update(earlier)
                self._move(earlier)
            self._quiet(held)
            before, kinds = self._context.Clone(), dict[Hashable, _Update]()
            indices = range(index, index + self._memory.common_period)
            for each, kind in zip(indices, map(self._memory.kind, indices), strict=True):
                if kind not in kinds:
                    self._context.SetTimeStateAndParametersFrom(before)
                    self._context.SetTime(each * self.scenario.sample_time)
                    kinds[kind] = self._update(each)
            self._updates[key] = tuple(kinds[self._memory.kind(each)] for each in indices)
        return self._updates[key]

    def _update(self, index: int) -> "_Update":
        """The update at the control sample ``index``, which the context stands just before; it is
        made.
        """
        width, memory, state = self._width, self._memory.read(), self._plant_state()
        size = width + memory.size
        parts = [
            *self._memory.parts,
            *(slice(memory.size + p.start, memory.size + p.stop) for p in self._noise.parts),
        ]
        groups = [
            slice(0, width),
            *(slice(width + part.start, width + part.stop) for part in parts),
        ]
        memory_steps = _STEP * np.maximum(1.0, np.abs(memory))
        steps = np.concatenate([np.full(width, _STEP), memory_steps, np.ones(self._noise.size)])
        owner = np.repeat(np.arange(len(groups)), [group.stop - group.start for group in groups])
        written = np.zeros(steps.size)

        def update(x: np.ndarray) -> np.ndarray:
            """The memory after the sample's update; x is followed by the noise.

            Only what differs from the last x is written, so that Drake computes only what depends
            on it.
            """
            for k in set(owner[x != written].tolist()):
                if k == 0:
                    self._set_plant_state(self._moved(state, x[:width]))
                elif k <= len(self._memory.parts):
                    self._memory.write_part(k - 1, memory[parts[k - 1]] + x[groups[k]])
                else:
                    self._noise.write_part(k - 1 - len(self._memory.parts), x[groups[k]])
            written[:] = x
            return self._memory.after(index)

        jacobian = _jacobian(update, groups, steps)
        update(np.zeros(steps.size))
        self._memory.update(index)
        kept = [group for group in groups if group.stop <= size]
        return _Update(
            index=index,
            after=self._context.Clone(),
            groups=kept,
            steps=steps[:size],
            jacobian=jacobian,
        )

    def _map(self, update: "_Update", truth: MassProperties | None) -> SampleMap:
        """The map of a control sample: its update and the motion up to the next."""
        nv, width, size = len(self.loop.coordinates.names), self._width, update.steps.size
        self._context.SetTimeStateAndParametersFrom(update.after)
        if truth is not None:
            self.loop.set_payload(self._context, truth)
        after, state, updated = self._context.Clone(), self._plant_state(), self._memory.read()

        def move(x: np.ndarray) -> np.ndarray:
            """The plant's state at the next sample, and the controller's force until then."""
            self._context.SetTimeStateAndParametersFrom(after)
            self._set_plant_state(self._moved(state, x[:width]))
            self._memory.write(updated + x[width:])
            force = self._force.Eval(self._controller_context).copy()
            self._move(update.index)
            return np.concatenate([self._plant_state(), force])

        base = move(np.zeros(size))
        if not np.array_equal(self._memory.read(), updated):
            raise BlockError(
                "a block updates between two control samples, which cannot be linearised"
            )

        def change(x: np.ndarray) -> np.ndarray:
            reached = move(x)
            return np.concatenate([_difference(reached[:-nv], base[:-nv]), reached[-nv:]])

        motion = _jacobian(change, update.groups, update.steps)
        # From [x; w] to [x+; u], by way of the memory after the update.
        whole = motion[:, width:] @ update.jacobian
        whole[:, :width] += motion[:, :width]
        undriven = np.flatnonzero(~self.loop.coordinates.is_driven)
        whole[:, nv + undriven] = 0.0  # but for rounding
        if not self.loop.tracks_frame:
            whole[:, undriven] = 0.0  # likewise
            whole[undriven, undriven] = 1.0  # their drift adds up
        both = np.vstack([whole[:width], update.jacobian])
        force = whole[width:]
        return SampleMap(a=both[:, :size], b=both[:, size:], c=force[:, :size], d=force[:, size:])

    def _known_state(self, plant_context: Context | None = None) -> np.ndarray:
        """[q; v] of the plant without what is hidden."""
        return self.loop.split.known_part(
            self._plant.GetPositionsAndVelocities(plant_context or self._plant_context)
        ).copy()

    def _plant_state(self) -> np.ndarray:
        """[q; v] of the plant, then its hidden state."""
        whole = self._plant.GetPositionsAndVelocities(self._plant_context)
        return np.concatenate([self._known_state(), self.loop.split.hidden_part(whole)])

    def _set_plant_state(self, state: np.ndarray) -> None:
        known, hidden = np.split(state, [2 * len(self.loop.coordinates.names) + 1])
        self._plant.SetPositionsAndVelocities(
            self._plant_context, self.loop.split.whole(known, hidden)
        )

    def _moved(self, state: np.ndarray, change: np.ndarray) -> np.ndarray:
        """A plant's state moved by e, its rate and the hidden state, the attitude by a rotation
        vector in the world.
        """
        moved, nv = state.copy(), len(self.loop.coordinates.names)
        w, x, y, z = state[:4]
        # small: the quaternion needs no sine, and its norm does not matter
        a, b, c = 0.5 * change[:3]
        moved[:4] += (
            -a * x - b * y - c * z,
            a * w + b * z - c * y,
            b * w + c * x - a * z,
            c * w + a * y - b * x,
        )
        moved[4 : nv + 1] += change[3:nv]
        moved[nv + 1 :] += change[nv:]
        return moved if not self.loop.coordinates.undriven else self._at_same_momentum(moved, state)

    def _at_same_momentum(self, moved: np.ndarray, state: np.ndarray) -> np.ndarray:
        """A plant's state with the undriven coordinates of another: their place, and velocities of
        equal momentum.

        Where a frame is tracked, their place is the state's own.
        """
        coordinates, hidden = self.loop.coordinates, self.loop.split
        nq, model = len(coordinates.position_names), self.loop.model(self._plant_context)
        # of the base, which comes first in every state
        undriven = np.flatnonzero(~coordinates.is_driven)
        places = np.arange(4) if "base_rotation" in coordinates.undriven else np.empty(0, dtype=int)
        places = np.concatenate([places, undriven[undriven >= len(BASE_ROTATION)] + 1])
        result = moved.copy()
        if not self.loop.tracks_frame:  # to which their place is all the same
            result[places] = state[places]

        def whole(known_and_hidden: np.ndarray) -> tuple[FreeFloating, np.ndarray]:
            known, rest = np.split(known_and_hidden, [nq + len(coordinates.names)])
            q, v = np.split(hidden.whole(known, rest), [nq + len(hidden.names)])
            others = np.delete(np.arange(v.size), undriven)
            mass_matrix = model.calc_mass_matrix(q)
            return FreeFloating(
                mass_matrix=mass_matrix, base_position=q[4:NUM_BASE_POSITIONS], driven=others
            ), v

        before, v_before = whole(state)
        after, v = whole(result)
        momentum = before.momentum(v_before)
        change = after.velocity(v[after.driven], momentum) - before.velocity(
            v_before[before.driven], momentum
        )
        # to the last bit as it was without a change
        result[nq + undriven] = state[nq + undriven] + change[undriven]
        return result


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Update:
    """First-order map of a control sample's update, from [x; w], and the state after it."""

    index: int
    after: Context
    groups: Sequence[slice]  # of x: the plant's state, then each group of the memory
    steps: np.ndarray  # of the differences, of x
    jacobian: np.ndarray  # of the memory after it by [x; w]


class _Memory:
    """The discrete state of several systems as one vector; ``parts`` says where each group
    stands.
    """

    def __init__(
        self,
        systems: Sequence[System],
        root_context: Context,
        *,
        sample_time: float,
        leave_out: Callable[[System, int], bool] = lambda system, group: False,
    ) -> None:
        self.systems, self.size, self.parts = systems, 0, list[slice]()
        self._groups: list[tuple[Context, int]] = []
        self._where = dict[tuple[System, int], slice]()
        # with period and offset in control samples
        self._updated: list[tuple[System, Context, float, float]] = []
        # of each of them its groups, and where they stand
        self._parts_of: list[list[tuple[int, slice]]] = []
        # A system may behave differently from sample to sample: it says how by ``phase`` and
        # ``phase_period``.
        self._phased = [system for system in systems if hasattr(system, "phase_period")]
        for system in systems:
            context, parts = (
                system.GetMyMutableContextFromRoot(root_context),
                list[tuple[int, slice]](),
            )
            for group in range(context.num_discrete_state_groups()):
                if not leave_out(system, group):
                    width = context.get_discrete_state(group).size()
                    self._where[system, group] = slice(self.size, self.size + width)
                    parts.append((group, self._where[system, group]))
                    self.size += width
            self.parts += [part for _, part in parts]
            self._groups += [(context, group) for group, _ in parts]
            timing = system.GetUniquePeriodicDiscreteUpdateAttribute()
            if timing is not None:
                period, offset = (
                    timing.period_sec() / sample_time,
                    timing.offset_sec() / sample_time,
                )
                self._updated.append((system, context, period, offset))
                self._parts_of.append(parts)
        periods = [max(1, round(period)) for _, _, period, _ in self._updated]
        self.common_period = math.lcm(*periods, *(system.phase_period for system in self._phased))
        every_sample = all(
            abs(period - 1.0) + abs(offset) < 1e-6 for _, _, period, offset in self._updated
        )
        self._always = (True,) * len(self._updated) if every_sample else ()

    def part_of(self, system: System, group: int) -> slice | None:
        """Where a system's discrete group stands; None where it was left out."""
        return self._where.get((system, group))

    def kind(self, index: int) -> Hashable:
        """Equal for control samples that do the same."""
        return self.which(index), tuple(system.phase(index) for system in self._phased)

    def which(self, index: int) -> tuple[bool, ...]:
        """Which systems update at a control sample."""
        if self._always:
            return self._always
        times = [(index - offset) / period for _, _, period, offset in self._updated]
        return tuple(time > -1e-6 and abs(time - round(time)) < 1e-6 for time in times)

    def update(self, index: int) -> None:
        """Make the update of a control sample, all from the state before it."""
        found = list[tuple[Context, list[np.ndarray]]]()
        for (system, context, _, _), due in zip(self._updated, self.which(index), strict=True):
            if due:
                values = system.EvalUniquePeriodicDiscreteUpdate(context)
                found.append(
                    (
                        context,
                        [values.get_vector(i).value().copy() for i in range(values.num_groups())],
                    )
                )
        for context, groups in found:
            for i, group in enumerate(groups):
                context.SetDiscreteState(i, group)

    def after(self, index: int) -> np.ndarray:
        """What ``read`` would give after the update of a control sample, which is not made."""
        result = self.read()
        for (system, context, _, _), parts, due in zip(
            self._updated, self._parts_of, self.which(index), strict=True
        ):
            if due:
                values = system.EvalUniquePeriodicDiscreteUpdate(context)
                for group, part in parts:
                    result[part] = values.value(group)
        return result

    def read(self) -> np.ndarray:
        return np.concatenate(
            [context.get_discrete_state(group).value() for context, group in self._groups] or [[]]
        )

    def write(self, values: np.ndarray) -> None:
        for (context, group), part in zip(self._groups, self.parts, strict=True):
            context.SetDiscreteState(group, values[part])

    def write_part(self, number: int, values: np.ndarray) -> None:
        context, group = self._groups[number]
        context.SetDiscreteState(group, values)


def has_base_actuators(scenario: Scenario) -> bool:
    """Whether thrusters or wheels of the scenario's own give the base's wrench."""
    actuation = scenario.actuation
    return scenario.blocks.actuation is None and (
        actuation.thrusters is not None or actuation.wheels is not None
    )


def linear_actuation(actuation: Actuation) -> Actuation:
    """The actuators without ``NOT_LINEAR``."""
    drives, plain = actuation.drives, Actuation(drives=Drives())
    if drives is not None:
        changes = {name: getattr(plain.drives, name) for name in NOT_LINEAR["drives"]}
        drives = dataclasses.replace(drives, **changes)
    changes = {name: getattr(plain, name) for name in NOT_LINEAR["actuation"]}
    return dataclasses.replace(actuation, drives=drives, **changes)


def _without_limits(scenario: Scenario) -> Scenario:
    """The scenario without quantisation and without ``NOT_LINEAR``."""
    sensing, estimator = smooth_sensing(scenario), scenario.estimator
    if sensing is not scenario.sensing:  # the estimator goes on to assume what it assumed
        estimator = _with_assumptions(scenario)
    actuation = linear_actuation(scenario.actuation)
    return dataclasses.replace(scenario, sensing=sensing, estimator=estimator, actuation=actuation)


def _mean_actuation(setup: BlockSetup) -> Diagram | None:
    settings, coordinates, period = setup.scenario.actuation, setup.coordinates, setup.sample_time
    base = make_mean_base(settings, coordinates, sample_time=period)
    return make_actuation(settings, coordinates, sample_time=period, base=base)


def smooth_sensing(scenario: Scenario) -> Sensing:
    """The sensors without quantisation, which counts as noise: rounding to a step adds the variance
    of its sawtooth.
    """
    sensing = scenario.sensing
    if not any((*sensing.position_quantization.values(), *sensing.velocity_quantization.values())):
        return sensing
    names = make_nominal_plant(scenario).coordinates

    def noise(part: str) -> PerCoordinate:
        sigma, step = (
            names.vector(getattr(sensing, key), key=f"sensing.{key}", default=0.0)
            for key in (f"{part}_noise", f"{part}_quantization")
        )
        return dict(zip(names.names, np.hypot(sigma, step / math.sqrt(12.0)).tolist(), strict=True))

    return dataclasses.replace(
        sensing,
        position_noise=noise("position"),
        velocity_noise=noise("velocity"),
        position_quantization={},
        velocity_quantization={},
    )


def _with_assumptions(scenario: Scenario) -> Estimator:
    """The estimator with the noises written out that it takes from the sensors."""
    coordinates = make_nominal_plant(scenario).coordinates
    position, velocity = (noise.tolist() for noise in assumed_noise(scenario, coordinates))
    return dataclasses.replace(
        scenario.estimator,
        position_noise=dict(zip(coordinates.names, position, strict=True)),
        velocity_noise=dict(zip(coordinates.names, velocity, strict=True)),
    )


def _jacobian(
    function: Callable[[np.ndarray], np.ndarray], groups: Sequence[slice], steps: np.ndarray
) -> np.ndarray:
    """Differences of a function at zero by ``steps``, without those groups of its argument that do
    not matter to it.
    """
    center = function(np.zeros(steps.size))
    jacobian = np.zeros((center.size, steps.size))
    for group in groups:
        trial = np.zeros(steps.size)
        trial[group] = steps[group] * np.linspace(1.0, 2.0, group.stop - group.start)
        if np.array_equal(function(trial), center):
            continue
        for i in range(group.start, group.stop):
            x = np.zeros(steps.size)
            x[i] = steps[i]
            jacobian[:, i] = (function(x) - center) / steps[i]
    return jacobian


def _silence(sources: Sequence[RandomSource], diagram: Diagram, context: Context) -> bool:
    """Fix what hears the sources to zero. False where that is not seen: an output of a block that
    is noise itself.
    """
    heard = list[System]()
    for part in _diagrams(diagram):
        for (system, number), (source, _) in part.connection_map().items():
            if source in sources:
                port = system.get_input_port(number)
                port.FixValue(system.GetMyMutableContextFromRoot(context), np.zeros(port.size()))
                heard.append(source)
    return all(source in heard for source in sources)


def _diagrams(system: System) -> Iterator[Diagram]:
    if isinstance(system, Diagram):
        yield system
        for part in system.GetSystems():
            yield from _diagrams(part)


def _leaves(system: System) -> Iterator[System]:
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            yield from _leaves(part)
    else:
        yield system


def _difference(state: np.ndarray, base: np.ndarray) -> np.ndarray:
    """The change of e, its rate and the hidden state from ``base`` to ``state``, both [q; v] and
    the hidden state.
    """
    return np.concatenate([rotation_error(state[:4], base[:4]), state[4:] - base[4:]])
