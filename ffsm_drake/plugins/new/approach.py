"""Postures of a new mission, and the approach to a target."""

import copy
import itertools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw

from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.remarks import plan_clearance
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.pacing import INSTANTS, SECONDS, Pacing
from ffsm_drake.plugins.new.postures import STARTS, Arm
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.limits import POSITION, RATE
from ffsm_drake.spacecraft.plant import find_frame
from ffsm_drake.systems.reference import make_motion

_SAMPLES = 400  # candidates of a posture
_LENGTHS = (0.3, 0.2, 0.5)  # m, of an approach along the grasp axis
# Shares of the joints' limits that a plan may use, and of the durations, of approach and motion,
# with which it is tried: a joint that moves at the grasp turns back later in a longer motion.
_WITHIN = {POSITION: 0.98, RATE: 0.9}
SHORTER = ((1.0, 1.0), (0.5, 1.0), (0.75, 0.75), (0.5, 0.5), (0.25, 0.5), (0.25, 0.25))


class Approach:
    """The postures and the approach of a draft."""

    def __init__(self, draft: Draft, pacing: Pacing) -> None:
        self._data, self._asked, self._coordinates = draft.data, draft.asked, draft.coordinates
        self._draft, self._pacing, self.starts = draft, pacing, list[np.ndarray]()
        limits = draft.mission.craft.limits
        self._limits = [each for each in limits if each.quantity in _WITHIN]

    def choose_postures(self) -> None:
        """Choose target posture, initial posture, and a duration with moderate rates.

        ``starts`` are the initial configurations (nq) without contact, the best first.
        """
        arm, rng = Arm(self._draft), np.random.default_rng(self._draft.seed)
        low, high = arm.low[arm.moving], arm.high[arm.moving]
        rest = 0.5 * (low + high)
        target = arm.best([rest, *(low + (high - low) * rng.random((_SAMPLES, low.size)))])[0]
        step = np.minimum(0.6, 0.5 * (high - low))
        draws = rng.uniform(0.35, 1.0, (_SAMPLES, low.size)) * rng.choice([-1.0, 1.0], low.size)
        near = [q for q in target + draws * step if ((q >= low) & (q <= high)).all()]
        starts = arm.best([*near, 0.5 * (target + rest)], to=target, count=STARTS)
        end, initial = self._data["target_posture"], self._data["initial_posture"]
        end["joints"], initial["joints"] = (
            arm.by_name(arm.filled(each)) for each in (target, starts[0])
        )
        if (least := arm.nearest(starts[0], target)).distance < 0.0:
            self._draft.touching = f"no posture free of contact was found: {least} in the best"
        rate, reference = 1.875, self._data["reference"]  # largest rate of the quintic in unit time
        reference["duration"] = max(
            reference["duration"],
            *(
                rate * abs(end["joints"][name] - angle) / self._draft.rate_of(name)
                for name, angle in initial["joints"].items()
            ),
        )
        self.starts = [arm.whole(arm.filled(start)) for start in starts]

    def used(self, mission: Mission) -> tuple[float, str]:
        """Return the largest share of the joint limits, minus their margins, that the planned
        motion uses, and the joint that uses it, as text.
        """
        motion, limits = make_motion(mission), self._limits
        q, v, _ = motion.evaluate(np.linspace(0.0, motion.end, 4 * INSTANTS))
        used = np.array([
            limit.used({POSITION: q[:, 1:], RATE: v}[limit.quantity]).max(axis=0)
            / _WITHIN[limit.quantity] for limit in limits
        ])  # fmt: skip
        which, joint = np.unravel_index(np.argmax(used), used.shape)
        limit = limits[which]
        what = f"{100.0 * used.max() * _WITHIN[limit.quantity]:.3g} % of {limit.source}"
        return float(used.max()), (
            f"no motion within the joint limits was found: {limit.names[joint]} uses {what}; try a "
            "slower tumble, or a lighter target"
        )

    def choose(self, durations: Iterable[tuple[float, float]]) -> None:
        """Choose the initial posture, the approach along the grasp axis, and the durations.

        Joints stay within their limits, and parts stay clear of the tumbling target. If no choice
        meets both, the best one is used.

        Args:
          durations: durations of approach and motion to try, as shares of the present ones.
        """
        enough, told = Scenario().clearance, ""
        best, chosen, before = (-math.inf, -math.inf), dict[str, Any](), self._choice
        ways = [*itertools.product(self.starts, _LENGTHS if self._asked.has_approach else (0.0,))]
        for shares in durations:
            if best >= (-1.0, enough):
                break
            self._data |= copy.deepcopy(before)
            start, length = ways[0]
            self._begin(start, length, shares)
            if min(shares) < 1.0 and self._pacing.overloads():  # with any start, by and large
                continue
            for k, (start, length) in enumerate(ways):
                self._data |= copy.deepcopy(before)
                self._begin(start, length, shares)
                with step(f"approach {k + 1} of {len(ways)}"):
                    mission = self._draft.mission
                    used = max(self.used(mission)[0], 1.0)
                    if -used < best[0]:
                        continue
                    near = min(plan_clearance(mission), key=lambda each: each.distance)
                if (-used, near.distance) > best:
                    told = str(near)
                    best, chosen = (-used, near.distance), self._choice
                if best >= (-1.0, 2.0 * enough):
                    return
        self._data |= chosen
        if best[1] < enough:
            self._draft.touching = (
                f"no approach keeps clear of the target: {told}; try a "
                "slower tumble, or a --tip at the end of the hand (now "
                f"{self._data['model']['end_effector']})"
            )

    @property
    def _choice(self) -> dict[str, Any]:
        """A copy of the sections that ``_approach`` chooses."""
        keys = "initial_posture", "reference", "capture"
        return copy.deepcopy({key: self._data[key] for key in keys})

    def _begin(self, start: np.ndarray, length: float, shares: tuple[float, float]) -> None:
        """Set an initial configuration (nq), the length of the approach (m), and the durations as
        shares of the present ones.
        """
        initial, joints = self._data["initial_posture"], start[NUM_BASE_POSITIONS:].tolist()
        initial["joints"] = dict(zip(self._coordinates.joints, joints, strict=True))
        timed = [(self._data["reference"], shares[1])]
        if self._asked.has_approach:
            tip = find_frame(self._draft.true.plant, self._data["model"]["end_effector"], key="tip")
            turn = RollPitchYaw(initial["base_rpy"]).ToRotationMatrix().matrix()
            self._draft.true.plant.SetPositions(self._draft.true.context, start)
            axis = turn @ tip.CalcPoseInWorld(self._draft.true.context).rotation().matrix()[:, 2]
            place = np.array(initial["base_position"]) - length * axis
            approach = self._data["capture"]["approach"]
            approach["posture"] = {**initial, "base_position": list(map(rounded, place.tolist()))}
            timed.append((approach, shares[0]))
        for section, share in timed:
            if share < 1.0:
                whole = round(share * section["duration"] / SECONDS)
                section["duration"] = SECONDS * max(whole, 1)
