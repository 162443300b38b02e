"""Numbers of a new scenario: postures, durations, disturbance, wheels, panels and gains.

A motion uses at most a part of the force of the actuators. The bandwidth is limited by sensor
noise, which may use the rest. If the mission does not settle, the bandwidth is reduced.
"""

import copy
import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.multibody.tree import RigidBody

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import short
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.plugins.design.remarks import plan_clearance
from ffsm_drake.plugins.design.rounding import readable, rounded, rounded_by_group
from ffsm_drake.plugins.design.stability import Margins, stability
from ffsm_drake.plugins.design.stability.mission import linear_verdict
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.base_box import BaseBox
from ffsm_drake.plugins.new.hands import Hands
from ffsm_drake.plugins.new.postures import STARTS, Arm
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.plugins.new.urdf.target import Target
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import EMPTY, Grip, Scenario, scenario_from_dict
from ffsm_drake.scenario.actuation import Thrusters, Wheel, thrusters_of
from ffsm_drake.spacecraft.coordinates import (
    BASE_POSITION,
    BASE_ROTATION,
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
)
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.limits import POSITION, RATE
from ffsm_drake.spacecraft.mission import Mission
from ffsm_drake.spacecraft.plant import configuration, find_frame
from ffsm_drake.systems.limits import actuation_limit
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import SHIPPED, find_factory

BY_AXIS = ("tdc", "asmc", "aismc", "tde_aismc")
# The postures.
_SAMPLES = 400  # candidates of a posture
_HOLD, _LONG_HOLD = 5.0, 20.0  # s, the target posture is held; with real sensors or actuators
_LENGTHS = (0.3, 0.2, 0.5)  # m, of an approach along the grasp axis
# Shares of the joints' limits that a plan may use, and of the durations, of approach and motion,
# with which it is tried: a joint that moves at the grasp turns back later in a longer motion.
_WITHIN = {POSITION: 0.98, RATE: 0.9}
_SHORTER = ((1.0, 1.0), (0.5, 1.0), (0.75, 0.75), (0.5, 0.5), (0.25, 0.5), (0.25, 0.25))
_ROUNDS, _SECONDS = 3, 5.0  # of durations, then postures; durations are multiples of these
# Peaks along the motion.
_RATE, _SHARE_OF_VELOCITY = {"rad": 0.1, "m": 0.05}, 0.2  # rad/s, m/s; of the URDF's limits
_JOINT, _MOTION, _DISTURBED = 0.3, 0.65, 0.3  # shares of what the actuators give
_LEAST_LEFT = 0.05  # share of the force, if the disturbance uses the rest
_LONGEST, _SETTLE, _INSTANTS = 120.0, 1.0, 60  # s; s after a grasp that do not count
# The disturbance accelerates each coordinate, the others free to react, by this much: rad/s^2 or
# m/s^2; its frequencies, rad/s, are taken in turn.
_DISTURBANCE = {"base_rotation": 1.5e-3, "base_position": 8e-4, "rad": 5e-3, "m": 1e-3}
_FREQUENCIES = (0.3, 0.1, 0.5, 1.0, 0.6, 0.8)
# Steps, s, and rates within which friction changes its sign, rad/s or m/s; its time constant near
# rest over a step, at least.
_RESOLVED = 1.3
_STEP_SIZES, _SMOOTHED = (0.01, 0.005, 0.002, 0.001, 0.0005), (5e-3, 2e-2, 5e-2)
_PULSES, _WHEEL = 0.4, (0.05, 5.0)  # wheels' share of the thrusters' torque; a wheel, N m
_SLOW_WHEEL, _ROTOR = 0.4, 0.005  # torque (1/s^2) and rotor per least moment of base
# Natural frequencies to start from, rad/s, and what shrinks them.
_OMEGA = {"base_rotation": 15.0, "base_position": 10.0, "joints": 20.0}
_SHRINK, _TRIES = 0.7, 8
_NOISES = 3.0  # standard deviations of the noise, times I omega^2, that the actuators give
_K_S, _SWITCHING = 0.1, 2e-4  # K_s as a share of omega; bound of G
_COVER = 0.1  # m, of a part that covers a thruster
# Panels: of the base's inertia; m; Hz.
_PANEL_SHARE, _PANEL_LENGTH, _PANEL_FREQUENCY = 0.3, (0.3, 3.0), 0.25
_FROM_FILES = ("payload", "limit", "coulomb_friction", "viscous_friction")  # keys
_PANEL_SIDES = ([0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0])


