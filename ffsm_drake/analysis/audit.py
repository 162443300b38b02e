"""Is a log physics? Checks of another simulator's log of a free-flying spacecraft against a URDF:
frames and units of its velocities, then momentum and energy with this package's own plant.

What is wrong is named by trying: of all usual mistakes (quaternions with the scalar last, degrees,
exchanged joints, gravity, ...) the one without which the log agrees with itself.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from ffsm_drake.analysis.findings import Verdict
from ffsm_drake.analysis.foreign_log import ForeignLog, read_log, with_rates
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.coordinates import position_errors
from ffsm_drake.spacecraft.plant import base_body, coordinates_of, make_plant

TOLERANCE = 1e-3  # of momentum and energy, as a share of what the bodies exchange
_FITS = 0.1  # share of a motion that rates may miss, of samples held or integrated coarsely
_DRIFTS = 0.15  # share that momentum may drift in MuJoCo's Euler integrator with fast light links
_TRIMMED = 0.9  # share of the periods that a fit is about: jumps are found apart
_STILL = 1e-9  # rad or m in a period
_MAX_SAMPLES = 40  # of those that momentum is compared at
_DEGREE = math.pi / 180.0
_INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # of a quaternion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """The result of one check."""

    name: str
    statement: str
    verdict: Verdict = "holds"  # "measured": a convention that was recognised
    cause: str = ""  # of what does not hold: one word for one mistake


@dataclasses.dataclass(frozen=True, kw_only=True)
class Audit:
    """The checks of one log, in their order."""

    checks: tuple[Check, ...]

    @property
    def is_physics(self) -> bool:
        """False if any check does not hold, or momentum could not be checked."""
        untold = any(c.name == "momentum" and c.verdict == "not tested" for c in self.checks)
        return not (self.causes or untold)

    @property
    def causes(self) -> tuple[str, ...]:
        """The mistakes that were named."""
        return tuple(check.cause for check in self.checks if check.verdict == "does not hold")

    def as_data(self) -> dict[str, object]:
        """Plain data, for JSON."""
        return {
            "is_physics": self.is_physics,
            "checks": [dataclasses.asdict(check) for check in self.checks],
        }

    def __str__(self) -> str:
        lines = [f"[{check.verdict}] {check.name}: {check.statement}" for check in self.checks]
        verdict = "yes" if self.is_physics else "not known, as momentum is not tested"
        verdict = f"no: {', '.join(self.causes)}" if self.causes else verdict
        return "\n".join([*lines, f"Is this log physics? {verdict}"])


def audit(
    log: Path,
    urdf: Path,
    *,
    columns: dict[str, str] | None = None,
    tolerance: float = TOLERANCE,
) -> Audit:
    """Check a log (``read_log``) against a URDF with one free base, or model directives.

    Args:
      columns: other names of columns; see ``read_log``.
      tolerance: of momentum and energy, as a share of what the bodies exchange.

    Raises:
      ModelError, RecordError: a file cannot be used.
    """
    plant = make_plant(Model(directives=str(urdf), end_effector="WorldModelInstance::world"))
    joints = coordinates_of(plant).joints
    read = read_log(log, joints, base=base_body(plant).name(), columns=columns)
    checks: list[Check] = []
    for step in (
        _time,
        _quaternion,
        _differentiated,
        _time_unit,
        _attitude,
        _base_velocity,
        _joint_rates,
        _jumps,
    ):
        found, read = step(read, plant)
        checks += found
    checks += _dynamics(read, Dynamics(plant), tolerance)
    return Audit(checks=tuple(checks))


_Checked = tuple[list[Check], ForeignLog]


def _fault(name: str, cause: str, statement: str) -> Check:
    return Check(name=name, statement=statement, verdict="does not hold", cause=cause)


def _time(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """Samples in order, none missing; those out of order are left out from here on."""
    steps = np.diff(log.time)
    if (back := np.flatnonzero(steps <= 0.0)).size:
        kept = log.time > np.maximum.accumulate(np.concatenate([[-np.inf], log.time[:-1]]))
        said = (
            f"{np.sum(~kept)} samples are not later than all before them, first after "
            f"{log.time[back[0]]:g} s"
        )
        return [_fault("time", "time_order", said)], _only(log, kept)
    period = float(np.median(steps))
    gaps = np.flatnonzero(steps > 1.5 * period)
    if gaps.size and gaps.size < 0.2 * steps.size:
        missing = int(np.round(steps[gaps] / period - 1.0).sum())
        said = (
            f"about {missing} samples are missing, in {gaps.size} gaps, the first after "
            f"{log.time[gaps[0]]:g} s"
        )
        return [_fault("time", "dropped_samples", said)], log
    said = f"{log.time.size} samples, period {period:.4g} s{log.note}"
    return [Check(name="time", statement=said)], log


_RATES = {
    "angular": "the base's angular velocity",
    "linear": "the base's velocity",
    "rates": "the joints' rates",
}


def _differentiated(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """Rates from the positions, where none are logged."""
    if not log.missing:
        return [], log
    said = f"{', '.join(_RATES[what] for what in log.missing)}: not logged, differentiated"
    return [Check(name="rates", statement=said, verdict="measured")], with_rates(log)


_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


def _time_unit(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """A unit of time in which joints and base go as far as their rates say; s if there is none."""
    paths = (log.angles, log.rates), (log.position, log.linear)
    ratios = []
    for position, rate in paths:
        moved = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
        expected = _integral(log.time, np.linalg.norm(rate, axis=1)[:, None])[-1, 0]
        if moved > _STILL and expected > 0.0:
            ratios.append(moved / expected)
    for unit, factor in _TIME_UNITS.items():
        if ratios and all(abs(ratio / factor - 1.0) < 0.2 for ratio in ratios):
            said = f"it is in {unit}, or every rate is {1.0 / factor:.0e} times too large"
            return [_fault("time", "time_unit", said)], log.replace(time=log.time * factor)
    return [], log


def _only(log: ForeignLog, kept: np.ndarray) -> ForeignLog:
    """Some samples of a log."""
    values = {f.name: getattr(log, f.name) for f in dataclasses.fields(log)}
    arrays = {name: v for name, v in values.items() if isinstance(v, np.ndarray)}
    return log.replace(**{name: v[kept] for name, v in arrays.items()})


def _quaternion(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    norm = np.linalg.norm(log.quaternion, axis=1)
    worst = float(np.abs(norm - 1.0).max())
    said = f"its norm is 1 within {worst:.2g}"
    if worst <= 1e-4:
        return [Check(name="quaternion", statement=said)], log
    said = f"its norm is {norm.min():.6g} to {norm.max():.6g}, not 1"
    whole = log.replace(quaternion=log.quaternion / np.where(norm > 0.0, norm, 1.0)[:, None])
    return [_fault("quaternion", "quaternion_norm", said)], whole


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Fit:
    """How well rates explain a motion: displacement = factor * rate * period."""

    factor: float
    missed: float  # share of the displacements, by their root mean square
    still: bool  # nothing moves


def _fit(log: ForeignLog, moved: np.ndarray, rates: np.ndarray) -> _Fit:
    """Compare displacements (n - 1, k) with rates (n, k), but for the periods with jumps."""
    expected = 0.5 * (rates[1:] + rates[:-1]) * np.diff(log.time)[:, None]
    if max(np.abs(moved).max(), np.abs(expected).max()) < _STILL:
        return _Fit(factor=1.0, missed=0.0, still=True)
    kept = np.ones(len(moved), dtype=bool)
    for _ in range(2):
        square = float((expected[kept] ** 2).sum())
        factor = float((moved[kept] * expected[kept]).sum()) / square if square > 0.0 else 0.0
        misses = np.linalg.norm(moved - factor * expected, axis=1)
        kept = misses <= np.quantile(misses, _TRIMMED)
    size = math.sqrt(float((moved[kept] ** 2).sum()))
    missed = math.sqrt(float((misses[kept] ** 2).sum())) / size if size > 0.0 else math.inf
    return _Fit(factor=factor, missed=missed, still=False)


def _rate(log: ForeignLog, path: np.ndarray) -> np.ndarray:
    """Rate (n, k) of a path (n, k), in place of a logged one that cannot be used."""
    rate: np.ndarray = np.gradient(path, log.time, axis=0, edge_order=2)
    return rate


def _turned(log: ForeignLog) -> np.ndarray:
    """Rotation vectors between samples (n - 1, 3), world axes, rad."""
    q = log.quaternion
    return position_errors(q[1:], q[:-1])[:, :3]


def in_world_axes(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors in body axes (n, 3) in those of the world, for attitudes (w, x, y, z) (n, 4)."""
    return in_body_axes(quaternions * _INVERSE, vectors)


