"""The contract of the base's own actuators: what they can give, beside what every part has."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.parts.advice import Advice, Load
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signals


class BaseActuator(Part):
    """Base class of actuators of the base, such as thrusters and wheels.

    Runs with other noise sequences check their limits.
    """

    @property
    def is_helped(self) -> bool:
        """Whether actuators before it supply the torque beyond its limit."""
        return False

    def most(self, scenario: Scenario, directions: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the largest ``torque`` (N m) and ``force`` (N) along each of the directions (n, 3;
        base's axes), for the kinds that it provides.
        """
        raise NotImplementedError(f"{type(self).__name__} needs a method most(...)")

    def reach(self, scenario: Scenario) -> Mapping[str, np.ndarray]:
        """For each kind of ``most`` a matrix (3, n; base's axes). Its columns are the largest
        outputs of its units, or of combinations without any other output.
        """
        return {}

    def saturated(self, signals: Signals) -> np.ndarray:
        """Whether it gives less than was wanted: (n,) from its signals (n, components), or a single
        truth value from those of one sample (components).
        """
        return np.zeros((), dtype=bool)

    def advice(self, scenario: Scenario, load: Load) -> Iterator[Advice]:
        """The remedies for its saturation."""
        yield from ()

    def storage(self, scenario: Scenario) -> Any:
        """Return its storage of angular momentum, as the wheels have it; None if it has none."""
        return None

    def locked(self, scenario: Scenario) -> Scenario:
        """Return the scenario with its rotating masses fixed to the base, for gravity."""
        return scenario
