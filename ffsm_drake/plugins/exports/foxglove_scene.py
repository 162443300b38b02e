"""The bodies of a spacecraft as messages of Foxglove's schemas."""

import importlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Mesh, Rgba, Sphere
from pydrake.math import RigidTransform

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.exports.motion import WORLD, Bodies
from ffsm_drake.scenario import Scenario

_MEDIA = {".obj": "model/obj", ".gltf": "model/gltf+json", ".glb": "model/gltf-binary"}
_MEDIA |= {".stl": "model/stl"}


def foxglove_library() -> Any:
    try:
        importlib.import_module("foxglove.channels")
        return importlib.import_module("foxglove")
    except ImportError as error:
        raise FfsmError("this needs foxglove-sdk: pip install 'ffsm-drake[mcap]'") from error


class Scene:
    """The bodies of a scenario's model: their shapes, and where they are."""

    def __init__(self, foxglove: Any, context: Any, scenario: Scenario) -> None:
        self.m, channels = foxglove.messages, foxglove.channels
        self._tf = channels.FrameTransformsChannel("/tf", context=context)
        self._shapes = channels.SceneUpdateChannel("/scene", context=context)
        self.bodies = Bodies(scenario)

    def stamp(self, nanoseconds: int) -> Any:
        return self.m.Timestamp(*divmod(nanoseconds, 10**9))

    def write_shapes(self, time: int) -> None:
        """Log the shapes of all bodies at a time, ns."""
        entities = []
        for name, pictures in self.bodies.pictures():
            shapes: dict[str, list[Any]] = {}
            for found in filter(None, (self._primitive(*picture) for picture in pictures)):
                shapes.setdefault(found[0], []).append(found[1])
            if shapes:
                entity = self.m.SceneEntity(
                    timestamp=self.stamp(time), frame_id=name, id=name, frame_locked=True, **shapes
                )
                entities.append(entity)
        self._shapes.log(self.m.SceneUpdate(entities=entities), log_time=time)

    def write_poses(self, time: int, poses: Mapping[str, RigidTransform]) -> None:
        """Log the poses of bodies, by name, at a time, ns."""
        transforms = [
            self.m.FrameTransform(
                timestamp=self.stamp(time),
                parent_frame_id=WORLD,
                child_frame_id=name,
                translation=self._vector(X.translation()),
                rotation=self._quaternion(X),
            )
            for name, X in poses.items()
        ]
        self._tf.log(self.m.FrameTransforms(transforms=transforms), log_time=time)

    def _primitive(self, shape: Any, X: RigidTransform, rgba: Rgba) -> tuple[str, Any] | None:
        """The kind and the primitive of a shape; None for what has no such form."""
        color = self.m.Color(r=rgba.r(), g=rgba.g(), b=rgba.b(), a=rgba.a())
        pose = self.m.Pose(position=self._vector(X.translation()), orientation=self._quaternion(X))
        more: dict[str, Any] = {}
        if isinstance(shape, Box):
            kind, make, size = "cubes", self.m.CubePrimitive, shape.size()
        elif isinstance(shape, Cylinder | Capsule):  # a capsule without its caps
            kind, make = "cylinders", self.m.CylinderPrimitive
            size = 2.0 * shape.radius(), 2.0 * shape.radius(), shape.length()
            more = {"bottom_scale": 1.0, "top_scale": 1.0}
        elif isinstance(shape, Sphere):
            kind, make, size = "spheres", self.m.SpherePrimitive, 3 * [2.0 * shape.radius()]
        elif isinstance(shape, Ellipsoid):
            kind, make = "spheres", self.m.SpherePrimitive
            size = 2.0 * shape.a(), 2.0 * shape.b(), 2.0 * shape.c()
        elif isinstance(shape, Mesh) and (file := Path(shape.source().path())).suffix in _MEDIA:
            return "models", self.m.ModelPrimitive(
                pose=pose,
                color=color,
                scale=self._vector(np.broadcast_to(shape.scale3(), 3)),
                media_type=_MEDIA[file.suffix],
                data=file.read_bytes(),
                override_color=file.suffix in (".obj", ".stl"),
            )
        else:
            return None
        return kind, make(pose=pose, color=color, size=self._vector(size), **more)

    def _vector(self, values: Iterable[float]) -> Any:
        return self.m.Vector3(**dict(zip("xyz", values, strict=True)))

    def _quaternion(self, X: RigidTransform) -> Any:
        return self.m.Quaternion(
            **dict(zip("wxyz", X.rotation().ToQuaternion().wxyz(), strict=True))
        )
