"""The control law of a scenario as an FMU (FMI 3.0, co-simulation), which needs no Python.

A step is one control sample. At each sample t_k a master sets the inputs, steps the law, and
applies its force: the force of a sample follows from the measurement of the same sample.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from ffsm_drake.plugins.flight.fmu_package import HIDDEN, TIME, Package, Variable, write_package
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.traced import FlightLaw
from ffsm_drake.scenario import HELD, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates

_FRAME = {
    "quaternion": ("w", "x", "y", "z"),
    **dict.fromkeys(("p", "w", "v", "alpha", "a"), ("x", "y", "z")),
}
_FRAME_UNITS = {"p": "m", "w": "rad/s", "v": "m/s", "alpha": "rad/s^2", "a": "m/s^2"}
_FORCES = {"rad": "N m", "m": "N"}  # by the unit of the coordinate


def write_fmu(
    scenario: Scenario, path: Path, float32: bool = False, table: bool = False
) -> list[str]:
    """Write the control law of a scenario as an FMU with C code and its compiled library.

    Args:
      scenario: names the law, its gains, estimator, filters, limits and reference.
      path: FILE.fmu.
      float32: compute in single precision.
      table: the law's own reference as a table, even if it is a polynomial.

    Returns: a line for each thing to know.

    Raises FfsmError: the law cannot be exported as C, no C compiler is found, or the file cannot
    be written.
    """
    files, law = LawFiles.of(scenario, single=float32, table=table), FlightLaw(scenario, HELD)
    macros = dict(re.findall(r"#define LAW_(\w+) (\d+) /", files.header, re.MULTILINE))
    has = {name: int(value) for name, value in macros.items()}
    gains = list(_gains(law))
    variables = [TIME, *_inputs(law.coordinates, has), *gains, *_switches(has)]
    variables += of_velocities(
        "force", law.coordinates, "o", "force of the control law", force=True
    )
    variables += _RESULTS
    package = Package(
        name="ffsm_law",
        variables=variables,
        part="law_part.h",
        sources={"law.h": files.header, "law.c": files.source},
        defined={"FMU_NUM_GAINS": f"{len(gains)}"},
    )
    folder = write_package(scenario, package, path)
    precision = "single" if float32 else "double"
    return [
        f"{path}: the law {scenario.controller} as an FMU (FMI 3.0), {precision} precision",
        f"it has C code, and a library for {folder}",
    ]


def _inputs(names: Coordinates, has: dict[str, int]) -> Iterator[Variable]:
    """The numbers of ``law_in``, in its order."""
    yield from of_positions("measured_position", names, "i", "measured position")
    yield from of_velocities("measured_velocity", names, "i", "measured velocity", "/s")
    yield from of_positions("desired_position", names, "i", "reference position")
    yield from of_velocities("desired_velocity", names, "i", "reference velocity", "/s")
    yield from of_velocities("desired_acceleration", names, "i", "reference acceleration", "/s^2")
    about = "force over the last period"
    yield from of_velocities("applied_force", names, "i", about, force=True)
    if has["READS_IS_NEW"]:
        yield Variable("", HIDDEN, 1.0)  # the quaternion has one entry more
        for kind in ("position", "velocity"):
            for name in names.names:
                about = f"1: the {kind} is measured anew, 0: it is repeated"
                yield Variable(f"is_new_{kind}.{name}", "i", 1.0, "", about)
    if has["READS_FRAME"]:
        for name, axes in _FRAME.items():
            for axis in axes:
                start, unit = float(axis == "w"), _FRAME_UNITS.get(name, "")
                about = "reference of the frame, in the world"
                yield Variable(f"desired_frame.{name}_{axis}", "i", start, unit, about)
    for index in range(has["NUM_WRENCHES"]):
        unit = "N m" if index % 6 < 3 else "N"
        yield Variable(f"measured_wrench.{index}", "i", 0.0, unit, "wrench at a contact")


def _gains(law: FlightLaw) -> Iterator[Variable]:
    """The gains, in the order of ``law_gains``."""
    coordinates = law.coordinates
    for name, (declared, values) in law.gains.items():
        angular, _, linear = declared.unit.partition(" or ")
        numbers, about = values.ravel().tolist(), declared.meaning
        if len(numbers) == coordinates.num_velocities:
            for own, of, value in zip(coordinates.names, coordinates.units, numbers, strict=True):
                unit = linear if linear and of == "m" else angular
                yield Variable(f"gain.{name}.{own}", "p", value, unit, about)
        elif len(numbers) == 1:
            unit, about = ("", f"{declared.unit}: {about}") if linear else (angular, about)
            yield Variable(f"gain.{name}", "p", numbers[0], unit, about)
        else:
            for index, value in enumerate(numbers):
                yield Variable(f"gain.{name}.{index}", "p", value, "" if linear else angular, about)


def _switches(has: dict[str, int]) -> Iterator[Variable]:
    about = "true: the reference of the scenario, false: the inputs desired_..."
    yield Variable("own_reference", "c" if has["HAS_REFERENCE"] else HIDDEN, about=about)
    about = "true: forget what was a sample ago, as velocities jumped"
    yield Variable("is_first", "b", about=about)
    yield Variable(
        "holds_target", "b" if has["HAS_CAPTURE"] else HIDDEN, about="a grasp holds the target"
    )


_RESULTS = (
    Variable(
        "status", "u", about="0: good sample, 1: the last force is held, 2: the force is zero"
    ),
    Variable("causes", "u", about="bits LAW_BAD_... of sources/law.h: why the sample is not good"),
    Variable("warnings", "u", about="bits LAW_BEYOND_..., LAW_FORCE_LIMITED of sources/law.h"),
)


def of_positions(group: str, names: Coordinates, kind: str, about: str) -> Iterator[Variable]:
    """The variables of a configuration (nq)."""
    units = ("",) * 4 + names.units[3:]
    for index, (name, unit) in enumerate(zip(names.position_names, units, strict=True)):
        yield Variable(f"{group}.{name}", kind, float(index == 0), unit, about)


def of_velocities(
    group: str, names: Coordinates, kind: str, about: str, per: str = "", *, force: bool = False
) -> Iterator[Variable]:
    """The variables of a vector along v (nv), whose units are those of its coordinates ``per``
    time, or those of forces.
    """
    for name, unit in zip(names.names, names.units, strict=True):
        own = _FORCES[unit] if force else f"{unit}{per}"
        yield Variable(f"{group}.{name}", kind, 0.0, own, about)
