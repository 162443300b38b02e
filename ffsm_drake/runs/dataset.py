"""The labelled time series of a run: the signals of its log, and quantities that the true plant
gives for its states.
"""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.numbers import usable
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.recorded_signals import RECORDED_SIGNALS
from ffsm_drake.runs.table import Table
from ffsm_drake.runs.tracking import frame_poses
from ffsm_drake.scenario import NOTHING, Scenario
from ffsm_drake.spacecraft.coordinates import error_rate
from ffsm_drake.spacecraft.grasp import shift_moment
from ffsm_drake.spacecraft.mass_properties import set_payload, spatial_inertia
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_rpy, find_body, hand_frame
from ffsm_drake.systems.controllers import SMALLEST
from ffsm_drake.systems.parts.placed import PlacedPart, with_role
from ffsm_drake.systems.parts.signals import ROLES, STORED_MOMENTUM, values_of

if TYPE_CHECKING:
    import xarray as xr


def make_table(log: RunLog) -> Table:
    """Return the labelled time series of a run."""
    model = log.mission.craft.flexible()
    states = log.whole_states
    values = _values(log, model, states)
    signals = {name: signal for name, signal in RECORDED_SIGNALS.items() if name in values}
    if (sliding := signals.get("sliding_variable")) is not None:
        signals["sliding_variable"] = dataclasses.replace(sliding, unit=log.sliding_unit)
    for name in values:
        # several external forces act, and disturbance_force is their sum
        if name.startswith("force_"):
            meaning = f"external force '{name[6:]}' at this instant"
            signals[name] = dataclasses.replace(signals["disturbance_force"], meaning=meaning)
    table = log.table.assign(
        {
            name: (signal.dims, values[name], signal.meaning, signal.unit)
            for name, signal in signals.items()
        },
        {},
    )
    if log.grasp is not None:
        table = _with_phases(table, log.grasp, log.scenario, model, states)
    for part in log.parts.values():
        table = _with_part(table, log, part)
    return _with_roles(table, log)


def _values(log: RunLog, model: PlantModel, states: np.ndarray) -> dict[str, np.ndarray]:
    """Return the variables of ``RECORDED_SIGNALS`` that a run has, and each external force where
    several act.

    Args:
      log: the run.
      model: the true plant.
      states: its [q; v] at the samples (n, its size).
    """
    scenario, series = log.scenario, log.series
    found = {name: np.asarray(each.of(log)) for name, each in RECORDED_SIGNALS.items() if each.of}
    rates = map(error_rate, log.error, found["desired_velocity"], found["velocity"])
    found |= {"error": log.error, "error_rate": np.array(list(rates))}
    own = {
        name: series[name] for name in series if name in RECORDED_SIGNALS or name[:6] == "force_"
    }
    if SMALLEST in own:
        own[SMALLEST] = own[SMALLEST][:, 0]
    if log.grasp is None:
        momentum, energy = _momentum_and_energy(model, states)
    else:
        momentum, energy = _through_the_grasp(log, log.grasp, model, states)
    desired = log.split.whole_positions(found["desired_position"])
    q = states[:, : model.plant.num_positions()]
    frame = hand_frame(model.plant, scenario.model)
    return {
        **found,
        **own,
        "end_effector_position": frame_poses(model, q, frame)[:, 4:],
        "desired_end_effector_position": frame_poses(model, desired, frame)[:, 4:],
        "base_rpy": base_rpy(found["position"]),
        "desired_base_rpy": base_rpy(found["desired_position"]),
        "linear_momentum": momentum[:, 3:],
        "angular_momentum": momentum[:, :3],
        "kinetic_energy": energy,
    }


def _with_part(table: Table, log: RunLog, part: PlacedPart) -> Table:
    """Return the table with the signals of a part. Raises BlockError if a name is taken."""
    for signal in part.signals:
        place = f"blocks.{part.name}: signal '{signal.name}'"
        if signal.name in table:
            raise BlockError(f"{place} has the name of another variable of the record; rename it")
        values = values_of(signal, log)
        if values is None:
            continue
        column = (signal.dims, values, signal.meaning, signal.unit)
        table = table.assign({signal.name: column}, {})
        if signal.components:
            along = signal.dims[1]
            given = list(signal.components)
            if along not in table:
                table = table.assign({}, {along: (along, given)})
            elif table[along].values.tolist() != given:
                names = ", ".join(map(str, table[along].values.tolist()))
                raise BlockError(f"{place} stands along '{along}', whose components are {names}")
    for constant in part.constants:
        coordinate = (constant.dimension, list(constant.values), constant.meaning, constant.unit)
        table = table.assign({}, {constant.name: coordinate})
    return table


