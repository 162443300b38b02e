"""Loading a scenario: from its YAML file, or plain data, and overrides."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario.layers import (
    OVERRIDE,
    Override,
    assembled,
    file_layers,
    find_scenario,
    flatten,
    layers_in,
    override_layers,
    parsed,
    read_text,
    relate_paths,
)
from ffsm_drake.scenario.resolving import as_dict
from ffsm_drake.scenario.schema import Scenario
from ffsm_drake.scenario.strict_yaml import write_yaml


def load_scenario(name_or_path: str | Path, overrides: Iterable[Override] = ()) -> Scenario:
    """Load and check a scenario, with overrides.

    Args:
      name_or_path: the name of a shipped scenario, the path of a YAML file, or the folder or
        manifest.json of a run, for the scenario of that run.
      overrides: texts ``key=value`` with a dotted key and a YAML value
        (``controllers.tdc.k_d.joint_1=50``), or mappings, which merge like a file with ``extends``
        (``{"payload": {"truth": {"mass": 80}}}``). Later overrides win.

    Returns: the scenario.

    Raises:
      ScenarioError: the file, a key or a value cannot be used. The message has the place and a
        valid choice.

    Example:
      >>> from ffsm_drake import load_scenario
      >>> scenario = load_scenario("postcapture", ["duration=5", {"reference": {"duration": 4}}])
      >>> scenario.duration, scenario.reference.duration
      (5.0, 4.0)
    """
    path = find_scenario(str(name_or_path))
    return scenario_from_yaml(read_text(path), overrides, source=str(path))


def scenario_from_yaml(
    text: str, overrides: Iterable[Override] = (), *, source: str = ""
) -> Scenario:
    """Build a scenario from YAML text; ``source`` is the file name used in errors and for relative
    paths.
    """
    return scenario_from_dict(parsed(text, source), overrides, source=source)


def scenario_from_dict(
    data: Mapping[str, Any], overrides: Iterable[Override] = (), *, source: str = ""
) -> Scenario:
    """Build a scenario from plain data (as read from YAML or JSON)."""
    layers = file_layers(data, source) + override_layers(overrides)
    return assembled(Scenario, layers)


def place_of(key: str, name_or_path: str | Path, overrides: Iterable[Override] = ()) -> str:
    """Source of a key of a scenario that loads: "--set", a base file, or else
    ``name_or_path``.
    """
    files = layers_in(find_scenario(str(name_or_path)))
    layers = [*files[:-1], *override_layers(overrides)]
    places = [layer.source for layer in layers if layer.gives(key)]
    own = files[-1].gives(key) and OVERRIDE not in places[-1:]
    return str(name_or_path) if own or not places else places[-1]


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """Return the whole scenario as plain data, which ``scenario_from_dict`` accepts unchanged."""
    return as_dict(scenario)


def differing_keys(*scenarios: Scenario) -> list[str]:
    """Return the dotted keys, except the description, in which scenarios differ."""
    flat = [flatten(scenario_to_dict(scenario)) for scenario in scenarios]
    keys = {key for one in flat for key in one} - {"description"}
    return sorted(key for key in keys if len({repr(one.get(key)) for one in flat}) > 1)


def scenario_to_yaml(scenario: Scenario) -> str:
    """Return the whole scenario as YAML text, which ``load_scenario`` reads from a file."""
    return write_yaml(scenario_to_dict(scenario))


def portable_scenario(scenario: Scenario, folder: Path) -> dict[str, Any]:
    """Return the whole scenario as plain data for a file in ``folder``, with paths relative to the
    folder.
    """
    data = scenario_to_dict(scenario)
    relate_paths(data, folder)
    return data


def override_scenario(scenario: Scenario, overrides: Iterable[Override]) -> Scenario:
    """Return a new scenario with overrides. The given scenario does not change.

    Args:
      scenario: the scenario to start from.
      overrides: texts or mappings, see ``load_scenario``.

    Returns: the new scenario.

    Raises:
      ScenarioError: a key or a value cannot be used.

    Example:
      >>> from ffsm_drake import load_scenario, override_scenario
      >>> scenario = load_scenario("postcapture")
      >>> override_scenario(scenario, ["random_seed=7"]).random_seed, scenario.random_seed
      (7, 0)
    """
    return scenario_from_dict(scenario_to_dict(scenario), overrides)


def checked(scenario: Scenario) -> Scenario:
    """Check a scenario that Python code may have changed, like one from a file.

    Raises ScenarioError: a value cannot be used; the message begins with ``Scenario`` and the key.
    """
    try:
        return scenario_from_dict(scenario_to_dict(scenario))
    except ScenarioError as error:
        raise error.located("Scenario") from None
