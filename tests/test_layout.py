"""A room imports only rooms before it in this list: data flows one way, and files in no circle.
The core imports no plug-in, and a plug-in those that it needs. Every room's tests have a
few that are quick.
"""

import ast
import graphlib
import re
from pathlib import Path

import pytest

from ffsm_drake.common.registrations import own_plugins

PACKAGE = Path(__file__).parents[1] / "ffsm_drake"
ROOMS = (
    "common",
    "scenario",
    "spacecraft",
    "mission",
    "systems",
    "loop",
    "runs",
    "show",
    "cli",
)
DRAWING = {"matplotlib", "plotly", "jinja2", "markupsafe"}  # what only pictures and pages need
DRAWS = {"show", "plugins"}
PLUGINS = "plugins"  # after the rooms; each folder in it is a plug-in
# What stands at the top for users: the verbs, the command, the conformance kit.
FACES = ("__init__", "__main__", "testing")


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules_in(path: Path) -> list[str]:
    """What a file imports, within functions and for the type checker too."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            short = module in ("ffsm_drake", f"ffsm_drake.{PLUGINS}")
            found += [f"{module}.{alias.name}" for alias in node.names] if short else [module]
    return found


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE))
)
def test_imports_go_one_way(path):
    room = room_of(path)
    if room in FACES:
        return
    assert room in (*ROOMS, PLUGINS), "a new room: give it its place in the list"
    for module in modules_in(path):
        parts = module.split(".")
        assert parts[:2] != ["pydrake", "all"], path
        assert parts[0] not in DRAWING or room in DRAWS, f"{path.name} imports {module}"
        if room != PLUGINS and parts[0] == "ffsm_drake" and len(parts) > 1 and parts[1] != room:
            assert parts[1] in ROOMS, f"{path.name} imports {module}"
            assert ROOMS.index(parts[1]) < ROOMS.index(room), f"{path.name} imports {module}"


def plugins_named_in(path: Path) -> set[str]:
    named = set(re.findall(rf"\bffsm_drake\.{PLUGINS}\.(\w+)", path.read_text()))  # in strings too
    return named | {
        module.split(".")[2]
        for module in modules_in(path)
        if module.startswith(f"ffsm_drake.{PLUGINS}.")
    }


@pytest.mark.parametrize("plugin", own_plugins())
def test_a_plugin_needs_those_that_it_names(plugin):
    named = set().union(*map(plugins_named_in, (PACKAGE / PLUGINS / plugin).rglob("*.py")))
    assert sorted(named - {plugin}) == list(own_plugins()[plugin].needs)


def test_the_core_names_no_plugin():
    core = [path for path in PACKAGE.rglob("*.py") if room_of(path) != PLUGINS]
    assert {path: named for path in core if (named := plugins_named_in(path))} == {}


TESTS = Path(__file__).parent


@pytest.mark.parametrize("path", sorted(TESTS.rglob("*.py")), ids=lambda path: path.name)
def test_tests_of_the_core_need_no_plugin(path):
    """Where they look at one, they skip without it."""
    if path.relative_to(TESTS).parts[0] == PLUGINS:
        return
    assert not [name for name in modules_in(path) if name.startswith(f"ffsm_drake.{PLUGINS}.")]


def module_files() -> dict[str, Path]:
    names = {
        path.relative_to(PACKAGE.parent).with_suffix(""): path for path in PACKAGE.rglob("*.py")
    }
    return {".".join(name.parts).removesuffix(".__init__"): path for name, path in names.items()}


def imported(path: Path, modules: dict[str, Path]) -> set[str]:
    """The files of the package that a file imports by name, within functions and for the type
    checker too.
    """
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in modules else str(node.module) for name in names}
    return found & set(modules)


def test_no_files_import_each_other_in_a_circle():
    modules = module_files()
    graph = {name: imported(path, modules) for name, path in modules.items()}
    graphlib.TopologicalSorter(graph).prepare()  # a CycleError names the circle


@pytest.mark.parametrize(
    "folder",
    sorted({path.parent for path in TESTS.rglob("test_*.py")}),
    ids=lambda folder: folder.name,
)
def test_every_folder_has_smoke_tests(folder):
    assert any("@pytest.mark.smoke\n" in path.read_text() for path in folder.glob("test_*.py"))
