"""Xacro files: macros of ROS that expand to a URDF."""

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.plugins.new.urdf.elements import package_folders


def expand(path: Path, arguments: Mapping[str, str], packages: Mapping[str, Path]) -> str:
    """The text of a xacro file's URDF.

    Args:
      arguments: values of its <xacro:arg>.
      packages: folders of the packages in $(find NAME); others are searched above the file.

    Raises ModelError: the package xacro is not installed, or cannot expand the file.
    """
    try:
        import xacro
        from xacro import substitution_args
    except ImportError as error:
        raise ModelError(
            f"is a xacro file: pip install 'ffsm-drake[xacro]', or expand it: xacro {path.name} > "
            f"{path.name.split('.')[0]}.urdf"
        ) from error

    def find(package: str) -> str:
        for folder in package_folders(package, path.resolve(), packages):
            if folder.is_dir():
                return str(folder.resolve())
        raise ModelError(f"$(find {package}): no such package; give --package {package}=FOLDER")

    usual, substitution_args._eval_find = substitution_args._eval_find, find
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            document = xacro.process_file(str(path), mappings=dict(arguments))
        return str(document.toxml())
    except Exception as error:  # whatever the expressions in the file raise
        given = f" (given: {', '.join(arguments)})" if arguments else ""
        advice = "; give --xacro-arg NAME=VALUE" if "Undefined substitution" in str(error) else ""
        raise ModelError(f"cannot be expanded: {one_line(error)}{advice}{given}") from error
    finally:
        substitution_args._eval_find = usual
