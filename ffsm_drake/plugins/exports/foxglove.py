"""A recorded run as MCAP, for Foxglove and other readers, and a run live in Foxglove: messages of
Foxglove's schemas, in their binary form (protocol buffers), at the run's own time in ns.

Topics: ``/tf`` (every body in the world), ``/scene`` (the visual shapes of the bodies, once),
``/joint_states``, ``/events`` (phases, modes, how it ended), and each series of the record under
its name, as JSON. The scenario and the URDFs are attached.
"""

import dataclasses
import importlib
import json
import logging
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Mesh, Rgba, Role, Shape, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Diagram, DiagramBuilder
from websockets.http11 import Request

from ffsm_drake.common.door import HOST, BadFrame, Door, random_loopback
from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.loop.operator import make_operated_disturbance
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario, scenario_to_yaml
from ffsm_drake.spacecraft.plant import (
    add_combined_plant,
    base_body,
    find_body,
    model_files,
    split_of,
)
from ffsm_drake.systems.controllers import complete_gains
from ffsm_drake.systems.setup import BlockSetup

WORLD = "world"
_PLAIN = Rgba(0.7, 0.7, 0.72, 1.0)  # colour of shapes without one
_MEDIA = {".obj": "model/obj", ".gltf": "model/gltf+json", ".glb": "model/gltf-binary"}
_MEDIA |= {".stl": "model/stl"}
_ANY: dict[str, str] = {"type": "object"}  # schema of the JSON topics
# Live: between two pictures, between two copies of the shapes, and the lag that is caught up, s.
_PICTURE, _SHAPES, _LARGEST_DEBT = 0.04, 1.0, 0.1
_AS_IT_IS = np.array([1.0, 0.0, 0.0, 0.0])  # scale of the disturbance, and no push


def write(record: RunRecord, path: Path) -> None:
    """Write a run to a file.

    Raises: FfsmError, if the library is missing; OSError, if the file cannot be written.
    """
    foxglove = _library()
    context = foxglove.Context()
    messages = _Messages(foxglove, context, record)
    try:
        with foxglove.open_mcap(str(path), context=context, allow_overwrite=True) as writer:
            for name, text in _attached(record):
                media = "application/xml" if name.endswith("urdf") else "application/yaml"
                writer.attach(log_time=0, create_time=0, name=name, media_type=media, data=text)
            messages.write()
    except RuntimeError as error:  # the library's for a full disk, too
        raise OSError(f"not to its end, as on a full disk: {one_line(error)}") from error


def watch(
    scenario: Scenario,
    *,
    port: int = 8765,
    tell: Callable[[str], None] = print,
    wait: Callable[[float], None] = time.sleep,
) -> RunRecord:
    """Run a scenario at real time, or its ``target_realtime_rate``, and serve ``/tf`` and
    ``/scene`` to Foxglove on 127.0.0.1 meanwhile.

    The library's server obeys every page, so it is behind a proxy (``common.door``): clients must
    know the printed address, with a secret at its end.

    Args: the scenario; the port, 0: any; a function called with the line for the terminal; a
    function called with seconds, to let wall time pass.

    Returns: the record of ``simulate``.

    Raises: FfsmError, if the library is missing, or the port is taken.
    """
    foxglove = _library()
    context = foxglove.Context()
    server, address = _started(foxglove, context)
    door = None
    try:
        door = FoxgloveDoor(f"ws://{address}:{server.port}", port)
        tell(f"In Foxglove open the connection {door.url}")
        live = _Live(_Scene(foxglove, context, scenario), scenario, wait)
        alone = scenario.replace(simulator_config={"target_realtime_rate": 0.0})  # ``live`` paces
        record = simulate(alone, blocks={"forces.disturbance": live.make})
        return dataclasses.replace(record, scenario=complete_gains(scenario))
    finally:
        if door is not None:
            door.close()
        server.stop()


def _started(foxglove: Any, context: Any) -> tuple[Any, str]:
    """A server and its address: any of this machine, 127.0.0.1 where the system has no other."""
    # Disconnected pages are not reported in the terminal.
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)
    for host in (random_loopback(), HOST):
        with suppress(OSError, RuntimeError):
            server = foxglove.start_server(name="ffsm_drake", host=host, port=0, context=context)
            return server, host
    raise FfsmError("Foxglove cannot start: no port of this machine is free for it")


