"""A block as pure functions on arrays, and the Drake system around it.

The functions of a ``Sampled`` block are written once. ``SampledSystem`` calls them with numbers in
a Drake diagram. The plug-in ``compiled`` calls them with symbols (of the plug-in ``tape``).
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, System
from pydrake.systems.primitives import Demultiplexer

from ffsm_drake.common.errors import BlockError, choices
from ffsm_drake.common.guard import calling, is_user_supplied
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.returned import arrays, mapping, numbers
from ffsm_drake.scenario import MassProperties
from ffsm_drake.systems.setup import CompositeBlock, inputs_of, outputs_of

Arrays = Mapping[str, np.ndarray]  # by name
Ports = Mapping[str, int] | tuple[str, ...]


NO_PHASE: Sequence[Any] = ()
NEXT = "next_"  # of a held output's value at this instant, for the record


class Now(NamedTuple):
    """The control sample at which a block steps."""

    time: Any  # s
    phase: Sequence[Any] | np.ndarray = NO_PHASE  # what ``Sampled.phase`` returns for it
    is_first: bool = False  # for a control law: no sample before, or a grasp since


class Sampled:
    """A block that steps once in a control sample, or a force that steps ``per_sample`` times.

    It steps on what its inputs are at a sample. An actuator (``acts``) steps on the command that a
    sample makes, and on other inputs as they are at the sample (``latched``).

    A block that depends on the true payload has a method ``with_payload(properties)``, which
    returns it for other ``MassProperties``.

    A subclass is a frozen dataclass. Its arrays of floats may hold symbols in ``step``; all else is
    constant. ``step`` must depend on its arguments and fields alone, and change neither.

    Example:
      >>> from dataclasses import dataclass
      >>> import numpy as np
      >>> from ffsm_drake import Sampled, load_scenario, make_closed_loop
      >>> @dataclass(frozen=True, kw_only=True)
      ... class Offset(Sampled):
      ...     inputs, outputs = ("state",), ("estimated_state",)
      ...     offset: np.ndarray
      ...     @classmethod
      ...     def from_setup(cls, setup):
      ...         return cls(offset=np.full(2 * len(setup.coordinates.names) + 1, 1e-4))
      ...     def step(self, inputs, memory, now):
      ...         return {"estimated_state": inputs["state"] + self.offset}, memory
      >>> loop = make_closed_loop(load_scenario("postcapture"), blocks={"sensing.offset": Offset})
      >>> loop.blocks["sensing.offset"].get_name()
      'offset'
    """

    acts: ClassVar[bool] = False
    traced: ClassVar[bool] = True  # else Python calls it in compiled runs too
    optional: ClassVar[tuple[str, ...]] = ()  # inputs that another block may lack
    # steps of a force in a control sample, evenly; 0: it never steps, and its outputs are zero
    per_sample: int = 1

    @property
    def latched(self) -> Mapping[str, Sequence[float]]:
        """Inputs of an actuator that are no commands: their values before the first sample."""
        return {}

    @property
    def entries(self) -> Mapping[str, Sequence[int]]:
        """Entries of a latched input that ``step`` reads, if not all."""
        return {}

    @property
    def inputs(self) -> Ports:
        """Its input ports: their names, which are those of the loop; or numbers in each by name."""
        return ()

    @property
    def outputs(self) -> Ports:
        """Its output ports, likewise."""
        return ()

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """Its memory before the first sample, by name: vectors.

        Args: [q; v] (nq + nv) that the spacecraft had before, if it is known.
        """
        return {}

    def phase(self, sample: Any) -> Sequence[Any]:
        """Numbers that depend on the number of the control sample alone, such as whether a slow
        sensor measures; of an array of samples, arrays.
        """
        return ()

    @property
    def phase_period(self) -> int:
        """Control samples after which ``phase`` repeats."""
        return 1

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """Return the outputs at a sample, and the memory after it."""
        raise NotImplementedError(f"{type(self).__name__} has no step")


def sized(ports: Ports, usual: Mapping[str, int], place: str) -> dict[str, int]:
    """Return the numbers in each port by name.

    Args: ports; numbers in the ports of the loop; the block's name in errors.
    """
    if not isinstance(ports, Mapping | tuple | list):
        raise BlockError(f"{place}: ports are a tuple of names or sizes by name, not {ports!r}")
    found = dict(ports) if isinstance(ports, Mapping) else dict.fromkeys(ports)
    for name, size in found.items():
        if size is None and name not in usual:
            raise BlockError(f"{place}: unknown port '{name}'; known: {choices(name, usual)}")
        if size is not None and not (isinstance(size, int | np.integer) and size >= 0):
            raise BlockError(f"{place}: port '{name}' has a number of entries, not {size!r}")
    return {name: usual[name] if size is None else int(size) for name, size in found.items()}


def memory_of(block: Sampled, state: np.ndarray | None = None, *, place: str) -> Arrays:
    """Return the memory of a block before the first sample.

    Args: the block; [q; v] of the spacecraft then, if it is known; the block's name in errors.

    Raises BlockError: it fails, or is not numbers, or depends in its layout on the state.
    """
    found = calling(place, block.start, state)
    if not is_user_supplied(type(block)):
        return {name: np.asarray(value, dtype=float) for name, value in found.items()}
    at = f"{place}: start"
    given = mapping(found, at)
    shapes = {name: calling(at, np.shape, value) for name, value in given.items()}
    own = arrays(given, at, shapes=shapes)
    if state is None:
        return own
    usual = memory_of(block, place=place)
    if {name: value.shape for name, value in usual.items()} != shapes:
        raise BlockError(f"{at} must return the same names and shapes for a state as for None")
    return {name: own[name] for name in usual}


def phases_of(block: Sampled, samples: int, *, place: str) -> np.ndarray:
    """Return the phase of a block at each of so many samples (samples, n). Raises BlockError."""
    if not is_user_supplied(type(block)):
        columns = block.phase(np.arange(samples))
        return np.array(columns, dtype=float).reshape(len(columns), samples).T
    rows = [calling(place, _phase, block, sample) for sample in range(samples)]
    size = len(rows[0]) if rows else 0
    return np.array([numbers(row, (size,), f"{place}: phase", kinds="fiub") for row in rows])


def _phase(block: Sampled, sample: int) -> tuple[Any, ...]:
    return tuple(block.phase(sample))


class DividedSystem(CompositeBlock):
    """A system with an output ``result``, of which parts are outputs.

    With several outputs, Drake would call a block for each of them.
    """

    def __init__(
        self, name: str, own: "BlockSystem", sizes: Sequence[int], parts: Sequence[str]
    ) -> None:
        """Args: name; the system; sizes of all parts of its result; names of the first, "" of one
        that is no output.
        """
        systems: dict[str, System] = {own.get_name(): own}
        signals = {own.get_name(): {"result": parts[0]}}
        if len(sizes) > 1:  # Drake calls what reads a part anew at every stage
            systems["parts"] = Demultiplexer(sizes)
            named = {f"y{index}": part for index, part in enumerate(parts)}
            signals = {"parts": {"u0": "result", **named}}
        held = outputs_of(own).keys() - {"result"}
        shown = [*sorted(held), *filter(None, parts)]
        super().__init__(name, systems, inputs=inputs_of(own), outputs=shown, signals=signals)
        self._own: Any = own


class SampledSystem(DividedSystem):
    """The Drake system of a ``Sampled`` block.

    Discrete state, updated every ``sample_time``: the block's memory, a group for each name; of an
    actuator also its latched inputs and phase. Its memory is brought up to date at the next sample,
    since its command changes at this one. Outputs that are ``held`` are state too; ``next_NAME``
    has the value at this instant, unless the block has an output of this name, or steps several
    times in a sample.
    """

    def __init__(
        self,
        block: Sampled,
        *,
        name: str,
        sample_time: float,
        usual: Mapping[str, int] = {},
        place: str = "",
        held: bool = False,
    ) -> None:
        """Args:
          block: the block.
          name: of the system.
          sample_time: the control period, s.
          usual: numbers in the ports of the loop.
          place: name of the block in errors; default: the system's name.
          held: hold the outputs from a sample to the next.

        Raises BlockError: a user-supplied block fails, or returns what it should not.
        """
        place = place or name
        ports = (calling(place, getattr, block, name) for name in ("inputs", "outputs"))
        inputs, outputs = (sized(of, usual, place) for of in ports)
        own = _Stepping(block, inputs, outputs, sample_time, place, held=held)
        own.set_name(f"{name}_at_samples")
        parts = list[str]()
        for each in outputs:
            now = NEXT + each if own.HasOutputPort(each) else each
            is_shown = now == each or (now not in outputs and block.per_sample == 1)
            parts.append(now if is_shown else "")
        super().__init__(name, own, own.widths, parts)

    @property
    def block(self) -> Sampled:
        """The block."""
        return self._own.block

    def memory(self, context: Context) -> Arrays:
        """Return a copy of the block's memory."""
        return self._own.memory(self.GetSubsystemContext(self._own, context))

    def remember(self, context: Context, memory: Arrays) -> None:
        """Set the block's memory."""
        self._own.remember(self.GetMutableSubsystemContext(self._own, context), memory)


