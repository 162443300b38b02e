"""Remarks on the layers of a scenario: what a layer changes of the meaning of those below."""

from collections.abc import Iterable, Iterator

from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.layers import (
    Layer,
    Override,
    Stack,
    find_scenario,
    layers_in,
    override_layers,
)
from ffsm_drake.scenario.sensing import FURTHER


def layer_remarks(name: str, overrides: Iterable[Override] = ()) -> Iterator[str]:
    """A line for sensors that were given for another sample time than the scenario's.

    Args: the name or file of a scenario that loads, and the overrides.
    """
    files = layers_in(find_scenario(name))
    stack, given = Stack({}, {}), dict[str, float]()  # key -> sample time for which it was given
    for group in (*([layer] for layer in files), override_layers(overrides)):
        for layer in group:
            stack = layer.onto(Scenario, stack)
        period = float(stack.whole.get("sample_time") or Scenario().sample_time)
        given |= {key: period for key, other in FURTHER.items() if _gives(group, key)}
        for key, other in FURTHER.items():
            if _gives(group, other):
                given.pop(key, None)
    if not stack.whole:
        return
    sensing, now = stack.whole["sensing"], float(stack.whole["sample_time"])
    stale = {key: at for key, at in given.items() if at != now and _differs(key, sensing[key])}
    for at in dict.fromkeys(stale.values()):
        keys = [key for key in stale if stale[key] == at]
        seconds = ", ".join(other for key, other in FURTHER.items() if key in keys)
        yield (
            f"sample_time: {now:g} s changes the sensors, because of values that were "
            f"given in samples of {at:g} s: sensing.{', '.join(keys)}; set {seconds} instead"
        )


def _gives(group: list[Layer], key: str) -> bool:
    return any(layer.gives(f"sensing.{key}") for layer in group)


def _differs(key: str, value: object) -> bool:
    """Whether a value of a sample has an effect."""
    values = value.values() if isinstance(value, dict) else [value]
    return any(each != (1 if key.endswith("period") else 0) for each in values)
