"""Runs whose gripper closes over a time (``capture.closing``), up to the grasp: approach and
closing; then, with the target apart, retreat and the next try.

Each leg has a loop of its own; plant and blocks go on from leg to leg as they are.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context

from ffsm_drake.common.numbers import number
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.ending import BOUNCED, MISSED, SLIPPED, Outcome
from ffsm_drake.runs.handover import Handover
from ffsm_drake.runs.limits import closest_of
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Posture, Scenario
from ffsm_drake.scenario.capture import Closing, Compliance, Retreat
from ffsm_drake.spacecraft.capture import coast, target_body
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import base_body, base_rpy, configuration, posture_of
from ffsm_drake.systems.approach import (
    approach_posture,
    gentle_duration,
    given_approach,
    is_gentle,
    outwards,
)
from ffsm_drake.systems.gripper import Gripper, Met
from ffsm_drake.systems.limits import actuation_limit
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion, without_target
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.retreat import Move, RetreatReference
from ffsm_drake.systems.supervisor import Mode, SupervisorPart
from ffsm_drake.systems.target_filter import Path
from ffsm_drake.systems.tracked_target import Approached, TrackedTarget, drawn_path

_EVERY = 0.5  # s; between the instants at which a further try may meet the target
_LENGTH = 2.0  # m; a turn of the base by 1 rad counts as this way
_CANDIDATES = 30  # meetings looked at, those with the shortest ways
_INSTANTS = 15  # at which the clearance of each is looked at
_PACES = (1.0, 0.87, 1.15, 0.76, 1.32, 0.66, 1.52, 0.57, 0.5)  # of a stop, that may keep clear
_LATELY = 20  # samples before the contact, over which the joints' force is averaged

Begin = Callable[[ClosedLoop, Context], None]


def closing_of(scenario: Scenario) -> Closing | None:
    """The closing of a run's gripper; None where it closes at once."""
    capture = scenario.capture
    return None if capture is None or capture.approach is None else capture.closing