class BlockSystem(LeafSystem):
    """A system around a block, which may depend on the true payload: a parameter of the context."""

    def __init__(self, block: Any) -> None:
        """Args: the block; for payloads, it has a method ``with_payload``."""
        super().__init__()
        self._block, self._loaded = block, hasattr(block, "with_payload")
        self._payload: tuple[MassProperties, ...] = ()  # of the block
        if self._loaded:
            # a tuple: None is no value of Drake on Python 3.13
            self._given = self.DeclareAbstractParameter(AbstractValue.Make(()))

    def set_payload(self, context: Context, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        if self._loaded:
            context.get_mutable_abstract_parameter(self._given).set_value((properties,))

    def exchange(self, block: Any) -> None:
        """Put another block with the same ports in its place."""
        self._block, self._payload = block, ()

    def block_at(self, context: Context) -> Any:
        """Return the block with the payload of a context."""
        if self._loaded:
            given = context.get_abstract_parameter(self._given).get_value()
            if given and given != self._payload:
                self._payload, self._block = given, self._block.with_payload(*given)
        return self._block


class _Stepping(BlockSystem):
    """The functions of ``SampledSystem``; one output with the block's outputs and the memory after
    the sample, each of ``widths`` numbers.
    """

    def __init__(
        self,
        block: Sampled,
        inputs: Mapping[str, int],
        outputs: Mapping[str, int],
        sample_time: float,
        place: str,
        *,
        held: bool,
    ) -> None:
        super().__init__(block)
        self._sample_time, self._place = sample_time, place
        self._is_checked = is_user_supplied(type(block))
        self._acts, self._optional = block.acts, block.optional
        memory = memory_of(block, place=place)
        phase = phases_of(block, 1, place=place)[0]
        self._is_phased = phase.size > 0
        ports = {each: self.DeclareVectorInputPort(each, size) for each, size in inputs.items()}
        self._latched = {
            each: (ports.pop(each), self._state(value), list(block.entries.get(each, ())) or None)
            for each, value in block.latched.items()
        }
        self._inputs = ports
        self._memory = {each: self._state(value) for each, value in memory.items()}
        if self._is_phased and self._acts:
            self._phase = self.DeclareDiscreteState(phase)
        self._held = {
            each: self._state(np.zeros(size))
            for each, size in outputs.items()
            if held and not each.startswith(NEXT)
        }
        self._outputs = tuple(outputs)
        self._sizes = [*outputs.items(), *((each, value.size) for each, value in memory.items())]
        self._declare_result()
        for each, group in self._held.items():
            if block.per_sample:
                self.DeclareStateOutputPort(each, group)
            else:
                size = outputs[each]
                self.DeclareVectorOutputPort(each, size, _no_force, {self.nothing_ticket()})
        if block.per_sample and (memory or self._acts or held):
            period = sample_time / block.per_sample
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, weak_callback(self._update))
        untie(self)

    def _declare_result(self) -> None:
        """Declare the output with what a step returns, and where each part is in it."""
        self.widths = [size for _, size in self._sizes]
        ends = np.cumsum([0, *self.widths]).tolist()
        places = [slice(*pair) for pair in itertools.pairwise(ends)]
        self._places = dict(zip(self._outputs, places, strict=False))
        self._kept = dict(zip(self._memory, places[len(self._outputs) :], strict=True))
        reads = {self.input_port_ticket(port.get_index()) for port in self._inputs.values()}
        if self._loaded:
            reads.add(self.all_parameters_ticket())
        if self._memory or self._acts:
            reads.add(self.xd_ticket())
        if not self._acts:
            reads.add(self.time_ticket())
        self._result = self.DeclareVectorOutputPort(
            "result", ends[-1], weak_callback(self._calc_result), reads
        )

    def _state(self, value: Sequence[float] | np.ndarray) -> Any:
        return self.DeclareDiscreteState(np.ravel(value))

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The spacecraft was at ``state`` [q; v] before the start."""
        self._set(context, memory_of(self.block_at(context), state, place=self._place))

    @property
    def block(self) -> Any:
        """The block."""
        return self._block

    def memory(self, context: Context) -> Arrays:
        """See SampledSystem."""
        value = context.get_discrete_state().value
        return {name: value(group).copy() for name, group in self._memory.items()}

    def remember(self, context: Context, memory: Arrays) -> None:
        """See SampledSystem."""
        self._set(context, memory)

    def _set(self, context: Context, memory: Arrays) -> None:
        for name, group in self._memory.items():
            context.SetDiscreteState(group, np.ravel(memory[name]))

    @property
    def phase_period(self) -> int:
        """Control samples after which ``phase`` repeats."""
        return self._block.phase_period

    def phase(self, sample: int) -> tuple[Any, ...]:
        """Phase of the block at a control sample."""
        return tuple(self._block.phase(sample))

    def _calc_result(self, context: Context, output: BasicVector) -> None:
        block = self.block_at(context)
        time, value = context.get_time(), context.get_discrete_state().value
        inputs = {
            name: port.Eval(context)
            for name, port in self._inputs.items()
            if name not in self._optional or port.HasValue(context)
        }
        inputs |= {name: value(group) for name, (_, group, _) in self._latched.items()}
        memory = {name: value(group) for name, group in self._memory.items()}
        phase = NO_PHASE
        if self._is_phased:
            phase = value(self._phase) if self._acts else self._phase_of(context)
        output.SetFromVector(np.concatenate(self._stepped(block, inputs, memory, Now(time, phase))))

    def _sample(self, context: Context) -> int:
        return round(context.get_time() / self._sample_time)

    def _phase_of(self, context: Context) -> Sequence[Any]:
        if self._is_checked:
            return tuple(calling(self._place, self._block.phase, self._sample(context)))
        return self._block.phase(self._sample(context))

    def _stepped(self, block: Sampled, inputs: Arrays, memory: Arrays, now: Now) -> list[Any]:
        """The block's outputs, then its memory, in the order of ``_sizes``."""
        if not self._is_checked:
            outputs, memory = block.step(inputs, memory, now)
            return [*(outputs[name] for name in self._outputs), *map(memory.get, self._kept)]
        for each in (*inputs.values(), *memory.values()):
            each.setflags(write=False)
        returned = calling(self._place, block.step, inputs, memory, now, time=now.time)
        return _checked(returned, self._sizes, len(self._outputs), self._place, now.time)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        if not self._acts or self._sample(context) > 0:
            result = self._result.Eval(context)
            for name, place in self._kept.items():
                values.set_value(self._memory[name], result[place])
            for name, group in self._held.items():
                values.set_value(group, result[self._places[name]])
        for port, group, entries in self._latched.values():
            read = port.Eval(context)
            if entries is not None:
                read = read[entries]
            values.set_value(group, read)
        if self._acts and self._is_phased:
            values.set_value(self._phase, np.array(self._block.phase(self._sample(context))))


def _no_force(context: Context, output: BasicVector) -> None:
    output.SetFromVector(np.zeros(output.size()))


def _checked(
    returned: Any, sizes: Sequence[tuple[str, int]], count: int, place: str, time: float
) -> list[np.ndarray]:
    """The results of a user-supplied ``step``: so many outputs, then the memory. Raises BlockError
    for other names or sizes.
    """
    at = f"{place}: step at t = {time:.2f} s"
    if not (isinstance(returned, tuple) and len(returned) == 2):
        raise BlockError(f"{at} must return (outputs, memory), two mappings from names to vectors")
    made = list[np.ndarray]()
    for given, wanted, of in zip(
        returned, (sizes[:count], sizes[count:]), ("outputs", "memory"), strict=True
    ):
        found = arrays(given, at, of=of, shapes={name: (size,) for name, size in wanted})
        made += [found[name] for name, _ in wanted]
    return made
