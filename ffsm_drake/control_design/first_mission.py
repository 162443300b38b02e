"""Sizes, durations and gains of a new scenario whose sensors and actuators are real ones.

The rule: a motion takes at most a part of what the base's actuators give; the bandwidth is what
they leave for the sensors' noise; and K_s leaves an error from which a saturated integral returns.
Then the linear loop and, with actuators, the loop under their pulses; each shrinks the bandwidth.
"""

import math
from typing import Any

import numpy as np

from ffsm_drake.control_design.asked import Asked, wheel_units
from ffsm_drake.control_design.first_motion import OMEGA, Motion, effective_inertia
from ffsm_drake.control_design.rounding import rounded, rounded_by_group
from ffsm_drake.control_design.stability.mission import linear_verdict
from ffsm_drake.control_design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.control_design.stability.rehearsal import rehearse
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.scenario import Posture, Scenario, from_grasp, scenario_from_dict
from ffsm_drake.spacecraft.capture import planned_contact, target_path
from ffsm_drake.spacecraft.clearance import ApproachClearance, Nearest
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.limits import actuation_limit
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import find_factory

_MOTION = 0.65  # of what the actuators give, at most, for the planned motion
_DISTURBANCE = 0.3  # likewise, at most, for the disturbance
_NOISES = 3.0  # standard deviations of the noise, times I_eff omega^2, that the actuators give
_LEAST_LEFT = 0.05  # of what the actuators give, for the noise, where the motion takes the rest
_RETURN = 2.5e-3  # rad or m; a saturated integral returns from errors as large as that
_K_S = (0.05, 0.3)  # of omega; below the first K_s is 0, the second is the largest
_SWITCHING = 2e-4  # bound of G
_PULSES = 0.4  # of the thrusters' largest torque, that wheels give beside them
_LEAST_WHEEL, _LARGEST_WHEEL = 0.05, 5.0  # N m; a motion that takes more is made longer
_LONGEST = 120.0  # s
_SHRINK, _TRIES = 0.7, 8
_INSTANTS, _POSES = 60, 301  # of a motion: at which forces, and distances, are looked at
_APPROACHES, _CLEAR = (0.3, 0.2, 0.5), 0.02  # lengths along the grasp axis, and distance kept, m
_SETTLE = 1.0  # s after the grasp, when the response to it counts, not the motion
_LAWS = ("tdc", "asmc", "aismc", "tde_aismc")


