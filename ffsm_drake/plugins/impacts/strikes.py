"""Repeated impacts against the spin of a target.

The arms strike in turn. A tip meets the face towards its side, off the face's middle
against the spin, with a chosen speed. From the contact on the tip moves as the admittance has it,
beside the planned motion and for a while:

    m x'' + d x' + k x = f,

with f the measured contact force: the target meets the mass m. Without admittance the tip follows
its plan, as stiff as its drives allow. Then the tip returns. Joint torques follow from the
accelerations of tips and hands by inverse dynamics of the free-floating robot, in which the base
is moved by nothing but the arms.

A slow target may be caged: both hands come beside two opposite faces, turn with them, close until
all four tips press, and then stop, and the target with them.
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
    TIP_REACH,
    TORQUE_LIMIT,
    WIDTH,
    Scene,
    arm_joints,
)

START = np.array(
    [0.0, 0.0, 0.0, np.pi / 3, -np.pi / 3, -np.pi / 2, -np.pi / 3, np.pi / 3, np.pi / 2]
)
# m; of a wrist from the centre of a target that its tips touch
_HELD = 0.5 * WIDTH + TIP + TIP_REACH * math.cos(TIP_ANGLE)
_QUARTER = 0.5 * np.pi
_AWAY, _APART = 0.16, 0.05  # m; of a tip from the target's centre, of mirrored hands
_K_P, _K_D = 400.0, 40.0  # 1/s^2, 1/s; of tips and hands about their plans
_STIFF = 1e4, 200.0  # likewise, for hands that hold


@dataclasses.dataclass(frozen=True, kw_only=True)
class Admittance:
    """Motion of a tip under contact force, for a while after the contact begins."""

    mass: float = 0.2  # kg
    damping: float = 0.1  # N s/m
    stiffness: float = 0.1  # N/m
    duration: float = 0.35  # s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cage:
    """Both hands close about the slow target, and stop."""

    gap: float = 0.03  # m; of the tips from the faces before they close
    press: float = 1e-3  # m; of each tip into its face in the end
    soonest: float = 1.5  # s; until the hands are beside the faces
    close: float = 0.6  # s
    stop: float = 0.5  # s


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
    cage: Cage | None = None


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
    """Commanded motion of a hand: [x, y] of its wrist, and its angle; or of joints."""

    def __init__(self, home: np.ndarray) -> None:
        self._begin, self._end, self._last = 0.0, 0.0, np.array([home, 0.0 * home])
        self._polynomial = np.zeros((6, home.size))
        self.striking, self.contact = False, math.nan  # s; when the contact began
        self.yielded = np.zeros((3, home.size))  # by the admittance: way, speed, acceleration

    def move(self, now: float, *, to: np.ndarray, at: float, speed: np.ndarray) -> None:
        """From the command of now by a quintic to a place at a time, and on from there at a
        speed.
        """
        T, k = at - now, np.arange(6)
        first, last = (self._rows(k, t) for t in (0.0, T))
        start, end = self.command(now), np.array([to, speed, 0.0 * to])
        self._polynomial = np.linalg.solve(np.vstack([first, last]), np.vstack([start, end]))
        self._begin, self._end, self._last = now, at, end[:2]
        self.yielded = 0.0 * end

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
            planned = np.array([to + (time - self._end) * speed, speed, 0.0 * to])
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


class _Caging:
    """Commanded motion of both hands about a target from a time on.

    ``place`` (3) is the target's then, its angle that of the way from the left to the right hand.
    """

    def __init__(self, cage: Cage, begin: float, place: np.ndarray, rate: np.ndarray) -> None:
        self._cage, self.begin, self._place, self._rate = cage, begin, place, rate
        self.stiff = begin + 0.5 * cage.close  # s; before the tips touch
        self.end = begin + cage.close + cage.stop

    def command(self, hand: int, time: float) -> np.ndarray:
        """[x; x'; x''] (3, 3) of a hand's wrist and angle."""
        cage, side, t = self._cage, 2.0 * hand - 1.0, time - self.begin
        # frame: at the target's rates until the tips press, then to rest
        late = min(max(t - cage.close, 0.0), cage.stop)
        slower = -self._rate / cage.stop if 0.0 < late < cage.stop else np.zeros(3)
        rate = self._rate * (1.0 - late / cage.stop)
        place = self._place + self._rate * (min(t, cage.close) + late - 0.5 * late**2 / cage.stop)
        # distance of the wrist from the target's centre
        x = min(t / cage.close, 1.0)
        way = np.array([x**3 * (10.0 - 15.0 * x + 6.0 * x * x), 30.0 * (x * (1.0 - x)) ** 2,
                        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)])  # fmt: skip
        way *= -(cage.gap + cage.press) / cage.close ** np.arange(3)
        way[0] += _HELD + cage.gap
        d, d_rate, d_rate_rate = way
        c, s = math.cos(place[2]), math.sin(place[2])
        along, across, w = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), rate[2]
        return np.array(
            [
                place + side * (d * along + [0.0, 0.0, 0.5 * np.pi]),
                rate + side * (d_rate * along + d * w * across),
                slower + side * ((d_rate_rate - d * w * w) * along
                                 + (2.0 * d_rate * w + d * slower[2]) * across),
            ]
        )  # fmt: skip


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
        self._next, self._again = 0, 0.0
        self._caging: _Caging | None = None
        self._joints: _Hand | None = None  # motion of the joints, in place of the hands

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
        if self._caging is not None:
            if self._joints is not None and self._caging.begin <= time < self._caging.end:
                self._joints = None
            elif self._joints is None and time >= self._caging.end:
                self._joints = _Hand(q[JOINTS])
            return
        if any(hand.striking for hand in self.hands):
            return
        if abs(rate[2]) > mission.slow:
            self._strike(time, target, rate)
        elif mission.cage is not None and time >= self.hands[0].due:
            self._joints = self._joints or _Hand(q[JOINTS])
            if time >= self._again:
                self._again = time + 0.1
                self._close(mission.cage, time, q, v)

    def _close(self, cage: Cage, time: float, q: np.ndarray, v: np.ndarray) -> None:
        """The joints go to where the hands are beside two faces, as soon as they reach these until
        the target has stopped.
        """
        begin, rate = time + cage.soonest, v[TARGET]
        place = q[TARGET] + rate * cage.soonest
        place[2] = (place[2] + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
        caging = _Caging(cage, begin, place, rate)
        goals = [
            self._reached(q, [caging.command(i, at)[0] for i in range(2)])
            for at in (caging.end, begin)
        ]
        self._scene.place(q, v)
        if np.isfinite(goals).all():
            self._caging, self._joints = caging, _Hand(q[JOINTS])
            self._joints.move(time, to=goals[1], at=begin, speed=np.zeros(6))

    def _reached(self, q: np.ndarray, goals: list[np.ndarray]) -> np.ndarray:
        """Joints (6) with the wrists at goals, where they take the base; NaN: out of reach."""
        base, joints = q[:3], q[JOINTS]
        for _ in range(15):
            joints = np.concatenate([arm_joints(i, base, goals[i]) for i in range(2)])
            if not np.isfinite(joints).all():
                break
            base = 0.5 * (base + self._scene.base_after(q, joints))
        return joints

    def _command(self, hand: int, time: float) -> np.ndarray:
        caging = self._caging
        if caging is None or time < caging.begin:
            return self.hands[hand].command(time)
        return caging.command(hand, time)

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
        stiff = self._caging is not None and time > self._caging.stiff
        k_p, k_d = _STIFF if stiff else (_K_P, _K_D)
        for i, body in enumerate(scene.hands):
            own = slice(3 * i, 3 * i + 3)
            rows[own][:2] = scene.jacobian(body, np.zeros(3))[:, :9]
            rows[3 * i + 2, [2, 3 + 3 * i, 4 + 3 * i, 5 + 3 * i]] = 1.0
            x, speed, acceleration = self._command(i, time)
            wanted[own] = acceleration + k_d * (speed - rows[own] @ v[:9])
            wanted[own] += k_p * (x - self._state(i, q))
            wanted[own][:2] -= scene.bias(body, np.zeros(3))
        if self._joints is not None:
            x, speed, acceleration = self._joints.command(time)
            rows = np.eye(9)[JOINTS]
            wanted = acceleration + k_d * (speed - v[JOINTS]) + k_p * (x - q[JOINTS])
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