class Draft:
    """The plain data of a scenario, filled step by step; ``remarks`` list what cannot be met."""

    def __init__(
        self, data: dict[str, Any], asked: Asked, servicer: Servicer, source: str, *, seed: int = 0
    ) -> None:
        """See the attributes. Another seed draws other postures."""
        self.data, self.asked, self.servicer, self.source = data, asked, servicer, source
        self._seed, self._starts = seed, list[np.ndarray]()
        self.remarks, self.margins = list[str](), dict[str, Margins]()
        self.is_held = True  # by all hands
        self.touching = ""  # the parts that no posture and approach found keeps clear
        self._outside = ""  # the joints that leave their limits in every motion tried
        if servicer.normal is not None:
            initial = self.data["initial_posture"]
            initial["base_position"][servicer.normal] = 0.0
            for k in {0, 1, 2} - {servicer.normal}:
                initial["base_rpy"][k] = 0.0
        self._enough = 0.0  # N m, of a wheel
        self.peaks, self.weak = np.zeros(0), ""  # (nv) forces of motion and disturbance
        craft = Craft(self.scenario)
        self.true, self.coordinates = craft.true(), craft.coordinates
        self._limits = [each for each in craft.limits if each.quantity in _WITHIN]

    @property
    def scenario(self) -> Scenario:
        """The present scenario."""
        return self._scenario()

    @property
    def mission(self) -> Mission:
        """The present scenario with its spacecraft."""
        return Mission(self.scenario)

    def _scenario(self, **changes: Any) -> Scenario:
        """Return the present scenario with other sections, without empty ones."""
        before = self.data["capture"]["approach"]["duration"] if self.asked.has_approach else 0.0
        hold = _HOLD if self.asked.is_paper else _LONG_HOLD
        self.data["duration"] = before + self.data["reference"]["duration"] + hold
        sections = {key: each for key, each in {**self.data, **changes}.items() if each != {}}
        return scenario_from_dict(_written(sections), source=self.source)

    @property
    def written(self) -> dict[str, Any]:
        """The plain data for the file. ``scenario`` is made from the same numbers."""
        return _written(self.data)

    @step("searching for postures without contact")
    def place(self, target: Target) -> None:
        """Choose thrusters, panels, postures, the approach, and the frame of a second hand."""
        self._thrusters()
        self._panels()
        if self.servicer.second is not None:
            self.is_held = Hands(self, target).place()
            return
        self._starts = self._postures()
        if self.asked.has_approach:
            self._approach(_SHORTER[:1])

    @step("choosing wheels and durations")
    def pace(self) -> None:
        """Choose disturbance, durations and wheels, after ``place``."""
        self._disturb()
        moves = bool(self._starts) and self.asked.capture is not None
        for _ in range(_ROUNDS):
            if not (self._pace() or self._used(self.mission)[0] > 1.0) or not moves:
                break
            self._approach(_SHORTER)
        else:
            self._pace()
        used, told = self._used(self.mission)
        self._outside = told if used > 1.0 else ""

    @property
    def faults(self) -> list[str]:
        """Faults of the plan that other postures may avoid."""
        return [*filter(None, (self.touching, self._outside))]

    @step("choosing gains")
    def fill(self) -> None:
        """Choose integrator steps for friction, then gains, after ``pace``."""
        self._resolve_friction()
        self.remarks += [*self.faults, *filter(None, (self.weak,))]
        self._tune()

    def _postures(self) -> list[np.ndarray]:
        """Choose target posture, initial posture, and a duration with moderate rates.

        Returns: initial configurations (nq) without contact, the best first.
        """
        arm, rng = Arm(self), np.random.default_rng(self._seed)
        low, high = arm.low[arm.moving], arm.high[arm.moving]
        rest = 0.5 * (low + high)
        target = arm.best([rest, *(low + (high - low) * rng.random((_SAMPLES, low.size)))])[0]
        step = np.minimum(0.6, 0.5 * (high - low))
        draws = rng.uniform(0.35, 1.0, (_SAMPLES, low.size)) * rng.choice([-1.0, 1.0], low.size)
        near = [q for q in target + draws * step if ((q >= low) & (q <= high)).all()]
        starts = arm.best([*near, 0.5 * (target + rest)], to=target, count=STARTS)
        end, initial = self.data["target_posture"], self.data["initial_posture"]
        end["joints"], initial["joints"] = (
            arm.by_name(arm.filled(each)) for each in (target, starts[0])
        )
        if (least := arm.nearest(starts[0], target)).distance < 0.0:
            self.touching = f"no posture free of contact was found: {least} in the best"
        self.data["reference"]["duration"] = max(
            self.data["reference"]["duration"],
            *(
                1.875 * abs(end["joints"][name] - angle) / self.rate_of(name)  # quintic's peak
                for name, angle in initial["joints"].items()
            ),
        )
        return [arm.whole(arm.filled(start)) for start in starts]

    def rate_of(self, name: str) -> float:
        """Return the moderate rate of a joint, rad/s or m/s."""
        joint = next(each for each in self.servicer.joints if each.name == name)
        return min(_RATE[joint.unit], _SHARE_OF_VELOCITY * joint.velocity)

    def _used(self, mission: Mission) -> tuple[float, str]:
        """Return the largest share of the joint limits, minus their margins, that the planned
        motion uses, and the joint that uses it, as text.
        """
        motion, limits = make_motion(mission), self._limits
        q, v, _ = motion.evaluate(np.linspace(0.0, motion.end, 4 * _INSTANTS))
        used = np.array([
            limit.used({POSITION: q[:, 1:], RATE: v}[limit.quantity]).max(axis=0)
            / _WITHIN[limit.quantity] for limit in limits
        ])  # fmt: skip
        which, joint = np.unravel_index(np.argmax(used), used.shape)
        limit = limits[which]
        what = f"{100.0 * used.max() * _WITHIN[limit.quantity]:.3g} % of {limit.source}"
        return float(used.max()), (
            f"no motion within the joint limits was found: {limit.names[joint]} uses {what}; try a "
            "slower tumble, or a lighter target"
        )

    def _approach(self, durations: Iterable[tuple[float, float]]) -> None:
        """Choose the initial posture, the approach along the grasp axis, and the durations.

        Joints stay within their limits, and parts stay clear of the tumbling target. If no choice
        meets both, the best one is used.

        Args:
          durations: durations of approach and motion to try, as shares of the present ones.
        """
        enough, told = Scenario().clearance, ""
        best, chosen, before = (-math.inf, -math.inf), dict[str, Any](), self._choice
        ways = [*itertools.product(self._starts, _LENGTHS if self.asked.has_approach else (0.0,))]
        for shares in durations:
            if best >= (-1.0, enough):
                break
            self.data |= copy.deepcopy(before)
            start, length = ways[0]
            self._begin(start, length, shares)
            if min(shares) < 1.0 and self._overloads():  # with any start, by and large
                continue
            for k, (start, length) in enumerate(ways):
                self.data |= copy.deepcopy(before)
                self._begin(start, length, shares)
                with step(f"approach {k + 1} of {len(ways)}"):
                    mission = self.mission
                    used = max(self._used(mission)[0], 1.0)
                    if -used < best[0]:
                        continue
                    near = min(plan_clearance(mission), key=lambda each: each.distance)
                if (-used, near.distance) > best:
                    told = str(near)
                    best, chosen = (-used, near.distance), self._choice
                if best >= (-1.0, 2.0 * enough):
                    return
        self.data |= chosen
        if best[1] < enough:
            self.touching = (
                f"no approach keeps clear of the target: {told}; try a "
                "slower tumble, or a --tip at the end of the hand (now "
                f"{self.data['model']['end_effector']})"
            )

    @property
    def _choice(self) -> dict[str, Any]:
        """A copy of the sections that ``_approach`` chooses."""
        keys = "initial_posture", "reference", "capture"
        return copy.deepcopy({key: self.data[key] for key in keys})

    def _begin(self, start: np.ndarray, length: float, shares: tuple[float, float]) -> None:
        """Set an initial configuration (nq), the length of the approach (m), and the durations as
        shares of the present ones.
        """
        initial, joints = self.data["initial_posture"], start[NUM_BASE_POSITIONS:].tolist()
        initial["joints"] = dict(zip(self.coordinates.joints, joints, strict=True))
        timed = [(self.data["reference"], shares[1])]
        if self.asked.has_approach:
            tip = find_frame(self.true.plant, self.data["model"]["end_effector"], key="tip")
            turn = RollPitchYaw(initial["base_rpy"]).ToRotationMatrix().matrix()
            self.true.plant.SetPositions(self.true.context, start)
            axis = turn @ tip.CalcPoseInWorld(self.true.context).rotation().matrix()[:, 2]
            place = np.array(initial["base_position"]) - length * axis
            approach = self.data["capture"]["approach"]
            approach["posture"] = {**initial, "base_position": list(map(rounded, place.tolist()))}
            timed.append((approach, shares[0]))
        for section, share in timed:
            if share < 1.0:
                whole = round(share * section["duration"] / _SECONDS)
                section["duration"] = _SECONDS * max(whole, 1)

    @property
    def _bus(self) -> tuple[RigidBody, float, np.ndarray]:
        """The heaviest body of the base, its mass (kg) and its moments (3, kg m^2)."""
        links = map(self.true.plant.GetBodyByName, self.servicer.base_links)
        body = max(links, key=lambda link: float(link.default_mass()))
        inertia = body.default_spatial_inertia()
        moments = inertia.Shift(inertia.get_com()).CalcRotationalInertia().get_moments()
        return body, float(inertia.get_mass()), moments

    def _box(self, body: str) -> BaseBox:
        """Return the box of the base in the frame of one of its bodies."""
        found = self.servicer
        return BaseBox.of(self.scenario.model, found.base_links, body, side=found.half_side)

    def _thrusters(self) -> None:
        """Place thrusters on the box of the base; remark on thrusters that a part of it covers."""
        if self.asked.thrusters is None:
            return
        box = self._box(self.servicer.base)
        found = self.asked.thruster_settings(self.servicer.base_mass, box)
        self.data["actuation"]["thrusters"] = found
        covered = dict[str, list[str]]()
        for name, unit in thrusters_of(self.scenario.actuation.thrusters or Thrusters()).items():
            out = unit.position + _COVER * np.sign(unit.position - box.centre) * [0, 0, 1]
            for body in box.overlapped(out[None]):
                covered.setdefault(body, []).append(name)
        self.remarks += [
            f"thrusters {', '.join(names)} are inside a part of '{body}': move them "
            "(actuation.thrusters.units), or the part"
            for body, names in covered.items()
        ]

    def _panels(self) -> None:
        """Place panels on the sides of the base. Raises ScenarioError: the panels are too heavy."""
        if self.asked.panels is None:
            return
        count, mass = self.asked.panels
        body, own, moments = self._bus
        if count * mass >= 0.5 * own:
            raise ScenarioError(
                "--panels",
                f"{count} of {mass:g} kg must be less than half of the base's {short(own, 4)} kg, "
                "which contain them",
            )
        box, sides = self._box(body.name()), np.array(_PANEL_SIDES[:count])
        axes = np.flatnonzero(np.abs(sides).any(axis=0))
        flat = float((moments.sum() - 2.0 * moments[axes]).min())  # small: close to a flat body
        middle = math.sqrt(_PANEL_SHARE * min(float(moments.min()), flat) / (count * mass))
        out = middle - float((np.abs(sides) @ box.half).max())
        length = rounded(min(max(2.0 * out, _PANEL_LENGTH[0]), _PANEL_LENGTH[1]))
        self.data["model"]["flexible"] = {
            f"panel_{k + 1}": {
                "body": f"servicer::{body.name()}",
                "position": [rounded(x) for x in (box.centre + box.half * side).tolist()],
                "direction": side.tolist(),
                **({"axis": [0, 1, 0]} if side[0] else {}),
                "mass": mass,
                "length": length,
                "width": min(1.0, length),
                "frequency": _PANEL_FREQUENCY,
            }
            for k, side in enumerate(sides)
        }
        for name, panel in self.data["model"]["flexible"].items():
            along, across = (np.arange(0.02, 1.0, 0.04) * panel["length"] + 0.05,
                             np.arange(-0.48, 0.5, 0.04) * panel["width"])  # fmt: skip
            direction = np.array(panel["direction"])
            axis = np.array(panel.get("axis", [1, 0, 0]))
            points = np.array(panel["position"]) + np.array(
                [d * direction + w * axis for d in along for w in across]
            )
            self.remarks += [
                f"{name} lies on a part of '{part}' that the model has: leave out --panels, or "
                f"move it (model.flexible.{name}), or remove the part"
                for part in box.overlapped(points)
            ]

    @property
    def _limit(self) -> np.ndarray:
        """Largest forces (nv) of the actuators that are available in every direction, N m or N."""
        return actuation_limit(self.scenario, self.coordinates).upper

    @property
    def _sizes_wheels(self) -> bool:
        return self.asked.wheels is not None and self.asked.wheels.torque is None

    @property
    def _disturbance(self) -> np.ndarray:
        """Largest force (nv) of the disturbance, N m or N."""
        harmonics = self.data["disturbance"]["harmonics"].items()
        largest = {name: each["amplitude"] for name, each in harmonics}
        return self.coordinates.vector(largest, key="disturbance", default=0.0)

    def _planned(self, **changes: Any) -> PlannedDynamics:
        """Return the motion after the grasp, without disturbance."""
        return PlannedDynamics(*from_grasp(Mission(self._scenario(disturbance={}, **changes))))

    def _disturb(self) -> None:
        """Choose a harmonic disturbance for each driven coordinate.

        Its amplitude is proportional to the effective inertia of the coordinate in the target
        posture, and leaves most of the actuator force to the motion.
        """
        planned, harmonics = self._planned(capture=None), dict[str, dict[str, float]]()
        inertia = _effective_inertia(planned.mass_matrices(planned.motion.end)[0])
        limit = np.full(inertia.size, np.inf) if self._sizes_wheels else self._limit
        coordinates, out_of_plane = self.coordinates, set[str]()
        if (normal := self.servicer.normal) is not None:
            out_of_plane = {*BASE_ROTATION} - {BASE_ROTATION[normal]} | {BASE_POSITION[normal]}
        for k, (name, group) in enumerate(
            zip(coordinates.names, coordinates.group_of, strict=True)
        ):
            if self.asked.drives(group) and name not in out_of_plane:
                size = _DISTURBANCE[coordinates.units[k] if group == "joints" else group]
                harmonics[name] = {
                    "amplitude": rounded(min(size * inertia[k], _DISTURBED * limit[k])),
                    "frequency": _FREQUENCIES[k % len(_FREQUENCIES)],
                    "phase": 1.571 if k % 3 == 1 else 0.0,
                }
        self.data["disturbance"]["harmonics"] = harmonics

    def _pace(self) -> bool:
        """Size the wheels, and lengthen motion and approach until the actuators can follow them.

        Returns: whether a duration was increased.
        """
        reference, longer = self.data["reference"], math.inf
        before = reference["duration"]
        while longer > reference["duration"]:
            if longer < math.inf:
                reference["duration"] = longer
            with step(f"trying a motion of {reference['duration']:g} s"):
                self.peaks = self._motion_peaks() + self._disturbance
            self._size_wheels()
            longer = self._longer(reference["duration"], self.peaks - self._disturbance)
        is_longer = bool(reference["duration"] > before)
        if not self.asked.has_approach:
            return is_longer
        approach = self.data["capture"]["approach"]
        before = approach["duration"]
        approach["duration"] = self._longer(before, self._approach_peaks())
        return is_longer or bool(approach["duration"] > before)

    def _overloads(self) -> bool:
        """Whether motion or approach are too short for the actuators."""
        timed = [(self.data["reference"]["duration"], self._motion_peaks())]
        if self.asked.has_approach:
            timed.append((self.data["capture"]["approach"]["duration"], self._approach_peaks()))
        return any(self._longer(*each) > each[0] for each in timed)

    def _motion_peaks(self) -> np.ndarray:
        """Return the largest forces (nv) of the motion, N m or N, except just after a grasp."""
        planned = self._planned()
        first = 0.0 if self.asked.capture is None else min(_SETTLE, 0.1 * planned.motion.end)
        return _peaks(planned, first)

    def _approach_peaks(self) -> np.ndarray:
        """Return the largest forces (nv) of the approach, N m or N, as if the target were held."""
        whole = PlannedDynamics(Mission(self._scenario(disturbance={})))
        return _peaks(whole, 0.0, self.data["capture"]["approach"]["duration"])

    def _longer(self, duration: float, peaks: np.ndarray) -> float:
        """Return the duration, a multiple of 5 s, with which a motion leaves the actuators their
        reserve.

        Args:
          duration: s, the present duration.
          peaks: largest forces (nv) with the present duration, N m or N.
        """
        limit, base = self._limit, np.arange(peaks.size) < NUM_BASE_VELOCITIES
        share = np.where(base, _MOTION, _JOINT)
        left = np.maximum(share * limit - self._disturbance, _LEAST_LEFT * limit)
        driven = np.array([self.asked.drives(group) for group in self.coordinates.group_of])
        ratio = math.sqrt(float((driven * peaks / left).max()))
        whole = math.ceil(max(ratio, 1.0) * duration / _SECONDS - 1e-9)
        return min(_SECONDS * whole, _LONGEST)

    def motion_forces(self) -> np.ndarray:
        """Return the largest forces (nv) of perfect tracking of the planned motion, N m or N."""
        return _peaks(self._planned())

    def _at_postures(self, grip: Grip) -> Iterator[np.ndarray]:
        """Yield the mass matrices (nv, nv) in the postures, with the target or without."""
        model = self.mission.craft.true(grip)
        for key, each in self.scenario.postures.items():
            yield model.calc_mass_matrix(configuration(model.coordinates, each, key=key))

    def _resolve_friction(self) -> None:
        """Choose integrator steps that resolve friction near rest.

        Large steps are preferred, then a slow rate within which friction changes its sign.
        """
        drives, config = self.data["actuation"].get("drives"), self.data["simulator_config"]
        if drives is None:
            return
        joints, free = slice(NUM_BASE_VELOCITIES, None), list[np.ndarray]()
        for held in {True, self.asked.capture is None}:
            for matrix in self._at_postures(Grip(held)):
                free.append(np.linalg.inv(matrix)[joints, joints])
        for step_size, rate in itertools.product(_STEP_SIZES, _SMOOTHED):
            config["max_step_size"], drives["smoothing_rate"] = step_size, rate
            settings = self.scenario.drives
            assert settings is not None
            made = DriveSet(settings, self.scenario.actuation.limit, self.coordinates)
            if min(made.time_constant(each)[0] for each in free) > _RESOLVED * step_size:
                return
        self.remarks.append(
            "friction is too stiff for steps of any size tried: give "
            "simulator_config.integration_scheme: implicit_euler"
        )

    def _size_wheels(self) -> None:
        """Size the wheels for the peak torque and, with thrusters, for the torque of their pulses.

        Thrusters assist wheels that are too weak or that hold the momentum of a grasp.
        """
        if self.asked.wheels is None:
            return
        asked, actuation, pulses = self.asked.wheels, self.data["actuation"], 0.0
        wheels, torque, moment = actuation["wheels"], asked.torque, float(self._bus[2].min())
        one = dataclasses.replace(asked, torque=None)
        least = self._torque({**actuation, "wheels": {"units": one.units(1.0, 1e-9)}})
        if self.asked.thrusters is not None:
            pulses = _PULSES * self._torque({**actuation, "wheels": None}) / least
        motion = float(np.linalg.norm(self.peaks[:3])) / _MOTION / least
        floor = min(_WHEEL[0], _SLOW_WHEEL * moment)
        needed = rounded(max(min(motion, max(_WHEEL[1], pulses)), pulses, floor))
        self._enough = max(self._enough, needed)  # a lengthened motion needs less
        inertia = rounded(_ROTOR * moment)
        usual = Wheel().inertia
        wheels["units"] = asked.units(needed, None if inertia >= usual else inertia)
        weak = torque is not None and torque < needed
        self.weak = f"wheels of {torque:.3g} N m are too weak for the motion" if weak else ""
        if weak:
            beside = " and the pulses of the thrusters" if pulses else ""
            self.weak += f"{beside}: --wheels {asked.count}x{rounded(1.05 * self._enough):g}Nm"
        if pulses and (weak or self.asked.capture is not None):
            wheels["assist_above"] = 1.0

    def _torque(self, actuation: dict[str, Any]) -> float:
        """Return the torque of the base actuators of a section in every direction, N m."""
        scenario = self._scenario(actuation=actuation)
        return float(actuation_limit(scenario, self.coordinates).upper[0])

    def _tune(self) -> None:
        """Choose natural frequencies and gains.

        The frequencies start at the values of the sensors' scenario, or lower if noise would exceed
        the reserve of the actuators. They are equal within a group, and shrink until the mission
        settles.
        """
        coordinates, source = self.coordinates, self.asked.source
        planned, limit = self._planned(), self._limit
        times = map(planned.motion.part, np.linspace(0.0, 1.0, 9))
        matrices = np.array([planned.mass_matrices(time)[0] for time in times])
        usual: Any = _OMEGA
        if source.estimator.kind != "one_sample":
            stiffness: Any = source.controllers["tdc"]["k_p"]
            usual = {group: math.sqrt(k) for group, k in stiffness.items()}
        omega = coordinates.vector(usual, key="omega")
        noise = coordinates.vector(self.scenario.sensing.position_noise, key="noise", default=0.0)
        left = np.maximum(limit - self.peaks, _LEAST_LEFT * limit)
        with np.errstate(divide="ignore"):
            most = np.sqrt(left / _effective_inertia(matrices).max(axis=0) / noise / _NOISES)
        for part in coordinates.groups.values():
            omega[part] = np.minimum(omega[part], most[part].min(initial=np.inf))
        alone = [] if self.asked.capture is None else list(self._at_postures(EMPTY))
        for k in range(_TRIES):
            with step(f"bandwidth {k + 1} of at most {_TRIES}"):
                self._put_gains(omega, np.array([*matrices, *alone]))
                fast = self._too_fast()
            if not fast:
                return
            omega[:fast] *= _SHRINK
        found = "no bandwidth tried is stable and settles"
        if not self.asked.is_paper and make_rollout(self.scenario).run().ending.is_settled:
            found = "the linear loop is unstable at each bandwidth tried, yet the mission settles"
        self.remarks.append(f"{found}; see 'ffsm stability'")

    def _put_gains(self, omega: np.ndarray, matrices: np.ndarray) -> None:
        """Set the gains of every law of the package.

        With real sensors, laws that are not designed by axis have half the frequencies, because
        they may be stiffer.

        Args:
          omega: natural frequencies (nv), rad/s.
          matrices: mass matrices (m, nv, nv) along the motion.
        """
        found = self.data["controllers"]
        for name in SHIPPED["controller"]:
            law: Any = find_factory("controller", name)
            if self.asked.is_paper:
                gains = law.starting_gains(omega, matrices)
            elif name in BY_AXIS:
                gains = law.gains_for(omega, _K_S * omega)
                if "g_max" in law.__dataclass_fields__:
                    gains |= {"g_initial": _SWITCHING, "g_max": _SWITCHING}
            else:
                gains = law.starting_gains(0.5 * omega, matrices)
            if gains:
                found[name] = {
                    key: value if np.ndim(value) == 0 else rounded_by_group(value, self.coordinates)
                    for key, value in gains.items()
                }

    def _too_fast(self) -> int:
        """Return how many coordinates, from the first one, have too large a bandwidth: none, the
        six of the base, or all.
        """
        if self.asked.is_paper:
            for name in BY_AXIS:
                with step(f"checking the stability of {name}"):
                    self.margins[name] = stability(self._scenario(controller=name), postures=9)
            stable = all(
                each.verdict == "stable for small errors" for each in self.margins.values()
            )
            return 0 if stable else self.peaks.size
        if linear_verdict(self.scenario).is_alarm:
            return self.peaks.size
        return 0 if make_rollout(self.scenario).run().ending.is_settled else NUM_BASE_VELOCITIES


def _written(data: dict[str, Any]) -> dict[str, Any]:
    """Data with few digits, except the numbers from model files."""
    found: dict[str, Any] = readable(data, kept=_FROM_FILES)
    return found


def _effective_inertia(mass_matrix: np.ndarray) -> np.ndarray:
    """Return force divided by acceleration of each coordinate (..., nv), the others free."""
    return 1.0 / np.diagonal(np.linalg.inv(mass_matrix), axis1=-2, axis2=-1)


def _peaks(planned: PlannedDynamics, begin: float = 0.0, end: float | None = None) -> np.ndarray:
    """Return the largest forces (nv) of perfect tracking between two times, s."""
    times = np.linspace(begin, planned.motion.end if end is None else end, _INSTANTS)
    return np.abs(planned.perfect_tracking(times)[1]).max(axis=0)