class ClosingRun:
    """The legs of one run up to the grasp.

    After ``run``, ``scenario``, ``blocks``, ``handover`` and ``sample`` are those of the last try,
    ``loop`` and ``context`` those in which it ended.
    """

    loop: ClosedLoop
    context: Context
    _across: Move  # from where a retreat ends to where the next try begins

    def __init__(
        self,
        scenario: Scenario,
        handover: Handover,
        *,
        blocks: Mapping[str, Factory] | None,
        progress: Callable[[float, float], None] | None,
    ) -> None:
        """Args: what to run; that of its first try; as for ``Rollout`` and its ``run``."""
        self.scenario, self.handover, self.blocks = scenario, handover, dict(blocks or {})
        self._chosen, self._progress = scenario, progress
        closing = closing_of(scenario)
        if closing is None or scenario.capture is None or scenario.capture.approach is None:
            raise ValueError("capture.closing: there is none")
        self._capture, self._closing = scenario.capture, closing
        self._approach = scenario.capture.approach
        self._samples = round(closing.duration / scenario.sample_time)  # of the closing
        self.sample = 0
        # motion of the target (n, 13) at the samples of the run, as far as is known
        last = handover.sample - 1
        self._path = np.vstack([handover.path[:last], self._onward(handover.path[last], last)])
        self._measured = self._capture.measured is not None
        nominal = np.array(scenario.payload.nominal.center_of_mass)
        arm = nominal if self._measured else self._true_arm
        self._known = Path(motion=self._path, arm=arm)
        place = np.array(scenario.initial_posture.base_position)  # at the grasp
        self._reach = float(np.linalg.norm(place - self._known.center(handover.sample)))
        if self._measured:
            motion, self._expected = drawn_path(scenario, self._path[0])
            self._path = self._onward(motion, 0)
        self._legs: list[tuple[str, int]] = []
        self.logs: list[RunLog] = []
        self.outcome: Outcome | None = None  # unless the target is captured

    def run(self, rollout: Rollout, scenario: Scenario | None, begin: Begin) -> bool:
        """Approach and close, and try again as ``capture.retreat`` says; True: it is captured.

        Args: the loop of the first approach; as for its ``run``; called at its start.
        """
        first = self.handover.sample - self._samples
        alone = None if scenario is None else without_target(scenario)
        if self._measured:
            rollout = Rollout(without_target(self.scenario), blocks=self.followed(self.blocks))
            alone = None
        flown = self._leg(rollout, [("approach", first)], begin, alone)
        tries, retreat = 1, self._capture.retreat
        while flown and not self._close(tries):
            if self.outcome is None or retreat is None:
                return False
            if not self._retreat(tries, retreat):
                return False
            tries += 1
        return flown

    def held(self) -> tuple[Scenario, Handover]:
        """What the run goes on with once the target is captured: a stop planned from the state that
        the servicer measures, with the target at rest in the gripper.
        """
        scenario, model = self.scenario, make_nominal_plant(self.scenario)
        state = self.loop.diagram.GetOutputPort("estimated_state").Eval(self.context)
        q, v = np.split(state, [model.plant.num_positions()])
        body = target_body(scenario, model)
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
        handover.sample, handover.path = self.sample, self._path[: self.sample]
        handover.legs = tuple(self._legs)
        handover.find_target(self._path[self.sample])
        return scenario, handover

    @property
    def ungrasped(self) -> GraspLog:
        """Log of the run so far."""
        return GraspLog(
            sample=self.sample,
            contact=None,
            payload=self._chosen.payload.truth,
            target=self._path[: self.sample],
            legs=tuple(self._legs),
        )

    @property
    def joined(self) -> RunLog:
        """The log of all legs."""
        *_, last = self.logs
        names = set.intersection(*(set(log.series) for log in self.logs))
        return dataclasses.replace(
            last,
            scenario=self._chosen,
            outcome=self.outcome or last.outcome,
            time=np.concatenate([log.time for log in self.logs]),
            series={
                name: np.concatenate([log.series[name] for log in self.logs])
                for name in last.series
                if name in names
            },
            wall_time={key: sum(log.wall_time[key] for log in self.logs) for key in last.wall_time},
            grasp=self.ungrasped,
        )

    def _keep(self, loop: ClosedLoop, root_context: Context) -> None:
        self.loop, self.context = loop, root_context

    def _leg(
        self,
        rollout: Rollout,
        names: Sequence[tuple[str, int]],
        begin: Begin,
        scenario: Scenario | None = None,
    ) -> bool:
        """Run on to the last of the samples with the names before them; False: it ends before."""
        leg = Leg(first=self.sample, last=names[-1][1], begin=begin, end=self._keep)
        log = rollout.run(scenario, progress=self._progress, leg=leg)
        self.logs.append(_without_contact(log))
        end = self.sample + log.time.size
        for name, last in names:
            count = min(last, end) - self.sample
            if count > 0:
                self._legs.append((name, count))
                self.sample += count
        return log.outcome.completed

    def _go_on(self, tell: Begin | None = None, *, afresh: bool = False) -> Begin:
        """A leg's begin that carries on the loop of the last one; ``tell``: called after it;
        ``afresh``: the law starts anew.
        """
        before, context_before = self.loop, self.context

        def begin(loop: ClosedLoop, root_context: Context) -> None:
            loop.carry_on(root_context, before, context_before, afresh=afresh)
            if tell is not None:
                tell(loop, root_context)

        return begin

    def _close(self, tries: int) -> bool:
        """Close the gripper, unless it misses; True: the target is captured."""
        self.outcome = None
        first, handover = self.sample, self.handover
        if since := given_up(self.logs[-1]):
            self._fail(MISSED, f"is not met: {since}")
            return False
        handover.find_target(self._path[first])
        handover.meet(self.loop, self.loop.whole_states(self.context)[0])
        if beyond := handover.beyond_envelope():
            self._fail(MISSED, f"is missed: {beyond}")
            return False
        name = "closing" if tries == 1 else f"closing_{tries}"
        part = Gripper(self._capture.compliance or Compliance())
        blocks = self._supervised({**self.blocks, GRIPPER: part}, waits=True)
        blocks = self.followed(blocks, sees=False)
        limp = self._closing.joints == "limp"
        applied = self.logs[-1].series["applied_force"][-_LATELY:, NUM_BASE_VELOCITIES:]
        rollout = Rollout(
            without_target(self.scenario),
            blocks=blocks,
            joint_force=applied.mean(axis=0) if limp else None,
        )

        def begin(loop: ClosedLoop, root_context: Context) -> None:
            force, context = _gripper(loop, root_context)
            force.begin(
                context,
                payload=self._chosen.payload.truth,
                target=self._path[first],
                state=loop.whole_states(root_context)[0],
            )

        flown = self._leg(rollout, [(name, first + self._samples)], self._go_on(begin))
        moved: Any = rollout.loop.blocks[GRIPPER]
        self._path = np.vstack([self._path[:first], *moved.motions[: self.sample - first]])
        if not flown:
            return False
        force, context = _gripper(self.loop, self.context)
        met = force.met(context, self.loop.whole_states(self.context)[0])
        pose = [*met.X_WP.rotation().ToQuaternion().wxyz(), *met.X_WP.translation()]
        onward = self._onward(np.concatenate([pose, met.twist]), self.sample)
        self._path = np.vstack([self._path, onward])
        return self._holds(met, first)

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

    def _holds(self, met: Met, first: int) -> bool:
        """Whether the target is held; else the outcome says how it got away."""
        turning, moving = np.linalg.norm(met.rate.reshape(2, 3), axis=1).tolist()
        if math.isinf(met.left) and max(turning, moving) <= self._closing.rest:
            return True
        away = float(np.linalg.norm(met.offset[3:]))
        closed_at = first * self._chosen.sample_time + self._closing.time
        status = BOUNCED if met.left < closed_at else SLIPPED
        how = "bounces off the gripper" if status == BOUNCED else "slips out of the gripper"
        motion = f"{number(moving)} m/s and {number(turning)} rad/s"
        self._fail(status, f"{how}: {number(away)} m away, moving at {motion} from it")
        return False

    def _retreat(self, tries: int, retreat: Retreat) -> bool:
        """Move away from the target, and to it again if there are tries left and a way to it; True:
        the gripper is to close once more.
        """
        period = self._chosen.sample_time
        self._known = self._seen
        moves = [self._away(retreat)]
        end = self.sample + round(moves[0].duration / period)
        if end > self._chosen.num_control_periods:
            return False
        failed, number_of = self.outcome, "" if tries == 1 else f"_{tries}"
        self.outcome, name, left = None, f"retreat{number_of}", tries < retreat.tries
        touched = failed is not None and failed.status != MISSED
        flown = True
        if left and self._measured:  # it looks at the target before it plans the next try
            flown = self._go(moves, [(name, end)], touched=touched)
            self._known, touched = self._seen, False
        again = flown and left and self._meet_again(moves[0].goal, end)
        if again:
            begin = self.handover.sample - round(self.scenario.grasp_time / period)
            names = [
                (name, begin),
                (f"approach_{tries + 1}", self.handover.sample - self._samples),
            ]
            flown = self._go([*moves, self._across], names, again=begin * period, touched=touched)
        elif self.sample < end and flown:
            flown = self._go(moves, [(name, end)], touched=touched)
        if failed is not None and flown and not again:
            last = self.loop.whole_states(self.context)[0][4:7]
            path = Path(motion=self._path, arm=self._true_arm)
            apart = float(np.linalg.norm(last - path.center(self.sample - 1)))
            message = f"{failed.message}; the servicer retreats to {number(apart)} m from it"
            time = (self.sample - 1) * period
            self.outcome = dataclasses.replace(failed, time=time, message=message)
        return flown and again

    def _go(
        self,
        moves: Sequence[Move],
        names: Sequence[tuple[str, int]],
        *,
        again: float | None = None,
        touched: bool,
    ) -> bool:
        """Run a leg along moves, and from ``again`` on (s) along the next approach; ``touched``:
        the gripper has touched the target since it was seen. False: it ends before.
        """
        self.blocks["reference"] = RetreatReference(moves=tuple(moves), again=again)
        begin = moves[0].begin if again is None else again
        self.blocks = self._supervised(self.blocks, begin=begin)
        blocks = self.followed(self.blocks, follows=again is not None)
        rollout = Rollout(without_target(self.scenario), blocks=blocks)

        def renew(loop: ClosedLoop, root_context: Context) -> None:
            block: Any = loop.blocks["reference"]
            block.renew(block.GetMyMutableContextFromRoot(root_context), touched=touched)

        tell = renew if self._measured else None
        return self._leg(rollout, names, self._go_on(tell, afresh=True))

    def _away(self, retreat: Retreat) -> Move:
        """From the measured state to rest away from the target, at a pace that the limits and the
        end of the run allow: straight away from it, or in the nearest other direction, to a face,
        an edge or a corner of a cube, in which it keeps clear.
        """
        scenario, coordinates = self._chosen, self.loop.coordinates
        state = self.loop.diagram.GetOutputPort("estimated_state").Eval(self.context)
        q, v = np.split(state, [len(coordinates.position_names)])
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
            samples = np.linspace(self.sample, min(last, len(self._path) - 1), 2 * _INSTANTS)
            motion = moves[-1].motion(scenario, coordinates)
            if self._is_clear(motion, samples, self.sample):
                return moves[-1]
        return moves[0]

    def _retreats(self, retreat: Retreat, from_target: np.ndarray) -> float:
        """How far a retreat goes, m: to ``distance`` beyond where the base is at the grasp."""
        return max(0.0, self._reach + retreat.distance - float(np.linalg.norm(from_target)))

    def _paced(self, move: Move) -> Move:
        """A retreat that lasts as long as the limits ask for and the run leaves."""
        scenario, coordinates = self._chosen, self.loop.coordinates

        def motion_in(duration: float) -> PlannedMotion:
            return dataclasses.replace(move, duration=duration).motion(scenario, coordinates)

        left = (scenario.num_control_periods - self.sample) * scenario.sample_time
        duration = gentle_duration(scenario, motion_in, move.duration)
        return dataclasses.replace(move, duration=max(min(duration, left), move.duration))

    def followed(
        self, blocks: dict[str, Factory], *, follows: bool = True, sees: bool = True
    ) -> dict[str, Factory]:
        """Blocks with a reference that follows the target's estimate, if that is measured, or only
        estimates it; ``sees``: whether there are images.
        """
        if not self._measured:
            return blocks
        period, meets = self._chosen.sample_time, self.handover.sample
        begin = meets - round(self.scenario.grasp_time / period)
        approached = Approached(
            begin=begin * period,
            contact=(meets - self._samples) * period,
            meets=meets * period,
            motion=self.handover.expected,
        )
        inner: Any = blocks.get("reference")
        part = TrackedTarget(
            self._chosen,
            self._path,
            self._expected,
            inner=inner,
            approached=approached if follows else None,
            sees=sees,
        )
        return {**blocks, "reference": part}

    @property
    def _seen(self) -> Path:
        """The target's path as the servicer knows it: from now on by the estimate."""
        if not self._measured:
            return dataclasses.replace(self._known, motion=self._path)
        block: Any = self.loop.blocks["reference"]
        context = block.GetMyContextFromRoot(self.context)
        path: Path = block.known_path(context, self.sample, len(self._path) - self.sample)
        motion = np.vstack([self._path[: self.sample], path.motion])
        return dataclasses.replace(path, motion=motion)

    def _supervised(self, blocks: dict[str, Factory], **how: Any) -> dict[str, Factory]:
        """Blocks with the supervisor's, if there is one, made as ``SupervisorPart`` says."""
        if self._chosen.supervisor is None:
            return blocks
        return {**blocks, "supervisor": SupervisorPart(**how)}

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
        lasts = round(chosen.grasp_time / period)
        stop = chosen.reference.duration or chosen.grasp_time
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
                make_motion(without_target(scenario), self.loop.coordinates),
                np.linspace(begin, sample - self._samples, _INSTANTS),
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
        body = target_body(self._chosen, model).body_frame()
        return RigidTransform(body.CalcPose(model.context, base_body(model.plant).body_frame()))

    def _try(self, X_WB: RigidTransform, X_WS: RigidTransform, motion: np.ndarray) -> Scenario:
        """The scenario of a further try, with the base at X_WS where its approach begins, at X_WB
        where it ends, and the target then in a motion (13).
        """
        chosen = self._chosen
        w, v_P = np.split(motion[7:], 2)
        # the capture's velocity is that of the true centre of mass, which is nowhere used but to
        # find v_P again
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
        return dataclasses.replace(chosen, initial_posture=posture, capture=capture)

    def _leads_to(self, start: Posture, scenario: Scenario, first: int, begin: int) -> bool:
        """Whether the servicer, at rest in a posture from a sample on, can ``_across`` be where the
        approach of a try begins, at another sample.
        """
        period, goal = scenario.sample_time, approach_posture(scenario)
        move = Move(begin=first * period, duration=(begin - first) * period, start=start, goal=goal)
        self._across, motion = move, move.motion(scenario, self.loop.coordinates)
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
        q = motion.rows(times)[:, : len(self.loop.coordinates.position_names)]
        target = self._known.motion[samples, :7]
        nearest = closest_of(scenario, times, q, target=target)
        return all(each.distance >= scenario.clearance + margin for each in nearest)

    def _fail(self, status: str, what: str) -> None:
        time = self.sample * self._chosen.sample_time
        message = f"at t = {time:g} s the target {what}"
        self.outcome = Outcome(status=status, time=time, message=message)


