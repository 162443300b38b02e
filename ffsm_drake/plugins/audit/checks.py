"""Results of an audit: checks with their verdicts, and the overall verdict."""

import dataclasses
from typing import Literal

UNEXPLAINED = "no_single_mistake"  # cause of a check that no tried mistake explains
AMBIGUOUS = "cannot_say_which"  # cause of a check that several mistakes explain, none completely


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """The result of one check."""

    name: str
    statement: str
    verdict: Literal["holds", "measured", "not tested", "cannot tell", "does not hold"] = "holds"
    cause: str = ""  # name of the mistake or doubt; empty if there is none


def fault(name: str, cause: str, statement: str) -> Check:
    """A check that does not hold."""
    return Check(name=name, statement=statement, verdict="does not hold", cause=cause)


def undecided(name: str, cause: str, statement: str) -> Check:
    """A check that cannot be decided."""
    return Check(name=name, statement=statement, verdict="cannot tell", cause=cause)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Audit:
    """The checks of one log, in their order."""

    checks: tuple[Check, ...]

    @property
    def verdict(self) -> Literal["yes", "no", "cannot tell"]:
        """Overall verdict: whether the log is physically consistent."""
        return "no" if self.causes else "cannot tell" if self.doubts else "yes"

    @property
    def is_physics(self) -> bool:
        """True if the verdict is "yes"."""
        return self.verdict == "yes"

    @property
    def causes(self) -> tuple[str, ...]:
        """Causes of the checks that do not hold."""
        return self._causes("does not hold")

    @property
    def doubts(self) -> tuple[str, ...]:
        """Causes of the checks that cannot be decided."""
        return self._causes("cannot tell")

    def _causes(self, verdict: str) -> tuple[str, ...]:
        return tuple(
            dict.fromkeys(check.cause for check in self.checks if check.verdict == verdict)
        )

    def as_data(self) -> dict[str, object]:
        """Plain data, for JSON."""
        return {
            "is_physics": self.is_physics,
            "verdict": self.verdict,
            "checks": [dataclasses.asdict(check) for check in self.checks],
        }

    def __str__(self) -> str:
        lines = [f"[{check.verdict}] {check.name}: {check.statement}" for check in self.checks]
        why = ", ".join(self.causes or self.doubts)
        return "\n".join([*lines, f"Is this log physics? {self.verdict}{': ' if why else ''}{why}"])
