"""User-supplied blocks with one fault: shipped ones in which a method, from its nth call on, raises
an exception or returns something else. The faults are drawn by test_user_code.py.
"""

import asyncio
import dataclasses
import functools
from types import MappingProxyType
from typing import NamedTuple

import click
import numpy as np
from pydrake.systems.framework import LeafSystem

from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signal
from ffsm_drake.systems.registry import find_factory


class Fault(NamedTuple):
    """What fails: ``method`` of ``block`` ("controller tdc", "sensing", "part forces"), from its
    call number ``at`` on, by ``what`` of ERRORS or VALUES, in the ``part`` of its result.
    """

    block: str
    method: str
    at: int
    what: str
    part: int = 0


class Mute(Exception):
    """It has no text to give."""

    def __str__(self):
        raise RuntimeError("even this fails")


class OwnEnd(BaseException):
    """Not an Exception."""


ERRORS = {
    "value": lambda: ValueError("a text\nof two lines"),
    "key": lambda: KeyError(""),
    "zero": lambda: ZeroDivisionError(),
    "long": lambda: RuntimeError("x" * 10_000),
    "mute": Mute,
    "own_end": lambda: OwnEnd("the end"),
    "exit": lambda: SystemExit(0),
    "exit_text": lambda: SystemExit("done"),
    "ctrl_c": KeyboardInterrupt,
    "generator": GeneratorExit,
    "stop": lambda: StopIteration(5),
    "memory": lambda: MemoryError("no memory"),
    "recursion": lambda: RecursionError("too deep"),
    "cancelled": lambda: asyncio.CancelledError("cancelled"),
    "pipe": lambda: BrokenPipeError(32, "Broken pipe"),
    "os": lambda: OSError(28, "No space left on device"),
    "missing": lambda: ModuleNotFoundError("No module named 'x'"),
    "attribute": lambda: AttributeError("no attribute"),
    "not_implemented": lambda: NotImplementedError(),
    "click_exit": lambda: click.exceptions.Exit(0),
    "click_abort": click.Abort,
    "click": lambda: click.ClickException("odd"),
    "group": lambda: ExceptionGroup("several", [ValueError("a"), KeyError("b")]),
    "warning": lambda: UserWarning("as an exception"),
    "assertion": lambda: AssertionError(),
}
# Python functions of a good result, most of them made for an array.
VALUES = {
    "none": lambda good: None,
    "text": lambda good: "force",
    "digits": lambda good: np.full(np.shape(good), "1"),
    "bytes": lambda good: np.full(np.shape(good), b"1"),
    "flags": lambda good: np.full(np.shape(good), True),
    "dates": lambda good: np.full(np.shape(good), np.datetime64("2026-01-01")),
    "spans": lambda good: np.full(np.shape(good), np.timedelta64(3, "s")),
    "complex": lambda good: np.full(np.shape(good), 1.0 + 1e-3j),
    "objects": lambda good: np.full(np.shape(good), 1.0, dtype=object),
    "odd_objects": lambda good: np.full(np.shape(good), None, dtype=object),
    "records": lambda good: np.zeros(np.shape(good), dtype=[("a", float)]),
    "longer": lambda good: np.zeros(np.size(good) + 1),
    "empty": lambda good: np.zeros(0),
    "row": lambda good: np.zeros((1, np.size(good))),
    "matrix": lambda good: np.zeros((np.size(good), 2)),
    "number": lambda good: 3.0,
    "ragged": lambda good: [[1.0], [1.0, 2.0]],
    "huge": lambda good: np.broadcast_to(0.0, 10**12),
    "nested": lambda good: functools.reduce(lambda inner, _: [inner], range(200), 1.0),
    "class": lambda good: type(good),
    "function": lambda good: np.sin,
    "generator": lambda good: (x for x in range(3)),
    "tuple": lambda good: (1, 2, 3),
    "mapping": lambda good: {"a": 1},
    "odd_keys": lambda good: {3: np.zeros(2), None: 1},
    "taken": lambda good: {"generalized_force": np.zeros(11)},
    "array_fails": lambda good: Unarrayed(),
    "mapping_fails": lambda good: Unmapped(a=1),
    "object": lambda good: object(),
    "nan": lambda good: np.full(np.shape(good), np.nan),
    "infinite": lambda good: np.full(np.shape(good), np.inf),
    "zeros": lambda good: np.zeros(np.shape(good)),
}
# As good as the good result.
HARMLESS = {
    "single": lambda good: np.asarray(good, dtype=np.float32),
    "whole": lambda good: np.asarray(np.round(np.clip(good, -1e6, 1e6)), dtype=int),
    "list": lambda good: np.asarray(good).tolist(),
    "strided": lambda good: np.repeat(np.asarray(good, dtype=float), 2)[::2],
    "read_only": lambda good: _read_only(good),
    "masked": lambda good: np.ma.masked_invalid(good),
    "swapped": lambda good: np.asarray(good, dtype=">f8"),
}
FIRED = list[str]()  # what has failed since the list was emptied


