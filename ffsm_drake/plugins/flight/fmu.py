"""The plant or the law of a scenario as an FMU (FMI 3.0, co-simulation), which needs no Python.

A step is one control sample. At each sample t_k a master takes the plant's outputs to the law,
steps the law, takes its force to the plant, and steps the plant: the force of a sample follows from
the measurement of the same sample.
"""

from collections.abc import Collection, Iterator
from pathlib import Path

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.flight.fmu_package import HIDDEN, TIME, Package, Variable, write_package
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.plant import PlantFiles
from ffsm_drake.plugins.flight.traced import FlightLaw
from ffsm_drake.scenario import HELD, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.craft import Craft

_FRAME = {
    "quaternion": ("w", "x", "y", "z"),
    **dict.fromkeys(("p", "w", "v", "alpha", "a"), ("x", "y", "z")),
}
_FRAME_UNITS = {"p": "m", "w": "rad/s", "v": "m/s", "alpha": "rad/s^2", "a": "m/s^2"}
_FORCES = {"rad": "N m", "m": "N"}  # by the unit of the coordinate


PARTS = ("plant", "controller")


def write_fmu(
    scenario: Scenario, path: Path, part: str = "plant", float32: bool = False, table: bool = False
) -> list[str]:
    """Write the plant or the control law of a scenario as an FMU with C code and its library.

    Args:
      scenario: the scenario.
      path: FILE.fmu.
      part: one of ``PARTS``.
      float32: compute the law in single precision.
      table: the reference as a table, even if it is a polynomial.

    Returns: a line for each thing to know.

    Raises FfsmError: the part cannot be exported as C, no C compiler is found, or the file cannot
    be written.
    """
    if part not in PARTS:
        raise FfsmError(f"--part: must be one of {', '.join(PARTS)}, not '{part}'")
    if float32 and part == "plant":
        raise FfsmError("--float32: only for --part controller")
    if part == "plant":
        what = "the plant"
        package = _plant(scenario, PlantFiles.of(scenario, table=table))
    else:
        precision = "single" if float32 else "double"
        what = f"the law {scenario.controller}, in {precision} precision,"
        package = _law(scenario, LawFiles.of(scenario, single=float32, table=table))
    folder = write_package(scenario, package, path)
    return [f"{path}: {what} as an FMU (FMI 3.0) with C code and a library for {folder}"]


def _law(scenario: Scenario, files: LawFiles) -> Package:
    law = FlightLaw(scenario, HELD)
    gains, variables = list(_gains(law)), [TIME, *_inputs(law, files.reads)]
    has_reference, grasps = bool(files.reference), bool(scenario.grasps)
    variables += [*gains, *_switches(has_reference=has_reference, grasps=grasps)]
    variables += of_velocities("force", law.coordinates, "o", "force of the law", force=True)
    return Package(
        name="ffsm_law",
        variables=[*variables, *_RESULTS],
        part="law_part.h",
        sources={"law.h": files.header, "law.c": files.source},
        defined={"FMU_NUM_GAINS": f"{len(gains)}"},
    )


def _plant(scenario: Scenario, files: PlantFiles) -> Package:
    names = Craft(scenario).coordinates
    about = "true mass of the payload; its inertia stays"
    mass, seed = scenario.payload.truth.mass, float(scenario.random_seed)
    variables = [
        TIME,
        Variable("payload_mass", "f" if files.has_payload else HIDDEN, mass, "kg", about),
        Variable("seed", "s" if files.has_seed else HIDDEN, seed, "", "seed of the noise"),
        *of_velocities("force", names, "i", "force of the law", force=True),
    ]
    for group, *_, size in files.shown:
        variables += _group(group, size, names, "o")
    return Package(
        name="ffsm_plant",
        variables=variables,
        part="plant_part.h",
        sources={"plant.h": files.header, "plant.c": files.source},
        most_steps=scenario.num_control_periods,
    )


_POSITIONS = {
    "position": "true position",
    "measured_position": "measured position",
    "desired_position": "reference position",
}
_VELOCITIES = {  # meaning, and what their units are divided by
    "velocity": ("true velocity", "/s"),
    "measured_velocity": ("measured velocity", "/s"),
    "desired_velocity": ("reference velocity", "/s"),
    "desired_acceleration": ("reference acceleration", "/s^2"),
    "error": ("tracking error", ""),
    "error_rate": ("rate of the tracking error", "/s"),
}


def _group(group: str, size: int, names: Coordinates, kind: str) -> Iterator[Variable]:
    """The variables of a group that both parts can have, in the order of their numbers."""
    if group in _POSITIONS:
        yield from of_positions(group, names, kind, _POSITIONS[group])
    elif group in _VELOCITIES:
        yield from of_velocities(group, names, kind, *_VELOCITIES[group])
    elif group == "applied_force":
        yield from of_velocities(group, names, kind, "force over the last period", force=True)
    elif group == "is_new":
        yield Variable("", HIDDEN, 1.0)  # the quaternion has one entry more
        for of in ("position", "velocity"):
            for name in names.names:
                about = f"1: the {of} is measured anew, 0: it is repeated"
                yield Variable(f"is_new_{of}.{name}", kind, 1.0, "", about)
    elif group == "desired_frame":
        for name, axes in _FRAME.items():
            for axis in axes:
                start, unit = float(axis == "w"), _FRAME_UNITS.get(name, "")
                about = "reference of the frame, in the world"
                yield Variable(f"{group}.{name}_{axis}", kind, start, unit, about)
    else:
        for index in range(size):
            unit = "N m" if index % 6 < 3 else "N"
            yield Variable(f"{group}.{index}", kind, 0.0, unit, "wrench at a contact")


def _inputs(law: FlightLaw, reads: Collection[str]) -> Iterator[Variable]:
    """The numbers of ``law_in``, in its order."""
    groups = ["measured_position", "measured_velocity", "desired_position", "desired_velocity"]
    groups += ["desired_acceleration", "applied_force"]
    optional = {"measurement_is_new": "is_new", "desired_frame": "desired_frame"}
    groups += [group for name, group in optional.items() if name in reads]
    groups += ["measured_wrench"] if "measured_wrench" in reads else []
    for group in groups:
        yield from _group(group, law.inputs.get(group, 0), law.coordinates, "i")


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


def _switches(*, has_reference: bool, grasps: bool) -> Iterator[Variable]:
    about = "true: the reference of the scenario, false: the inputs desired_..."
    yield Variable("own_reference", "c" if has_reference else HIDDEN, about=about)
    about = "true: there is no sample before, or velocities jumped since"
    yield Variable("is_first", "b", about=about)
    about = "true: a grasp holds the target"
    yield Variable("holds_target", "b" if grasps else HIDDEN, about=about)


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
