"""Settings of backlash in the gears of joints: ``effects.backlash``."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting


@dataclass
class Backlash:
    """Backlash in flexible gears: a dead band of the spring between rotor and link."""

    gap: dict[str, float] = setting(
        {},
        "rad",
        "free travel of each gear, by its name in ``model.flexible``; half of it on each side",
        above=0,
        below=1,
        size=(1, 100),
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that each name is that of a flexible gear, and for faults."""
        if scenario.faults is not None:
            yield key, "cannot be combined with faults: a jam would ignore the gap; remove faults"
        parts = scenario.model.flexible.items()
        gears = [name for name, part in parts if part.kind == "gear"]
        for name in self.gap:
            if name not in gears:
                known = ", ".join(gears) or "none; add a part of kind gear to model.flexible"
                yield f"{key}.gap.{name}", f"is no flexible gear; there are: {known}"
