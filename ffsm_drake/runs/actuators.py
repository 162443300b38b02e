"""What a run took out of its actuators: propellant and pulses of thrusters, momentum of wheels, margins of drives."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.scenario import Scenario, Wheel, own_thrusters
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.systems.actuation.drives import FRICTION_FORCE, FRICTION_WORK, DriveSet

if TYPE_CHECKING:
    from ffsm_drake.runs.rollout import RunLog
    from ffsm_drake.runs.table import Labelled, Table

STANDARD_GRAVITY = 9.80665  # m/s^2; defines the specific impulse
_WHOLE = 1.0 - 1e-9  # the part of a wrench that counts as all of it


def add_thrusters(table: "Table", scenario: Scenario, series: Mapping[str, np.ndarray]) -> "Table":
    """The table with what thrusters did, along ``thruster``: their names, with force and specific impulse.

    Args:
      table: of a run.
      scenario: of the run; the thrusters of a user-supplied actuation are numbered.
      series: of the run's log.
    """
    count, units = series["thruster_force"].shape[1], own_thrusters(scenario)
    names = list(units) or [f"thruster_{i + 1}" for i in range(count)]
    by_thruster = ("time", "thruster")
    for name, meaning, unit in (
        ("thruster_force", "mean force of each thruster from this sample to the next", "N"),
        ("thruster_open", "share of the sample for which each thruster is open", "1"),
    ):
        table = table.assign({name: (by_thruster, series[name], {"long_name": meaning, "units": unit})})
    meaning = "part of the wanted wrench that the last allocation to thrusters could give"
    given = ("time", series["thruster_given"][:, 0], {"long_name": meaning, "units": "1"})
    table = table.assign({"thruster_given": given})
    table = table.assign_coords({"thruster": ("thruster", names)})
    if units:
        impulse = [unit.specific_impulse for unit in units.values()]
        column = ("thruster", impulse, {"long_name": "specific impulse", "units": "s"})
        table = table.assign_coords({"specific_impulse": column})
    return table


def add_wheels(table: "Table", scenario: Scenario, series: Mapping[str, np.ndarray]) -> "Table":
    """The table with what wheels did, along ``wheel``; ``angular_momentum`` becomes that of base, arm and wheels.

    Arguments as for ``add_thrusters``.
    """
    units = scenario.wheels.units if scenario.wheels is not None else {}
    momentum = series["wheel_momentum"]
    by_wheel, by_axis = ("time", "wheel"), ("time", "axis")
    for name, dims, meaning, unit in (
        ("wheel_momentum", by_wheel, "momentum of each wheel about its axis", "N m s"),
        ("wheel_torque", by_wheel, "torque of each wheel's motor from this sample to the next", "N m"),
        ("wheel_reaction", by_axis, "torque of the wheels on the base, part of applied_force, held likewise", "N m"),
        ("stored_momentum", by_axis, "momentum of the wheels in the world frame, part of angular_momentum", "N m s"),
    ):
        table = table.assign({name: (dims, series[name], {"long_name": meaning, "units": unit})})
    unloads = {"long_name": "1 while thrusters unload the wheels", "units": "1"}
    alone = table["angular_momentum"]
    table = table.assign({
        "wheel_unloads": ("time", series["wheel_unloads"][:, 0], unloads),
        "angular_momentum": alone._replace(values=alone.values + series["stored_momentum"]),
    })  # fmt: skip
    names = list(units) or [f"wheel_{i + 1}" for i in range(momentum.shape[1])]
    table = table.assign_coords({"wheel": ("wheel", names)})
    if not units:
        return table
    speed = _speed(units, momentum, table["position"].values[:, :4], table["velocity"].values[:, :3])
    of_speed = {"long_name": "speed of each wheel in the base", "units": "rad/s"}
    table = table.assign({"wheel_speed": (by_wheel, speed, of_speed)})
    limits = {
        name: ("wheel", [getattr(unit, name) for unit in units.values()], {"units": unit})
        for name, unit in (("torque_limit", "N m"), ("speed_limit", "rad/s"))
    }
    return table.assign_coords(limits)


def add_drives(
    table: "Table", scenario: Scenario, coordinates: Coordinates, series: Mapping[str, np.ndarray]
) -> "Table":
    """The table with friction of the joints' drives and, along ``coordinate``, the limits of the drives.

    Arguments as for ``add_thrusters``, and the coordinates.
    """
    for name, meaning, unit in (
        (FRICTION_FORCE, "friction in the drives at this instant", "N m or N"),
        (FRICTION_WORK, "work of friction in the drives since the start", "J"),
    ):
        if name in series:
            column = (("time", "coordinate"), series[name], {"long_name": meaning, "units": unit})
            table = table.assign({name: column})
    if scenario.drives is None:
        return table
    drives = DriveSet(scenario.drives, scenario.actuation.limit, coordinates)
    rates = np.abs(table["velocity"].values)
    base = np.full(NUM_BASE_VELOCITIES, np.inf)
    knee = np.r_[np.zeros(NUM_BASE_VELOCITIES), drives.knee]
    table = table.assign_coords({
        "drive_force_limit": ("coordinate", np.r_[base, drives.force_limit], {"units": "N m or N"}),
        "drive_rate_limit": ("coordinate", np.r_[base, drives.rate_limit], {"units": "rad/s or m/s"}),
        "drive_knee": ("coordinate", knee, {"units": "1"}),
    })  # fmt: skip
    if drives.has_rate_limit:
        shares = rates / table["drive_rate_limit"].values
        of_share = {"long_name": "rate as a share of the drive's limit", "units": "1"}
        table = table.assign({"rate_share": (("time", "coordinate"), shares, of_share)})
    return table


def drive_metrics(dataset: "Labelled") -> dict[str, Any]:
    """What a run asked of the drives of its joints, as plain numbers; empty for one without.

    Keys, by joint; the first two for joints with such a limit:
      force_used: largest share of actuation.limit that was applied.
      rate_used: largest share of the drive's rate limit.
      rate_limited: share of the samples in which the rate cut the force, of any joint.
      peak_friction: N m or N; left out, as what follows, without friction.
      friction_loss: J; taken out by friction over the run.
    """
    if "drive_rate_limit" not in dataset.coords and FRICTION_FORCE not in dataset:
        return {}
    joints = dataset["group"].values.astype(str) == "joints"
    names = dataset["coordinate"].values[joints].astype(str).tolist()

    def of_joints(name: str) -> np.ndarray:
        values: np.ndarray = dataset[name].values[..., joints]
        return values

    result: dict[str, Any] = {}
    if "drive_rate_limit" in dataset.coords:
        for key, name, limit in (
            ("force_used", "applied_force", "drive_force_limit"),
            ("rate_used", "velocity", "drive_rate_limit"),
        ):
            most = of_joints(limit)
            shares = (np.abs(of_joints(name)).max(axis=0) / most).tolist()
            result[key] = {
                name: share for name, share, one in zip(names, shares, most, strict=True) if np.isfinite(one)
            }
    if "rate_share" in dataset:
        share, knee = of_joints("rate_share"), of_joints("drive_knee")
        left = np.clip((1.0 - share) / (1.0 - knee), 0.0, 1.0)  # of the force; see DriveSet.available
        with np.errstate(invalid="ignore"):
            most = left * of_joints("drive_force_limit")
        beyond = (np.abs(of_joints("generalized_force")) > most) & (left < 1.0)
        result["rate_limited"] = float(
            (beyond & (of_joints("generalized_force") * of_joints("velocity") > 0.0)).any(axis=1).mean()
        )
    if FRICTION_FORCE in dataset:
        peak, work = np.abs(of_joints(FRICTION_FORCE)).max(axis=0), of_joints(FRICTION_WORK)
        result["peak_friction"] = dict(zip(names, peak.tolist(), strict=True))
        result["friction_loss"] = dict(zip(names, (work[0] - work[-1]).tolist(), strict=True))
    return result


def _speed(units: Mapping[str, Wheel], momentum: np.ndarray, quaternion: np.ndarray, w_WB: np.ndarray) -> np.ndarray:
    """Speeds of wheels in the base (n, wheels), rad/s, with w_WB (n, 3) in world axes."""
    axes = np.array([np.array(unit.axis, dtype=float) / np.linalg.norm(unit.axis) for unit in units.values()])
    return momentum / np.array([unit.inertia for unit in units.values()]) - _in_the_base(quaternion, w_WB) @ axes.T


def _in_the_base(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors in world axes (n, 3) in those of bodies with attitudes (w, x, y, z) (n, 4)."""
    w, u = quaternions[:, :1], -quaternions[:, 1:]
    twice = 2.0 * np.cross(u, vectors)
    return vectors + (w * twice + np.cross(u, twice)) / (quaternions**2).sum(axis=1)[:, None]


