"""Plumes of thrusters: their force on the bodies that they hit.

A plume's momentum leaves the nozzle into the half space behind the thrust, per solid angle as
cos^n of the angle off its axis (a source flow, docs/actuator_models.md). Rays carry equal parts of
it. Each transfers its whole momentum, along its direction, to the first shape on its path (no
reflection). Bodies shadow one another.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform

from ffsm_drake.common.memo import memoized
from ffsm_drake.scenario import (
    Actuation,
    Model,
    Plume,
    Posture,
    Scenario,
    Thruster,
    Thrusters,
    thrusters_of,
)
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.distance import Solids
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import (
    base_body,
    configuration,
    coordinates_of,
    find_body,
    model_files,
    parsed_plant,
)

_LEAST = 1e-4  # m; rays do not meet a shape that is nearer to their nozzle or around it
_FARTHEST = 1e10  # m
_FIRST_GROUP = np.array([1, 0, 0, 0, 0, 0], np.uint8)
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))  # rad


def rays_of(axis: np.ndarray, settings: Plume) -> tuple[np.ndarray, float]:
    """Unit directions (n, 3) of a plume's rays about a unit axis, and the momentum that each
    carries per impulse of the thruster: along the axis they sum to 1.
    """
    count, exponent = settings.rays, settings.exponent
    share = (np.arange(count) + 0.5) / count
    cosine, turn = (1.0 - share) ** (1.0 / (exponent + 1.0)), _GOLDEN * np.arange(count)
    sine = np.sqrt(1.0 - cosine**2)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    across = np.outer(sine * np.cos(turn), first) + np.outer(
        sine * np.sin(turn), np.cross(axis, first)
    )
    return np.outer(cosine, axis) + across, 1.0 / float(cosine.sum())


class RaySolids(Solids):
    """Convex solids that rays meet. Boxes are in double precision; depths of capsules in them are
    inexact.
    """

    boxes_by_corners = False

    def first_met(
        self, point: np.ndarray, rays: np.ndarray, passed: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of the first solid that each ray meets (n), -1 without one, and its
        distance (n), m.

        Args:
          point: where the rays begin (3), in the world.
          rays: unit directions (n, 3).
          passed: numbers of solids that no ray meets, such as those around the point.
        """
        import mujoco  # slow

        numbers, distances = np.zeros(len(rays), np.int32), np.zeros(len(rays))
        self._model.geom_group[:] = 0
        self._model.geom_group[passed] = 1
        mujoco.mj_multiRay(
            self._model, self._data, point, rays.ravel(), _FIRST_GROUP, True, -1, numbers,
            distances, None, len(rays), _FARTHEST,
        )  # fmt: skip
        return numbers, distances


