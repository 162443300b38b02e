"""What plug-ins add to the spacecraft: flexible parts, true geometry, and formats of models."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context

from ffsm_drake.common.registrations import Registry
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.coordinates import StateSplit


class FlexibleParts(Protocol):
    """The parts of ``model.flexible`` in a plant. All but ``modes_of`` raise ModelError."""

    def add_flexible(self, plant: MultibodyPlant, model: Model) -> None:
        """Add the hidden coordinates before the plant is finalized."""

    def lock_joints(self, plant: MultibodyPlant, model: Model) -> None:
        """Fix, before the plant is finalized, the joints that only the true plant has."""

    def draw_on_plates(self, plant: MultibodyPlant, scene_graph: SceneGraph, model: Model) -> None:
        """Move the shapes of panels to their plates, in a finalized plant without a context."""

    def set_flexible(self, plant: MultibodyPlant, context: Context, model: Model) -> None:
        """Set springs and dampers, and subtract the masses of the parts from their bodies."""

    def take_masses(
        self, plant: MultibodyPlant, context: Context, model: Model, *, body: str
    ) -> None:
        """Subtract the masses of a body's parts from the body (scoped name)."""

    def flexible_bodies(
        self, plant: MultibodyPlant, model: Model
    ) -> Iterable[tuple[RigidBody, bool]]:
        """Return the bodies that ``add_flexible`` added, each with whether it is a plate."""

    def modes_of(self, plant: MultibodyPlant, context: Context, split: StateSplit) -> list[Any]:
        """Return the modes of vibration (``VibrationMode``), the slowest first."""


FLEXIBLE_PARTS = Registry[FlexibleParts]("flexible_parts")


class ModelFormats(Protocol):
    """Models in further formats."""

    def check(
        self, address: str, place: str, files: tuple[Path, ...], packages: Mapping[str, str]
    ) -> None:
        """Raise ModelError for a model that Drake's parser cannot read, or reads differently.

        Args: the address that Drake parses, its place in errors, the files of the model, and the
        folder of each package.
        """

    def as_urdf(self, path: Path) -> str:
        """Return the URDF of a model file, for its dynamics only. Raises ModelError."""


# Displaces the frames of a plant (which a context belongs to) by ``effects.geometry``.
TRUE_GEOMETRY = Registry[Callable[[MultibodyPlant, Context, Scenario], None]]("true_geometry")
MODEL_FORMATS = Registry[ModelFormats]("model_formats")
