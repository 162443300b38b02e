"""Runs with a capture: the servicer alone up to the grasp, then with the target, with one
controller.

Each side of the grasp is a closed loop with its own nominal model. At the grasp the states of
sensors, actuators and forces are kept, the law resumes (``ControlLaw.resume``), and the servicer's
velocity jumps. The target is held where the gripper meets it: the position error of the arm becomes
part of the payload's mass properties.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import BlockError
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.ending import MISSED, Outcome
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix
from ffsm_drake.spacecraft.capture import (
    contact_at,
    planned_contact,
    target_body,
    target_path,
)
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel, make_flexible_plant, make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration, find_frame
from ffsm_drake.systems.part import STORED_MOMENTUM
from ffsm_drake.systems.reference import without_target
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.supervisor import Mode


class CaptureRollout:
    """As ``Rollout``, for a scenario with a capture, or several that grasp at the same sample."""

    def __init__(
        self,
        scenario: Scenario | Sequence[Scenario],
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Args and errors as for ``Rollout``."""
        self._stop = Rollout(scenario, blocks=blocks, meshcat=meshcat)
        self._scenarios = _as_tuple(scenario)
        self._approach = None
        first = self._scenarios[0]
        if first.grasp_time > 0.0:
            target = None
            if meshcat is not None:
                model = make_nominal_plant(first)
                target = target_path(first, model, planned_contact(first, model))[1][:, :7]
            self._approach = Rollout(
                [without_target(each) for each in self._scenarios],
                blocks=blocks,
                meshcat=meshcat,
                target=target,
            )

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop with the target held."""
        return self._stop.loop

    def release(self) -> None:
        """As ``Rollout.release``."""
        for rollout in (self._stop, self._approach):
            if rollout is not None:
                rollout.release()

    def accepts(self, scenario: Scenario | Sequence[Scenario]) -> bool:
        """As ``Rollout.accepts``; the payload's true centre of mass must be the same too, since the
        target's motion depends on it.
        """
        centers, built = (
            [each.payload.truth.center_of_mass for each in scenarios]
            for scenarios in (_as_tuple(scenario), self._scenarios)
        )
        return self._stop.accepts(scenario) and centers == built

    def check(self) -> None:
        """As ``Rollout.check``."""
        for rollout in (self._approach, self._stop):
            if rollout is not None:
                rollout.check()

    def run(
        self,
        scenario: Scenario | None = None,
        *,
        progress: Callable[[float, float], None] | None = None,
    ) -> RunLog:
        """As ``Rollout.run``; at the sample of the grasp the log holds the velocity after it."""
        start = time.perf_counter()
        chosen = scenario or self._stop.loop.scenario
        if self._approach is None:
            return _grasped_at_start(self._stop.run(scenario, progress=progress))
        handovers = _Handovers([chosen])
        sample, (handover,) = handovers.sample, handovers.each
        try:
            approach = self._approach.run(
                None if scenario is None else without_target(scenario),
                progress=progress,
                leg=Leg(last=sample, begin=handovers.start, end=handovers.keep),
            )
        except BlockError as error:
            if error.log is not None:
                ungrasped = handover.ungrasped(error.log.time.size)
                error.log = dataclasses.replace(error.log, scenario=chosen, grasp=ungrasped)
            raise
        ungrasped = handover.ungrasped(approach.time.size)
        if not approach.outcome.completed:
            return dataclasses.replace(approach, scenario=chosen, grasp=ungrasped)
        if given_up := _given_up(approach):
            return dataclasses.replace(approach, scenario=chosen, outcome=given_up, grasp=ungrasped)
        handovers.meet(self._stop.loop)
        if beyond := handover.beyond_envelope():
            last = float(approach.time[-1])
            message = f"the target is missed at t = {chosen.grasp_time:g} s: {beyond}"
            missed = Outcome(status=MISSED, time=last, message=message)
            return dataclasses.replace(approach, scenario=chosen, outcome=missed, grasp=ungrasped)
        try:
            log = self._stop.run(
                scenario, progress=progress, leg=Leg(first=sample, begin=handovers.grasp)
            )
        except BlockError as error:
            if error.log is not None:
                error.log = handover.joined(approach, error.log, start)
            raise
        return handover.joined(approach, log, start)

    def run_all(self, scenarios: Sequence[Scenario] | None = None) -> list[RunLog | None]:
        """As ``Rollout.run_all``; None of one that misses its target, too."""
        start = time.perf_counter()
        if self._approach is None:
            logs = self._stop.run_all(scenarios)
            return [None if log is None else _grasped_at_start(log) for log in logs]
        handovers = _Handovers(self._scenarios if scenarios is None else scenarios)
        sample = handovers.sample
        approaches = self._approach.run_all(
            None if scenarios is None else [without_target(each) for each in scenarios],
            leg=Leg(last=sample, begin=handovers.start, end=handovers.keep),
        )
        if all(log is None for log in approaches):
            return approaches
        handovers.meet(self._stop.loop, without=[log is None for log in approaches])
        logs = self._stop.run_all(
            scenarios,
            leg=Leg(first=sample, begin=handovers.grasp),
            without=handovers.ended,
        )
        return [
            None if before is None or after is None else handover.joined(before, after, start)
            for before, after, handover in zip(approaches, logs, handovers.each, strict=True)
        ]


def _given_up(approach: RunLog) -> Outcome | None:
    """The outcome of an approach from which the supervisor retreats; None of any other."""
    modes = approach.series.get("mode", np.zeros(1)).ravel()
    if modes[-1] == Mode.APPROACH:
        return None
    since = float(approach.time[np.flatnonzero(modes != Mode.APPROACH)[0]])
    message = f"the approach is given up at t = {since:g} s"
    return Outcome(status=MISSED, time=float(approach.time[-1]), message=message)


def _as_tuple(scenario: Scenario | Sequence[Scenario]) -> tuple[Scenario, ...]:
    return (scenario,) if isinstance(scenario, Scenario) else tuple(scenario)


def _grasped_at_start(log: RunLog) -> RunLog:
    """The log of a run that begins with the planned grasp."""
    model = make_flexible_plant(log.scenario)
    contact = planned_contact(log.scenario, model)
    mismatch = _mismatch(log.scenario, model, contact.q, contact.velocity, contact.target_velocity)
    grasp = GraspLog(
        sample=0,
        contact=contact,
        payload=log.scenario.payload.truth,
        target=np.empty((0, 13)),
        mismatch=mismatch,
        stored=_stored(log),
    )
    return dataclasses.replace(log, grasp=grasp)


def make_rollout(
    scenario: Scenario | Sequence[Scenario],
    *,
    blocks: Mapping[str, Factory] | None = None,
    meshcat: Meshcat | None = None,
) -> Rollout | CaptureRollout:
    """The rollout of a scenario, or of several; arguments and errors as for ``Rollout``."""
    kind = Rollout if _as_tuple(scenario)[0].capture is None else CaptureRollout
    return kind(scenario, blocks=blocks, meshcat=meshcat)


class _Handover:
    """Takes a run from the loop before the grasp to the one after it."""

    log: GraspLog

    def __init__(self, scenario: Scenario) -> None:
        self._scenario, self.truth = scenario, scenario.payload.truth
        self.sample = round(scenario.grasp_time / scenario.sample_time)
        model = make_nominal_plant(scenario)
        planned = planned_contact(scenario, model)
        self.reference = np.concatenate([planned.q, planned.grasp.velocity])
        # The target's own motion up to where it is to be met.
        self._twist = planned.target_velocity
        self._X_WP, self._path = target_path(scenario, model, planned)

    def start(self, loop: ClosedLoop) -> np.ndarray:
        """The plant's own [q; v] of the servicer where the approach starts."""
        capture = self._scenario.capture
        if capture is None or capture.approach is None:
            raise ValueError("capture.approach: there is none")
        position = configuration(
            loop.single, capture.approach.posture, key="capture.approach.posture"
        )
        velocity = loop.coordinates.vector(
            self._scenario.initial_velocity, key="initial_velocity", default=0.0
        )
        return loop.split.whole(np.concatenate([position, velocity]))

    def ungrasped(self, samples: int) -> GraspLog:
        """Log of a run that ended before the grasp, after a number of samples."""
        payload = self._scenario.payload.truth
        return GraspLog(sample=samples, contact=None, payload=payload, target=self._path[:samples])

    def joined(self, approach: RunLog, log: RunLog, start: float) -> RunLog:
        """The log of both legs of a run that began at a wall time."""
        return dataclasses.replace(
            log,
            time=np.concatenate([approach.time, log.time]),
            series={
                name: np.concatenate([approach.series[name], values])
                for name, values in log.series.items()
            },
            wall_time={
                "build": approach.wall_time["build"] + log.wall_time["build"],
                "advance_to": approach.wall_time["advance_to"] + log.wall_time["advance_to"],
                "total": time.perf_counter() - start,
            },
            grasp=dataclasses.replace(self.log, stored=_stored(log)),
        )

    def meet(self, loop: ClosedLoop, state: np.ndarray) -> None:
        """Find how the gripper, at the plant's own [q; v], meets the target, with the loop in which
        it is held.
        """
        scenario, plant = self._scenario, loop.single
        self._q, self._v = np.split(state, [plant.num_positions()])
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, self._q)
        model = dataclasses.replace(loop.model(context), plant=plant)
        # X_WQ: where the model welds the target's frame P
        self._X_WQ = RigidTransform(target_body(scenario, model).EvalPoseInWorld(context))
        offset = self._X_WQ.translation() - self._X_WP.translation()
        self._twist_Q = self._twist.copy()
        self._twist_Q[3:] += np.cross(self._twist_Q[:3], offset)
        turn = (self._X_WP.rotation() @ self._X_WQ.rotation().inverse()).ToAngleAxis()
        self._offset = np.concatenate([turn.angle() * turn.axis(), -offset])
        self._mismatch = _mismatch(scenario, model, self._q, self._v, self._twist_Q)

    def beyond_envelope(self) -> str:
        """The part of the miss beyond ``capture.envelope``; empty where the gripper holds."""
        capture = self._scenario.capture
        if capture is None:
            return ""
        (angle, distance), (rate, speed) = (
            np.linalg.norm(part.reshape(2, 3), axis=1).tolist()
            for part in (self._offset, self._mismatch)
        )
        sizes = {
            "position": (distance, "m"),
            "angle": (angle, "rad"),
            "velocity": (speed, "m/s"),
            "angular_velocity": (rate, "rad/s"),
        }
        limits = {name: getattr(capture.envelope, name) for name in sizes}
        return ", ".join(
            f"{name} {size:.3g} {unit} (capture.envelope.{name}: {limits[name]:g})"
            for name, (size, unit) in sizes.items()
            if limits[name] is not None and size > limits[name]
        )

    def grasp(self, loop: ClosedLoop) -> np.ndarray:
        """Grasp the target, as ``log`` says; the plant's own [q; v] after it."""
        scenario = self._scenario
        model = loop.true_model(scenario)
        payload = seen_from(scenario.payload.truth, self._X_WQ.InvertAndCompose(self._X_WP))
        set_payload(model.plant, model.context, body=scenario.payload.body, properties=payload)
        contact = contact_at(
            scenario, model, q=self._q, velocity=self._v, target_velocity=self._twist_Q
        )
        self.log = GraspLog(
            sample=self.sample,
            contact=contact,
            payload=payload,
            target=self._path,
            offset=self._offset,
            mismatch=self._mismatch,
        )
        return np.concatenate([self._q, contact.grasp.velocity])


