"""Copies of the files that a run was made from, in its folder, so that the folder runs elsewhere.

The copies have the places of the originals relative to each other, because models name meshes and
modules import each other by them. What the package ships and what is installed is not copied.
"""

import os
import re
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any

from pydrake.multibody.parsing import PackageMap

from ffsm_drake.common.files import check_regular
from ffsm_drake.common.guard import is_installed
from ffsm_drake.runs.input_copies import InputCopies
from ffsm_drake.runs.reading import INPUTS, digest_of
from ffsm_drake.scenario import Scenario, policy_parts
from ffsm_drake.scenario.fields import POLICY
from ffsm_drake.spacecraft.plant import model_files, models_dir, resolve_package
from ffsm_drake.systems.registry import module_file, module_folder

_LARGEST = 500_000_000  # bytes of all copies
_LINKED = 5_000_000  # bytes from which a file is linked instead, where the disk can
_FOLDERS = re.compile(r'\b(?:meshdir|texturedir|assetdir)\s*=\s*"([^"\n]+)"')
_FILES = re.compile(r'\bfile\s*=\s*"([^"\n]+)"')


def keep_inputs(scenario: Scenario, folder: Path) -> dict[str, Any]:
    """Copy the files that a scenario's run was made from into ``folder``/record.inputs.

    Warns if they are too large; the run's folder then needs the originals.

    Returns: for the manifest ``files`` (name in the folder -> SHA-256), and ``scenario``: the keys
    that lead to the copies. Empty if there is nothing to copy.

    Raises:
      OSError: a file cannot be read or written.
      ModelError: a model's file cannot be read.
    """
    models, modules = _models_of(scenario), _modules_of(scenario)
    files = list(dict.fromkeys([*models, *(each for found in modules.values() for each in found)]))
    if not files:
        return {}
    packages = {
        name: place
        for name, place in _packages_of(scenario).items()
        if any(file.is_relative_to(place) for file in models)
    }
    folders = [*map(Path, packages.values()), *modules]
    root = Path(os.path.commonpath([*folders, *(file.parent for file in files)]))
    sizes = {file: file.stat().st_size for file in files}
    if sum(size for size in sizes.values() if size < _LINKED) > _LARGEST:
        warnings.warn(
            f"the model files ({sum(sizes.values()) / 1e6:.0f} MB, limit {_LARGEST / 1e6:.0f} MB) "
            "are not copied to the run's folder; to repeat the run elsewhere, copy them to the "
            "same paths",
            stacklevel=2,
        )
        return {}

    def kept(path: Path) -> str:
        return (INPUTS / path.relative_to(root)).as_posix()

    for file, size in sizes.items():
        copy = folder / kept(file)
        copy.parent.mkdir(parents=True, exist_ok=True)
        _copy(file, copy, linked=size >= _LINKED)
    changed = _changed_keys(scenario, {file: kept(file) for file in files})
    if packages:
        given = changed.setdefault("model", {}).setdefault("packages", {})
        given |= {name: kept(Path(place)) for name, place in packages.items()}
    if modules:
        changed["python_path"] = [kept(Path(place)) for place in modules]
    names = {kept(file): digest_of(folder / kept(file)) for file in files}
    return {"files": names, "scenario": changed}


def changed_inputs(directory: Path, inputs: Any) -> Iterator[str]:
    """A line for each file of ``keep_inputs`` that is missing in a run's folder or has another
    content; ``inputs`` is the manifest's entry, of any form.
    """
    files = inputs.get("files") if isinstance(inputs, dict) else None
    for name, digest in files.items() if isinstance(files, dict) else ():
        path = directory / name
        if Path(name).parts[:1] != INPUTS.parts or ".." in Path(name).parts:
            continue
        try:
            check_regular(path, limit=_LARGEST)
            if digest_of(path) != digest:
                yield f"{path}: was changed after the run, so the folder may not repeat its run"
        except (OSError, ValueError):
            yield f"{path}: is missing, so the folder does not repeat its run"


class Copies(InputCopies):
    """Copies in the folder record.inputs."""

    keep = staticmethod(keep_inputs)
    changed = staticmethod(changed_inputs)


COPIES = Copies()


