"""Logs in MCAP: standard messages of ROS 2 and Foxglove as named columns.

Definitions of the messages: tf2_msgs/TFMessage, sensor_msgs/JointState, nav_msgs/Odometry and
geometry_msgs/WrenchStamped (https://docs.ros.org/en/rolling/p/common_interfaces);
foxglove.FrameTransforms and foxglove.JointStates (https://docs.foxglove.dev/docs/sdk/schemas).
"""

import dataclasses
import importlib
import json
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.errors import FfsmError, one_line

_MODULES = {  # encoding of messages -> decoder, its package, our extra
    "protobuf": ("mcap_protobuf.decoder", "mcap-protobuf-support", "mcap"),
    "cdr": ("mcap_ros2.decoder", "mcap-ros2-support", "ros2"),
}
_MAX_UNPACKED = 8_000_000_000  # bytes


class _Key(NamedTuple):
    """Source of a series."""

    kind: str  # "pose", "odometry", "joint", "wrench" or "json"
    name: str  # name of the frame, joint or field
    parent: str = ""  # reference frame of a pose or odometry


_Series = dict[_Key, pd.DataFrame]  # values (n, k) by their times, ns
_Rows = Iterable[tuple[_Key, Any, list[float]]]  # with a time stamp
_COLUMNS = {
    "pose": [f"base_{x}" for x in ("position_x", "position_y", "position_z", "quaternion_w",
             "quaternion_x", "quaternion_y", "quaternion_z")],
    "odometry": [f"base_{what}_{x}" for what in ("velocity", "angular_velocity") for x in "xyz"],
    "wrench": [f"base_{what}_{x}" for what in ("force", "torque") for x in "xyz"],
}  # fmt: skip


def read_mcap(path: Path, base: str) -> tuple[dict[str, np.ndarray], str, dict[str, str]]:
    """Read a log. Times are those of the headers; if a header never advances, those of the log.

    Args:
      base: the frame of the base, with or without a prefix that ends in "::" or "/".

    Returns:
      The columns, a note on changes, and the axes that the messages define. Columns have this
      package's names; numbers of JSON topics are called TOPIC.FIELD. A series with other times
      has blank cells.

    Raises:
      FfsmError: a library is missing.
      ValueError: the log cannot be read, or no single frame matches the base.
    """
    series, logged = _read(path)
    frames = {key.name: key for kind in ("odometry", "pose") for key in series if key.kind == kind}
    pose = frames[_called(base, frames)]
    tables = [series[pose].iloc[:, :7].set_axis(_COLUMNS["pose"], axis=1)]
    stated: dict[str, str] = {}
    for key, each in series.items():
        if key[:2] == ("odometry", pose.name):
            tables.append(each.iloc[:, 7:].set_axis(_COLUMNS["odometry"], axis=1))
            stated |= dict.fromkeys(("linear", "angular"), "body axes")  # as Odometry defines
        elif key.kind == "wrench" and key.name in (pose.parent, pose.name):
            tables.append(each.set_axis(_COLUMNS["wrench"], axis=1))
            if key.name == pose.name:
                stated |= dict.fromkeys(("force", "torque"), "body axes")
        elif key.kind == "joint":
            names = [key.name + end for end in ("", "_rate", "_effort")]
            tables.append(each.set_axis(names, axis=1).dropna(axis=1, how="all"))
        elif key.kind == "json":
            tables.append(each.set_axis([key.name], axis=1))
    whole = pd.concat([each[~each.index.duplicated()] for each in tables], axis=1).sort_index()
    found = {str(name): column.to_numpy(dtype=float) for name, column in whole.items()}
    stamps = whole.index.to_numpy()
    note = "; the headers' stamps do not advance: log times are used" if logged else ""
    return {"time": 1e-9 * (stamps - stamps[0])} | found, note, stated


def _called(base: str, frames: Mapping[str, object]) -> str:
    """The frame of the base among those of a log."""
    alike = [name for name in frames if base in (name, re.split("::|/", name)[-1])]
    alike = [base] if base in alike else alike
    if len(alike) != 1:
        said = f"has no frame '{base}'" if not alike else f"several frames are called '{base}'"
        raise ValueError(f"{said}; name one with --column base=FRAME; there are {sorted(frames)}")
    return alike[0]


def _read(path: Path) -> tuple[_Series, bool]:
    """All series of a file, and whether their times are from the log."""
    try:
        make_reader = importlib.import_module("mcap.reader").make_reader
    except ImportError as error:
        raise FfsmError("an .mcap needs mcap: pip install 'ffsm-drake[mcap]'") from error
    rows: dict[_Key, list[tuple[float, ...]]] = {}  # stamp of the header, of the log, values
    decoders: dict[int, Callable[[bytes], Any]] = {}
    try:
        with path.open("rb") as stream:
            _check_unpacked(stream)
            stream.seek(0)
            for schema, channel, message in make_reader(stream).iter_messages():
                found: _Rows = ()
                if channel.message_encoding == "json":
                    found = _of_json(channel.topic, message)
                elif schema and schema.name in _MESSAGES:
                    if channel.id not in decoders:
                        decoders[channel.id] = _decoder(channel.message_encoding, schema)
                    found = _MESSAGES[schema.name](decoders[channel.id](message.data))
                for key, stamp, row in found:
                    rows.setdefault(key, []).append((_nanoseconds(stamp), message.log_time, *row))
    except (OSError, FfsmError):
        raise
    except Exception as error:  # decompressors and decoders raise exceptions of many kinds
        raise ValueError(one_line(error)) from error
    tables = {key: pd.DataFrame(each) for key, each in rows.items()}
    stopped = [np.ptp(each[0]) == 0 and np.ptp(each[1]) > 0 for each in tables.values()]
    own = int(any(stopped))
    return {key: each.set_index(own).iloc[:, 1:] for key, each in tables.items()}, bool(own)


