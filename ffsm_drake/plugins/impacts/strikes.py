"""Repeated impacts against the spin of a target.

The arms strike in turn. A tip meets the face towards its side, off the face's middle
against the spin, with a chosen speed. From the contact on the tip moves as the admittance has it,
beside the planned motion and for a while:

    m x'' + d x' + k x = f,

with f the measured contact force: the target meets the mass m. Without admittance the tip follows
its plan, as stiff as its drives allow. Then the tip returns. Joint torques follow from the
accelerations of tips and hands by inverse dynamics of the free-floating robot, in which the base
is moved by nothing but the arms.
"""

import dataclasses
import math

import numpy as np

from ffsm_drake.plugins.impacts.contact import Surface
from ffsm_drake.plugins.impacts.robot import (
    JOINTS,
    TARGET,
    TIP,
    TIP_ANGLE,
    TORQUE_LIMIT,
    WIDTH,
    Scene,
)

START = np.array(
    [0.0, 0.0, 0.0, np.pi / 3, -np.pi / 3, -np.pi / 2, -np.pi / 3, np.pi / 3, np.pi / 2]
)
_AWAY, _APART = 0.16, 0.05  # m; of a tip from the target's centre, of mirrored hands
_K_P, _K_D = 400.0, 40.0  # 1/s^2, 1/s; of tips and hands about their plans


@dataclasses.dataclass(frozen=True, kw_only=True)
class Admittance:
    """Motion of a tip under contact force, for a while after the contact begins."""

    mass: float = 0.2  # kg
    damping: float = 0.1  # N s/m
    stiffness: float = 0.1  # N/m
    duration: float = 0.35  # s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Strikes:
    """A mission: the target's spin and how it is struck."""

    spin: float = 1.0  # rad/s
    slow: float = 0.5  # rad/s; below it no tip strikes any more
    speed: float = 0.17  # m/s; of the tip to the face
    off_middle: float = 0.75  # share of half the width
    soonest: float = 0.8  # s; of a strike from its start
    duration: float = 25.0  # s
    step: float = 1e-3  # s; of control and integration (Runge-Kutta of order 4)
    surface: Surface = Surface()
    admittance: Admittance | None = Admittance()


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """A run at its steps; momentum is that of robot and target together."""

    strikes: np.ndarray  # (m, 3) begin, end (s) and the spin after each contact, rad/s
    time: np.ndarray  # (n) s
    q: np.ndarray  # (n, 12)
    v: np.ndarray  # (n, 12)
    force: np.ndarray  # (n, 2, 2) size on each tip, N
    torque: np.ndarray  # (n, 6) N m
    momentum: np.ndarray  # (n, 3) N s, N s, N m s

    @property
    def spin(self) -> np.ndarray:
        """Rate of the target (n), rad/s."""
        return self.v[:, 11]


class _Hand:
    """Commanded motion of a hand: [x, y] of its wrist, and its angle."""

    def __init__(self, home: np.ndarray) -> None:
        self._begin, self._end, self._last = 0.0, 0.0, np.array([home, np.zeros(3)])
        self._polynomial = np.zeros((6, 3))
        self.striking, self.contact = False, math.nan  # s; when the contact began
        self.yielded = np.zeros((3, 3))  # by the admittance: way, speed, acceleration

    def move(self, now: float, *, to: np.ndarray, at: float, speed: np.ndarray) -> None:
        """From the command of now by a quintic to a place at a time, and on from there at a
        speed.
        """
        T, k = at - now, np.arange(6)
        first, last = (self._rows(k, t) for t in (0.0, T))
        start, end = self.command(now), np.array([to, speed, np.zeros(3)])
        self._polynomial = np.linalg.solve(np.vstack([first, last]), np.vstack([start, end]))
        self._begin, self._end, self._last = now, at, end[:2]
        self.yielded = np.zeros((3, 3))

    @staticmethod
    def _rows(k: np.ndarray, t: float) -> np.ndarray:
        """Powers of t and their derivatives (3, 6)."""
        powers = t ** np.maximum(k - np.arange(3)[:, None], 0)
        return np.array([np.ones(6), k, k * (k - 1)]) * powers

    def command(self, time: float) -> np.ndarray:
        """[x; x'; x''] (3, 3)."""
        if time < self._end:
            planned = self._rows(np.arange(6), time - self._begin) @ self._polynomial
        else:
            to, speed = self._last
            planned = np.array([to + (time - self._end) * speed, speed, np.zeros(3)])
        found: np.ndarray = planned + self.yielded
        return found

    @property
    def due(self) -> float:
        """Time of the planned end, s."""
        return self._end

    def give_way(self, force: np.ndarray, how: Admittance, step: float) -> None:
        """A step of the admittance under the force (2) on the tip."""
        way, speed, acceleration = self.yielded
        acceleration[:2] = force - how.damping * speed[:2] - how.stiffness * way[:2]
        acceleration[:2] /= how.mass
        speed += step * acceleration
        way += step * speed


