"""Fault detection of the flight software: the last stage of the section ``sensing``.

At each sample it compares measurements with the commands of the actuators:

- a sensor is silent if it reports no new measurement; frozen if it repeats its bits while others
  move; biased if a position jumps by more than its velocity explains, or a velocity differs from
  its position's slope;
- a wheel has stopped if its momentum, from its tachometer, does not follow the commanded torque;
- joints and thrusters: see ``plugins.faults.motion_watch``.

A lost position is extrapolated with its velocity, a lost velocity comes from an observer of
position and reported force, a bias is subtracted (base sensors: in the base's axes). A lost
thruster or wheel leaves the allocation. A jammed joint, or the loss of a unit essential to the
allocation, raises ``abort_request``. A sensor that measures again is read again; actuators stay
isolated, and an abort stays requested.
"""

import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ffsm_drake.loop.blocks import WRENCH
from ffsm_drake.plugins.faults.force_watch import ForceWatch
from ffsm_drake.plugins.faults.known import KINDS, units_of
from ffsm_drake.plugins.faults.memory import HEAD, Memory
from ffsm_drake.plugins.faults.sensor_watch import JUMP
from ffsm_drake.plugins.faults.windows import BATCH, EVERY
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.faults import detects
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signal, View
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.sensing.block import IS_NEW
from ffsm_drake.systems.setup import BlockSetup


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
                components=tuple(units_of(setup.scenario, setup.coordinates)),
                dimension="fault_unit",
                heading="",
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """Numbers and times of detections, and times of the ends of faults."""
        by_name = functools.partial(Metric, column="")

        def of(pick: Callable[[np.ndarray], float]) -> Callable[[View], dict[str, float]]:
            return lambda run: {name: pick(turns) for name, turns in _turns(run).items()}

        def ended(run: View) -> dict[str, float]:
            return {name: turns[-1] for name, turns in _turns(run).items() if len(turns) % 2 == 0}

        return (
            by_name(key="faults.noticed", unit="s", of=of(lambda turns: turns[0])),
            by_name(key="faults.noticed_last", unit="s", of=of(lambda turns: turns[::2][-1])),
            by_name(key="faults.detections", unit="1", of=of(lambda turns: len(turns[::2]))),
            by_name(key="faults.ended", unit="s", of=ended),
        )

    def sentence(self, figures: Sequence[Figure]) -> str:
        """Detected faults with their times."""
        noticed, last, detections, ended = by_key(figures).values()
        listed = list[str]()
        for name, time in noticed.items():
            when = f"at {time:.2f} s"
            if detections[name] > 1:
                when = f"{detections[name]} times, first {when}, last at {last[name]:.2f} s"
            if name in ended:
                when += f" (works again since {ended[name]:.2f} s)"
            listed.append(f"{name} {when}")
        return f"Faults detected: {', '.join(listed) or 'none'}"


def _turns(run: View) -> dict[str, np.ndarray]:
    """Unit and kind -> times at which its detections begin and end, in turn, s; sorted by the first
    detection.
    """
    found = dict[str, np.ndarray]()
    units = units_of(run.scenario, run.coordinates)
    for unit, codes in zip(units, run["fault_detected"].T, strict=True):
        for code in np.unique(codes[codes > 0.0]):
            is_found = np.concatenate([[False], codes == code])
            found[f"{unit} {KINDS[int(code)]}"] = run.time[np.diff(is_found)]
    return dict(sorted(found.items(), key=lambda item: item[1][0]))


