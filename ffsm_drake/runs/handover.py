"""The way of a run from the loop before the grasp to the one after it."""

import dataclasses
import time
from collections.abc import Sequence

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix
from ffsm_drake.spacecraft.capture import contact_at, planned_contact, target_body, target_path
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration, find_frame
from ffsm_drake.systems.approach import approach_posture
from ffsm_drake.systems.part import STORED_MOMENTUM


class Handover:
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
        self._X_WP, self.path = target_path(scenario, model, planned)
        # motion (13) of the target where the arm is planned to meet it
        pose = [*self._X_WP.rotation().ToQuaternion().wxyz(), *self._X_WP.translation()]
        self.expected = np.concatenate([pose, self._twist])
        self.legs: tuple[tuple[str, int], ...] = ()  # before the grasp; see GraspLog

    def start(self, loop: ClosedLoop) -> np.ndarray:
        """The plant's own [q; v] of the servicer where the approach starts."""
        capture = self._scenario.capture
        if capture is None or capture.approach is None:
            raise ValueError("capture.approach: there is none")
        position = configuration(
            loop.single, approach_posture(self._scenario), key="capture.approach.posture"
        )
        velocity = loop.coordinates.vector(
            self._scenario.initial_velocity, key="initial_velocity", default=0.0
        )
        return loop.split.whole(np.concatenate([position, velocity]))

    def ungrasped(self, samples: int) -> GraspLog:
        """Log of a run that ended before the grasp, after a number of samples."""
        payload = self._scenario.payload.truth
        return GraspLog(sample=samples, contact=None, payload=payload, target=self.path[:samples])

    def joined(self, approach: RunLog, log: RunLog, start: float) -> RunLog:
        """The log of both legs of a run that began at a wall time."""
        return dataclasses.replace(
            log,
            time=np.concatenate([approach.time, log.time]),
            series={
                name: np.concatenate([approach.series[name], values])
                for name, values in log.series.items()
                if name in approach.series
            },
            wall_time={
                "build": approach.wall_time["build"] + log.wall_time["build"],
                "advance_to": approach.wall_time["advance_to"] + log.wall_time["advance_to"],
                "total": time.perf_counter() - start,
            },
            grasp=dataclasses.replace(self.log, stored=stored_at_start(log)),
        )

    def find_target(self, motion: np.ndarray) -> None:
        """The target is elsewhere than planned: at (13) [quaternion, p_WP; w_WP, v_WP]."""
        quaternion = Quaternion(motion[:4] / np.linalg.norm(motion[:4]))
        self._X_WP, self._twist = RigidTransform(quaternion, motion[4:7]), motion[7:]

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
        self._mismatch = mismatch_of(scenario, model, self._q, self._v, self._twist_Q)

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
            target=self.path,
            legs=self.legs,
            offset=self._offset,
            mismatch=self._mismatch,
        )
        return np.concatenate([self._q, contact.grasp.velocity])


class Handovers:
    """Those of runs side by side, or of one, as callbacks of their legs."""

    def __init__(self, each: Sequence[Handover], *, afresh: bool = False) -> None:
        """Args: of each run; whether their laws start afresh with the target held."""
        self.each, self._afresh = each, afresh
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
        before, context_before = self._before, self._context_before
        loop.resume(root_context, before, context_before, references, afresh=self._afresh)
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


def stored_at_start(log: RunLog) -> np.ndarray | None:
    """The momentum (3) that parts store at a log's start; None where none does."""
    stored = log.with_role(STORED_MOMENTUM)
    return None if stored is None else stored[0]


def mismatch_of(
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
