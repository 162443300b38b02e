"""Reaction wheels: torque, and the resulting momentum.

A balanced wheel, symmetric about its axis a (base's frame), is described by its momentum h about
the axis, which includes the base's rotation: dh/dt is the torque u on it about the axis, of
motor and friction, and its speed relative to the base is Omega = h/J - a . w. The base's
inertia then includes the wheel without J a a', and the base feels -d(h a)/dt: -u a in its own axes,
and -w x (h a).

The part N h, N = 1 - A^+ A, of the momenta h of wheels with axes A is held by wheels against each
other: A N = 0, so the motors alone can remove it without a torque on the base. Thrusters must
remove the rest (A h).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.products import length
from ffsm_drake.scenario import FaultKind, Wheels

WHEEL_STOPS = FaultKind(
    name="stops",
    effect="the motor fails, and the bearing stops the wheel with the wheel's `torque_limit`",
)
_FADES_BELOW = 0.1  # rad/s; Coulomb friction, which jumps at rest otherwise
_LEAST = 1e-12
_UNLOADING = 0.5  # largest share of the motors' torque
_REARRANGED = 0.02  # share of the speed limit; motors leave a smaller internal momentum


@dataclasses.dataclass(frozen=True, kw_only=True)
class WheelTorques:
    """Output of wheels in one control sample."""

    motor: np.ndarray  # (n) torque of each motor, N m
    on_wheels: np.ndarray  # (n) torque of motor and friction on each, N m
    on_base: np.ndarray  # (3) in the base's axes, without the gyroscopic torque, N m


def _no_torque_about(axis: np.ndarray) -> ScenarioError:
    listed = ", ".join(f"{number:.3g}" for number in axis.round(3) + 0.0)
    return ScenarioError(
        "actuation.wheels.units",
        f"give no torque about the axis [{listed}] of the base; add wheels, or actuation.thrusters",
    )


class WheelSet:
    """Torques of a set of wheels: pure functions of arrays."""

    def __init__(
        self, settings: Wheels, *, sample_time: float, alone: bool, lost: Sequence[str] = ()
    ) -> None:
        """Args:
          settings: the wheels.
          sample_time: s.
          alone: whether there are no thrusters.
          lost: wheels without torque.

        Raises ScenarioError: alone they cannot give every torque. Thrusters, if present, give the
        torque about an axis not covered by wheels.
        """
        units = settings.units.values()
        self.names = tuple(settings.units)
        self.settings, self._sample_time = settings, sample_time
        axes = np.array([unit.axis for unit in units], dtype=float).T
        self.axes = axes / np.linalg.norm(axes, axis=0)  # (3, n)
        (
            self.inertia,
            self._torque,
            self._speed,
            self.initial_momentum,
            self._coulomb,
            self._viscous,
        ) = (
            np.array([getattr(unit, name) for unit in units], dtype=float)
            for name in (
                "inertia",
                "torque_limit",
                "speed_limit",
                "initial_momentum",
                "coulomb_friction",
                "viscous_friction",
            )
        )
        works = np.array([name not in lost for name in self.names])
        used = self.axes * works
        self._share = np.linalg.pinv(used, rcond=1e-9)
        left, sizes, _ = np.linalg.svd(used)
        self._lost = left[:, np.count_nonzero(sizes > 1e-9) :].T  # unit axes of no torque
        if alone and len(self._lost):
            raise _no_torque_about(self._lost[-1])
        # Speeds that together give the base nothing.
        self._idle = np.eye(len(self.names)) - self._share @ self.axes
        self._opposed = np.diag(1.0 * works) - self._share @ used  # N
        self._most_momentum = self.inertia * self._speed

    @property
    def constants(self) -> str:
        """What its functions depend on, besides their arguments."""
        return repr((self.settings, self._sample_time, self._share.tolist()))

    def speed(self, momentum: np.ndarray, angular_velocity: np.ndarray) -> np.ndarray:
        """Speeds (n, rad/s) relative to the base, from momenta (n, N m s) and w_WB in the base's
        axes (3, rad/s).
        """
        return momentum / self.inertia - self.axes.T.dot(angular_velocity)

    def give(
        self,
        torque: np.ndarray,
        momentum: np.ndarray,
        angular_velocity: np.ndarray,
        *,
        rearranging: np.ndarray | None = None,
    ) -> WheelTorques:
        """The torques nearest to a wanted one on the base (3, base's axes) within the wheels'
        limits.

        Above the motors' limits it is scaled; a wheel at its speed limit is not accelerated. What
        room is left is for torques of the motors ``rearranging`` (n) that the base does not
        feel.
        """
        motor = -self._share.dot(torque)
        motor = motor / np.maximum(1.0, self._loads(motor))
        carried = self.inertia * self.axes.T.dot(angular_velocity)
        most = self.inertia * self._speed
        lower = (carried - most - momentum) / self._sample_time
        upper = (carried + most - momentum) / self._sample_time
        motor = np.clip(np.clip(motor, lower, upper), -self._torque, self._torque)
        if rearranging is not None:
            ahead = np.where(
                rearranging > 0.0, np.minimum(upper, self._torque), np.maximum(lower, -self._torque)
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                room = np.where(rearranging == 0.0, np.inf, (ahead - motor) / rearranging)
            motor = motor + np.clip(room.min(), 0.0, 1.0) * rearranging
        speed = self.speed(momentum, angular_velocity)
        on_wheels = motor - self._coulomb * np.tanh(speed / _FADES_BELOW) - self._viscous * speed
        return WheelTorques(motor=motor, on_wheels=on_wheels, on_base=-self.axes.dot(on_wheels))

    def stopping(
        self,
        torques: WheelTorques,
        stops: np.ndarray,
        momentum: np.ndarray,
        angular_velocity: np.ndarray,
    ) -> WheelTorques:
        """The torques with some wheels (n) stopped: their motors give nothing, and their bearings
        brake them with the motor's largest torque until they turn with the base.
        """
        spin = self.inertia * self.speed(momentum, angular_velocity)
        brake = -np.clip(spin / self._sample_time, -self._torque, self._torque)
        on_wheels = np.where(stops > 0.0, brake, torques.on_wheels)
        motor = np.where(stops > 0.0, 0.0, torques.motor)
        return WheelTorques(motor=motor, on_wheels=on_wheels, on_base=-self.axes.dot(on_wheels))

    def _loads(self, motor: np.ndarray) -> Any:
        """The largest share of a motor's limit among torques of motors (n), N m."""
        return (np.abs(motor) / self._torque).max()

    @property
    def reach(self) -> np.ndarray:
        """The largest torque of each motor (3, n; base's axes), N m."""
        return self.axes * self._torque

    def most(self, direction: np.ndarray) -> float:
        """The largest multiple of a torque (3; base's axes, N m) within the motors' limits, without
        its part about axes left to thrusters; infinite if nothing remains.
        """
        used = float(self._loads(self._share.dot(direction)))
        return 1.0 / used if used > _LEAST * float(np.linalg.norm(direction)) else np.inf

    @property
    def initial(self) -> np.ndarray:
        """Angular momentum (3, base's axes) that they hold at the start, N m s."""
        return self.axes @ self.initial_momentum

    def filled(self, momentum: np.ndarray) -> np.ndarray:
        """The share of its speed limit (..., n) of each wheel for a total momentum, in a base at
        rest.

        The motors have brought the wheels there from their initial momentum, sharing torque as in
        ``give``, without rearranging.

        Args:
          momentum: (..., 3), base's axes, N m s.
        """
        share: np.ndarray = (
            np.abs(momentum @ self._share.T + self._idle @ self.initial_momentum)
            / self._most_momentum
        )
        return share

    def capacity(self, direction: np.ndarray) -> float:
        """The largest momentum along a direction (3, base's axes), N m s, that ``filled`` allows;
        at least zero.
        """
        unit = direction / np.linalg.norm(direction)
        if len(self._lost) and np.abs(self._lost @ unit).max() > 1e-9:
            return 0.0
        along = self._share @ unit
        room = self._most_momentum - np.sign(along) * (self._idle @ self.initial_momentum)
        with np.errstate(divide="ignore"):
            return max(0.0, float((room / np.abs(along)).min()))

    @property
    def least_capacity(self) -> float:
        """``capacity`` along the worst direction, N m s."""
        if len(self._lost):
            return 0.0
        room = self._most_momentum - np.abs(self._idle @ self.initial_momentum)
        return max(0.0, float((room / np.linalg.norm(self._share, axis=1)).min()))

    def assist_torque(self, torque: np.ndarray) -> np.ndarray:
        """The part of a commanded torque on the base (3, base's axes, N m) requested from
        thrusters: axes not covered by wheels, and the excess defined by ``assist_above``.
        """
        lost = np.zeros_like(torque)
        if len(self._lost):
            lost = self._lost.T.dot(self._lost.dot(torque))
        if self.settings.assist_above is None:
            return lost
        feasible = torque - lost
        share = self.settings.assist_above / (self._loads(self._share.dot(feasible)) + _LEAST)
        return lost + np.maximum(0.0, 1.0 - share) * feasible

    def bounded(self, impulse: np.ndarray, samples: int) -> np.ndarray:
        """An impulse of torque (3, N m s), cut to twice what the weakest motor gives in some
        control samples.
        """
        most = 2.0 * samples * self._sample_time * self._torque.min()
        return impulse / np.maximum(1.0, length(impulse) / most)

    def unloads(
        self, was: np.ndarray | bool, momentum: np.ndarray, angular_velocity: np.ndarray
    ) -> np.ndarray:
        """Whether (1) thrusters are to unload the wheels, by what they do not hold against
        each other, with hysteresis; ``was``: whether they were.
        """
        fullest = self._fullest(momentum - self._opposed.dot(momentum), angular_velocity)
        below, above = self.settings.desaturate_below, self.settings.desaturate_above
        return fullest > np.where(was, below, above)

    def rearranges(
        self, was: np.ndarray | bool, momentum: np.ndarray, angular_velocity: np.ndarray
    ) -> np.ndarray:
        """Whether (1) motors are to remove momentum held by wheels against each other; with
        hysteresis, until none is left.
        """
        left = np.abs(self._opposed.dot(momentum) / self._most_momentum).max()
        below, above = self.settings.desaturate_below, self.settings.desaturate_above
        full = self._fullest(momentum, angular_velocity) > np.where(was, below, above)
        return full & (left > np.where(was, 1.0, 2.0) * _REARRANGED)

    def _fullest(self, momentum: np.ndarray, angular_velocity: np.ndarray) -> Any:
        """The largest share of a speed limit."""
        return (np.abs(self.speed(momentum, angular_velocity)) / self._speed).max()

    def unloading_torque(self, momentum: np.ndarray) -> np.ndarray:
        """Torque on the base (3, base's axes) for thrusters, to make the opposing wheels lose
        momentum.
        """
        torque = -self.axes.dot(momentum) / self.settings.desaturation_time
        largest = self._loads(self._share.dot(torque)) / _UNLOADING
        return torque / np.maximum(1.0, largest)

    def rearranging_torque(self, momentum: np.ndarray) -> np.ndarray:
        """Motor torques (n) that remove the momentum held by wheels against each other."""
        motor = -self._opposed.dot(momentum) / self.settings.desaturation_time
        return motor / np.maximum(1.0, self._loads(motor) / _UNLOADING)
