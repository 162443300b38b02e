"""A control law of this package as an external controller: the other end of the loop.

    python -m ffsm_drake.plugins.udp.fly postcapture -c tde_aismc

It listens on the loopback interface unless another address is given, and answers until Ctrl-C. A
request that comes again gets the same reply, without another step of the law.
"""

import argparse
import contextlib
import dataclasses
import socket
from collections.abc import Sequence

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.udp.packets import HOLDS, IS_FIRST, LARGEST, Packet, inputs_of, read
from ffsm_drake.scenario import Scenario, load_scenario
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.controllers import SampledController, make_controller
from ffsm_drake.systems.controllers.law import State


class Pilot:
    """A law with its memory, from request to reply, without the target and with it."""

    def __init__(self, scenario: Scenario) -> None:
        """Raises the errors of ``make_controller``, and FfsmError: it is not a control law."""
        self._controllers = {
            holds: _controller(dataclasses.replace(scenario, holds=bool(holds)))
            for holds in ((0, HOLDS) if scenario.grasps else (HOLDS,))
        }
        coordinates = make_nominal_plant(scenario).coordinates
        self._sizes = len(coordinates.position_names), len(coordinates.names)
        self._memory: State = {}
        self._last: Packet | None = None
        self._holds = HOLDS  # at the last request

    def reply(self, request: Packet) -> Packet | None:
        """The reply to a request; None to one older than the last.

        Raises ValueError: the request is for another spacecraft, or another mission.
        """
        inputs, holds = inputs_of(request, *self._sizes), request.flags & HOLDS
        if (controller := self._controllers.get(holds)) is None:
            raise ValueError("a request of a phase without a target: the mission has no capture")
        last = self._last
        if last is None or last.run != request.run:
            self._memory, last = controller.law.initial_state(), None
        if last is not None and request.sample <= last.sample:
            return last if request.sample == last.sample else None
        is_first = bool(request.flags & IS_FIRST)
        if last is not None and holds != self._holds:
            law, is_first = self._controllers[self._holds].law, True
            self._memory = controller.law.resume(self._memory, law, inputs["desired_state"])
        self._holds = holds
        force, self._memory = controller.step(
            inputs, self._memory, is_first=is_first, time=lambda: request.time
        )
        self._last = Packet(
            run=request.run, sample=request.sample, time=request.time, flags=0, values=force
        )
        return self._last


def _controller(scenario: Scenario) -> SampledController:
    controller = make_controller(scenario, make_nominal_plant(scenario))
    if not isinstance(controller, SampledController):
        raise FfsmError(f"{scenario.controller} is a Drake system, not a control law")
    return controller


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
