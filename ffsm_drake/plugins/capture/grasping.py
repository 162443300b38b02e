"""The grasp of a target: the plan, how the gripper meets the target, and the grasp itself."""

import dataclasses
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.approach import approach_posture, planned_approach
from ffsm_drake.plugins.capture.contact import (
    contact_at,
    payload_body,
    planned_contact,
    target_path,
)
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.spacecraft.coordinates import Coordinates, halves
from ffsm_drake.spacecraft.inertia import SIX
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration, hand_frame
from ffsm_drake.systems.parts.signals import STORED_MOMENTUM

Target = tuple[RigidTransform, np.ndarray]  # X_WP and [w_WP; v_WP] (6) of a target


class Aim:
    """The planned grasp of a mission."""

    def __init__(self, mission: Mission, sample: int | None = None) -> None:
        """Args: sample of the grasp; default: that of the scenario."""
        self.mission, scenario = mission, mission.scenario
        first = round(scenario.grasp_time / scenario.sample_time)
        self.sample = first if sample is None else sample
        model = mission.craft.nominal()
        planned = planned_contact(mission, model)
        # [q; v] of the servicer after it
        self.reference = np.concatenate([planned.q, planned.grasp.velocity])
        # the target where it is to be met, and its own motion (n, 13) at the samples before
        X_WP, self.path = target_path(scenario, model, planned)
        self.target: Target = X_WP, planned.target_velocity
        # motion (13) of the target where the arm is planned to meet it
        pose = [*X_WP.rotation().ToQuaternion().wxyz(), *X_WP.translation()]
        self.expected = np.concatenate([pose, planned.target_velocity])

    def start(self, model: PlantModel) -> np.ndarray:
        """The plant's own [q; v] of the servicer where the run starts."""
        scenario = self.mission.scenario
        velocity = model.coordinates.vector(
            scenario.initial_velocity, key="initial_velocity", default=0.0
        )
        if scenario.blocks.phases or scenario.undriven:
            position, planned, _ = planned_approach(self.mission).evaluate(0.0)
            velocity += planned
        else:
            posture = approach_posture(self.mission)
            position = configuration(model.coordinates, posture, key="capture.approach.posture")
        return model.split.whole(np.concatenate([position, velocity]))


