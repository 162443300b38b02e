"""A first motion for an arm given as a URDF, its disturbance, and starting gains."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.multibody.tree import JacobianWrtVariable

from ffsm_drake.control_design.rounding import rounded, rounded_by_group
from ffsm_drake.scenario import Model, Posture, Reference
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import (
    BASE_POSITION,
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    Coordinates,
)
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_body, find_body, find_frame
from ffsm_drake.spacecraft.urdf import Joint, Servicer
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.registry import SHIPPED, find_factory

_SAMPLES = 800
_TURN = 2.2  # rad, the largest joint angle in the search
# Peaks along the motion, as large as in the paper's mission.
_PEAK_RATE = {"rad": 0.1, "m": 0.05}  # rad/s, m/s
_SHARE_OF_VELOCITY, _SHARE_OF_EFFORT = 0.2, 0.3  # of the URDF's limits
_PEAK_BASE_ACCELERATION = 0.01  # force on the base per mass of the spacecraft, m/s^2
_CLEAR = 0.05  # m, that parts keep to each other in a posture
_LOOKED_AT, _STARTS, _WAY = 300, 10, 6  # candidates, initial postures kept, instants of a way
_SHORTEST, _LONGEST = 20.0, 120.0  # s
# The disturbance accelerates each coordinate, the others free to react, by this much: rad/s^2 or
# m/s^2.
_DISTURBANCE = {"base_rotation": 1.5e-3, "base_position": 8e-4, "rad": 5e-3, "m": 1e-3}
_FREQUENCIES = (0.3, 0.1, 0.5, 1.0, 0.6, 0.8)  # rad/s, taken in turn
# Natural frequencies to start from, rad/s.
OMEGA = {"base_rotation": 15.0, "base_position": 10.0, "joints": 20.0}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Motion:
    """The planned motion and the forces that it needs."""

    initial: Posture
    target: Posture
    duration: float  # s
    peak_force: Mapping[str, float]  # by coordinate, of perfect tracking, N m or N
    mass_matrices: np.ndarray  # (m, nv, nv) along the motion
    # initial postures in order of preference, each with the axis (3, world) into the target
    starts: tuple[tuple[Posture, np.ndarray], ...] = ()
    distance: float = math.inf  # m, least of the spacecraft's parts; below 0 they overlap


def plan_motion(
    true: PlantModel, servicer: Servicer, *, body: str, model: Model | None = None
) -> Motion:
    """Choose postures and duration for a spacecraft that holds the payload with the scoped name
    ``body``.

    The target posture is the best of many drawn from the inner part of the joint limits: far from
    singular, the target clear of the spacecraft. The initial posture is the best of many near it.
    With the ``model`` both, and the way between them, are clear of contact, or as clear as found.
    Seeded, so that the same URDF gets the same motion.
    """
    search = _Search(true, servicer, body, None if model is None else Clearance(model))
    rng = np.random.default_rng(0)
    low, high = search.inner_limits.T
    drawn = [search.rest, *(low + (high - low) * x for x in rng.random((_SAMPLES, low.size)))]
    target = search.clear(search.ranked(drawn), count=1)[0]
    step = np.where(search.units == "m", 0.35 * (high - low), np.minimum(0.6, 0.5 * (high - low)))
    draws = rng.uniform(0.35, 1.0, (_SAMPLES // 2, low.size)) * rng.choice(
        [-1.0, 1.0], (_SAMPLES // 2, low.size)
    )
    near = [
        start for start in target + draws * step if np.all(start >= low) and np.all(start <= high)
    ]
    starts = search.clear(
        search.ranked([*near, 0.5 * (target + search.rest)]), to=target, count=_STARTS
    )
    scale = min(max(servicer.tip.reach, 0.2), 10.0)
    first = [
        Posture(
            base_position=[float(f"{0.05 * scale * x:.1g}") for x in (1, 2, -1)],
            base_rpy=[0.1, 0.08, -0.1],
            joints=search.by_name(initial),
        )
        for initial in starts
    ]
    end = Posture(base_position=[0.0] * 3, base_rpy=[0.0] * 3, joints=search.by_name(target))
    turn = RollPitchYaw(first[0].base_rpy).ToRotationMatrix().matrix()
    return dataclasses.replace(
        _timed(true, servicer, first[0], end),
        starts=tuple((p, turn @ search.pointing(q)) for p, q in zip(first, starts, strict=True)),
        distance=search.distance(starts[0], target),
    )


class _Search:
    """Rates postures of the joints that move the tip; the other joints are at rest."""

    def __init__(
        self, true: PlantModel, servicer: Servicer, body: str, clearance: Clearance | None
    ) -> None:
        self.clearance = clearance
        self.true, self.reach = true, max(servicer.tip.reach, 0.05)
        self.plant = true.plant
        by_name = {joint.name: joint for joint in servicer.joints}
        self.joints = [by_name[name] for name in true.coordinates.joints]  # in the plant's order
        moving = [k for k, joint in enumerate(self.joints) if joint.name in servicer.tip.joints]
        self.moving = np.array(moving)
        self.units = np.array([self.joints[k].unit for k in moving])
        self.inner_limits = np.array([_inner_limits(self.joints[k]) for k in moving])
        self.rest = self.inner_limits.mean(axis=1)
        self.tip = find_frame(self.plant, f"servicer::{servicer.tip.frame}", key="tip")
        self.payload = find_body(self.plant, body, key="payload.body")
        # The target must keep away from the base and from every link that does not hold it.
        base = base_body(self.plant)
        holding = {base.index(), self.payload.index(), self.tip.body().index()}
        links = map(self.plant.get_body, self.plant.GetBodyIndices(base.model_instance()))
        self.links = [link for link in links if link.index() not in holding]
        self.base = base
        fixed = [
            self.plant.GetBodyByName(name, base.model_instance()).index()
            for name in servicer.base_links
        ]
        inertia = self.plant.CalcSpatialInertia(true.context, base.body_frame(), fixed)
        self.base_centre = inertia.get_com()
        # Of the solid cube with these moments: between half its side and half its diagonal.
        moments = np.diagonal(
            inertia.Shift(self.base_centre).CalcRotationalInertia().CopyToFullMatrix3()
        )
        self.base_radius = 0.6 * math.sqrt(6.0 * moments.mean() / servicer.base_mass)

    def all_joints(self, values: np.ndarray) -> np.ndarray:
        """Positions (n) of all joints for those (m) that move the tip; the others stay at zero or
        the next limit.
        """
        joints = np.array([min(max(0.0, joint.lower), joint.upper) for joint in self.joints])
        joints[self.moving] = values
        return joints

    def by_name(self, values: np.ndarray) -> dict[str, float]:
        return {
            joint.name: float(value)
            for joint, value in zip(self.joints, self.all_joints(values), strict=True)
        }

    def ranked(self, candidates: list[np.ndarray]) -> list[np.ndarray]:
        """Candidates (m), the best first, rounded to three digits after the point."""
        order = np.argsort([-self.rate(values) for values in candidates], kind="stable")
        return [np.round(candidates[int(i)], 3) for i in order]

    def clear(
        self, ranked: list[np.ndarray], *, count: int, to: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """The first ``count`` that are clear of contact, also on the way ``to`` another; where none
        is, the one with the largest distance.
        """
        distances = {}
        for k, values in enumerate(ranked[:_LOOKED_AT]):
            distances[k] = self.distance(values, values if to is None else to)
            if sum(each >= _CLEAR for each in distances.values()) == count:
                break
        free = [ranked[k] for k, each in distances.items() if each >= _CLEAR]
        return free or [ranked[max(distances, key=lambda k: distances[k])]]

    def distance(self, start: np.ndarray, end: np.ndarray) -> float:
        """The least distance of parts on the straight way between two postures (m), m; as far as
        ``_CLEAR`` of interest.
        """
        if self.clearance is None or not self.clearance.pairs:
            return math.inf
        least = math.inf
        for share in np.linspace(0.0, 1.0, 1 if np.array_equal(start, end) else _WAY):
            q = self.configuration(start + share * (end - start))
            least = min(least, self.clearance.nearest(q, below=_CLEAR).distance)
        return least

    def pointing(self, values: np.ndarray) -> np.ndarray:
        """The axis (3, base's axes) along which the tip points into the target."""
        self.plant.SetPositions(self.true.context, self.configuration(values))
        axis: np.ndarray = self.tip.CalcPoseInWorld(self.true.context).rotation().matrix()[:, 2]
        return axis

    def configuration(self, values: np.ndarray) -> np.ndarray:
        """Positions (nq), the base at the origin."""
        q = self.plant.GetPositions(self.true.context)
        q[:NUM_BASE_POSITIONS] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        q[NUM_BASE_POSITIONS:] = self.all_joints(values)
        return q

    def rate(self, values: np.ndarray) -> float:
        """Higher is better: dexterity times clearance, each between 0 and 1."""
        plant, context = self.plant, self.true.context
        plant.SetPositions(context, self.configuration(values))
        jacobian = plant.CalcJacobianSpatialVelocity(
            context,
            JacobianWrtVariable.kV,
            self.tip,
            np.zeros(3),
            self.base.body_frame(),
            self.base.body_frame(),
        )[:, NUM_BASE_VELOCITIES + self.moving]
        jacobian[3:] /= self.reach
        # a metre of stroke counts as a radian at full reach
        jacobian[:, self.units == "m"] *= self.reach
        singular = np.linalg.svd(jacobian, compute_uv=False)
        dexterity = singular[-1] / singular[0] if singular[0] > 0.0 else 0.0
        centre = plant.EvalBodyPoseInWorld(context, self.payload).translation()
        tip = self.tip.CalcPoseInWorld(context).translation()
        # the target's half width, as far as the model says
        outward = float(np.linalg.norm(centre - tip))
        nearest = min(
            [
                np.linalg.norm(centre - link.EvalPoseInWorld(context).translation())
                for link in self.links
            ]
            # the base stands at the origin
            + [np.linalg.norm(centre - self.base_centre) - self.base_radius]
        )
        clearance = min(max((float(nearest) - outward) / (0.5 * self.reach), 0.01), 1.0)
        return float((dexterity + 1e-6) * clearance)


def _inner_limits(joint: Joint) -> tuple[float, float]:
    """The part of a joint's range that the motion may use."""
    lower, upper = joint.lower, joint.upper
    if joint.unit == "m" and not joint.is_limited:
        lower = min(max(lower, 0.0), upper)
        upper = min(upper, lower + 0.5)
    if upper - lower < math.inf:
        margin = 0.1 * (upper - lower)
        lower, upper = lower + margin, upper - margin
    if joint.unit == "m" or lower > _TURN or upper < -_TURN:
        return lower, upper
    return max(lower, -_TURN), min(upper, _TURN)


def _timed(true: PlantModel, servicer: Servicer, initial: Posture, target: Posture) -> Motion:
    """The motion with a duration whose peak rates and forces are moderate."""
    coordinates = true.coordinates
    unit_time = PolynomialMotion(
        coordinates=coordinates,
        start=initial,
        target=target,
        blend=Blend(Reference(), 1.0),
        base_rotation="eigenaxis",
        sample_time=1.0 / 40.0,
    )
    matrices, forces, rates = [], [], []
    for time in np.linspace(0.0, 1.0, 41):
        q, v, a = unit_time.evaluate(time)
        matrices.append(true.calc_mass_matrix(q))
        forces.append(matrices[-1] @ a + true.calc_bias(q, v))
        rates.append(v)
    peak_force, peak_rate = (
        dict(zip(coordinates.names, np.abs(values).max(axis=0).tolist(), strict=True))
        for values in (forces, rates)
    )
    # Rates fall with the duration, forces with its square.
    needed = [_SHORTEST]
    for joint in servicer.joints:
        needed.append(
            peak_rate[joint.name] / min(_PEAK_RATE[joint.unit], _SHARE_OF_VELOCITY * joint.velocity)
        )
        needed.append(math.sqrt(peak_force[joint.name] / (_SHARE_OF_EFFORT * joint.effort)))
    mass = true.plant.CalcTotalMass(true.context)
    needed += [
        math.sqrt(peak_force[name] / (_PEAK_BASE_ACCELERATION * mass)) for name in BASE_POSITION
    ]
    duration = min(5.0 * math.ceil(max(needed) / 5.0 - 1e-9), _LONGEST)
    return Motion(
        initial=initial,
        target=target,
        duration=duration,
        peak_force={name: force / duration**2 for name, force in peak_force.items()},
        mass_matrices=np.array(matrices),
    )


def scaled_disturbance(motion: Motion, coordinates: Coordinates) -> dict[str, dict[str, float]]:
    """A harmonic per coordinate, sized by how easily the coordinate is moved in the target
    posture.
    """
    inertia = effective_inertia(motion.mass_matrices[-1])
    kinds = [
        unit if group == "joints" else group
        for unit, group in zip(coordinates.units, coordinates.group_of, strict=True)
    ]
    return {
        name: {
            "amplitude": rounded(_DISTURBANCE[kinds[k]] * inertia[k]),
            "frequency": _FREQUENCIES[k % len(_FREQUENCIES)],
            "phase": 1.571 if k % 3 == 1 else 0.0,
        }
        for k, name in enumerate(coordinates.names)
    }


def starting_gains(
    omega: Mapping[str, float], *, coordinates: Coordinates, mass_matrices: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Starting gains of shipped controllers: controller -> gain -> value by coordinate.

    Args:
      omega: natural frequency of each group, rad/s.
      mass_matrices: those of the true spacecraft along the motion (m, nv, nv).
    """
    frequencies, gains = coordinates.vector(omega, key="omega"), dict[str, dict[str, Any]]()
    for name in SHIPPED["controller"]:
        law: Any = find_factory("controller", name)
        proposed = law.starting_gains(frequencies, mass_matrices)
        if proposed:
            gains[name] = {
                key: value if np.ndim(value) == 0 else rounded_by_group(value, coordinates)
                for key, value in proposed.items()
            }
    return gains


def effective_inertia(mass_matrix: np.ndarray) -> np.ndarray:
    """Force per acceleration of each coordinate (nv), the others free to react, kg m^2 or kg."""
    return 1.0 / np.diagonal(np.linalg.inv(mass_matrix))
