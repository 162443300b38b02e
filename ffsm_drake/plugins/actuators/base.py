"""Thrusters and wheels in the closed loop: they give the base's force and torque."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.common.choice import choose, may_be, repeated
from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.plugins.actuators.attitude import attitude_ahead
from ffsm_drake.plugins.actuators.thruster_faults import gains_and_floors
from ffsm_drake.plugins.actuators.thrusters import Firing, ThrusterSet
from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS, WheelSet, WheelTorques
from ffsm_drake.systems.faults import Hit
from ffsm_drake.systems.sampled import Arrays, Now, Sampled

# Control samples in which wheels recover the torque impulse of pulses beyond their capability.
# Commands beyond their limits are not recovered: the controller reads applied_force and repeats
# them.
_RECOVERY = 10
# Codes of fault detection for a thruster or wheel: it is off and gets no command (a thruster's
# upstream valve is shut); a thruster stays open.
LOST, STUCK_ON = 1.0, 2.0
_LARGEST = 1e300  # N m and N; products of larger numbers overflow


_Working = tuple[ThrusterSet | None, WheelSet | None, bool]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class BaseActuators(Sampled):
    """Thrusters, wheels or both: they provide the base's wrench; other forces pass unchanged.

    Wheels provide torque; thrusters provide force, unload the wheels and may help them. Without
    wheels, thrusters provide torque too; without thrusters, force acts as commanded. In each sample
    the wheels counter the torque of the thrusters' pulses. Inputs:
      commanded_force: (nv), the base's torque and force in world axes.
      state: [q; v] of the plant (nq + nv) at the sample.
      stored_momentum: with wheels only, their integrated momentum in world axes (3), N m s.
      isolated: with detection only, 0, ``LOST`` or ``STUCK_ON`` for each thruster, then wheel.
    Outputs (change at control samples only):
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
        wheel, N m.
    The base turns within a sample. Its attitude at the middle, extrapolated with the angular
    velocity at the start, is held; the relative error of a body-fixed impulse is then
    (w L)^2 / 24. Memory: for wheels the missing impulse of torque (3, world axes, N m s), their
    momentum (n), and whether thrusters unload them and motors rearrange it (2); for thrusters the
    impulse requested but not fired (6, world axes, N m s and N s), and that of ``ThrusterSet``.
    Phase: whether a frame begins (1), and with faults the effect of those that are there.
    """

    thrusters: ThrusterSet | None
    wheels: WheelSet | None
    num_velocities: int
    sample_time: float
    faults: Sequence[Hit] = ()
    detects: bool = False
    acts = True
    in_phase: ClassVar = ("faults",)

    @functools.cached_property
    def frame(self) -> int:
        """Control samples from one allocation to the next."""
        return 1 if self.thrusters is None else self.thrusters.settings.frame

    @functools.cached_property
    def units(self) -> tuple[str, ...]:
        """Names of thrusters, then of wheels."""
        thrusters, wheels = (() if each is None else each.names for each in self._sets)
        return *thrusters, *wheels

    @property
    def _sets(self) -> tuple[ThrusterSet | None, WheelSet | None]:
        return self.thrusters, self.wheels

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        sizes = {name: len(value) for name, value in self.latched.items()}
        return {
            "commanded_force": self.num_velocities,
            **sizes,
            "state": 2 * self.num_velocities + 1,
        }

    @functools.cached_property
    def entries(self) -> Mapping[str, Sequence[int]]:
        """See Sampled: the base's quaternion and angular velocity."""
        first = self.num_velocities + 1
        return {"state": [0, 1, 2, 3, first, first + 1, first + 2]}

    @functools.cached_property
    def latched(self) -> Mapping[str, Sequence[float]]:
        """See Sampled."""
        made = {"state": [1.0, *[0.0] * 6]}
        if self.wheels is not None:
            made["stored_momentum"] = self.wheels.initial.tolist()
        if self.detects:
            made["isolated"] = [0.0] * len(self.units)
        return made

    @functools.cached_property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        made = {"applied_force": self.num_velocities}
        if self.thrusters is not None:
            count = len(self.thrusters.names)
            made |= {"thruster_force": count, "thruster_open": count, "thruster_given": 1}
        if self.wheels is not None:
            count = len(self.wheels.names)
            made |= {"wheel_momentum": count, "wheel_torque": count, "wheel_unloads": 1}
            made["wheel_reaction"] = 3
        if self._may_break:
            made |= {"told_force": self.num_velocities, "told_units": len(self.units)}
        return made

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        made = dict[str, np.ndarray]()
        if self.wheels is not None:
            made = {"short": np.zeros(3), "momentum": self.wheels.initial_momentum}
            made["modes"] = np.zeros(2)
        if self.thrusters is not None:
            made |= {"owed": np.zeros(6), **self.thrusters.initial_memory()}
        return made

    def phase(self, sample: Any) -> Sequence[Any]:
        """See Sampled."""
        begins = (sample % self.frame == 0) * 1.0
        if not self.faults:
            return [begins]
        samples = np.atleast_1d(sample)
        there = np.zeros((samples.size, len(self.faults)), dtype=bool)
        for at, fault in enumerate(self.faults):
            there[:, at] = fault.occurs.at(samples)
        effects = np.array([self._effects_of(*each) for each in there.tolist()])
        return [begins, *(effects.T if np.ndim(sample) else effects[0])]

    @property
    def phase_period(self) -> int:
        """See Sampled; faults do not repeat."""
        return self.frame

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled. The base turns as at the sample's start.

        Commands beyond ``_LARGEST`` give NaN, which marks the run as diverged.
        """
        commanded, (quaternion, w_WB) = inputs["commanded_force"], np.split(inputs["state"], [4])
        commanded = np.where(np.abs(commanded) < _LARGEST, commanded, np.nan)
        thrusters, wheels, (gain, floor, stops) = self._working(inputs, now)
        rotation = attitude_ahead(quaternion, w_WB, self.sample_time / 2.0).reshape(3, 3)
        # torque, force in the base's axes; those requested from the thrusters
        wanted: Any = np.matmul(commanded[:6].reshape(2, 3), rotation)
        asked, applied, told_units = wanted.copy(), commanded.copy(), list[Any]()
        if wheels is not None:
            at_start = attitude_ahead(quaternion, w_WB, 0.0).reshape(3, 3)
            momentum, turning = memory["momentum"], at_start.T.dot(w_WB)
            # The held direction of the torque, and the integrator, leave a little between the two.
            in_world = at_start.dot(wheels.axes.dot(momentum))
            missing = (inputs["stored_momentum"] - in_world) / self.sample_time
            unloads = self._ask(wheels, wanted, asked, memory, rotation, turning, now.phase[0])
            if thrusters is None:
                applied[:3] = 0.0
        told, found, kept = applied.copy(), dict[str, Any](), dict[str, Any]()
        if thrusters is not None:
            firing, kept = self._fire(thrusters, asked, memory, rotation, begins=now.phase[0])
            really = thrusters.failing(firing, gain, floor) if self.faults else firing
            told[:6] = _turned_back(firing.wrench, rotation)
            applied[:6] = _turned_back(really.wrench, rotation)
            found = {"thruster_force": really.force, "thruster_open": firing.open_share}
            found["thruster_given"] = firing.given
            told_units.append(firing.force)
            wanted[0] -= firing.wrench[:3]
        if wheels is not None:
            torques, rearranges = self._turn(wheels, wanted[0], memory, turning)
            stopped = torques
            if self.faults:
                stopped = wheels.stopping(torques, stops, momentum, turning)
            by_wheels = rotation.dot(stopped.on_base) + missing
            told[:3] += rotation.dot(torques.on_base) + missing
            applied[:3] += by_wheels
            told_units.append(torques.on_wheels)
            found |= {"wheel_momentum": momentum, "wheel_torque": stopped.motor}
            found |= {"wheel_unloads": unloads * 1.0, "wheel_reaction": by_wheels}
            # The missing part has already been given, in a held direction.
            left = memory["short"] + (commanded[:3] - (told[:3] - missing)) * self.sample_time
            kept["short"] = wheels.bounded(left, _RECOVERY)
            kept["momentum"] = momentum + stopped.on_wheels * self.sample_time
            kept["modes"] = np.concatenate([unloads, rearranges]) * 1.0
        if self._may_break:
            found |= {"told_force": told, "told_units": np.concatenate(told_units)}
        return {"applied_force": applied, **found}, kept

    def _working(
        self, inputs: Arrays, now: Now
    ) -> tuple[ThrusterSet | None, WheelSet | None, Sequence[Any]]:
        """Thrusters and wheels in the allocation, and the effect of faults: gains and floors of
        thrusters, stopped wheels.
        """
        thrusters, wheels = self.thrusters, self.wheels
        count = 0 if thrusters is None else len(thrusters.names)
        is_open, isolated = 1.0, inputs.get("isolated")
        if isolated is not None and isolated.any():
            thrusters, wheels, _ = self.without(isolated)
            is_open = isolated[:count] != LOST  # a shut valve lets nothing through
        if not self.faults:
            return thrusters, wheels, (None, None, None)
        gain, floor, stops = np.split(now.phase[1:], [count, 2 * count])
        return thrusters, wheels, (gain * is_open, floor * is_open, stops)

    def _ask(
        self,
        wheels: WheelSet,
        wanted: Any,
        asked: Any,
        memory: Arrays,
        rotation: Any,
        turning: Any,
        begins: Any,
    ) -> Any:
        """Add to the wanted torque what wheels recover; of it, request from thrusters what the
        wheels leave. Return whether thrusters unload the wheels (1).
        """
        momentum, was = memory["momentum"], memory["modes"][:1] > 0.0
        wanted[0] += rotation.T.dot(memory["short"]) / (_RECOVERY * self.sample_time)
        unloads = choose(begins, lambda: wheels.unloads(was, momentum, turning), was)
        asked[0] = wheels.assist_torque(wanted[0])
        if may_be(unloads):
            asked[0] += np.where(unloads, wheels.unloading_torque(momentum), 0.0)
        return unloads

    def _turn(
        self, wheels: WheelSet, torque: Any, memory: Arrays, turning: Any
    ) -> tuple[WheelTorques, Any]:
        """The torques of wheels for one on the base (3), and whether motors rearrange momentum."""
        momentum, rearranging = memory["momentum"], None
        rearranges = wheels.rearranges(memory["modes"][1:] > 0.0, momentum, turning)
        if may_be(rearranges):
            rearranging = np.where(rearranges, wheels.rearranging_torque(momentum), 0.0)
        return wheels.give(torque, momentum, turning, rearranging=rearranging), rearranges

    def _fire(
        self, thrusters: ThrusterSet, asked: Any, memory: Arrays, rotation: Any, *, begins: Any
    ) -> tuple[Firing, dict[str, Any]]:
        """Fire thrusters for the requested torque and force (2, 3, the base's axes), with the
        owed impulse; also returns the memory.
        """

        def allocated(before: Arrays, fixed: Arrays) -> Arrays:
            owed, rotation = before["owed"], fixed["rotation"]
            in_base = np.matmul(owed.reshape(asked.shape), rotation)
            with_owed = (fixed["asked"] + in_base / thrusters.frame).reshape(owed.shape)
            after = thrusters.allocate(with_owed, before)
            left, less = owed, after["given"] < 1.0
            if may_be(less):  # the rest is given up
                all_owed = _turned_back(with_owed, rotation)
                rest = (1.0 - after["given"]) * thrusters.frame * all_owed
                left = np.where(less, owed - rest, owed)
            return {**after, "begins": np.zeros(()), "owed": left}

        names = ("owed", *thrusters.initial_memory())
        before = {"begins": begins, **{name: memory[name] for name in names}}
        after = dict(repeated(allocated, before, {"asked": asked, "rotation": rotation}, most=1))
        owed, _ = after.pop("owed"), after.pop("begins")
        firing, kept = thrusters.fire(after)
        if thrusters.carries_over:
            left = asked - firing.wrench.reshape(asked.shape)
            owed = owed + _turned_back(left, rotation) * self.sample_time
        return firing, {"owed": owed, **kept}

    def without(self, isolated: np.ndarray) -> _Working:
        """Thrusters and wheels (None: none) for the allocation without what is ``isolated``, and
        whether they give every wrench; those without none where they do not.
        """
        key = isolated.tobytes()
        if key not in self._without_by_codes:
            self._without_by_codes[key] = self._make_without(isolated)
        return self._without_by_codes[key]

    @functools.cached_property
    def _without_by_codes(self) -> dict[bytes, _Working]:
        return {}

    @property
    def _may_break(self) -> bool:
        return self.detects or bool(self.faults)

    def _make_without(self, isolated: np.ndarray) -> _Working:
        thrusters, wheels, step = self.thrusters, self.wheels, self.sample_time
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

    def _effects_of(self, *are_there: bool) -> np.ndarray:
        """Gains, floors, stopped wheels, with those of the faults that are there."""
        if are_there not in self._effects:
            hits = [hit for hit, is_there in zip(self.faults, are_there, strict=True) if is_there]
            thrusters, wheels = (() if each is None else each.names for each in self._sets)
            of_thrusters = [hit for hit in hits if hit.kind is not WHEEL_STOPS]
            stopped = {hit.unit for hit in hits if hit.kind is WHEEL_STOPS}
            stops = [float(name in stopped) for name in wheels]
            effects = np.concatenate([*gains_and_floors(thrusters, of_thrusters), stops])
            self._effects[are_there] = effects
        return self._effects[are_there]

    @functools.cached_property
    def _effects(self) -> dict[tuple[bool, ...], np.ndarray]:
        return {}


def _turned_back(wrench: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Torque and force (6) of the base's axes in the world's."""
    in_world: np.ndarray = np.matmul(wrench.reshape(2, 3), rotation.T)
    return in_world.reshape(6)
