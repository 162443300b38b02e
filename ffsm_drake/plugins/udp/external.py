"""The controller of a scenario in another process: ``controller:
ffsm_drake.plugins.udp.external:External``.

At every control sample the simulation sends the controller's inputs and waits for the force.
Without a fault the run has the bits of one with the law itself. If no reply comes in time, the
last force is held. Late, repeated and damaged replies are dropped. The record counts all of them
at every sample (``link_faults``). Another address is that of a subclass:

    class Mine(External):
        host = "10.0.0.2"
"""

import dataclasses
import os
import socket
import time
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.plugins.udp.packets import (
    FLAG_OF,
    HAS_FRAME,
    HAS_NEW,
    HOLDS,
    IS_FIRST,
    LARGEST,
    MOST_PORT,
    Packet,
    open_socket,
    read,
    request_sizes,
)
from ffsm_drake.systems.controllers.law import Gain, gain_values
from ffsm_drake.systems.parts.metrics import Figure, Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import STEPS, Signal, View
from ffsm_drake.systems.setup import BlockSetup

LOST, LATE, DOUBLED, REFUSED = FAULTS = ("lost", "late", "doubled", "refused")


def _number(default: float, unit: str, meaning: str, **limits: Any) -> Any:
    declared = Gain(
        default=default, unit=unit, meaning=meaning, scalar=True, bound=False, feedback=False,
        **limits,
    )  # fmt: skip
    return dataclasses.field(default=default, metadata={"setting": declared})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings under ``controllers.External``, one number each."""

    port: float = _number(5020.0, "", "UDP port of the other process", least=1, most=MOST_PORT)
    timeout: float = _number(0.05, "s", "longest wait for a reply", above=0, most=86_400)
    connect: float = _number(10.0, "s", "longest wait for the first reply", above=0, most=86_400)
    real_time: float = _number(0.0, "", "1: no sample is sent before its time", least=0, most=1)

    @classmethod
    def of(cls, setup: BlockSetup) -> "Settings":
        """The settings of a scenario. Raises ScenarioError: a value or a key is wrong."""
        given = gain_values(cls, setup.settings, setup.coordinates, name=setup.name)
        made = cls(**{name: float(value) for name, value in given.items()})
        for name in ("port", "real_time"):
            if (value := getattr(made, name)) != int(value):
                key = f"controllers.{setup.name}.{name}"
                raise ScenarioError(key, f"must be a whole number, not {value:g}")
        return made


@dataclasses.dataclass(frozen=True, kw_only=True)
class Link(Part):
    """The packets of an external controller, as a run's record counts them."""

    title: ClassVar[str] = "External controller"
    about: ClassVar[str] = "Replies that were lost, late, doubled or refused."

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        return (
            Signal(
                name="link_faults", unit="1", components=FAULTS, chart=STEPS,
                meaning="no reply in time (the force is held), and replies dropped at this sample",
            ),
        )  # fmt: skip

    def metrics(self) -> Sequence[Metric]:
        def count(index: int) -> Any:
            return lambda run: int(run["link_faults"][:, index].sum())

        def samples(run: View) -> int:
            return len(run.time)

        return (
            *(
                Metric(key=f"link.{name}", unit="1", label=f"Packets {name}", of=count(index))
                for index, name in enumerate(FAULTS)
            ),
            Metric(key="link.samples", unit="1", column="", of=samples),
        )

    def sentence(self, figures: Sequence[Figure]) -> str:
        """The counts of a run with faults."""
        found: dict[str, Any] = {each.key.partition(".")[2]: each.value for each in figures}
        if not any(found.get(name) for name in FAULTS):
            return ""
        dropped = ", ".join(f"{found[name]} {name}" for name in FAULTS[1:])
        return (
            f"{self.title}: no reply in time at {found[LOST]} of {found['samples']} samples, where "
            f"the last force was held; replies dropped: {dropped}"
        )


