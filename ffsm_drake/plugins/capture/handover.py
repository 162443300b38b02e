"""The way of a run from the loop before the grasp to the one after it."""

import dataclasses

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.approach import approach_posture, planned_approach
from ffsm_drake.plugins.capture.contact import (
    contact_at,
    payload_body,
    planned_contact,
    target_path,
)
from ffsm_drake.plugins.capture.made_grasp import MadeGrasp
from ffsm_drake.runs.log import RunLog
from ffsm_drake.scenario import Capture, MassProperties, Scenario, inertia_matrix
from ffsm_drake.spacecraft.inertia import SIX
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel, make_flexible_plant, make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration, hand_frame
from ffsm_drake.systems.part import STORED_MOMENTUM


class Handover:
    """Takes a run from the loop before the grasp to the one after it."""

    log: MadeGrasp | None = None  # log of the grasp, once it is made

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.payload = scenario, scenario.payload.truth  # as it lies in the gripper
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

    def start(self, loop: ClosedLoop) -> np.ndarray:
        """The plant's own [q; v] of the servicer where the run starts."""
        velocity = loop.coordinates.vector(
            self.scenario.initial_velocity, key="initial_velocity", default=0.0
        )
        if self.scenario.blocks.phases:
            position, planned, _ = planned_approach(self.scenario).evaluate(0.0)
            velocity += planned
        else:
            posture = approach_posture(self.scenario)
            position = configuration(loop.single, posture, key="capture.approach.posture")
        return loop.split.whole(np.concatenate([position, velocity]))

    def find_target(self, motion: np.ndarray) -> None:
        """The target is elsewhere than planned: at (13) [quaternion, p_WP; w_WP, v_WP]."""
        quaternion = Quaternion(motion[:4] / np.linalg.norm(motion[:4]))
        self._X_WP, self._twist = RigidTransform(quaternion, motion[4:7]), motion[7:]

    def meet(self, loop: ClosedLoop, state: np.ndarray) -> None:
        """Find how the gripper, at the plant's own [q; v], meets the target, with the loop in which
        it is held.
        """
        scenario, plant = self.scenario, loop.single
        self._q, self._v = np.split(state, [plant.num_positions()])
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, self._q)
        model = dataclasses.replace(loop.model(context), plant=plant)
        # X_WQ: where the model welds the target's frame P
        self._X_WQ = RigidTransform(payload_body(scenario, model).EvalPoseInWorld(context))
        offset = self._X_WQ.translation() - self._X_WP.translation()
        self._twist_Q = self._twist.copy()
        self._twist_Q[3:] += np.cross(self._twist_Q[:3], offset)
        turn = (self._X_WP.rotation() @ self._X_WQ.rotation().inverse()).ToAngleAxis()
        self._offset = np.concatenate([turn.angle() * turn.axis(), -offset])
        self._mismatch = mismatch_of(scenario, model, self._q, self._v, self._twist_Q)

    def beyond_envelope(self) -> str:
        """The part of the miss beyond ``capture.envelope``; empty where the gripper holds."""
        envelope = (self.scenario.capture or Capture()).envelope
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
        limits = {name: getattr(envelope, name) for name in sizes}
        return ", ".join(
            f"{name} {size:.3g} {unit} (capture.envelope.{name}: {limits[name]:g})"
            for name, (size, unit) in sizes.items()
            if limits[name] is not None and size > limits[name]
        )

    def grasp(self, loop: ClosedLoop) -> np.ndarray:
        """Grasp the target, with the result in ``log``. Return [q; v] of the plant after it."""
        scenario = self.scenario
        model = loop.true_model(scenario)
        lies = self._X_WQ.InvertAndCompose(self._X_WP)
        self.payload = payload = seen_from(scenario.payload.truth, lies)
        set_payload(model.plant, model.context, body=scenario.payload.body, properties=payload)
        contact = contact_at(
            scenario, model, q=self._q, velocity=self._v, target_velocity=self._twist_Q
        )
        self.log = MadeGrasp(
            sample=self.sample,
            contact=contact,
            payload=payload,
            target=self.path,
            offset=self._offset,
            mismatch=self._mismatch,
        )
        return np.concatenate([self._q, contact.grasp.velocity])


def seen_from(properties: MassProperties, X_QP: RigidTransform) -> MassProperties:
    """The mass properties of a body in frame P, in another frame Q of it."""
    R = X_QP.rotation().matrix()
    inertia = R @ inertia_matrix(properties) @ R.T
    return MassProperties(
        mass=properties.mass,
        center_of_mass=(X_QP @ np.array(properties.center_of_mass)).tolist(),
        inertia=inertia[SIX].tolist(),
    )


def grasped_at_start(log: RunLog) -> RunLog:
    """The log of a run with its planned grasp, with which it begins."""
    model = make_flexible_plant(log.scenario)
    contact = planned_contact(log.scenario, model)
    mismatch = mismatch_of(
        log.scenario, model, contact.q, contact.velocity, contact.target_velocity
    )
    grasp = MadeGrasp(
        sample=0,
        contact=contact,
        payload=log.scenario.payload.truth,
        target=np.empty((0, 13)),
        mismatch=mismatch,
        stored=stored_at_start(log),
    )
    return dataclasses.replace(log, grasp=grasp)


def stored_at_start(log: RunLog) -> np.ndarray | None:
    """The momentum (3) that parts store at a log's start; None where none does."""
    stored = log.with_role(STORED_MOMENTUM)
    return None if stored is None else stored[0]


def mismatch_of(
    scenario: Scenario, model: PlantModel, q: np.ndarray, v: np.ndarray, twist: np.ndarray
) -> np.ndarray:
    """[w; v] (6) of the target from the hand, at its origin; ``twist`` is that of the
    payload body's frame.
    """
    model.plant.SetPositionsAndVelocities(model.context, np.concatenate([q, v]))
    hand = hand_frame(model.plant, scenario.model)
    p_WP = payload_body(scenario, model).EvalPoseInWorld(model.context).translation()
    moving = hand.CalcSpatialVelocityInWorld(model.context).get_coeffs()
    there = twist.copy()
    there[3:] += np.cross(twist[:3], hand.CalcPoseInWorld(model.context).translation() - p_WP)
    return there - moving
