"""Mistakes of a log that may explain why its momentum changes."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from pydrake.multibody.tree import RevoluteJoint
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ffsm_drake.plugins.audit.log import Array, Log, every, only
from ffsm_drake.plugins.audit.misfit import Mistake
from ffsm_drake.plugins.audit.momentum_residual import Residual
from ffsm_drake.plugins.audit.motions import constant, fixed, turned

_DEGREE = np.pi / 180.0
_FARTHEST = 2.0  # largest offset of a sliding joint, m
_STARTS, _TRIED = 8, 3  # offsets at which a search may begin; starts of which a search begins


def mistakes_of(found: Residual) -> Iterator[Mistake]:
    """Mistakes with one cause, to be fitted to the residual."""
    yield from _of_masses(found)
    yield from _of_centers(found)
    yield from _of_zeros(found)
    yield from _of_forces(found)
    yield from _of_frames(found)
    for cause, words, changed in _of_columns(found):
        yield _instead(found, cause, words, changed)


def _instead(found: Residual, cause: str, words: str, log: Log) -> Mistake:
    """Mistake that replaces the logged samples with ``log``. Its size is near 1 if it applies."""
    change = found.missed - found.residual(log)
    return Mistake(cause=cause, text=words, columns=[change], least=0.9, most=1.1)


def _fitted(
    found: Residual, missed: Callable[[Array], Array], starts: Array, **mistake: Any
) -> Mistake:
    """Mistake with a nonlinear effect, linearised at the sizes that fit best.

    Args:
      missed: the residual (n, 6) without a mistake of given sizes (k).
      starts: sizes (m, k) at which a search may begin.
    """

    def flat(sizes: Array) -> Array:
        left = missed(sizes)
        return np.asarray((left - left.mean(axis=0)).ravel())

    most = np.array([np.abs(flat(sizes)).max() for sizes in starts])
    near = [i for i in np.argsort(most)[:_TRIED] if most[i] < 2.0 * most.min()]
    fits = [least_squares(flat, starts[i], x_scale="jac", max_nfev=40) for i in near or [0]]
    best = min(fits, key=lambda fit: float(fit.cost))
    columns = [*-np.asarray(best.jac).T.reshape(-1, *found.missed.shape)]
    linear = sum(size * column for size, column in zip(best.x, columns, strict=True))
    return Mistake(columns=columns, bent=found.missed - missed(best.x) - linear, **mistake)


def _of_masses(found: Residual) -> Iterator[Mistake]:
    """One body with another mass and inertia. Momentum is linear in both."""
    bodies = found.dynamics.bodies
    for i, body in enumerate(bodies if len(bodies) > 1 else ()):
        words = " has {1:.3g} times the mass of the URDF and {2:.3g} times the inertia"
        yield Mistake(
            cause="mass", text=body.name() + words, offset=1.0, floors=-1.0,
            columns=[-part[:, i] / found.scale for part in found.momenta],
        )  # fmt: skip


def _of_centers(found: Residual) -> Iterator[Mistake]:
    """One body with another centre of mass."""
    bodies = found.dynamics.bodies
    for i, body in enumerate(bodies if len(bodies) > 1 else ()):

        def missed(by: Array, i: int = i) -> Array:
            return found.residual(found.some, bodies=found.bodies.shifted(i, by))

        words = f"{body.name()}'s centre of mass differs by {{0}} from the URDF, in its own axes"
        yield _fitted(found, missed, np.zeros((1, 3)), cause="center_of_mass", text=words, unit="m")


def _of_zeros(found: Residual) -> Iterator[Mistake]:
    """A joint's position with a constant offset."""
    log, plant = found.some, found.dynamics.plant
    for name, axis in zip(found.dynamics.names, np.eye(len(log.angles.T)), strict=True):

        def missed(offset: Array, axis: Array = axis) -> Array:
            return found.residual(log.replace(angles=log.angles - offset * axis))

        turns = plant.GetJointByName(name).type_name() == RevoluteJoint.kTypeName
        most = np.pi if turns else _FARTHEST
        yield _fitted(
            found, missed, most * np.linspace(-1.0, 1.0, _STARTS, endpoint=False)[:, None],
            cause="zero_shift", text=f"{name}'s position has a constant offset of {{0}}",
            unit="rad" if turns else "m",
        )  # fmt: skip


