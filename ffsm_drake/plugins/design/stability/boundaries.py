"""Stability limits of a scenario on its wired loop, one parameter at a time.

Every trial builds the loop again and linearises it at the posture nearest to instability.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.stability.adaptation import adapts, reached_gains
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear, TooLarge
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.scenario import Scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.systems.controllers import complete_gains, declared_gains

LARGEST_FACTOR = 30.0
LARGEST_DELAY = 30  # control samples
_RATIO = 1.3  # ratio of successive factors in the search
LARGEST_TRIED = _RATIO ** math.floor(math.log(LARGEST_FACTOR, _RATIO))
_ACCURACY = 1e-3  # relative accuracy of a factor
MASS = "mass of "  # before the name of a flexible part: its parameter
_FAST = 100.0  # log of a spectral radius, in place of an infinite one


@dataclasses.dataclass(frozen=True, kw_only=True)
class Boundaries:
    """Stability limits, one parameter at a time: the largest stable values. NaN: unstable at the
    given value; infinite: stable at every value tried.
    """

    # factor on all feedback gains of the controller; infinite where it declares none
    gains: float
    nominal_payload: float  # factor on the nominal payload's mass and inertia
    sample_time: float  # factor on the control period
    # by part of ``model.flexible`` that has a mass, and "all": factor on it
    flexible_mass: Mapping[str, float]
    # additional delay of the sensors, unknown to the estimator: the last stable number of control
    # samples
    delay: float
    # the same at the starting K_s; None: adaptation cannot change it, or does not count
    starting: "Boundaries | None" = None

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> limit, see ``variations``."""
        masses = {f"{MASS}{name}": value for name, value in self.flexible_mass.items()}
        factors = {name: getattr(self, name) for name in _FACTORS}
        return {**factors, **masses, "delay": self.delay}


@step("computing stability limits")
def find_boundaries(
    scenario: Scenario, *, time: float | Sequence[float], adapted: bool = True
) -> Boundaries:
    """The boundaries at one posture of the planned motion, or at several; takes some seconds.

    Args:
      scenario: the scenario.
      time: s, the postures; ``Margins.edge_times`` of ``stability``.
      adapted: whether a stable trial must be stable at the K_s that adaptation reaches in it, too
        (``adaptation.reached_gains``).

    Raises ModelError, ScenarioError and BlockError as ``stability`` does.
    """
    scenario, times = complete_gains(scenario), np.atleast_1d(time).tolist()
    given = functools.partial(_find, scenario, times)
    if not adapted:
        return given(adapted=False)
    with Linearizer(scenario) as linearizer:
        has_starting = adapts(linearizer)
    starting = given(adapted=False) if has_starting else None
    return dataclasses.replace(given(adapted=True), starting=starting)


def _find(scenario: Scenario, times: Sequence[float], *, adapted: bool) -> Boundaries:
    masses = dict[str, float]()
    found: dict[str, Any] = {**dict.fromkeys(_FACTORS, math.nan), "delay": math.nan}
    if _radius(scenario, times, adapted=adapted) < 1.0:
        found["gains"] = math.inf
        for name, vary in variations(scenario).items():
            with step(name.replace("_", " ")):
                limit = _limit(name, vary, times, adapted=adapted)
            (masses if name.startswith(MASS) else found)[name.removeprefix(MASS)] = limit
    return Boundaries(**found, flexible_mass=masses)


def variations(scenario: Scenario) -> dict[str, Callable[[float], Scenario]]:
    """What is varied, by parameter: factor -> the scenario with that times the factor; ``delay``:
    further control samples, unknown to the estimator. The gains of the scenario must be complete.
    """
    heavy = [
        name for name, part in scenario.model.flexible.items() if part.kind not in ("joint", "gear")
    ]
    parts = {name: [name] for name in heavy} | ({"all": heavy} if len(heavy) > 1 else {})
    factors = dict(_FACTORS)
    if not feedback_gains(scenario):
        del factors["gains"]
    return {
        **{name: functools.partial(change, scenario) for name, change in factors.items()},
        **{
            f"{MASS}{name}": functools.partial(with_flexible_mass, scenario, names)
            for name, names in parts.items()
        },
        "delay": functools.partial(with_delay, scenario),
    }


def feedback_gains(scenario: Scenario) -> list[str]:
    """Names of the feedback gains that a scenario's law declares."""
    return [name for name, gain in declared_gains(scenario).items() if gain.feedback]


def largest_stable(scenario: Scenario, parameter: str, *, time: float) -> float:
    """One limit (``Boundaries.values``) at the starting K_s. Errors: see ``find_boundaries``."""
    if _radius(scenario, [time], adapted=False) >= 1.0:
        return math.nan
    return _limit(parameter, variations(scenario)[parameter], [time], adapted=False)


