"""The section ``blocks``: user-supplied blocks of the closed loop."""

from dataclasses import dataclass
from typing import Any, ClassVar

from ffsm_drake.common.settings import Problems
from ffsm_drake.scenario.fields import identifier_problems, name_problems, unitless


@dataclass
class Block:
    """The system of a block of the closed loop; a text stands for ``{system: text}``."""

    SHORTHAND: ClassVar[str] = "system"  # the field that a text alone gives

    KIND: ClassVar[str] = "system"  # another one drops the inherited settings

    system: str = unitless(
        "",
        "module:attribute, or the name of an installed one: a factory (BlockSetup -> Drake system)",
    )
    settings: dict[str, Any] = unitless({}, "passed to the factory unchanged")

    def check(self, key: str, scenario: Any) -> Problems:
        """A name that can be looked up."""
        yield from name_problems(self.system, f"{key}.system")


@dataclass
class Blocks:
    """User-supplied blocks, in place of those that the scenario's sections of the same names
    describe, or beside them.
    """

    reference: Block | None = unitless(None, "the planned motion")
    sensing: dict[str, Block] = unitless(
        {},
        "by name: further stages from the state to the controller's measurement of it, in a row "
        "after the section ``sensing``; one named ``sensing`` replaces that section; a block alone "
        "stands for {own: block}",
    )
    actuation: Block | None = unitless(None, "from the commanded to the applied force")
    forces: dict[str, Block] = unitless(
        {},
        "by name: external forces, summed; ``disturbance`` and ``environment`` replace the "
        "scenario's sections of those names, any other name adds to them",
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Names that the diagram can have."""
        yield from identifier_problems(f"{key}.forces", self.forces, "a force's")
        yield from identifier_problems(f"{key}.sensing", self.sensing, "a stage's")