def wheel_metrics(dataset: "Labelled") -> dict[str, Any]:
    """What a run asked of its wheels, as plain numbers; empty for one without, or of a user-supplied block.

    Keys:
      peak_momentum, peak_speed, peak_torque: N m s, rad/s and N m, of each wheel.
      speed_used, torque_used: the largest share of any wheel's limit.
      torque_limited: share of the samples in which a motor is at its limit.
      unloading: share of the samples in which thrusters unload them.
    """
    if "wheel_speed" not in dataset:
        return {}
    names = dataset["wheel"].values.astype(str).tolist()
    torque_used = np.abs(dataset["wheel_torque"].values) / dataset["torque_limit"].values

    def peak(variable: str) -> dict[str, float]:
        return dict(zip(names, np.abs(dataset[variable].values).max(axis=0).tolist(), strict=True))

    return {
        "peak_momentum": peak("wheel_momentum"),
        "peak_speed": peak("wheel_speed"),
        "peak_torque": peak("wheel_torque"),
        "speed_used": float((np.abs(dataset["wheel_speed"].values) / dataset["speed_limit"].values).max()),
        "torque_used": float(torque_used.max()),
        "torque_limited": float((torque_used > 1.0 - 1e-9).any(axis=1).mean()),
        "unloading": float(dataset["wheel_unloads"].values.mean()),
    }