def _of_forces(found: Residual) -> Iterator[Mistake]:
    """Gravity, a constant force, drag of the base, and momentum that decays."""
    some, place, attitude = found.some, found.some.position, found.some.attitude
    shares = found.dynamics.masses / found.dynamics.mass
    center = place + attitude.apply(np.einsum("b,nbi->ni", shares, found.bodies.center))
    still = np.zeros_like(place)

    def impulse(force: Array, at: Array, torque: Array) -> Array:
        rate = np.hstack([np.cross(at, force) + torque, force])
        return _integral(some.time, rate) / found.scale

    decay = -_integral(some.time, found.missed)

    world = constant(some, np.eye(3))
    for words, axes in (("world axes", world), ("base axes", fixed(some))):
        pushes = [impulse(axis, place, still) for axis in axes]
        turns = [impulse(still, place, axis) for axis in axes]
        for what, columns in (("N", pushes), ("N m", turns), ("(N, N m)", pushes + turns)):
            yield Mistake(
                cause="external_force", text=f"the base is pushed by {{0}} {what} in {words}",
                columns=columns,
            )  # fmt: skip
    for cause, text, columns, floors in (
        ("gravity", "gravity of {0} m/s^2 acts",
         [impulse(found.dynamics.mass * axis, center, still) for axis in world], -np.inf),
        ("damping", "the base is damped by {1:.3g} N s/m and {2:.3g} N m s",
         [-impulse(some.linear, place, still), -impulse(still, place, some.angular)], 0.0),
        ("damping", "it decays by {1:.3g} per s, the angular part by {2:.3g} per s: a simulator's "
         "damping", [decay * (np.arange(6) >= 3), decay * (np.arange(6) < 3)], 0.0),
    ):  # fmt: skip
        yield Mistake(cause=cause, text=text, columns=columns, floors=floors)


def _of_frames(found: Residual) -> Iterator[Mistake]:
    """A constant rotation of the base's axes, one of the attitude's world axes, or a log in a
    turning frame.
    """
    some, since = found.some, (found.some.time - found.some.time[0])[:, None]
    attitude, place = some.attitude, some.position + found.log.position[0]

    def turned_to(turn: Rotation, angular: Array) -> Log:
        return some.replace(quaternion=turn.as_quat(scalar_first=True), angular=angular)

    def base(vector: Array) -> Log:
        return turned_to(attitude * Rotation.from_rotvec(-vector), some.angular)

    def world(vector: Array) -> Log:
        back = Rotation.from_rotvec(-vector)
        return turned_to(back * attitude, back.apply(some.angular))

    def turning(rate: Array) -> Log:
        frame = Rotation.from_rotvec(since * rate)
        return turned_to(frame * attitude, frame.apply(some.angular + rate)).replace(
            position=frame.apply(place) - place[0],
            linear=frame.apply(some.linear + np.cross(rate, place)),
        )

    cube = Rotation.create_group("O").as_rotvec()
    for cause, changed, starts, factor, unit, words in (
        ("frame", base, cube, 1.0 / _DEGREE, "deg", "the base's axes are turned from the URDF's by "
         "{0} (rotation vector): another body frame, or a star tracker's"),
        ("frame", world, cube, 1.0 / _DEGREE, "deg", "the world axes of the attitude are turned "
         "from the axes of the positions by {0} (rotation vector)"),
        ("frame_rate", turning, np.zeros((1, 3)), 1.0, "rad/s", "the log is in a frame that turns "
         "at a constant rate of {0} (its own axes)"),
    ):  # fmt: skip

        def missed(vector: Array, changed: Callable[[Array], Log] = changed) -> Array:
            return found.residual(changed(vector), bodies=found.bodies)

        yield _fitted(found, missed, starts, cause=cause, text=words, unit=unit, factor=factor)


