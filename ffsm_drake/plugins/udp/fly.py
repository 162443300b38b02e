"""A control law of this package as an external controller: the other end of the loop.

    python -m ffsm_drake.plugins.udp.fly postcapture -c tde_aismc

It listens on the loopback interface unless another address is given, and answers until Ctrl-C or
SIGTERM. A request that comes again gets the same reply, without another step of the law. Damaged
and foreign packets are counted and passed over.
"""

import argparse
import collections
import contextlib
import dataclasses
import os
import socket
import sys
from collections.abc import Sequence

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.interrupts import handle_signals, interruptible
from ffsm_drake.common.numbers import counted
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.udp.packets import (
    HOLDS,
    IS_FIRST,
    LARGEST,
    MOST_PORT,
    Packet,
    inputs_of,
    open_socket,
    read,
)
from ffsm_drake.scenario import Grip, Scenario, load_scenario
from ffsm_drake.systems.controllers import SampledController, make_controller
from ffsm_drake.systems.controllers.law import State

_MOST_FLIGHTS = 64  # runs whose memory is kept
_MOST_REASONS = 20  # counted one by one


@dataclasses.dataclass(kw_only=True)
class _Flight:
    """The law's memory in one run of a simulation."""

    memory: State
    holds: int  # at the last request
    last: Packet | None = None  # the last reply


class Pilot:
    """A law with its memory in each run, from request to reply, without the target and with it."""

    def __init__(self, scenario: Scenario) -> None:
        """Raises the errors of ``make_controller``, and FfsmError: it is not a control law."""
        mission = Mission(scenario)
        self._controllers = {
            holds: _controller(mission, Grip(bool(holds)))
            for holds in ((0, HOLDS) if scenario.grasps else (HOLDS,))
        }
        coordinates = mission.craft.coordinates
        self._sizes = len(coordinates.position_names), len(coordinates.names)
        self._period = scenario.sample_time
        self._flights = dict[int, _Flight]()  # by run, the one of the last request last
        self.answered, self.refused = 0, collections.Counter[str]()

    def answer(self, data: bytes) -> bytes | None:
        """The reply to a packet; None to one that is no request for this pilot, which is counted
        by its reason. The first of each reason is printed.
        """
        try:
            request = read(data)
            if request is None:
                raise ValueError("what is no packet of this version")
            reply = self.reply(request)
        except (Exception, SystemExit) as error:  # Drake exits for some numbers
            known = isinstance(error, FfsmError | ValueError)
            reason = one_line(error) if known else f"{type(error).__name__}: {one_line(error)}"
            if reason not in self.refused and len(self.refused) >= _MOST_REASONS:
                reason = "other reasons"
            self.refused[reason] += 1
            if self.refused[reason] == 1:
                print(f"refused: {reason}", flush=True)
            return None
        self.answered += reply is not None
        return None if reply is None else reply.to_bytes()

    def reply(self, request: Packet) -> Packet | None:
        """The reply to a request; None to one older than the last of its run.

        A request that is refused leaves every memory as it was.

        Raises ValueError: the request is damaged, or for another spacecraft or mission.
        """
        inputs, holds = inputs_of(request, *self._sizes), request.flags & HOLDS
        if not abs(request.time - request.sample * self._period) < 0.5 * self._period:
            raise ValueError(f"a request whose time is not its sample times {self._period:g} s")
        if (controller := self._controllers.get(holds)) is None:
            raise ValueError("a request of a phase without a target: the mission has no capture")
        flight = self._flights.get(request.run)
        is_first = bool(request.flags & IS_FIRST)
        if flight is None:
            flight = _Flight(memory=controller.law.initial_state(), holds=holds)
        last, memory = flight.last, flight.memory
        if last is not None and request.sample <= last.sample:
            return last if request.sample == last.sample else None
        if holds != flight.holds:
            law, is_first = self._controllers[flight.holds].law, True
            memory = controller.resumed(memory, law, inputs["desired_state"])
        with np.errstate(all="ignore"):
            force, memory = controller.step(inputs, memory, is_first=is_first, time=request.time)
        reply = Packet(
            run=request.run, sample=request.sample, time=request.time, flags=0, values=force
        )
        if not reply.is_usable:
            raise ValueError("a request to which the law has no finite force")
        self._flights.pop(request.run, None)
        self._flights[request.run] = _Flight(memory=memory, holds=holds, last=reply)
        if len(self._flights) > _MOST_FLIGHTS:
            del self._flights[next(iter(self._flights))]
        return reply


def _controller(mission: Mission, grip: Grip) -> SampledController:
    controller = make_controller(mission, mission.craft.nominal(grip))
    if not isinstance(controller, SampledController):
        raise FfsmError(f"{mission.scenario.controller} is a Drake system, not a control law")
    return controller


def fly(pilot: Pilot, own: socket.socket) -> None:
    """Answer requests that come to a socket, until Ctrl-C or SIGTERM; then print the counts."""
    with contextlib.suppress(KeyboardInterrupt), interruptible():
        print("listening on {}:{}".format(*own.getsockname()), flush=True)
        while True:
            data, sender = own.recvfrom(LARGEST)
            if (reply := pilot.answer(data)) is not None:
                with contextlib.suppress(OSError):  # a sender that cannot be reached
                    own.sendto(reply, sender)
    print(f"answered {pilot.answered} requests, refused {pilot.refused.total()}", flush=True)
    for reason, count in pilot.refused.items():
        print(f"refused {counted(count, 'time')}: {reason}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command; see the module docstring."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("scenario")
    parser.add_argument("-c", "--controller", help="default: the scenario's")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020)
    given = parser.parse_args(arguments)
    law = [] if given.controller is None else [f"controller={given.controller}"]
    handle_signals()
    try:
        if not 0 <= given.port <= MOST_PORT:
            raise FfsmError(f"--port: must be from 0 to {MOST_PORT}, not {given.port}")
        with open_socket("bind", given.host, given.port, key="--host, --port") as own:
            fly(Pilot(load_scenario(given.scenario, [*given.set, *law])), own)
    except (FfsmError, OSError) as error:
        parser.exit(2, f"error: {one_line(error)}\n")


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # freeing every object takes a second
