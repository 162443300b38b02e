"""Hardware of a new servicer: thrusters, panels, wheels, and steps that resolve friction."""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
from pydrake.multibody.tree import RigidBody

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import short
from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.new.base_box import BaseBox
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.scenario import Grip
from ffsm_drake.scenario.actuation import Thrusters, Wheel, thrusters_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.systems.mission_limits import actuation_limit

MOTION = 0.65  # share of what the base's actuators give, for the motion
# Steps, s, and rates within which friction changes its sign, rad/s or m/s; its time constant near
# rest over a step, at least.
_RESOLVED = 1.3
_STEP_SIZES, _SMOOTHED = (0.01, 0.005, 0.002, 0.001, 0.0005), (5e-3, 2e-2, 5e-2)
_PULSES, _WHEEL = 0.4, (0.05, 5.0)  # wheels' share of the thrusters' torque; a wheel, N m
_SLOW_WHEEL, _ROTOR = 0.4, 0.005  # torque (1/s^2) and rotor per least moment of base
_COVER = 0.1  # m, of a part that covers a thruster
# Panels: of the base's inertia; m; Hz.
_PANEL_SHARE, _PANEL_LENGTH, _PANEL_FREQUENCY = 0.3, (0.3, 3.0), 0.25
_PANEL_SIDES = ([0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0])