def _of_columns(found: Residual) -> Iterator[tuple[str, str, Log]]:
    """Cause, description and the log without the mistake.

    The log has another point of the base, or its joints are exchanged, reversed or in degrees.
    """
    log, names = found.some, found.dynamics.names
    for point, (arm, swung) in found.dynamics.points(log).items():
        words = f"position and velocity belong to {point}, not to the origin of the base"
        yield "point", words, log.replace(position=log.position - arm, linear=log.linear - swung)
    order = [*range(len(names))]
    orders = {"the joints are in reverse order": order[::-1]} if len(names) > 2 else {}
    for i, j in itertools.combinations(order, 2):
        swapped = [{i: j, j: i}.get(k, k) for k in order]
        orders[f"{names[i]} and {names[j]} are exchanged"] = swapped
    for words, each in orders.items():
        yield "joint_order", words, _joints(log, each, 1.0)
    for i, name in enumerate(names):
        sign = np.where(np.arange(len(names)) == i, -1.0, 1.0)
        yield "joint_sign", f"{name} has the opposite sign", _joints(log, order, sign)
    yield "degrees", "every joint is in degrees", _joints(log, order, _DEGREE)


def _integral(time: Array, rate: Array) -> Array:
    """Integral (n, k) of a smooth rate (n, k) since the start."""
    return CubicSpline(time, rate).antiderivative()(time)


def _joints(log: Log, order: list[int], factor: float | Array) -> Log:
    """The log with its joints in another order, and multiplied."""
    return log.replace(angles=log.angles[:, order] * factor, rates=log.rates[:, order] * factor)


def of_integrator(found: Residual) -> Iterator[Mistake]:
    """The drift of first-order integrators. The momentum changes with the square of the step."""
    log, period = found.log, np.diff(found.log.time)
    near = every(len(period), most=1000)
    here, there = only(log, near), only(log, near + 1)
    times = 0.5 * (here.time + there.time)
    halfway = Rotation.from_rotvec(0.5 * turned(log)[near]) * here.attitude
    most = float(np.abs(np.hstack([found.some.angular, found.some.rates])).max())
    trial = 0.01 / max(most, 1e-9)

    def total(is_body: bool, semi: float, step: float) -> Array:
        """The total after a step from the middle of each period; rates change before poses."""

        def after(what: str, step: float) -> Array:
            first, last = getattr(here, what), getattr(there, what)
            if is_body and what == "angular":
                first, last = (x.attitude.inv().apply(x.angular) for x in (here, there))
            return 0.5 * (first + last) + step * (last - first) / period[near][:, None]

        def moved(path: str, rate: str) -> Array:
            return after(path, 0.0) + step * after(rate, semi * step)

        more = Rotation.from_rotvec(step * after("angular", semi * step))
        now = halfway * more if is_body else more * halfway
        omega = after("angular", step)
        return found.total(here.replace(
            quaternion=now.as_quat(scalar_first=True), angles=moved("angles", "rates"),
            position=moved("position", "linear") - log.position[0],
            angular=now.apply(omega) if is_body else omega,
            linear=after("linear", step), rates=after("rates", step),
        ))  # fmt: skip

    for way in itertools.product((True, False), (1.0, 0.0)):
        sides = total(*way, trial) + total(*way, -trial) - 2.0 * total(*way, 0.0)
        drift = CubicSpline(times, sides / (2.0 * trial**2)).antiderivative()(found.some.time)
        yield Mistake(
            cause="integrator", text="", columns=[drift], least=0.0, most=1.1 * period.max(),
        )  # fmt: skip
