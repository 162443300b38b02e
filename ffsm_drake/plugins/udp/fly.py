"""A control law of this package as an external controller: the other end of the loop.

    python -m ffsm_drake.plugins.udp.fly postcapture -c tde_aismc

It listens on the loopback interface unless another address is given, and answers until Ctrl-C. A
request that comes again gets the same reply, without another step of the law.
"""

import argparse
import contextlib
import socket
from collections.abc import Sequence

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.udp.packets import IS_FIRST, LARGEST, Packet, inputs_of, read
from ffsm_drake.scenario import Scenario, load_scenario
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.controllers import SampledController, make_controller
from ffsm_drake.systems.controllers.law import State


class Pilot:
    """A law with its memory, from request to reply."""

    def __init__(self, scenario: Scenario) -> None:
        """Raises the errors of ``make_controller``, and FfsmError: it is not a control law."""
        controller = make_controller(scenario, make_nominal_plant(scenario))
        if not isinstance(controller, SampledController):
            raise FfsmError(f"{scenario.controller} is a Drake system, not a control law")
        self._controller = controller
        coordinates = make_nominal_plant(scenario).coordinates
        self._sizes = len(coordinates.position_names), len(coordinates.names)
        self._memory: State = {}
        self._last: Packet | None = None

    def reply(self, request: Packet) -> Packet | None:
        """The reply to a request; None to one older than the last.

        Raises ValueError: the request is for another spacecraft.
        """
        last = self._last
        if last is None or last.run != request.run:
            self._memory, last = self._controller.law.initial_state(), None
        if last is not None and request.sample <= last.sample:
            return last if request.sample == last.sample else None
        force, self._memory = self._controller.step(
            inputs_of(request, *self._sizes),
            self._memory,
            is_first=bool(request.flags & IS_FIRST),
            time=lambda: request.time,
        )
        self._last = Packet(
            run=request.run, sample=request.sample, time=request.time, flags=0, values=force
        )
        return self._last


def fly(pilot: Pilot, address: tuple[str, int]) -> None:
    """Answer requests until the process ends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(address)
        print("listening on {}:{}".format(*own.getsockname()), flush=True)
        while True:
            data, sender = own.recvfrom(LARGEST)
            request = read(data)
            if request is None:
                continue
            try:
                reply = pilot.reply(request)
            except ValueError as error:
                print(f"refused: {error}", flush=True)
                continue
            if reply is not None:
                own.sendto(reply.to_bytes(), sender)


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
    try:
        pilot = Pilot(load_scenario(given.scenario, [*given.set, *law]))
    except FfsmError as error:
        parser.exit(2, f"error: {error}\n")
    with contextlib.suppress(KeyboardInterrupt):
        fly(pilot, (given.host, given.port))


if __name__ == "__main__":
    main()
