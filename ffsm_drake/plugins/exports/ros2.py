"""A recorded run as MCAP with messages of ROS 2: /tf, /joint_states, /odom and /wrench (of the
base).
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.plugins.exports.motion import WORLD, Bodies, joints_of, poses_of
from ffsm_drake.runs.record import RunRecord

_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
}
_MESSAGES = {
    "/tf": ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms"),
    "/joint_states": (
        "sensor_msgs/msg/JointState",
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort",
    ),
    "/odom": (  # the twist in the base's axes
        "nav_msgs/msg/Odometry",
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
    ),
    "/wrench": (
        "geometry_msgs/msg/WrenchStamped",
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    ),
}
_SERIES = ("position", "velocity", "effort")  # of joints
_UNKNOWN = [0.0] * 36  # covariance
_RULE = "\n" + 80 * "=" + "\nMSG: "


def write(record: RunRecord, path: Path) -> None:
    """Write a run to a file.

    Raises: FfsmError, if the library is missing.
    """
    try:
        ros2: Any = importlib.import_module("mcap_ros2.writer")
    except ImportError as error:
        raise FfsmError("--ros2 needs mcap-ros2-support: pip install 'ffsm-drake[ros2]'") from error
    data, bodies, (names, joints) = record.dataset, Bodies(record.scenario), joints_of(record)
    poses = poses_of(record, bodies)
    with path.open("wb") as stream:
        writer = ros2.Writer(stream)
        schemas = {
            topic: writer.register_msgdef(name, text + "".join(map(_definition, _PARTS)))
            for topic, (name, text) in _MESSAGES.items()
        }
        for k, time in enumerate(data.time.values):
            stamp = round(float(time) * 1e9)
            header = {"stamp": dict(zip(("sec", "nanosec"), divmod(stamp, 10**9), strict=True))}
            header["frame_id"] = WORLD  # type: ignore[assignment]
            torque, force = np.split(data["applied_force"].values[k, :6], 2)
            found = {
                "/joint_states": {
                    "header": header,
                    "name": names,
                    **dict(
                        zip(("position", "velocity", "effort"), joints[k].tolist(), strict=True)
                    ),
                },
                "/wrench": {
                    "header": header,
                    "wrench": {"force": _vector(force), "torque": _vector(torque)},
                },
            }
            if placed := next(poses, None):
                transforms = [_transform(header, *each) for each in placed.items()]
                found["/tf"] = {"transforms": transforms}
                q, v = data["position"].values[k, :4], data["velocity"].values[k, :6]
                rates = in_body_axes(q[None], v.reshape(2, 3))
                found["/odom"] = {
                    "header": header,
                    "child_frame_id": bodies.base,
                    "pose": {"pose": _pose(placed[bodies.base]), "covariance": _UNKNOWN},
                    "twist": {
                        "twist": {"linear": _vector(rates[1]), "angular": _vector(rates[0])},
                        "covariance": _UNKNOWN,
                    },
                }
            for topic, message in found.items():
                writer.write_message(topic, schemas[topic], message, log_time=stamp)
        writer.finish()


def _definition(name: str) -> str:
    return f"{_RULE}{name}\n{_PARTS[name]}"


def _vector(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _quaternion(X: Any) -> dict[str, float]:
    return dict(zip("wxyz", X.rotation().ToQuaternion().wxyz().tolist(), strict=True))


def _pose(X: Any) -> dict[str, Any]:
    return {"position": _vector(X.translation()), "orientation": _quaternion(X)}


def _transform(header: dict[str, Any], name: str, X: Any) -> dict[str, Any]:
    transform = {"translation": _vector(X.translation()), "rotation": _quaternion(X)}
    return {"header": header, "child_frame_id": name, "transform": transform}
