"""Fault detection of the flight software: the last stage of the section ``sensing``.

At each sample it compares measurements with the commands of the actuators:

- a sensor is silent if it reports no new measurement; frozen if it repeats its bits while others
  move; biased if a position jumps by more than its velocity explains, or a velocity differs from
  its position's slope;
- a wheel has stopped if its momentum, from its tachometer, does not follow the commanded torque;
- a joint is jammed if it stands still under a force beyond the stated bounds of disturbance,
  friction and payload;
- thrusters: see ``plugins.faults.residuals``.

A lost position is extrapolated with its velocity, a lost velocity comes from an observer of
position and reported force, a bias is subtracted (base sensors: in the base's axes). A lost
thruster or wheel leaves the allocation. A jammed joint, or the loss of a unit essential to the
allocation, raises ``abort_request``.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from types import SimpleNamespace

import numpy as np

from ffsm_drake.common.so3 import matrix_of, turning_matrix
from ffsm_drake.plugins.actuators.base import LOST, STUCK_ON
from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.row import make_base_actuators
from ffsm_drake.plugins.estimators.estimators import assumed_noise
from ffsm_drake.plugins.faults.residuals import (
    Suspicion,
    between,
    slope_of,
    suspect,
    times_of,
)
from ffsm_drake.plugins.faults.sensors import entries_in_state, sensors_of
from ffsm_drake.scenario import Scenario, thrusters_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates, position_error
from ffsm_drake.spacecraft.nominal import PlantModel, damping_of, make_nominal_plant
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.systems.faults import detects, hits
from ffsm_drake.systems.part import Figure, Metric, Part, Signal, View
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.sensing.block import IS_NEW
from ffsm_drake.systems.sensing.errors import measurement_times
from ffsm_drake.systems.setup import BlockSetup

KINDS = (
    *("", "stuck_on", "stuck_off", "leaking", "weak", "stops", "jammed"),
    *("frozen", "silent", "biased"),
)
_CODE = {kind: float(code) for code, kind in enumerate(KINDS)}
# control samples of a block; blocks that are kept; looks until a slope is known
_EVERY, _KEPT, _OLD = 5, 61, 20
_WINDOWS = (8, 24, 60)  # blocks
# consecutive evaluations that name the same thruster; share of the threshold required in them:
# residuals that are not white stay within bounds
_CONFIRMED, _ASKED = 4, 0.6
_LEARNT = 50  # samples, or blocks, after which a variance is known
_REPEATED = 5  # samples with the same bits
_JUMP, _SLOPE = 1e-3, 1e-3  # m or rad, m/s or rad/s; smaller sensor errors are ignored
_SPEED, _SHARE = 0.2, 0.3  # rad/s and share of the commanded impulse: tolerance of a wheel
_STILL, _LEAST = 2e-5, 0.05  # for a jam: rad or m; N m or N beyond all bounds
_OFF = 0.2  # uncertain share of the payload's radius of gyration (centre) and moments
_PULSE = 0.1  # share of the largest impulse of a frame that is noise
_FLEXIBLE = 4.0  # times the largest acceleration so far that flexible parts may give
_BANDWIDTH = {"base_rotation": 8.0, "base_position": 2.0, "joints": 10.0}  # rad/s


class FaultDetection(Part):
    """The section ``faults.detection`` of a scenario."""

    title = "Fault detection"
    section = "Faults"
    about = "Detected faults: " + ", ".join(f"{i} {kind}" for i, kind in enumerate(KINDS) if kind)

    @classmethod
    def of(cls, scenario: Scenario) -> "FaultDetection | None":
        """None if the flight software does not look for faults."""
        return cls() if detects(scenario) else None

    def build(self, setup: BlockSetup) -> "Detector":
        """The stage."""
        return Detector(setup)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Detected fault of each unit."""
        return (
            Signal(
                name="fault_detected",
                unit="1",
                meaning=f"detected fault of each unit: {self.about.partition(': ')[2]}, 0 none",
                components=tuple(_units(setup.scenario, setup.coordinates)),
                dimension="fault_unit",
                heading="",
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """Times of detection."""
        return (
            Metric(
                key="faults.noticed", unit="s", label="Detected", column="", of=_noticed,
            ),
        )  # fmt: skip

    def sentence(self, figures: Sequence[Figure]) -> str:
        """Detected faults with their times."""
        (found,) = (each.value for each in figures if each.key == "faults.noticed")
        assert isinstance(found, dict)
        listed = ", ".join(f"{name} at {time:.2f} s" for name, time in found.items())
        return f"Faults detected: {listed or 'none'}"


def _noticed(run: View) -> dict[str, float]:
    """Unit and kind -> time, s."""
    found, codes = dict[str, float](), np.asarray(run["fault_detected"])
    for unit, of_unit in zip(_units(run.scenario, run.coordinates), codes.T, strict=True):
        for k in np.flatnonzero(np.diff(of_unit, prepend=0.0)):
            found[f"{unit} {KINDS[int(of_unit[k])]}"] = float(run.time[k])
    return dict(sorted(found.items(), key=lambda item: item[1]))


def _units(scenario: Scenario, coordinates: Coordinates) -> list[str]:
    """All units that may be reported, with the names in ``faults``."""
    thrusters, wheels = scenario.actuation.thrusters, scenario.wheels
    return [
        *(f"thrusters.{name}" for name in ({} if thrusters is None else thrusters_of(thrusters))),
        *(f"wheels.{name}" for name in ({} if wheels is None else wheels.units)),
        *(f"joints.{name}" for name in coordinates.joints),
        *(f"sensing.{name}" for name in sensors_of(coordinates)),
    ]


class Memory(SimpleNamespace):
    """What the detector remembers from sample to sample; methods change it in place.

    Of each thruster, wheel, joint and sensor: the ``codes`` found. Of sensors: ``raw`` and ``seen``
    state, before and after corrections; biases ``off``, base's axes; for how many samples each is
    ``stale``, and how often it ``repeats`` its bits; slips ``since`` then, and their mean square
    ``jitter``; ``observed`` state and ``acceleration`` in place of lost velocities; the usual
    ``slope`` of slips, after so many ``looks``. Of forces, ``kept`` blocks of ``sums``, the last
    ``part`` of one, and how many ``blocks`` form a window; ``rough``: mean square of unexplained
    changes; ``largest`` accelerations of flexible parts; whether the last sample ``jumped``.
    ``told`` force of units and ``momentum`` of wheels; how often each thruster was ``suspected`` by
    window. Samples of this ``leg``, which the payload's mass tells.
    """


class Detector(Sampled):
    """Inputs: those of the block; of actuators ``told_force`` (nv), and, where they have them,
    ``gyroscopic_force`` (nv), ``told_units`` and ``wheel_momentum``. Outputs: the block's,
    ``fault_detected``, ``abort_request``, and with thrusters or wheels ``isolated``, as found at
    the sample before.
    """

    traced = False

    def __init__(self, setup: BlockSetup) -> None:
        scenario, coordinates = setup.scenario, setup.coordinates
        assert scenario.faults is not None
        assert scenario.faults.detection is not None
        self._settings, self._step = scenario.faults.detection, setup.sample_time
        self._model, self._names = setup.nominal, _units(scenario, coordinates)
        self._nq, self._nv = len(coordinates.position_names), len(coordinates.names)
        # the nominal payload changes at a grasp
        held = setup.grip.carried(scenario.payload).nominal
        self._leg = float(held.mass)
        factor = self._settings.payload_factor if setup.grip.holds else 1.0
        # the nominal one, those with a light and with a heavy payload
        self._models = [self._model, *_extremes(scenario, factor)]
        self._payload = (scenario.payload.body, held.mass, 0.5 * sum(held.inertia[:3]))
        self._damping = damping_of(self._model.plant)
        self._is_flexible = bool(scenario.model.flexible)
        actuation = allocated(scenario)
        self._base = None
        if actuation.thrusters is not None or actuation.wheels is not None:
            self._base = make_base_actuators(
                actuation, coordinates, sample_time=self._step, detects=True
            )
        self._read_sensors(scenario, coordinates)
        self._bound_disturbance(scenario, coordinates)
        nothing = np.zeros(self._nv)
        self._friction, self._viscous = nothing, nothing
        if actuation.drives is not None:
            drives = DriveSet(actuation.drives, actuation.limit, coordinates)
            base = np.zeros(NUM_BASE_VELOCITIES)
            self._friction = np.concatenate([base, drives.static])
            self._viscous = np.concatenate([base, drives.viscous])
        # of the observer of lost velocities: three equal poles for each coordinate, without
        # steady-state error under a constant unreported force
        w = coordinates.vector(_BANDWIDTH, key="bandwidth", default=0.0)
        self._gains = np.array([3.0 * w, 3.0 * w**2, w**3]) * self._step
        self._lay_out()

    def _bound_disturbance(self, scenario: Scenario, coordinates: Coordinates) -> None:
        """The largest external force (nv), and twice that of an orbit by inertia, 1/s^2."""
        given, of = self._settings.disturbance, scenario.disturbance
        self._orbital = 0.0
        if given is not None:
            key = "faults.detection.disturbance"
            self._disturbance = coordinates.vector(given, key=key, default=0.0)
            return
        largest = {
            name: abs(of.amplitude_scale) * (abs(each.amplitude) + abs(each.bias))
            for name, each in of.harmonics.items()
        }
        self._disturbance = coordinates.vector(largest, key="disturbance.harmonics", default=0.0)
        if scenario.environment is not None:
            self._orbital = 3.0 * float(Orbit.of(scenario.environment).rate) ** 2

    def _bound(self, mass: np.ndarray, state: np.ndarray) -> np.ndarray:
        """The largest force (nv) that is neither reported nor a fault, friction included."""
        inertia = 0.5 * np.trace(mass[:3, :3]) + mass[3, 3] * (state[4:7] @ state[4:7])
        orbital = self._orbital * np.sqrt(np.diag(mass) * inertia)
        rates = np.abs(state[self._nq :])
        bound: np.ndarray = self._disturbance + orbital + self._friction + self._viscous * rates
        return bound

    def _bound_payload(self, state: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """The largest force (nv) of a payload whose centre of mass and axes of inertia are not the
        nominal ones, at an acceleration (nv).
        """
        model, (name, mass, moment) = self._model, self._payload
        if mass == 0.0:
            return np.zeros(self._nv)
        q, v = np.split(state, [self._nq])
        jacobian = model.calc_jacobian(q, name)
        moved = jacobian @ acceleration + model.calc_bias_acceleration(q, v, name)
        turning = np.linalg.norm(moved[:3]) + np.sum((jacobian[:3] @ v) ** 2)
        offset = _OFF * np.sqrt(mass * moment)  # its mass times how far its centre is off
        torque = offset * np.linalg.norm(moved[3:]) + _OFF * moment * turning
        sizes = np.linalg.norm(jacobian.reshape(2, 3, -1), axis=1)
        bound: np.ndarray = torque * sizes[0] + offset * turning * sizes[1]
        return bound

    def _read_sensors(self, scenario: Scenario, coordinates: Coordinates) -> None:
        """Read the sensors' properties: update pattern and noise."""
        self._sensors = sensors_of(coordinates)
        period, delay = measurement_times(scenario.sensing, coordinates)
        self._is_prompt = (period == 1) & (delay == 0)
        self._patience = 3 * period + delay  # control samples without anything new
        noise = assumed_noise(scenario, coordinates)
        self._position_noise, self._velocity_noise = noise
        quantized = [
            coordinates.vector(of, key="sensing", default=0.0)
            for of in (
                scenario.sensing.position_quantization,
                scenario.sensing.velocity_quantization,
            )
        ]
        self._is_fine = np.concatenate(quantized) == 0.0
        self._position_noise = self._position_noise + quantized[0]
        self._velocity_noise = self._velocity_noise + quantized[1]
        silent = any(fault.kind == "silent" for _, fault in hits(scenario, "sensing"))
        self._may_be_old = silent or bool((period > 1).any())
        self._sees_forces = bool(self._is_prompt.all())

    def _lay_out(self) -> None:
        nv, base, size = self._nv, self._base, self._nq + self._nv
        self._thrusters, self._wheels = (
            (None, None) if base is None else (base.thrusters, base.wheels)
        )
        self._force = np.zeros(0) if self._thrusters is None else self._thrusters.force
        self._num_units = 0 if base is None else len(base.units)
        self._num_wheels = self._num_units - len(self._force)
        # columns of a block: unexplained velocities of each model, slips, motions, velocities,
        # commanded impulses, momenta that wheels did not take
        models = len(self._models) * nv
        widths = {"left": models, "slip": nv, "moved": nv, "velocity": nv}
        widths |= {"told": self._num_units, "beyond": self._num_wheels}
        ends = np.cumsum([0, *widths.values()]).tolist()
        self._at = {
            name: slice(*pair) for name, pair in zip(widths, itertools.pairwise(ends), strict=True)
        }
        self._shapes: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("leg", "samples", "blocks", "looks", "abort_request", "jumped"), ()),
            **dict.fromkeys(("raw", "seen", "stale", "observed"), (size,)),
            **dict.fromkeys(("off", "since"), (2 * nv,)),
            **dict.fromkeys(("jitter", "rough", "largest", "slope", "acceleration"), (nv,)),
            **dict.fromkeys(("sums", "part"), (ends[-1],)),
            "codes": (len(self._names),), "repeats": (len(self._sensors),),
            "told": (self._num_units,), "momentum": (self._num_wheels,), "kept": (_KEPT, ends[-1]),
            "suspected": (len(_WINDOWS), len(self._force)),
        }  # fmt: skip

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        size, nv, wheels = self._nq + self._nv, self._nv, self._num_wheels
        found = {
            "state": size, "told_force": nv, IS_NEW: size * self._may_be_old,
            "told_units": self._num_units, "gyroscopic_force": nv if wheels else 0,
            "wheel_momentum": wheels,
        }  # fmt: skip
        return {name: number for name, number in found.items() if number}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        size = self._nq + self._nv
        found = {
            "estimated_state": size, IS_NEW: size * self._may_be_old,
            "fault_detected": len(self._names), "abort_request": 1, "isolated": self._num_units,
        }  # fmt: skip
        return {name: number for name, number in found.items() if number}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled; before the start the state was measured."""
        memory = {name: np.zeros(shape) for name, shape in self._shapes.items()}
        memory["leg"] -= 1.0
        if state is not None:
            memory |= dict.fromkeys(("raw", "seen", "observed"), state)
        return _flat(memory)

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        before, shapes = memory["codes"], self._shapes
        after = Memory(
            **{name: np.array(memory.get(name, ())).reshape(shapes[name]) for name in shapes}
        )
        self._look_at(after, inputs)
        outputs = {
            "estimated_state": after.seen.copy(), "fault_detected": before,
            "abort_request": memory["abort_request"],
        }  # fmt: skip
        if self._may_be_old:
            outputs[IS_NEW] = self._renewed(inputs[IS_NEW], before)
        if self._num_units:
            outputs["isolated"] = self._isolated(before)
        return outputs, _flat(vars(after))

    def _renewed(self, new: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """A value in a lost sensor's place is new."""
        new = new.copy()
        for name, entries in self._sensors.items():
            if codes[self._unit(name)] and self._is_prompt[entries].all():
                new[entries_in_state(entries)] = 1.0
        return new

    def _unit(self, sensor: str) -> int:
        return self._names.index(f"sensing.{sensor}")

    def _isolated(self, codes: np.ndarray) -> np.ndarray:
        """Codes for the actuators (units)."""
        assert self._base is not None
        told = (codes[: len(self._base.units)] > 0.0) * LOST
        if not self._settings.isolation_valves:
            told[codes[: told.size] == _CODE["stuck_on"]] = STUCK_ON
            told[codes[: told.size] == _CODE["leaking"]] = 0.0
        return told

    def _look_at(self, memory: Memory, inputs: Arrays) -> None:
        """Bring the memory up to date with a sample; ``seen`` is the state without lost sensors."""
        raw = inputs["state"]
        is_first = memory.leg != self._leg
        seen = memory.seen.copy()
        force = self._acting(memory, inputs) - self._damping * seen[self._nq :]
        if is_first:
            memory.leg = self._leg
            self._forget(memory)
            memory.samples = 0.0
        changes = self._changes(seen, np.column_stack([force, self._pushes(seen)]))
        expected = self._step * changes[:, :, 0] * (not is_first)
        self._correct(memory, raw, seen, expected[0], is_first=is_first)
        if not is_first:
            self._look_at_sensors(memory, raw, seen, inputs.get(IS_NEW))
            if self._collect(memory, seen, expected, changes[0, :, 1:]):
                self._look_at_blocks(memory, changes[0, :, 1:])
        memory.raw[:] = raw

    def _changes(self, state: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Accelerations (models, nv, n) under generalized forces (nv, n), of which all but the
        first act alone.
        """
        q, v = np.split(state, [self._nq])
        forces = forces.copy()
        changes, total = [], forces[:, 0].copy()
        for model in self._models:
            forces[:, 0] = total - model.calc_bias(q, v)
            changes.append(np.linalg.solve(model.calc_mass_matrix(q), forces))
        return np.array(changes)

    def _acting(self, memory: Memory, inputs: Arrays) -> np.ndarray:
        """The force (nv) on the plant in the last sample as reported, with measured wheel torques;
        updates the sums in ``part``.
        """
        force = inputs["told_force"].copy()
        memory.sums[self._at["told"]] += self._step * memory.told
        if self._wheels is not None:
            force += inputs["gyroscopic_force"]
            now = inputs["wheel_momentum"]
            if memory.samples > 1.0:
                beyond = now - memory.momentum - self._step * memory.told[-now.size :]
                memory.sums[self._at["beyond"]] += beyond
                axes = matrix_of(memory.seen[:4]) @ self._wheels.axes
                force[:3] -= axes @ beyond / self._step
            memory.momentum = now
        memory.told = inputs.get("told_units", memory.told)
        return force

    def _pushes(self, state: np.ndarray) -> np.ndarray:
        """Generalized forces (nv, n) of unit forces of thrusters."""
        pushes = np.zeros((self._nv, len(self._force)))
        if self._thrusters is not None:
            pairs = self._thrusters.wrenches.reshape(2, 3, -1)
            pushes[:6] = (matrix_of(state[:4]) @ pairs).reshape(6, -1)
        return pushes

    @staticmethod
    def _of_base(R: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Errors of positions and velocities (2 nv) with the base's vectors turned by R."""
        turned = off.copy().reshape(2, -1)
        base = turned[:, :NUM_BASE_VELOCITIES].reshape(2, 2, 3)
        turned[:, :NUM_BASE_VELOCITIES] = (base @ R.T).reshape(2, -1)
        return turned.ravel()

    @staticmethod
    def _forget(memory: Memory) -> None:
        """Begin a window with the next block."""
        memory.blocks = -1.0

    def _correct(
        self,
        memory: Memory,
        raw: np.ndarray,
        seen: np.ndarray,
        expected: np.ndarray,
        *,
        is_first: bool,
    ) -> None:
        """Write the measured state, without lost sensors and biases, into ``seen`` of the memory;
        ``seen`` is the one before.
        """
        nq, nv = self._nq, self._nv
        off = self._of_base(matrix_of(seen[:4]), memory.off)
        q, v = _moved(raw[:nq], -off[:nv]), raw[nq:] - off[nv:]
        lost = self._lost(memory.codes)
        if lost[nv:].any():
            before, speed = np.split(memory.observed, [nq])
            change = expected + self._step * memory.acceleration
            ahead = _moved(before, self._step * (speed + 0.5 * change))
            of_q, of_v, of_a = self._gains * position_error(q, ahead)
            speed = speed + change + of_v
            memory.observed = np.concatenate([_moved(ahead, of_q), speed])
            memory.acceleration += of_a
            v = np.where(lost[nv:], speed, v)
        if lost[:nv].any() and not is_first:
            carried = _moved(seen[:nq], 0.5 * self._step * (seen[nq:] + v))
            q = np.where(np.concatenate([lost[:1], lost[:nv]]), carried, q)
        memory.seen[:] = np.concatenate([q, v])

    def _lost(self, codes: np.ndarray) -> np.ndarray:
        """Mask of the measurements (2 nv) that are replaced."""
        lost = np.zeros(2 * self._nv, dtype=bool)
        for name, entries in self._sensors.items():
            if codes[self._unit(name)] in (_CODE["frozen"], _CODE["silent"]):
                lost[entries] = self._is_prompt[entries]
        return lost

    def _jammed(self, codes: np.ndarray) -> np.ndarray:
        """Mask of the jammed coordinates (nv)."""
        base, joints = np.zeros(NUM_BASE_VELOCITIES, dtype=bool), self._model.coordinates.joints
        at = [self._names.index(f"joints.{name}") for name in joints]
        return np.concatenate([base, codes[at] > 0.0])

    def _look_at_sensors(
        self, memory: Memory, raw: np.ndarray, before: np.ndarray, new: np.ndarray | None
    ) -> None:
        """Detect silent, frozen or jumping sensors."""
        nq, nv, codes = self._nq, self._nv, memory.codes
        now, old = memory.seen, memory.raw
        moved = position_error(now[:nq], before[:nq])
        slip = moved - 0.5 * self._step * (now[nq:] + before[nq:])
        memory.since += np.tile(slip, 2)
        memory.stale[:] = 0.0 if new is None else np.where(new > 0.0, 0.0, memory.stale + 1.0)
        lost, joints = self._lost(codes), self._jammed(codes)
        known = memory.samples >= _LEARNT
        for index, (name, entries) in enumerate(self._sensors.items()):
            columns = entries_in_state(entries)
            if codes[self._unit(name)]:
                slip[entries[entries < nv]] = 0.0
                continue
            same = bool((raw[columns] == old[columns]).all())
            memory.repeats[index] = memory.repeats[index] + 1.0 if same else 0.0
            if not same:
                memory.since[entries] = 0.0
            prompt = self._is_prompt[entries].all()
            if (memory.stale[columns] > self._patience[entries[0]]).all():
                self._lose(memory, name, "silent")
            elif prompt and self._is_fine[entries].all() and memory.repeats[index] >= _REPEATED:
                walk = self._velocity_noise[entries % nv].max() * np.sqrt(memory.repeats[index])
                least = 1e-7 + self._settings.threshold * self._step * walk  # or it is at rest
                if np.abs(memory.since[entries]).max() > least and not joints[entries % nv].any():
                    self._lose(memory, name, "frozen")
            elif same:
                continue  # a jump back to the shown value would not be one
            elif prompt and known and entries[0] < nv and not lost[entries + nv].any():
                size = np.linalg.norm(slip[entries] / np.sqrt(memory.jitter[entries] + 1e-30))
                if size > self._settings.threshold + 1.0 and np.linalg.norm(slip[entries]) > _JUMP:
                    found = np.zeros(2 * nv)
                    found[entries] = slip[entries]
                    memory.off += self._of_base(matrix_of(now[:4]).T, found)
                    turn = np.zeros(nv)
                    turn[entries] = slip[entries]
                    now[:nq] = _moved(now[:nq], -turn)
                    slip[entries] = 0.0
                    self._lose(memory, name, "biased")
        gain = 1.0 / min(memory.samples + 1.0, 4.0 * _LEARNT)
        memory.jitter += gain * (slip**2 - memory.jitter)
        memory.sums[self._at["slip"]] += slip
        memory.sums[self._at["moved"]] += moved

    def _lose(self, memory: Memory, sensor: str, kind: str) -> None:
        """Handle a lost sensor: the estimates of its coordinates are reset."""
        nq, nv, entries = self._nq, self._nv, self._sensors[sensor]
        memory.codes[self._unit(sensor)] = _CODE[kind]
        now = memory.seen
        if kind != "biased" and entries[0] < nv:  # changes missed meanwhile
            missed = np.zeros(nv)
            missed[entries] = memory.since[entries]
            now[:nq] = _moved(now[:nq], -missed)
        elif kind != "biased":
            memory.observed[:] = now
            memory.acceleration[:] = 0.0
        lost = self._lost(memory.codes)
        if (lost[:nv] & lost[nv:]).any() or not self._is_prompt[entries].all():
            memory.abort_request = 1.0
        self._forget(memory)

    def _collect(
        self, memory: Memory, before: np.ndarray, expected: np.ndarray, pushes: np.ndarray
    ) -> bool:
        """Sums of what is unexplained, in blocks; whether one ends."""
        nq, now = self._nq, memory.seen
        left = now[nq:] - before[nq:] - expected  # (models, nv)
        count = memory.samples = memory.samples + 1.0
        bound = self._settings.threshold * np.sqrt(memory.rough)
        bound += self._step * np.abs(pushes) @ self._force
        known = np.clip(left[0], -bound, bound) if count > _LEARNT else left[0]
        # a jump of a sensor is no force; a lasting change is one
        jumps = float((known != left[0]).any())
        if jumps and not memory.jumped and memory.blocks >= _WINDOWS[0]:
            self._forget(memory)
            left = left - left[0] + known
        memory.jumped = jumps
        memory.rough += (known**2 - memory.rough) / min(count, 4.0 * _LEARNT)
        memory.sums[self._at["left"]] += left.ravel()
        memory.sums[self._at["velocity"]] = now[nq:]
        memory.part += memory.sums / _EVERY
        is_whole = bool(count % _EVERY == 0.0)
        if is_whole:
            memory.kept = np.vstack([memory.kept[1:], memory.part])
            memory.part = np.zeros_like(memory.part)
            memory.blocks += 1.0
        return is_whole

    def _look_at_blocks(self, memory: Memory, pushes: np.ndarray) -> None:
        """Wheels, joints, velocities, thrusters, in windows of blocks."""
        valid, step, nv, kept = int(memory.blocks), _EVERY * self._step, self._nv, memory.kept
        if valid >= _KEPT or (memory.looks < _OLD and valid >= 2 * _OLD):
            old = kept[-min(valid, _KEPT) :][_OLD : 2 * _OLD, self._at["slip"]]
            memory.looks += 1.0
            gain = 1.0 / min(memory.looks, 2.0 * _LEARNT)
            memory.slope += gain * (slope_of(old, step)[0] - memory.slope)
        if self._wheels is not None:
            self._look_at_wheels(memory, valid)
        # an unpredictable motion allows no further detection
        if memory.abort_request or memory.samples < _LEARNT:
            return
        if self._is_flexible and valid >= _KEPT:
            old = np.abs(slope_of(kept[:_OLD, :nv], step)[0])
            memory.largest = np.maximum(memory.largest, old)
        mass = [model.calc_mass_matrix(memory.seen[: self._nq]) for model in self._models]
        bound = self._bound(mass[0], memory.seen)
        is_known = not self._is_flexible or bool(memory.largest.any())
        suspicions = list[Suspicion]()
        for window in (each for each in _WINDOWS if each <= valid):
            blocks = kept[-window:]
            if memory.looks >= _OLD:
                self._look_at_velocities(memory, blocks)
            if self._sees_forces and not self._are_velocities_off(memory, blocks):
                acceleration = slope_of(blocks[:, self._at["velocity"]], step)[0]
                total = bound + self._bound_payload(memory.seen, acceleration)
                self._look_at_joints(memory, blocks, mass, total)
                if self._thrusters is not None and is_known:
                    most = np.max([np.abs(np.linalg.inv(each)) @ total for each in mass], axis=0)
                    most += _FLEXIBLE * memory.largest
                    stands = self._stand(memory, blocks[-_CONFIRMED:])
                    holds = np.linalg.inv(mass[0])[:, NUM_BASE_VELOCITIES:][:, stands]
                    suspicions.append(self._look_at_thrusters(memory, blocks, pushes, most, holds))
                    self._confirm(memory, suspicions, window)

    def _noise(self, memory: Memory) -> np.ndarray:
        """Standard deviation (nv) of a block's mean of the velocities' noise."""
        assumed = self._velocity_noise / np.sqrt(_EVERY)
        noise: np.ndarray = np.maximum(_white(memory.rough), assumed)
        return noise

    def _notice(self, memory: Memory, unit: str, kind: str) -> None:
        memory.codes[self._names.index(unit)] = _CODE[kind]
        self._forget(memory)
        is_without = self._base is not None and not unit.startswith("joints.")
        if is_without and self._base is not None:
            is_without = self._base.without(self._isolated(memory.codes))[2]
        if not is_without:
            memory.abort_request = 1.0

    def _look_at_wheels(self, memory: Memory, valid: int) -> None:
        """Detect a momentum that does not follow the commanded torque."""
        assert self._wheels is not None
        count = len(self._wheels.names)
        for window in (each for each in (_EVERY, *_WINDOWS) if each < valid):
            change = np.abs(memory.kept[-1] - memory.kept[-1 - window])
            told, beyond = change[-2 * count :].reshape(2, count)
            for index in np.flatnonzero(beyond > _SHARE * told + _SPEED * self._wheels.inertia):
                unit = f"wheels.{self._wheels.names[index]}"
                if not memory.codes[self._names.index(unit)]:
                    self._notice(memory, unit, "stops")

    def _stand(self, memory: Memory, blocks: np.ndarray) -> np.ndarray:
        """Mask of the joints that stand still."""
        moved = blocks[:, self._at["moved"]]
        most = _STILL + self._settings.threshold * self._position_noise / np.sqrt(_EVERY)
        still: np.ndarray = (np.ptp(moved, axis=0) < most)[NUM_BASE_VELOCITIES:]
        return still

    def _look_at_joints(
        self, memory: Memory, blocks: np.ndarray, mass: Sequence[np.ndarray], bound: np.ndarray
    ) -> None:
        """Detect joints at rest under a force beyond all bounds, for any payload mass.

        The mean over a window of a force within +-D, by any weights, is within +-D at any
        frequency.
        """
        nv, step, base = self._nv, _EVERY * self._step, NUM_BASE_VELOCITIES
        stands = self._stand(memory, blocks[len(blocks) // 2 :])
        if not stands.any():
            return
        time = times_of(len(blocks), step)
        slopes = (time @ blocks[:, self._at["left"]] / (time @ time)).reshape(-1, nv)
        forces = np.array([each @ slope for each, slope in zip(mass, slopes, strict=True)])
        noise = np.sqrt(mass[0] ** 2 @ self._noise(memory) ** 2 / (time @ time))
        low, high = between(forces)
        beyond = np.maximum(low, -high) - bound - self._settings.threshold * noise
        for index in np.flatnonzero(stands & (beyond[base:] > _LEAST)):
            unit = f"joints.{self._model.coordinates.joints[index]}"
            if not memory.codes[self._names.index(unit)]:
                self._notice(memory, unit, "jammed")

    def _slips(self, memory: Memory, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Difference (nv) between velocities and the slopes of their positions beyond the usual
        one, and its standard deviation.
        """
        step, white = _EVERY * self._step, _white(memory.jitter)
        slope, deviation = slope_of(blocks[:, self._at["slip"]], step, white)
        velocity = 1.2 * self._velocity_noise / np.sqrt(_EVERY)
        known = times_of(_OLD, step)
        of_usual = np.hypot(white / np.sqrt(known @ known), velocity / np.sqrt(_OLD))
        of_usual /= np.sqrt(max(memory.looks / _OLD, 1.0))
        deviation = np.hypot(deviation, velocity / np.sqrt(len(blocks)))
        return slope - memory.slope, np.hypot(deviation, of_usual) + 1e-30

    def _are_velocities_off(self, memory: Memory, blocks: np.ndarray) -> bool:
        """Whether a velocity seems to differ from the slope of its position and cannot reveal
        forces.
        """
        off, deviation = self._slips(memory, blocks)
        return bool((np.abs(off) > _SLOPE + 4.0 * deviation).any())

    def _look_at_velocities(self, memory: Memory, blocks: np.ndarray) -> None:
        """Detect velocities that differ from the slope of their position."""
        nv, codes = self._nv, memory.codes
        off, deviation = self._slips(memory, blocks)
        for name, entries in self._sensors.items():
            at = entries - nv
            if (
                at[0] < 0
                or codes[self._unit(name)]
                or codes[self._unit(name.removesuffix("_velocity"))]
            ):
                continue
            if not (self._is_prompt[entries].all() and self._is_prompt[at].all()):
                continue
            if np.linalg.norm(off[at]) > _SLOPE and (
                np.linalg.norm(off[at] / deviation[at]) > self._settings.threshold + 1.0
            ):
                found = np.zeros(2 * nv)
                found[entries] = off[at]
                memory.off -= self._of_base(matrix_of(memory.seen[:4]).T, found)
                self._lose(memory, name, "biased")

    def _look_at_thrusters(
        self,
        memory: Memory,
        blocks: np.ndarray,
        pushes: np.ndarray,
        bound: np.ndarray,
        holds: np.ndarray,
    ) -> Suspicion:
        """The best hypothesis of ``residuals``; ``bound``: of accelerations (nv)."""
        assert self._thrusters is not None
        count, (left, told) = len(self._force), (blocks[:, self._at[e]] for e in ("left", "told"))
        pulse = _PULSE * self._thrusters.frame * np.abs(pushes * self._force).max(axis=1)
        return suspect(
            left.reshape(len(blocks), -1, self._nv),
            told[:, :count],
            pushes=pushes,
            force=self._force,
            bound=bound,
            noise=np.hypot(self._noise(memory), pulse),
            in_use=memory.codes[:count] == 0.0,
            step=_EVERY * self._step,
            band=self._settings.band,
            holds=holds,
        )

    def _confirm(self, memory: Memory, suspicions: Sequence[Suspicion], window: int) -> None:
        """Report the thruster of the last window after enough consecutive evaluations have named
        it, with the kind of the best explanation in the window: before and after a fault's start
        two kinds differ by a constant force.
        """
        found = suspicions[-1]
        looks = memory.suspected[_WINDOWS.index(window)]
        before, looks[:] = looks[found.thruster], 0.0
        if found.explained > (_ASKED * self._settings.threshold) ** 2 and found.is_isolated:
            looks[found.thruster] = before + 1.0
            if looks[found.thruster] >= _CONFIRMED:
                same = [each for each in suspicions if each.thruster == found.thruster]
                kind = max(same, key=lambda each: each.explained).kind
                self._notice(memory, self._names[found.thruster], kind)


def _flat(memory: Arrays) -> Arrays:
    """Vectors, without empty ones."""
    return {name: np.ravel(values) for name, values in memory.items() if np.size(values)}


def _extremes(scenario: Scenario, factor: float) -> list[PlantModel]:
    """The models with the lightest and the heaviest payload."""
    payload = scenario.payload
    if factor == 1.0:
        return []
    models = []
    for share in (1.0 / factor, factor):
        inertia = [share * each for each in payload.nominal.inertia]
        nominal = dataclasses.replace(
            payload.nominal, mass=share * payload.nominal.mass, inertia=inertia
        )
        changed = dataclasses.replace(payload, nominal=nominal)
        models.append(make_nominal_plant(dataclasses.replace(scenario, payload=changed)))
    return models


def _white(square: np.ndarray) -> np.ndarray:
    """The noise of a block's mean, from the mean square of the differences of its samples."""
    noise: np.ndarray = np.sqrt(square / (2.0 * _EVERY))
    return noise


def _moved(q: np.ndarray, by: np.ndarray) -> np.ndarray:
    """A configuration (nq) after a rotation vector and differences (nv)."""
    moved = np.concatenate([q[:4], q[4:] + by[3:]])
    moved[:4] = turning_matrix(by[:3]) @ q[:4]
    return moved