def _limit(
    parameter: str,
    vary: Callable[[float], Scenario],
    times: Sequence[float],
    *,
    adapted: bool,
) -> float:
    def radius(size: float) -> float:
        return probed_radius(vary(size), times, adapted=adapted)

    return _largest_delay(radius) if parameter == "delay" else _largest_factor(radius)


def _radius(scenario: Scenario, times: Sequence[float], *, adapted: bool) -> float:
    """The largest spectral radius at some times, s; with ``adapted`` at the starting K_s, and at
    the K_s that adaptation reaches.
    """
    with Linearizer(scenario) as linearizer:

        def worst(held: Mapping[str, np.ndarray] | None = None) -> float:
            return max(linearizer.at(time, held=held).spectral_radius for time in times)

        start, reached = worst(), 0.0
        for held, _ in reached_gains(linearizer) if adapted and start < 1.0 else ():
            reached = worst(held)
            if reached < 1.0:
                break
        return max(start, reached)


def probed_radius(changed: Scenario, times: Sequence[float], *, adapted: bool) -> float:
    """The spectral radius of a trial, see ``_radius``; infinite where its loop, other than that of
    the scenario itself, cannot be linearised: a user-supplied law may cease to be smooth as it
    leaves its plan.
    """
    try:
        return _radius(changed, times, adapted=adapted)
    except TooLarge:
        raise
    except NotLinear:
        return math.inf


def _largest_delay(radius: Callable[[float], float]) -> float:
    for further in range(1, LARGEST_DELAY + 1):
        try:
            if radius(further) >= 1.0:
                return float(further - 1)
        except TooLarge:  # not an instability: the search range ends
            break
    return math.inf


def with_gains(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with every feedback gain of its controller times a factor. Its gains must be
    complete.
    """
    feedback = feedback_gains(scenario)

    def scale(name: str, value: Any) -> Any:
        if name not in feedback or value is None:
            return value
        return {each: factor * number for each, number in value.items()}

    return scenario.with_gains({name: scale(name, x) for name, x in scenario.gains.items()})


def with_nominal_payload(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with the nominal payload's mass and inertia times a factor."""
    data = scenario_to_dict(scenario)
    nominal = data["payload"]["nominal"]
    nominal["mass"] *= factor
    nominal["inertia"] = [factor * value for value in nominal["inertia"]]
    return scenario_from_dict(data)


def with_sample_time(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with its control period times a factor."""
    return dataclasses.replace(scenario, sample_time=factor * scenario.sample_time)


# Parameters that are factors.
_FACTORS: Mapping[str, Callable[[Scenario, float], Scenario]] = {
    "gains": with_gains,
    "nominal_payload": with_nominal_payload,
    "sample_time": with_sample_time,
}


def with_flexible_mass(scenario: Scenario, names: Collection[str], factor: float) -> Scenario:
    """The scenario with the masses of named parts of ``model.flexible`` times a factor, at the same
    frequencies.
    """
    parts = {
        name: dataclasses.replace(
            part,
            mass=factor * part.mass,
            stiffness=None if part.stiffness is None else factor * part.stiffness,
        )
        if name in names
        else part
        for name, part in scenario.model.flexible.items()
    }
    return dataclasses.replace(scenario, model=dataclasses.replace(scenario.model, flexible=parts))


def with_delay(scenario: Scenario, further: float) -> Scenario:
    """The scenario with further control samples of delay of its sensors, unknown to its
    estimator.
    """
    delay = scenario.sensing.delay + int(further)
    known = scenario.sensing.delay if scenario.estimator.delay is None else scenario.estimator.delay
    return dataclasses.replace(
        scenario,
        sensing=dataclasses.replace(scenario.sensing, delay=delay, delay_time=None),
        estimator=dataclasses.replace(scenario.estimator, delay=known),
    )


def _largest_factor(radius: Callable[[float], float]) -> float:
    """The largest stable factor from 1 up, by a loop's spectral radius; infinite where the
    loop is stable over the whole search range, or up to a model that cannot be built (a part
    outweighs its carrier).
    """
    from scipy.optimize import brentq

    stable = 1.0

    def growth(factor: float) -> float:
        nonlocal stable
        found = radius(factor)
        if found < 1.0:
            stable = max(stable, factor)
        return math.log(found) if math.isfinite(found) else _FAST

    outside = _RATIO
    try:
        while growth(outside) < 0.0:
            outside *= _RATIO
            if outside > LARGEST_FACTOR:
                return float("inf")
    except ModelError:
        return float("inf")
    # it ends with a stable and an unstable factor so near to each other
    brentq(growth, stable, outside, xtol=1e-12, rtol=_ACCURACY)
    return stable