def _gripper(loop: ClosedLoop, root_context: Context) -> tuple[Any, Context]:
    """The gripper's block of a loop, and its context."""
    block = loop.blocks[GRIPPER]
    return block, block.GetMyMutableContextFromRoot(root_context)


def _with_clear_stop(scenario: Scenario, coordinates: Coordinates) -> Scenario:
    """The scenario with a stop that keeps clear: from a tumbling target a slow one swings far. Its
    duration is the first of ``reference.duration``, a little less, a little more, and so on, whose
    plan keeps the scenario's clearance and the limits of force; that of the scenario if none does.
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
            each.distance >= scenario.clearance for each in closest_of(scenario, times, q)
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


def _without_contact(log: RunLog) -> RunLog:
    """A leg's log whose external force is that on servicer and target together."""
    series = dict(log.series)
    contact = series.pop(f"force_{GRIPPER.partition('.')[2]}", None)
    if contact is not None:
        series["disturbance_force"] = series["disturbance_force"] - contact
    return dataclasses.replace(log, series=series)


def given_up(approach: RunLog) -> str:
    """How an approach ended from which the supervisor retreats; empty of any other."""
    modes = approach.series.get("mode", np.zeros(1)).ravel()
    if modes[-1] == Mode.APPROACH:
        return ""
    since = float(approach.time[np.flatnonzero(modes != Mode.APPROACH)[0]])
    return f"the approach is given up at t = {since:g} s"
