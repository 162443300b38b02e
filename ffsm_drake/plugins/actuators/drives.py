"""Joint drives: torque-speed limit and friction.

A motor with a limited current gives its full torque up to some speed; beyond it the voltage above
the back-EMF falls linearly, to zero at the no-load speed (the torque-speed line of a DC motor). It
brakes at any speed. The friction model is by Armstrong-Helouvry, Dupont and Canudas de
Wit (Automatica 30, 1994), with tanh in place of the sign:

    F(v) = -((F_c + (F_s - F_c) exp(-(v / v_s)^2)) tanh(v / v_0) + b v)

with Coulomb friction F_c, static friction F_s, Stribeck rate v_s, smoothing rate v_0 and viscous
friction b. Under a force F < F_c a joint held by friction creeps at v_0 artanh(F / F_c).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import percent, short
from ffsm_drake.scenario import Drives, PerCoordinate, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.limits import RATE, Limit
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import INTERNAL_WORK, Constant, Signal, View
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

_KEY = "actuation.drives"
# Integration schemes that are stable at any step, for any friction.
_IMPLICIT_SCHEMES = ("implicit_euler", "velocity_implicit_euler", "radau1", "radau3")
# the system with the work of friction as its state; it feeds nothing back
FRICTION = "friction_of_drives"
FRICTION_FORCE, FRICTION_WORK = "friction_force", "friction_work"  # its outputs


class DriveSet:
    """Force and friction of a set of drives: pure functions of arrays, by joint (n) in the order of
    v.
    """

    def __init__(
        self, settings: Drives, limit: PerCoordinate | None, coordinates: Coordinates
    ) -> None:
        """Args:
          settings: the drives.
          limit: ``actuation.limit``.
          coordinates: names of the coordinates.

        Raises ScenarioError: a value for a name that is no joint, static friction below Coulomb, a
        rate limit without a force.
        """

        def of_joints(name: str, default: float) -> np.ndarray:
            return coordinates.joint_vector(
                getattr(settings, name) or {}, key=f"{_KEY}.{name}", default=default
            )

        self.names = coordinates.joints
        self.coulomb, self.viscous = (
            of_joints("coulomb_friction", 0.0),
            of_joints("viscous_friction", 0.0),
        )
        self.static = (
            self.coulomb
            if settings.static_friction is None
            else of_joints("static_friction", np.nan)
        )
        self.static = np.where(np.isnan(self.static), self.coulomb, self.static)
        self.stribeck_rate, self.smoothing_rate = (
            of_joints("stribeck_rate", 0.01),
            of_joints("smoothing_rate", 1e-3),
        )
        self.rate_limit, self.knee = of_joints("rate_limit", np.inf), of_joints("knee", 0.9)
        self.force_limit = coordinates.vector(limit or {}, key="actuation.limit", default=np.inf)[
            NUM_BASE_VELOCITIES:
        ]
        for name, coulomb, static in zip(self.names, self.coulomb, self.static, strict=True):
            if static < coulomb:
                problem = f"{name} has {static:g}, less than its coulomb_friction, {coulomb:g}"
                raise ScenarioError(f"{_KEY}.static_friction", problem)
        for name, rate, force in zip(self.names, self.rate_limit, self.force_limit, strict=True):
            if np.isfinite(rate) and not np.isfinite(force):
                problem = (
                    f"{name} has no actuation.limit, below which its force would fall with the "
                    f"rate; set actuation.limit.{name}"
                )
                raise ScenarioError(f"{_KEY}.rate_limit", problem)

    @property
    def constants(self) -> str:
        """What its functions depend on, besides their arguments."""
        return repr({name: np.asarray(own).tolist() for name, own in vars(self).items()})

    @property
    def has_friction(self) -> bool:
        """Whether any joint has."""
        return bool(self.static.any() or self.viscous.any())

    @property
    def has_rate_limit(self) -> bool:
        """Whether any joint has."""
        return bool(np.isfinite(self.rate_limit).any())

    def friction(self, rate: Any) -> Any:
        """The force of friction at joint rates (..., n), N m or N."""
        parts = (self._friction_of(i, rate[..., i]) for i in range(len(self.names)))
        return np.stack([*parts], axis=-1)

    def _friction_of(self, i: int, rate: Any) -> Any:
        """The friction of joint i at its rate, without the cost of unused terms."""
        dry: Any = self.coulomb[i]
        if self.static[i] > self.coulomb[i]:
            slow = rate * (1.0 / self.stribeck_rate[i])
            dry = dry + (self.static[i] - self.coulomb[i]) * np.exp(-slow * slow)
        force = 0.0 * rate
        if self.static[i] > 0.0:
            force = -dry * np.tanh(rate * (1.0 / self.smoothing_rate[i]))
        return force - self.viscous[i] * rate if self.viscous[i] > 0.0 else force

    def available(self, rate: np.ndarray) -> np.ndarray:
        """The largest force (..., n) with the motion at joint rates (..., n), N m or N; infinite
        without a limit.
        """
        with np.errstate(invalid="ignore"):  # without limits
            share = (1.0 - np.abs(rate) / self.rate_limit) / (1.0 - self.knee)
            return np.where(
                np.isfinite(self.rate_limit),
                self.force_limit * np.clip(share, 0.0, 1.0),
                self.force_limit,
            )

    def give(self, force: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Applied force after the torque-speed limit, from a commanded force (..., n) at joint
        rates (..., n), N m or N; only force in the direction of motion is cut.
        """
        most = self.available(rate)
        return np.clip(
            force, np.where(rate < 0.0, -most, -np.inf), np.where(rate > 0.0, most, np.inf)
        )

    def time_constant(self, inverse_inertia: np.ndarray) -> tuple[float, str]:
        """The shortest time constant, s, of friction on a joint near rest, and that joint.

        Args:
          inverse_inertia: (n, n), accelerations of the joints per force on them.
        """
        slope = self.static / self.smoothing_rate + self.viscous
        root = np.sqrt(slope)
        rates, modes = np.linalg.eigh(root[:, None] * inverse_inertia * root)
        joint = self.names[int(np.argmax(np.abs(modes[:, -1])))]
        return (1.0 / float(rates[-1]) if rates[-1] > 0.0 else np.inf), joint


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OfRates:
    """A block of drives that reads ``state`` [q; v] (nq + nv), of which the joints' rates act."""

    drives: DriveSet
    num_velocities: int

    @property
    def entries(self) -> Mapping[str, Sequence[int]]:
        """See Sampled and Continuous."""
        return {"state": [*range(2 * self.num_velocities + 1)][-len(self.drives.names) :]}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RateLimit(_OfRates, Sampled):
    """Limits the forces on joints to the drives' capability at the rates of the last control
    sample.

    Inputs: ``force`` (nv) and ``state`` [q; v] (nq + nv). Output: ``limited`` (nv), changing
    at control samples only.
    """

    acts = True

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"force": self.num_velocities, "state": 2 * self.num_velocities + 1}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"limited": self.num_velocities}

    @property
    def latched(self) -> Mapping[str, Sequence[float]]:
        """See Sampled."""
        return {"state": [0.0] * len(self.drives.names)}

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        force, joints = inputs["force"].copy(), slice(NUM_BASE_VELOCITIES, None)
        force[joints] = self.drives.give(force[joints], inputs["state"])
        return {"limited": force}, memory


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointFriction(_OfRates, Continuous):
    """Friction as a continuous force on the plant, and its work.

    Input: ``state`` [q; v] of the plant. Outputs: ``friction_force`` (nv), N m or N, and
    ``friction_work`` (nv), its integral of force times rate since the start, J, which is integrated
    with the plant.
    """

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"state": 2 * self.num_velocities + 1}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return dict.fromkeys((FRICTION_FORCE, FRICTION_WORK), self.num_velocities)

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Continuous."""
        return {FRICTION_WORK: np.zeros(len(self.drives.names))}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        rates, base = inputs["state"], np.zeros(NUM_BASE_VELOCITIES)
        force = self.drives.friction(rates)
        found = {
            FRICTION_FORCE: np.concatenate([base, force]),
            FRICTION_WORK: np.concatenate([base, state[FRICTION_WORK]]),
        }
        return found, {FRICTION_WORK: force * rates}


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointDrives(Part):
    """Signals and metrics of the drives of a scenario's own actuators."""

    title = "Drives"
    section = "Actuators"
    about = ""
    settings: Drives
    limit: PerCoordinate | None

    @classmethod
    def of(cls, scenario: Scenario) -> "JointDrives | None":
        """The drives of a scenario."""
        settings = scenario.drives
        return None if settings is None else cls(settings=settings, limit=scenario.actuation.limit)

    def check_plant(self, scenario: Scenario, model: PlantModel) -> None:
        """Raise ScenarioError if a fixed step does not resolve a joint's friction near rest."""
        drives, config = self._drives(model.coordinates), scenario.simulator_config
        implicit = config.integration_scheme in _IMPLICIT_SCHEMES
        if implicit or config.use_error_control or not drives.has_friction:
            return
        whole = np.arange(model.plant.num_velocities())
        joints = model.split.known_velocities(whole)[NUM_BASE_VELOCITIES:]
        least, fastest = np.inf, ""
        for name, posture in scenario.postures.items():
            q = model.split.whole_positions(configuration(model.coordinates, posture, key=name))
            mobility = np.linalg.inv(model.calc_mass_matrix(q))[np.ix_(joints, joints)]
            least, fastest = min((least, fastest), drives.time_constant(mobility))
        if config.max_step_size > least:
            raise ScenarioError(
                "simulator_config.max_step_size",
                f"{config.max_step_size:g} s exceeds the time constant of friction near rest "
                f"({fastest}: {least:.2g} s); set at most {0.9 * least:.2g}, or "
                f"{1.1 * config.max_step_size / least:.2g} times actuation.drives.smoothing_rate",
            )

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Friction and its work, and how much of their rates joints use."""
        coordinates, drives = setup.coordinates, self._drives(setup.coordinates)
        by_coordinate = functools.partial(
            Signal, components=coordinates.names, dimension="coordinate", held=False
        )
        units = dict(zip(coordinates.names, coordinates.units, strict=True))
        rubs = (drives.static > 0.0) | (drives.viscous > 0.0)
        rubbing, limited = (
            [name for name, member in zip(drives.names, members, strict=True) if member]
            for members in (rubs, np.isfinite(drives.rate_limit))
        )
        friction = (
            by_coordinate(
                name=FRICTION_FORCE,
                unit="N m or N",
                meaning="friction in the drives at this instant",
                heading="Drives: friction",
                panels={name: {"rad": "N m", "m": "N"}[units[name]] for name in rubbing},
            ),
            by_coordinate(
                name=FRICTION_WORK,
                unit="J",
                meaning="work of friction in the drives since the start",
                heading="",
                role=INTERNAL_WORK,
            ),
        )
        rate = by_coordinate(
            name="rate_share",
            unit="1",
            meaning="rate as a share of the drive's limit",
            heading="Drives: share of the rate limit",
            panels=dict.fromkeys(limited, ""),
            of=lambda run: np.abs(_velocity(run)) / _with_base(drives.rate_limit, np.inf),
        )
        return (*(friction if drives.has_friction else ()), *([rate] if limited else ()))

    def constants(self, setup: BlockSetup) -> Sequence[Constant]:
        """Limits of the drives; infinite, and the knee 0, if not given."""
        drives = self._drives(setup.coordinates)
        return [
            Constant(
                name=f"drive_{name}",
                unit=unit,
                meaning=meaning,
                dimension="coordinate",
                values=_with_base(values, base).tolist(),
            )
            for name, unit, meaning, values, base in (
                ("force_limit", "N m or N", "of the drive", drives.force_limit, np.inf),
                ("rate_limit", "rad/s or m/s", "of the drive", drives.rate_limit, np.inf),
                ("knee", "1", "share of that where its force begins to fall", drives.knee, 0.0),
            )
        ]

    def limits(self, coordinates: Coordinates) -> Sequence[Limit]:
        """Rates of the joints."""
        rate = _with_base(self._drives(coordinates).rate_limit, np.inf)
        return [Limit.of_coordinates(RATE, f"{_KEY}.rate_limit", coordinates, rate)]

    def metrics(self) -> Sequence[Metric]:
        """Metrics by joint (the first two for joints with such a limit): use of limits and friction
        losses; and the share of samples in which the rate limited the force of any joint.
        """

        def by_joint(key: str, unit: str, of: Callable[[View], Mapping[str, float]]) -> Metric:
            return Metric(key=f"drives.{key}", unit=unit, column="", of=of)

        def used(signal: Callable[[View], np.ndarray], limit: str) -> Callable[[View], Any]:
            def shares(run: View) -> dict[str, float]:
                drives = self._drives(run.coordinates)
                most = getattr(drives, limit)
                largest = np.abs(_of_joints(signal(run))).max(axis=0)
                return {
                    name: share
                    for name, share, one in zip(
                        drives.names, (largest / most).tolist(), most, strict=True
                    )
                    if np.isfinite(one)
                }

            return shares

        friction = (
            by_joint("peak_friction", "N m or N", self._peak_friction),
            by_joint("friction_loss", "J", self._friction_loss),
        )
        limited = Metric(key="drives.rate_limited", unit="1", column="", of=self._rate_limited)
        has_friction = any(
            value
            for name in ("coulomb_friction", "viscous_friction", "static_friction")
            for value in (getattr(self.settings, name) or {}).values()
        )
        return (
            by_joint("force_used", "1", used(lambda run: run["applied_force"], "force_limit")),
            by_joint("rate_used", "1", used(_velocity, "rate_limit")),
            *([limited] if self.settings.rate_limit else ()),
            *(friction if has_friction else ()),
        )

    def sentence(self, figures: Sequence[Figure]) -> str:
        """Peak use of the drives, and friction losses."""
        found = by_key(figures)
        parts = [
            f"up to {percent(max(used.values()))} of the {what} of a joint"
            for key, what in (("force_used", "force limit"), ("rate_used", "rate limit"))
            if (used := found[f"drives.{key}"])
        ]
        if "drives.rate_limited" in found:
            parts.append(
                f"cut by the rate in {percent(found['drives.rate_limited'])} of the samples"
            )
        if "drives.friction_loss" in found:
            peak, name = max((x, name) for name, x in found["drives.peak_friction"].items())
            parts.append(
                f"friction of up to {peak:.3g} N m or N, in {name}, and "
                f"{short(sum(found['drives.friction_loss'].values()))} J dissipated in all joints"
            )
        return f"drives: {', '.join(parts)}" if parts else ""

    def _drives(self, coordinates: Coordinates) -> DriveSet:
        return DriveSet(self.settings, self.limit, coordinates)

    def _rate_limited(self, run: View) -> float:
        drives = self._drives(run.coordinates)
        rate, force = _of_joints(_velocity(run)), _of_joints(run["generalized_force"])
        most = drives.available(rate)
        cut = (np.abs(force) > most) & (most < drives.force_limit) & (force * rate > 0.0)
        return float(cut.any(axis=1).mean())

    def _peak_friction(self, run: View) -> dict[str, float]:
        peak = np.abs(_of_joints(run[FRICTION_FORCE])).max(axis=0)
        return dict(zip(run.coordinates.joints, peak.tolist(), strict=True))

    def _friction_loss(self, run: View) -> dict[str, float]:
        work = _of_joints(run[FRICTION_WORK])
        return dict(zip(run.coordinates.joints, (work[0] - work[-1]).tolist(), strict=True))


def _velocity(run: View) -> np.ndarray:
    """All coordinates' (n, nv)."""
    return run["state"][:, len(run.coordinates.position_names) :]


def _of_joints(values: np.ndarray) -> np.ndarray:
    return values[..., NUM_BASE_VELOCITIES:]


def _with_base(values: np.ndarray, base: float) -> np.ndarray:
    """Values of joints, with one for all coordinates of the base before them."""
    return np.concatenate([np.full(NUM_BASE_VELOCITIES, base), values])
