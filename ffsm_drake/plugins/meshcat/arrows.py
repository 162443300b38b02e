"""Forces and torques on the base as arrows that follow a run."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba, SceneGraphInspector
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.numbers import magnification, number
from ffsm_drake.plugins.meshcat.solids import draw_over
from ffsm_drake.plugins.meshcat.stage import base_bounding_box

if TYPE_CHECKING:
    import xarray as xr

_FOLDER = "forces"
_MIN_SCALE = 1e-6  # smallest scale: the renderer inverts it, so not zero


@dataclasses.dataclass(frozen=True)
class ArrowKind:
    """The vector shown by an arrow."""

    label: str
    variable: str  # names in the record's dataset
    coordinates: str  # base_position: the force, base_rotation: the torque about the base's origin
    unit: str
    color_name: str
    color: tuple[float, float, float]

    @property
    def is_torque(self) -> bool:
        return self.coordinates == "base_rotation"

    @property
    def path(self) -> str:
        """Path in Meshcat's tree."""
        return f"{_FOLDER}/{self.label}"


ARROW_KINDS = (
    ArrowKind("applied force", "applied_force", "base_position", "N", "green", (0.25, 0.90, 0.35)),
    ArrowKind(
        "applied torque", "applied_force", "base_rotation", "N m", "blue", (0.25, 0.60, 1.00)
    ),
    ArrowKind(
        "disturbance force", "disturbance_force", "base_position", "N", "red", (1.00, 0.25, 0.20)
    ),
    ArrowKind(
        "disturbance torque",
        "disturbance_force",
        "base_rotation",
        "N m",
        "pink",
        (1.00, 0.45, 0.85),
    ),
)


class Arrow:
    """An arrow in Meshcat that is drawn over everything else."""

    def __init__(
        self,
        meshcat: Meshcat,
        path: str,
        *,
        size: float,
        color: tuple[float, float, float],
        heads: int = 1,
    ) -> None:
        """Add an arrow, yet without direction; ``size``, m, is the length of a long one."""
        self._meshcat = meshcat
        self._path = path
        self._head = 0.12 * size
        width = 0.012 * size
        # Along +z, with a shaft of 1 m that is scaled; Drake's cone has its point at the origin and
        # opens along +z.
        parts = {f"{path}/shaft/cylinder": (Cylinder(width, 1.0), RigidTransform([0.0, 0.0, 0.5]))}
        for i in range(heads):
            pose = RigidTransform(
                RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, -0.6 * self._head * i]
            )
            parts[f"{path}/tip/head/cone_{i}"] = (
                MeshcatCone(self._head, 3.0 * width, 3.0 * width),
                pose,
            )
        for part, (shape, pose) in parts.items():
            meshcat.SetObject(part, shape, Rgba(*color, 1.0))
            meshcat.SetTransform(part, pose)
            draw_over(meshcat, part)

    def show(
        self,
        tail: np.ndarray,
        direction: np.ndarray,
        length: float,
        *,
        time_in_recording: float | None = None,
    ) -> None:
        """Show it from its tail (3; world) along a unit vector (3); a length (m) of 0 hides it."""
        # A short arrow has a small head, or it would look too long.
        head = max(_MIN_SCALE, min(1.0, length / (2.0 * self._head)))
        shaft = max(_MIN_SCALE, length - 0.5 * head * self._head)
        pose = RigidTransform(RotationMatrix.MakeFromOneVector(direction, 2), tail)
        self._meshcat.SetTransform(self._path, pose, time_in_recording)
        self._meshcat.SetProperty(
            f"{self._path}/shaft", "scale", [head, head, shaft], time_in_recording
        )
        self._meshcat.SetTransform(
            f"{self._path}/tip", RigidTransform([0.0, 0.0, length]), time_in_recording
        )
        self._meshcat.SetProperty(f"{self._path}/tip/head", "scale", [head] * 3, time_in_recording)


