"""What a run took out of its actuators: propellant, pulses and on-times of thrusters, momentum and torque of wheels."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.scenario import Scenario, thrusters_of

if TYPE_CHECKING:
    import xarray as xr

    from ffsm_drake.runs.rollout import RunLog

STANDARD_GRAVITY = 9.80665  # m/s^2; defines the specific impulse
_WHOLE = 1.0 - 1e-9  # the part of a wrench that counts as all of it


def add_thrusters(dataset: "xr.Dataset", scenario: Scenario, series: Mapping[str, np.ndarray]) -> "xr.Dataset":
    """The dataset with what thrusters did, along ``thruster``: their names, with force and specific impulse.

    Args:
      dataset: of a run.
      scenario: of the run; the thrusters of a user-supplied actuation are numbered.
      series: of the run's log.
    """
    count, settings = series["thruster_force"].shape[1], scenario.actuation.thrusters
    own = settings is not None and scenario.blocks.actuation is None
    units = thrusters_of(settings) if own and settings is not None else {}
    names = list(units) or [f"thruster_{i + 1}" for i in range(count)]
    by_thruster = ("time", "thruster")
    for name, meaning, unit in (
        ("thruster_force", "mean force of each thruster from this sample to the next", "N"),
        ("thruster_open", "share of the sample for which each thruster is open", "1"),
    ):
        dataset[name] = (by_thruster, series[name], {"long_name": meaning, "units": unit})
    meaning = "part of the wanted wrench that the last allocation to thrusters could give"
    dataset["thruster_given"] = ("time", series["thruster_given"][:, 0], {"long_name": meaning, "units": "1"})
    dataset = dataset.assign_coords(thruster=names)
    if units:
        impulse = [unit.specific_impulse for unit in units.values()]
        dataset = dataset.assign_coords(
            specific_impulse=("thruster", impulse, {"long_name": "specific impulse", "units": "s"})
        )
    return dataset


def add_wheels(dataset: "xr.Dataset", scenario: Scenario, series: Mapping[str, np.ndarray]) -> "xr.Dataset":
    """The dataset with what wheels did, along ``wheel``; ``angular_momentum`` becomes that of base, arm and wheels.

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
        dataset[name] = (dims, series[name], {"long_name": meaning, "units": unit})
    unloads = {"long_name": "1 while thrusters unload the wheels", "units": "1"}
    dataset["wheel_unloads"] = ("time", series["wheel_unloads"][:, 0], unloads)
    dataset["angular_momentum"] = dataset["angular_momentum"].copy(
        data=dataset["angular_momentum"].values + series["stored_momentum"]
    )
    dataset = dataset.assign_coords(wheel=list(units) or [f"wheel_{i + 1}" for i in range(momentum.shape[1])])
    if not units:
        return dataset
    axes = np.array([np.array(unit.axis, dtype=float) / np.linalg.norm(unit.axis) for unit in units.values()])
    turning = _in_the_base(dataset["position"].values[:, :4], dataset["velocity"].values[:, :3]) @ axes.T
    speed = momentum / np.array([unit.inertia for unit in units.values()]) - turning
    dataset["wheel_speed"] = (by_wheel, speed, {"long_name": "speed of each wheel in the base", "units": "rad/s"})
    limits = {
        name: ("wheel", [getattr(unit, name) for unit in units.values()], {"units": unit})
        for name, unit in (("torque_limit", "N m"), ("speed_limit", "rad/s"))
    }
    return dataset.assign_coords(limits)


def _in_the_base(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors in world axes (n, 3) in those of bodies with attitudes (w, x, y, z) (n, 4)."""
    w, u = quaternions[:, :1], -quaternions[:, 1:]
    twice = 2.0 * np.cross(u, vectors)
    return vectors + (w * twice + np.cross(u, twice)) / (quaternions**2).sum(axis=1)[:, None]


def wheel_metrics(dataset: "xr.Dataset") -> dict[str, Any]:
    """What a run asked of its wheels, as plain numbers; empty for one without, or of a user-supplied block.

    Keys:
      peak_momentum, peak_torque: N m s and N m, of each wheel.
      speed_used, torque_used: the largest share of any wheel's limit.
      torque_limited: share of the samples in which a motor is at its limit.
      unloading: share of the samples in which thrusters unload them.
    """
    if "wheel_speed" not in dataset:
        return {}
    names = dataset["wheel"].values.astype(str).tolist()
    torque = np.abs(dataset["wheel_torque"].values)
    torque_used = torque / dataset["torque_limit"].values
    return {
        "peak_momentum": dict(zip(names, np.abs(dataset["wheel_momentum"].values).max(axis=0).tolist(), strict=True)),
        "peak_torque": dict(zip(names, torque.max(axis=0).tolist(), strict=True)),
        "speed_used": float((np.abs(dataset["wheel_speed"].values) / dataset["speed_limit"].values).max()),
        "torque_used": float(torque_used.max()),
        "torque_limited": float((torque_used > 1.0 - 1e-9).any(axis=1).mean()),
        "unloading": float(dataset["wheel_unloads"].values.mean()),
    }


def thrust_taken(log: "RunLog") -> tuple[float, float]:
    """Propellant (kg) of a run with thrusters of its scenario, and the share of its samples with less than wanted."""
    settings, series, period = log.scenario.actuation.thrusters, log.series, log.scenario.sample_time
    if settings is None or len(log.time) < 2:
        return 0.0, 0.0
    exhaust = STANDARD_GRAVITY * np.array([unit.specific_impulse for unit in thrusters_of(settings).values()])
    impulse = series["thruster_force"][:-1].sum(axis=0) * period
    return float((impulse / exhaust).sum()), float((series["thruster_given"][:-1] < _WHOLE).mean())


def thruster_metrics(dataset: "xr.Dataset") -> dict[str, Any]:
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
