"""Station keeping before an approach (``phases: [{hold: {...}}, approach, stop]``)."""

import dataclasses

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.interpolate import CubicSpline

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.settings import setting
from ffsm_drake.common.so3 import composed, cross_of, matrix_of
from ffsm_drake.plugins.capture.approach import approach_posture
from ffsm_drake.plugins.capture.contact import planned_contact, target_path
from ffsm_drake.runs.phases import Phase
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.resolving import build_settings
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Where the base waits: displaced from its place at the grasp."""

    distance: float = setting(0.5, "m", "distance of the base from its place at the grasp", least=0)
    direction: list[float] = setting(
        [],
        "",
        "direction of ``distance``, in the axes that ``relative`` names; empty: away from the "
        "centre of mass of the target",
    )
    relative: str = setting(
        "target",
        "",
        "what the base is at rest to: the target, with which it turns and moves, or the world",
        one_of=("target", "world"),
    )


class Hold(PlannedMotion):
    """The base at rest to a target or the world, and the joints at the start of the approach."""

    def __init__(
        self, scenario: Scenario, model: PlantModel, settings: Settings, *, begin: float, end: float
    ) -> None:
        """Args: nominal model with the target; begin and end in the run, s."""
        coordinates, period = model.coordinates, scenario.sample_time
        planned = planned_contact(scenario, model)
        X_WP, path = target_path(scenario, model, planned)
        grasp = scenario.initial_posture
        X_WB = RigidTransform(RollPitchYaw(grasp.base_rpy), grasp.base_position)
        center = X_WP @ np.array(scenario.payload.truth.center_of_mass)
        away = np.array(settings.direction)
        if not away.size:
            away = X_WB.translation() - center
        elif settings.relative == "target":
            away = X_WP.rotation() @ away
        place = X_WB.translation() + settings.distance * away / np.linalg.norm(away)
        X_WH = RigidTransform(X_WB.rotation(), place)
        posture = configuration(model.plant, approach_posture(scenario), key="capture.approach")
        self._joints, self._begin = posture[7:], begin
        self._turns, fixed = settings.relative == "target", X_WH
        if self._turns:
            fixed = X_WP.inverse() @ X_WH
            samples = np.arange(len(path))
            self._path = CubicSpline(period * samples, path)
        self._fixed = fixed.rotation().ToQuaternion().wxyz(), fixed.translation()
        super().__init__(coordinates=coordinates, sample_time=period, end=end - begin)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        nq, nv = len(self.coordinates.position_names), len(self.coordinates.names)
        rows, (quaternion, way) = np.zeros((times.size, nq + 2 * nv)), self._fixed
        rows[:, 7:nq] = self._joints
        if not self._turns:
            rows[:, :4], rows[:, 4:7] = quaternion, way
            return rows
        at = self._begin + times
        motion, rate = self._path(at), self._path(at, 1)
        q_WP = motion[:, :4] / np.linalg.norm(motion[:, :4], axis=1, keepdims=True)
        arm, w, alpha = matrix_of(q_WP) @ way, motion[:, 7:10], rate[:, 7:10]
        turns = cross_of(w, arm)
        rows[:, :4] = composed(q_WP, np.tile(quaternion, (times.size, 1)))
        rows[:, 4:7] = motion[:, 4:7] + arm
        rows[:, nq : nq + 3], rows[:, nq + 3 : nq + 6] = w, motion[:, 10:] + turns
        a = nq + nv
        rows[:, a : a + 3] = alpha
        rows[:, a + 3 : a + 6] = rate[:, 10:] + cross_of(alpha, arm) + cross_of(w, turns)
        return rows


def hold(setup: BlockSetup) -> Phase:
    """The kind ``hold``: the approach begins where it ends."""
    scenario, phases = setup.scenario, setup.scenario.blocks.phases
    settings = build_settings(Settings, dict(setup.settings), f"phases.{setup.name}")
    if settings.direction and not (
        len(settings.direction) == 3 and np.linalg.norm(settings.direction) > 0.0
    ):
        raise ScenarioError(f"phases.{setup.name}.direction", "must have 3 numbers, not all zero")
    names = list(phases)
    before = sum(phases[name].duration for name in names[: names.index(setup.name)])
    model = make_nominal_plant(dataclasses.replace(scenario, holds=True))
    end = before + phases[setup.name].duration
    return Phase(motion=Hold(scenario, model, settings, begin=before, end=end), joins=True)
