"""Logs in MCAP: standard messages of ROS 2 and Foxglove as named columns.

Their definitions: tf2_msgs/TFMessage, sensor_msgs/JointState, nav_msgs/Odometry and
geometry_msgs/WrenchStamped (https://docs.ros.org/en/rolling/p/common_interfaces);
foxglove.FrameTransforms and foxglove.JointStates (https://docs.foxglove.dev/docs/sdk/schemas).
"""

import importlib
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.so3 import in_body_axes

_MODULES = {  # encoding of messages -> what decodes it, its package, our extra
    "protobuf": ("mcap_protobuf.decoder", "mcap-protobuf-support", "mcap"),
    "cdr": ("mcap_ros2.decoder", "mcap-ros2-support", "ros2"),
}
_MAX_UNPACKED = 8_000_000_000  # bytes
_INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # of a quaternion


class _Key(NamedTuple):
    """What a series is of."""

    kind: str  # "pose", "odometry", "joint", "wrench" or "json"
    name: str  # of the frame, joint or field
    parent: str = ""  # of a pose or odometry: the frame that it is in


class Series(NamedTuple):
    """Values at their own times."""

    stamps: np.ndarray  # (n), ns
    rows: np.ndarray  # (n, k)


_Found = Iterator[tuple[_Key, Any, list[float]]]  # with a time stamp


def read_mcap(path: Path, base: str) -> tuple[dict[str, np.ndarray], str]:
    """Read a log; times are those of the base's poses, from the first: the headers', or the log's
    where a header's never advances.

    Args:
      base: the base's frame, with or without what precedes "::" or "/".

    Returns: columns by this package's names and, as TOPIC.FIELD, the numbers of JSON topics; what
    was done to them.

    Raises:
      FfsmError: a library is missing.
      ValueError: it cannot be read, or tells nothing of the base.
    """
    series, logged = _read(path)
    frames = {key.name: key for kind in ("odometry", "pose") for key in series if key.kind == kind}
    pose = frames[_called(base, frames)]
    odometry = next((k for k in series if k[:2] == ("odometry", pose.name)), None)
    wrenches = [_Key("wrench", name) for name in (pose.parent, pose.name)]
    used = [key for key in series if key in (pose, odometry, *wrenches) or key.kind == "joint"]
    spans = [series[key].stamps for key in used]
    stamps, rows = series[pose]
    first, last = max(each.min() for each in spans), min(each.max() for each in spans)
    kept = (stamps >= first) & (stamps <= last)
    stamps, rows = stamps[kept], rows[kept, :7]
    if not stamps.size:
        raise ValueError(f"{pose.kind} of {pose.name} and the other messages share no time")
    found = {"time": 1e-9 * (stamps - stamps[0])} | _split("base_position", rows[:, :3])
    found |= _split("base_quaternion", rows[:, 3:], "wxyz")
    changed = {key.kind for key in used if not _fits(series[key], stamps)}
    if odometry:
        twist = at_times(series[odometry], stamps)[:, 7:]
        found |= _split("base_velocity", twist[:, :3])
        found |= _split("base_angular_velocity", twist[:, 3:])
    for key in wrenches:
        if key in series:
            force, torque = np.hsplit(at_times(series[key], stamps, smooth=False), 2)
            if key.name == pose.name:
                back = rows[:, 3:] * _INVERSE
                force, torque = in_body_axes(back, force), in_body_axes(back, torque)
            found |= _split("base_force", force) | _split("base_torque", torque)
    for key, each in series.items():
        if key.kind == "joint":
            for end, column in zip(("", "_rate", "_effort"), each.rows.T, strict=True):
                if not np.isnan(column).all():
                    own = Series(each.stamps, column[:, None])
                    found[key.name + end] = at_times(own, stamps, smooth=end != "_effort")[:, 0]
        elif key.kind == "json":
            found[key.name] = at_times(each, stamps, smooth=False)[:, 0]
    note = "; the headers' stamps do not advance: log times are used" if logged else ""
    note += f"; {' and '.join(sorted(changed))} interpolated to the poses' times" if changed else ""
    return found, note


def _split(name: str, rows: np.ndarray, labels: str = "xyz") -> dict[str, np.ndarray]:
    return {f"{name}_{label}": row for label, row in zip(labels, rows.T, strict=True)}


def _called(base: str, frames: Mapping[str, object]) -> str:
    """The frame of the base among those of a log."""
    alike = [name for name in frames if base in (name, re.split("::|/", name)[-1])]
    alike = [base] if base in alike else alike
    if len(alike) != 1:
        said = f"has no frame '{base}'" if not alike else f"several frames are called '{base}'"
        raise ValueError(f"{said}; name one with --column base=FRAME; there are {sorted(frames)}")
    return alike[0]


def _fits(series: Series, stamps: np.ndarray) -> bool:
    """Whether a series has the times that are asked for."""
    return bool(np.isin(stamps, series.stamps).all())


