"""Sensors that break: frozen, biased or silent.

A bias of the base's sensors is in the base's axes. A frozen or silent sensor repeats its last
measurement, in world axes.
"""

from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.so3 import composed, matrix_of, quaternion_of
from ffsm_drake.plugins.estimators.estimators import assumed_noise
from ffsm_drake.scenario import Fault, Scenario
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, Coordinates
from ffsm_drake.systems.faults import BreakingPart, first_sample, hits
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

    def build(self, setup: BlockSetup) -> LeafSystem:
        """The stage."""
        return _Stage(setup)


class _Stage(LeafSystem):
    """Inputs ``state`` and ``true_state``, output ``estimated_state``; for a silent sensor with
    a notice also input and output ``measurement_is_new`` (nq + nv each). Discrete state: the
    last estimate.
    """

    def __init__(self, setup: BlockSetup) -> None:
        super().__init__()
        size, self._step = 2 * len(setup.coordinates.names) + 1, setup.sample_time
        self._sensors = sensors_of(setup.coordinates)
        self._hits = [
            (name, first_sample(fault, setup.sample_time), fault, self._bias(setup, name, fault))
            for name, fault in hits(setup.scenario, "sensing")
        ]
        self._input = self.DeclareVectorInputPort("state", size)
        self._true = self.DeclareVectorInputPort("true_state", size)
        self._held = self.DeclareDiscreteState(size)
        self.DeclareVectorOutputPort("estimated_state", size, weak_callback(self._calc))
        if any(fault.kind == "silent" for _, _, fault, _ in self._hits):
            new = "measurement_is_new"
            self._new = self.DeclareVectorInputPort(new, size)
            self.DeclareVectorOutputPort(new, size, weak_callback(self._calc_new))
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def _bias(self, setup: BlockSetup, name: str, fault: Fault) -> float:
        if fault.size is not None:
            return fault.size
        noise = np.concatenate(assumed_noise(setup.scenario, setup.coordinates))
        return max(_LEAST_BIAS, _NOISES * float(noise[self._sensors[name]].max()))

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Before the start, ``state`` was measured."""
        context.SetDiscreteState(self._held, state)

    def _sample(self, context: Context) -> int:
        return round(context.get_time() / self._step)

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._measured(context))

    def _measured(self, context: Context) -> np.ndarray:
        state, sample = self._input.Eval(context).copy(), self._sample(context)
        held = context.get_discrete_state(self._held).value()
        for name, since, fault, bias in self._hits:
            if sample < since:
                continue
            entries = entries_in_state(self._sensors[name])
            if fault.kind != "biased":
                state[entries] = held[entries]
                continue
            off = np.full(min(entries.size, 3), bias / np.sqrt(min(entries.size, 3)))
            if entries.size == 4:
                state[entries] = composed(state[entries], quaternion_of(off))
            elif entries.size == 3:  # a sensor of the base
                state[entries] += matrix_of(self._true.Eval(context)[:4]) @ off
            else:
                state[entries] += off
        return state

    def _calc_new(self, context: Context, output: BasicVector) -> None:
        new, sample = np.ones(output.size()), self._sample(context)
        if self._new.HasValue(context):
            new = self._new.Eval(context).copy()
        for name, since, fault, _ in self._hits:
            if fault.kind == "silent" and sample >= since:
                new[entries_in_state(self._sensors[name])] = 0.0
        output.SetFromVector(new)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        values.set_value(self._held, self._measured(context))
