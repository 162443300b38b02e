"""The sections ``model``, ``payload`` and the postures: the simulated bodies and their
placement.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import (
    ORIGIN,
    X_AXIS,
    ZERO,
    PerCoordinate,
    choice_of,
    identifier_problems,
    unitless,
    vector_in,
)


@dataclass
class Flexible:
    """A flexible part of the true spacecraft. The controller's model treats it as rigid.

    The mass of the carrying body includes the mass of a panel, beam, sloshing mass or pendulum.
    """

    KIND: ClassVar[str] = "kind"  # another one drops the inherited settings

    kind: str = choice_of(
        "panel",
        'kind of part: "panel": plates on hinges; "beam": bending modes of a uniform cantilever; '
        '"mass": a point mass on a spring, such as slosh; "pendulum": a point mass on a rod; '
        '"joint": a joint of the model with a spring and without a drive; "gear": a spring between '
        "the rotor of a joint drive (actuation.drives.rotor_inertia) and the link",
        "panel",
        "beam",
        "mass",
        "pendulum",
        "joint",
        "gear",
    )
    body: str = unitless(
        "servicer::base", "scoped name of the body that carries a panel, beam, mass or pendulum"
    )
    joint: str | None = unitless(None, "name of the joint in the model; only for joint and gear")
    position: list[float] = vector_in(
        ORIGIN,
        "m",
        "position of the hinge, root, pivot or resting point mass in the frame of the body",
    )
    direction: list[float] = vector_in(
        [0.0, 1.0, 0.0],
        "",
        "direction from the hinge, root or pivot to the part, or direction in which a point mass "
        "moves, in the frame of the body; any length",
        nonzero=True,
    )
    axis: list[float] = vector_in(
        X_AXIS,
        "",
        "axis of the hinges or of bending, perpendicular to ``direction``, in the frame of the "
        "body; any length",
        nonzero=True,
    )
    mass: float = setting(2.0, "kg", "mass of the panel, beam, point mass or pendulum", above=0)
    length: float = setting(
        3.0, "m", "length of the panel, of the beam, or of the rod of the pendulum", above=0
    )
    width: float = setting(1.0, "m", "width of the panel along ``axis``", above=0)
    plates: int = unitless(
        1,
        "number of plates of a panel; equal plates in a row, each on a hinge",
        least=1,
        most=10,
    )
    frequency: float | None = setting(
        None,
        "Hz",
        "natural frequency with the body fixed; for a panel, the lowest one; for a joint or gear, "
        "in the zero posture; null if ``stiffness`` is given",
        above=0,
    )
    frequencies: list[float] = setting(
        [],
        "Hz",
        "natural frequencies of the first modes of a beam with a fixed root",
        above=0,
        size=(0, 5),
    )
    stiffness: float | None = setting(
        None,
        "N m/rad or N/m",
        "stiffness of each hinge or of the spring; null if ``frequency`` is given",
        above=0,
    )
    damping_ratio: float = unitless(
        0.005, "damping ratio at ``frequency``, or of each mode of a beam", least=0, below=1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that one stiffness is given, and only settings of the kind."""
        of_joint = self.kind in ("joint", "gear")
        along, axis = (np.divide(v, np.linalg.norm(v)) for v in (self.direction, self.axis))
        if not of_joint and self.kind != "mass" and abs(along @ axis) >= 1e-6:
            yield f"{key}.axis", f"must be across direction {self.direction}, not {self.axis}"
        if of_joint != (self.joint is not None):
            unused = f"has no effect on a {self.kind}; remove it"
            yield f"{key}.joint", "give the name of a joint of the model" if of_joint else unused
        given = (self.frequency is not None) + (self.stiffness is not None)
        if self.kind == "beam":
            if given:
                yield f"{key}.frequency", "has no effect on a beam; remove it, and set frequencies"
            if not self.frequencies:
                yield f"{key}.frequencies", "give the frequencies of 1 to 5 modes, Hz"
        else:
            if self.frequencies:
                yield f"{key}.frequencies", f"have no effect on a {self.kind}; set frequency"
            if given != 1:
                yield f"{key}.frequency", "give either frequency (Hz) or stiffness"
        drives = scenario.actuation.drives
        rotors = {} if drives is None else drives.rotor_inertia or {}
        rotor = next((rotors[key] for key in (self.joint, "joints", "all") if key in rotors), 0.0)
        if self.kind == "gear" and rotor == 0:
            yield (
                "actuation.drives.rotor_inertia",
                f"must be > 0 kg m^2 for {self.joint}, because '{key.rpartition('.')[2]}' is a "
                "gear "
                "between its rotor and its link",
            )