class _Handovers:
    """Those of runs side by side, or of one, as callbacks of their legs."""

    def __init__(self, scenarios: Sequence[Scenario]) -> None:
        self.each = [_Handover(scenario) for scenario in scenarios]
        (self.sample,) = {handover.sample for handover in self.each}
        self.ended: set[int] = set()  # those that do not come to their grasp

    def start(self, loop: ClosedLoop, root_context: Context) -> None:
        """Put the servicers where the approaches start."""
        loop.set_whole_states(root_context, np.stack([each.start(loop) for each in self.each]))

    def keep(self, loop: ClosedLoop, root_context: Context) -> None:
        """Keep the loop before the grasp, and its context at the grasp."""
        self._before, self._context_before = loop, root_context

    def meet(self, loop: ClosedLoop, without: Sequence[bool] = (False,)) -> None:
        """Find how each gripper meets its target; ``without``: those whose approach failed."""
        self.ended = set(np.flatnonzero(without).tolist())
        for copy, state in enumerate(self._before.whole_states(self._context_before)):
            if copy not in self.ended:
                self.each[copy].meet(loop, state)
                if self.each[copy].beyond_envelope():
                    self.ended.add(copy)

    def grasp(self, loop: ClosedLoop, root_context: Context) -> None:
        """Grasp the targets; the runs continue from the states after the grasp."""
        rows = loop.whole_states(root_context)
        payloads = [each.truth for each in self.each]
        for copy, handover in enumerate(self.each):
            if copy not in self.ended:
                rows[copy] = handover.grasp(loop)
                payloads[copy] = handover.log.payload
        loop.set_whole_states(root_context, rows)
        references = np.stack([each.reference for each in self.each])
        loop.resume(root_context, self._before, self._context_before, references)
        # to the blocks, which resume with nothing in the gripper
        loop.set_payloads(root_context, payloads)


