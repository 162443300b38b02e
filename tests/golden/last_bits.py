"""Changes in the last bits of a run: what another processor's rounding may do to it."""

import copy
import dataclasses
import hashlib
from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from ffsm_drake import Part, Scenario, setting
from ffsm_drake.scenario import scenario_from_dict, scenario_to_dict

# Where a scenario says how a run starts and what disturbs it.
SECTIONS = ("initial_posture", "initial_velocity", "payload", "disturbance", "sensing")
STEP = 2.0**-52  # relative


@dataclasses.dataclass(frozen=True, kw_only=True)
class LastBits(Part):
    """A stage of sensing that changes the last bits of each measured number, drawn anew at every
    control sample.
    """

    seed: int = setting(0, "1", "of what is drawn", least=0)

    def build(self, setup):
        return _Rounded(2 * len(setup.coordinates.names) + 1, self.seed)


class _Rounded(LeafSystem):
    def __init__(self, size, seed):
        super().__init__()
        self._size, self._seed = size, seed
        self._state = self.DeclareVectorInputPort("state", size)
        self.DeclareVectorOutputPort("estimated_state", size, self._calc)

    def _calc(self, context, output):
        text = f"{self._seed} {context.get_time():.6f}".encode()
        draws = np.random.default_rng(list(hashlib.sha256(text).digest()))
        state = np.array(self._state.Eval(context))
        output.SetFromVector(state * (1.0 + STEP * draws.integers(-1, 2, self._size)))


def with_other_last_bits(scenario: Scenario, seed: int) -> Scenario:
    """The scenario with its initial state, disturbance and noise changed in their last bits, and
    with ``LastBits`` behind its sensors.
    """
    draws = np.random.default_rng(seed)

    def changed(tree: Any) -> Any:
        if isinstance(tree, dict):
            return {key: changed(value) for key, value in tree.items()}
        if isinstance(tree, list):
            return [changed(value) for value in tree]
        return tree * (1.0 + STEP * float(draws.integers(-2, 3))) if type(tree) is float else tree

    data = copy.deepcopy(scenario_to_dict(scenario))
    for section in SECTIONS:
        data[section] = changed(data[section])
    stage = {"system": "last_bits:LastBits", "settings": {"seed": seed}}
    data["blocks"]["sensing"] = {"last_bits": stage}
    return scenario_from_dict(data)
