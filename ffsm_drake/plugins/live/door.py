"""A small proxy between browsers and a server without access control.

The server listens on a private, random loopback address; a door (the proxy) serves the page at its
own address, refuses connections according to ``refusal``, and forwards the frames returned by
``passed``.
"""

import abc
import asyncio
import contextlib
import logging
import re
import threading
from collections.abc import Iterable
from http import HTTPStatus

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.loopback import HOST

_MOST_PAGES = 16
_REFUSED = 1008  # the websocket's code for a client that breaks the rules
_LOOPBACK = re.compile(r"(localhost|127(\.\d{1,3}){3})(:\d+)?", re.ASCII)


def header(request: Request, name: str) -> str:
    """Return a header that is there once; otherwise empty."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else ""


class BadFrame(ValueError):
    """A frame that no page of the server sends."""


class Door(abc.ABC):
    """A proxy before a websocket server, in a thread of its own, at ``HOST`` and ``port``."""

    largest = 4096  # bytes of a page's frame
    subprotocol: str | None = None

    def __init__(self, socket: str, ports: Iterable[int], *, called: str) -> None:
        """Args:
          socket: the address of the server, ws://...
          ports: to try one after another; 0: any.
          called: the server, for the error.

        Raises FfsmError if no port is free.
        """
        self._socket, self._pages, ports = socket, 0, list(ports)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        port = asyncio.run_coroutine_threadsafe(self._open(ports), self._loop).result()
        if port is None:
            self.close()
            which = f"port {ports[0]}" if len(ports) == 1 else f"one from {ports[0]} to {ports[-1]}"
            raise FfsmError(f"{called} cannot start: no port is free; free {which}")
        self.port = port

    @abc.abstractmethod
    def refusal(self, request: Request, host: str) -> str | None:
        """Return why a websocket of a request to ``host`` is refused; None: it is accepted."""

    @abc.abstractmethod
    def passed(self, frame: str | bytes) -> str | bytes | None:
        """Return the part of a page's frame for the server; None: nothing. Raises BadFrame."""

    def file(self, page: ServerConnection, path: str) -> Response:
        """Return a file of the page; called in a thread."""
        return page.respond(HTTPStatus.NOT_FOUND, "not found\n")

    def close(self) -> None:
        """Close it and every connection through it."""
        asyncio.run_coroutine_threadsafe(self._shut(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _open(self, ports: Iterable[int]) -> int | None:
        logger = logging.Logger("ffsm_drake.door")
        logger.addHandler(logging.NullHandler())  # bad clients are not the terminal's business
        self._server: Server | None = None
        spoken = None if self.subprotocol is None else [Subprotocol(self.subprotocol)]
        for port in ports:
            with contextlib.suppress(OSError, OverflowError):
                self._server = await serve(
                    self._relay, HOST, port, process_request=self._answer, max_size=self.largest,
                    compression=None, logger=logger, close_timeout=1.0, subprotocols=spoken,
                )  # fmt: skip
                found: int = next(iter(self._server.sockets)).getsockname()[1]
                return found
        return None

    async def _shut(self) -> None:
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
        await self._loop.shutdown_default_executor()

    async def _answer(self, page: ServerConnection, request: Request) -> Response | None:
        """The page's files; None lets a websocket in.

        A name that leads here from elsewhere (DNS rebinding) has another Host; browsers send it
        truthfully.
        """
        host = header(request, "Host")
        if not _LOOPBACK.fullmatch(host):
            return page.respond(HTTPStatus.FORBIDDEN, "this page is at another address\n")
        if header(request, "Upgrade").lower() != "websocket":
            return await asyncio.to_thread(self.file, page, request.path)
        if problem := self.refusal(request, host):
            return page.respond(HTTPStatus.FORBIDDEN, problem)
        if self._pages >= _MOST_PAGES:
            return page.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n")
        return None

    async def _relay(self, page: ServerConnection) -> None:
        self._pages += 1
        spoken = None if page.subprotocol is None else [page.subprotocol]
        try:
            async with connect(
                self._socket, max_size=None, compression=None, ping_interval=None, proxy=None,
                subprotocols=spoken,
            ) as server:  # fmt: skip
                outward = asyncio.create_task(_show(server, page))
                try:
                    async for frame in page:
                        if (passed := self.passed(frame)) is not None:
                            await server.send(passed)
                finally:
                    outward.cancel()
                    # with a scene unread, a polite end would be waited for
                    server.transport.abort()
                    await asyncio.gather(outward, return_exceptions=True)
        except BadFrame:
            await page.close(_REFUSED, "not an event of this page")
        except (OSError, ConnectionClosed, InvalidHandshake):
            pass  # one of the two is gone
        finally:
            self._pages -= 1


async def _show(server: ClientConnection, page: ServerConnection) -> None:
    """Pass on what the server sends; the page goes when the server does."""
    with contextlib.suppress(ConnectionClosed):
        async for message in server:
            await page.send(message)
        await page.close()