class Unarrayed:
    def __array__(self, *arguments, **settings):
        raise RuntimeError("no array")


class Unmapped(dict):
    def keys(self):
        raise RuntimeError("no keys")

    def __iter__(self):
        raise RuntimeError("no names")


def _read_only(good):
    array = np.array(good, dtype=float)
    array.setflags(write=False)
    return array


def _broken(fault, good, given=()):
    """The result of a method that fails in the drawn way; ``good`` makes the right one."""
    FIRED.append(fault.what)
    if fault.what in ERRORS:
        raise ERRORS[fault.what]()
    if fault.what == "mutate":
        for array in _arrays(given):
            array[...] = 1e3
        return good()
    change, right = {**VALUES, **HARMLESS}[fault.what], good()
    if fault.method != "step" or fault.part == 0:
        return change(right)
    force, memory = right
    if fault.part == 1:
        return change(force), memory
    if fault.part == 2:
        return force, change(memory)
    if fault.part == 3 and memory:
        name = next(iter(memory))
        return force, {**memory, name: change(memory[name])}
    if fault.part == 4:
        return force, {**memory, "another": np.zeros(3)}
    return force, dict(list(memory.items())[1:])


def _arrays(given):
    for each in given:
        if isinstance(each, np.ndarray):
            yield each
        elif isinstance(each, tuple):
            yield from _arrays(each)
        elif isinstance(each, (dict, MappingProxyType)):
            yield from _arrays(tuple(each.values()))


def _faulty(fault, name, method):
    """A method, or a function, that fails from its nth call on if it is the one to fail."""
    if name != fault.method:
        return method
    calls = [0]

    @functools.wraps(method)
    def call(self, *given, **settings):
        calls[0] += 1
        if calls[0] <= fault.at:
            return method(self, *given, **settings)
        return _broken(fault, lambda: method(self, *given, **settings), given)

    return call


LAW_METHODS = (
    "step", "initial_state", "held", "resume", "from_setup", "__init__",
    "by_axis", "reaching_gain", "tracks_frame", "random_walks", "contacts_read", "starting_gains",
    "import",
)  # fmt: skip
BLOCK_METHODS = ("__init__", "factory", "calc", "set_initial_state", "set_payload", "import")
PART_METHODS = (
    "check", "check_plant", "build", "signals", "constants", "metrics", "metric", "limits",
    "linear", "sentence", "table", "calc", "title",
)  # fmt: skip


def make(fault):
    """The factory that a module offers."""
    kind, _, base = fault.block.partition(" ")
    if fault.method == "import":
        return _broken(fault, lambda: Pass)
    if kind == "controller":
        return _make_law(fault, find_factory("controller", base))
    if kind == "part":
        return _make_part(fault, base)
    return _make_block(fault, kind)