def at_times(series: Series, stamps: np.ndarray, *, smooth: bool = True) -> np.ndarray:
    """A series at other times (n, k): by cubic splines where it is smooth, else linear."""
    own, index = np.unique(series.stamps, return_index=True)
    rows = series.rows[index]
    if _fits(series, stamps):
        return rows[np.searchsorted(own, stamps)]
    times, wanted = 1e-9 * (own - own[0]), 1e-9 * (stamps - own[0])
    if smooth and own.size > 1 and np.isfinite(rows).all():
        found: np.ndarray = CubicSpline(times, rows)(wanted)
        return found
    return np.stack([np.interp(wanted, times, column) for column in rows.T], axis=1)


def _read(path: Path) -> tuple[dict[_Key, Series], bool]:
    """All series of a file, and whether their times are those of the log."""
    try:
        make_reader = importlib.import_module("mcap.reader").make_reader
    except ImportError as error:
        raise FfsmError("an .mcap needs mcap: pip install 'ffsm-drake[mcap]'") from error
    stamps: dict[_Key, list[tuple[int, int]]] = {}  # the header's, the log's
    rows: dict[_Key, list[list[float]]] = {}
    decoders: dict[int, Callable[[bytes], Any]] = {}
    try:
        with path.open("rb") as stream:
            _check_unpacked(stream)
            stream.seek(0)
            for schema, channel, message in make_reader(stream).iter_messages():
                name = schema.name if schema else ""
                if channel.message_encoding == "json":
                    for key, value in _of_json(channel.topic, message.data):
                        both = message.log_time, message.log_time
                        stamps.setdefault(key, []).append(both)
                        rows.setdefault(key, []).append([value])
                elif name in _MESSAGES:
                    if channel.id not in decoders:
                        decoders[channel.id] = _decoder(channel.message_encoding, schema)
                    for key, stamp, row in _MESSAGES[name](decoders[channel.id](message.data)):
                        both = _nanoseconds(stamp), message.log_time
                        stamps.setdefault(key, []).append(both)
                        rows.setdefault(key, []).append(row)
    except (OSError, FfsmError):
        raise
    except Exception as error:  # of many kinds, by what decompresses and decodes
        raise ValueError(one_line(error)) from error
    times = {key: np.array(pairs) for key, pairs in stamps.items()}
    stopped = [not np.ptp(pair[:, 0]) and np.ptp(pair[:, 1]) > 0 for pair in times.values()]
    own = int(any(stopped))
    return {key: Series(times[key][:, own], np.array(rows[key])) for key in rows}, bool(own)


def _check_unpacked(stream: BinaryIO) -> None:
    """Raise ValueError for a file that says of its chunks, or whose chunks say, that they are too
    much when unpacked; of lz4 they are at most 255 times the file.
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


def _of_json(topic: str, data: bytes) -> Iterator[tuple[_Key, float]]:
    message = json.loads(data)
    for name, value in message.items() if isinstance(message, dict) else ():
        if isinstance(value, int | float):
            yield _Key("json", f"{topic.lstrip('/')}.{name}"), float(value)


def _nanoseconds(stamp: Any) -> int:
    """A time stamp of ROS 2 or of protocol buffers."""
    if hasattr(stamp, "nanosec"):
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return int(stamp.seconds) * 10**9 + int(stamp.nanos)


def _vector(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _pose(position: Any, rotation: Any) -> list[float]:
    return [*_vector(position), rotation.w, *_vector(rotation)]


def _of_transforms(message: Any) -> _Found:
    for each in message.transforms:
        key = _Key("pose", each.child_frame_id, each.header.frame_id)
        yield key, each.header.stamp, _pose(each.transform.translation, each.transform.rotation)


def _of_frame(message: Any) -> _Found:
    key = _Key("pose", message.child_frame_id, message.parent_frame_id)
    yield key, message.timestamp, _pose(message.translation, message.rotation)


def _of_frames(message: Any) -> _Found:
    for each in message.transforms:
        yield from _of_frame(each)


def _of_odometry(message: Any) -> _Found:
    pose, twist = message.pose.pose, message.twist.twist
    rates = [*_vector(twist.linear), *_vector(twist.angular)]
    row = [*_pose(pose.position, pose.orientation), *rates]
    key = _Key("odometry", message.child_frame_id, message.header.frame_id)
    yield key, message.header.stamp, row


def _of_joint_state(message: Any) -> _Found:
    for i, name in enumerate(message.name):
        series = (message.position, message.velocity, message.effort)
        row = [values[i] if i < len(values) else math.nan for values in series]
        yield _Key("joint", name), message.header.stamp, row


def _of_joint_states(message: Any) -> _Found:
    for joint in message.joints:
        row = [
            getattr(joint, field) if joint.HasField(field) else math.nan
            for field in ("position", "velocity", "effort")
        ]
        yield _Key("joint", joint.name), message.timestamp, row


def _of_wrench(message: Any) -> _Found:
    row = [*_vector(message.wrench.force), *_vector(message.wrench.torque)]
    yield _Key("wrench", message.header.frame_id), message.header.stamp, row


_MESSAGES: dict[str, Callable[[Any], _Found]] = {
    "tf2_msgs/msg/TFMessage": _of_transforms,
    "sensor_msgs/msg/JointState": _of_joint_state,
    "nav_msgs/msg/Odometry": _of_odometry,
    "geometry_msgs/msg/WrenchStamped": _of_wrench,
    "foxglove.FrameTransform": _of_frame,
    "foxglove.FrameTransforms": _of_frames,
    "foxglove.JointStates": _of_joint_states,
}
