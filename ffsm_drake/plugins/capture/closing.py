"""Runs with a gripper that closes in time (``capture.closing``), up to the grasp.

The phases are approach and closing. If the grasp fails, a retreat and the next attempt follow. Each
phase has its own loop. Plant and blocks keep their states from one phase to the next.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context

from ffsm_drake.common.numbers import number
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.approach import (
    approach_posture,
    gentle_duration,
    given_approach,
    is_gentle,
    outwards,
)
from ffsm_drake.plugins.capture.contact import coast, payload_body
from ffsm_drake.plugins.capture.gripper import Gripper, Met
from ffsm_drake.plugins.capture.handover import Handover
from ffsm_drake.plugins.capture.phases import Captures, given_up
from ffsm_drake.plugins.capture.retreat import Move, along
from ffsm_drake.plugins.capture.supervisor import SupervisorPart
from ffsm_drake.plugins.capture.target_filter import Path
from ffsm_drake.plugins.capture.tracked_target import Approached, TrackedTarget, drawn_path
from ffsm_drake.runs.ending import BOUNCED, MISSED, SLIPPED
from ffsm_drake.runs.limits import closest_of
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Phase, Progress
from ffsm_drake.scenario import Posture, Scenario
from ffsm_drake.scenario.capture import Compliance, Retreat
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import base_body, base_rpy, configuration, posture_of
from ffsm_drake.systems.limits import actuation_limit
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import Factory

_EVERY = 0.5  # s; between the instants at which a further try may meet the target
_LENGTH = 2.0  # m; a turn of the base by 1 rad counts as this way
_CANDIDATES = 30  # meetings looked at, those with the shortest ways
_INSTANTS = 15  # at which the clearance of each is looked at
_PACES = (1.0, 0.87, 1.15, 0.76, 1.32, 0.66, 1.52, 0.57, 0.5)  # tried, times a stop's
_LATELY = 20  # samples before the contact, over which the joints' force is averaged


class ClosingRun(Captures):
    """One run with its tries to close the gripper.

    ``scenario`` and ``handover`` are those of the last try.
    """

    _across: Move  # from where a retreat ends to where the next try begins

    def __init__(self, handover: Handover, progress: Progress | None = None, **how: Any) -> None:
        """Args: see ``Captures``."""
        super().__init__(handover, progress, **how)
        self._chosen = self.scenario = scenario = handover.scenario
        self._moves: tuple[Move, ...] = ()  # moves of the last retreat
        self._again: float | None = None  # s; begin of the approach after it
        self._supervises: dict[str, Factory] = {}  # the supervisor's block after a retreat
        assert scenario.capture is not None
        assert scenario.approach is not None
        assert scenario.closing is not None
        self._capture, self._approach, self._closing = (
            scenario.capture,
            scenario.approach,
            scenario.closing,
        )
        self.samples = round(self._closing.duration / scenario.sample_time)  # the closing takes
        self._tries = 1
        # motion of the target (n, 13) at the samples of the run, as far as is known
        last = handover.sample - 1
        self._motion = np.vstack([handover.path[:last], self._onward(handover.path[last], last)])
        self._measured = measured = scenario.measured
        nominal = np.array(scenario.payload.nominal.center_of_mass)
        arm = nominal if measured else self._true_arm
        self._known = Path(motion=self._motion, arm=arm)
        place = np.array(scenario.initial_posture.base_position)  # at the grasp
        self._reach = float(np.linalg.norm(place - self._known.center(handover.sample)))
        if measured:
            motion, self._expected = drawn_path(scenario, measured.filter, self._motion[0])
            self._motion = self._onward(motion, 0)

    def first(self) -> Phase:
        """The first phase."""
        blocks = self._followed(None) if self._measured else {}
        return self.approach(self.handover.sample - self.samples, self._close, blocks)

    def _phase(
        self, *, follows: bool = True, sees: bool = True, afresh: Sequence[str] = (), **how: Any
    ) -> Phase:
        """A phase on the plan of the last try, after the moves of a retreat. Args: see
        ``_followed``; further fields.
        """
        plan, motion = dataclasses.replace(self.scenario, holds=how.get("holds", False)), None
        if self._moves:
            motion = along(self._moves, plan, self.before.coordinates, again=self._again)
        blocks = {**self._supervises, **how.pop("blocks", {})}
        if self._measured:
            blocks |= self._followed(motion, follows=follows, sees=sees)
        elif not plan.holds:
            afresh = (*afresh, "reference")
        return Phase(
            scenario=plan,
            motion=None if self._measured else motion,
            blocks=blocks,
            afresh=tuple(afresh),
            **how,
        )

    def _stop(self) -> Phase:
        """The stop with the target in the gripper, at rest there, planned from the state that the
        servicer measures.
        """
        scenario, model = self.scenario, make_nominal_plant(self.scenario)
        q, v = np.split(self._estimated, [model.plant.num_positions()])
        body = payload_body(scenario, model)
        w, v_P = np.split(model.calc_jacobian(q, body.body_frame()) @ v, 2)
        arm = body.EvalPoseInWorld(model.context).rotation() @ np.array(
            scenario.payload.truth.center_of_mass
        )
        capture = dataclasses.replace(
            self._capture,
            rate=w.tolist(),
            velocity=(v_P + np.cross(w, arm)).tolist(),
            axes="world",
            servicer="given",
            servicer_velocity=dict(zip(model.coordinates.names, v.tolist(), strict=True)),
            approach=given_approach(scenario),
        )
        scenario = dataclasses.replace(
            scenario, initial_posture=posture_of(q, model.coordinates), capture=capture
        )
        scenario = _with_clear_stop(scenario, model.coordinates)
        handover = Handover(scenario)
        handover.sample, handover.path = self.sample, self._motion[: self.sample]
        handover.find_target(self._motion[self.sample])
        self.handover, self.scenario = handover, scenario
        self.meet()
        return self._phase(
            names=(("stop", None),), holds=True, follows=False, sees=False, afresh=("controller",)
        )

    @property
    def path(self) -> np.ndarray:
        """Motion of the target (n, 13) at the samples of the run, as far as is known."""
        return self._motion

    def _note(self, phase: Phase, log: RunLog) -> None:
        first = self.sample
        super()._note(phase, log)
        block: Any = self.loop.blocks[GRIPPER]
        if block.motions:  # the target is where the gripper moved it
            self._motion = np.vstack([self._motion[:first], *block.motions[: log.time.size]])

    def _close(self) -> Phase | None:
        """Close the gripper, unless it misses."""
        first, handover = self.sample, self.handover
        if since := given_up(self.logs[-1]):
            return self._retreat(MISSED, f"is not met: {since}")
        handover.find_target(self._motion[first])
        self.meet()
        if beyond := handover.beyond_envelope():
            return self._retreat(MISSED, f"is missed: {beyond}")
        last = first + self.samples
        return self._phase(
            names=((self._numbered("closing"), last),),
            blocks={
                GRIPPER: Gripper(self._capture.compliance or Compliance()),
                **self._supervised(waits=True),
            },
            joint_force=_lately(self.logs[-1]) if self._closing.joints == "limp" else None,
            sees=False,
            begin=self._begin_to_close,
            next=lambda: self._judge(first),
        )

    def _begin_to_close(self, loop: ClosedLoop, root_context: Context) -> None:
        """Begin to close the gripper at the present sample."""
        force: Any = loop.blocks[GRIPPER]
        force.begin(
            force.GetMyMutableContextFromRoot(root_context),
            payload=self._chosen.payload.truth,
            target=self._motion[self.sample],
            state=loop.whole_states(root_context)[0],
        )

    def _judge(self, first: int) -> Phase | None:
        """Go on with the target, if the gripper that began to close at a sample holds it."""
        force: Any = self.before.blocks[GRIPPER]
        state = self.before.whole_states(self.context)[0]
        met: Met = force.met(force.GetMyContextFromRoot(self.context), state)
        onward = self._onward(met.motion, self.sample)
        self._motion = np.vstack([self._motion, onward])
        turning, moving = np.linalg.norm(met.rate.reshape(2, 3), axis=1).tolist()
        if math.isinf(met.left) and max(turning, moving) <= self._closing.rest:
            return self._stop()
        away = float(np.linalg.norm(met.offset[3:]))
        closed_at = first * self._chosen.sample_time + self._closing.time
        status = BOUNCED if met.left < closed_at else SLIPPED
        how = "bounces off the gripper" if status == BOUNCED else "slips out of the gripper"
        motion = f"{number(moving)} m/s and {number(turning)} rad/s"
        return self._retreat(status, f"{how}: {number(away)} m away, moving at {motion} from it")

    def _numbered(self, name: str) -> str:
        return name if self._tries == 1 else f"{name}_{self._tries}"

    def _onward(self, motion: np.ndarray, sample: int) -> np.ndarray:
        """The free target's motion (n, 13) from a sample to the end of the run."""
        return coast(
            self._chosen,
            RigidTransform(Quaternion(motion[:4]), motion[4:7]),
            motion[7:],
            time=sample * self._chosen.sample_time,
            samples=self._chosen.num_control_periods + 1 - sample,
            onward=True,
        )

    def _retreat(self, status: str, what: str) -> Phase | None:
        """Move away from the target, which was not captured, and to it again if there are tries
        left and a way to it.
        """
        period, retreat = self._chosen.sample_time, self._capture.retreat
        message = f"at t = {self.sample * period:g} s the target {what}"
        self._fail(status, message)
        if retreat is None:
            return None
        self._known = self._seen
        away = self._away(retreat)
        end = self.sample + round(away.duration / period)
        if end > self._chosen.num_control_periods:
            return None
        self.failed = None  # unless the retreat comes to its end
        name, left = (self._numbered("retreat"), end), self._tries < retreat.tries
        touched = status != MISSED

        def apart() -> Phase | None:
            last = self.before.whole_states(self.context)[0][4:7]
            path = Path(motion=self._motion, arm=self._true_arm)
            far = number(float(np.linalg.norm(last - path.center(self.sample - 1))))
            self._fail(status, f"{message}; the servicer retreats to {far} m from it")
            return None

        def again(*, touched: bool = False) -> Phase | None:
            if left and self._meet_again(away.goal, end):
                self._tries += 1
                begin = self.handover.sample - round(self._approach.duration / period)
                closes = self.handover.sample - self.samples
                names = ((name[0], begin), (self._numbered("approach"), closes))
                moves = (away, self._across)
                return self._along(
                    moves, names, again=begin * period, touched=touched, next=self._close
                )
            if self.sample < end:
                return self._along((away,), (name,), touched=touched, next=apart)
            return apart()

        def seen() -> Phase | None:  # it looks at the target before it plans the next try
            self._known = self._seen
            return again()

        if left and self._measured:
            return self._along((away,), (name,), touched=touched, next=seen)
        return again(touched=touched)

    def _along(
        self,
        moves: tuple[Move, ...],
        names: tuple[tuple[str, int | None], ...],
        *,
        again: float | None = None,
        touched: bool,
        next: Callable[[], Phase | None],
    ) -> Phase:
        """Along moves, and from ``again`` on (s) along the next approach; ``touched``: the gripper
        has touched the target since it was seen.
        """
        self._moves, self._again = moves, again
        self._supervises = self._supervised(begin=moves[0].begin if again is None else again)

        def renew(loop: ClosedLoop, root_context: Context) -> None:
            block: Any = loop.blocks["reference"]
            block.renew(block.GetMyMutableContextFromRoot(root_context), touched=touched)

        return self._phase(
            names=names,
            follows=again is not None,
            afresh=("controller", "supervisor"),
            next=next,
            begin=renew if self._measured else _nothing,
        )

    @property
    def _estimated(self) -> np.ndarray:
        """The state [q; v] that the servicer measures."""
        found: np.ndarray = self.before.diagram.GetOutputPort("estimated_state").Eval(self.context)
        return found

    def _away(self, retreat: Retreat) -> Move:
        """Motion from the measured state to rest away from the target, within the limits and the
        time of the run: straight away from it, or in the nearest clear direction to a face, an edge
        or a corner of a cube.
        """
        scenario, coordinates = self._chosen, self.before.coordinates
        q, v = np.split(self._estimated, [len(coordinates.position_names)])
        from_target = q[4:7] - self._known.center(self.sample)
        straight, moves = from_target / np.linalg.norm(from_target), []
        for direction in (
            straight,
            *(each for each in outwards(straight) if each @ straight > 0.5),
        ):
            goal = dataclasses.replace(
                approach_posture(scenario),
                base_position=(q[4:7] + self._retreats(retreat, from_target) * direction).tolist(),
                base_rpy=base_rpy(q).tolist(),
            )
            move = Move(
                begin=self.sample * scenario.sample_time,
                duration=retreat.duration,
                start=posture_of(q, coordinates),
                goal=goal,
                velocity=v,
            )
            moves.append(self._paced(move))
            last = self.sample + round(moves[-1].duration / scenario.sample_time)
            samples = np.linspace(self.sample, min(last, len(self._motion) - 1), 2 * _INSTANTS)
            motion = moves[-1].motion(scenario, coordinates)
            if self._is_clear(motion, samples, self.sample):
                return moves[-1]
        return moves[0]

    def _retreats(self, retreat: Retreat, from_target: np.ndarray) -> float:
        """How far a retreat goes, m: to ``distance`` beyond where the base is at the grasp."""
        return max(0.0, self._reach + retreat.distance - float(np.linalg.norm(from_target)))

    def _paced(self, move: Move) -> Move:
        """A retreat that lasts as long as the limits ask for and the run leaves."""
        scenario, coordinates = self._chosen, self.before.coordinates

        def motion_in(duration: float) -> PlannedMotion:
            return dataclasses.replace(move, duration=duration).motion(scenario, coordinates)

        left = (scenario.num_control_periods - self.sample) * scenario.sample_time
        duration = gentle_duration(scenario, motion_in, move.duration)
        return dataclasses.replace(move, duration=max(min(duration, left), move.duration))

    def _followed(
        self, motion: PlannedMotion | None, *, follows: bool = True, sees: bool = True
    ) -> dict[str, Factory]:
        """The reference that follows the estimate of a measured target from a motion, or only
        estimates it; ``sees``: whether there are images.
        """
        assert self._measured is not None
        period, meets = self._chosen.sample_time, self.handover.sample
        begin = meets - round(self._approach.duration / period)
        approached = Approached(
            begin=begin * period,
            contact=(meets - self.samples) * period,
            meets=meets * period,
            motion=self.handover.expected,
        )
        part = TrackedTarget(
            self._chosen,
            self._capture,
            self._measured,
            self._motion,
            self._expected,
            motion=motion,
            approached=approached if follows else None,
            sees=sees,
        )
        return {"reference": part}

    @property
    def _seen(self) -> Path:
        """The path of the target as the servicer estimates it: from now, by the present
        estimate.
        """
        if not self._measured:
            return dataclasses.replace(self._known, motion=self._motion)
        block: Any = self.before.blocks["reference"]
        context = block.GetMyContextFromRoot(self.context)
        path: Path = block.known_path(context, self.sample, len(self._motion) - self.sample)
        motion = np.vstack([self._motion[: self.sample], path.motion])
        return dataclasses.replace(path, motion=motion)

    def _supervised(self, **how: Any) -> dict[str, Factory]:
        """The block of the supervisor, made by ``SupervisorPart``; None: there is none."""
        return {} if self._chosen.supervisor is None else {"supervisor": SupervisorPart(**how)}

    @property
    def _true_arm(self) -> np.ndarray:
        """p_PC (3) of the target, in P's axes."""
        return np.array(self._chosen.payload.truth.center_of_mass)

    def _meet_again(self, start: Posture, first: int) -> bool:
        """Find the next try, from rest in a posture at a sample or later: the first one moved with
        the target to where the servicer has least to move ``_across`` to its begin, on a way that
        keeps clear. False: there is none.
        """
        chosen, period = self._chosen, self._chosen.sample_time
        lasts = round(self._approach.duration / period)
        stop = chosen.reference.duration or self._approach.duration
        earliest = first + lasts + round(_EVERY / period)
        latest = chosen.num_control_periods - math.ceil(stop / period)
        X_BP = self._target_from_base(make_nominal_plant(chosen))
        X_BS = _base_pose(chosen.initial_posture).inverse() @ _base_pose(approach_posture(chosen))
        X_W0 = _base_pose(start)
        candidates = []
        for sample in range(earliest, latest + 1, max(1, round(_EVERY / period))):
            motion = self._known.motion[sample]
            X_WB = RigidTransform(Quaternion(motion[:4]), motion[4:7]) @ X_BP.inverse()
            X_0S = X_W0.inverse() @ X_WB @ X_BS
            way = np.linalg.norm(X_0S.translation())
            candidates.append((way + _LENGTH * X_0S.rotation().ToAngleAxis().angle(), sample, X_WB))
        for _, sample, X_WB in sorted(candidates, key=lambda each: each[0])[:_CANDIDATES]:
            scenario = self._try(X_WB, X_WB @ X_BS, self._known.motion[sample])
            begin = sample - lasts
            if self._leads_to(start, scenario, first, begin) and self._is_clear(
                make_motion(dataclasses.replace(scenario, holds=False), self.before.coordinates),
                np.linspace(begin, sample - self.samples, _INSTANTS),
                begin,
                margin=self._approach.margin,
            ):
                self.scenario, self.handover = scenario, Handover(scenario)
                self.handover.sample = sample
                return True
        return False

    def _target_from_base(self, model: PlantModel) -> RigidTransform:
        """X_BP of the target's frame in the base's, where the arm is to meet it."""
        q = configuration(model.plant, self._chosen.initial_posture, key="initial_posture")
        model.plant.SetPositions(model.context, q)
        body = payload_body(self._chosen, model).body_frame()
        return RigidTransform(body.CalcPose(model.context, base_body(model.plant).body_frame()))

    def _try(self, X_WB: RigidTransform, X_WS: RigidTransform, motion: np.ndarray) -> Scenario:
        """The scenario of a further try, with the base at X_WS where its approach begins, at X_WB
        where it ends, and the target then in a motion (13).
        """
        chosen = self._chosen
        w, v_P = np.split(motion[7:], 2)
        # ``capture.velocity`` refers to the true centre of mass; used only to recover v_P
        arm = matrix_of(motion[:4]) @ self._true_arm
        posture = _placed(approach_posture(chosen), X_WS)
        capture = dataclasses.replace(
            self._capture,
            axes="world",
            rate=w.tolist(),
            velocity=(v_P + np.cross(w, arm)).tolist(),
            approach=dataclasses.replace(self._approach, posture=posture, start="given"),
        )
        posture = _placed(chosen.initial_posture, X_WB)
        blocks = dataclasses.replace(chosen.blocks, phases={})
        return dataclasses.replace(chosen, initial_posture=posture, capture=capture, blocks=blocks)

    def _leads_to(self, start: Posture, scenario: Scenario, first: int, begin: int) -> bool:
        """Whether the servicer, at rest in a posture from a sample on, can ``_across`` be where the
        approach of a try begins, at another sample.
        """
        period, goal = scenario.sample_time, approach_posture(scenario)
        move = Move(begin=first * period, duration=(begin - first) * period, start=start, goal=goal)
        self._across, motion = move, move.motion(scenario, self.before.coordinates)
        samples = np.linspace(first, begin, _INSTANTS)
        margin = self._approach.margin
        return is_gentle(scenario, motion) and self._is_clear(motion, samples, first, margin=margin)

    def _is_clear(
        self, motion: PlannedMotion, samples: np.ndarray, first: int, *, margin: float = 0.0
    ) -> bool:
        """Whether a motion that begins at a sample keeps the scenario's clearance, and a margin (m)
        beyond it, at others.
        """
        samples, scenario = samples.round().astype(int), self._chosen
        times = (samples - first) * scenario.sample_time
        q = motion.rows(times)[:, : len(self.before.coordinates.position_names)]
        target = self._known.motion[samples, :7]
        nearest = closest_of(scenario, times, q, target=target)
        return all(each.keeps(scenario.clearance + margin) for each in nearest)


