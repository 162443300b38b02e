"""A scenario without the settings that have no derivative: limits and quantisation."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.estimators.assumed_noise import assumed_noise
from ffsm_drake.scenario import Actuation, Drives, Estimator, PerCoordinate, Scenario, Sensing
from ffsm_drake.spacecraft.coordinates import Coordinates

_T = TypeVar("_T", Actuation, Drives)
# Settings of actuation and drives without a derivative: the linear loop has their defaults.
NOT_LINEAR = {"actuation": ("limit", "quantization"), "drives": ("rate_limit",)}


def without_limits(mission: Mission) -> Scenario:
    """The scenario without quantisation, barriers, supervisor, faults, plumes and rough effects,
    and with the defaults of ``NOT_LINEAR``.
    """
    scenario, coordinates = mission.scenario, mission.craft.coordinates
    sensing = smooth_sensing(scenario, coordinates)
    estimator, actuation = scenario.estimator, scenario.actuation
    if sensing is not scenario.sensing:  # the estimator keeps its assumptions
        estimator = _with_assumptions(scenario, coordinates)
    if actuation.drives is not None:
        drives = _with_defaults(actuation.drives, NOT_LINEAR["drives"])
        actuation = dataclasses.replace(actuation, drives=drives)
    actuation = _with_defaults(actuation, NOT_LINEAR["actuation"])
    if actuation.thrusters is not None:  # plumes push with pulses
        thrusters = dataclasses.replace(actuation.thrusters, plume=None)
        actuation = dataclasses.replace(actuation, thrusters=thrusters)
    return dataclasses.replace(
        scenario,
        sensing=sensing,
        estimator=estimator,
        actuation=actuation,
        command_filter=dataclasses.replace(scenario.command_filter, barriers=None),
        supervisor=None,
        faults=None,
        effects=_smooth_effects(scenario.effects),
    )


def _smooth_effects(effects: Any) -> Any:
    """Effects of a scenario without a lossy link and backlash."""
    given = [
        name
        for name in ("link", "sensor_link", "backlash")
        if getattr(effects, name, None) is not None
    ]
    return dataclasses.replace(effects, **dict.fromkeys(given))


def _with_defaults(settings: _T, names: Sequence[str]) -> _T:
    default = type(settings)()
    return dataclasses.replace(settings, **{name: getattr(default, name) for name in names})


def smooth_sensing(scenario: Scenario, names: Coordinates) -> Sensing:
    """The sensors with the variance of the quantisation's sawtooth as noise in its place."""
    sensing = scenario.sensing
    if not any((*sensing.position_quantization.values(), *sensing.velocity_quantization.values())):
        return sensing

    def noise(part: str) -> PerCoordinate:
        sigma, step = (
            names.vector(getattr(sensing, key), key=f"sensing.{key}", default=0.0)
            for key in (f"{part}_noise", f"{part}_quantization")
        )
        return names.by_name(np.hypot(sigma, step / math.sqrt(12.0)))

    return dataclasses.replace(
        sensing,
        position_noise=noise("position"),
        velocity_noise=noise("velocity"),
        position_quantization={},
        velocity_quantization={},
    )


def _with_assumptions(scenario: Scenario, coordinates: Coordinates) -> Estimator:
    """The estimator with the noises that it takes from the sensors written out."""
    position, velocity = assumed_noise(scenario, coordinates)
    return dataclasses.replace(
        scenario.estimator,
        position_noise=coordinates.by_name(position),
        velocity_noise=coordinates.by_name(velocity),
    )
