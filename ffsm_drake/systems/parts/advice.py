"""Remedies for saturated base actuators, and the load of a mission that they depend on."""

import dataclasses
import shlex
from collections.abc import Iterator, Mapping
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """Changes of a scenario against saturation."""

    changes: Mapping[str, Any]  # by dotted key
    reason: str

    def __str__(self) -> str:
        """As options of the command line, and why."""
        given = (f"{key}={_as_yaml(value)}" for key, value in self.changes.items())
        return f"{' '.join(f'--set {shlex.quote(each)}' for each in given)} ({self.reason})"


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupLoad:
    """Requirements of a mission and its loop on a group's actuators, and the actuators' limits."""

    limit: float  # N m or N; in any direction
    inertia: float  # kg m^2 or kg; the largest about or along an axis, all else free to react
    noise: float  # rad or m; largest standard deviation of a measured position
    motion: float  # N m or N; peak of the planned motion; with a capture, after its first seconds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """Possible remedies for saturated base actuators of any kind."""

    groups: Mapping[str, GroupLoad]  # by group, of those with a limit
    slower: Advice | None  # a longer motion, if it takes less of the limit
    softer: Mapping[str, Advice]  # by group: smaller gains, if they are too large
    other_law: Advice | None  # a law without an integral, if the law has one

    def advice(self, *groups: str) -> Iterator[Advice]:
        """The remedies for actuators of some groups."""
        if self.slower is not None:
            yield self.slower
        yield from (self.softer[group] for group in groups if group in self.softer)
        if self.other_law is not None:
            yield self.other_law


def _as_yaml(value: Any) -> str:
    """Return a number, text, or numbers by name, in the form of an override."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name}: {_as_yaml(each)}' for name, each in value.items())}}}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
