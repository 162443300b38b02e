"""FMUs (FMI 3.0, co-simulation) of C code: description, sources and library in one file."""

import hashlib
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.files import check_writable, written_whole
from ffsm_drake.plugins.flight.functions import Precision
from ffsm_drake.scenario import Scenario

_WRAPPER = ("fmi3.h", "fmu.c", "absent.c")
_COMPILERS = ("cc", "gcc", "clang")
# nothing is fused, so that results are those of the compiled loop; only functions of FMI are seen
_OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared")
_PATIENCE = 600.0  # s, for the compiler
# kind in fmu.h -> element of a variable, causality, variability
_KINDS = {
    "t": ("Float64", "independent", "continuous"),
    "i": ("Float64", "input", "discrete"),
    "p": ("Float64", "parameter", "tunable"),
    "f": ("Float64", "parameter", "fixed"),
    "o": ("Float64", "output", "discrete"),
    "b": ("Boolean", "input", "discrete"),
    "c": ("Boolean", "parameter", "fixed"),
    "u": ("UInt32", "output", "discrete"),
    "s": ("Int64", "parameter", "fixed"),
}
HIDDEN = "-"
_NO_TOKEN = "no token yet"


class Variable(NamedTuple):
    """A variable of an FMU, or a hidden place among its values."""

    name: str
    kind: str  # a key of ``_KINDS``, or HIDDEN
    start: float = 0.0
    unit: str = ""
    about: str = ""


TIME = Variable("time", "t", unit="s")


class Package(NamedTuple):
    """What an FMU consists of."""

    name: str  # identifier of the model
    variables: Sequence[Variable]  # in the order of their values; the first one is TIME
    part: str  # file of ``fmi/`` with the functions that begin and step
    sources: Mapping[str, str]  # file -> text of generated C code
    defined: Mapping[str, str] = {}  # further macros of fmu.h
    most_steps: int = 2**32 - 1


def write_package(scenario: Scenario, package: Package, path: Path) -> str:
    """Write an FMU, and return the platform of its library, such as ``x86_64-linux``.

    Raises FfsmError: no C compiler, or the file cannot be written.
    """
    check_writable(path.parent)
    folder = Path(__file__).parent / "fmi"
    texts = {name: (folder / name).read_text() for name in (*_WRAPPER, package.part)}
    texts |= package.sources
    own = _header(scenario, package)
    token = hashlib.sha256("\n".join((*texts.values(), own)).encode()).hexdigest()
    texts["fmu.h"] = own.replace(_NO_TOKEN, token)
    units = sorted(name for name in texts if name.endswith(".c"))
    files = {f"sources/{name}": text.encode() for name, text in texts.items()}
    files["modelDescription.xml"] = _text(_description(scenario, package, token))
    files["sources/buildDescription.xml"] = _text(_build(package, units))
    files[f"binaries/{_platform()}/{package.name}{_ending()}"] = _compiled(texts, units)
    with written_whole(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in sorted(files.items()):
            entry = zipfile.ZipInfo(name)  # of one date: the same scenario gives the same file
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return _platform()


def _header(scenario: Scenario, package: Package) -> str:
    """The text of fmu.h."""
    number = Precision(single=False).number
    defined = {
        "FMU_TOKEN": f'"{_NO_TOKEN}"',
        "FMU_SAMPLE_TIME": number(scenario.sample_time),
        "FMU_NUM_VALUES": f"{len(package.variables)}",
        "FMU_MOST_STEPS": f"{package.most_steps}U",
        **package.defined,
    }
    macros = "\n".join(f"#define {name} {value}" for name, value in defined.items())
    rows = "\n".join(
        f"  {number(each.start)}, /* {index}: {each.name or 'hidden'} */"
        for index, each in enumerate(package.variables)
    )
    kinds = [f"'{each.kind}'" for each in package.variables]
    lines = [", ".join(kinds[first : first + 16]) for first in range(0, len(kinds), 16)]
    kinds_text = ",\n  ".join(lines)
    return f"""/* The variables of the FMU, in the order of their value references. */
#ifndef FFSM_FMU_H
#define FFSM_FMU_H
#include <math.h>

{macros}

#include "{package.part}"

static const char FMU_KINDS[FMU_NUM_VALUES] = {{
  {kinds_text}
}};
static const double FMU_STARTS[FMU_NUM_VALUES] = {{
{rows}
}};

#endif
"""


def _description(scenario: Scenario, package: Package, token: str) -> ET.Element:
    """The content of modelDescription.xml."""
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=package.name,
        instantiationToken=token,
        description=scenario.description,
        generationTool=f"ffsm_drake {version('ffsm-drake')}",
        variableNamingConvention="flat",
    )
    ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=package.name,
        canHandleVariableCommunicationStepSize="false",
        fixedInternalStepSize=_number(scenario.sample_time),
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    seen = {name: each for name, each in enumerate(package.variables) if each.kind != HIDDEN}
    units = ET.SubElement(root, "UnitDefinitions")
    for unit in sorted({each.unit for each in seen.values()} - {""}):
        ET.SubElement(units, "Unit", name=unit)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError")
    ET.SubElement(
        root,
        "DefaultExperiment",
        startTime="0.0",
        stopTime=_number(scenario.duration),
        stepSize=_number(scenario.sample_time),
    )
    variables = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    for element in ("Output", "InitialUnknown"):
        for reference, each in seen.items():
            if _KINDS[each.kind][1] == "output":
                ET.SubElement(structure, element, valueReference=f"{reference}")
    for reference, each in seen.items():
        variables.append(_variable(reference, each))
    return root