def target_at(motion: np.ndarray) -> Target:
    """The target in a motion (13) [quaternion, p_WP; w_WP, v_WP]."""
    quaternion = Quaternion(motion[:4] / np.linalg.norm(motion[:4]))
    return RigidTransform(quaternion, motion[4:7]), motion[7:]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MadeGrasp(GraspLog):
    """A grasp in numbers, with its ``contact``, and the target before it."""

    # (6) the target's pose error from P at the grasp: rotation vector, position
    offset: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))
    # (6) of the target from the hand, at its origin: angular velocity, velocity
    mismatch: np.ndarray
    # X_QP of the target from where the model welds it; None: it is there
    lies: RigidTransform | None = None
    # (3) momentum stored in the actuators, N m s; the grasp does not change it
    stored: np.ndarray | None = None

    def ledger(self, time: np.ndarray, coordinates: Coordinates) -> dict[str, Any] | None:
        """The grasp in plain numbers; ``time`` (n; s) are the samples."""
        assert self.contact is not None
        contact, grasp, compliant = self.contact, self.contact.grasp, self.contact.compliant
        known = contact.split.known_velocities
        named = zip(coordinates.names, known(grasp.brake_impulse).tolist(), strict=True)
        return {
            "time": float(time[self.sample]),
            "impulse": contact.impulse[3:].tolist(),  # on the target, N s
            "angular_impulse": contact.impulse[:3].tolist(),  # about the hand, N m s
            # by joint, N m s or N s
            "brake_impulse": {name: impulse for name, impulse in named if impulse != 0.0},
            "before": self._side(
                coordinates,
                momentum=contact.momentum_before,
                spin=contact.spin_before,
                energy=grasp.energy_before,
                velocity=known(contact.velocity),
            ),
            "after": self._side(
                coordinates,
                momentum=contact.momentum_after,
                spin=contact.spin_after,
                energy=grasp.energy_after,
                velocity=known(grasp.velocity),
            ),
            # angular momentum stored by actuators in the base, N m s
            **({} if self.stored is None else {"stored_momentum": self.stored.tolist()}),
            "compliant": {} if compliant is None else {
                "peak_force": compliant.peak_force,  # N
                "peak_torque": compliant.peak_torque,  # N m
                "peak_stretch": compliant.peak_stretch,  # m
                "time": compliant.time,  # s
            },
            "miss": {
                "position": float(np.linalg.norm(self.offset[3:])),  # m
                "angle": float(np.linalg.norm(self.offset[:3])),  # rad
                "velocity": float(np.linalg.norm(self.mismatch[3:])),  # m/s
                "angular_velocity": float(np.linalg.norm(self.mismatch[:3])),  # rad/s
            },
        }  # fmt: skip

    def _side(
        self,
        coordinates: Coordinates,
        *,
        momentum: np.ndarray,
        spin: np.ndarray,
        energy: float,
        velocity: np.ndarray,
    ) -> dict[str, Any]:
        """Servicer and target together, and the servicer's velocity, on one side of the grasp."""
        return {
            "linear_momentum": momentum[3:].tolist(),  # N s
            # momentum of the bodies, without that stored in actuators, N m s
            "angular_momentum": momentum[:3].tolist(),  # about the origin
            "spin": spin.tolist(),  # about the centre of mass
            "kinetic_energy": energy,  # J
            "velocity": coordinates.by_name(velocity),
        }


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Meeting:
    """How a gripper meets a target."""

    q: np.ndarray  # the plant's own
    v: np.ndarray
    lies: RigidTransform  # X_QP of the target's frame from where the model welds it
    twist: np.ndarray  # (6) of the target, at Q
    offset: np.ndarray  # (6) of the target from Q: rotation vector, position; world axes
    mismatch: np.ndarray  # (6) of the target from the hand: angular velocity, velocity

    @classmethod
    def of(cls, scenario: Scenario, target: Target, stage: Stage) -> "Meeting":
        """The meeting of a target and the gripper of a stage."""
        (X_WP, twist), model = target, stage.model()
        q, v = halves(stage.state)
        model.plant.SetPositions(model.context, q)
        X_WQ = RigidTransform(payload_body(scenario, model).EvalPoseInWorld(model.context))
        offset = X_WQ.translation() - X_WP.translation()
        twist = twist.copy()
        twist[3:] += np.cross(twist[:3], offset)
        turn = (X_WP.rotation() @ X_WQ.rotation().inverse()).ToAngleAxis()
        return cls(
            q=q,
            v=v,
            lies=X_WQ.InvertAndCompose(X_WP),
            twist=twist,
            offset=np.concatenate([turn.angle() * turn.axis(), -offset]),
            mismatch=mismatch_of(scenario, model, q, v, twist),
        )

    def beyond(self, envelope: Envelope) -> str:
        """The part of the miss beyond an envelope; empty where the gripper holds."""
        (angle, distance), (rate, speed) = (
            np.linalg.norm(part.reshape(2, 3), axis=1).tolist()
            for part in (self.offset, self.mismatch)
        )
        return envelope.beyond(
            position=distance, angle=angle, velocity=speed, angular_velocity=rate
        )

    def grasp(self, scenario: Scenario, model: PlantModel, path: np.ndarray) -> MadeGrasp:
        """Grasp the target after its path (n, 13) at the samples before; ``model``: true."""
        payload = seen_from(scenario.payload.truth, self.lies)
        set_payload(model.plant, model.context, body=scenario.payload.body, properties=payload)
        contact = contact_at(scenario, model, q=self.q, velocity=self.v, target_velocity=self.twist)
        return MadeGrasp(
            sample=len(path),
            contact=contact,
            payload=payload,
            target=path,
            offset=self.offset,
            mismatch=self.mismatch,
            lies=self.lies,
        )


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
    model = log.mission.craft.flexible()
    contact = planned_contact(log.mission, model)
    mismatch = mismatch_of(
        log.scenario, model, contact.q, contact.velocity, contact.target_velocity
    )
    grasp = MadeGrasp(
        sample=0,
        contact=contact,
        payload=log.scenario.payload.truth,
        target=np.empty((0, 13)),
        mismatch=mismatch,
    )
    return with_grasp(log, grasp)


def with_grasp(log: RunLog, grasp: MadeGrasp) -> RunLog:
    """The log of a run with its grasp, and the momentum (3) that parts store then."""
    stored = log.with_role(STORED_MOMENTUM)
    stored = None if stored is None else stored[grasp.sample]
    return dataclasses.replace(log, grasp=dataclasses.replace(grasp, stored=stored))


def mismatch_of(
    scenario: Scenario, model: PlantModel, q: np.ndarray, v: np.ndarray, twist: np.ndarray
) -> np.ndarray:
    """[w; v] (6) of the target from the hand, at its origin; ``twist`` is that of the
    payload body's frame.
    """
    model.plant.SetPositionsAndVelocities(model.context, np.concatenate([q, v]))
    hand = hand_frame(model.plant, scenario.model)
    p_WP = payload_body(scenario, model).EvalPoseInWorld(model.context).translation()
    moving = model.calc_frame_twist(q, v, hand)
    there = twist.copy()
    there[3:] += np.cross(twist[:3], hand.CalcPoseInWorld(model.context).translation() - p_WP)
    return there - moving
