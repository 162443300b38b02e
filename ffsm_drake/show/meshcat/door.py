"""The way from a browser to Drake's Meshcat server: a small proxy that refuses what Drake cannot.

Drake's server answers every page of every origin, and a frame that is not msgpack ends its thread.
So it listens at an address that nobody is told; pages reach it through a door, which serves the
page, hears its own pages only, and passes on nothing but clicks and slider values, encoded anew.
"""

import asyncio
import ctypes
import logging
import math
import re
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus

import msgpack
from pydrake.geometry import Meshcat
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.show.meshcat.stage import quiet_drake, start_meshcat

_HOST, _PORTS = "127.0.0.1", range(7000, 8000)
_LARGEST = 4096  # bytes of a page's frame
_MOST_PAGES = 16
_PATIENCE = 5.0  # s for Drake's server to answer
_IGNORED = ("camera_pose", "gamepad")  # what the page sends besides, and nobody here reads
_REFUSED = 1008  # the websocket's code for a client that breaks the rules
_LOOPBACK = re.compile(r"(localhost|127(\.\d{1,3}){3})(:\d+)?", re.ASCII)
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # whatever HTTP_PROXY says


class BadFrame(ValueError):
    """A frame that Meshcat's page does not send."""


def page_event(frame: str | bytes) -> bytes | None:
    """The click or slider value in a page's frame, encoded anew; None for one of no interest.

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


class Door:
    """A proxy before a Meshcat server, in a thread of its own; ``url`` is where pages find it."""

    def __init__(self, meshcat: Meshcat) -> None:
        """Raises FfsmError if no port is free."""
        self._page, self._socket = meshcat.web_url(), meshcat.ws_url()
        self._pages = 0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        port = asyncio.run_coroutine_threadsafe(self._open(), self._loop).result()
        if port is None:
            self.close()
            raise FfsmError(f"Meshcat cannot start: free a port from {_PORTS[0]} to {_PORTS[-1]}")
        self.url = f"http://{_HOST}:{port}"

    def close(self) -> None:
        """Close it and every connection through it."""
        asyncio.run_coroutine_threadsafe(self._shut(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _open(self) -> int | None:
        logger = logging.Logger("ffsm_drake.door")
        logger.addHandler(logging.NullHandler())  # bad clients are not the terminal's business
        self._server: Server | None = None
        for port in _PORTS:
            with suppress(OSError):
                self._server = await serve(
                    self._relay, _HOST, port, process_request=self._answer, max_size=_LARGEST,
                    compression=None, logger=logger, close_timeout=1.0,
                )  # fmt: skip
                return port
        return None

    async def _shut(self) -> None:
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
        await self._loop.shutdown_default_executor()

    async def _answer(self, page: ServerConnection, request: Request) -> Response | None:
        """The page's files; None lets a websocket of our own page in.

        A name that leads here from elsewhere (DNS rebinding) has another Host, a page of another
        site another Origin; browsers send both truthfully.
        """
        host = request.headers.get("Host", "")
        if not _LOOPBACK.fullmatch(host):
            return page.respond(HTTPStatus.FORBIDDEN, "this page is at another address\n")
        if request.headers.get("Upgrade", "").lower() != "websocket":
            return await asyncio.to_thread(self._file, page, request.path)
        if request.headers.get("Origin") != f"http://{host}":
            return page.respond(HTTPStatus.FORBIDDEN, "pages of this address only\n")
        if self._pages >= _MOST_PAGES:
            return page.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n")
        return None

    def _file(self, page: ServerConnection, path: str) -> Response:
        try:
            with _DIRECT.open(self._page + path, timeout=_PATIENCE) as answer:
                body, kind = answer.read(), answer.headers.get("Content-Type", "")
        except (OSError, ValueError):  # also an unknown path
            return page.respond(HTTPStatus.NOT_FOUND, "not found\n")
        response = page.respond(HTTPStatus.OK, "")
        del response.headers["Content-Type"], response.headers["Content-Length"]
        response.headers["Content-Type"] = kind or "application/octet-stream"
        response.headers["Content-Length"] = str(len(body))
        response.body = body
        return response

    async def _relay(self, page: ServerConnection) -> None:
        self._pages += 1
        try:
            async with connect(
                self._socket, max_size=None, compression=None, ping_interval=None, proxy=None
            ) as drake:
                outward = asyncio.create_task(_show(drake, page))
                try:
                    async for frame in page:
                        if (event := page_event(frame)) is not None:
                            await drake.send(event)
                finally:
                    outward.cancel()
                    drake.transport.abort()  # with a scene unread, a polite end would be waited for
                    await asyncio.gather(outward, return_exceptions=True)
        except BadFrame:
            await page.close(_REFUSED, "not an event of this page")
        except (OSError, ConnectionClosed, InvalidHandshake):
            pass  # one of the two is gone
        finally:
            self._pages -= 1


async def _show(drake: ClientConnection, page: ServerConnection) -> None:
    """Pass on what Drake sends; the page goes when Drake's server does."""
    with suppress(ConnectionClosed):
        async for message in drake:
            await page.send(message)
        await page.close()


def keep_for_ever(meshcat: Meshcat) -> None:
    """Never free a server that has failed: that would hang or end the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(meshcat))


@contextmanager
def live_server(meshcat: Meshcat | None) -> Iterator[tuple[Meshcat, str]]:
    """A Meshcat server and the address of its page: the given one with its own address, or a new
    one behind a door, whose address is printed.
    """
    if meshcat is not None:
        yield meshcat, meshcat.web_url()
        return
    with quiet_drake():  # nobody is to go around the door
        meshcat = start_meshcat()
    door = Door(meshcat)
    print(f"Meshcat listening for connections at {door.url}", file=sys.stderr)
    try:
        yield meshcat, door.url
    finally:
        door.close()