class _Control:
    """Which arm strikes when, and the joint torques."""

    def __init__(
        self, scene: Scene, mission: Strikes, state: tuple[np.ndarray, np.ndarray]
    ) -> None:
        self._scene, self._mission = scene, mission
        self._tip = 0 if mission.spin > 0.0 else 1  # index of the leading tip
        self._lead = -math.copysign(0.5 * TIP_ANGLE, mission.spin)
        scene.place(*state)
        self.hands = [_Hand(self._state(i, state[0])) for i in range(2)]
        self._next = 0

    def _state(self, hand: int, q: np.ndarray) -> np.ndarray:
        X = self._scene.hands[hand].EvalPoseInWorld(self._scene.context)
        angle = q[2] + q[3 + 3 * hand : 6 + 3 * hand].sum()
        return np.array([*X.translation()[:2], angle])

    def _goal(self, hand: int, tip: np.ndarray) -> np.ndarray:
        """[wrist, angle] with the leading tip at a place."""
        angle = (2.0 * hand - 1.0) * 0.5 * np.pi + self._lead
        c, s = math.cos(angle), math.sin(angle)
        offset = np.array([[c, -s], [s, c]]) @ self._scene.tips[self._tip][:2]
        return np.array([*(tip - offset), angle])

    def _both(self, hand: int, now: float, at: float, goal: np.ndarray, speed: np.ndarray) -> None:
        """A hand moves to a goal, the other in its mirror, a little apart: the base turns less."""
        self.hands[hand].move(now, to=goal, at=at, speed=speed)
        apart = np.array([(2.0 * hand - 1.0) * _APART, 0.0, 0.0])
        mirrored = (goal + apart) * [-1.0, 1.0, -1.0]
        self.hands[1 - hand].move(now, to=mirrored, at=at, speed=np.zeros(3))

    def decide(self, time: float, q: np.ndarray, v: np.ndarray, forces: np.ndarray) -> None:
        """Begin a strike, an admittance, or the way back."""
        mission, target, rate = self._mission, q[TARGET], v[TARGET]
        for i, hand in enumerate(self.hands):
            touched = bool(forces[i].any())
            if hand.striking and touched and math.isnan(hand.contact):
                hand.contact = time
            if not math.isnan(hand.contact):
                if mission.admittance is not None:
                    hand.give_way(forces[i].sum(axis=0), mission.admittance, mission.step)
                over = time >= hand.contact + (mission.admittance or Admittance()).duration
                over = over and not touched
            else:
                over = hand.striking and time > hand.due + 0.3  # it met nothing
            if over:
                hand.striking, hand.contact = False, math.nan
                side = 2.0 * i - 1.0
                away = self._goal(i, target[:2] + np.array([side * _AWAY, 0.0]))
                self._both(i, time, time + mission.soonest, away, np.zeros(3))
        if not any(hand.striking for hand in self.hands) and abs(rate[2]) > mission.slow:
            self._strike(time, target, rate)

    def _strike(self, time: float, target: np.ndarray, rate: np.ndarray) -> None:
        mission, i = self._mission, self._next
        quarter, spin = 0.5 * np.pi, math.copysign(1.0, rate[2])
        hand = self.hands[i]
        soonest = max(time, hand.due) + mission.soonest
        turned = target[2] + rate[2] * (soonest - time)
        left = (-spin * turned) % quarter  # to turn until a face looks to the side
        at = soonest + left / abs(rate[2])
        side = 2.0 * i - 1.0
        off = 0.5 * WIDTH * mission.off_middle
        center = target[:2] + rate[:2] * (at - time)
        face = np.array([side * (0.5 * WIDTH + TIP), -side * spin * off])
        speed = rate[:2] - [side * (mission.speed - abs(rate[2]) * off), 0.0]
        self._both(i, time, at, self._goal(i, center + face), np.array([*speed, 0.0]))
        hand.striking, self._next = True, 1 - i

    def torque(self, time: float, q: np.ndarray, v: np.ndarray, contact: np.ndarray) -> np.ndarray:
        """Joint torques (6) at the configuration that the scene was ``place``d at."""
        scene = self._scene
        rows, wanted = np.zeros((6, 9)), np.zeros(6)
        for i, body in enumerate(scene.hands):
            own = slice(3 * i, 3 * i + 3)
            rows[own][:2] = scene.jacobian(body, np.zeros(3))[:, :9]
            rows[3 * i + 2, [2, 3 + 3 * i, 4 + 3 * i, 5 + 3 * i]] = 1.0
            x, speed, acceleration = self.hands[i].command(time)
            wanted[own] = acceleration + _K_D * (speed - rows[own] @ v[:9])
            wanted[own] += _K_P * (x - self._state(i, q))
            wanted[own][:2] -= scene.bias(body, np.zeros(3))
        mass = scene.plant.CalcMassMatrix(scene.context)[:9, :9]
        known = (contact - scene.plant.CalcBiasTerm(scene.context))[:9]
        driven = np.zeros((9, 6))
        driven[JOINTS] = np.eye(6)
        system = np.block([[mass, -driven], [rows, np.zeros((6, 6))]])
        found = np.linalg.solve(system, np.concatenate([known, wanted]))[9:]
        return np.clip(found, -TORQUE_LIMIT, TORQUE_LIMIT)


