"""Xacro files: macros of ROS that expand to a URDF."""

import contextlib
import io
import re
from collections.abc import Mapping
from pathlib import Path

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.elements import package_folders

_MISSING = re.compile(r"Undefined substitution argument (\w+)")


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

    def expanded(known: Mapping[str, str]) -> str:
        with contextlib.redirect_stderr(io.StringIO()):
            return str(xacro.process_file(str(path), mappings=dict(known)).toxml())

    usual, substitution_args._eval_find = substitution_args._eval_find, find
    missing, besides = dict[str, str](), ""  # a stand-in by name, so that one message names all
    try:
        while True:
            try:
                text = expanded({**arguments, **missing})
                break
            except Exception as error:  # whatever the expressions in the file raise
                told = one_line(error)
                found = _MISSING.search(told)
                if found is None or found[1] in missing:
                    if not missing:
                        given = f" (given: {', '.join(arguments)})" if arguments else ""
                        raise ModelError(f"cannot be expanded: {told}{given}") from error
                    besides = f"; besides, {told}" if "is not defined" in told else ""
                    break
                missing[found[1]] = ""
    finally:
        substitution_args._eval_find = usual
    if missing:
        advice = " ".join(f"--xacro-arg {name}=..." for name in missing)
        count = counted(len(missing), "argument")
        raise ModelError(f"{count} missing, without a default: give {advice}{besides}")
    return text
