"""A room imports only rooms before it in this list: data flows one way."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "ffsm_drake"
ROOMS = (
    "common",
    "scenario",
    "spacecraft",
    "systems",
    "loop",
    "control_design",
    "runs",
    "preflight",
    "analysis",
    "campaign",
    "show",
    "studies",
    "cli",
)
APART = ({"control_design", "runs"}, {"analysis", "campaign"})  # neighbours: neither imports the other
DRAWING = {"matplotlib", "plotly", "jinja2", "markupsafe"}  # what only pictures and pages need
DRAWS = {"show", "studies"}
# What stands at the top for users: the verbs, the command, the conformance kit.
FACES = ("__init__", "__main__", "testing")


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    room = room_of(path)
    if room in FACES:
        return
    assert room in ROOMS, "a new room: give it its place in the list"
    for node in ast.walk(ast.parse(path.read_text())):  # imports within functions too
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
            if node.module == "ffsm_drake":
                modules = [f"ffsm_drake.{alias.name}" for alias in node.names]
        for module in modules:
            parts = module.split(".")
            assert parts[:2] != ["pydrake", "all"], path
            assert parts[0] not in DRAWING or room in DRAWS, f"{path.name} imports {module}"
            if parts[0] == "ffsm_drake" and len(parts) > 1 and parts[1] != room:
                assert ROOMS.index(parts[1]) < ROOMS.index(room), f"{path.name} imports {module}"
                assert {parts[1], room} not in APART, f"{path.name} imports {module}"
