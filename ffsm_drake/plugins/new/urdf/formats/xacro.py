"""Xacro files: macros of ROS that expand to a URDF.

The package xacro runs expressions as Python, which code can escape from. Here ``expressions.py``
computes them. Files are opened only in the folder of the model and in packages, unless the file is
trusted.
"""

import contextlib
import io
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.elements import package_folders
from ffsm_drake.plugins.new.urdf.formats.expressions import (
    EVAL_KNOWN,
    KNOWN,
    Space,
    evaluate,
)
from ffsm_drake.spacecraft.checked_urdf import MAX_URDF, require

_MISSING = re.compile(r"Undefined substitution argument (\w+)")
_DEPTH, _FILES, _CALLS = 50, 1000, 20_000  # nested includes, files read, macros called
_PACKAGE = "package.xml"  # in the folder of every ROS package
_SUFFIX = 80  # characters of an expression in an error
_TRUST = "; if you trust the file, give --trust"


def expand(
    path: Path, arguments: Mapping[str, str], packages: Mapping[str, Path], *, trust: bool
) -> str:
    """Return the text of the URDF of a xacro file.

    Args:
      arguments: values of its <xacro:arg>.
      packages: folders of the packages in $(find NAME); others are searched above the file.
      trust: allow load_yaml, environment variables, and files outside the folder of the package of
        the model and outside other packages.

    Raises ModelError: the package xacro is not installed, or cannot expand the file.
    """
    try:
        import xacro
    except ImportError as error:
        raise ModelError(
            f"is a xacro file: pip install 'ffsm-drake[xacro]', or expand it: xacro {path.name} > "
            f"{path.name.split('.')[0]}.urdf"
        ) from error
    missing, besides = dict[str, str](), ""  # a stand-in by name, so that one message names all
    while True:
        reader = _Reader(xacro, path, packages, trust)
        try:
            with reader.installed(), contextlib.redirect_stderr(io.StringIO()):
                mappings = {**arguments, **missing}
                text = str(xacro.process_file(str(path), mappings=mappings).toxml())
            break
        except Exception as error:  # whatever the expressions in the file raise
            found = _MISSING.search(one_line(error))
            if found is None or found[1] in missing:
                told = _told(xacro, error, path)
                if not missing:
                    given = f" (given: {', '.join(arguments)})" if arguments else ""
                    raise ModelError(f"cannot be expanded: {told}{given}") from error
                besides = f"; also, {told}" if "is not defined" in told else ""
                break
            missing[found[1]] = ""
    if missing:
        advice = " ".join(f"--xacro-arg {name}=..." for name in missing)
        count = counted(len(missing), "argument")
        raise ModelError(f"{count} missing, without a default: give {advice}{besides}")
    return text


def _told(xacro: Any, error: BaseException, path: Path) -> str:
    """Return what went wrong, once, and where."""
    cause, suffix = error, ""
    while isinstance(cause, xacro.XacroException) and cause.exc is not None:
        suffix, cause = (cause.suffix or suffix).strip()[:_SUFFIX], cause.exc
    told = one_line(cause)
    if isinstance(cause, OSError) and cause.filename:
        told = f"{cause.strerror}: {cause.filename}"
    elif isinstance(cause, RecursionError):
        told, suffix = "its macros, properties or files nest too deeply, or use themselves", ""
    file = (xacro.filestack or [None])[-1]
    inside = "" if file is None or Path(file) == path else f", in {file}"
    return " ".join(f"{told} {suffix}".split()) + inside


