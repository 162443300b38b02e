"""The blocks of a scenario, made as pure functions for a compiled run."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ffsm_drake.common.guard import calling
from ffsm_drake.common.registrations import Registry
from ffsm_drake.loop.blocks import DISTURBANCE, factory_of
from ffsm_drake.plugins.compiled.followed_reference import FollowedReference
from ffsm_drake.plugins.compiled.parts import Block, Parts, frozen
from ffsm_drake.plugins.compiled.supervising import Supervised, Supervisor
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import Block as Choice
from ffsm_drake.scenario import Scenario, kind_of
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.placed import PlacedPart
from ffsm_drake.systems.registry import Factory, call_factory, section_parts
from ffsm_drake.systems.sampled import Sampled
from ffsm_drake.systems.sensing.block import measurement_of
from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.setup import BlockSetup

_DETECTION = "sensing.detection"
# Of a scenario: its actuators in a row, after saturation, quantisation and delay, and those beside.
ActingBlocks = Callable[[Scenario, Coordinates], tuple[Sequence[Sampled], Sequence[Continuous]]]
ACTING_BLOCKS = Registry[ActingBlocks]("acting_blocks")


class ScenarioBlocks:
    """The blocks of a scenario, or of a phase in their place, except the controller."""

    def __init__(
        self,
        plain: BlockSetup,
        errors: SensorErrors,
        given: Mapping[str, Factory],
        acting: ActingBlocks | None = None,
    ) -> None:
        """Args:
          plain: what blocks are made from, with the faults drawn; names and settings follow.
          errors: of the sensors.
          given: factories of blocks in place of the scenario's.
          acting: makes the actuators in place of the scenario's.

        Raises NotCovered: a block is a Drake system, or is not traced.
        """
        self._plain, self._given = plain, given
        self._acting_blocks = acting or ACTING_BLOCKS.first()
        self.built = set[str]()  # names of blocks that are made here
        self._shown = list[str]()  # outputs of forces in a record
        stages = measurement_of(errors), *_of(Sampled, self._made("sensing")).values()
        self.detector = None if stages[-1].traced else stages[-1]
        forces = self._made("forces")
        self.reference = self._reference()
        self.supervisor = self._supervisor()
        self.watch = None if self.supervisor is None else self.supervisor.block
        actuators, flows = self._acting()
        self.external = tuple(forces)  # names of the forces beside the disturbance
        self.parts = Parts(
            sensing=_numbered([each for each in stages if each.traced]),
            actuation=_numbered(actuators),
            flows=_numbered(flows),
            forces=_of(Sampled, forces),
            last=_of(Continuous, forces),
            supervisor=frozen(
                {"supervisor": self.watch} if isinstance(self.watch, Sampled) else {}
            ),
        )
        self.placed = self._placed()

    def _placed(self) -> dict[str, PlacedPart]:
        """The parts of the loop by name, with the settings and signals of this scenario; see
        ``make_blocks``.
        """
        scenario = self._plain.scenario
        choices, found = scenario.blocks.choices(), dict[str, PlacedPart]()
        own = section_parts(scenario, self._given, grip=self._plain.nominal.grip)
        others = {*choices, *self._given} & {*self.built, "supervisor"} - {*own}
        for name in (*own, *sorted(others)):
            is_own = name in own
            part = own[name] if is_own else factory_of(name, scenario, self._given.get(name))
            if not isinstance(part, Part):
                continue
            settings = choices.get(name, Choice()).settings
            setup = self.setup(name if is_own else name.rpartition(".")[2], settings)
            place = f"blocks.{name} '{type(part).__name__}'"
            signals = calling(place, lambda part=part, setup=setup: tuple(part.signals(setup)))
            constants = calling(place, lambda part=part, setup=setup: tuple(part.constants(setup)))
            if kind_of(name) == "sensing":
                signals = tuple(dataclasses.replace(each, held=True) for each in signals)
            if signals or not is_own:
                block = name if name in self.built else kind_of(name)
                found[name] = PlacedPart(
                    name=name, block=block, part=part, signals=signals, constants=constants
                )
        return found

    def recorded(self, scenario: Scenario) -> tuple[str, ...]:
        """Signals of the actuators and forces of a scenario."""
        parts = section_parts(scenario, of="actuation").values()
        setup = self.setup("actuation")
        names = [signal.name for part in parts for signal in part.signals(setup)]
        return *names, *self._shown

    def setup(self, name: str, settings: Mapping[str, Any] = {}) -> BlockSetup:
        """What a block is made from, with its name and settings."""
        return dataclasses.replace(self._plain, name=name, settings=settings)

    def _factory(self, block: str, parts: Mapping[str, Part]) -> Factory:
        """What makes a block: of a phase, of a section (``parts``), or of the scenario's choice; a
        part has its settings.
        """
        if block in parts and block not in self._given:
            return parts[block]
        return factory_of(block, self._plain.scenario, self._given.get(block))

    def _made(self, kind: str) -> dict[str, Sampled | Continuous]:
        """The blocks of a kind in addition to the first one, by name."""
        scenario, found = self._plain.scenario, dict[str, Sampled | Continuous]()
        choices = scenario.blocks.choices()
        parts = section_parts(scenario, grip=self._plain.nominal.grip)
        for block in dict.fromkeys((*parts, *choices, *self._given)):
            first, _, name = block.partition(".")
            if first != kind or not name or block == DISTURBANCE:
                continue
            choice = choices.get(block, Choice())
            factory = self._factory(block, parts)
            setup, place = self.setup(name, choice.settings), f"blocks.{block} '{choice.system}'"
            # of a part, ``flow`` has pure functions in place of a Drake system
            made = call_factory(getattr(factory, "flow", factory), setup, place=place)
            if isinstance(factory, Part) and kind == "forces":
                self._shown += [each.name for each in factory.signals(setup)]
                self._shown += factory.logged
            is_last = kind == "forces" and isinstance(made, Continuous) and not made.start()
            if not (isinstance(made, Sampled) or is_last):
                raise NotCovered(block)
            if isinstance(made, Sampled) and not made.traced and block != _DETECTION:
                raise NotCovered(f"{block}, which is not traced")
            found[name] = made
            self.built.add(block)
        return found

    def _acting(self) -> tuple[tuple[Sampled, ...], tuple[Continuous, ...]]:
        """The actuators after limits, quantisation and delay, and the flows beside them."""
        if self._acting_blocks is None:
            return (), ()
        row, beside = self._acting_blocks(self._plain.scenario, self._plain.coordinates)
        return tuple(row), tuple(beside)

    def _supervisor(self) -> Supervisor | None:
        """The supervisor; None: there is none."""
        parts = section_parts(self._plain.scenario)
        if "supervisor" not in {*parts, *self._given}:
            return None
        part = self._factory("supervisor", parts)
        setup = self.setup("supervisor")
        return part.supervisor(setup) if isinstance(part, Supervised) else None

    def _reference(self) -> FollowedReference | None:
        """A reference of blocks without inputs; None: the motion."""
        if "reference" not in self._given:
            return None
        factory = self._factory("reference", {})
        setup = self.setup("reference")
        made = call_factory(factory, setup, place="blocks.reference")
        if not isinstance(made, Sampled) or made.inputs:
            raise NotCovered("blocks.reference")
        signals = factory.signals(setup) if isinstance(factory, Part) else ()
        self.built.add("reference")
        return FollowedReference(made, {signal.name: signal.held for signal in signals})


def _numbered(blocks: Sequence[Block]) -> Mapping[str, Block]:
    return frozen({str(index): each for index, each in enumerate(blocks)})


def _of(kind: type[Block], blocks: Mapping[str, Sampled | Continuous]) -> Mapping[str, Block]:
    return frozen({name: each for name, each in blocks.items() if isinstance(each, kind)})
