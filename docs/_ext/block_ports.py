"""The table of the closed loop's blocks and their ports, from ffsm_drake.loop.blocks.BLOCKS.

It replaces the line ``<!-- block ports -->`` of a page, as Markdown, when the site is built.
"""

from typing import TYPE_CHECKING, Any

from ffsm_drake.loop.blocks import BLOCKS

if TYPE_CHECKING:
    from sphinx.application import Sphinx

MARKER = "<!-- block ports -->"
_KEYS = {"controller": "`controller`", "forces": "`blocks.forces.<name>`"}


def markdown() -> str:
    """One row for each port of each block."""
    lines = ["| scenario key | port | size |", "|---|---|---|"]
    for block, ports in BLOCKS.items():
        key = _KEYS.get(block, f"`blocks.{block}`")
        for kind, names, optional in (
            ("in", ports.inputs, ""),
            ("in", ports.optional_inputs, ", optional"),
            ("out", ports.outputs, ""),
            ("out", ports.optional_outputs, ", optional"),
        ):
            for name, size in names.items():
                shown = size.replace(" ", "&nbsp;")
                lines.append(f"| {key} | {kind} `{name}`{optional} | {shown} |")
                key = ""
    return "\n".join(lines)


def _insert(app: "Sphinx", docname: str, source: list[str]) -> None:
    source[0] = source[0].replace(MARKER, markdown())


def setup(app: "Sphinx") -> dict[str, Any]:
    app.connect("source-read", _insert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
