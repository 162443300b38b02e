"""A run live in Foxglove, behind a proxy that only passes subscriptions."""

import dataclasses
import json
import logging
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram
from websockets.http11 import Request

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.loopback import HOST, random_loopback
from ffsm_drake.plugins.exports.foxglove_scene import Scene, foxglove_library
from ffsm_drake.plugins.live.door import BadFrame, Door
from ffsm_drake.plugins.live.operator import make_operated_disturbance
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.controllers import complete_gains
from ffsm_drake.systems.setup import BlockSetup

# Live: between two pictures, between two copies of the shapes, and the lag that is caught up, s.
_PICTURE, _SHAPES, _LARGEST_DEBT = 0.04, 1.0, 0.1
_AS_IT_IS = np.array([1.0, 0.0, 0.0, 0.0])  # scale of the disturbance, and no push


def watch(
    scenario: Scenario,
    *,
    port: int = 8765,
    tell: Callable[[str], None] = print,
    wait: Callable[[float], None] = time.sleep,
) -> RunRecord:
    """Run a scenario at real time, or its ``target_realtime_rate``, and serve ``/tf`` and
    ``/scene`` to Foxglove on 127.0.0.1 meanwhile.

    The library's server obeys every page, so it is behind a proxy (``live.door``): clients must
    know the printed address, with a secret at its end.

    Args: the scenario; the port, 0: any; a function called with the line for the terminal; a
    function called with seconds, to let wall time pass.

    Returns: the record of ``simulate``.

    Raises: FfsmError, if the library is missing, or the port is taken.
    """
    foxglove = foxglove_library()
    context = foxglove.Context()
    server, address = _started(foxglove, context)
    door = None
    try:
        door = FoxgloveDoor(f"ws://{address}:{server.port}", port)
        tell(f"In Foxglove open the connection {door.url}")
        live = _Live(Scene(foxglove, context, scenario), scenario, wait)
        alone = scenario.replace(simulator_config={"target_realtime_rate": 0.0})  # ``live`` paces
        record = simulate(alone, blocks={"forces.disturbance": live.make})
        return dataclasses.replace(record, scenario=complete_gains(scenario))
    finally:
        if door is not None:
            door.close()
        server.stop()


def _started(foxglove: Any, context: Any) -> tuple[Any, str]:
    """A server and its address: any of this machine, 127.0.0.1 where the system has no other."""
    # Disconnected pages are not reported in the terminal.
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)
    for host in (random_loopback(), HOST):
        with suppress(OSError, RuntimeError):
            server = foxglove.start_server(name="ffsm_drake", host=host, port=0, context=context)
            return server, host
    raise FfsmError("Foxglove cannot start: no port of this machine is free for it")


class FoxgloveDoor(Door):
    """The proxy in front of a Foxglove server; ``url`` is the proxy's address."""

    largest = 2**20
    subprotocol = "foxglove.sdk.v1"

    def __init__(self, socket: str, port: int) -> None:
        """Raises FfsmError if the port is not free."""
        self._path = f"/{secrets.token_urlsafe(16)}"
        super().__init__(socket, [port], called="Foxglove")
        self.url = f"ws://{HOST}:{self.port}{self._path}"

    def refusal(self, request: Request, host: str) -> str | None:
        """Check the secret path, not the origin: Foxglove's own pages have many origins."""
        known = secrets.compare_digest(request.path.encode(), self._path.encode())
        return None if known else "the address is not the one that was told\n"

    def passed(self, frame: str | bytes) -> str | None:
        """Pass a page's subscriptions; drop all other requests."""
        try:
            message = json.loads(frame) if isinstance(frame, str) else None
        except (ValueError, RecursionError) as error:
            raise BadFrame from error
        if not isinstance(message, dict):
            raise BadFrame
        is_known = message.get("op") in ("subscribe", "unsubscribe")
        return frame if is_known else None  # type: ignore[return-value]


class _Live:
    """A live run: sets its pace and shows its bodies."""

    def __init__(self, scene: Scene, scenario: Scenario, wait: Callable[[float], None]) -> None:
        self._scene, self._wait = scene, wait
        self._period = scenario.sample_time / (
            scenario.simulator_config.target_realtime_rate or 1.0
        )
        self._due, self._shown, self._seen = 0.0, -np.inf, -np.inf

    def make(self, setup: BlockSetup) -> Diagram:
        """The scenario's disturbance, polled at each sample."""
        return make_operated_disturbance(setup, initial=_AS_IT_IS, poll=self._poll)

    def _poll(self, now: float, q: np.ndarray) -> np.ndarray:
        wall = time.perf_counter()
        self._due = max(min(self._due, wall) + self._period, wall - _LARGEST_DEBT)
        if (left := self._due - wall) > 0.0:
            self._wait(left)
        if wall - self._shown >= _PICTURE:
            self._shown, stamp = wall, round(now * 1e9)
            if wall - self._seen >= _SHAPES:  # for pages that connected meanwhile
                self._seen = wall
                self._scene.write_shapes(stamp)
            self._scene.write_poses(stamp, dict(self._scene.bodies.poses(q)))
        return _AS_IT_IS