class Fitting:
    """A scenario's plain data, changed step by step; ``remarks`` say what cannot be met."""

    def __init__(self, data: dict[str, Any], asked: Asked, coordinates: Coordinates, source: str):
        self.data, self.asked, self.coordinates, self.source = data, asked, coordinates, source
        self.remarks: list[str] = []
        self._clearance: ApproachClearance | None = None

    def fit(self, motion: Motion) -> None:
        """The approach, actuators, durations, then gains."""
        if self.asked.has_approach:
            self._approach(motion)
        self._limit_disturbance()
        peaks, after_grasp = self._paced()
        if self.asked.has_approach and self._approach_is_lengthened():
            self._approach(motion)
        self._assist(peaks, after_grasp)
        scenario = self.scenario
        limit, inertia = self._limit(scenario), self._inertia(scenario)
        omega = self._bandwidth(scenario, limit - peaks, inertia)
        for _ in range(_TRIES):
            self._put_gains(omega, limit / inertia)
            factors = self._checked()
            if (factors == 1.0).all():
                return
            omega = omega * factors
        self.remarks.append("no bandwidth tried settles; see 'ffsm stability'")

    @property
    def scenario(self) -> Scenario:
        return scenario_from_dict(self.data, source=self.source)

    def _approach(self, motion: Motion) -> None:
        """The first initial posture, and way to it along the grasp axis, that keep clear of the
        tumbling target; where none does, those that come least near.
        """
        best, chosen = -math.inf, ""
        for posture, axis in motion.starts:
            for length in _APPROACHES:
                near = self._approached(posture, axis, length)
                if near.distance > best:
                    best, chosen = near.distance, f"{near.first} and {near.second}"
                    kept = posture, axis, length
                if near.distance >= _CLEAR:
                    return
        self._approached(*kept)
        if best < Scenario().clearance:
            self.remarks.append(
                f"no approach keeps clear of the target: {chosen} come within {best:.3g} m "
                "(below 0 they overlap); a smaller target, a slower tumble, or a --tip at the end "
                f"of the hand (now {self.data['model']['end_effector']})"
            )

    def _approached(self, posture: Posture, axis: np.ndarray, length: float) -> Nearest:
        """Approach an initial posture from ``length`` (m) back along an axis; the closest that
        parts come in it.
        """
        joints = dict(posture.joints)
        self.data["initial_posture"]["joints"] = joints
        place = np.array(posture.base_position) - length * axis
        self.data["capture"]["approach"]["posture"] |= {
            "base_position": [rounded(x) for x in place.tolist()],
            "joints": dict(joints),
        }
        return self._nearest()

    def _nearest(self) -> Nearest:
        """The closest that parts come in the planned approach."""
        scenario = self.scenario
        model = make_nominal_plant(scenario)
        motion = make_motion(scenario, model.coordinates)
        if self._clearance is None:
            self._clearance = ApproachClearance(scenario.model, scenario.payload.body)
        path = target_path(scenario, model, planned_contact(scenario, model))[1]
        chosen = np.unique(np.linspace(0, len(path) - 1, _POSES).round().astype(int))
        q = motion.rows(scenario.sample_time * chosen)[:, : len(model.coordinates.position_names)]
        return self._clearance.along(np.hstack([q, path[chosen, :7]])).nearest

    def _limit(self, scenario: Scenario) -> np.ndarray:
        """Largest forces (nv) that the actuators give in any direction."""
        return actuation_limit(scenario, self.coordinates).upper

    def _inertia(self, scenario: Scenario) -> np.ndarray:
        """Largest effective inertia (nv) along the motion."""
        planned = PlannedDynamics(from_grasp(scenario))
        times = [planned.motion.part(share) for share in (0.0, 0.5, 1.0)]
        return np.max([effective_inertia(planned.mass_matrices(t)[0]) for t in times], axis=0)

    def _paced(self) -> tuple[np.ndarray, np.ndarray]:
        """Size wheels, and lengthen the motion until the actuators have enough for it.

        Returns: the peak forces (nv) of motion and disturbance, and those right after the grasp.
        """
        while True:
            planned = PlannedDynamics(from_grasp(self._undisturbed))
            end = planned.motion.end
            first = 0.0 if self.asked.capture is None else min(_SETTLE, 0.1 * end)
            peaks, early = (
                np.abs(planned.perfect_tracking(np.linspace(*leg, _INSTANTS))[1]).max(axis=0)
                for leg in ((first, end), (0.0, max(first, 0.1)))
            )
            total = peaks + self._disturbance
            if self.asked.wheels is not None and self.asked.wheels[1] is None:
                units = wheel_units(self.asked.wheels[0], self._wheel_torque(total))
                self._wheels["units"] = units
            duration = self.data["reference"]["duration"]
            longer = self._longer(duration, peaks)
            if longer <= duration:
                break
            self.data["reference"]["duration"] = longer
            self.data["duration"] += longer - duration
        limit = self._limit(self.scenario)
        share = self._driven * total / limit
        worst = int(np.argmax(share))
        if share[worst] > _MOTION + 0.05:
            unit = "N" if self.coordinates.units[worst] == "m" else "N m"
            self.remarks.append(
                f"{self.coordinates.names[worst]}: the motion of {duration:g} s takes "
                f"{peaks[worst]:.3g} {unit}, the disturbance {self._disturbance[worst]:.3g} "
                f"{unit}, and the actuators give {limit[worst]:.3g} {unit} in any direction: take "
                "stronger ones"
            )
        return total, early + self._disturbance

    def _limit_disturbance(self) -> None:
        """A disturbance that leaves most of given actuators' forces to the motion."""
        if self.asked.wheels is not None and self.asked.wheels[1] is None:
            return  # sized for it
        limit = _DISTURBANCE * self._limit(self.scenario)
        harmonics = self.data["disturbance"]["harmonics"]
        for name, most in zip(self.coordinates.names, limit.tolist(), strict=True):
            if name in harmonics:
                amplitude = min(harmonics[name]["amplitude"], most)
                harmonics[name]["amplitude"] = rounded(amplitude)

    def _longer(self, duration: float, peaks: np.ndarray) -> float:
        """The duration of a motion whose peak forces (nv) leave the actuators their reserve."""
        limit = self._limit(self.scenario)
        room = np.maximum(_MOTION * limit - self._disturbance, _LEAST_LEFT * limit)
        ratio = math.sqrt(float((self._driven * peaks / room).max()))
        return min(5.0 * math.ceil(max(ratio, 1.0) * duration / 5.0 - 1e-9), _LONGEST)

    def _approach_is_lengthened(self) -> bool:
        """Lengthen the approach likewise, as if the target were held; whether that was needed."""
        approach = self.data["capture"]["approach"]
        duration = approach["duration"]
        times = np.linspace(0.0, duration, _INSTANTS)
        _, force = PlannedDynamics(self._undisturbed).perfect_tracking(times)
        approach["duration"] = self._longer(duration, np.abs(force).max(axis=0))
        self.data["duration"] += approach["duration"] - duration
        return bool(approach["duration"] > duration)

    @property
    def _undisturbed(self) -> Scenario:
        data = {**self.data, "disturbance": {}}
        return scenario_from_dict(data, source=self.source)

    @property
    def _disturbance(self) -> np.ndarray:
        """Its largest force (nv)."""
        largest = {
            name: abs(each.amplitude) + abs(each.bias)
            for name, each in self.scenario.disturbance.harmonics.items()
        }
        return self.coordinates.vector(largest, key="disturbance", default=0.0)

    @property
    def _driven(self) -> np.ndarray:
        return np.array([self.asked.drives(group) for group in self.coordinates.group_of])

    @property
    def _wheels(self) -> dict[str, Any]:
        wheels: dict[str, Any] = self.data["actuation"]["wheels"]
        return wheels

    def _wheel_torque(self, peaks: np.ndarray) -> float:
        """The motors' torque, N m, for peak forces (nv) and, beside thrusters, their pulses."""
        actuation, asked = self.data["actuation"], self.asked
        assert asked.wheels is not None
        unit = {**actuation, "wheels": {"units": wheel_units(asked.wheels[0], 1.0)}}
        least, pulses = self._torque(unit), 0.0
        if asked.thrusters is not None:
            pulses = _PULSES * self._torque({**actuation, "wheels": None}) / least
        motion, largest = float(np.linalg.norm(peaks[:3])), max(_LARGEST_WHEEL, pulses)
        return rounded(max(min(motion / _MOTION / least, largest), pulses, _LEAST_WHEEL))

    def _torque(self, actuation: dict[str, Any]) -> float:
        """What the base's actuators of a section give in any direction, N m."""
        data = {**self.data, "actuation": actuation}
        return float(self._limit(scenario_from_dict(data, source=self.source))[0])

    def _assist(self, peaks: np.ndarray, after_grasp: np.ndarray) -> None:
        """Thrusters beside the wheels where those are too weak; a line that says so."""
        asked, limit = self.asked, float(self._limit(self.scenario)[0])
        weak, (count, torque) = False, asked.wheels or (0, None)
        if torque is not None:
            needed = self._wheel_torque(peaks)
            if weak := torque < needed:
                self.remarks.append(
                    f"wheels of {torque:.3g} N m are too weak for the motion"
                    f"{' and the pulses of the thrusters' if asked.thrusters else ''}: "
                    f"--wheels {count}x{needed:g}Nm"
                )
        jerk = float(np.linalg.norm(after_grasp[:3]))
        if asked.capture is not None and asked.drives("base_rotation") and jerk > limit:
            weak = True
            self.remarks.append(
                f"the grasp takes up to {jerk:.3g} N m of the base, and its actuators give "
                f"{limit:.3g} N m in any direction: a slower tumble, or stronger ones"
            )
        if weak and asked.wheels is not None and asked.thrusters is not None:
            self._wheels["assist_above"] = 1.0

    def _bandwidth(self, scenario: Scenario, left: np.ndarray, inertia: np.ndarray) -> np.ndarray:
        """Natural frequencies (nv), rad/s: those of the sensors' scenario, or less where noise
        would take more than the actuators have ``left``; equal within a group.
        """
        coordinates, source = self.coordinates, self.asked.source
        usual: Any = OMEGA
        if source is not None and source.estimator.kind != "one_sample":
            stiffness: Any = source.controllers["tdc"]["k_p"]
            usual = {group: math.sqrt(k) for group, k in stiffness.items()}
        omega = coordinates.vector(usual, key="omega")
        noise = coordinates.vector(scenario.sensing.position_noise, key="noise", default=0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            most = np.sqrt(
                np.maximum(left, 0.05 * self._limit(scenario)) / inertia / noise / _NOISES
            )
        most = np.where(noise > 0.0, most, np.inf)
        for part in coordinates.groups.values():
            omega[part] = np.minimum(omega[part], most[part].min())
        return omega

    def _put_gains(self, omega: np.ndarray, acceleration: np.ndarray) -> None:
        """Gains of the laws on time-delay estimation.

        Args: natural frequencies (nv); acceleration (nv) that the actuators give.
        """
        k_d, k_p = 2.0 * omega, omega**2
        swing = 4.0 / math.pi * acceleration
        beyond = k_p * _RETURN - swing
        with np.errstate(divide="ignore", invalid="ignore"):
            k_s = np.where(beyond > 0.0, swing * k_d / beyond, np.inf)
        k_s = np.minimum(k_s, _K_S[1] * omega)
        k_s[k_s < _K_S[0] * omega] = 0.0
        self.data["controllers"] = {}
        for name in _LAWS:
            law: Any = find_factory("controller", name)
            gains = law.gains_for(omega, k_s)
            if "g_max" in law.__dataclass_fields__:
                gains |= {"g_initial": _SWITCHING, "g_max": _SWITCHING}
            self.data["controllers"][name] = {
                key: value if np.ndim(value) == 0 else rounded_by_group(value, self.coordinates)
                for key, value in gains.items()
            }

    def _checked(self) -> np.ndarray:
        """Factors (nv) of the bandwidth: 1 where it can stay. Radii first, actuators last."""
        scenario, factors = self.scenario, np.ones(len(self.coordinates.names))
        if linear_verdict(scenario).is_alarm:
            return factors * _SHRINK
        if not is_rehearsed(from_grasp(scenario)):
            return factors
        rehearsal = rehearse(scenario, seeds=1)
        names = zip(self.coordinates.names, self.coordinates.group_of, strict=True)
        tolerance = np.array([scenario.tolerance_of(*each) for each in names])
        if rehearsal.share_diverged > 0.0:
            factors[:6] = _SHRINK**2
        elif (rehearsal.largest_error[:6] > tolerance[:6]).any():
            factors[:6] = _SHRINK
        return factors
