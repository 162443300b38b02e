"""Checks of a URDF before it is read: UTF-8 text, addressable names, finite numbers, and lengths,
masses and counts within bounds. Drake itself aborts on some violations, and reports others as
errors in later elements.
"""

import contextlib
import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import yaml

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.files import check_regular

DRAKE = "{http://drake.mit.edu}"
ElementTree.register_namespace("drake", DRAKE.strip("{}"))  # in texts of URDFs
MAX_URDF = 50_000_000  # bytes
MAX_LINKS = 300
MAX_SHAPES = 5_000
MOST_FAR = 1e4  # m, rad, deg
_MAX_NAME = 200  # characters
# strtod's decimal numbers, as Drake reads them; Python's float reads more
_NUMBER = re.compile(r"[-+]?((\d+\.?\d*|\.\d+)(e[-+]?\d+)?|inf|infinity)", re.ASCII | re.I)
_DECLARED = re.compile(r"""\ufeff?\s*<\?xml\s[^>]*?\bencoding\s*=\s*(["'])(.*?)\1""", re.DOTALL)
_NAMED = ("link", "joint", "frame", f"{DRAKE}joint")


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Allowed numbers in a text."""

    most: float = 1e308  # largest size; infinite if infinity is allowed
    least: float = 0.0  # least size of nonzero values
    unit: str = ""
    count: tuple[int, ...] = (1,)
    positive: bool = False
    negative: bool = True  # whether values below zero are allowed

    def problems(self, text: str) -> Iterator[str]:
        """What is wrong with a text, such as "must be a number, not 'a'"."""
        parts, shown = text.split(), f"not '{text[:60]}'"
        if len(parts) not in self.count or not all(map(_NUMBER.fullmatch, parts)):
            many = " or ".join(str(count) for count in self.count if count)
            yield f"must be {'a number' if self.count == (1,) else f'{many} numbers'}, {shown}"
            return
        for value in map(float, parts):
            size, unit = abs(value), f" {self.unit}" * bool(self.unit)
            if self.positive and value <= 0.0:
                yield f"must be > 0{unit}, {shown}"
            elif not self.negative and value < 0.0:
                yield f"must be >= 0{unit}, {shown}"
            elif not math.isfinite(value) and self.most < math.inf:
                yield f"must be finite, {shown}"
            elif size > self.most or 0.0 < size < self.least:
                bounds = f"at most {self.most:g}" + (
                    f" and at least {self.least:g}" if self.least else ""
                )
                yield f"must be {bounds}{unit} in size, {shown}"


_LENGTH = Numbers(MOST_FAR, unit="m")
_SIDE = Numbers(MOST_FAR, least=1e-6, unit="m", positive=True)
_ANGLES = Numbers(1e3, unit="rad", count=(3,))
_PLACE = dataclasses.replace(_LENGTH, count=(3,))
_MOMENT = Numbers(1e15, unit="kg m^2")
_FACTOR = Numbers(1e9)

_CHECKED = {
    "origin": {"xyz": _PLACE, "rpy": _ANGLES},
    "frame": {"xyz": _PLACE, "rpy": _ANGLES},
    "axis": {"xyz": Numbers(1e6, count=(3,))},
    "mass": {"value": Numbers(1e9, least=1e-9, unit="kg")},
    "inertia": dict.fromkeys(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), _MOMENT),
    "box": {"size": dataclasses.replace(_SIDE, count=(3,))},
    "sphere": {"radius": _SIDE},
    "cylinder": {"radius": _SIDE, "length": _SIDE},
    "capsule": {"radius": _SIDE, "length": _SIDE},
    "ellipsoid": {"a": _SIDE, "b": _SIDE, "c": _SIDE},
    "mesh": {"scale": Numbers(1e6, least=1e-9, count=(1, 3))},
    "color": {"rgba": Numbers(1e3, count=(4,))},
    "limit": dict.fromkeys(
        ("lower", "upper", "effort", "velocity", f"{DRAKE}acceleration"), Numbers(math.inf)
    ),
    "dynamics": {"damping": dataclasses.replace(_FACTOR, negative=False), "friction": _FACTOR},
    "rotor_inertia": {"value": dataclasses.replace(_MOMENT, negative=False)},
    "gear_ratio": {"value": _FACTOR},
}


def require(condition: object, problem: str) -> None:
    """Raise ModelError with the problem unless the condition holds."""
    if not condition:
        raise ModelError(problem)


class Faults(list[str]):
    """Texts of ModelErrors, gathered: those raised in its ``with`` blocks."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: object, traceback: object) -> bool:
        if isinstance(error, ModelError):
            self.append(str(error))
        return isinstance(error, ModelError)

    def raise_all(self) -> None:
        """Raise one ModelError with all of them, if there are any."""
        if len(told := list(dict.fromkeys(self))) > 1:
            numbered = "; ".join(f"({k}) {fault}" for k, fault in enumerate(told, 1))
            raise ModelError(f"{len(told)} faults: {numbered}")
        require(not told, "".join(told))


def header_of(text: str) -> str:
    """Return the comments before a root element."""
    before = re.match(r"(?:\s|\ufeff|<\?.*?\?>|<!--.*?-->)*", text, re.DOTALL)
    return "\n".join(re.findall(r"<!--.*?-->", before[0] if before else "", re.DOTALL))