def thrusters_used(log: "RunLog") -> dict[str, float]:
    """Of a run with thrusters of its scenario: propellant (kg), impulse (N s) and pulses of all, share saturated."""
    force, opened = log.series["thruster_force"][:-1], log.series["thruster_open"][:-1]
    period = log.scenario.sample_time
    exhaust = STANDARD_GRAVITY * np.array([unit.specific_impulse for unit in own_thrusters(log.scenario).values()])
    impulse = force.sum(axis=0) * period
    return {
        "propellant": float((impulse / exhaust).sum()),
        "thruster_impulse": float(impulse.sum()),
        "thruster_pulses": float(sum(pulses_of(column, period)[0].size for column in opened.T)),
        "thrusters_saturated": float((log.series["thruster_given"][:-1] < _WHOLE).mean()) if len(force) else 0.0,
    }


def wheels_used(log: "RunLog") -> dict[str, float]:
    """Of a run with wheels of its scenario: the shares of ``wheel_metrics``."""
    units = log.scenario.wheels.units if log.scenario.wheels is not None else {}
    series, state = log.series, log.series["state"]
    w_WB = state[:, len(log.coordinates.position_names) :][:, :3]
    speed = _speed(units, series["wheel_momentum"], state[:, :4], w_WB)
    speed_used = np.abs(speed) / [unit.speed_limit for unit in units.values()]
    torque_used = np.abs(series["wheel_torque"]) / [unit.torque_limit for unit in units.values()]
    return {
        "wheel_speed_used": float(speed_used.max()),
        "wheel_torque_used": float(torque_used.max()),
        "wheels_torque_limited": float((torque_used > 1.0 - 1e-9).any(axis=1).mean()),
        "wheels_unloading": float(series["wheel_unloads"].mean()),
    }


def thruster_metrics(dataset: "Labelled") -> dict[str, Any]:
    """What a run with thrusters took, as plain numbers; empty for one without.

    Keys:
      propellant: kg; left out where no specific impulse is known.
      propellant_of_force: kg; what the commanded base force alone would take of thrusters that push exactly its way,
        the integral of its size over the largest specific impulse: no layout takes less for it.
      impulse: N s, of each thruster.
      pulses: number, of each.
      on_time: s, of each; opened in all.
      shortest_pulse: s; of all pulses that end within the run.
      saturated: share of the samples whose wanted wrench the thrusters could not give whole.
    """
    if "thruster_force" not in dataset:
        return {}
    period, names = float(dataset.attrs["sample_time"]), dataset["thruster"].values.astype(str).tolist()
    impulse = dataset["thruster_force"].values[:-1].sum(axis=0) * period
    opened = dataset["thruster_open"].values[:-1]
    pulses = [pulses_of(column, period)[1] for column in opened.T]
    # The last pulse of a valve that is open at the end is cut off there.
    ended = [each[: each.size - int(column[-1:].sum() == 1.0)] for each, column in zip(pulses, opened.T, strict=True)]
    shortest = min((float(each.min()) for each in ended if each.size), default=None)
    result: dict[str, Any] = {}
    if "specific_impulse" in dataset.coords:
        exhaust = STANDARD_GRAVITY * dataset["specific_impulse"].values
        force = dataset["generalized_force"].values[:-1, dataset["group"].values.astype(str) == "base_position"]
        wanted = float(np.linalg.norm(force, axis=1).sum() * period)
        result = {
            "propellant": float((impulse / exhaust).sum()),
            "propellant_of_force": wanted / float(exhaust.max()),
        }
    return result | {
        "impulse": dict(zip(names, impulse.tolist(), strict=True)),
        "pulses": {name: int(each.size) for name, each in zip(names, pulses, strict=True)},
        "on_time": dict(zip(names, (opened.sum(axis=0) * period).tolist(), strict=True)),
        "shortest_pulse": shortest,
        "saturated": float((dataset["thruster_given"].values[:-1] < _WHOLE).mean()) if len(opened) else 0.0,
    }


def pulses_of(opened: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """The pulses of a valve that is open for a share (n) of each sample, from the sample's start on.

    Returns: the samples in which they start, and their lengths, s.
    """
    goes_on = np.r_[False, opened[:-1] == 1.0]  # open up to the sample's start
    starts = np.flatnonzero((opened > 0.0) & ~goes_on)
    return starts, np.add.reduceat(opened, starts) * period if starts.size else np.zeros(0)
