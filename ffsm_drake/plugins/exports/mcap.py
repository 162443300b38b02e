"""A recorded run as MCAP: for Foxglove, or with messages of ROS 2."""

from pathlib import Path

from ffsm_drake.runs.record import RunRecord


def write(record: RunRecord, path: Path, ros2: bool = False) -> None:
    """Write a run. Raises FfsmError: a library is missing."""
    if ros2:
        from ffsm_drake.plugins.exports.ros2 import write as write_messages
    else:
        from ffsm_drake.plugins.exports.foxglove import write as write_messages
    write_messages(record, path)