@dataclass
class Model:
    """The models of servicer and target, and the frames in reports.

    Files are package:// addresses or paths. Relative paths start at the folder of the scenario
    file.
    """

    directives: str | None = unitless(
        "package://ffsm_drake/postcapture.dmd.yaml",
        "file of model directives; null if ``servicer`` is given",
    )
    servicer: str | None = unitless(
        None,
        'URDF of base and arm, which becomes the model instance "servicer"; null if ``directives`` '
        "is given",
    )
    debris: str = unitless(
        "package://ffsm_drake/urdf/debris.urdf",
        'URDF of the target, which becomes the model instance "debris"; used with ``servicer``',
    )
    end_effector: str = unitless(
        "servicer::end_effector",
        "scoped name of the frame that holds the target; reports show its origin",
    )
    grasp: str = unitless(
        "debris::grasp",
        "scoped name of the target frame that is welded to ``end_effector``; used with "
        "``servicer``",
    )
    packages: dict[str, str] = unitless(
        {}, "folder of each package:// name in the models, such as {mine: meshes}"
    )
    flexible: dict[str, Flexible] = unitless(
        {}, "flexible parts by any name; the controller's model treats them as rigid"
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that one source of the model is given."""
        if (self.servicer is None) == (self.directives is None):
            yield key, "needs exactly one of directives and servicer (a URDF)"
        yield from identifier_problems(f"{key}.flexible", self.flexible, "a part's")


@dataclass
class MassProperties:
    """Mass properties of the payload body in its frame P."""

    mass: float = setting(100.0, "kg", "mass of the payload body", above=0)
    center_of_mass: list[float] = vector_in(
        ORIGIN, "m", "position p_PScm_P of the centre of mass in the frame of the body"
    )
    inertia: list[float] = setting(
        [16.7, 16.7, 16.7],
        "kg m^2",
        "inertia about the centre of mass in the axes of the body: [Ixx, Iyy, Izz] or [Ixx, Iyy, "
        "Izz, Ixy, Ixz, Iyz]",
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that a rigid body can have the inertia."""
        key = f"{key}.inertia"
        if len(self.inertia) not in (3, 6):
            yield (
                key,
                "must hold three moments [Ixx, Iyy, Izz], or those and three products [Ixy, Ixz, "
                "Iyz]",
            )
            return
        try:
            with np.errstate(all="ignore"):
                principal = np.linalg.eigvalsh(inertia_matrix(self))
        except np.linalg.LinAlgError:
            principal = np.full(3, np.nan)
        if not np.isfinite(principal).all():
            yield key, f"has no principal moments: {self.inertia}"
        elif principal[0] <= 0:
            yield key, "must be positive definite"
        elif principal[0] + principal[1] < principal[2] * (1 - 1e-12):
            yield (
                key,
                f"principal moments {np.round(principal, 6).tolist()} violate the triangle "
                "inequality (the largest must not exceed the sum of the others)",
            )


NOTHING = MassProperties(mass=0.0, inertia=[0.0, 0.0, 0.0])  # in the gripper, before the grasp


@dataclass
class Payload:
    """The captured body, with true mass properties, and nominal ones for the controller."""

    body: str = unitless("debris::debris", "scoped name of the captured body in the model")
    truth: MassProperties = setting(MassProperties())
    nominal: MassProperties = setting(MassProperties(mass=80.0, inertia=[12.0, 12.0, 12.0]))


@dataclass
class Posture:
    """A configuration of base and arm."""

    base_position: list[float] = vector_in(
        ORIGIN, "m", "position p_WB of the base in the world frame"
    )
    base_rpy: list[float] = vector_in(
        ORIGIN,
        "rad",
        "roll, pitch, yaw of the base attitude R_WB: rotations about the world's x, y, z axes in "
        "that order",
    )
    joints: PerCoordinate = setting(ZERO, "rad or m", "joint positions, by joint name")


def inertia_matrix(body: MassProperties) -> np.ndarray:
    """Inertia about the centre of mass as a symmetric (3, 3) matrix, kg m^2."""
    ixx, iyy, izz, ixy, ixz, iyz = (*body.inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
