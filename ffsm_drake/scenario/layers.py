"""The layers of a scenario, later ones winning: the defaults, the files that ``extends`` names, the
file itself, the overrides.
"""

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ffsm_drake.common.errors import ScenarioError, choices, one_line, some
from ffsm_drake.common.settings import require_valid
from ffsm_drake.scenario.fields import POLICY, policy_parts
from ffsm_drake.scenario.resolving import (
    apply_override,
    build,
    defaults_of,
    merged,
    resolve,
    shown,
)
from ffsm_drake.scenario.sensing import FURTHER, Sensing
from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml

MANIFEST_FILE = "manifest.json"  # in a run's folder; holds the run's scenario
MAX_FILE_SIZE = 1_000_000  # bytes
EXTENDS = "extends"  # key of the scenario that a file extends
OVERRIDE = "--set"  # the source of an override

Override = str | Mapping[str, Any]  # "key=value", or a mapping as in a file with extends


@dataclass(frozen=True)
class Layer:
    """The data of one file or one override."""

    given: Any  # plain data from a file or mapping; key=value from a text
    source: str  # the file, or OVERRIDE, for errors
    folder: Path | None = None  # start of relative paths; None: left relative

    @property
    def is_assignment(self) -> bool:
        """Whether it is an override's key=value."""
        return isinstance(self.given, str) and self.source == OVERRIDE

    def gives(self, key: str) -> bool:
        """Whether the layer holds a dotted key, one within it or one that contains it."""
        given = self.given
        if self.is_assignment:
            name, _, value = given.partition("=")
            with contextlib.suppress(StrictYamlError):  # a text that is refused names no keys
                value = read_yaml(value)
            given = {name.strip(): value}
        return isinstance(given, Mapping) and is_overridden(key, flatten(given))

    def onto(self, schema: Any, below: "Stack") -> "Stack":
        """Return the layers below with this one on top, checked except for conditions on several
        settings.
        """
        try:
            if self.is_assignment:
                apply_override(schema, below.whole, self.given)
                return Stack(below.whole, below.whole)
            given = merged(schema, below.given, self.given)
            found = Stack(given, resolve(schema, defaults_of(schema), given, ""))
        except ScenarioError as error:
            raise error.located(self.source) from None
        model = self.given.get("model") or {}
        for data in (found.given, found.whole):
            for one, other in (("servicer", "directives"), ("directives", "servicer")):
                if model.get(one) is not None and model.get(other) is None:
                    data["model"] = data["model"] | {other: None}  # the model's other source
            if self.folder is not None:
                anchor_paths(data, self.folder)
        return found


@dataclass(frozen=True)
class Stack:
    """Plain data of several layers: the given part, and the whole with defaults."""

    given: dict[str, Any]
    whole: dict[str, Any]


def shipped_scenarios() -> dict[str, Path]:
    """Return the scenarios that ship with the package: name -> file."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "shipped").glob("*.yaml"))}


def assembled(schema: Any, layers: Sequence[Layer]) -> Any:
    """Return the scenario of some layers, checked.

    Raises:
      ScenarioError: named first is the layer that holds the wrong value.
    """
    scenario = build(schema, whole_of(schema, layers))
    try:
        require_valid(scenario, scenario=scenario)
    except ScenarioError as error:
        raise error.located(_at_fault(schema, layers, error)) from None
    return scenario


def whole_of(schema: Any, layers: Iterable[Layer]) -> dict[str, Any]:
    """Return the plain data of some layers with defaults, without a check of the values."""
    stack = Stack({}, {})
    for layer in layers:
        stack = layer.onto(schema, stack)
        _refuse_both(layer, stack.whole)
    return stack.whole


def override_layers(overrides: Iterable[Override]) -> list[Layer]:
    """Return a layer for each override; the dotted keys of a mapping are nested."""
    layers = []
    for override in overrides:
        if isinstance(override, str):
            layers.append(Layer(override, OVERRIDE))
            continue
        for key, value in override.items():
            given, parts = value, str(key).split(".")
            for part in reversed(parts):
                given = {part: given}
            layers.append(Layer(given, OVERRIDE))
    return layers


def file_layers(data: Any, source: str) -> list[Layer]:
    """Return the layers of plain data of a file: the layers of its base files, then its own."""
    layers: list[Layer] = []
    seen = [Path(source).resolve()] if source else []
    while True:
        base = data.get(EXTENDS) if isinstance(data, Mapping) else None
        if base is not None:
            data = {key: value for key, value in data.items() if key != EXTENDS}
        folder = Path(source).parent if source else None
        layers.insert(0, Layer(data, source, folder))
        if base is None:
            return layers
        if not isinstance(base, str):
            problem = f"must be a shipped scenario's name or a file, not {shown(base)}"
            raise ScenarioError(EXTENDS, problem, source=source)
        try:
            path = find_scenario(base, folder or Path())
        except ScenarioError as error:
            raise ScenarioError(EXTENDS, f"{base}: {error.problem}", source=source) from None
        seen.append(path.resolve())
        if seen[-1] in seen[:-1]:
            names = " -> ".join(each.name for each in seen)
            raise ScenarioError(EXTENDS, f"leads back to itself: {names}", source=source)
        source = str(path)
        data = parsed(read_text(path), source)


def layers_in(path: Path) -> list[Layer]:
    """Return the ``file_layers`` of a file. Raises ScenarioError if it cannot be read."""
    return file_layers(parsed(read_text(path), str(path)), str(path))


def read_text(path: Path) -> str:
    """Read the text of a scenario's file. Raises ScenarioError if it cannot be read."""
    try:
        if path.stat().st_size > MAX_FILE_SIZE:
            problem = f"larger than {MAX_FILE_SIZE} bytes: not a scenario; give a YAML file"
            raise ScenarioError("", problem, source=str(path))
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        problem = f"is not UTF-8 text ({one_line(error)})"
        raise ScenarioError("", problem, source=str(path)) from error
    except OSError as error:
        raise ScenarioError("", f"cannot be read: {one_line(error)}", source=str(path)) from error