class FoxgloveDoor(Door):
    """The proxy in front of a Foxglove server; ``url`` is the proxy's address."""

    largest = 2**20
    subprotocol = "foxglove.sdk.v1"

    def __init__(self, socket: str, port: int) -> None:
        """Raises FfsmError if the port is not free."""
        self._path = f"/{secrets.token_urlsafe(16)}"
        super().__init__(socket, [port], called="Foxglove")
        self.url = f"ws://{HOST}:{self.port}{self._path}"

    def refusal(self, request: Request, host: str) -> str | None:
        """Check the secret path, not the origin: Foxglove's own pages have many origins."""
        known = secrets.compare_digest(request.path.encode(), self._path.encode())
        return None if known else "the address is not the one that was told\n"

    def passed(self, frame: str | bytes) -> str | None:
        """Pass a page's subscriptions; drop all other requests."""
        try:
            message = json.loads(frame) if isinstance(frame, str) else None
        except (ValueError, RecursionError) as error:
            raise BadFrame from error
        if not isinstance(message, dict):
            raise BadFrame
        return frame if message.get("op") in ("subscribe", "unsubscribe") else None  # type: ignore[return-value]


def _library() -> Any:
    try:
        importlib.import_module("foxglove.channels")
        return importlib.import_module("foxglove")
    except ImportError as error:
        raise FfsmError("this needs foxglove-sdk: pip install 'ffsm-drake[mcap]'") from error


def _attached(record: RunRecord) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the scenario and of its model's files."""
    yield "scenario.yaml", scenario_to_yaml(record.scenario).encode()
    for file in model_files(record.scenario.model):
        if file.suffix in (".urdf", ".yaml"):
            yield file.name, file.read_bytes()


def free_target(record: RunRecord) -> Mapping[int, RigidTransform]:
    """Poses of the target before the grasp, by sample; none without a capture."""
    data = record.dataset
    if "phase" not in data.coords:
        return {}
    before = np.flatnonzero(data["phase"].values.astype(str) != "stop")
    turns, places = (data[f"target_{each}"].values for each in ("quaternion", "position"))
    return {
        int(k): RigidTransform(Quaternion(turns[k] / np.linalg.norm(turns[k])), places[k])
        for k in before
    }


def poses_of(record: RunRecord, bodies: "Bodies") -> Iterator[dict[str, RigidTransform]]:
    """X_WB of each body at the samples of a run, up to the first that is not finite."""
    data, free = record.dataset, free_target(record)
    hidden = data["hidden_position"].values if "hidden_position" in data else None
    for k, q in enumerate(data["position"].values):
        if not np.isfinite(q).all():
            break
        yield dict(bodies.poses(q, hidden=None if hidden is None else hidden[k], free=free.get(k)))


def joints_of(record: RunRecord) -> tuple[list[str], np.ndarray]:
    """Names of the joints, and their positions, rates and efforts (n, 3, joints)."""
    angles = record.positions().joint_position
    of = {"coordinate": [str(name) for name in angles.coordinate.values]}
    rows = [angles, *(record.dataset[name].sel(of) for name in ("velocity", "applied_force"))]
    return of["coordinate"], np.stack([each.values for each in rows], axis=1)


