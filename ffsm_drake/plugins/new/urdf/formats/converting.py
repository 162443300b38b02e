"""A model file of any format as the text of a URDF; called in a process of its own."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ffsm_drake.common.errors import ModelError
from ffsm_drake.spacecraft.checked_urdf import require

MOST_NESTED = 200  # levels of elements


def convert(
    path: str,
    packages: Mapping[str, str],
    arguments: Mapping[str, str],
    is_xacro: bool,
    trust: bool,
) -> dict[str, Any]:
    """The text of a file's ``urdf``, and ``remarks`` on omissions.

    Raises ModelError, and whatever the parsers raise.
    """
    file, folders = Path(path), {name: Path(folder) for name, folder in packages.items()}
    content, remarks = file.read_bytes(), list[str]()
    if is_xacro:
        from ffsm_drake.plugins.new.urdf.formats.xacro import expand

        content = expand(file, arguments, folders, trust=trust).encode()
    root = ElementTree.fromstring(content, ElementTree.XMLParser(encoding="utf-8"))
    check_depth(root)
    if root.tag in ("mujoco", "sdf"):
        if is_xacro:
            raise ModelError("expands to another format; expand it first, and give the result")
        if root.tag == "mujoco":
            from ffsm_drake.plugins.new.urdf.formats.mjcf import read_mjcf as read
        else:
            from ffsm_drake.plugins.new.urdf.formats.sdformat import read_sdformat as read
        root, remarks = read(file, folders)
    return {"urdf": ElementTree.tostring(root, encoding="unicode"), "remarks": remarks}


def check_depth(root: ElementTree.Element) -> None:
    """Raise ModelError for elements within elements without end."""
    level, depth = [root], 0
    while level := [child for element in level for child in element]:
        depth += 1
        require(depth <= MOST_NESTED, f"its elements nest deeper than {MOST_NESTED} levels")
