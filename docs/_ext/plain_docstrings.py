"""Lets docstrings that are written to be read as plain text through reStructuredText: |s|,
formulas, lists of ports.
"""

import re
from typing import Any

from sphinx.application import Sphinx

_LIST = re.compile(r"^(Inputs|Outputs|Keys|Discrete state)\b.*:$")
_LITERAL = re.compile(r"(``.*?``)")
_COLON = "\ue000"  # stands for a colon while napoleon reads a docstring
_RETURNS = re.compile(r"Returns: (.+)$")  # on one line; napoleon would read words as a type


def readable(lines: list[str], *, module: bool) -> list[str]:
    """The docstring with bars escaped, lists of names as bullets and, in a module's, indented
    formulas as literals.
    """
    result: list[str] = []
    position = 0
    while position < len(lines):
        line = lines[position]
        position += 1
        if found := _RETURNS.match(line):
            result += ["", _escaped(f":returns: {found[1]}")]
            while position < len(lines) and lines[position].strip():
                result.append(_escaped(f"  {lines[position].strip()}"))
                position += 1
        elif _LIST.match(line):
            result += ["", line, ""]
            while position < len(lines) and lines[position].startswith("  "):
                item = lines[position][2:]
                result.append(
                    _escaped(f"  {item.strip()}" if item.startswith(" ") else f"* {item}")
                )
                position += 1
            result.append("")
        elif module and line.startswith("    ") and result and not result[-1].strip():
            result += ["::", ""]
            while position <= len(lines) and (line.startswith("    ") or not line.strip()):
                result.append(line)
                line = lines[position] if position < len(lines) else "end"
                position += 1
            result.append("")
            position -= 1
        else:
            result.append(_escaped(line))
    return result


def _escaped(line: str) -> str:
    return "".join(
        part if part.startswith("``") else part.replace("|", "\\|").replace("\\\\|", "\\|")
        for part in _LITERAL.split(line)
    )


def _process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = readable(lines, module=what == "module")
    # Napoleon takes the words before a colon, in the first line of a property, for its type.
    if what in ("attribute", "property") and ":" in lines[0]:
        lines[0] = lines[0].replace(":", _COLON)


def _restore(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = [line.replace(_COLON, ":") for line in lines]


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("autodoc-process-docstring", _process, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", _restore, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
