"""A proxy between browsers and Drake's Meshcat server.

Drake's server accepts connections from every page of every origin, and a frame that is not msgpack
ends its thread. So it listens on a private port; a proxy (``live.door``) serves the page, accepts
connections from it only, and forwards only clicks and slider values, newly encoded.
"""

import ctypes
import math
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus

import msgpack
from pydrake.geometry import Meshcat
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from ffsm_drake.common.loopback import HOST
from ffsm_drake.plugins.live.door import BadFrame, Door, header
from ffsm_drake.plugins.meshcat.stage import start_meshcat

_PORTS = range(7000, 8000)
_PATIENCE = 5.0  # s for Drake's server to answer
_IGNORED = ("camera_pose", "gamepad")  # other messages of the page, without use here
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # whatever HTTP_PROXY says


def page_event(frame: str | bytes) -> bytes | None:
    """Click or slider value in a page's frame, re-encoded; None for other known messages.

    Raises BadFrame for anything else.
    """
    if isinstance(frame, str):
        raise BadFrame
    try:
        event = msgpack.unpackb(frame)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise BadFrame from error
    match event:
        case {"type": "button", "name": str(name)}:
            return bytes(msgpack.packb({"type": "button", "name": name}))
        case {"type": "slider", "name": str(name), "value": int() | float() as value} if (
            not isinstance(value, bool) and math.isfinite(value)
        ):
            return bytes(msgpack.packb({"type": "slider", "name": name, "value": float(value)}))
        case {"type": str(kind)} if kind in _IGNORED:
            return None
    raise BadFrame


class MeshcatDoor(Door):
    """The proxy in front of a Meshcat server; ``url`` is the address of its page."""

    def __init__(self, meshcat: Meshcat) -> None:
        """Raises FfsmError if no port is free."""
        self._page = meshcat.web_url()
        super().__init__(meshcat.ws_url(), _PORTS, called="Meshcat")
        self.url = f"http://{HOST}:{self.port}"

    def refusal(self, request: Request, host: str) -> str | None:
        """A page of another site has another Origin; browsers send it truthfully."""
        if header(request, "Origin") != f"http://{host}":
            return "pages of this address only\n"
        return None

    def passed(self, frame: str | bytes) -> bytes | None:
        return page_event(frame)

    def file(self, page: ServerConnection, path: str) -> Response:
        try:
            with _DIRECT.open(self._page + path, timeout=_PATIENCE) as answer:
                body, kind = answer.read(), answer.headers.get("Content-Type", "")
        except (OSError, ValueError):  # also an unknown path
            return super().file(page, path)
        response = page.respond(HTTPStatus.OK, "")
        del response.headers["Content-Type"], response.headers["Content-Length"]
        response.headers["Content-Type"] = kind or "application/octet-stream"
        response.headers["Content-Length"] = str(len(body))
        response.body = body
        return response


def keep_for_ever(meshcat: Meshcat) -> None:
    """Never free a failed server: that would hang or end the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(meshcat))


@contextmanager
def live_server(meshcat: Meshcat | None) -> Iterator[tuple[Meshcat, str]]:
    """A Meshcat server and the address of its page: the given one with its own address, or a new
    one behind a proxy, with the proxy's address printed.
    """
    if meshcat is not None:
        yield meshcat, meshcat.web_url()
        return
    meshcat = start_meshcat()
    door = MeshcatDoor(meshcat)
    print(f"Meshcat listening for connections at {door.url}", file=sys.stderr)
    try:
        yield meshcat, door.url
    finally:
        door.close()