class ForceArrows:
    """Arrows for the base's control force and torque and its disturbance (``ARROW_KINDS``).

    The arrow of the run's largest control force is as long as the base's longest edge, and so is
    that of its largest control torque. A disturbance has the scale of its control times a round
    ``magnification``, because it may be far smaller. A torque's arrow has two heads and points
    along its axis. Each arrow starts where its line through the base's origin leaves the base (a
    torque's a little above), and is drawn over everything else.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        dataset: "xr.Dataset",
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
    ) -> None:
        self._position = dataset["position"].values
        self._vectors = [
            _finite_rows(
                dataset[kind.variable]
                .sel(coordinate=[f"{kind.coordinates}_{axis}" for axis in "xyz"])
                .values
            )
            for kind in ARROW_KINDS
        ]
        # the largest of any axis, as tables have it; the longest arrow is of the largest vector
        self.peaks = [float(np.abs(vectors).max()) for vectors in self._vectors]
        longest = [float(np.linalg.norm(vectors, axis=1).max()) for vectors in self._vectors]
        self._box_pose, self._box_half_width = base_bounding_box(plant, inspector)
        self._longest = 2.0 * float(self._box_half_width.max())
        self.magnifications: list[int] = []
        self._scales: list[float] = []  # m per N or N m
        # control force and torque; the disturbance's arrows share their scales
        control = longest[:2] * 2
        for norm, largest in zip(longest, control, strict=True):
            reference = largest or norm or 1.0
            self.magnifications.append(magnification(norm / reference))
            self._scales.append(self._longest / reference * self.magnifications[-1])
        self._arrows = [
            Arrow(
                meshcat,
                kind.path,
                size=self._longest,
                color=kind.color,
                heads=2 if kind.is_torque else 1,
            )
            for kind in ARROW_KINDS
        ]

    def show(self, sample: int, *, time_in_recording: float | None = None) -> None:
        """Show the arrows of one sample of the record."""
        q = self._position[sample]
        rotation = RotationMatrix(Quaternion(q[:4] / np.linalg.norm(q[:4])))
        for kind, arrow, vectors, scale in zip(
            ARROW_KINDS, self._arrows, self._vectors, self._scales, strict=True
        ):
            vector = vectors[sample]
            norm = float(np.linalg.norm(vector))
            direction = vector / norm if norm > 0.0 else np.array([0.0, 0.0, 1.0])
            tail = q[4:7] + self._distance_to_surface(rotation, direction) * direction
            if kind.is_torque:  # a free vector, drawn next to a force of the same direction
                tail[2] += 0.08 * self._longest
            arrow.show(tail, direction, scale * norm, time_in_recording=time_in_recording)

    def _distance_to_surface(self, rotation: RotationMatrix, direction: np.ndarray) -> float:
        """Distance from the base's origin to its bounding box along a world direction, m."""
        in_box = self._box_pose.rotation().inverse() @ (rotation.inverse() @ direction)
        origin = self._box_pose.inverse().translation()
        with np.errstate(divide="ignore", invalid="ignore"):
            exits = (np.copysign(self._box_half_width, in_box) - origin) / in_box
        return max(0.0, float(np.min(exits, where=in_box != 0.0, initial=np.inf)))


def legend(arrows: ForceArrows) -> list[str]:
    """One line per arrow: colour, vector, magnification, and the run's peak along an axis."""
    times = [f" x {factor}" if factor > 1 else "" for factor in arrows.magnifications]
    return [
        f"{kind.color_name}: {kind.label}{factor}, peak {number(peak)} {kind.unit}"
        for kind, factor, peak in zip(ARROW_KINDS, times, arrows.peaks, strict=True)
    ]


def _finite_rows(vectors: np.ndarray) -> np.ndarray:
    """Return a copy with zeros for rows of non-finite length, such as a diverged run's last
    force.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(np.isfinite(np.linalg.norm(vectors, axis=1, keepdims=True)), vectors, 0.0)
