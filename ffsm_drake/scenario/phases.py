"""The key ``phases``: the phases of a mission in their order."""

from collections.abc import Iterator, Mapping
from typing import Any

from ffsm_drake.common.settings import Problems
from ffsm_drake.scenario.blocks import OwnPhase

_OF_A_CAPTURE = ("approach", "close", "stop")


def own_phases(given: list[Any]) -> dict[str, OwnPhase]:
    """The phases before the approach by name, of a list as ``phase_problems`` accepts it."""
    found = dict[str, OwnPhase]()
    for name, settings in _entries(given):
        if name in _OF_A_CAPTURE:
            break
        own, lasts = dict(settings), OwnPhase().duration
        given_lasts, kind = own.pop("duration", lasts), str(own.pop("kind", name))
        duration = float(given_lasts) if _is_duration(given_lasts) else lasts
        found[name] = OwnPhase(system=kind, settings=own, duration=duration)
    return found


def phase_problems(given: list[Any], scenario: Any) -> Problems:
    """What is wrong with the phases of a scenario."""
    entries = list(_entries(given))
    for index, entry in enumerate(given):
        is_named = isinstance(entry, Mapping) and len(entry) == 1
        if not isinstance(entry, str) and not (
            is_named and isinstance(next(iter(entry.values())), Mapping)
        ):
            yield f"phases[{index}]", "must be a name, or {name: {setting: value}}"
            return
    names = [name for name, _ in entries]
    if scenario.approach is None:
        yield "phases", "needs an approach; add capture.approach, or remove phases"
        return
    wanted = [name for name in _OF_A_CAPTURE if name != "close" or scenario.closing is not None]
    before = names[: names.index("approach")] if "approach" in names else names
    if names[len(before) :] != wanted:
        hint = "" if "close" in wanted else " (close needs capture.closing)"
        yield "phases", f"must end with {', '.join(wanted)}{hint}, not be {', '.join(names)}"
    for name, settings in entries:
        if name in _OF_A_CAPTURE and settings:
            yield f"phases.{name}", "has its settings in capture; remove them here"
        if names.count(name) > 1 or (name in before and name in _OF_A_CAPTURE):
            yield f"phases.{name}", "is there twice; rename one and set its kind"
            return
        if not _is_duration(settings.get("duration", 1.0)):
            yield f"phases.{name}.duration", f"must be a number > 0 s, not {settings['duration']}"


def _is_duration(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value > 0.0


def _entries(given: list[Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Name and settings of each entry."""
    for entry in given:
        if isinstance(entry, str):
            yield entry, {}
        elif isinstance(entry, Mapping):
            for name, settings in entry.items():
                yield str(name), settings if isinstance(settings, Mapping) else {}