def _variable(reference: int, variable: Variable) -> ET.Element:
    element, causality, variability = _KINDS[variable.kind]
    given = {
        "name": variable.name,
        "valueReference": f"{reference}",
        "causality": causality,
        "variability": variability,
    }
    if variable.about:
        given["description"] = variable.about
    if variable.unit:
        given["unit"] = variable.unit
    if causality in ("input", "parameter"):
        written = {"Boolean": lambda value: str(bool(value)).lower(), "Int64": "{:.0f}".format}
        given["start"] = written.get(element, _number)(variable.start)
    return ET.Element(element, given)


def _build(package: Package, units: Sequence[str]) -> ET.Element:
    """The content of buildDescription.xml."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=package.name)
    options = " ".join(_OPTIONS[1:3])
    files = ET.SubElement(build, "SourceFileSet", language="C99", compilerOptions=options)
    for name in units:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(build, "Library", name="m", external="true")
    return root


def _compiled(texts: Mapping[str, str], units: Sequence[str]) -> bytes:
    """The library that a C compiler of this computer makes."""
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None:
        raise FfsmError(f"an FMU needs a C compiler: none of {', '.join(_COMPILERS)} was found")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [compiler, *_OPTIONS, "-o", "library", *units, "-lm"]
        try:
            for file, text in texts.items():
                (folder / file).write_text(text)
            done = subprocess.run(
                command, cwd=folder, env={**os.environ, "LC_ALL": "C"}, capture_output=True,
                text=True, timeout=_PATIENCE, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise FfsmError(f"{compiler} did not end within {_PATIENCE:g} s") from error
        except OSError as error:
            raise FfsmError(f"{compiler} cannot compile the FMU: {one_line(error)}") from error
        if done.returncode:
            told = re.search(r"error: (.*)", done.stderr)
            why = told[1] if told else f"exit code {done.returncode}"
            raise FfsmError(f"{compiler} cannot compile the FMU: {why}")
        return (folder / "library").read_bytes()


def _platform() -> str:
    """The folder of this computer's libraries."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}
    name = platform.machine().lower()
    return f"{machine.get(name, name)}-{platform.system().lower()}"


def _ending() -> str:
    return ".dylib" if sys.platform == "darwin" else ".so"


def _number(value: float) -> str:
    """A number in XML."""
    if math.isfinite(value):
        return repr(float(value))
    return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="UTF-8", xml_declaration=True)
    return text
