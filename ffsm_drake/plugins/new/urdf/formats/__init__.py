"""Models in MJCF, SDFormat and xacro, converted to URDF.

Elements without effect in free flight are omitted and listed. Elements that change the dynamics and
have no counterpart are errors, all in one message.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ffsm_drake.plugins.new.apart import answer
from ffsm_drake.plugins.new.urdf.formats.building import without_pictures
from ffsm_drake.plugins.new.urdf.formats.converting import check_depth, convert
from ffsm_drake.spacecraft.checked_urdf import check, header_of, read_xml, require
from ffsm_drake.spacecraft.inertia import mend
from ffsm_drake.spacecraft.model_files import files_of

__all__ = ["as_urdf", "read_model"]

_XACRO = re.compile(r"\bxmlns:xacro\s*=")


def read_model(
    path: Path,
    what: str,
    packages: Mapping[str, Path],
    arguments: Mapping[str, str],
    *,
    trust: bool = False,
) -> tuple[Element, str, list[str]]:
    """Return the root element of the URDF of a file, the comments before it, and remarks on
    omissions.

    A URDF is read in this process. Other formats, and URDFs that declare the namespace of xacro,
    are read in a separate process.

    Args:
      path: the file.
      what: what the file should be, for errors.
      packages: folders of its packages.
      arguments: values of the arguments of a xacro file.
      trust: see ``xacro.expand``.

    Raises ModelError, also for unusable names and numbers.
    """
    root, text = read_xml(path, what)
    remarks = list[str]()
    is_xacro = path.suffix == ".xacro" or bool(_XACRO.search(text))
    require(is_xacro or not arguments, "--xacro-arg is for xacro files, and this one is not")
    check_depth(root)
    if is_xacro or root.tag in ("mujoco", "sdf"):
        folders = {name: str(folder.absolute()) for name, folder in packages.items()}
        if root.tag == "mujoco":
            files_of(str(path), "its files", folders)
        found = answer(
            convert, path=str(path), packages=folders, arguments=dict(arguments),
            is_xacro=is_xacro, trust=trust,
        )  # fmt: skip
        root, remarks = ElementTree.fromstring(found["urdf"]), found["remarks"]
    check(root)
    mend(root)
    return root, header_of(text), remarks


def as_urdf(path: Path) -> str:
    """Return the URDF of a model file as text, without visuals and joint friction, for its dynamics
    only.

    Raises ModelError.
    """
    root, _, _ = read_model(path, "a model", {}, {})
    for joint in root.findall("joint"):
        for dynamics in joint.findall("dynamics"):
            joint.remove(dynamics)
    return without_pictures(root)
