"""Thrusters and wheels in the closed loop: they give the base's force and torque."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    InputPort,
    LeafSystem,
)
from pydrake.systems.primitives import Demultiplexer

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.products import times
from ffsm_drake.plugins.actuators.thrusters import (
    Firing,
    ThrusterMemory,
    ThrusterSet,
    gains_and_floors,
)
from ffsm_drake.plugins.actuators.wheels import Gyroscopic, WheelSet
from ffsm_drake.scenario import Fault
from ffsm_drake.spacecraft.coordinates import Coordinates

# Control samples in which wheels recover the torque impulse of pulses beyond their capability.
# Commands beyond their limits are not recovered: the controller reads applied_force and repeats
# them.
_RECOVERY = 10
Hit = tuple[str, Fault, int]  # unit, fault, first control sample of the fault
# Codes of fault detection for a thruster or wheel: it is off and gets no command (a thruster's
# upstream valve is shut); a thruster stays open.
LOST, STUCK_ON = 1.0, 2.0
_LARGEST = 1e300  # N m and N; products of larger numbers overflow


_Working = tuple[ThrusterSet | None, WheelSet | None, bool]


class BaseActuators(LeafSystem):
    """Thrusters, wheels or both: they provide the base's wrench; other forces pass unchanged.

    Wheels provide torque; thrusters provide force, unload the wheels and may help them. Without
    wheels, thrusters provide torque too; without thrusters, force acts as commanded. In each sample
    the wheels counter the torque of the thrusters' pulses. Inputs:
      commanded_force: (nv), the base's torque and force in world axes.
      state: [q; v] of the plant (nq + nv).
      stored_momentum: with wheels only, their integrated momentum in world axes (3), N m s.
      isolated: with detection only, 0, ``LOST`` or ``STUCK_ON`` for each thruster, then wheel.
    Output (changes at control samples only):
      sample: stacked by ``sizes``, each for copy after copy of the spacecraft:
        applied_force (nv), with the mean wrench of thrusters and wheels over the sample, in world
          axes, without the wheels' gyroscopic torque;
        with n thrusters thruster_force (n), the mean force of each, N; thruster_open (n), the open
          share of the sample for each; thruster_given (1), the part of the commanded wrench given
          by the last allocation;
        with n wheels wheel_momentum (n), about the axes at the sample's start, N m s; wheel_torque
          (n), of the motors, N m; wheel_unloads (1), whether thrusters unload them; wheel_reaction
          (3), the wheels' part of applied_force's torque;
        with faults or detection told_force (nv), the reported force (undetected faults not
          included); told_units, the reported force of each thruster, N, and torque on each
          wheel, N m;
        memory, for the next update.
    With faults the discrete state has ``gains_and_floors``, and 1 for each stopped wheel; with
    detection also ``isolated``.
    The base turns within a sample. Its attitude at the middle, extrapolated with the angular
    velocity at the start, is held; the relative error of a body-fixed impulse is then
    (w L)^2 / 24. Discrete state, updated every control sample: R_WB at its middle (9), whether a
    frame begins (1), w_WB in the base's axes and the reaction missing from the wheels' integrated
    momentum (6); for wheels the missing impulse of torque (3, world axes, N m s), their momentum
    (n), and whether thrusters unload them and motors rearrange it (2); for thrusters the impulse
    requested but not fired (6, world axes, N m s and N s), and ThrusterMemory.
    """

    def __init__(
        self,
        thrusters: ThrusterSet | None,
        wheels: WheelSet | None,
        coordinates: Coordinates,
        *,
        sample_time: float,
        copies: int = 1,
        faults: Sequence[Hit] = (),
        detects: bool = False,
    ) -> None:
        super().__init__()
        # for one spacecraft, vectors are faster than rows
        self._rows = (copies, -1) if copies > 1 else (-1,)
        self.thrusters, self.wheels, self._sample_time = thrusters, wheels, sample_time
        # control samples from one allocation to the next
        self.frame = 1 if thrusters is None else thrusters.settings.frame
        nv = len(coordinates.names)
        initial = list[np.ndarray]()
        self.sizes = {"applied_force": nv}
        if wheels is not None:
            initial += [np.zeros(3), wheels.initial_momentum, np.zeros(2)]
        if thrusters is not None:
            count = len(thrusters.names)
            self.sizes |= {"thruster_force": count, "thruster_open": count, "thruster_given": 1}
            initial += [np.zeros(6), thrusters.initial_memory().packed()]
        if wheels is not None:
            count = len(wheels.names)
            self.sizes |= {
                "wheel_momentum": count,
                "wheel_torque": count,
                "wheel_unloads": 1,
                "wheel_reaction": 3,
            }
            self._stored = self.DeclareVectorInputPort("stored_momentum", 3 * copies)
        self._faults, self._may_break = faults, detects or bool(faults)
        if self._may_break:
            self.units = [name for each in (thrusters, wheels) if each for name in each.names]
            self.sizes |= {"told_force": nv, "told_units": len(self.units)}
            self._broken = self.DeclareDiscreteState(self._faults_at(-1))
        self._told: InputPort | None = None
        if detects:
            self._told = self.DeclareVectorInputPort("isolated", len(self.units))
            self._isolated = self.DeclareDiscreteState(len(self.units))
            self._without = dict[bytes, _Working]()
        self.initial_memory = memory = np.concatenate([np.empty(0), *initial])
        self.sizes["memory"] = memory.size
        ends = np.cumsum([0, *(each.size for each in initial)]).tolist()
        self._parts = list(itertools.starmap(slice, itertools.pairwise(ends)))
        self._commanded = self.DeclareVectorInputPort("commanded_force", copies * nv)
        self._state = self.DeclareVectorInputPort("state", copies * (2 * nv + 1))
        self._rotation = self.DeclareDiscreteState(np.tile(np.eye(3).ravel(), copies))
        self._begins = self.DeclareDiscreteState(np.zeros(1))
        self._turning = self.DeclareDiscreteState(np.zeros(6 * copies))
        self._memory = self.DeclareDiscreteState(np.tile(memory, copies))
        size = sum(self.sizes.values())
        self._by_name = _part_after_part(list(self.sizes.values()), copies)
        # Not on the plant's state: while the command is held, the integrator's stages read the
        # cached value.
        depends = {self.input_port_ticket(self._commanded.get_index()), self.xd_ticket()}
        self._sample = self.DeclareVectorOutputPort(
            "sample", copies * size, weak_callback(self._calc), depends
        )
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def give(
        self,
        commanded: np.ndarray,
        memory: np.ndarray,
        *,
        rotation: np.ndarray,
        turning: np.ndarray,
        begins: bool,
        broken: np.ndarray | None = None,
        isolated: np.ndarray | None = None,
    ) -> np.ndarray:
        """The output ``sample`` (...), a row for each copy, as a pure function of the command
        (..., nv) and of the discrete state: ``memory`` (...), ``rotation`` (..., 3, 3),
        ``turning`` (..., 6), ``begins``, with faults ``broken``, with detection ``isolated``.

        Commands beyond ``_LARGEST`` give NaN, which marks the run as diverged.
        """
        commanded = np.where(np.abs(commanded) < _LARGEST, commanded, np.nan)
        thrusters, wheels = self.thrusters, self.wheels
        if isolated is not None and isolated.any():
            thrusters, wheels, _ = self.without(isolated)
        # torque, force in the base's axes
        wanted = np.matmul(commanded[..., :6].reshape(*commanded.shape[:-1], 2, 3), rotation)
        asked = wanted.copy()  # requested from the thrusters
        memories = iter([memory[..., part] for part in self._parts])
        parts, kept, told_units = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        applied = commanded.copy()
        if wheels is not None:
            short, momentum, held = next(memories), next(memories), next(memories) > 0.0
            unloads, rearranges = held[..., :1], held[..., 1:]
            w_WB, missing = turning[..., :3], turning[..., 3:]
            recovered = times(rotation.swapaxes(-1, -2), short)
            wanted[..., 0, :] += recovered / (_RECOVERY * self._sample_time)
            if begins:
                unloads = wheels.unloads(unloads, momentum, w_WB)
            asked[..., 0, :] = wheels.assist_torque(wanted[..., 0, :])
            if unloads.any():
                asked[..., 0, :] += np.where(unloads, wheels.unloading_torque(momentum), 0.0)
        told = applied
        if thrusters is not None:
            owed, memory = next(memories), next(memories)
            firing, kept = self._fire(thrusters, asked, owed, memory, rotation, begins=begins)
            force, fired = firing.force, firing.wrench.reshape(wanted.shape)
            applied[..., :6] = _turned_back(fired, rotation)
            if broken is not None:
                told = applied.copy()
                told_units.append(firing.force)
                gain, floor = broken[: 2 * len(thrusters.names)].reshape(2, -1)
                force = np.maximum(gain * firing.level, floor) * thrusters.force
                really = times(thrusters.wrenches, force).reshape(wanted.shape)
                applied[..., :6] = _turned_back(really, rotation)
            parts += [force, firing.open_share, firing.given]
            wanted[..., 0, :] -= fired[..., 0, :]
        elif broken is not None:
            told = applied.copy()
        if wheels is not None:
            rearranges, rearranging = wheels.rearranges(rearranges, momentum, w_WB), None
            if rearranges.any():
                rearranging = np.where(rearranges, wheels.rearranging_torque(momentum), 0.0)
            torques = wheels.give(wanted[..., 0, :], momentum, w_WB, rearranging=rearranging)
            by_wheels = times(rotation, torques.on_base) + missing
            if broken is not None:
                told[..., :3] = by_wheels + (0.0 if thrusters is None else told[..., :3])
                told_units.append(torques.on_wheels)
                torques = wheels.stopping(torques, broken[-len(wheels.names) :], momentum, w_WB)
                by_wheels = times(rotation, torques.on_base) + missing
            applied[..., :3] = by_wheels + (0.0 if thrusters is None else applied[..., :3])
            parts += [momentum, torques.motor, unloads * 1.0, by_wheels]
            # The missing part has already been given, in a held direction.
            given = told[..., :3] - missing
            left = short + (commanded[..., :3] - given) * self._sample_time
            momentum = momentum + torques.on_wheels * self._sample_time
            both = np.concatenate([unloads, rearranges], axis=-1) * 1.0
            kept = [wheels.bounded(left, _RECOVERY), momentum, both, *kept]
        if broken is not None:
            parts += [told, *told_units]
        return np.concatenate([applied, *parts, *kept], axis=-1)

    def _fire(
        self,
        thrusters: ThrusterSet,
        asked: np.ndarray,
        owed: np.ndarray,
        memory: np.ndarray,
        rotation: np.ndarray,
        *,
        begins: bool,
    ) -> tuple[Firing, list[np.ndarray]]:
        """Fire thrusters for the requested torque and force (..., 2, 3, the base's axes), with the
        owed impulse; also returns the memory.
        """
        fuel = ThrusterMemory.unpacked(memory)
        if begins:
            in_base = np.matmul(owed.reshape(asked.shape), rotation)
            with_owed = asked + in_base / thrusters.frame
            fuel = thrusters.allocate(with_owed.reshape(owed.shape), fuel)
            if (fuel.given < 1.0).any():  # the rest is given up
                all_owed = _turned_back(with_owed, rotation)
                rest = (1.0 - fuel.given) * thrusters.frame * all_owed
                owed = np.where(fuel.given < 1.0, owed - rest, owed)
        firing, fuel = thrusters.fire(fuel)
        if thrusters.carries_over:
            left = asked - firing.wrench.reshape(asked.shape)
            owed = owed + _turned_back(left, rotation) * self._sample_time
        return firing, [owed, fuel.packed()]

    def without(self, isolated: np.ndarray) -> "_Working":
        """Thrusters and wheels (None: none) for the allocation without what is ``isolated``, and
        whether they give every wrench; those without none where they do not.
        """
        key = isolated.tobytes()
        if key not in self._without:
            self._without[key] = self._make_without(isolated)
        return self._without[key]

    def _make_without(self, isolated: np.ndarray) -> "_Working":
        thrusters, wheels, step = self.thrusters, self.wheels, self._sample_time
        count, alone = 0 if thrusters is None else len(thrusters.names), thrusters is None
        try:
            if thrusters is not None and isolated[:count].any():
                failures = dict(thrusters.settings.failures)
                for name, told in zip(thrusters.names, isolated[:count], strict=True):
                    if told:
                        failures[name] = "stuck_on" if told == STUCK_ON else "stuck_off"
                settings = dataclasses.replace(thrusters.settings, failures=failures)
                thrusters = ThrusterSet(settings, sample_time=step)
            if wheels is not None and isolated[count:].any():
                told_of_wheels = zip(wheels.names, isolated[count:], strict=True)
                lost = [name for name, told in told_of_wheels if told]
                wheels = WheelSet(wheels.settings, sample_time=step, alone=alone, lost=lost)
        except ScenarioError:
            return self.thrusters, self.wheels, False
        return thrusters, wheels, True

    def _faults_at(self, sample: int) -> np.ndarray:
        """Gains, floors, stopped wheels at a control sample."""
        there = [(name, fault) for name, fault, since in self._faults if sample >= since]
        thrusters, wheels = (
            () if each is None else each.names for each in (self.thrusters, self.wheels)
        )
        of_thrusters = gains_and_floors(thrusters, [e for e in there if e[1].kind != "stops"])
        stopped = {name for name, fault in there if fault.kind == "stops"}
        return np.concatenate([*of_thrusters, [float(name in stopped) for name in wheels]])

    def _calc(self, context: Context, output: BasicVector) -> None:
        value, rows = context.get_discrete_state().value, self._rows
        sample = self.give(
            self._commanded.Eval(context).reshape(rows),
            value(self._memory).reshape(rows),
            rotation=value(self._rotation).reshape(*self._rows[:-1], 3, 3),
            turning=value(self._turning).reshape(rows),
            begins=bool(value(self._begins).item()),
            broken=value(self._broken) if self._may_break else None,
            isolated=None if self._told is None else value(self._isolated),
        )
        output.SetFromVector(sample.ravel()[self._by_name])

    def _update(self, context: Context, values: DiscreteValues) -> None:
        sample, rows = round(context.get_time() / self._sample_time), self._rows
        memory = context.get_discrete_state().value(self._memory)
        if sample > 0:
            memory = self._sample.Eval(context)[-memory.size :]
            values.set_value(self._memory, memory)
        if self._may_break:
            broken = self._faults_at(sample)
            if self._told is not None:
                isolated = self._told.Eval(context)
                values.set_value(self._isolated, isolated)
                if self.thrusters is not None:  # a shut valve lets nothing through
                    count = len(self.thrusters.names)
                    broken[: 2 * count] *= np.tile(isolated[:count] != LOST, 2)
            values.set_value(self._broken, broken)
        if self.thrusters is not None:
            values.set_value(self._begins, [float(sample % self.frame == 0)])
        state, nv = self._state.Eval(context).reshape(rows), self.sizes["applied_force"]
        quaternion, w_WB = state[..., :4], state[..., nv + 1 : nv + 4]
        ahead = attitude_ahead(quaternion, w_WB, self._sample_time / 2.0)
        values.set_value(self._rotation, ahead.ravel())
        if self.wheels is not None:
            now = attitude_ahead(quaternion, w_WB, 0.0).reshape(*rows[:-1], 3, 3)
            in_base = times(self.wheels.axes, memory.reshape(rows)[..., self._parts[1]])
            # The held direction of the torque, and the integrator, leave a little between the two.
            missing = self._stored.Eval(context).reshape(rows) - times(now, in_base)
            turning = [times(now.swapaxes(-1, -2), w_WB), missing / self._sample_time]
            values.set_value(self._turning, np.concatenate(turning, axis=-1).ravel())


def _turned_back(wrench: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Torque and force (..., 2, 3) of the base's axes in the world's, in a row (..., 6)."""
    in_world: np.ndarray = np.matmul(wrench, rotation.swapaxes(-1, -2))
    return in_world.reshape(*wrench.shape[:-2], 6)


def _part_after_part(sizes: list[int], copies: int) -> np.ndarray:
    """For rows of copies with parts of these sizes: the entries part after part."""
    rows = np.arange(copies * sum(sizes)).reshape(copies, -1)
    parts = np.split(rows, np.cumsum(sizes)[:-1], axis=1)
    return np.concatenate([part.ravel() for part in parts])


class BaseBlock(Diagram):
    """Thrusters and wheels with the stored momentum of the wheels.

    Inputs: ``commanded_force`` (nv), and ``state`` [q; v] of the plant. Outputs: the
    entries stacked in ``BaseActuators``, ``applied_force`` first; with wheels also the outputs of
    ``Gyroscopic``.
    """

    def __init__(self, base: BaseActuators, coordinates: Coordinates, *, copies: int = 1) -> None:
        super().__init__()
        self._wheels, builder = base.wheels, DiagramBuilder()
        builder.AddNamedSystem("actuators", base)
        parts = builder.AddNamedSystem(
            "sample", Demultiplexer([copies * size for size in base.sizes.values()])
        )
        builder.Connect(base.get_output_port(), parts.get_input_port())
        outputs = {name: parts.get_output_port(index) for index, name in enumerate(base.sizes)}
        builder.ExportInput(base.GetInputPort("commanded_force"), "commanded_force")
        builder.ExportInput(base.GetInputPort("state"), "state")
        if base.HasInputPort("isolated"):
            builder.ExportInput(base.GetInputPort("isolated"), "isolated")
        if base.wheels is not None:
            stored = self._stored = builder.AddNamedSystem(
                "gyroscopic", Gyroscopic(coordinates, copies=copies)
            )
            builder.ConnectInput("state", stored.GetInputPort("state"))
            builder.Connect(outputs["wheel_reaction"], stored.GetInputPort("reaction"))
            name = "stored_momentum"
            builder.Connect(stored.GetOutputPort(name), base.GetInputPort(name))
            outputs |= {each: stored.GetOutputPort(each) for each in ("gyroscopic_force", name)}
        del outputs["memory"]
        for name, port in outputs.items():
            builder.ExportOutput(port, name)
        builder.BuildInto(self)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The wheels have their initial momentum, in a base with the attitude of ``state`` [q;
        v], a row for each copy.
        """
        if self._wheels is not None:
            quaternion = state[..., :4]
            rotation = attitude_ahead(quaternion, np.zeros_like(quaternion[..., :3]), 0.0)
            in_base = times(self._wheels.axes, self._wheels.initial_momentum)
            momentum = times(rotation.reshape(*quaternion.shape[:-1], 3, 3), in_base)
            within = self.GetMutableSubsystemContext(self._stored, context)
            self._stored.set_momentum(within, momentum.ravel())


def attitude_ahead(quaternion: np.ndarray, angular_velocity: np.ndarray, time: float) -> np.ndarray:
    """R_WB (..., 9, by rows) after a time, s, at a constant angular velocity w_WB (..., 3, rad/s)
    from (w, x, y, z) (..., 4).
    """
    before = quaternion.reshape(-1, 4).tolist()
    halves = (0.5 * time * angular_velocity).reshape(-1, 3).tolist()  # half of the rotation vector
    turned = [_turned(one, half) for one, half in zip(before, halves, strict=True)]
    return np.array(turned).reshape(*quaternion.shape[:-1], 9)


def _turned(quaternion: list[float], half: list[float]) -> tuple[float, ...]:
    """A rotation matrix (9, by rows): that of a quaternion of any length, turned by twice a
    rotation vector. On few numbers faster than arrays, and than Drake's classes.
    """
    bw, bx, by, bz = quaternion
    norm = math.sqrt(bw * bw + bx * bx + by * by + bz * bz)
    bw, bx, by, bz = bw / norm, bx / norm, by / norm, bz / norm
    x, y, z = half
    angle = math.sqrt(x * x + y * y + z * z)
    sinc = math.sin(angle) / angle if angle > 0.0 else 1.0
    aw, ax, ay, az = math.cos(angle), sinc * x, sinc * y, sinc * z
    w = (aw * bw - ay * by) - (az * bz + ax * bx)
    x = (aw * bx + ay * bz) - (az * by - ax * bw)
    y = (aw * by + ay * bw) + (az * bx - ax * bz)
    z = (aw * bz - ay * bx) + (az * bw + ax * by)
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * y * x, 2.0 * z * x, 2.0 * z * y
    wx, wy, wz = 2.0 * x * w, 2.0 * y * w, 2.0 * z * w
    return (
        *(1.0 - (yy + zz), xy - wz, xz + wy),
        *(xy + wz, 1.0 - (xx + zz), yz - wx),
        *(xz - wy, yz + wx, 1.0 - (xx + yy)),
    )
