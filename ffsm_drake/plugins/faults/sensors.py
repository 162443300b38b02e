"""Sensors that break: frozen, biased or silent.

A bias of the base's sensors is in the base's axes. A frozen or silent sensor repeats its last
measurement, in world axes.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.common.choice import choose
from ffsm_drake.common.so3 import composed, matrix_of, quaternion_of
from ffsm_drake.plugins.estimators.assumed_noise import assumed_noise
from ffsm_drake.scenario import Fault, Scenario
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, Coordinates
from ffsm_drake.systems.faults import BreakingPart, first_sample, hits
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


class FaultySensors(BreakingPart):
    """Sensors affected by ``faults``: the last stage of the section ``sensing``."""

    title, hit_as = "Faulty sensors", "sensing"

    @classmethod
    def known_faults(cls, scenario: Scenario, coordinates: Coordinates) -> Mapping[str, list[str]]:
        """Any sensor may freeze, get a bias, or fall silent."""
        kinds = ["frozen", "biased", "silent"]
        return {f"sensing.{name}": kinds for name in sensors_of(coordinates)}

    def build(self, setup: BlockSetup) -> "SensorFaults":
        """The stage."""
        found = hits(setup.scenario, "sensing")
        return SensorFaults(
            faults=tuple(SensorFault.of(setup, name, fault) for name, fault in found),
            size=2 * len(setup.coordinates.names) + 1,
            notices=any(fault.kind == "silent" for _, fault in found),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorFault:
    """A fault of a sensor, as vectors along [q; v] (nq + nv)."""

    first: int  # control sample with it
    kept: np.ndarray  # 1: it repeats the last measurement
    silent: np.ndarray  # 1: with a notice
    biased: np.ndarray  # 1: it has a bias
    turn: np.ndarray  # (4) the attitude's, a quaternion
    bias: np.ndarray  # the others', of vectors in the base's axes
    in_phase: ClassVar = ("first",)

    @classmethod
    def of(cls, setup: BlockSetup, name: str, fault: Fault) -> "SensorFault":
        """Return a fault of the sensor of this name."""
        sensor = sensors_of(setup.coordinates)[name]
        entries, size = entries_in_state(sensor), 2 * len(setup.coordinates.names) + 1
        masks = dict[str, np.ndarray]()
        for mask, kinds in (("kept", "frozen silent"), ("silent", "silent"), ("biased", "biased")):
            masks[mask] = np.zeros(size)
            masks[mask][entries] = fault.kind in kinds.split()
        offset = fault.size
        if offset is None:
            noise = np.concatenate(assumed_noise(setup.scenario, setup.coordinates))
            offset = max(_LEAST_BIAS, _NOISES * float(noise[sensor].max()))
        off = np.full(sensor.size, offset / np.sqrt(sensor.size))
        turn, bias = quaternion_of(np.zeros(3)), np.zeros(size)
        if entries[0] == 0:
            turn = quaternion_of(off)
        else:
            bias[entries] = off
        first = first_sample(fault, setup.sample_time)
        return cls(first=first, turn=turn, bias=bias, **masks)

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
        return [sample >= fault.first for fault in self.faults]

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