def _with_roles(table: Table, log: RunLog) -> Table:
    """Return the table with the roles of the parts' signals in the balances of momentum and energy
    as attributes; ``angular_momentum`` includes the momentum that parts store.
    """
    roles = {role: " ".join(with_role(log.parts, role)) for role in ROLES}
    columns, stored = dict(table.columns), log.with_role(STORED_MOMENTUM)
    if stored is not None:
        alone = columns["angular_momentum"]
        columns["angular_momentum"] = alone._replace(values=alone.values + stored)
    attrs = {**table.attrs, **{k: v for k, v in roles.items() if v}}
    return dataclasses.replace(table, attrs=attrs, columns=columns)


def _momentum_and_energy(model: PlantModel, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the momentum about the world's origin (n, 6; angular, then linear) and kinetic energy
    (n) of states (n, nq + nv).
    """
    plant, context = model.plant, model.context
    origin = np.zeros(3)
    momentum, energy = np.full((len(states), 6), np.nan), np.full(len(states), np.nan)
    for i in np.flatnonzero(usable(states)):  # not a diverged run's last: Drake ends the process
        plant.SetPositionsAndVelocities(context, states[i])
        momentum[i] = plant.CalcSpatialMomentumInWorldAboutPoint(context, origin).get_coeffs()
        energy[i] = plant.CalcKineticEnergy(context)
    return momentum, energy


def _through_the_grasp(
    log: RunLog, grasp: GraspLog, model: PlantModel, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums for servicer and target, before and after the grasp, as ``_momentum_and_energy``."""
    held = grasp.payload
    context, body = model.context, log.scenario.payload.body
    set_payload(model.plant, context, body=body, properties=NOTHING)
    momentum, energy = _momentum_and_energy(model, states[: grasp.sample])
    set_payload(model.plant, context, body=body, properties=held)
    of_both, energy_of_both = _momentum_and_energy(model, states[grasp.sample :])
    M_PPo_P = spatial_inertia(log.scenario.payload.truth)
    for i, state in enumerate(grasp.target):
        M_PPo_W = M_PPo_P.ReExpress(
            RotationMatrix(Quaternion(state[:4] / np.linalg.norm(state[:4])))
        )
        of_target = M_PPo_W.CopyToFullMatrix6() @ state[7:]
        energy[i] += 0.5 * state[7:] @ of_target
        momentum[i] += shift_moment(of_target, -state[4:7])
    return np.concatenate([momentum, of_both]), np.concatenate([energy, energy_of_both])


def _with_phases(
    table: Table, grasp: GraspLog, scenario: Scenario, model: PlantModel, states: np.ndarray
) -> Table:
    """Return the table with the coordinate ``phase`` along time and the target's pose, held or
    not.
    """
    count = grasp.sample
    body = find_body(model.plant, scenario.payload.body, key="payload.body")
    held = frame_poses(model, states[count:, : model.plant.num_positions()], body.body_frame())
    pose = np.vstack([grasp.target[:, :7], held])
    # one of the two quaternions of a rotation
    pose[:, :4] *= np.sign(pose[:, :1]) + (pose[:, :1] == 0.0)
    frame = "of the target's frame in the world"
    axes = ("time", "quaternion")
    return table.assign(
        {
            "target_position": (("time", "axis"), pose[:, 4:], f"origin {frame} frame", "m"),
            "target_quaternion": (axes, pose[:, :4], f"attitude {frame}", "1"),
        },
        {
            "phase": ("time", grasp.phases + ["stop"] * (len(states) - count)),
            "quaternion": ("quaternion", ["w", "x", "y", "z"]),
        },
    )


def free_target(data: "xr.Dataset") -> dict[int, RigidTransform]:
    """Return the poses of a run's target before the grasp, by sample; none without a capture."""
    if "phase" not in data.coords:
        return {}
    before = np.flatnonzero(data["phase"].values.astype(str) != "stop").tolist()
    turns, places = (data[f"target_{each}"].values for each in ("quaternion", "position"))
    return {
        k: RigidTransform(Quaternion(turns[k] / np.linalg.norm(turns[k])), places[k])
        for k in before
    }