def _nothing(loop: ClosedLoop, root_context: Context) -> None:
    pass


def _lately(log: RunLog) -> np.ndarray:
    """The mean force (joints) of the joints' actuators over the last samples of a log."""
    applied = log.series["applied_force"][-_LATELY:, NUM_BASE_VELOCITIES:]
    found: np.ndarray = applied.mean(axis=0)
    return found


def _with_clear_stop(scenario: Scenario, coordinates: Coordinates) -> Scenario:
    """The scenario with a stop that keeps clear (a slow stop of a tumbling target swings far).

    Its duration is the nearest to ``reference.duration`` with a plan within clearance and limits of
    force; the scenario's own without one.
    """
    duration = scenario.reference.duration
    if duration is None or scenario.reference.kind == "optimal":
        return scenario
    model = make_nominal_plant(scenario)
    limit = actuation_limit(scenario, coordinates, helped=True).upper
    nq, nv = len(coordinates.position_names), len(coordinates.names)
    for factor in _PACES:
        reference = dataclasses.replace(scenario.reference, duration=factor * duration)
        paced = dataclasses.replace(scenario, reference=reference)
        motion = make_motion(paced, coordinates)
        if motion.end > scenario.duration:
            continue
        times = np.linspace(motion.begin, motion.end, 2 * _INSTANTS)
        q, v, a = np.split(motion.rows(times), [nq, nq + nv], axis=1)
        if (np.abs(model.calc_tracking_force(q, v, a)) <= limit).all() and all(
            each.keeps(scenario.clearance) for each in closest_of(scenario, times, q)
        ):
            return paced
    return scenario


def _base_pose(posture: Posture) -> RigidTransform:
    """X_WB of a posture."""
    return RigidTransform(RollPitchYaw(posture.base_rpy), posture.base_position)


def _placed(posture: Posture, X_WB: RigidTransform) -> Posture:
    """A posture with the base elsewhere."""
    rpy = RollPitchYaw(X_WB.rotation()).vector()
    return dataclasses.replace(
        posture, base_position=X_WB.translation().tolist(), base_rpy=rpy.tolist()
    )
