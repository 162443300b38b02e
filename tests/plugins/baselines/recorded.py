"""What a law reads at the samples of a run on Drake, and the nominal model's terms there."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from ffsm_drake import load_scenario, make_rollout
from ffsm_drake.mission import Mission
from ffsm_drake.spacecraft.coordinates import halves


@dataclasses.dataclass(frozen=True)
class Recorded:
    """One sample: H (nv, nv), b = C v, errors, accelerations and forces (nv)."""

    time: float
    H: np.ndarray
    b: np.ndarray
    v: np.ndarray
    e: np.ndarray
    e_dot: np.ndarray
    a_d: np.ndarray
    applied: np.ndarray  # over the last period
    commanded: np.ndarray  # at this sample


def samples(name: str, given: list[str]) -> tuple[Any, list[Recorded]]:
    """The log of a run, and its samples."""
    mission = Mission(load_scenario(name, given))
    log, model = make_rollout(mission).run(), mission.craft.nominal()
    return log, list(_rows(log, model))


def _rows(log: Any, model: Any) -> Iterator[Recorded]:
    applied = np.zeros(log["generalized_force"].shape[1])
    for k, time in enumerate(log.time):
        measured, desired = log["measurement"][k], log["desired_state"][k]
        q, v = halves(measured)
        e, e_dot = model.calc_tracking_errors(desired, measured, q.size)
        yield Recorded(
            time=time,
            H=model.calc_mass_matrix(q),
            b=model.calc_bias(q, v),
            v=v,
            e=e,
            e_dot=e_dot,
            a_d=log["desired_acceleration"][k],
            applied=applied,
            commanded=log["generalized_force"][k],
        )
        applied = log["applied_force"][k]
