"""The controller of a scenario in another process: ``controller:
ffsm_drake.plugins.udp.external:External``.

At every control sample the simulation sends the controller's inputs and waits for the force.
Without a fault the run has the bits of one with the law itself. If no reply comes in time, the
last force is held. Late and repeated replies are dropped. Every fault is a row of
``udp_faults.csv`` in the current folder. Another address or file is that of a subclass:

    class Mine(External):
        host, log = "10.0.0.2", "out/faults.csv"
"""

import csv
import dataclasses
import os
import socket
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.plugins.udp.packets import (
    FRAME,
    HAS_FRAME,
    HAS_NEW,
    HOLDS,
    IS_FIRST,
    LARGEST,
    Packet,
    read,
)
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings under ``controllers.External``, one number each."""

    port: float = 5020.0
    timeout: float = 0.05  # s that the simulation waits for a reply
    connect: float = 10.0  # s for the first one
    real_time: float = 0.0  # 1: samples are sent no sooner than their time


class External(LeafSystem):
    """A controller whose force another process computes, at every control sample.

    Inputs: as ``SampledController``. Output: generalized_force (nv), held over the period. It
    cannot be linearised, as the other process has a memory of its own.
    """

    host: ClassVar[str] = "127.0.0.1"  # address of the external controller; default: this machine
    # whether it gets the path of ``reference.frame``, and is evaluated by the frame's pose
    tracks_frame: ClassVar[bool] = False
    log: ClassVar[str] = "udp_faults.csv"  # sample, time (s) and kind of every fault

    def __init__(self, setup: BlockSetup) -> None:
        """Raises BlockError: an unknown setting."""
        super().__init__()
        known = {field.name for field in dataclasses.fields(Settings)}
        if unknown := sorted({*setup.settings} - known):
            raise BlockError(
                f"controllers.{setup.name}.{unknown[0]}: unknown; there are "
                f"{', '.join(sorted(known))}"
            )
        given = {name: setup.settings[name]["all"] for name in setup.settings}
        self._settings, self._period = Settings(**given), setup.sample_time
        self._phase = HOLDS * setup.scenario.holds
        self.set_name(setup.name)
        nv, nq = len(setup.coordinates.names), len(setup.coordinates.position_names)
        self._undriven = np.flatnonzero(~setup.coordinates.is_driven)
        self._needed = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("estimated_state", nq + nv),
                ("desired_state", nq + nv),
                ("desired_acceleration", nv),
                ("applied_force", nv),
            )
        ]
        self._optional = {HAS_NEW: self.DeclareVectorInputPort("measurement_is_new", nq + nv)}
        if self.tracks_frame:
            self._optional[HAS_FRAME] = self.DeclareVectorInputPort("desired_frame", FRAME)
        self._force = self.DeclareDiscreteState(nv)
        # number of the run, 0 before the first sample; flag HOLDS of the last sample
        self._before = self.DeclareDiscreteState(2)
        self.DeclareAbstractState(Value(0))  # the other process's: nothing to linearise
        self.DeclareStateOutputPort("generalized_force", self._force)
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, weak_callback(self._update))
        self._link: _Link | None = None
        untie(self)

    def _update(self, context: Context, discrete_values: DiscreteValues) -> None:
        state = context.get_discrete_state()
        sample, (run, phase) = round(context.get_time() / self._period), state.value(self._before)
        is_new = run == 0.0
        if is_new:
            run = float(1 + int.from_bytes(os.urandom(6), "little"))
        if self._link is None or self._link.run != run:  # each phase has a system, and a link
            self._link = _Link(self._settings, host=self.host, log=Path(self.log), run=int(run))
        if sample == 0:
            Path(self.log).unlink(missing_ok=True)  # an earlier run's
        is_first = is_new or phase != self._phase
        flags, values = self._phase | IS_FIRST * is_first, []
        for port in self._needed:
            values.append(
                port.Eval(context) if port.HasValue(context) else state.value(self._force)
            )
        for flag, port in self._optional.items():
            if port.HasValue(context):
                flags |= flag
                values.append(port.Eval(context))
        packet = Packet(
            run=int(run), sample=sample, time=context.get_time(), flags=flags,
            values=np.concatenate(values),
        )  # fmt: skip
        force = self._link.exchange(packet, size=self._force_size(state), is_new=is_new)
        discrete_values.set_value(self._before, [run, self._phase])
        if force is not None:
            force[self._undriven] = 0.0
            discrete_values.set_value(self._force, force)

    def _force_size(self, state: DiscreteValues) -> int:
        return int(state.value(self._force).size)


class _Link:
    """The connection of one phase of a run."""

    def __init__(self, settings: Settings, *, host: str, log: Path, run: int) -> None:
        self.run, self._settings, self._log = run, settings, log
        self._place = (host, int(settings.port))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(self._place)
        self._answered: set[int] = set()
        self._begin: float | None = None
        self._asked_again, self._again = -1, 0  # sample of the first request; how often again

    def __del__(self) -> None:
        if hasattr(self, "_socket"):
            self._socket.close()

    def exchange(self, packet: Packet, *, size: int, is_new: bool) -> np.ndarray | None:
        """The force (size) of a request; None: none came in time.

        Raises BlockError: nothing answers the first request (``is_new``), or a force is not finite.
        """
        sample, at = packet.sample, packet.time
        if self._settings.real_time and self._begin is not None:
            time.sleep(max(0.0, self._begin + at - time.monotonic()))
        longest = self._settings.connect if is_new else self._settings.timeout
        deadline = time.monotonic() + longest
        self._send(packet)
        while (left := deadline - time.monotonic()) > 0.0:
            reply = self._receive(min(left, 0.1) if is_new else left)
            if reply is None:
                if is_new:  # nobody may have listened yet
                    self._send(packet)
                    self._again += 1
                continue
            if reply.run != self.run:
                continue
            if reply.sample != sample:
                is_known = reply.sample in self._answered
                if is_known and reply.sample == self._asked_again and self._again:
                    self._again -= 1  # one of the replies to a request that was sent again
                else:
                    self._note(sample, at, "doubled" if is_known else "late")
                continue
            if reply.values.size != size or not np.isfinite(reply.values).all():
                raise BlockError(
                    f"the external controller's force at t = {at:.2f} s must be {size} finite "
                    "numbers"
                )
            self._answered.add(sample)
            if is_new:
                self._asked_again = sample
            if self._begin is None:
                self._begin = time.monotonic() - at
            return reply.values
        if is_new:
            raise BlockError(
                "no external controller answers at {}:{}; start it, such as by 'python -m "
                "ffsm_drake.plugins.udp.fly SCENARIO'".format(*self._place)
            )
        self._note(sample, at, "lost")
        return None

    def _send(self, packet: Packet) -> None:
        try:
            self._socket.send(packet.to_bytes())
        except ConnectionRefusedError:  # the answer to an earlier packet: nobody listens
            time.sleep(0.01)

    def _receive(self, longest: float) -> Packet | None:
        self._socket.settimeout(longest)
        try:
            return read(self._socket.recv(LARGEST))
        except TimeoutError:
            return None
        except ConnectionRefusedError:
            time.sleep(0.01)
            return None

    def _note(self, sample: int, at: float, fault: str) -> None:
        is_new = not self._log.exists()
        with self._log.open("a", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            if is_new:
                rows.writerow(["sample", "time", "fault"])
            rows.writerow([sample, f"{at:.6f}", fault])
