"""Station keeping before an approach (``phases: [{hold: {...}}, approach, stop]``)."""

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline

from ffsm_drake.common.errors import ScenarioError, choices
from ffsm_drake.common.settings import setting, settings_of
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.contact import planned_contact, target_path
from ffsm_drake.runs.phases import Phase
from ffsm_drake.scenario.resolving import build_settings
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Where the base waits: displaced from its place at the grasp."""

    distance: float = setting(
        0.5,
        "m",
        "distance of the origin of the base from its place at the grasp, not of the gripper from "
        "the target",
        least=0,
    )
    direction: list[float] = setting(
        [],
        "",
        "direction from the place of the base at the grasp, world axes; empty: away from the "
        "centre of mass of the target",
    )
    relative: str = setting(
        "target",
        "",
        "what the base is at rest to: the centre of mass of the target, with which the place at "
        "the grasp moves, or the world",
        one_of=("target", "world"),
    )


class Hold(PlannedMotion):
    """The base at rest to the centre of mass of a target, or to the world, with its attitude at the
    grasp and the joints at the start of the approach.
    """

    def __init__(self, mission: Mission, settings: Settings, *, begin: float, end: float) -> None:
        """Args: begin and end in the run, s."""
        scenario, model = mission.scenario, mission.craft.nominal()
        assert scenario.approach is not None
        coordinates, period = model.coordinates, scenario.sample_time
        X_WP, path = target_path(scenario, model, planned_contact(mission, model))
        grasp, arm = scenario.initial_posture, np.array(scenario.payload.truth.center_of_mass)
        place, center = np.array(grasp.base_position), X_WP @ arm
        away = np.array(settings.direction) if settings.direction else place - center
        place = place + settings.distance * away / np.linalg.norm(away)
        posture = dataclasses.replace(
            scenario.approach.posture, base_position=place.tolist(), base_rpy=grasp.base_rpy
        )
        self._q = configuration(model.coordinates, posture, key="capture.approach.posture")
        self._begin = begin
        self._way: CubicSpline | None = None
        if settings.relative == "target":
            ways = path[:, 4:7] + matrix_of(path[:, :4]) @ arm - center
            self._way = CubicSpline(period * np.arange(len(path)), ways)
        super().__init__(coordinates=coordinates, sample_time=period, end=end - begin)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        nq, nv = self._q.size, len(self.coordinates.names)
        rows = np.zeros((times.size, nq + 2 * nv))
        rows[:, :nq] = self._q
        if self._way is not None:
            for order, first in enumerate((4, nq + 3, nq + nv + 3)):
                rows[:, first : first + 3] += self._way(self._begin + times, order)
        return rows


def hold(setup: BlockSetup) -> Phase:
    """The kind ``hold``: the approach begins where it ends."""
    phases = setup.scenario.blocks.phases
    key, known = f"blocks.phases.{setup.name}.settings", [*settings_of(Settings)]
    if setup.scenario.phases:
        key, known = f"phases.{setup.name}", [*known, "duration", "kind"]
    for name in setup.settings:
        if name not in known:
            problem = f"unknown key; valid here: {choices(name, known)}"
            raise ScenarioError(f"{key}.{name}", problem)
    settings = build_settings(Settings, dict(setup.settings), key)
    if settings.direction and not (
        len(settings.direction) == 3 and np.linalg.norm(settings.direction) > 0.0
    ):
        raise ScenarioError(f"{key}.direction", "must have 3 numbers, not all zero")
    names = list(phases)
    before = sum(phases[name].duration for name in names[: names.index(setup.name)])
    end = before + phases[setup.name].duration
    return Phase(motion=Hold(setup.mission, settings, begin=before, end=end), joins=True)