def run(mission: Strikes | None = None) -> Run:
    """Strike the target until it is slow, then come to rest beside it.

    Example:
      >>> from ffsm_drake.plugins.impacts.strikes import Strikes, run
      >>> short = run(Strikes(duration=0.1))
      >>> float(abs(short.momentum - short.momentum[0]).max()) < 1e-12
      True
    """
    mission = mission or Strikes()
    scene, step = Scene(mission.surface), mission.step
    q, v = np.concatenate([START, [0.0, 0.35, 0.0]]), np.zeros(12)
    v[11] = mission.spin
    control = _Control(scene, mission, (q, v))
    rows, contacts, begun = list[tuple[np.ndarray, ...]](), list[list[float]](), math.nan
    for k in range(round(mission.duration / step)):
        time = k * step
        scene.place(q, v)
        contact, forces = scene.contacts(q, v)
        control.decide(time, q, v, forces)
        torque = control.torque(time, q, v, contact)
        sizes = np.linalg.norm(forces, axis=2)
        rows.append((np.array(time), q, v, sizes, torque, scene.momentum(q, v)))
        if sizes.any() and math.isnan(begun):
            begun = time
        if not math.isnan(begun) and not sizes.any() and time > begun + 0.05:
            contacts.append([begun, time, v[11]])
            begun = math.nan
        q, v = _advance(scene, q, v, torque, step)
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Run(np.array(contacts).reshape(-1, 3), *columns)


def _advance(
    scene: Scene, q: np.ndarray, v: np.ndarray, torque: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """A step of the classical Runge-Kutta method."""
    k = [(v, scene.acceleration(q, v, torque))]
    for share in (0.5, 0.5, 1.0):
        rate, acceleration = k[-1]
        at = v + share * step * acceleration
        k.append((at, scene.acceleration(q + share * step * rate, at, torque)))
    change = [
        step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        for first, second, third, fourth in zip(*k, strict=True)
    ]
    return q + change[0], v + change[1]