def read_xml(path: Path, what: str) -> tuple[Element, str]:
    """Return the root element and the text of an XML file. Raises ModelError: it is none."""
    try:
        check_regular(path, limit=MAX_URDF)
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise ModelError(f"no such file; give {what}") from error
    except OSError as error:
        raise ModelError(f"cannot be read: {one_line(error)}; give {what}") from error
    text = decoded(content)
    require("<!DOCTYPE" not in text, "has a <!DOCTYPE ...>, not allowed in a URDF; remove it")
    try:
        parser = ElementTree.XMLParser(encoding="utf-8")
        root: Element = ElementTree.fromstring(content, parser)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ModelError(f"is not valid XML: {one_line(error)}") from error
    return root, text


def decoded(content: bytes) -> str:
    """Return the text of a file in UTF-8, as which Drake reads any. Raises ModelError: it is none,
    or the encoding that it declares gives another text.
    """
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ModelError(f"line {line}: is not UTF-8 text; save it as UTF-8") from error
    if found := _DECLARED.match(text):
        try:
            is_same = content.decode(found[2]) == text
        except (LookupError, ValueError):
            is_same = False
        require(is_same, f"declares the encoding '{found[2][:40]}'; save it as UTF-8")
    return text


def number(element: Element, attribute: str, place: str, default: str = "") -> float:
    """Return an attribute as a number; ModelError, which begins with the place, for anything
    else.
    """
    text = element.get(attribute, default)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    require(
        not math.isnan(value),
        f"{place}: <{element.tag} {attribute}> must be a number, not '{text}'",
    )
    return value


def read_limits(joint: Element) -> tuple[float, float, float, float]:
    """Lower and upper position, effort and velocity of a joint (rad, m, N, s); infinite if not
    given.

    Raises ModelError: a limit cannot be used.
    """
    place, limit = f"joint '{joint.get('name', '')}'", joint.find("limit")
    lower, upper, effort, velocity = -math.inf, math.inf, math.inf, math.inf
    if limit is not None:
        moves = joint.get("type") in ("revolute", "prismatic")
        if moves and (limit.get("lower") or limit.get("upper")):
            lower, upper = (number(limit, side, place, "0") for side in ("lower", "upper"))
            require(
                lower <= upper,
                f"{place}: its lower limit {lower:g} lies above its upper limit {upper:g}",
            )
            if lower == upper == 0.0:  # an unknown range, as below
                lower, upper = -math.inf, math.inf
        # Generators write zero for an unknown limit.
        effort, velocity = (
            number(limit, what, place, "0") or math.inf for what in ("effort", "velocity")
        )
        require(
            min(effort, velocity) > 0.0,
            f"{place}: its effort and velocity limits must not be negative",
        )
    return lower, upper, effort, velocity


def check_directives(text: str) -> None:
    """Raise ModelError for the first number of model directives that cannot be a place or angle."""
    with contextlib.suppress(yaml.YAMLError):  # which Drake reports
        for token in yaml.scan(text):
            if isinstance(token, yaml.ScalarToken) and token.plain:
                word = token.value.replace(".inf", "inf")
                if _NUMBER.fullmatch(word) and not abs(float(word)) <= MOST_FAR:
                    raise ModelError(
                        f"line {token.start_mark.line + 1}: a place or angle must be at most "
                        f"{MOST_FAR:g} m, rad or deg in size, not {word[:60]}"
                    )


def check(root: Element) -> None:
    """Raise ModelError, with all faults, unless the element is a URDF whose names, numbers and
    counts can be used.
    """
    require(root.tag == "robot", f"is not a URDF: its root element is <{root.tag}>, not <robot>")
    parts = [part for part in root if part.tag in _NAMED]
    links = sum(part.tag == "link" for part in parts)
    require(links <= MAX_LINKS, f"has {links} links; at most {MAX_LINKS} are read")
    shapes = sum(1 for _ in root.iter("geometry"))
    require(shapes <= MAX_SHAPES, f"has {shapes} shapes; at most {MAX_SHAPES} are read")
    faults = Faults()
    for part in (*parts, *root.findall("material"), *root.findall("transmission")):
        name, tag = part.get("name", ""), part.tag.removeprefix(DRAKE)
        with faults:
            require(name or tag == "transmission", f"a <{tag}> has no name")
            if part in parts:
                _check_name(name, f"{tag} '{name[:_MAX_NAME]}'")
        for element in part.iter():
            faults += [f"{tag} '{name}': {problem}" for problem in _number_problems(element)]
    faults.raise_all()


def _check_name(name: str, place: str) -> None:
    require(len(name) <= _MAX_NAME, f"{place}: its name is longer than {_MAX_NAME} characters")
    fault = "'::', which separates model and name" if "::" in name else ""
    if not name.isprintable() or name != name.strip():
        fault = "a character that is not printed, or a space at an end"
    require(not fault, f"{place}: its name holds {fault}; rename the {place.split()[0]}")


def _number_problems(element: Element) -> Iterator[str]:
    """Problems with the numbers of one element."""
    tag = element.tag.removeprefix(DRAKE)
    for attribute, allowed in _CHECKED.get(tag, {}).items():
        if (text := element.get(attribute)) is None:
            continue
        shown = f"<{tag} {attribute.removeprefix(DRAKE)}>"
        yield from (f"{shown} {problem}" for problem in allowed.problems(text))