class Bodies:
    """The bodies of a scenario's model, by scoped name."""

    def __init__(self, scenario: Scenario) -> None:
        builder = self._builder = DiagramBuilder()  # owns what the inspector looks at
        plant = self._plant = add_combined_plant(builder, scenario.model, flexible=True)
        self._inspector = builder.GetSubsystemByName("scene_graph").model_inspector()
        self._context, self._split = plant.CreateDefaultContext(), split_of(plant)
        bodies = [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]
        self._bodies = {body.scoped_name().get_full(): body for body in bodies}
        target = find_body(plant, scenario.payload.body, key="payload.body")
        self._target = target.scoped_name().get_full()
        self.base = str(base_body(plant).scoped_name().get_full())

    def pictures(self) -> Iterator[tuple[str, list[tuple[Shape, RigidTransform, Rgba]]]]:
        """Shapes of each body, with their poses in its frame and their colours."""
        look = self._inspector
        for name, body in self._bodies.items():
            frame = self._plant.GetBodyFrameIdOrThrow(body.index())
            yield (
                name,
                [
                    (
                        look.GetShape(each),
                        look.GetPoseInFrame(each),
                        look.GetIllustrationProperties(each).GetPropertyOrDefault(
                            "phong", "diffuse", _PLAIN
                        ),
                    )
                    for each in look.GetGeometries(frame, Role.kIllustration)
                ],
            )

    def poses(
        self,
        q: np.ndarray,
        *,
        hidden: np.ndarray | None = None,
        free: RigidTransform | None = None,
    ) -> Iterator[tuple[str, RigidTransform]]:
        """X_WB of each body in configuration q (nq), with the coordinates of flexible parts; the
        target, if it is ``free``, at that pose.
        """
        self._plant.SetPositions(self._context, self._split.whole_positions(q, hidden))
        for name, body in self._bodies.items():
            is_free = name == self._target and free is not None
            yield name, free if is_free else self._plant.EvalBodyPoseInWorld(self._context, body)


class _Scene:
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


class _Live:
    """A live run: sets its pace and shows its bodies."""

    def __init__(self, scene: _Scene, scenario: Scenario, wait: Callable[[float], None]) -> None:
        self._scene, self._wait = scene, wait
        self._period = scenario.sample_time / (
            scenario.simulator_config.target_realtime_rate or 1.0
        )
        self._due, self._shown, self._seen = 0.0, -np.inf, -np.inf

    def make(self, setup: BlockSetup) -> Diagram:
        """The scenario's disturbance, polled at each sample."""
        return make_operated_disturbance(setup, initial=_AS_IT_IS, poll=self._poll)

    def _poll(self, now: float, q: np.ndarray) -> np.ndarray:
        wall = time.perf_counter()
        self._due = max(min(self._due, wall) + self._period, wall - _LARGEST_DEBT)
        if (left := self._due - wall) > 0.0:
            self._wait(left)
        if wall - self._shown >= _PICTURE:
            self._shown, stamp = wall, round(now * 1e9)
            if wall - self._seen >= _SHAPES:  # for pages that connected meanwhile
                self._seen = wall
                self._scene.write_shapes(stamp)
            self._scene.write_poses(stamp, dict(self._scene.bodies.poses(q)))
        return _AS_IT_IS


class _Messages:
    """The messages of a run."""

    def __init__(self, foxglove: Any, context: Any, record: RunRecord) -> None:
        self._scene = _Scene(foxglove, context, record.scenario)
        self._m, self._channels, self._context = foxglove.messages, foxglove.channels, context
        self._json: Callable[..., Any] = foxglove.Channel
        self._record, self._data = record, record.dataset
        self._stamps = [round(float(time) * 1e9) for time in self._data.time.values]

    def write(self) -> None:
        """Write them, topic after topic."""
        self._scene.write_shapes(self._stamps[0])
        self._write_poses()
        self._write_joints()
        self._write_events()
        for name, series in self._data.data_vars.items():
            self._write_series(str(name), series)

    def _topic(self, kind: str, topic: str) -> Any:
        return getattr(self._channels, f"{kind}Channel")(topic, context=self._context)

    def _write_poses(self) -> None:
        poses = poses_of(self._record, self._scene.bodies)
        for stamp, each in zip(self._stamps, poses, strict=False):
            self._scene.write_poses(stamp, each)

    def _write_joints(self) -> None:
        topic, (names, rows) = self._topic("JointStates", "/joint_states"), joints_of(self._record)
        for stamp, row in zip(self._stamps, rows, strict=True):
            joints = [
                self._m.JointState(name=name, position=q, velocity=v, effort=f)
                for name, q, v, f in zip(names, *row, strict=True)
            ]
            topic.log(
                self._m.JointStates(timestamp=self._scene.stamp(stamp), joints=joints),
                log_time=stamp,
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
                timestamp=self._scene.stamp(stamp),
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
