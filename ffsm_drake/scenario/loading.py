"""Loading a scenario in layers, later ones winning: the defaults, the YAML file, the overrides
(``key=value``).
"""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from ffsm_drake.common.errors import ScenarioError, did_you_mean, one_line
from ffsm_drake.common.settings import require_valid
from ffsm_drake.scenario.resolving import apply_override, as_dict, build, resolve
from ffsm_drake.scenario.schema import Scenario
from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml, write_yaml

MANIFEST_FILE = "manifest.json"  # of a run's folder; holds its scenario
MAX_FILE_SIZE = 1_000_000  # bytes


def shipped_scenarios() -> dict[str, Path]:
    """The scenarios that ship with the package: name -> file."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "shipped").glob("*.yaml"))}


def load_scenario(name_or_path: str | Path, overrides: Iterable[str] = ()) -> Scenario:
    """Load a scenario by shipped name or file path, apply overrides, validate.

    Args:
      name_or_path: a name of ``shipped_scenarios()``, the path of a YAML file, or a run's folder or
        manifest.json: the scenario of that run.
      overrides: ``key=value`` strings; the key is dotted, the value is YAML
        (``controllers.tdc.k_d.joint_1=50``).

    Raises:
      ScenarioError: the file, a key or a value cannot be used; the message says where and what
        would be right.
    """
    path = _find(str(name_or_path))
    try:
        if path.stat().st_size > MAX_FILE_SIZE:
            raise ScenarioError(
                "",
                f"larger than {MAX_FILE_SIZE} bytes: not a scenario; give a YAML file",
                source=str(path),
            )
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ScenarioError(
            "", f"is not UTF-8 text ({one_line(error)})", source=str(path)
        ) from error
    except OSError as error:
        raise ScenarioError("", f"cannot be read: {one_line(error)}", source=str(path)) from error
    return scenario_from_yaml(text, overrides, source=str(path))


def scenario_from_yaml(text: str, overrides: Iterable[str] = (), *, source: str = "") -> Scenario:
    """Build a scenario from YAML text; ``source`` is the file name used in errors and for relative
    model paths.
    """
    try:
        data = read_yaml(text)
    except StrictYamlError as error:
        raise ScenarioError("", f"is not valid YAML: {one_line(error)}", source=source) from error
    if isinstance(data, dict) and Path(source).name == MANIFEST_FILE:
        data = data.get("scenario", {})
    if isinstance(data, dict):  # at the top, names with an underscore hold what aliases refer to
        data = {
            key: value
            for key, value in data.items()
            if not (isinstance(key, str) and key.startswith("_"))
        }
    return scenario_from_dict({} if data is None else data, overrides, source=source)


def scenario_from_dict(
    data: Mapping[str, Any], overrides: Iterable[str] = (), *, source: str = ""
) -> Scenario:
    """Build a scenario from plain data (as read from YAML or JSON)."""
    try:
        resolved = resolve(Scenario, as_dict(Scenario()), data, "")
        model, given = resolved["model"], data.get("model") or {}
        if model["servicer"] is not None and given.get("directives") is None:
            model["directives"] = None  # the default, which the servicer replaces
    except ScenarioError as error:
        raise error.located(source) from None
    if source:
        anchor_paths(resolved, Path(source).parent)
    overridden = []
    for override in overrides:
        try:
            overridden.append(apply_override(resolved, override))
        except ScenarioError as error:
            raise error.located("override") from None
    scenario: Scenario = build(Scenario, resolved)
    try:
        require_valid(scenario, scenario=scenario)
    except ScenarioError as error:
        if overridden and not is_overridden(error.key, overridden):
            scenario_from_dict(data, source=source)  # raises where the file itself is at fault
        raise error.located("override" if overridden else source) from None
    return scenario


def is_overridden(key: str, overridden: Iterable[str]) -> bool:
    """Whether a key is one of the overridden ones, stands within one, or holds one."""

    def within(inner: str, outer: str) -> bool:
        return inner == outer or inner.startswith((f"{outer}.", f"{outer}["))

    return any(within(key, other) or within(other, key) for other in overridden)


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """The whole scenario as plain data: what ``scenario_from_dict`` takes back unchanged."""
    data: dict[str, Any] = as_dict(scenario)
    return data


def flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def differing_keys(*scenarios: Scenario) -> list[str]:
    """The dotted keys, but for the description, in which scenarios are not all the same."""
    flat = [flatten(scenario_to_dict(scenario)) for scenario in scenarios]
    keys = {key for one in flat for key in one} - {"description"}
    return sorted(key for key in keys if len({repr(one.get(key)) for one in flat}) > 1)


def scenario_to_yaml(scenario: Scenario) -> str:
    """The whole scenario as YAML text: what ``load_scenario`` reads back from a file."""
    return write_yaml(scenario_to_dict(scenario))


def portable_scenario(scenario: Scenario, folder: Path) -> dict[str, Any]:
    """The whole scenario as plain data for a file in ``folder``, with paths relative to that."""
    data = scenario_to_dict(scenario)
    relate_paths(data, folder)
    return data


def relate_paths(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of a scenario in plain data relative to a folder; package:// addresses
    stay.
    """
    _map_paths(data, lambda path: os.path.relpath(path, folder.resolve()))


def anchor_paths(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of a scenario in plain data absolute, relative ones from a folder."""
    _map_paths(data, lambda path: str((folder / path).resolve()))


def override_scenario(scenario: Scenario, overrides: Iterable[str]) -> Scenario:
    """A new scenario with ``key=value`` overrides applied; the given one does not change."""
    return scenario_from_dict(scenario_to_dict(scenario), overrides)


def _find(name: str) -> Path:
    shipped = shipped_scenarios()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    try:
        if path.is_file():
            return path
        if (path / MANIFEST_FILE).is_file():
            return path / MANIFEST_FILE
        kind = "a folder" if path.is_dir() else "not a regular file" if path.exists() else ""
    except (OSError, ValueError) as error:  # too long, not allowed to look, ...
        raise ScenarioError("", f"cannot be read: {one_line(error)}", source=name) from error
    if kind and name:
        raise ScenarioError("", f"is {kind}; give a YAML file", source=name)
    if path.suffix in (".yaml", ".yml") or (name and path.name != name):
        raise ScenarioError(
            "",
            f"no such scenario file; give a YAML file or one of {', '.join(shipped)}",
            source=name,
        )
    raise ScenarioError(
        "",
        f"no such scenario; choose one of {', '.join(shipped)}, or give a YAML "
        f"file{did_you_mean(name, shipped)}",
        source=name or "''",
    )


def _map_paths(data: dict[str, Any], changed: Callable[[str], str]) -> None:
    """Apply a function to every path of a scenario in plain data that is not a package://
    address.
    """

    def path(value: str | None) -> str | None:
        return value if value is None or "://" in value else changed(value)

    model = data["model"]
    for key in ("directives", "servicer", "debris"):
        model[key] = path(model[key])
    model["packages"] = {name: path(folder) for name, folder in model["packages"].items()}
    data["reference"]["plan"] = path(data["reference"]["plan"])
    data["python_path"] = [path(folder) for folder in data["python_path"]]
