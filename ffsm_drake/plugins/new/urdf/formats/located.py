"""Elements of an XML file with their lines, which stay when other elements are removed."""

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from ffsm_drake.spacecraft.checked_urdf import MOST_FAR, Numbers, decoded

Lines = Mapping[Element, int]
_NUMBERS = {  # element of SDFormat -> the numbers that its text holds
    **dict.fromkeys(
        (
            "mass", "ixx", "iyy", "izz", "ixy", "ixz", "iyz", "radius", "length", "damping",
            "friction", "spring_stiffness", "spring_reference", "multiplier", "offset", "reference",
        ), Numbers()),
    **dict.fromkeys(("lower", "upper", "effort", "velocity"), Numbers(math.inf)),
    **dict.fromkeys(("diffuse", "ambient", "specular", "emissive"), Numbers(count=(3, 4))),
    **dict.fromkeys(("xyz", "scale"), Numbers(count=(3,))),
    "pose": Numbers(MOST_FAR, unit="m, rad or deg", count=(0, 6, 7)),
    "size": Numbers(count=(2, 3)),
}  # fmt: skip


def read_located(path: Path) -> tuple[Element, Lines]:
    """The root element of a file in UTF-8, and the lines of all elements."""
    builder, lines = TreeBuilder(), dict[Element, int]()
    parser = expat.ParserCreate("utf-8", "}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        given = {_spaced(key): value for key, value in attributes.items()}
        lines[builder.start(_spaced(tag), given)] = parser.CurrentLineNumber

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: builder.end(_spaced(tag))
    parser.CharacterDataHandler = builder.data
    parser.Parse(decoded(path.read_bytes()), True)
    return builder.close(), lines


def _spaced(name: str) -> str:
    return f"{{{name}" if "}" in name else name


def keep_lines(root: Element, lines: Lines) -> None:
    """Change the white space between elements so that each is written on its own line again."""
    here = lines[root]

    def space(given: str | None, line: int) -> str:
        """White space up to a line; text stays."""
        nonlocal here
        text = given if given and given.strip() else "\n" * max(line - here, 0)
        here += text.count("\n")
        return text

    def visit(element: Element) -> None:
        ahead = [lines.get(child, 0) for child in element]
        element.text = space(element.text, ahead[0] if ahead else 0)
        for child, line in zip(element, [*ahead, 0][1:], strict=True):
            visit(child)
            child.tail = space(child.tail, line)

    visit(root)


def number_faults(elements: Iterable[Element], lines: Lines) -> Iterator[str]:
    """Texts of elements of SDFormat that are not the numbers that they must be."""
    for root in elements:
        for element in root.iter():
            allowed, text = _NUMBERS.get(element.tag), (element.text or "").strip()
            if allowed is not None and (text or not len(element)):
                place = f"line {lines.get(element, 0)}: <{element.tag}>"
                yield from (f"{place} {problem}" for problem in allowed.problems(text))
