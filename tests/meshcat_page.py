"""Stand-ins for browsers: what pages send to a Meshcat server, from within and over the network."""

import base64
import gc
import os
import socket
from urllib.parse import urlsplit

import msgpack
import numpy as np
from pydrake.geometry import Meshcat


def click_message(button: str) -> bytes:
    """The message that a click on a button sends."""
    return msgpack.packb({"type": "button", "name": button})


def slider_message(slider: str, value: float) -> bytes:
    """The message that moving a slider sends."""
    return msgpack.packb({"type": "slider", "name": slider, "value": value})


def transform(meshcat: Meshcat, path: str) -> np.ndarray:
    """The 4 x 4 matrix that the browser was last told."""
    matrix = msgpack.unpackb(meshcat._GetPackedTransform(path))["matrix"]
    return np.array(matrix, dtype=float).reshape(4, 4).T


def click(meshcat: Meshcat, button: str) -> None:
    meshcat._InjectWebsocketMessage(click_message(button))


class ForeignPage:
    """A page of another site in the same machine's browser: a websocket with that site's Origin and
    Host.
    """

    def __init__(self, meshcat: Meshcat) -> None:
        address = urlsplit(meshcat.web_url())
        self._socket = socket.create_connection((address.hostname, address.port), timeout=5.0)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            "GET / HTTP/1.1\r\nHost: evil.example\r\nOrigin: http://evil.example\r\nUpgrade: "
            "websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: "
            "13\r\n\r\n".encode()
        )
        assert b" 101 " in self._socket.recv(4096).splitlines()[0], (
            "Drake has learnt to look at the origin"
        )

    def send(self, message: bytes) -> None:
        assert len(message) < 126
        mask = os.urandom(4)
        masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(message))
        self._socket.sendall(bytes([0x82, 0x80 | len(message)]) + mask + masked)

    def close(self) -> None:
        self._socket.close()


def resident():
    """Memory of this process after its garbage is collected, MiB."""
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20