def parsed(text: str, source: str) -> Any:
    """Parse a file's text to plain data. Raises ScenarioError if it is not YAML."""
    try:
        data = read_yaml(text)
    except StrictYamlError as error:
        raise ScenarioError("", f"is not valid YAML: {one_line(error)}", source=source) from error
    if isinstance(data, dict) and Path(source).name == MANIFEST_FILE:
        data = scenario_of(data) if "scenario" in data else {}
    if isinstance(data, dict):  # top-level names with an underscore hold targets of aliases
        data = {
            key: value
            for key, value in data.items()
            if not (isinstance(key, str) and key.startswith("_"))
        }
    return {} if data is None else data


def scenario_of(manifest: Mapping[str, Any]) -> Any:
    """Return the scenario of a run's manifest, with the paths of files in the run's folder."""
    data, kept = manifest["scenario"], manifest.get("inputs")
    changed = kept.get("scenario") if isinstance(kept, dict) else None
    if isinstance(data, dict) and isinstance(changed, dict):
        for key, value in changed.items():
            both = isinstance(value, dict) and isinstance(data.get(key), dict)
            data = data | {key: data[key] | value if both else value}
    return data


def find_scenario(name: str, folder: Path = Path()) -> Path:
    """Find the file of a shipped scenario, a path relative to a folder, or a run's folder.

    Raises:
      ScenarioError: there is none.
    """
    shipped = shipped_scenarios()
    if name in shipped:
        return shipped[name]
    path = folder / name
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
    if path.suffix in (".yaml", ".yml") or (name and Path(name).name != name):
        raise ScenarioError(
            "",
            f"no such scenario file; give a YAML file or one of {some(shipped)}",
            source=name,
        )
    raise ScenarioError(
        "",
        f"no such scenario; give a YAML file, or choose one of {choices(name, shipped)}",
        source=name or "''",
    )


def is_overridden(key: str, overridden: Iterable[str]) -> bool:
    """Whether a key is an overridden one, lies within one, or contains one."""

    def within(inner: str, outer: str) -> bool:
        return inner == outer or inner.startswith((f"{outer}.", f"{outer}["))

    return any(within(key, other) or within(other, key) for other in overridden)


def flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def relate_paths(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of a scenario in plain data relative to a folder; package:// addresses
    stay.
    """
    _map_paths(data, lambda path: os.path.relpath(path, folder.resolve()))
    if "controller" in data:
        data["controller"] = related_policy(data["controller"], folder)


def anchor_paths(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of a scenario in plain data absolute, relative ones from a folder."""
    _map_paths(data, lambda path: str((folder / path).resolve()))
    if "controller" in data:
        data["controller"] = anchored_policy(data["controller"], folder)


def related_policy(controller: str, folder: Path) -> str:
    """Return a controller with the file of a policy relative to a folder, unless it is searched
    for.
    """
    file, law = policy_parts(controller) or ("", "")
    if not Path(file).is_absolute():
        return controller
    return _policy(os.path.relpath(file, folder.resolve()), law)


def anchored_policy(controller: str, folder: Path) -> str:
    """Return a controller with the absolute file of a policy, if that is in a folder; elsewhere it
    is searched for.
    """
    file, law = policy_parts(controller) or ("", "")
    path = (folder / file).resolve()
    return _policy(str(path), law) if file and path.is_file() else controller


def _policy(file: str, law: str) -> str:
    return f"{POLICY}{file}{law and f'@{law}'}"


def _refuse_both(layer: Layer, whole: dict[str, Any]) -> None:
    """Raise ScenarioError if a layer gives a value per sample of a sensor with a density or
    time.
    """
    sensing = whole["sensing"]
    now = flatten(vars(Sensing(**sensing).at(abs(whole["sample_time"]) or 1.0)))
    for key, value in flatten(sensing).items():
        further = FURTHER.get(key.partition(".")[0])
        # an empty mapping sets nothing
        is_changed = further is not None and value != now.get(key, value)
        if is_changed and layer.gives(place := f"sensing.{key}"):
            other = f"sensing.{further}"
            problem = f"is set by {other}; remove one of the two, or first set {other}=null"
            raise ScenarioError(place, problem, source=layer.source)


def _at_fault(schema: Any, layers: Sequence[Layer], error: ScenarioError) -> str:
    """Return the source of the layer with a wrong value, or of the later layer that made the value
    wrong.
    """
    gave = max((k for k, layer in enumerate(layers) if layer.gives(error.key)), default=0)
    for count in range(gave + 1, len(layers)):
        try:
            assembled(schema, layers[:count])
        except ScenarioError as earlier:
            if earlier.key == error.key:
                return layers[count - 1].source
    return layers[-1].source


def _map_paths(data: dict[str, Any], changed: Callable[[str], str]) -> None:
    """Apply a function to every path of a scenario in plain data, except package:// addresses."""

    def path(value: str | None) -> str | None:
        return value if value is None or "://" in value else changed(value)

    for group, keys in (("model", ("directives", "servicer", "debris")), ("reference", ("plan",))):
        if given := data.get(group):
            data[group] = given | {key: path(given[key]) for key in keys if key in given}
    if packages := (data.get("model") or {}).get("packages"):
        data["model"]["packages"] = {name: path(folder) for name, folder in packages.items()}
    if "python_path" in data:
        data["python_path"] = [path(folder) for folder in data["python_path"]]