def _check_unpacked(stream: BinaryIO) -> None:
    """Raise ValueError if the chunks of a file are too large when unpacked.

    The size is stated in the file or in the chunks. lz4 expands a file at most 255 times.
    """
    reader: Any = importlib.import_module("mcap.stream_reader")
    total = 0
    for record in reader.StreamReader(stream, emit_chunks=True).records:
        if type(record).__name__ == "Chunk":
            size = record.uncompressed_size
            if record.compression == "zstd":
                zstandard: Any = importlib.import_module("zstandard")
                size = max(size, zstandard.frame_content_size(record.data))  # -1: not stated
            total += size
        if total > _MAX_UNPACKED:
            raise ValueError(
                f"holds {total:.3g} bytes unpacked; at most {_MAX_UNPACKED:.3g} are read"
            )


def _decoder(encoding: str, schema: Any) -> Callable[[bytes], Any]:
    if encoding not in _MODULES:
        raise ValueError(f"messages {schema.name} in '{encoding}' are not understood")
    module, package, extra = _MODULES[encoding]
    try:
        factory = importlib.import_module(module).DecoderFactory()
    except ImportError as error:
        said = f"an .mcap with {schema.name} needs {package}: pip install 'ffsm-drake[{extra}]'"
        raise FfsmError(said) from error
    decode: Callable[[bytes], Any] | None = factory.decoder_for(encoding, schema)
    if decode is None:
        raise ValueError(f"the schema of {schema.name} is not understood")
    return decode


def _of_json(topic: str, message: Any) -> _Rows:
    fields = json.loads(message.data)
    for name, value in fields.items() if isinstance(fields, dict) else ():
        if isinstance(value, int | float):
            yield _Key("json", f"{topic.lstrip('/')}.{name}"), message.log_time, [float(value)]


def _nanoseconds(stamp: Any) -> int:
    """A time in ns, or a time stamp of ROS 2 or of protocol buffers."""
    if isinstance(stamp, int):
        return stamp
    if hasattr(stamp, "nanosec"):
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return int(stamp.seconds) * 10**9 + int(stamp.nanos)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Vectors:
    """Reader of messages with vectors and quaternions; texts are names of attributes."""

    kind: str
    name: str = "child_frame_id"
    parent: str = "header.frame_id"
    stamp: str = "header.stamp"
    values: Sequence[str]
    each: str = ""  # list of the parts of a message; empty: it is one part

    def __call__(self, message: Any) -> _Rows:
        for part in getattr(message, self.each) if self.each else [message]:
            name, parent, stamp, *vectors = (
                operator.attrgetter(path)(part)
                for path in (self.name, self.parent, self.stamp, *self.values)
            )
            row = [getattr(v, x) for v in vectors for x in "wxyz" if hasattr(v, x)]
            yield _Key(self.kind, name, parent), stamp, row


def _of_joint_state(message: Any) -> _Rows:
    for i, name in enumerate(message.name):
        series = (message.position, message.velocity, message.effort)
        row = [values[i] if i < len(values) else math.nan for values in series]
        yield _Key("joint", name), message.header.stamp, row


def _of_joint_states(message: Any) -> _Rows:
    for joint in message.joints:
        row = [
            getattr(joint, field) if joint.HasField(field) else math.nan
            for field in ("position", "velocity", "effort")
        ]
        yield _Key("joint", joint.name), message.timestamp, row


_FRAME = _Vectors(
    kind="pose", parent="parent_frame_id", stamp="timestamp", values=("translation", "rotation"),
)  # fmt: skip
_MESSAGES: dict[str, Callable[[Any], _Rows]] = {
    "tf2_msgs/msg/TFMessage": _Vectors(
        kind="pose", values=("transform.translation", "transform.rotation"), each="transforms"
    ),
    "sensor_msgs/msg/JointState": _of_joint_state,
    "nav_msgs/msg/Odometry": _Vectors(
        kind="odometry",
        values=("pose.pose.position", "pose.pose.orientation", "twist.twist.linear",
                "twist.twist.angular"),
    ),
    "geometry_msgs/msg/WrenchStamped": _Vectors(
        kind="wrench", name="header.frame_id", values=("wrench.force", "wrench.torque")
    ),
    "foxglove.FrameTransform": _FRAME,
    "foxglove.FrameTransforms": dataclasses.replace(_FRAME, each="transforms"),
    "foxglove.JointStates": _of_joint_states,
}  # fmt: skip
