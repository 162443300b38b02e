"""Plans of missions with hands that close later: such a plan begins at the last closing.

Up to then, the first hand carries the target along the polynomial of ``reference.duration``.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.two_arms.closed_motion import ClosedMotion
from ffsm_drake.scenario import Capture, Grip, Posture
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_error,
)
from ffsm_drake.spacecraft.plant import base_rpy, find_body
from ffsm_drake.systems.planned_motion import InTurn, PlannedMotion
from ffsm_drake.systems.reference import make_motion

_SAME = 1e-4  # rad or m, and per s


@planned
def from_last_closing(mission: Mission) -> Mission:
    """Return the mission that begins at the last closing, with the motion at that time and all
    hands on the target. Raises the errors of the motion up to then.
    """
    scenario, last = mission.scenario, closing_times(mission.scenario)[-1]
    if not last:
        return mission
    q, v, _ = make_motion(_along_polynomial(mission)).evaluate(scenario.grasp_time + last)
    model = mission.craft.nominal()
    body = find_body(model.plant, scenario.payload.body, key="payload.body").body_frame()
    w, v_P = np.split(model.calc_jacobian(q, body) @ v, 2)
    arm = body.CalcPoseInWorld(model.context).rotation() @ np.array(
        scenario.payload.truth.center_of_mass
    )
    coordinates = mission.craft.coordinates
    joints = zip(coordinates.names[NUM_BASE_VELOCITIES:], q[NUM_BASE_POSITIONS:], strict=True)
    capture = dataclasses.replace(
        scenario.capture or Capture(),
        axes="world",
        rate=w.tolist(),
        velocity=(v_P + np.cross(w, arm)).tolist(),
        servicer="given",
        servicer_velocity=coordinates.by_name(v),
        joints="free",
        approach=None,
        closing=None,
        retreat=None,
        measured=None,
    )
    return mission.flown_by(
        contacts={
            name: dataclasses.replace(each, closes=0.0) for name, each in scenario.contacts.items()
        },
        initial_posture=Posture(
            base_position=q[4:NUM_BASE_POSITIONS].tolist(),
            base_rpy=base_rpy(q).tolist(),
            joints={name: float(angle) for name, angle in joints},
        ),
        initial_velocity={},
        capture=capture,
        phases=[],
        blocks=dataclasses.replace(scenario.blocks, phases={}),
    )


@planned
def _along_polynomial(mission: Mission) -> Mission:
    """The mission without a plan."""
    reference = dataclasses.replace(mission.scenario.reference, kind="quintic", plan=None)
    return mission.flown_by(reference=reference)


class PlannedAfterClosing(InTurn):
    """The polynomial up to the last closing, and a plan after it; times after the grasp."""

    def __init__(self, plan: PlannedMotion, mission: Mission, grip: Grip) -> None:
        """Args: the plan; the mission; the hands of the phase. Raises as ``ClosedMotion``."""
        scenario, closings = mission.scenario, closing_times(mission.scenario)
        begun, self._last = from_last_closing(mission), closings[-1]
        first = make_motion(_along_polynomial(mission), grip)
        after = ClosedMotion(plan, begun, begun.craft.nominal())
        begin, end = grip.closed or 0.0, self._last + after.end
        if grip.closed is not None:
            end = min([each for each in closings if each > begin], default=end)
        super().__init__(
            [(-scenario.grasp_time, first), (self._last, after)],
            begin=begin,
            end=end,
            sample_time=scenario.sample_time,
        )

    def instants(self, count: int) -> np.ndarray:
        """See PlannedMotion; as many up to the last closing."""
        marks = np.unique(np.clip([self.begin, self._last, self.end], self.begin, self.end))
        parts = [np.linspace(*pair, count) for pair in itertools.pairwise(marks)]
        return np.unique(np.concatenate(parts))

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion."""
        is_after, parts = times > self._last - 1e-9, list[dict[str, np.ndarray]]()
        for (begin, motion), where in zip(self._motions, (~is_after, is_after), strict=True):
            if where.any():
                own = {name: values[where] for name, values in found.items()}
                parts.append(
                    motion.shared(times[where] - begin, own, [each[where] for each in state])
                )
        order = np.argsort(np.concatenate([np.flatnonzero(~is_after), np.flatnonzero(is_after)]))
        return {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}

    def remarks(self) -> list[str]:
        """A line if the plan begins elsewhere than the polynomial is then."""
        (begin, first), (_, after) = self._motions
        (q, v, _), (q_d, v_d, _) = first.evaluate(self._last - begin), after.evaluate(0.0)
        off = np.abs([position_error(q_d, q), v_d - v]).max(axis=0)
        worst = int(np.argmax(off))
        if off[worst] <= _SAME:
            return []
        return [
            f"reference.plan: {self.coordinates.names[worst]} differs by {off[worst]:.3g} from the "
            f"motion at the last closing, {self._last:g} s after the grasp; make a plan for this "
            "scenario with 'ffsm plan'"
        ]
