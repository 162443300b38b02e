"""The section ``actuation``: limits, thrusters, wheels and drives."""

import functools
import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from ffsm_drake.common.settings import Problems, setting, unknown
from ffsm_drake.scenario.fields import (
    ORIGIN,
    X_AXIS,
    ZERO,
    PerCoordinate,
    choice_of,
    in_samples,
    unitless,
    vector_in,
)

_BOX = (1.2, 1.2, 1.9)  # m, sides of the base of the shipped layouts
# Combinations of groups that ``actuation.driven`` may name.
DRIVEN = (("base_rotation", "base_position", "joints"), ("base_rotation", "joints"), ("joints",))


@dataclass
class Thruster:
    """An on/off thruster that is fixed to the base."""

    position: list[float] = vector_in(
        ORIGIN, "m", "position of the thruster in the frame of the base"
    )
    direction: list[float] = vector_in(
        X_AXIS,
        "",
        "direction of the force on the base, opposite to the plume, in the frame of the base; any "
        "length",
        nonzero=True,
    )
    force: float = setting(5.0, "N", "thrust while the thruster is open", above=0)
    specific_impulse: float = setting(
        226.1, "s", "specific impulse: impulse per weight of propellant on Earth", above=0
    )


@dataclass
class Pwpf:
    """The pulse-width pulse-frequency modulator of each thruster: a first-order filter before a
    Schmitt trigger.
    """

    gain: float = unitless(
        10.0,
        "filter gain k_m. The filter's input is the commanded thrust divided by the full thrust, "
        "minus 1 while the thruster is open.",
        above=0,
    )
    time_constant: float = setting(0.2, "s", "time constant of the filter", above=0)
    on: float = unitless(0.25, "filter output at which the thruster opens", above=0)
    off: float = unitless(0.15, "filter output at which the thruster closes", least=0)

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the trigger closes below its opening threshold."""
        if self.off >= self.on:
            yield f"{key}.off", f"must be from 0 to below on ({self.on:g}), not {self.off:g}"


@dataclass
class Plume:
    """The plume of each thruster, which pushes the bodies that it hits.

    It is a source flow in the half space behind the thrust. Its density is the cosine of the angle
    from its axis to the power ``exponent``.
    """

    exponent: float = unitless(
        8.0,
        "exponent of the cosine of the angle from the plume's axis; larger: narrower plume",
        above=0,
        most=1000,
    )
    rays: int = unitless(
        100, "number of rays with equal momentum that represent a plume", least=8, most=10000
    )
    ban: float | None = unitless(
        None,
        "largest force of a thruster's plume on the spacecraft, as a share of its thrust, in "
        "``initial_posture`` or ``target_posture``. A thruster above this share is not used; null: "
        "all thrusters are used.",
        above=0,
    )


@dataclass
class Thrusters:
    """On/off thrusters for the force and torque on the base."""

    layout: str | None = choice_of(
        "12x5N",
        "shipped layout of thrusters; null if ``units`` are given",
        "12x1N",
        "12x5N",
        "16x22N",
    )
    force: float | None = setting(
        None, "N", "thrust of every thruster of a layout; null: as in its name", above=0
    )
    box: list[float] | None = setting(
        None,
        "m",
        "sides of the box to which a layout is scaled, about the origin of the base; null: 1.2, "
        "1.2, 1.9",
        size=3,
        above=0,
    )
    units: dict[str, Thruster] = unitless(
        {}, "thrusters by any name, which replace a layout", size=(0, 24)
    )
    failures: dict[str, str] = unitless(
        {},
        'known failure by thruster name: "stuck_off" or "stuck_on"; the allocation accounts for it',
        one_of=("stuck_off", "stuck_on"),
    )
    minimum_on_time: float = setting(
        0.02,
        "s",
        "shortest time for which a thruster opens",
        least=0,
        most=1000,
    )
    rise_time: float = setting(
        0.0,
        "s",
        "time constant of the rise of thrust after opening; 0: immediate",
        least=0,
        most=1000,
    )
    fall_time: float = setting(
        0.0,
        "s",
        "time constant of the fall of thrust after closing; 0: immediate",
        least=0,
        most=1000,
    )
    modulator: str = choice_of(
        "sigma_delta",
        'modulation of the commanded force: "sigma_delta": open for whole frames; "pulse_width": '
        'open for a part of each frame; "pwpf": pulse-width pulse-frequency',
        "sigma_delta",
        "pulse_width",
        "pwpf",
    )
    threshold: float = unitless(
        0.8,
        "share of the thrust above which a thruster opens with sigma_delta; 0.5 follows the "
        "commanded force most closely, and larger values use less propellant on noise",
        least=0.5,
        below=1,
    )
    frame: int = in_samples(
        2,
        "period of the allocation of force to thrusters; with sigma_delta also the shortest pulse",
        least=1,
    )
    pwpf: Pwpf = setting(Pwpf())
    plume: Plume | None = unitless(
        None, "force of the plumes on the bodies of the spacecraft; null: none"
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the thrusters exist and can give the required pulses."""
        if self.layout is not None and self.units:
            yield f"{key}.units", "has no effect with a layout; set layout: null"
        for name in ("force", "box"):
            if self.layout is None and getattr(self, name) is not None:
                yield f"{key}.{name}", "has no effect without a layout; remove it"
        names = thrusters_of(self)
        if not names:
            yield (
                f"{key}.layout",
                f"choose one of {', '.join(thruster_layouts())}, or give units",
            )
        for name in self.failures:
            if name not in names:
                yield f"{key}.failures.{name}", unknown(name, names)
        least, sample_time = self.minimum_on_time, scenario.sample_time
        if self.modulator != "pwpf" and self.frame * sample_time < least * (1 - 1e-9):
            yield (
                f"{key}.frame",
                f"{self.frame} control samples are {self.frame * sample_time:g} s, shorter than "
                f"minimum_on_time, {least:g} s; take {math.ceil(least / sample_time - 1e-9)} or "
                "more",
            )