def _make_law(fault, base):
    methods = {}
    for name in LAW_METHODS:
        own = getattr(base, name, None)
        if name != fault.method or name == "import":
            continue
        if isinstance(vars_of(base).get(name), property):
            own = vars_of(base)[name].fget
            methods[name] = property(_faulty(fault, name, lambda self, own=own: own(self)))
        elif name in ("by_axis", "tracks_frame", "random_walks", "contacts_read"):
            methods[name] = property(_faulty(fault, name, lambda self, own=own: own))
        elif name in ("from_setup", "starting_gains"):
            function = own.__func__
            methods[name] = classmethod(_faulty(fault, name, function))
        elif own is not None:
            methods[name] = _faulty(fault, name, own)
    return type("Faulty", (base,), {**methods, "__module__": __name__})


def vars_of(kind):
    """Attributes of a class and its bases, as they are written."""
    found = {}
    for each in reversed(kind.__mro__):
        found |= vars(each)
    return found


class Pass(LeafSystem):
    """What every block here is made of: it gives ``value(context)``, a vector, on each port."""

    fault = None
    inputs, outputs = {}, {}

    def __init__(self, setup):
        super().__init__()
        self.setup = setup
        nv = len(setup.coordinates.names)
        sizes = {"state": 2 * nv + 1, "force": nv}
        for name, size in self.inputs.items():
            self.DeclareVectorInputPort(name, sizes[size])
        for name, size in self.outputs.items():
            self.DeclareVectorOutputPort(
                name, sizes[size], functools.partial(self.write, name, sizes[size])
            )

    def write(self, name, size, context, output):
        output.SetFromVector(self.calc(context, name, size))

    def calc(self, context, name, size):
        if self.inputs:
            return self.GetInputPort(next(iter(self.inputs))).Eval(context)[:size]
        return np.zeros(size)

    def set_initial_state(self, context, state):
        pass

    def set_payload(self, context, properties):
        pass


class Sensing(Pass):
    inputs, outputs = {"state": "state"}, {"estimated_state": "state"}


class Actuation(Pass):
    inputs, outputs = {"commanded_force": "force"}, {"applied_force": "force"}


class Forces(Pass):
    inputs, outputs = {}, {"generalized_force": "force"}


class Reference(Pass):
    inputs, outputs = {}, {"desired_state": "state", "desired_acceleration": "force"}

    def calc(self, context, name, size):
        posture = self.setup.scenario.initial_posture
        q = configuration(self.setup.nominal.coordinates, posture, key="initial_posture")
        state = np.concatenate([q, np.zeros(q.size - 1)])
        return state if name == "desired_state" else np.zeros(size)


BLOCKS = {"sensing": Sensing, "actuation": Actuation, "forces": Forces, "reference": Reference}


def _make_block(fault, kind):
    base = BLOCKS[kind]
    methods = {
        name: _faulty(fault, name, getattr(base, name))
        for name in BLOCK_METHODS
        if name == fault.method and hasattr(base, name)
    }
    made = type("Faulty", (base,), methods)
    return _faulty(fault, "factory", made) if fault.method == "factory" else made


def _make_part(fault, kind):
    system = _make_block(fault, kind)

    class Base(Part):
        @property
        def title(self):
            return "Title"

        def build(self, setup):
            return system(setup)

        def signals(self, setup):
            return (Signal(name=next(iter(system.outputs)), unit="N", meaning="own"),)[:0]

        def metrics(self):
            of = _faulty(fault, "metric", lambda run: 1.0)
            return (Metric(key="own.number", unit="1", label="Number", of=of),)

        def sentence(self, figures):
            return "A sentence."

    methods = {}
    for name in PART_METHODS:
        if name == fault.method and name not in ("metric", "calc"):
            own = getattr(Base, name)
            if isinstance(own, property):
                methods[name] = property(_faulty(fault, name, own.fget))
            else:
                methods[name] = _faulty(fault, name, own)
    made = type("Faulty", (Base,), {**methods, "slot": kind})
    return dataclasses.dataclass(frozen=True, kw_only=True)(made)