class External(LeafSystem):
    """A controller whose force another process computes, at every control sample.

    Inputs: as ``SampledController``. Outputs: generalized_force (nv), held over the period;
    link_faults (4), the counts of FAULTS at the last sample. It cannot be linearised, as the other
    process has a memory of its own.
    """

    host: ClassVar[str] = "127.0.0.1"  # address of the external controller; default: this machine
    # whether it gets the path of ``reference.frame``, and is evaluated by the frame's pose
    tracks_frame: ClassVar[bool] = False

    def __init__(self, setup: BlockSetup) -> None:
        """Raises ScenarioError: a setting is unknown or out of its range; FfsmError: there is no
        such host.
        """
        super().__init__()
        self.part = Link()
        self._settings, self._period = Settings.of(setup), setup.sample_time
        self._connected().close()
        self._phase = HOLDS * setup.grip.holds
        self.set_name(setup.name)
        nv, nq = len(setup.coordinates.names), len(setup.coordinates.position_names)
        self._undriven = np.flatnonzero(~setup.coordinates.is_driven)
        sizes = request_sizes(nq, nv, HAS_NEW | HAS_FRAME * self.tracks_frame)
        self._ports = {name: self.DeclareVectorInputPort(name, n) for name, n in sizes.items()}
        self._force = self.DeclareDiscreteState(nv)
        # number of the run, 0 before the first sample; flag HOLDS of the last sample
        self._before = self.DeclareDiscreteState(2)
        self._faults = self.DeclareDiscreteState(len(FAULTS))
        self.DeclareAbstractState(Value(0))  # the other process's: nothing to linearise
        self.DeclareStateOutputPort("generalized_force", self._force)
        self.DeclareStateOutputPort("link_faults", self._faults)
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
            self._link = _Link(self._settings, self._connected(), run=int(run), first=sample)
        is_first = is_new or phase != self._phase
        flags, values = self._phase | IS_FIRST * is_first, []
        for name, port in self._ports.items():
            if port.HasValue(context):
                flags |= FLAG_OF.get(name, 0)
                values.append(port.Eval(context))
            elif name == "applied_force":
                values.append(state.value(self._force))
        packet = Packet(
            run=int(run), sample=sample, time=context.get_time(), flags=flags,
            values=np.concatenate(values),
        )  # fmt: skip
        force = self._link.exchange(packet, size=state.value(self._force).size, is_new=is_new)
        discrete_values.set_value(self._before, [run, self._phase])
        discrete_values.set_value(self._faults, [self._link.faults[name] for name in FAULTS])
        if force is not None:
            force[self._undriven] = 0.0
            discrete_values.set_value(self._force, force)

    def _connected(self) -> socket.socket:
        place = f"controller '{self.get_name() or type(self).__name__}': host"
        return open_socket("connect", self.host, int(self._settings.port), key=place)


class _Link:
    """The connection of one phase of a run."""

    def __init__(self, settings: Settings, made: socket.socket, *, run: int, first: int) -> None:
        """``made`` is connected with the other process; ``first`` is the first sample."""
        self.run, self._settings, self._socket, self._first = run, settings, made, first
        self.faults = dict.fromkeys(FAULTS, 0)  # at the last sample
        self._lost = set[int]()  # samples whose reply may still come
        self._begin: float | None = None
        self._asked_again, self._again = -1, 0  # sample of the first request; how often again

    def __del__(self) -> None:
        self._socket.close()

    def exchange(self, packet: Packet, *, size: int, is_new: bool) -> np.ndarray | None:
        """The force (size) of a request; None: none came in time. ``faults`` counts what came
        instead.

        Raises BlockError: nothing answers the first request (``is_new``).
        """
        sample, at = packet.sample, packet.time
        self.faults = dict.fromkeys(FAULTS, 0)
        if self._settings.real_time and self._begin is not None:
            time.sleep(max(0.0, self._begin + at - time.monotonic()))
        longest = self._settings.connect if is_new else self._settings.timeout
        deadline = time.monotonic() + longest
        self._send(packet)
        while (left := deadline - time.monotonic()) > 0.0:
            data = self._receive(min(left, 0.1) if is_new else left)
            if data is None:
                if is_new:  # nobody may have listened yet
                    self._send(packet)
                    self._again += 1
                continue
            reply = read(data)
            if reply is None or not self._is_sound(reply, sample, size):
                self.faults[REFUSED] += 1
            elif reply.sample == sample:
                if is_new:
                    self._asked_again = sample
                if self._begin is None:
                    self._begin = time.monotonic() - at
                return reply.values
            elif reply.sample in self._lost:
                self._lost.remove(reply.sample)
                self.faults[LATE] += 1
            elif reply.sample == self._asked_again and self._again:
                self._again -= 1  # one of the replies to a request that was sent again
            else:
                self.faults[DOUBLED] += 1
        if is_new:
            host, port = self._socket.getpeername()
            refused = self.faults[REFUSED]
            problem = (
                f"the external controller at {host}:{port} sent {refused} packets without a force "
                f"of {size} finite numbers; check that it flies this spacecraft"
                if refused
                else f"no external controller answers at {host}:{port}; start it, such as by "
                "'python -m ffsm_drake.plugins.udp.fly SCENARIO'"
            )
            raise BlockError(problem)
        self._lost.add(sample)
        self.faults[LOST] = 1
        return None

    def _is_sound(self, reply: Packet, sample: int, size: int) -> bool:
        """Whether a packet is a force (size) for this or an earlier sample of the run."""
        belongs = reply.run == self.run and self._first <= reply.sample <= sample
        return belongs and reply.values.size == size and reply.is_usable

    def _send(self, packet: Packet) -> None:
        try:
            self._socket.send(packet.to_bytes())
        except OSError:  # such as the answer to an earlier packet: nobody listens
            time.sleep(0.01)

    def _receive(self, longest: float) -> bytes | None:
        self._socket.settimeout(longest)
        try:
            return self._socket.recv(LARGEST)
        except TimeoutError:
            return None
        except OSError:
            time.sleep(0.01)
            return None
