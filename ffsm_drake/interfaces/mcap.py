"""A recorded run as MCAP, for Foxglove and other readers: messages of Foxglove's schemas, in their
binary form (protocol buffers), at the run's own time in ns.

Topics: ``/tf`` (every body in the world), ``/scene`` (the visual shapes of the bodies, once),
``/joint_states``, ``/events`` (phases, modes, how it ended), and each series of the record under
its name, as JSON. The scenario and the URDFs are attached.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Mesh, Rgba, Role, SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import scenario_to_yaml
from ffsm_drake.spacecraft.plant import add_combined_plant, find_body, model_files, split_of

WORLD = "world"
_PLAIN = Rgba(0.7, 0.7, 0.72, 1.0)  # of shapes without a colour
_MEDIA = {".obj": "model/obj", ".gltf": "model/gltf+json", ".glb": "model/gltf-binary"}
_MEDIA |= {".stl": "model/stl"}
_ANY: dict[str, str] = {"type": "object"}  # schema of the JSON topics


def write(record: RunRecord, path: Path) -> None:
    """Write a run to a file.

    Raises: FfsmError, if the library is missing.
    """
    try:
        foxglove: Any = importlib.import_module("foxglove")
        importlib.import_module("foxglove.channels")
    except ImportError as error:
        raise FfsmError("MCAP needs foxglove-sdk: pip install 'ffsm-drake[mcap]'") from error
    context = foxglove.Context()
    with foxglove.open_mcap(str(path), context=context, allow_overwrite=True) as writer:
        for name, text in _attached(record):
            media = "application/xml" if name.endswith("urdf") else "application/yaml"
            writer.attach(log_time=0, create_time=0, name=name, media_type=media, data=text)
        _Messages(foxglove, context, record).write()


def _attached(record: RunRecord) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the scenario and of its model's files."""
    yield "scenario.yaml", scenario_to_yaml(record.scenario).encode()
    for file in model_files(record.scenario.model):
        if file.suffix in (".urdf", ".yaml"):
            yield file.name, file.read_bytes()