@dataclass
class Wheel:
    """A balanced reaction wheel in the base, symmetric about its axis.

    The mass and inertia of the base include those of the wheel.
    """

    axis: list[float] = vector_in(
        [0.0, 0.0, 1.0],
        "",
        "direction of the wheel axis in the frame of the base; any length",
        nonzero=True,
    )
    inertia: float = setting(0.08, "kg m^2", "inertia of the wheel about its axis", above=0)
    torque_limit: float = setting(0.2, "N m", "largest motor torque in both directions", above=0)
    speed_limit: float = setting(
        628.0, "rad/s", "largest speed relative to the base in both directions", above=0
    )
    initial_momentum: float = setting(
        0.0, "N m s", "initial angular momentum of the wheel about its axis"
    )
    coulomb_friction: float = setting(
        0.0, "N m", "Coulomb friction torque of the bearings; it fades below 0.1 rad/s", least=0
    )
    viscous_friction: float = setting(
        0.0, "N m s", "viscous friction coefficient of the bearings", least=0
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the initial momentum is within the speed limit."""
        largest = self.inertia * self.speed_limit
        if abs(self.initial_momentum) > largest:
            yield (
                f"{key}.initial_momentum",
                f"must be within inertia * speed_limit, {largest:.4g} N m s, not "
                f"{self.initial_momentum:g}",
            )


@dataclass
class Wheels:
    """Reaction wheels for the torque on the base. Thrusters, if there are any, unload them."""

    units: dict[str, Wheel] = unitless({}, "wheels by any name", size=(0, 24))
    desaturate_above: float = unitless(
        0.8,
        "share of a wheel's ``speed_limit`` above which unloading starts; motors remove momentum "
        "that wheels hold against each other, and thrusters remove the rest",
        above=0,
        most=1,
    )
    desaturate_below: float = unitless(
        0.2,
        "share of ``speed_limit`` below which every wheel must be for unloading to end",
        least=0,
    )
    desaturation_time: float = setting(
        20.0, "s", "time constant with which motors and thrusters unload the wheels", above=0
    )
    assist_above: float | None = unitless(
        None,
        "multiple of the torque limit of the motors above which thrusters add the rest of the "
        "commanded torque; null: never",
        least=1,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that there are wheels and that unloading ends."""
        if not self.units:
            yield f"{key}.units", "give wheels by name, such as {z: {axis: [0, 0, 1]}}"
        above, below = self.desaturate_above, self.desaturate_below
        if below >= above:
            yield (
                f"{key}.desaturate_below",
                f"must be from 0 to below desaturate_above ({above:g}), not {below:g}",
            )


@dataclass
class Drives:
    """Joint drives: motor, gear and friction, in joint coordinates.

    ``actuation`` has the limit and the step of the force.
    """

    gear_ratio: PerCoordinate = unitless(
        {"all": 1.0},
        "turns of the motor per turn of the joint; for a prismatic joint, rad per m",
        above=0,
    )
    rotor_inertia: PerCoordinate | None = setting(
        None,
        "kg m^2",
        "inertia of the rotor about the motor axis; gear_ratio^2 times this is added to the "
        "inertia of the joint; null: as in the URDF",
        least=0,
    )
    nominal_rotor_inertia: PerCoordinate | None = setting(
        None,
        "kg m^2",
        "inertia of the rotor in the controller's model; null: ``rotor_inertia``",
        least=0,
    )
    rate_limit: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "joint rate at which the accelerating force of a drive is 0; null: no limit",
        above=0,
    )
    knee: PerCoordinate = unitless(
        {"all": 0.9},
        "share of ``rate_limit`` up to which the full ``actuation.limit`` is available; above "
        "it the "
        "available force falls linearly to 0",
        least=0,
        below=1,
    )
    coulomb_friction: PerCoordinate = setting(
        ZERO, "N m or N", "Coulomb friction, which does not depend on the rate", least=0
    )
    static_friction: PerCoordinate | None = setting(
        None,
        "N m or N",
        "breakaway friction, at least ``coulomb_friction``; null: ``coulomb_friction``",
        least=0,
    )
    stribeck_rate: PerCoordinate = setting(
        {"all": 0.01},
        "rad/s or m/s",
        "rate within which friction falls from ``static_friction`` to ``coulomb_friction``",
        above=0,
    )
    viscous_friction: PerCoordinate = setting(
        ZERO, "N m s/rad or N s/m", "viscous friction coefficient", least=0
    )
    smoothing_rate: PerCoordinate = setting(
        {"all": 1e-3},
        "rad/s or m/s",
        "rate over which friction changes its sign, as tanh(rate / smoothing_rate)",
        above=0,
    )


