"""Sensors that break. ``SENSOR_FAULTS`` lists the kinds; ``SensorFault.shown`` is what they show.

A bias of the base's sensors is in the base's axes. A sensor that repeats its last measurement does
so in world axes.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.common.choice import choose
from ffsm_drake.common.so3 import composed, matrix_of, quaternion_of
from ffsm_drake.plugins.estimators.assumed_noise import assumed_noise
from ffsm_drake.scenario import FaultKind, Scenario
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, Coordinates
from ffsm_drake.systems.faults import BreakingPart, Hit, Occurrence, hits, settle_faults
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.signals import Signal, View
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.sensing.block import IS_NEW
from ffsm_drake.systems.setup import BlockSetup

_VELOCITY = "_velocity"
_LEAST_BIAS, _NOISES = 0.01, 20.0


def sensors_of(coordinates: Coordinates) -> dict[str, np.ndarray]:
    """Sensors by name -> their entries in [positions; velocities] (2 nv): of the attitude, the
    position and each joint, and of their velocities.
    """
    groups: dict[str, tuple[str, ...]] = {
        "base_rotation": BASE_ROTATION,
        "base_position": BASE_POSITION,
    }
    groups |= {name: (name,) for name in coordinates.joints}
    found = {
        name: np.array([coordinates.names.index(e) for e in of]) for name, of in groups.items()
    }
    nv = len(coordinates.names)
    return found | {f"{name}{_VELOCITY}": entries + nv for name, entries in found.items()}


def entries_in_state(entries: np.ndarray) -> np.ndarray:
    """Entries of [q; v] (2 nv + 1) from those of [positions; velocities]; the attitude has four."""
    return np.arange(4) if entries[0] == 0 else entries + 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorFaultKind(FaultKind):
    """A kind of fault of a sensor."""

    repeats: bool = False  # the sensor repeats its last measurement,
    reports: bool = False  # and reports that there is no new one
    is_biased: bool = False


SENSOR_FAULTS = (
    SensorFaultKind(name="frozen", effect="the last measurement is repeated", repeats=True),
    SensorFaultKind(
        name="silent",
        effect="as `frozen`, but the sensor reports that there is no new measurement",
        repeats=True,
        reports=True,
    ),
    SensorFaultKind(
        name="biased",
        effect="a constant error of length `size` (rad, m, rad/s, m/s), with equal parts in all "
        "axes",
        size="the bias",
        is_biased=True,
    ),
    SensorFaultKind(
        name="dropout",
        effect="as `silent`, at the share `size` of the control samples, at random",
        size="share of the samples that are lost",
        is_share=True,
        default=0.5,
        at_random=True,
        repeats=True,
        reports=True,
    ),
)


def reports_losses(scenario: Scenario) -> bool:
    """Whether a sensor of a settled scenario reports lost measurements."""
    return any(hit.kind.reports for hit in hits(scenario, FaultySensors.fails_as))


def _lost(run: View | BlockSetup, time: np.ndarray) -> dict[str, np.ndarray]:
    """Sensor, with its name in ``faults`` -> whether a fault lost its samples at times (n), s."""
    scenario = settle_faults(run.scenario, run.coordinates)
    samples = np.rint(time / scenario.sample_time).astype(int)
    found = dict[str, np.ndarray]()
    for hit in hits(scenario, FaultySensors.fails_as):
        if hit.kind.reports:
            name = f"sensing.{hit.unit}"
            found[name] = found.get(name, False) | hit.occurs.at(samples)
    return found


class FaultySensors(BreakingPart):
    """Sensors affected by ``faults``: the last stage of the section ``sensing``."""

    title, fails_as, fault_kinds = "Faulty sensors", "sensing", SENSOR_FAULTS

    @classmethod
    def failing_units(cls, scenario: Scenario, coordinates: Coordinates) -> Iterable[str]:
        """Every sensor."""
        return sensors_of(coordinates)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Lost samples of each sensor that loses some."""
        lost = Signal(
            name="sample_lost",
            unit="1",
            meaning="1: a fault lost this sample of the sensor",
            components=tuple(_lost(setup, np.zeros(0))),
            of=lambda run: np.column_stack([*_lost(run, run.time).values()]),
            heading="",
        )
        return (lost,) if lost.components else ()

    def metrics(self) -> Sequence[Metric]:
        """Numbers of lost samples."""

        def count(run: View) -> dict[str, int]:
            return {name: lost.sum() for name, lost in _lost(run, run.time).items()}

        key = "faults.samples_lost"
        return (Metric(key=key, unit="1", label="Samples lost by", column="", of=count),)

    def build(self, setup: BlockSetup) -> "SensorFaults":
        """The stage."""
        found = hits(setup.scenario, self.fails_as)
        return SensorFaults(
            faults=tuple(SensorFault.of(setup, hit) for hit in found),
            size=2 * len(setup.coordinates.names) + 1,
            notices=reports_losses(setup.scenario),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorFault:
    """A fault of a sensor, as vectors along [q; v] (nq + nv)."""

    occurs: Occurrence
    kept: np.ndarray  # 1: it repeats the last measurement
    silent: np.ndarray  # 1: with a notice
    biased: np.ndarray  # 1: it has a bias
    turn: np.ndarray  # (4) the attitude's, a quaternion
    bias: np.ndarray  # the others', of vectors in the base's axes
    in_phase: ClassVar = ("occurs",)

    @classmethod
    def of(cls, setup: BlockSetup, hit: Hit) -> "SensorFault":
        """Return a fault of a sensor."""
        sensor, kind = sensors_of(setup.coordinates)[hit.unit], hit.kind
        entries, size = entries_in_state(sensor), 2 * len(setup.coordinates.names) + 1
        own = np.zeros(size)
        own[entries] = 1.0
        offset = hit.size
        if offset is None or not kind.is_biased:
            noise = np.concatenate(assumed_noise(setup.scenario, setup.coordinates))
            offset = max(_LEAST_BIAS, _NOISES * float(noise[sensor].max()))
        off = np.full(sensor.size, offset / np.sqrt(sensor.size))
        turn, bias = quaternion_of(np.zeros(3)), np.zeros(size)
        if entries[0] == 0:
            turn = quaternion_of(off)
        else:
            bias[entries] = off
        return cls(
            occurs=hit.occurs,
            kept=own * kind.repeats,
            silent=own * kind.reports,
            biased=own * kind.is_biased,
            turn=turn,
            bias=bias,
        )

    def shown(self, state: np.ndarray, held: np.ndarray, true: np.ndarray) -> np.ndarray:
        """What the sensors show (nq + nv).

        Args: their measurement without the fault, the one before, and the true state.
        """
        shift, R, velocity = self.bias.copy(), matrix_of(true[:4]), len(state) // 2 + 1
        for first in (4, velocity, velocity + 3):
            shift[first : first + 3] = R @ shift[first : first + 3]
        biased = np.concatenate([composed(state[:4], self.turn), state[4:] + shift[4:]])
        return np.where(self.kept != 0.0, held, np.where(self.biased != 0.0, biased, state))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorFaults(Sampled):
    """Inputs ``state`` and ``true_state``, output ``estimated_state``; for a silent sensor with
    a notice also input and output ``measurement_is_new`` (nq + nv each). Memory: the last estimate.
    Phase: whether each fault is there.
    """

    faults: tuple[SensorFault, ...]
    size: int
    notices: bool
    optional: ClassVar = (IS_NEW,)

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return dict.fromkeys(("state", "true_state", IS_NEW)[: 2 + self.notices], self.size)

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return dict.fromkeys(("estimated_state", IS_NEW)[: 1 + self.notices], self.size)

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled; before the start the state was measured."""
        return {"held": np.zeros(self.size) if state is None else state}

    def phase(self, sample: Any) -> Sequence[Any]:
        """See Sampled."""
        return [fault.occurs.at(sample) for fault in self.faults]

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        true, state = inputs["true_state"], inputs["state"]
        new = inputs.get(IS_NEW, np.ones(self.size))
        for fault, is_there in zip(self.faults, now.phase, strict=True):
            shown = functools.partial(fault.shown, state, memory["held"], true)
            state = choose(is_there, shown, state)
            new = new * (1.0 - is_there * fault.silent)
        outputs = {"estimated_state": state, IS_NEW: new}
        return {name: outputs[name] for name in self.outputs}, {"held": state}