class PlumeField:
    """The force of plumes on a spacecraft's bodies, as a function of its configuration."""

    def __init__(
        self,
        settings: Plume,
        units: Sequence[Thruster],
        model: PlantModel,
        of: Model,
        *,
        without: str | None = None,
    ) -> None:
        """Args:
        settings: the plumes.
        units: the thrusters.
        model: a plant without flexible coordinates for the field's own use.
        of: its model.
        without: a body (scoped name) that is not yet present.
        """
        self._model, self._base = model, base_body(model.plant)
        placed = [each for each in Clearance(of).placed() if each[0] != without]
        self._bodies = [find_body(model.plant, name, key="model") for name, _, _ in placed]
        shapes = [(k, shape, X_BG) for k, (_, shape, X_BG) in enumerate(placed)]
        nozzles = [
            (len(shapes), Sphere(0.0), RigidTransform(np.array(unit.position))) for unit in units
        ]
        self._solids = RaySolids([*shapes, *nozzles])
        self._at = np.array([unit.position for unit in units], dtype=float)
        axes = -np.array([unit.direction for unit in units], dtype=float)
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        made = [rays_of(axis, settings) for axis in axes]
        self._rays = np.array([rays for rays, _ in made])  # (n, rays, 3) in the base's axes
        self._parts = np.array([part for _, part in made])

    def calc(self, q: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Generalized force (nv) of plumes of thrusters with forces (n), N, in a configuration q
        (nq), and what all bodies get from each thruster (n, 3), world axes, N.
        """
        plant, context = self._model.plant, self._model.context
        plant.SetPositions(context, q)
        total, each = np.zeros(plant.num_velocities()), np.zeros((len(force), 3))
        poses = [body.EvalPoseInWorld(context) for body in (*self._bodies, self._base)]
        self._solids.place(np.array([pose.GetAsMatrix34() for pose in poses]))
        wrenches = np.zeros((len(self._bodies), 6))  # of each shape on its body, about its origin
        R = poses[-1].rotation().matrix()
        for thruster in np.flatnonzero(force > 0.0).tolist():
            p, u = poses[-1].multiply(self._at[thruster]), self._rays[thruster] @ R.T
            push = force[thruster] * self._parts[thruster] * u
            first, length = self._met(thruster, p, u)
            each[thruster] = push[first >= 0].sum(axis=0)
            for index in np.unique(first[first >= 0]):
                hit = first == index
                arm = p + length[hit, None] * u[hit] - poses[index].translation()
                wrenches[index] += np.hstack([np.cross(arm, push[hit]), push[hit]]).sum(axis=0)
        for index in np.flatnonzero(wrenches.any(axis=1)):
            jacobian = self._model.calc_jacobian(q, self._bodies[index].body_frame())
            total += jacobian.T @ wrenches[index]
        return total, each

    def _met(self, thruster: int, p: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of the first shape on each ray (n, 3) of a thruster at a point (3), -1
        without one, and the distance (n), m.
        """
        count = len(self._bodies)
        pairs = np.array([(count + thruster, shape) for shape in range(count)]).reshape(-1, 2)
        near = [shape for shape, _, _ in self._solids.within(pairs, _LEAST)]
        return self._solids.first_met(p, u, [*near, *range(count, count + len(self._at))])


def returned_shares(scenario: Scenario) -> dict[str, float]:
    """For each thruster of a scenario with plumes, the largest share of its thrust returned by its
    plume, in ``initial_posture`` and ``target_posture``.
    """
    settings = scenario.actuation.thrusters
    assert settings is not None
    postures = {key: getattr(scenario, key) for key in ("initial_posture", "target_posture")}
    return _largest_shares(scenario.model, settings, postures)


@memoized(maxsize=16, files=model_files)
def _largest_shares(
    model: Model, settings: Thrusters, postures: Mapping[str, Posture]
) -> dict[str, float]:
    """``returned_shares``, in postures by their keys."""
    assert settings.plume is not None
    plant, units = parsed_plant(model), thrusters_of(settings)
    coordinates, context = coordinates_of(plant), plant.CreateDefaultContext()
    known = PlantModel(plant=plant, context=context, coordinates=coordinates)
    field = PlumeField(settings.plume, [*units.values()], known, model)
    shares = []
    for key, posture in postures.items():
        q = configuration(coordinates, posture, key=key)
        back = np.linalg.norm(field.calc(q, np.ones(len(units)))[1], axis=1)
        shares.append(back)
    return dict(zip(units, np.max(shares, axis=0).tolist(), strict=True))


def allocated(scenario: Scenario) -> Actuation:
    """Return the actuators of a scenario that its allocation uses.

    Thrusters whose plumes return more than ``plume.ban`` of their thrust are left out.
    """
    actuation = scenario.actuation
    thrusters = actuation.thrusters
    if thrusters is None or thrusters.plume is None or thrusters.plume.ban is None:
        return actuation
    banned = {
        name: "stuck_off"
        for name, share in returned_shares(scenario).items()
        if share > thrusters.plume.ban
    }
    thrusters = dataclasses.replace(thrusters, failures={**banned, **thrusters.failures})
    return dataclasses.replace(actuation, thrusters=thrusters)
