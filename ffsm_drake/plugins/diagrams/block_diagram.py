"""Graphviz diagrams of the wiring.

``python -m ffsm_drake.plugins.diagrams.block_diagram`` writes those in ``diagrams/``.
"""

import re
import shutil
import subprocess
import sys
from itertools import zip_longest
from pathlib import Path

from pydrake.geometry import MeshcatVisualizer
from pydrake.systems.framework import DiagramBuilder, System

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.files import write_text, written_whole
from ffsm_drake.loop.closed_loop import add_closed_loop, build_closed_loop, make_closed_loop
from ffsm_drake.scenario import Scenario, load_scenario
from ffsm_drake.show.outputs import MESHCAT_SERVERS
from ffsm_drake.spacecraft.plant import add_combined_plant

NO_GRAPHVIZ = (
    "Graphviz's 'dot' is not installed: no SVG (install the package 'graphviz', or "
    "render the .dot elsewhere)"
)


def closed_loop_dot(scenario: Scenario, *, logged: bool = False) -> str:
    """Return the closed loop as Graphviz text; equal wiring gives equal text.

    Only the connected ports of the plant and the visualizer are drawn: the others depend on Drake's
    release.

    Args:
      scenario: the loop.
      logged: draw the logged outputs and the visualizer too.
    """
    builder = DiagramBuilder()
    if not logged:
        add_closed_loop(builder, scenario)
        diagram = builder.Build()
        diagram.set_name("closed_loop")
        return _without_idle_ports(_without_idle_holds(system_dot(diagram, max_depth=1)), "plant")
    start_meshcat = MESHCAT_SERVERS.only("--logged")  # for the wiring only
    plant = add_combined_plant(builder, scenario.model, flexible=True)
    loop = add_closed_loop(builder, scenario, plant=plant)
    visualizer = MeshcatVisualizer.AddToBuilder(
        builder, builder.GetSubsystemByName("scene_graph"), start_meshcat()
    )
    visualizer.set_name("meshcat_visualizer")
    dot = system_dot(build_closed_loop(builder, loop).diagram, max_depth=1)
    for name in ("plant", "meshcat_visualizer"):
        dot = _without_idle_ports(dot, name)
    return dot


def controller_dot(scenario: Scenario) -> str:
    """Return only the controller of the scenario, with its ports."""
    return system_dot(make_closed_loop(scenario).blocks["controller"])


def system_dot(system: System, *, max_depth: int | None = None) -> str:
    """Any system's wiring as Graphviz text, the same text in every process.

    Args:
      system: a diagram or a leaf system.
      max_depth: levels of nested diagrams to show; None for all.
    """
    text = system.GetGraphvizString(max_depth=max_depth)
    numbers: dict[str, int] = {}

    def renumber(found: re.Match[str]) -> str:
        return f"{found[1]}{numbers.setdefault(found[2], len(numbers))}"

    text = re.sub(
        r"\b(_|s|cluster|clusters)(\d+)(?=in\b|out\b|diagram\b|subsystems\b|\b)", renumber, text
    )
    # Drake lists the connections by memory address.
    edges = re.compile(r"(?:^s\d+\w*:\w+:\w+ -> .*\n)+", re.MULTILINE)
    return edges.sub(lambda found: "".join(sorted(found[0].splitlines(keepends=True))), text)


def _without_idle_holds(dot: str) -> str:
    """Leave out the holds that only a log reads."""
    for block in re.findall(r"(?m)^(s\d+) \[[^\]]*?<B>ZeroOrderHold</B>", dot):
        if not re.search(rf"(?m)^{block}:y", dot):
            dot = re.sub(rf"(?ms)^{block} \[.*?^>\];\n|^[^\n]*-> {block}:[^\n]*\n", "", dot)
    return dot


def _without_idle_ports(dot: str, name: str) -> str:
    """Leave out the unconnected ports of the block with the given name."""
    heading = rf"(s\d+) \[[^\]]*?name={name}\b[^\]]*?</TD></TR>\n"
    block = re.search(rf"{heading}(.*?)</TABLE>", dot, re.DOTALL)
    if block is None:
        return dot
    used = set(re.findall(rf"\b{block[1]}:([uy]\d+):", dot))
    cells = dict(re.findall(r'(<TD PORT="([uy]\d+)".*?</TD>)\n', block[2]))
    sides = [
        [cell for cell, port in cells.items() if port in used and port[0] == side] for side in "uy"
    ]
    rows = "".join(
        f"<TR>\n{a or '<TD></TD>'}\n{b or '<TD></TD>'}\n</TR>\n" for a, b in zip_longest(*sides)
    )
    rows += '<TR><TD BORDER="0" COLSPAN="2">(connected ports)</TD></TR>\n'
    return dot[: block.start(2)] + rows + dot[block.end(2) :]


def write_diagram(dot: str, path: Path) -> str:
    """Write ``path`` (.dot) and, if Graphviz is installed, an .svg file in the same folder.

    Returns: an empty string, or one line with the reason for a missing SVG.

    Raises:
      RecordError: a file cannot be written.
    """
    write_text(path, dot)
    if shutil.which("dot") is None:
        return NO_GRAPHVIZ
    with written_whole(path.with_suffix(".svg")) as temporary:
        drawn = subprocess.run(
            ["dot", "-Tsvg", "-o", temporary, path], capture_output=True, text=True, check=False
        )
        if drawn.returncode != 0:
            temporary.unlink(missing_ok=True)
            temporary.touch()
    return (
        "" if drawn.returncode == 0 else (f"{path}: 'dot' failed: {' '.join(drawn.stderr.split())}")
    )


def shipped_diagrams() -> dict[str, str]:
    """Return the file stem -> Graphviz text of the diagrams in ``diagrams/``."""
    scenario = load_scenario("postcapture")
    return {"closed_loop": closed_loop_dot(scenario), "controller": controller_dot(scenario)}


def main(directory: Path) -> int:
    """Write the shipped diagrams into a directory; returns the exit code."""
    try:
        for name, dot in shipped_diagrams().items():
            remark = write_diagram(dot, directory / f"{name}.dot")
            print(f"{directory / name}.dot{f': {remark}' if remark else ''}")
    except FfsmError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "diagrams")))
