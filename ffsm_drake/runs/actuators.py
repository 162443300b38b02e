"""What a run took out of its actuators: propellant, pulses and on-times of thrusters."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.scenario import Scenario, thrusters_of

if TYPE_CHECKING:
    import xarray as xr

STANDARD_GRAVITY = 9.80665  # m/s^2; defines the specific impulse


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
    pulses = [pulse_lengths(column, period) for column in opened.T]
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
        "saturated": float((dataset["thruster_given"].values[:-1] < 1.0 - 1e-9).mean()) if len(opened) else 0.0,
    }


def pulse_lengths(opened: np.ndarray, period: float) -> np.ndarray:
    """Lengths (s) of the pulses of a valve that is open for a share (n) of each sample, from the sample's start on."""
    is_open = opened > 0.0
    goes_on = np.r_[False, opened[:-1] == 1.0]  # open up to the sample's start
    starts = np.flatnonzero(is_open & ~goes_on)
    if not starts.size:
        return np.zeros(0)
    return np.add.reduceat(opened, starts) * period
