"""A recorded run as MCAP, for Foxglove and other readers: messages of Foxglove's schemas, in their
binary form (protocol buffers), at the run's own time in ns.

Topics: ``/tf`` (every body in the world), ``/scene`` (the visual shapes of the bodies, once),
``/joint_states``, ``/events`` (phases, modes, how it ended), and each series of the record under
its name, as JSON. The scenario and the URDFs are attached.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import one_line
from ffsm_drake.plugins.exports.foxglove_scene import Scene, foxglove_library
from ffsm_drake.plugins.exports.motion import joints_of, poses_of
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import scenario_to_yaml
from ffsm_drake.spacecraft.plant import model_files

_ANY: dict[str, str] = {"type": "object"}  # schema of the JSON topics


def write(record: RunRecord, path: Path) -> None:
    """Write a run to a file.

    Raises: FfsmError, if the library is missing; OSError, if the file cannot be written.
    """
    foxglove = foxglove_library()
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


def _attached(record: RunRecord) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the scenario and of its model's files."""
    yield "scenario.yaml", scenario_to_yaml(record.scenario).encode()
    for file in model_files(record.scenario.model):
        if file.suffix in (".urdf", ".yaml"):
            yield file.name, file.read_bytes()


class _Messages:
    """The messages of a run."""

    def __init__(self, foxglove: Any, context: Any, record: RunRecord) -> None:
        self._scene = Scene(foxglove, context, record.scenario)
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