_ATTITUDES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda q: q,
    "quaternion_order": lambda q: q[:, [3, 0, 1, 2]],
    "quaternion_inverse": lambda q: q * _INVERSE,
    "quaternion_order, quaternion_inverse": lambda q: q[:, [3, 0, 1, 2]] * _INVERSE,
}
_SAID = {
    "quaternion_order": "the quaternion's scalar stands last (x, y, z, w)",
    "quaternion_inverse": (
        "the attitude turns from world to base axes (R_BW, not R_WB; MRPs sigma_NB, not sigma_BN)"
    ),
}


def _attitude(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """Which way the quaternion turns, and the axes of the angular velocity."""
    if "angular" in log.missing:
        return [], log
    tried = {}
    for causes, change in _ATTITUDES.items():
        other = log.replace(quaternion=change(log.quaternion))
        for axes, omega in {
            "world": other.angular,
            "body": in_world_axes(other.quaternion, other.angular),
        }.items():
            fit = _fit(other, _turned(other), omega)
            tried[causes, axes] = fit, other.replace(angular=omega)
    right = {key: each for key, each in tried.items() if each[0].factor > 0.0 or each[0].still}
    usual = [key for key in right if not key[0] and right[key][0].missed < _FITS]
    allowed = {key: right[key] for key in usual} or right or tried
    (causes, axes), (fit, whole) = min(allowed.items(), key=lambda item: item[1][0].missed)
    if fit.still:
        return [Check(name="attitude", statement="the base does not turn")], log
    if fit.missed > _FITS:
        for said, omega in _turned_twice(log):
            once = _fit(log, _turned(log), omega)
            if once.missed < _FITS and abs(once.factor - 1.0) < _FITS:
                return [_fault("angular velocity", "axes", said)], log.replace(angular=omega)
        said = "the angular velocity is not the quaternion's rate"
        check = _in_no_axes("attitude", "angular_velocity", said, fit)
        return [check], log.replace(angular=_rate(log, _since_start(_turned(log))))
    name = "angular velocity"
    checks = [_fault("attitude", each, _SAID[each]) for each in causes.split(", ") if each]
    same = len(usual) == 2 and max(right[key][0].missed for key in usual) < 3.0 * fit.missed
    if not same and axes not in (stated := log.stated.get("angular", axes)):
        said = f"in {axes} axes, while the log says {stated}"
        checks.append(_fault(name, "axes", said))
    axes = "world or body axes, which it does not tell apart" if same else f"{axes} axes"
    checks.append(_scaled(name, fit, f"in {axes}"))
    return checks, whole.replace(angular=whole.angular * fit.factor)


def _turned_twice(log: ForeignLog) -> Iterator[tuple[str, np.ndarray]]:
    """Angular velocities in world axes, if a needless change of axes is undone."""
    said = "{} axes were taken for {} axes and turned to {} axes once more"
    twice = in_world_axes(log.quaternion, in_world_axes(log.quaternion, log.angular))
    yield said.format("body", "world", "body"), twice
    yield said.format("world", "body", "world"), in_body_axes(log.quaternion, log.angular)


def _in_no_axes(name: str, cause: str, said: str, fit: _Fit) -> Check:
    """The check of rates that agree with a motion in no axes."""
    missed = f"{100.0 * fit.missed:.0f} %"
    return _fault(name, cause, f"{said}, in world or in body axes; the nearest misses {missed}")


def _scaled(name: str, fit: _Fit, said: str) -> Check:
    """The check of rates that agree with a motion but for a factor."""
    for factor, cause, meaning in (
        (1.0, "", ""),
        (_DEGREE, "degrees", "the rates are in degrees per second"),
        (1.0 / _DEGREE, "degrees", "the positions are in degrees, the rates in radians per second"),
        (-1.0, "sign", "the rates have the other sign"),
    ):
        if abs(fit.factor / factor - 1.0) < _FITS:
            if cause:
                return _fault(name, cause, meaning)
            missed = f"{100.0 * fit.missed:.2g} %"
            return Check(name=name, statement=f"{said}; agrees within {missed}", verdict="measured")
    if fit.factor == 0.0:
        return _fault(name, "constant", "does not move while its rate is not zero, or the reverse")
    said = f"the position changes by {fit.factor:.3g} times what the rate says"
    return _fault(name, "rate_scale", said)


def _base_velocity(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """Axes of the base's velocity, and the point that it is of."""
    if "linear" in log.missing:
        return [], log
    moved = np.diff(log.position, axis=0)
    turned = in_world_axes(log.quaternion, log.linear)
    candidates = {"in world axes": log.linear, "in body axes": turned}
    for point, (arm, swing) in Dynamics(plant).points(log).items():
        if np.abs(arm).max() > 1e-6:
            candidates |= {f"{axes}, of {point}": v - swing
                           for axes, v in list(candidates.items())[:2]}  # fmt: skip
    fits = {axes: _fit(log, moved, velocity) for axes, velocity in candidates.items()}
    axes = min(fits, key=lambda each: fits[each].missed)
    fit = fits[axes]
    if fit.still:
        return [Check(name="base velocity", statement="the base does not move")], log
    if fit.missed > _FITS:
        said = "the velocity is not the position's rate"
        check = _in_no_axes("base velocity", "base_velocity", said, fit)
        return [check], log.replace(linear=_rate(log, log.position))
    alike = [each for each in fits if fits[each].missed < max(3.0 * fit.missed, 1e-6)]
    said = " or ".join(alike) + (", which it does not tell apart" if len(alike) > 1 else "")
    checks = [_scaled("base velocity", fit, said)]
    if "linear" in log.stated and (stated := f"in {log.stated['linear']}") not in alike:
        said = f"{said}, while the log says {stated}, of the base's origin"
        checks = [_fault("base velocity", "axes", said)]
    return checks, log.replace(linear=candidates[axes] * fit.factor)


def _joint_rates(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """Whether each joint's rate is that of its own position."""
    if "rates" in log.missing:
        return [], log
    names = coordinates_of(plant).joints
    moved = np.diff(log.angles, axis=0)
    checks, rates, angles = [], log.rates.copy(), log.angles.copy()
    for i, name in enumerate(names):
        fit = _fit(log, moved[:, [i]], log.rates[:, [i]])
        if fit.missed <= _FITS:
            check = _scaled(name, fit, "its rate")
            if check.cause == "degrees" and fit.factor > 1.0:
                angles[:, i] *= _DEGREE
            else:
                rates[:, i] *= fit.factor
        else:
            others = [_fit(log, moved[:, [i]], log.rates[:, [j]]) for j in range(len(names))]
            best = min(range(len(names)), key=lambda j: others[j].missed)
            if others[best].missed <= _FITS:
                said = f"the rate called {name} is not its own: that of {names[best]} is"
                check = _fault(name, "joint_order", said)
                rates[:, i] = others[best].factor * log.rates[:, best]
            else:
                said = f"its rate is not that of its position; misses {100 * fit.missed:.0f} %"
                check = _fault(name, "joint_rate", said)
                rates[:, i] = _rate(log, log.angles[:, i])
        if check.cause or fit.missed > _FITS:
            checks.append(check)
    said = "every rate is that of its joint's position"
    checks = checks or [Check(name="joints", statement=said)]
    return checks, log.replace(rates=rates, angles=angles)


def _jumps(log: ForeignLog, plant: MultibodyPlant) -> _Checked:
    """Periods in which much more or less happens than the rates say: samples lost or repeated."""
    period = np.diff(log.time)[:, None]
    angles = np.diff(log.angles, axis=0)
    angles -= 2.0 * np.pi * np.round(angles / (2.0 * np.pi))  # logs may begin anew after a turn
    moved = np.hstack([_turned(log), np.diff(log.position, axis=0), angles])
    rates = np.hstack([log.angular, log.linear, log.rates])
    expected = 0.5 * (rates[1:] + rates[:-1]) * period
    square = (expected**2).sum(axis=1)
    moves = square > 1e-4 * square.max()
    ratio = np.divide((moved * expected).sum(axis=1), square, out=np.ones(len(square)), where=moves)
    usual = np.abs(ratio - 1.0) < 0.3
    if usual.mean() < 0.7 or usual.all():
        return [], log
    lost, stale = np.flatnonzero(ratio > 1.3), np.flatnonzero(ratio < 0.3)
    if lost.size > 2 * stale.size:  # what follows a repeated sample jumps too
        missing = int(np.maximum(1, np.round(ratio[lost] - 1.0)).sum())
        said = (
            f"about {missing} samples were dropped and the time renumbered: the motion jumps in "
            f"{lost.size} periods, the first after {log.time[lost[0]]:g} s"
        )
        return [_fault("samples", "dropped_samples", said)], log
    said = f"{stale.size} samples repeat the one before, first at {log.time[stale[0]]:g} s"
    return [_fault("samples", "repeated_samples", said)], log


class Dynamics:
    """Momentum and energy of the bodies of a plant, for the samples of a log."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self.plant = plant
        self.context = plant.CreateDefaultContext()
        self.names = coordinates_of(plant).joints
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        self.bodies = [body for body in bodies if body.default_mass() > 0.0]
        masses = np.array([body.default_mass() for body in self.bodies])
        self.mass = float(masses.sum())
        self.shares = masses / self.mass

    def points(self, log: ForeignLog) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Points that are mistaken for the base's origin: their places from it (n, 3), m, and their
        velocities relative to it (n, 3), m/s, world axes.
        """
        center = np.asarray(base_body(self.plant).CalcCenterOfMassInBodyFrame(self.context))
        arm = in_world_axes(log.quaternion, np.tile(center, (len(log.time), 1)))
        whole, swing = np.zeros_like(log.linear), np.zeros_like(log.linear)
        q, v = [log.quaternion, whole, log.angles], [log.angular, swing, log.rates]
        for k, state in enumerate(np.hstack([*q, *v])):
            self.plant.SetPositionsAndVelocities(self.context, state)
            whole[k] = self.plant.CalcCenterOfMassPositionInWorld(self.context)
            swing[k] = self.plant.CalcCenterOfMassTranslationalVelocityInWorld(self.context)
        return {
            "the base's centre of mass": (arm, np.cross(log.angular, arm)),
            "the spacecraft's centre of mass": (whole, swing),
        }

    def momenta(self, log: ForeignLog) -> tuple[np.ndarray, np.ndarray]:
        """Of every body (n, bodies, 6): the momentum of its mass and that of its rotation about
        its own centre of mass, [angular; linear] about the first base position, world axes.
        """
        of_mass = np.zeros((len(log.time), len(self.bodies), 6))
        of_spin = np.zeros_like(of_mass)
        q = np.hstack([log.quaternion, log.position - log.position[0], log.angles])
        v = np.hstack([log.angular, log.linear, log.rates])
        for k, state in enumerate(np.hstack([q, v])):
            self.plant.SetPositionsAndVelocities(self.context, state)
            for i, body in enumerate(self.bodies):
                pose = body.EvalPoseInWorld(self.context)
                twist = body.EvalSpatialVelocityInWorld(self.context)
                inertia = body.CalcSpatialInertiaInBodyFrame(self.context)
                p_BoBcm_W = pose.rotation() @ inertia.get_com()
                central = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
                rotation = pose.rotation().matrix()
                w = twist.rotational()
                p = inertia.get_mass() * (twist.translational() + np.cross(w, p_BoBcm_W))
                of_mass[k, i, 3:] = p
                of_mass[k, i, :3] = np.cross(pose.translation() + p_BoBcm_W, p)
                turned = rotation @ central.CopyToFullMatrix3() @ rotation.T
                of_spin[k, i, :3] = turned @ w
        return of_mass, of_spin

    def energy(self, log: ForeignLog) -> np.ndarray:
        """Kinetic energy (n), J."""
        q = np.hstack([log.quaternion, log.position, log.angles])
        v = np.hstack([log.angular, log.linear, log.rates])
        found = []
        for state in np.hstack([q, v]):
            self.plant.SetPositionsAndVelocities(self.context, state)
            found.append(self.plant.CalcKineticEnergy(self.context))
        return np.array(found)


def _held(force: np.ndarray) -> tuple[np.ndarray, ...]:
    """Means of a force over each period (n - 1, k), as a log may mean it: that of its samples,
    held from each sample on, or held up to it.
    """
    return 0.5 * (force[1:] + force[:-1]), force[:-1], force[1:]


def _since_start(parts: np.ndarray) -> np.ndarray:
    """Sum since the start (n, k) of what each period gives (n - 1, k)."""
    return np.concatenate([np.zeros_like(parts[:1]), np.cumsum(parts, axis=0)])


def _integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral (n, k) of a rate (n, k) since the start."""
    return _since_start(_held(rate)[0] * np.diff(time)[:, None])


def _impulses(log: ForeignLog) -> list[np.ndarray]:
    """Impulse (n, 6) of the logged external force since the start, as ``Dynamics.momenta``: as
    ``_held``.
    """
    zero = np.zeros((len(log.time), 3))
    force = zero if log.force is None else log.force
    torque = zero if log.torque is None else log.torque
    arm, period = _held(log.position - log.position[0])[0], np.diff(log.time)[:, None]
    return [
        _since_start(np.hstack([moment + np.cross(arm, push), push]) * period)
        for moment, push in zip(_held(torque), _held(force), strict=True)
    ]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Balance:
    """How well momentum is conserved."""

    of_mass: np.ndarray  # (n, bodies, 6)
    of_spin: np.ndarray
    impulse: np.ndarray  # (n, 6)
    scale: np.ndarray  # (6): what the bodies exchange, N m s and N s

    @property
    def total(self) -> np.ndarray:
        """Total momentum without the impulse of the logged forces (n, 6)."""
        found: np.ndarray = (self.of_mass + self.of_spin).sum(axis=1) - self.impulse
        return found

    def missed(self, total: np.ndarray) -> float:
        """Change of a total momentum as a share of what the bodies exchange."""
        return float((np.abs(total - total.mean(axis=0)) / self.scale).max())

    def without(self, effects: Sequence[np.ndarray]) -> tuple[float, np.ndarray]:
        """What is missed with the best multiples of some effects (n, 6) added, and these."""

        def column(change: np.ndarray) -> np.ndarray:
            flat: np.ndarray = ((change - change.mean(axis=0)) / self.scale).ravel()
            return flat

        columns = np.stack([column(effect) for effect in effects], axis=1)
        times, *_ = np.linalg.lstsq(columns, -column(self.total), rcond=1e-9)
        return self.missed(self.total + np.tensordot(times, np.array(effects), axes=1)), times


def _balance(log: ForeignLog, dynamics: Dynamics, impulse: np.ndarray) -> _Balance:
    of_mass, of_spin = dynamics.momenta(log)
    momenta = of_mass + of_spin
    # what a body has beside its share of the whole's drift
    drift = momenta[..., 3:].sum(axis=1, keepdims=True) * dynamics.shares[:, None]
    linear = np.abs(momenta[..., 3:] - drift).sum(axis=1).max()
    angular = np.abs(momenta[..., :3]).sum(axis=1).max()
    scale = np.repeat([angular, linear], 3)
    scale = np.where(scale > 1e-12, scale, 1.0)
    return _Balance(of_mass=of_mass, of_spin=of_spin, impulse=impulse, scale=scale)


_Explanation = tuple[float, str, str]  # what is missed with it, cause, words


def _dynamics(log: ForeignLog, dynamics: Dynamics, tolerance: float) -> list[Check]:
    """Momentum, with the mistake without which it is conserved; energy."""
    kept = np.arange(len(log.time)) % -(-len(log.time) // _MAX_SAMPLES) == 0
    some = _only(log, kept)
    balances = [_balance(some, dynamics, impulse[kept]) for impulse in _impulses(log)]
    balance = min(balances, key=lambda each: each.missed(each.total))
    missed, impulse = balance.missed(balance.total), balance.impulse
    said, doubt, told = "", 0.0, ""
    if log.missing:
        rough = _balance(_only(with_rates(log, every=2), kept), dynamics, impulse)
        doubt = float((np.abs(rough.total - balance.total) / balance.scale).max())
        told = f" (rates of every second sample change it by {doubt:.1g})"
    if missed <= tolerance:
        said = f"conserved within {missed:.2g} of what the bodies exchange{told}"
        return [Check(name="momentum", statement=said), *_energy(log, dynamics, tolerance)]
    if missed <= 2.0 * doubt:
        said = f"changes by {missed:.2g} of what the bodies exchange{told}: log the velocities"
        return [Check(name="momentum", statement=said, verdict="not tested")]
    explained = [*_of_masses(balance, dynamics), *_of_forces(log, balance, dynamics, kept)]
    changes = itertools.chain(_of_points(some, dynamics), _of_joints(some, dynamics.names))
    for cause, words, changed in changes:
        other = _balance(changed, dynamics, impulse)
        explained.append((other.missed(other.total), cause, words))
    left, cause, words = min(explained)
    said = f"changes by {missed:.2g} of what the bodies exchange"
    if left < max(tolerance, (0.02 if missed < _FITS else 0.15) * missed):
        return [_fault("momentum", cause, f"{said}, by {left:.2g} if {words}")]
    cause = "drift" if missed < _DRIFTS else "external_force"
    words = {
        "drift": "a coarse integrator's drift, which shrinks with its step",
        "external_force": "an external force that is not logged",
    }[cause]
    said = f"{said}; no one mistake explains it: {words}, or several at once"
    return [_fault("momentum", cause, said)]


def _of_masses(balance: _Balance, dynamics: Dynamics) -> Iterator[_Explanation]:
    """One body with another mass and inertia: momentum is linear in both."""
    for i, body in enumerate(dynamics.bodies):
        left, more = balance.without([balance.of_mass[:, i], balance.of_spin[:, i]])
        if more[0] > -1.0:
            words = f"{body.name()} has {1.0 + more[0]:.3g} times the mass of the URDF"
            if balance.of_spin[:, i].any():
                words += f" and {1.0 + more[1]:.3g} times the inertia"
            yield left, "mass", words


def _of_forces(
    log: ForeignLog, balance: _Balance, dynamics: Dynamics, kept: np.ndarray
) -> Iterator[_Explanation]:
    """Gravity; drag of the base; momentum that decays."""
    at = log.position - log.position[0]
    center = at + dynamics.points(log)["the spacecraft's centre of mass"][0]

    def impulse(force: np.ndarray, at: np.ndarray, torque: float | np.ndarray = 0.0) -> np.ndarray:
        return _integral(log.time, np.hstack([np.cross(at, force) + torque, force]))[kept]

    axes = [np.tile(axis, (len(log.time), 1)) for axis in np.eye(3)]
    left, pull = balance.without([impulse(axis, center) for axis in axes])
    pull = -pull / dynamics.mass
    words = f"gravity of {np.linalg.norm(pull):.3g} m/s^2 acts along {_direction(pull)}"
    yield left, "gravity", words
    still = np.zeros_like(log.linear)
    drag = [impulse(log.linear, at), impulse(still, at, log.angular)]
    left, sizes = balance.without(drag)
    if sizes.min() > -1e-9 * abs(sizes).max():
        words = f"the base is damped by {sizes[0]:.3g} N s/m and {sizes[1]:.3g} N m s"
        yield left, "damping", words
    decay = _integral(log.time[kept], balance.total)
    left, sizes = balance.without([decay * (np.arange(6) < 3), decay * (np.arange(6) >= 3)])
    if sizes.min() > -1e-9 * abs(sizes).max():
        words = f"it decays by {sizes[1]:.3g} per s, the angular part by {sizes[0]:.3g} per s"
        yield left, "damping", f"{words}: a simulator's damping"


def _direction(vector: np.ndarray) -> str:
    return (
        "[" + ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in vector / np.linalg.norm(vector)) + "]"
    )


def _of_points(log: ForeignLog, dynamics: Dynamics) -> Iterator[tuple[str, str, ForeignLog]]:
    """Another point of the base logged: cause, words, the log without it."""
    for point, (arm, swing) in dynamics.points(log).items():
        words = f"the position and velocity are those of {point}, not of the base's origin"
        yield "point", words, log.replace(position=log.position - arm, linear=log.linear - swing)


def _of_joints(log: ForeignLog, names: Sequence[str]) -> Iterator[tuple[str, str, ForeignLog]]:
    """Joints exchanged, turned the other way, or in degrees: cause, words, the log without it."""
    count = len(names)
    orders = {pair: [*range(count)] for pair in itertools.combinations(range(count), 2)}
    for (i, j), order in orders.items():
        order[i], order[j] = j, i
        words = f"{names[i]} and {names[j]} are exchanged"
        yield "joint_order", words, _joints_as(log, order=order)
    if count > 2:
        words = "the joints stand in the reverse order"
        yield "joint_order", words, _joints_as(log, order=[*range(count)][::-1])
    each = {name: np.arange(count) == i for i, name in enumerate(names)}
    for name, mask in each.items():
        words = f"{name} turns the other way"
        yield "joint_sign", words, _joints_as(log, factor=np.where(mask, -1.0, 1.0))
    for name, mask in {"every joint": np.full(count, True), **each}.items():
        words = f"{name} is in degrees"
        yield "degrees", words, _joints_as(log, factor=np.where(mask, _DEGREE, 1.0))


def _joints_as(
    log: ForeignLog, *, order: Sequence[int] | None = None, factor: float | np.ndarray = 1.0
) -> ForeignLog:
    """The log with its joints in another order, or multiplied."""
    order = range(log.angles.shape[1]) if order is None else order
    return log.replace(angles=log.angles[:, order] * factor, rates=log.rates[:, order] * factor)


def _energy(log: ForeignLog, dynamics: Dynamics, tolerance: float) -> list[Check]:
    """Kinetic energy against the work of the logged forces."""
    energy = dynamics.energy(log)
    change = energy - energy[0]
    if log.efforts is None:
        share = float(np.ptp(energy) / max(energy.max(), 1e-300))
        said = f"changes by {share:.2g} of itself"
        if share <= tolerance:
            return [Check(name="energy", statement=f"{said}: nothing drives the joints")]
        said += "; log the joints' efforts (joint_1_effort, ...) to have it checked"
        return [Check(name="energy", statement=said, verdict="not tested")]
    forces, rates = [log.efforts], [log.rates]
    for force, rate in ((log.force, log.linear), (log.torque, log.angular)):
        if force is not None:
            forces, rates = [*forces, force], [*rates, rate]
    force, rate = np.hstack(forces), np.hstack(rates)
    moved = np.diff(_integral(log.time, rate), axis=0)
    works = [_since_start((each * moved).sum(axis=1)) for each in _held(force)]
    size = max(float(np.abs(_held(force)[0] * moved).sum()), 1e-300)
    missed = min(float(np.abs(change - each).max()) for each in works) / size
    # held efforts are known to half a period only
    allowed = max(tolerance, 20.0 * float(np.ptp(np.array(works), axis=0).max()) / size)
    if missed <= min(allowed, _FITS):
        said = f"follows the work of the efforts within {missed:.2g} of it"
        return [Check(name="energy", statement=said)]
    factors = [float(change @ each) / max(float(each @ each), 1e-300) for each in works]
    left, factor = min(
        (float(np.abs(change - factor * each).max()) / size, factor)
        for factor, each in zip(factors, works, strict=True)
    )
    if left < 0.1 * missed and factor > 0.0:
        said = (
            f"is {factor:.3g} times the work of the efforts: all masses of the log are "
            f"{1.0 / factor:.3g} times those of the URDF, or the efforts have another unit"
        )
        return [_fault("energy", "mass_or_effort_scale", said)]
    said = f"misses the work of the efforts by {missed:.2g} of it"
    return [_fault("energy", "energy", f"{said}: friction, or efforts that are not those applied")]
