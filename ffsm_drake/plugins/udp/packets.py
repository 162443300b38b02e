"""Packets of the loop: little-endian, float64 arrays, one packet a control sample and direction.

A head of 32 bytes: b"FFSM", version (uint16), flags (uint16), run (uint64), sample k (uint64), time
t_k (float64, s). A request then holds estimated_state (nq + nv), desired_state (nq + nv),
desired_acceleration (nv), applied_force (nv), and, if flagged, measurement_is_new (nq + nv) and
desired_frame (19), as at the ports of a controller. Flags: HOLDS, the target is in the gripper;
IS_FIRST, the first sample of a run, or the first after a grasp, where velocities jump. A reply
holds the generalized force (nv), N m and N. ``run`` is another number where a law starts without
memory; a reply repeats that and k. All numbers are finite and at most 1e9 in size, quaternions
have a norm of one within a tenth, and t_k is k times the control period.
"""

import dataclasses
import socket
import struct
from collections.abc import Mapping

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.systems.frame_path import FRAME_SIZE

VERSION = 1
IS_FIRST, HAS_NEW, HAS_FRAME, HOLDS = 1, 2, 4, 8  # flags
_FLAGS = IS_FIRST | HAS_NEW | HAS_FRAME | HOLDS
FLAG_OF = {"measurement_is_new": HAS_NEW, "desired_frame": HAS_FRAME}  # of an optional port
LARGEST = 65_507  # bytes of a UDP packet
MOST_PORT = 65_535
_MOST = 1e9  # rad, m, N m, N
_NORM = 0.1  # tolerance of a quaternion's norm, which integrators let drift
_HEAD = struct.Struct("<4sHHQQd")
_MAGIC = b"FFSM"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Packet:
    """A packet's head, and its numbers."""

    run: int
    sample: int
    time: float  # s
    flags: int
    values: np.ndarray

    @property
    def is_usable(self) -> bool:
        """Whether all numbers are finite, and none is huge."""
        return bool((np.abs(self.values) <= _MOST).all())  # false for NaN

    def to_bytes(self) -> bytes:
        """The packet on the wire."""
        head = _HEAD.pack(_MAGIC, VERSION, self.flags, self.run, self.sample, self.time)
        return head + self.values.astype("<f8").tobytes()


def read(data: bytes) -> Packet | None:
    """The packet in ``data``; None if it is not one of this version."""
    if len(data) < _HEAD.size or (len(data) - _HEAD.size) % 8:
        return None
    magic, version, flags, run, sample, time = _HEAD.unpack_from(data)
    if magic != _MAGIC or version != VERSION or flags & ~_FLAGS:
        return None
    values = np.frombuffer(data, "<f8", offset=_HEAD.size).astype(float)
    return Packet(run=run, sample=sample, time=time, flags=flags, values=values)


def request_sizes(num_positions: int, num_velocities: int, flags: int) -> dict[str, int]:
    """Numbers of a request with some flags, by port of the controller, in their order."""
    state = num_positions + num_velocities
    sizes = {
        "estimated_state": state,
        "desired_state": state,
        "desired_acceleration": num_velocities,
        "applied_force": num_velocities,
    }
    optional = {"measurement_is_new": state, "desired_frame": FRAME_SIZE}
    return sizes | {name: size for name, size in optional.items() if FLAG_OF[name] & flags}


def inputs_of(packet: Packet, num_positions: int, num_velocities: int) -> Mapping[str, np.ndarray]:
    """The controller's inputs in a request, by port.

    Raises ValueError: the request is of another size, or holds what no spacecraft measures.
    """
    sizes = request_sizes(num_positions, num_velocities, packet.flags)
    if packet.values.size != sum(sizes.values()):
        raise ValueError(
            f"a request of {packet.values.size} numbers, not {sum(sizes.values())}: another "
            "spacecraft"
        )
    if not packet.is_usable:
        raise ValueError(f"a request with numbers that are not finite, or beyond {_MOST:g}")
    parts = np.split(packet.values, np.cumsum([*sizes.values()])[:-1])
    inputs = dict(zip(sizes, parts, strict=True))
    for name in ("estimated_state", "desired_state", "desired_frame"):
        if name in inputs and abs(np.linalg.norm(inputs[name][:4]) - 1.0) > _NORM:
            raise ValueError(f"a request whose {name} has no unit quaternion")
    return inputs


def open_socket(act: str, host: str, port: int, *, key: str) -> socket.socket:
    """A UDP socket that is bound to an address, or connected with one.

    Args:
      act: "bind" or "connect".
      host: name or IPv4 address.
      port: from 0 to 65535.
      key: where the address is set, for errors.

    Raises FfsmError: there is no such address, or another program uses it.
    """
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        getattr(made, act)((host, port))
    except (OSError, TypeError, ValueError) as error:
        made.close()
        problem = f"cannot {act} to '{host}', port {port}; give another ({one_line(error)})"
        raise FfsmError(f"{key}: {problem}") from error
    return made