class Detector(ForceWatch, Sampled):
    """Inputs: those of the block; of actuators ``told_force`` (nv), and, where they have them,
    ``gyroscopic_force`` (nv), ``told_units`` and ``wheel_momentum``; of contacts that close loops,
    ``measured_wrench``. Outputs: the block's, ``fault_detected``, ``abort_request``, and with
    thrusters or wheels ``isolated``, as found at the sample before.
    """

    traced = False

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        size, nv, wheels = self._nq + self._nv, self._nv, self._num_wheels
        found = {
            "state": size, "told_force": nv, IS_NEW: size * self._may_be_old,
            "told_units": self._num_units, "gyroscopic_force": nv if wheels else 0,
            "wheel_momentum": wheels, WRENCH: self._wrists.size,
        }  # fmt: skip
        return {name: number for name, number in found.items() if number}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        size = self._nq + self._nv
        found = {
            "estimated_state": size, IS_NEW: size * self._may_be_old,
            "fault_detected": len(self.units), "abort_request": 1, "isolated": self._num_units,
        }  # fmt: skip
        return {name: number for name, number in found.items() if number}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled; before the start the state was measured."""
        memory = self._layout.start(len(self.units))
        memory.leg = -1.0  # of no payload
        if state is not None:
            memory.raw[:] = memory.seen[:] = memory.observed[:] = state
        return memory.arrays()

    def remembered(self, memory: Arrays) -> Memory:
        """A copy of the memory by names."""
        return Memory(self._layout, memory)

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        before, row, new = memory["codes"], self._row(inputs), inputs.get(IS_NEW)
        leg, count, limit, _ = memory["rows"][: len(HEAD)].tolist()
        seen, after, width = inputs["state"], dict(memory), self._layout.rows[1]
        last = len(HEAD) + int(count) * width
        may_wait = leg == self._leg and count + 1.0 < limit and (new is None or new.all())
        room = memory["own"][self._layout.places["room"]]
        if may_wait and self._is_usual(memory["rows"][last : last + seen.size], seen, room):
            rows = memory["rows"].copy()
            rows[last + width : last + width + row.size], rows[1] = row, count + 1.0
            after["rows"] = rows
        else:
            changed = self._looked_at(self.remembered(memory), row)
            seen, after = changed.seen.copy(), dict(changed.arrays())
        outputs = {
            "estimated_state": seen, "fault_detected": before,
            "abort_request": memory["abort_request"],
        }  # fmt: skip
        if new is not None:
            outputs[IS_NEW] = self._renewed(new, before) if before.any() else new
        if self._num_units:
            outputs["isolated"] = self._isolated(before)
        return outputs, after

    def _row(self, inputs: Arrays) -> np.ndarray:
        """What is kept of a sample: the columns up to ``slip``."""
        force, parts = inputs["told_force"], [inputs["state"]]
        if self._num_units:
            parts.append(inputs["told_units"])
        if self._wheels is not None:
            force = force + inputs["gyroscopic_force"]
            parts.append(inputs["wheel_momentum"])
        pressed = np.zeros(self._nv * self._has_wrists)
        if self._wrists.size:
            at_wrists, pressed = self._wrists.along(inputs["state"][: self._nq], inputs[WRENCH])
            force = force + at_wrists
        parts += [force, pressed]
        if self._may_be_old:
            parts.append(inputs[IS_NEW])
        return np.concatenate(parts)

    def _looked_at(self, memory: Memory, row: np.ndarray) -> Memory:
        """The memory with a sample and those that waited; ``seen`` is the state without lost
        sensors.
        """
        is_first = memory.leg != self._leg
        if is_first and memory.leg >= 0.0:  # the last sample may have waited
            memory.seen[:] = memory.rows[int(memory.count), : memory.seen.size]
        memory.count = 0.0 if is_first else memory.count + 1.0
        at = int(memory.count)
        memory.rows[at, : row.size] = row
        if is_first:
            memory.leg, memory.samples, memory.done = self._leg, 0.0, 0.0
            self._forget(memory)
            self._begin(memory)
            self._correct(memory, memory.rows[:1], is_first=True)
            memory.raw[:] = row[: memory.raw.size]
            memory.rows[0, : memory.raw.size] = memory.seen
        else:
            self._look_at_samples(memory)
            if at % EVERY == 0 and at >= memory.limit:
                memory = self._with_batch(memory, at)
        blocks = 1.0 if memory.tries else BATCH - memory.clock % BATCH
        memory.limit = blocks * EVERY * self._are_calm(memory)
        # smaller jumps are found with the others of a batch
        memory.room[:] = np.maximum(JUMP, self._settings.threshold * np.sqrt(memory.jitter))
        return memory

    def _with_batch(self, memory: Memory, size: int) -> Memory:
        """The memory with a batch of so many samples: looked at together, and if there is evidence,
        anew block by block.
        """
        together = self.remembered(memory.arrays()) if size > EVERY else memory
        if size > EVERY:
            self._look_at_blocks(together, self._collect(together, 0, size))
        if together is memory or together.tries:
            for first in range(0, size, EVERY):
                self._look_at_blocks(memory, self._collect(memory, first, EVERY))
            together = memory
        together.rows[0], together.count, together.done = together.rows[size], 0.0, 0.0
        return together