class Hardware:
    """The hardware of a draft."""

    def __init__(self, draft: Draft) -> None:
        self._data, self._asked, self._coordinates = draft.data, draft.asked, draft.coordinates
        self._draft, self._enough = draft, 0.0  # N m, of a wheel
        self.weak = ""  # what wheels are too weak for

    @property
    def _bus(self) -> tuple[RigidBody, float, np.ndarray]:
        """The heaviest body of the base, its mass (kg) and its moments (3, kg m^2)."""
        links = map(self._draft.true.plant.GetBodyByName, self._draft.servicer.base_links)
        body = max(links, key=lambda link: float(link.default_mass()))
        inertia = body.default_spatial_inertia()
        moments = inertia.Shift(inertia.get_com()).CalcRotationalInertia().get_moments()
        return body, float(inertia.get_mass()), moments

    def _box(self, body: str) -> BaseBox:
        """Return the box of the base in the frame of one of its bodies."""
        found = self._draft.servicer
        return BaseBox.of(self._draft.scenario.model, found.base_links, body, side=found.half_side)

    def place_thrusters(self) -> None:
        """Place thrusters on the box of the base; remark on thrusters that a part of it covers."""
        if self._asked.thrusters is None:
            return
        box = self._box(self._draft.servicer.base)
        found = self._asked.thruster_settings(self._draft.servicer.total_mass, box)
        self._data["actuation"]["thrusters"] = found
        covered = dict[str, list[str]]()
        placed = thrusters_of(self._draft.scenario.actuation.thrusters or Thrusters())
        for name, unit in placed.items():
            out = unit.position + _COVER * np.sign(unit.position - box.centre) * [0, 0, 1]
            for body in box.overlapped(out[None]):
                covered.setdefault(body, []).append(name)
        self._draft.remarks += [
            f"thrusters {', '.join(names)} are inside a part of '{body}': move them "
            "(actuation.thrusters.units), or the part"
            for body, names in covered.items()
        ]

    def place_panels(self) -> None:
        """Place panels on the sides of the base. Raises ScenarioError: the panels are too heavy."""
        if self._asked.panels is None:
            return
        count, mass = self._asked.panels
        body, own, moments = self._bus
        if count * mass >= 0.5 * own:
            raise ScenarioError(
                "--panels",
                f"{count} of {mass:g} kg must be less than half of the base's {short(own, 4)} kg, "
                "which contain them",
            )
        box, sides = self._box(body.name()), np.array(_PANEL_SIDES[:count])
        axes = np.flatnonzero(np.abs(sides).any(axis=0))
        flat = float((moments.sum() - 2.0 * moments[axes]).min())  # small: close to a flat body
        middle = math.sqrt(_PANEL_SHARE * min(float(moments.min()), flat) / (count * mass))
        out = middle - float((np.abs(sides) @ box.half).max())
        length = rounded(min(max(2.0 * out, _PANEL_LENGTH[0]), _PANEL_LENGTH[1]))
        self._data["model"]["flexible"] = {
            f"panel_{k + 1}": {
                "body": f"servicer::{body.name()}",
                "position": [rounded(x) for x in (box.centre + box.half * side).tolist()],
                "direction": side.tolist(),
                **({"axis": [0, 1, 0]} if side[0] else {}),
                "mass": mass,
                "length": length,
                "width": min(1.0, length),
                "frequency": _PANEL_FREQUENCY,
            }
            for k, side in enumerate(sides)
        }
        for name, panel in self._data["model"]["flexible"].items():
            along, across = (np.arange(0.02, 1.0, 0.04) * panel["length"] + 0.05,
                             np.arange(-0.48, 0.5, 0.04) * panel["width"])  # fmt: skip
            direction = np.array(panel["direction"])
            axis = np.array(panel.get("axis", [1, 0, 0]))
            points = np.array(panel["position"]) + np.array(
                [d * direction + w * axis for d in along for w in across]
            )
            self._draft.remarks += [
                f"{name} lies on a part of '{part}' that the model has: leave out --panels, or "
                f"move it (model.flexible.{name}), or remove the part"
                for part in box.overlapped(points)
            ]

    @property
    def sizes_wheels(self) -> bool:
        return self._asked.wheels is not None and self._asked.wheels.torque is None

    def size_wheels(self) -> None:
        """Size the wheels for the peak torque and, with thrusters, for the torque of their pulses.

        Thrusters assist wheels that are too weak or that hold the momentum of a grasp.
        """
        if self._asked.wheels is None:
            return
        asked, actuation, pulses = self._asked.wheels, self._data["actuation"], 0.0
        wheels, torque, moment = actuation["wheels"], asked.torque, float(self._bus[2].min())
        one = dataclasses.replace(asked, torque=None)
        least = self._torque({**actuation, "wheels": {"units": one.units(1.0, 1e-9)}})
        if self._asked.thrusters is not None:
            # the approach of two hands was found with the torque of the thrusters
            share = 1.0 if self._asked.tips and self._asked.has_approach else _PULSES
            pulses = share * self._torque({**actuation, "wheels": None}) / least
        motion = float(np.linalg.norm(self._draft.peaks[:3])) / MOTION / least
        floor = min(_WHEEL[0], _SLOW_WHEEL * moment)
        needed = rounded(max(min(motion, max(_WHEEL[1], pulses)), pulses, floor))
        self._enough = max(self._enough, needed)  # a lengthened motion needs less
        inertia = rounded(_ROTOR * moment)
        usual = Wheel().inertia
        wheels["units"] = asked.units(needed, None if inertia >= usual else inertia)
        weak = torque is not None and torque < needed
        self.weak = f"wheels of {torque:.3g} N m are too weak for the motion" if weak else ""
        if weak:
            beside = " and the pulses of the thrusters" if pulses else ""
            self.weak += f"{beside}: --wheels {asked.count}x{rounded(1.05 * self._enough):g}Nm"
        if pulses and (weak or self._asked.capture is not None):
            wheels["assist_above"] = 1.0

    def _torque(self, actuation: dict[str, Any]) -> float:
        """Return the torque of the base actuators of a section in every direction, N m."""
        scenario = self._draft.with_sections(actuation=actuation)
        return float(actuation_limit(scenario, self._coordinates).upper[0])

    def resolve_friction(self) -> None:
        """Choose integrator steps that resolve friction near rest.

        Large steps are preferred, then a slow rate within which friction changes its sign.
        """
        drives, config = self._data["actuation"].get("drives"), self._data["simulator_config"]
        if drives is None:
            return
        joints, free = slice(NUM_BASE_VELOCITIES, None), list[np.ndarray]()
        for held in {True, self._asked.capture is None}:
            for matrix in self._draft.at_postures(Grip(held)):
                free.append(np.linalg.inv(matrix)[joints, joints])
        for step_size, rate in itertools.product(_STEP_SIZES, _SMOOTHED):
            config["max_step_size"], drives["smoothing_rate"] = step_size, rate
            settings = self._draft.scenario.drives
            assert settings is not None
            made = DriveSet(settings, self._draft.scenario.actuation.limit, self._coordinates)
            if min(made.time_constant(each)[0] for each in free) > _RESOLVED * step_size:
                return
        self._draft.remarks.append(
            "friction is too stiff for steps of any size tried: give "
            "simulator_config.integration_scheme: implicit_euler"
        )