@dataclass
class Actuation:
    """Effect of the actuators on the commanded force.

    The order is saturation, quantisation, delay, then drives, wheels and thrusters.
    """

    driven: list[str] = unitless(
        ["all"],
        "groups of coordinates that have actuators and are tracked: [all], [base_rotation, joints] "
        "or [joints]; no force acts on the others, which move by conservation of momentum",
    )
    limit: PerCoordinate | None = setting(
        None, "N m or N", "largest force in both directions; null: no limit", above=0
    )
    quantization: PerCoordinate = setting(
        ZERO, "N m or N", "quantisation step of the force; 0: none", least=0
    )
    delay: int = in_samples(0, "delay from a command to its effect")
    thrusters: Thrusters | None = unitless(
        None,
        "thrusters for the force and torque on the base; null: force and torque act as commanded",
    )
    wheels: Wheels | None = unitless(None, "reaction wheels for the torque on the base; null: none")
    drives: Drives | None = unitless(
        None, "joint drives; null: no rotor inertia, friction or rate limit"
    )

    @property
    def is_ideal(self) -> bool:
        """Whether forces act as commanded."""
        return replace(self, driven=["all"]) == Actuation()

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the driven groups can be driven alone, with matching actuators and
        postures.
        """
        key, given, undriven = f"{key}.driven", self.driven, scenario.undriven
        distinct = len(set(given)) == len(given)
        if given != ["all"] and not (distinct and set(given) in map(set, DRIVEN)):
            choices = " or ".join(f"[{', '.join(groups)}]" for groups in DRIVEN[1:])
            yield key, f"must be all, {choices}, not {given}"
        for kind, group in (("thrusters", "base_position"), ("wheels", "base_rotation")):
            if getattr(self, kind) is not None and group in undriven:
                yield (
                    key,
                    f"{kind} act on {group}, which is not driven; remove actuation.{kind}, or add "
                    f"{group} to actuation.driven",
                )
        for name, group in itertools.product(scenario.postures, undriven):
            if name == "target_posture" and scenario.reference.goal == "stop":
                continue
            field = "base_rpy" if group == "base_rotation" else group
            if getattr(scenario.postures[name], field) != getattr(scenario.initial_posture, field):
                yield (
                    f"{name}.{field}",
                    f"must be as in initial_posture, because {group} is not driven; change it, or "
                    f"add {group} to actuation.driven",
                )


@functools.cache
def thruster_layouts() -> dict[str, dict[str, Thruster]]:
    """Return the shipped layouts of thrusters: layout -> name -> thruster."""
    text = Path(__file__).with_name("thruster_layouts.yaml").read_text(encoding="utf-8")
    return {
        layout: {name: Thruster(**values) for name, values in units.items()}
        for layout, units in yaml.safe_load(text).items()
    }


def thrusters_of(settings: Thrusters) -> dict[str, Thruster]:
    """Return the thrusters described by the settings, by name."""
    units = settings.units if settings.layout is None else thruster_layouts()[settings.layout]
    if settings.force is not None:
        units = {name: replace(unit, force=settings.force) for name, unit in units.items()}
    if settings.box is not None:
        for name, unit in units.items():
            place = [x * a / b for x, a, b in zip(unit.position, settings.box, _BOX, strict=True)]
            units = {**units, name: replace(unit, position=place)}
    return units
