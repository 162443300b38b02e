"""The runs of the noise study, and the scenario of each."""

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import Scenario, load_scenario, scenario_from_dict, scenario_to_dict

CONTROLLERS = ("tde_aismc", "aismc", "asmc", "tdc")
SIGMAS = (1e-7, 3e-7, 1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)  # rad/s and m/s, half decades
EXCHANGED_AT = 1e-4  # rad/s and m/s; the swept sigma nearest to it is used

# The gains of the sweep with each estimator, and those they are exchanged for.
GAINS_OF = {"one_sample": "published", "kalman": "bandwidth"}
EXCHANGED = {"one_sample": "bandwidth", "kalman": "published"}
# Bandwidth gains: natural frequency w of each group, rad/s; and the random walk of N that the
# filter assumes.
OMEGA = {"base_position": 2.0, "base_rotation": 5.0, "joints": 10.0}
WALK = {"base_position": 1e-3, "base_rotation": 1e-3, "joints": 1e-2}
# Position noise that the filter assumes, s times sigma. If it knew that positions are exact, it
# would differentiate them and ignore the rate sensor, an advantage that no real sensor gives.
POSITION_NOISE_TIME = 0.1


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseCase:
    """One run of the study."""

    controller: str
    estimator: str  # "one_sample" or "kalman"
    gains: str  # "published" or "bandwidth"
    sigma: float | None  # velocity noise, rad/s and m/s; None: the sensors of ``flight_sensors``
    seed: int = 0
    duration: float = 20.0  # s

    def scenario(self) -> Scenario:
        """The scenario: ``postcapture`` with this controller, estimator and noise."""
        data = copy.deepcopy(_shipped("postcapture"))
        data |= {"controller": self.controller, "random_seed": self.seed, "duration": self.duration}
        if self.sigma is None:
            data["sensing"] = _shipped("flight_sensors")["sensing"]
        else:
            data["sensing"] |= {
                "velocity_noise": {"all": self.sigma},
                "position_noise": {"all": 0.0},
            }
        if self.estimator == "kalman":
            data["estimator"] = {"kind": "kalman", "walk": WALK}
            if self.sigma is not None:
                position_noise = POSITION_NOISE_TIME * self.sigma
                data["estimator"] |= {
                    "velocity_noise": self.sigma,
                    "position_noise": position_noise,
                }
        if self.gains == "bandwidth":
            given = data["controllers"].get(self.controller, {})
            data["controllers"][self.controller] = given | bandwidth_gains(self.controller)
        return scenario_from_dict(data)

    @property
    def sensors(self) -> str:
        """The noise level, or the name of the sensor set."""
        return "flight_sensors" if self.sigma is None else f"{self.sigma:.0e}"

    def __str__(self) -> str:
        return (
            f"{self.controller}, {self.estimator}, {self.gains} gains, {self.sensors}, seed "
            f"{self.seed}"
        )


@functools.cache
def _shipped(name: str) -> dict[str, Any]:
    """A shipped scenario as plain data; not to be changed."""
    return scenario_to_dict(load_scenario(name))


def bandwidth_gains(controller: str) -> dict[str, dict[str, float]]:
    """Gains that place the poles of every group at its natural frequency."""
    if controller == "asmc":
        return {"k_d": OMEGA, "k_s": OMEGA}
    gains = {
        "k_d": {group: 2.0 * omega for group, omega in OMEGA.items()},
        "k_p": {group: omega**2 for group, omega in OMEGA.items()},
    }
    if controller in ("aismc", "tde_aismc"):
        # Real noise drives |s| far past the adaptation's thresholds: K_s would reach its bound, so
        # it starts there.
        k_s = {group: 0.3 * omega for group, omega in OMEGA.items()}
        gains |= {"k_s_initial": k_s, "k_s_max": k_s}
    return gains


def study_cases(
    *, seeds: int, sigmas: Sequence[float], duration: float, controllers: Sequence[str]
) -> list[NoiseCase]:
    """The sweep, and the exchange of estimates and gains. Raises ScenarioError for an argument that
    cannot be used.
    """
    if seeds < 1:
        raise ScenarioError("seeds", f"must be at least 1, not {seeds}")
    if (
        not sigmas
        or len(set(sigmas)) < len(sigmas)
        or not all(0.0 < sigma < math.inf for sigma in sigmas)
    ):
        raise ScenarioError(
            "sigmas", f"must be one or more positive and distinct numbers, not {list(sigmas)}"
        )
    if not controllers or not set(controllers) <= set(CONTROLLERS):
        raise ScenarioError(
            "controllers", f"must be some of {', '.join(CONTROLLERS)}, not {list(controllers)}"
        )
    swept = itertools.product(GAINS_OF.items(), controllers, (*sigmas, None))
    exchanged = itertools.product(EXCHANGED.items(), controllers, (exchange_point(sigmas),))
    return [
        NoiseCase(
            controller=controller,
            estimator=estimator,
            gains=gains,
            sigma=sigma,
            seed=seed,
            duration=duration,
        )
        for (estimator, gains), controller, sigma in (*swept, *exchanged)
        for seed in range(seeds)
    ]


def exchange_point(sigmas: Sequence[float]) -> float:
    """The sigma at which estimates and gains are exchanged."""
    return min(sigmas, key=lambda sigma: abs(math.log(sigma / EXCHANGED_AT)))