def _copy(file: Path, copy: Path, *, linked: bool) -> None:
    if linked:
        try:
            os.link(file.resolve(), copy)
        except OSError:  # another disk, or one without links
            pass
        else:
            return
    shutil.copyfile(file, copy)


def _changed_keys(scenario: Scenario, kept: Mapping[Path, str]) -> dict[str, Any]:
    """The keys of the scenario that hold a path of a copied file, with the copy's."""
    found: dict[str, Any] = {}
    for section, key in (
        ("model", "directives"), ("model", "servicer"), ("model", "debris"), ("reference", "plan"),
    ):  # fmt: skip
        address = getattr(getattr(scenario, section), key)
        copy = kept.get(_absolute(address)) if address and "://" not in address else None
        if copy is not None:
            found.setdefault(section, {})[key] = copy
    file, law = policy_parts(scenario.controller) or ("", "")
    if Path(file).is_absolute() and Path(file) in kept:
        found["controller"] = f"{POLICY}{kept[Path(file)]}{law and f'@{law}'}"
    return found


def _absolute(path: str | Path) -> Path:
    """A path without links resolved: files are named relative to where they are named to be."""
    return Path(os.path.abspath(path))


def _models_of(scenario: Scenario) -> list[Path]:
    """The files of a scenario's model and plan that the package does not ship."""
    reference = scenario.reference
    found = [_absolute(file) for file in model_files(scenario.model)]
    if reference.kind == "optimal" and reference.plan is not None:
        found.append(_absolute(resolve_package(reference.plan)))
    for file in [each for each in found if each.suffix.lower() == ".xml"]:
        text = file.read_text(encoding="utf-8", errors="replace")
        for place in _FOLDERS.findall(text):  # of MuJoCo's compiler
            found += [_absolute(file.parent / place / name) for name in _FILES.findall(text)]
    shipped = models_dir().resolve()
    return [
        file
        for file in dict.fromkeys(found)
        if file.is_file() and not file.resolve().is_relative_to(shipped)
    ]


def _packages_of(scenario: Scenario) -> dict[str, str]:
    """Folder of each package:// name that a scenario or the environment gives."""
    ros = PackageMap.MakeEmpty()
    ros.PopulateFromRosPackagePath()
    found = {name: ros.GetPath(name) for name in ros.GetPackageNames()} | scenario.model.packages
    return {name: str(_absolute(folder)) for name, folder in found.items()}


def _modules_of(scenario: Scenario) -> dict[Path, list[Path]]:
    """Folders of Python's path for the user-supplied blocks, with the files that they load: modules
    and what these import from such folders, policies and their external data.
    """
    addresses = [scenario.controller, *(b.system for b in scenario.blocks.choices().values())]
    found: dict[Path, list[Path]] = {}
    for address in addresses:
        file, folder = module_file(address), module_folder(address)
        if file is None or folder is None or not file.is_file():
            continue
        file, folder = _absolute(file), _absolute(folder)
        if ":" in address and policy_parts(address) is None:
            path = list(dict.fromkeys([str(folder), *map(os.path.abspath, scenario.python_path)]))
            for each in (file, *_imported(address.partition(":")[0], path)):
                place = next((p for p in map(Path, path) if each.is_relative_to(p)), folder)
                found.setdefault(place, []).append(each)
        else:
            beside = sorted(file.parent.glob(f"{file.name}*"))
            found.setdefault(folder, []).extend(each for each in beside if each.is_file())
    return found


def _imported(name: str, path: Sequence[str]) -> Iterator[Path]:
    """The files of a module and of all that it imports from the folders of ``path``; nothing of it
    runs.
    """
    finder = ModuleFinder(list(path), excludes=["ffsm_drake", "pydrake"])
    try:
        finder.import_hook(name)
    except (ImportError, SyntaxError, AttributeError):  # a package without __init__.py
        loaded = sys.modules.items()
        files = [m.__file__ for key, m in loaded if key.partition(".")[0] == name.partition(".")[0]]
    else:
        files = [getattr(module, "__file__", None) for module in finder.modules.values()]
    for file in files:
        if file is not None and file.endswith(".py") and not is_installed(os.path.abspath(file)):
            yield _absolute(file)