def seen_from(properties: MassProperties, X_QP: RigidTransform) -> MassProperties:
    """The mass properties of a body in frame P, in another frame Q of it."""
    R = X_QP.rotation().matrix()
    inertia = R @ inertia_matrix(properties) @ R.T
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return MassProperties(
        mass=properties.mass,
        center_of_mass=(X_QP @ np.array(properties.center_of_mass)).tolist(),
        inertia=inertia[rows, columns].tolist(),
    )


def _stored(log: RunLog) -> np.ndarray | None:
    """The momentum (3) that parts store at a log's start; None where none does."""
    stored = log.with_role(STORED_MOMENTUM)
    return None if stored is None else stored[0]


def _mismatch(
    scenario: Scenario, model: PlantModel, q: np.ndarray, v: np.ndarray, twist: np.ndarray
) -> np.ndarray:
    """[w; v] (6) of the target from the end effector, at its origin; ``twist`` is that of the
    payload body's frame.
    """
    model.plant.SetPositionsAndVelocities(model.context, np.concatenate([q, v]))
    effector = find_frame(model.plant, scenario.model.end_effector, key="model.end_effector")
    p_WP = target_body(scenario, model).EvalPoseInWorld(model.context).translation()
    moving = effector.CalcSpatialVelocityInWorld(model.context).get_coeffs()
    there = twist.copy()
    there[3:] += np.cross(twist[:3], effector.CalcPoseInWorld(model.context).translation() - p_WP)
    return there - moving
