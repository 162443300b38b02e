"""Models in MJCF, SDFormat and xacro, converted to URDF.

Elements without effect in free flight are passed over and listed. Elements that change dynamics and
have no counterpart are errors, all in one message.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ffsm_drake.plugins.new.urdf.formats.mjcf import read_mjcf
from ffsm_drake.plugins.new.urdf.formats.sdformat import read_sdformat
from ffsm_drake.plugins.new.urdf.formats.xacro import expand
from ffsm_drake.spacecraft.checked_urdf import check, header_of, read_xml, require

__all__ = ["read_model"]


def read_model(
    path: Path, what: str, packages: Mapping[str, Path], arguments: Mapping[str, str]
) -> tuple[Element, str, list[str]]:
    """The root element of a file's URDF, the comments before it, and remarks on omissions.

    Args:
      path: the file.
      what: what it should be, for errors.
      packages: folders of its packages.
      arguments: values of the arguments of a xacro file.

    Raises ModelError, also for unusable names and numbers.
    """
    root, text = read_xml(path, what)
    remarks = list[str]()
    is_xacro = path.suffix == ".xacro" or any("xacro" in each.tag for each in root.iter())
    require(is_xacro or not arguments, "--xacro-arg is for xacro files, and this one is not")
    if is_xacro:
        root = ElementTree.fromstring(expand(path, arguments, packages))
    readers = {"mujoco": read_mjcf, "sdf": read_sdformat}
    if root.tag in readers:
        root, remarks = readers[root.tag](path, packages)
    check(root)
    return root, header_of(text), remarks
