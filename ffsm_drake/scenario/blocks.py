"""The section ``blocks``: user-supplied blocks of the closed loop."""

from dataclasses import dataclass
from typing import Any, ClassVar

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import (
    identifier_problems,
    name_problems,
    sample_problems,
    unitless,
)


@dataclass
class Block:
    """A user-supplied system for a block of the closed loop.

    A text is short for ``{system: text}``.
    """

    SHORTHAND: ClassVar[str] = "system"  # the field that a text sets

    KIND: ClassVar[str] = "system"  # another one drops the inherited settings

    system: str = unitless(
        "",
        "factory of the block, from BlockSetup to a Drake system: module:attribute, or the name of "
        "an installed one",
    )
    settings: dict[str, Any] = unitless({}, "settings that are passed to the factory unchanged")

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the name can be looked up."""
        yield from name_problems(self.system, f"{key}.system")


@dataclass
class OwnPhase(Block):
    """A phase of a mission before its approach. A text is short for ``{system: text}``."""

    system: str = unitless(
        "",
        "factory of the phase, from BlockSetup to Phase: module:attribute, or the name of an "
        "installed one",
    )
    duration: float = setting(
        10.0, "s", "duration of the phase, a whole number of control samples", above=0
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check the name, for whole samples, and for an approach."""
        if scenario.phases:  # where it was given
            key = key.removeprefix("blocks.")
        yield from name_problems(self.system, f"{key}.{'kind' if scenario.phases else 'system'}")
        yield from sample_problems(self.duration, scenario.sample_time, f"{key}.duration")
        if scenario.approach is None:
            yield key, "must come before an approach; add capture.approach"


@dataclass
class Blocks:
    """User-supplied blocks, which replace sections of the scenario or add to them."""

    reference: Block | None = unitless(
        None, "block for the planned motion; null: the section ``reference``"
    )
    sensing: dict[str, Block] = unitless(
        {},
        "stages between the section ``sensing`` and the controller by name, in series; a stage "
        "named "
        "``sensing`` replaces the section; a single block is short for {own: block}",
    )
    actuation: Block | None = unitless(
        None,
        "block from the commanded to the applied force; null: the section ``actuation``",
    )
    forces: dict[str, Block] = unitless(
        {},
        "external forces by name, which are summed; ``disturbance`` and ``environment`` replace "
        "the "
        "sections with these names, and any other name adds a force",
    )

    phases: dict[str, OwnPhase] = unitless(
        {}, "phases of the mission before the approach by name, one after another"
    )

    def choices(self) -> dict[str, Block]:
        """Return the blocks that are filled here in place of their own section, by name."""
        named = {name: getattr(self, name) for name in ("reference", "actuation")}
        for name, stage in self.sensing.items():  # one called sensing replaces the section
            named[name if name == "sensing" else f"sensing.{name}"] = stage
        named |= {f"forces.{name}": block for name, block in self.forces.items()}
        named |= {f"phases.{name}": phase for name, phase in self.phases.items()}
        return {name: block for name, block in named.items() if block is not None}

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the names are valid in the diagram."""
        yield from identifier_problems(f"{key}.forces", self.forces, "a force's")
        yield from identifier_problems(f"{key}.sensing", self.sensing, "a stage's")
        place = "phases" if scenario.phases else f"{key}.phases"
        yield from identifier_problems(place, self.phases, "a phase's")


def kind_of(name: str) -> str:
    """Return the kind of a block with that name: "forces" for "forces.friction"."""
    return name.partition(".")[0]