class _Reader:
    """Replacements of functions of the package xacro, for one reading of a file."""

    def __init__(self, xacro: Any, path: Path, packages: Mapping[str, Path], trust: bool) -> None:
        self.xacro, self.packages, self.trust = xacro, packages, trust
        self.source = path.resolve()
        self.folder = next(
            (each for each in self.source.parents if (each / _PACKAGE).is_file()),
            self.source.parent,
        )
        self.roots = [self.folder, *(folder.resolve() for folder in packages.values())]
        self.files = self.calls = 0
        self.known = KNOWN | {"xacro": self._own()}
        self.known |= {name: self.known["xacro"][name] for name in _OWN_GLOBAL}

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace functions of the package in the block."""
        from xacro import substitution_args

        usual_parse, usual_call = self.xacro.parse, self.xacro.handle_macro_call

        def parse(inp: Any, filename: Any = None) -> Any:
            if inp is None:
                self.check(Path(self.xacro.root_dir, filename))
            return usual_parse(inp, filename)

        def handle_macro_call(*args: Any) -> Any:
            self.calls += args[0].tagName.startswith("xacro:")
            require(self.calls <= _CALLS, f"more than {_CALLS} macros are called")
            return usual_call(*args)

        own = {
            (self.xacro, "parse"): parse,
            (self.xacro, "handle_macro_call"): handle_macro_call,
            (self.xacro, "safe_eval"): self.evaluate,
            (substitution_args, "_eval"): self.evaluate_extension,
            (substitution_args, "_eval_find"): self.find,
            (substitution_args, "_eval_env"): self.environment,
            (substitution_args, "_eval_optenv"): self.environment,
        }
        with contextlib.ExitStack() as stack:
            for place, function in own.items():
                stack.callback(setattr, *place, getattr(*place))
                setattr(*place, function)
            yield

    def check(self, file: Path) -> None:
        """Raise ModelError for a file that must not be read."""
        self.files += 1
        require(self.files <= _FILES, f"more than {_FILES} files are included")
        require(
            len(self.xacro.filestack) <= _DEPTH,
            f"files include each other more than {_DEPTH} deep; does one include itself?",
        )
        within = any(file.resolve().is_relative_to(root) for root in self.roots)
        require(
            self.trust or within,
            f"{file} is outside the model's folder {self.folder}{_TRUST}",
        )
        with contextlib.suppress(FileNotFoundError):  # which xacro reports, or may pass over
            try:
                check_regular(file, limit=MAX_URDF)
            except FileNotFoundError:
                raise
            except OSError as error:
                raise ModelError(f"{file}: {one_line(error)}; give a file") from error

    def find(self, package: str) -> str:
        """Return the folder of a package. A package that is not named must hold package.xml, or the
        model.
        """
        for folder in package_folders(package, self.source, self.packages):
            place = folder.resolve()
            holds = place in self.source.parents and not Path.home().resolve().is_relative_to(place)
            known = holds or place in self.roots or (place / _PACKAGE).is_file()
            if place.is_dir() and (known or self.trust):
                self.roots.append(place)
                return str(place)
        raise ModelError(f"$(find {package}): no such package; give --package {package}=FOLDER")

    def environment(self, name: str, default: str | None = None) -> str:
        require(self.trust, f"reads the environment variable {name[:40]}{_TRUST}")
        value = os.environ.get(name, default)
        require(value is not None, f"the environment variable {name[:40]} is not set")
        return str(value)

    def evaluate(self, expression: str, symbols: Any, _: Any = None) -> Any:
        """The value of ${expression}."""
        return evaluate(expression, lambda name: self._symbol(symbols, name), self._attribute)

    def evaluate_extension(self, expression: str, context: dict[str, Any]) -> str:
        """The text of $(eval expression)."""
        from xacro.substitution_args import convert_value

        given = context.get("arg", {})
        known: dict[str, Any] = EVAL_KNOWN | {
            "arg": lambda name: convert_value(given[name], "auto"),
            "find": self.find, "env": self.environment, "optenv": self.environment,
        }  # fmt: skip
        return str(
            evaluate(
                expression,
                lambda name: known[name] if name in known else convert_value(given[name], "auto"),
                self._attribute,
            )
        )

    def _symbol(self, symbols: Any, name: str) -> Any:
        """Return a property, or a known function."""
        while isinstance(symbols, self.xacro.Table):
            if dict.__contains__(symbols, name):
                return symbols._resolve_(name)
            symbols = symbols.parent
        return self.known[name]

    def _attribute(self, value: Any, name: str) -> Any:
        """Return the name after a dot: a property of included files, or an entry of YAML."""
        if isinstance(value, self.xacro.NameSpace):
            try:
                return self._symbol(value, name)
            except KeyError:
                raise NameError(f"name '{name}' is not defined") from None
        require(
            isinstance(value, self.xacro.YamlDictWrapper),
            f"'.{name[:40]}' is not allowed in an expression",
        )
        return value[name]

    def _own(self) -> Space:
        """The functions of xacro itself."""
        from xacro.substitution_args import ArgException

        def silent(*_: Any, **__: Any) -> str:
            return ""

        def fatal(*texts: Any) -> None:
            raise ModelError(" ".join(map(str, texts)))

        def load_yaml(filename: str) -> Any:
            require(self.trust, f"load_yaml reads a file{_TRUST}")
            self.check(Path(self.xacro.abs_filename_spec(filename)))
            return self.xacro.load_yaml(filename)

        def arg(name: str) -> Any:
            given = self.xacro.substitution_args_context["arg"]
            if name not in given:
                raise ArgException(name)
            return given[name]

        return Space(
            message=silent, warning=silent, error=silent, print_location=silent, fatal=fatal,
            load_yaml=load_yaml, arg=arg, abs_filename=self.xacro.abs_filename_spec,
            dotify=self.xacro.YamlDictWrapper, tokenize=self.xacro.tokenize,
        )  # fmt: skip


_OWN_GLOBAL = ("load_yaml", "abs_filename", "dotify")
