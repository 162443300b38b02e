"""What a compiled run depends on: its code, and its numbers."""

import copy
import functools
import itertools
from collections.abc import Hashable

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.blocks import Blocks
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.models import PosedModel, posed_model
from ffsm_drake.plugins.compiled.parameters import parameters_of, rows_of
from ffsm_drake.plugins.compiled.parts import row
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import MassProperties
from ffsm_drake.systems.controllers import (
    SampledController,
    controller_names,
    make_controller,
)
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.registry import Factory


class Run:
    """One run: what its code depends on, and its numbers."""

    def __init__(
        self, mission: Mission, case: Case | None = None, law: Factory | None = None
    ) -> None:
        """Args: the mission, what it shares with other runs, and the factory of another law."""
        self.mission, self.case = mission, Case(mission) if case is None else case
        self.scenario = mission.scenario
        # blocks in place of the scenario's
        self.given: dict[str, Factory] = {} if law is None else {"controller": law}
        controller = (
            self.case.controller_of(mission)
            if law is None
            else make_controller(mission, self.case.nominal, law)
        )
        if not isinstance(controller, SampledController):
            raise NotCovered("a controller that is a Drake system")
        self.controller, self.law = controller, controller.law
        if self.law.contacts_read and not self.case.parts.last:
            raise NotCovered("a law that reads contacts")
        self.coordinates, self.samples = self.case.coordinates, self.case.samples
        self.motion, self.steps = self.case.motion, self.case.steps
        self._first_memory = row(self.law.initial_state().values())
        try:
            found = parameters_of(self.law)
        except NotCovered as error:
            self._call_law(error.what)
        else:
            self._lay_out(*found)
        self.key = (self.case.kind, self.scenario.controller, type(self.law), *self.code)

    def _lay_out(
        self, law: np.ndarray, constants: tuple[Hashable, ...], planned: int, *, called: str = ""
    ) -> None:
        """Args: of the law: its parameters, constants, and planned numbers; see ``Blocks``."""
        at_start = self._first_memory if self.case.made.watch is not None else np.zeros(0)
        fixed = vars(self.case.fixed)
        self.parameters = self.case.parameters | {"law": law, "law_at_start": at_start}
        self.blocks = Blocks(
            law=self.law,
            parts=self.case.parts,
            watch=self.case.made.watch,
            detector=self.case.made.detector,
            called=called,
            num_parameters=law.size,
            num_planned=planned,
            **fixed,
        )
        # equal for runs that can have the same code
        sizes = law.size, planned
        looks = str(self.blocks.detector_inputs), str(self.blocks.detector_outputs)
        self.code = *sizes, *fixed.values(), self.case.constants, constants, self.steps, *looks

    @functools.cached_property
    def states(self) -> dict[str, np.ndarray]:
        """What it begins with, by the names of ``Blocks.states``."""
        return self.case.states | {"memory": self._first_memory}

    @functools.cached_property
    def posed_model(self) -> PosedModel:
        """The true plant, for many configurations at once."""
        return posed_model(self.mission.craft.flexible())

    def on(self, case: Case) -> "Run":
        """The same on a case that differs in numbers."""
        other = copy.copy(self)
        other.case, other.parameters = case, self.parameters | case.parameters
        return other

    def carrying(self, payload: MassProperties) -> "Run":
        """See Case."""
        return self.on(self.case.carrying(payload))

    def _call_law(self, why: str) -> None:
        self._lay_out(np.zeros(0), (), 0, called=why)
        layout = {name: value.size for name, value in self.blocks.memory.items()}
        self.code = (*self.code, "called", str(layout), str(self.blocks.law_inputs))

    def with_called_law(self, why: str) -> "Run":
        """Return the run with its law called. Args: why the law is not traced."""
        if self.blocks.called:
            return self
        other = copy.copy(self)
        other._call_law(why)
        return other

    @property
    def rows(self) -> dict[str, np.ndarray]:
        """What it reads at each sample (samples, n), by the names of ``Blocks.row``."""
        if not self.blocks.num_planned:
            return self.case.rows
        until = self.case.window.stop
        planned = rows_of(self.law, self.case.planned["reference"][:until, : self.blocks.nq])
        return self.case.rows | {"planned": planned}

    @property
    def key_on_disk(self) -> str | None:
        """What the code is made from, besides this package; None for a user's law or block."""
        parts = itertools.chain(*(blocks.values() for blocks in self.case.parts))
        own = (self.blocks.called or is_shipped(self.law)) and all(map(is_shipped, parts))
        return repr(self.code) if own else None


def run_of(case: Case, mission: Mission) -> Run:
    """Return the run of a case with the controller of a mission; one with a law of this package is
    kept, unless a file or a user's function makes the law. Raises what ``Run`` raises.
    """
    name = mission.scenario.controller
    if isinstance(found := case.runs.get(name), Run):
        return found
    made = Run(mission, case)
    if name in controller_names() and is_shipped(made.law):
        case.runs[name] = made
    return made