class _Messages:
    """The messages of a run."""

    def __init__(self, foxglove: Any, context: Any, record: RunRecord) -> None:
        self._m, self._channels, self._context = foxglove.messages, foxglove.channels, context
        self._json: Callable[..., Any] = foxglove.Channel
        self._record, self._data = record, record.dataset
        self._stamps = [round(float(time) * 1e9) for time in self._data.time.values]

    def write(self) -> None:
        """Write them, topic after topic."""
        builder = DiagramBuilder()
        plant = add_combined_plant(builder, self._record.scenario.model, flexible=True)
        scene = builder.GetSubsystemByName("scene_graph")
        bodies = [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]
        self._write_scene(plant, scene, bodies)
        self._write_transforms(plant, bodies)
        self._write_joints()
        self._write_events()
        for name, series in self._data.data_vars.items():
            self._write_series(str(name), series)

    def _topic(self, kind: str, topic: str) -> Any:
        return getattr(self._channels, f"{kind}Channel")(topic, context=self._context)

    def _stamp(self, nanoseconds: int) -> Any:
        return self._m.Timestamp(*divmod(nanoseconds, 10**9))

    def _write_scene(
        self, plant: MultibodyPlant, scene: SceneGraph, bodies: list[RigidBody]
    ) -> None:
        inspector, entities = scene.model_inspector(), []
        for body in bodies:
            shapes: dict[str, list[Any]] = {}
            frame = plant.GetBodyFrameIdOrThrow(body.index())
            for geometry in inspector.GetGeometries(frame, Role.kIllustration):
                found = self._primitive(
                    inspector.GetShape(geometry),
                    inspector.GetPoseInFrame(geometry),
                    inspector.GetIllustrationProperties(geometry).GetPropertyOrDefault(
                        "phong", "diffuse", _PLAIN
                    ),
                )
                if found is not None:
                    shapes.setdefault(found[0], []).append(found[1])
            if shapes:
                name = body.scoped_name().get_full()
                entity = self._m.SceneEntity(
                    timestamp=self._stamp(self._stamps[0]),
                    frame_id=name,
                    id=name,
                    frame_locked=True,
                    **shapes,
                )
                entities.append(entity)
        update = self._m.SceneUpdate(entities=entities)
        self._topic("SceneUpdate", "/scene").log(update, log_time=self._stamps[0])

    def _primitive(self, shape: Any, X: RigidTransform, rgba: Rgba) -> tuple[str, Any] | None:
        """The kind and the primitive of a shape; None for what has no such form."""
        m = self._m
        color = m.Color(r=rgba.r(), g=rgba.g(), b=rgba.b(), a=rgba.a())
        common = {"pose": self._pose(X), "color": color}

        def vector(x: float, y: float, z: float) -> Any:
            return m.Vector3(x=x, y=y, z=z)

        if isinstance(shape, Box):
            return "cubes", m.CubePrimitive(size=vector(*shape.size()), **common)
        if isinstance(shape, Cylinder | Capsule):  # a capsule without its caps
            wide = 2.0 * shape.radius()
            size = vector(wide, wide, shape.length())
            return "cylinders", m.CylinderPrimitive(
                size=size, bottom_scale=1.0, top_scale=1.0, **common
            )
        if isinstance(shape, Sphere):
            return "spheres", m.SpherePrimitive(size=vector(*3 * (2.0 * shape.radius(),)), **common)
        if isinstance(shape, Ellipsoid):
            size = vector(2.0 * shape.a(), 2.0 * shape.b(), 2.0 * shape.c())
            return "spheres", m.SpherePrimitive(size=size, **common)
        if isinstance(shape, Mesh) and (file := Path(shape.source().path())).suffix in _MEDIA:
            scale = np.broadcast_to(shape.scale3(), 3)
            return "models", m.ModelPrimitive(
                scale=vector(*scale),
                media_type=_MEDIA[file.suffix],
                data=file.read_bytes(),
                override_color=file.suffix in (".obj", ".stl"),
                **common,
            )
        return None

    def _pose(self, X: RigidTransform) -> Any:
        return self._m.Pose(position=self._vector(X), orientation=self._quaternion(X))

    def _vector(self, X: RigidTransform) -> Any:
        x, y, z = X.translation()
        return self._m.Vector3(x=x, y=y, z=z)

    def _quaternion(self, X: RigidTransform) -> Any:
        w, x, y, z = X.rotation().ToQuaternion().wxyz()
        return self._m.Quaternion(w=w, x=x, y=y, z=z)

    def _write_transforms(self, plant: MultibodyPlant, bodies: list[RigidBody]) -> None:
        topic, context = self._topic("FrameTransforms", "/tf"), plant.CreateDefaultContext()
        split, data = split_of(plant), self._data
        hidden = data["hidden_position"].values if "hidden_position" in data else None
        target = find_body(plant, self._record.scenario.payload.body, key="payload.body")
        free = self._free_target()
        for k, (stamp, q) in enumerate(zip(self._stamps, data["position"].values, strict=True)):
            if not np.isfinite(q).all():
                break
            whole = split.whole_positions(q, None if hidden is None else hidden[k])
            plant.SetPositions(context, whole)
            transforms = []
            for body in bodies:
                X = plant.EvalBodyPoseInWorld(context, body)
                if body is target and k in free:
                    X = free[k]
                transform = self._m.FrameTransform(
                    timestamp=self._stamp(stamp),
                    parent_frame_id=WORLD,
                    child_frame_id=body.scoped_name().get_full(),
                    translation=self._vector(X),
                    rotation=self._quaternion(X),
                )
                transforms.append(transform)
            topic.log(self._m.FrameTransforms(transforms=transforms), log_time=stamp)

    def _free_target(self) -> Mapping[int, RigidTransform]:
        """Poses of the target before the grasp, by sample."""
        if "phase" not in self._data.coords:
            return {}
        before = np.flatnonzero(self._data["phase"].values.astype(str) != "stop")
        turns, places = (self._data[f"target_{each}"] for each in ("quaternion", "position"))
        return {
            int(k): RigidTransform(
                Quaternion(turns.values[k] / np.linalg.norm(turns.values[k])), places.values[k]
            )
            for k in before
        }

    def _write_joints(self) -> None:
        topic, record = self._topic("JointStates", "/joint_states"), self._record
        angles = record.positions().joint_position
        names = [str(name) for name in angles.coordinate.values]
        of = {"coordinate": names}
        speeds, forces = self._data.velocity.sel(of), self._data.applied_force.sel(of)
        series = (angles.values, speeds.values, forces.values)
        for stamp, *rows in zip(self._stamps, *series, strict=True):
            joints = [
                self._m.JointState(name=name, position=q, velocity=v, effort=f)
                for name, q, v, f in zip(names, *rows, strict=True)
            ]
            topic.log(
                self._m.JointStates(timestamp=self._stamp(stamp), joints=joints), log_time=stamp
            )

    def _write_events(self) -> None:
        topic = self._topic("Log", "/events")
        events = [(self._stamps[0], f"{self._record.scenario.controller} begins")]
        if "phase" in self._data.coords:
            phases = self._data["phase"].values.astype(str)
            changes = np.flatnonzero(phases[1:] != phases[:-1]) + 1
            events += [(self._stamps[k], f"phase {phases[k]}") for k in changes]
        events.append((self._stamps[-1], self._record.ending.sentence))
        for stamp, text in sorted(events, key=lambda event: event[0]):
            message = self._m.Log(
                timestamp=self._stamp(stamp),
                level=self._m.LogLevel.Info,
                message=text,
                name="ffsm_drake",
            )
            topic.log(message, log_time=stamp)

    def _write_series(self, name: str, series: Any) -> None:
        values = np.asarray(series.values)
        if series.dims[0] != "time" or values.ndim > 2 or values.dtype.kind not in "biuf":
            return
        metadata = {key: str(series.attrs.get(key, "")) for key in ("units", "long_name")}
        topic = self._json(f"/{name}", schema=_ANY, context=self._context, metadata=metadata)
        parts = [str(part) for part in series[series.dims[1]].values] if values.ndim == 2 else []
        finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
        for stamp, row, is_number in zip(self._stamps, values.tolist(), finite, strict=True):
            if is_number:  # JSON has no others
                message = dict(zip(parts, row, strict=True)) if parts else {"value": row}
                topic.log(message, log_time=stamp)
