"""A scenario's capture: motion of target and servicer before the grasp, and velocities after it."""

from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import Frame, RigidBody

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.so3 import quaternion_of, skew
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.compliant import compliant_grasp
from ffsm_drake.plugins.capture.free_body import FINE_TURN, Target, path_of
from ffsm_drake.plugins.capture.plastic import plastic_grasp
from ffsm_drake.scenario import Capture, Scenario
from ffsm_drake.scenario.capture import Compliance
from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
from ffsm_drake.spacecraft.grasp import CompliantGrasp, Contact, shift_moment
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.spacecraft.plant import configuration, find_body, find_frame, hand_frame
from ffsm_drake.systems.closed_chains import CLOSED_CHAINS


def payload_body(scenario: Scenario, model: PlantModel) -> RigidBody:
    """The payload body. Raises ModelError unless the target consists of this body alone, and of
    links without mass that are fixed to it.
    """
    key = "payload.body"
    body = find_body(model.plant, scenario.payload.body, key=key)
    hand = hand_frame(model.plant, scenario.model).body()
    fixed = {each.index() for each in model.plant.GetBodiesWeldedTo(body)}
    others = [
        other.scoped_name()
        for other in map(model.plant.get_body, model.plant.GetBodyIndices(body.model_instance()))
        if other.index() != body.index()
        and (other.index() not in fixed or other.default_mass() > 0.0)
    ]
    fault = f"shares its model with {', '.join(map(str, others))}" if others else ""
    if body.model_instance() == hand.model_instance():
        fault = "is a body of the servicer"
    if fault:
        raise ModelError(
            f"{key}: '{scenario.payload.body}' {fault}; a capture needs a target of one body, "
            "in its own model"
        )
    return body


def target_twist(
    scenario: Scenario, capture: Capture, model: PlantModel, q: np.ndarray
) -> np.ndarray:
    """[w_WP; v_WP] (6) of the target's frame P just before the grasp in a known configuration q,
    world axes.
    """
    model.plant.SetPositions(model.context, model.split.whole_positions(q))
    body = payload_body(scenario, model)
    R_WP = body.EvalPoseInWorld(model.context).rotation().matrix()
    turn = R_WP if capture.axes == "target" else np.eye(3)
    w = turn @ capture.rate
    return np.concatenate(
        [w, turn @ capture.velocity - np.cross(w, R_WP @ scenario.payload.truth.center_of_mass)]
    )


def servicer_velocity(
    scenario: Scenario, capture: Capture, model: PlantModel, q: np.ndarray
) -> np.ndarray:
    """v (nv) of the servicer at the grasp in a known configuration q.

    To follow the grasp frame, it minimises the mismatch between hand and target. Among equal
    minima, it chooses the smallest rates. To detumble, mismatch and angular momentum of the stack
    about its centre of mass are zero if the coordinates allow it, and the linear momentum is the
    smallest.

    Raises:
      ScenarioError: a value is given for an unknown coordinate.
    """
    coordinates, context = model.coordinates, model.context
    v = coordinates.vector(capture.servicer_velocity, key="capture.servicer_velocity", default=0.0)
    cost = coordinates.vector(capture.tracking_cost, key="capture.tracking_cost", default=1.0)
    if capture.servicer in ("rest", "given"):
        return v
    at_target = target_twist(scenario, capture, model, q)
    p_WP = payload_body(scenario, model).EvalPoseInWorld(context).translation()
    twists, jacobians = list[np.ndarray](), list[np.ndarray]()
    for hand in grasping_hands(scenario, model):
        twists.append(at_target.copy())
        arm = hand.CalcPoseInWorld(context).translation() - p_WP
        twists[-1][3:] += np.cross(at_target[:3], arm)
        jacobian = model.calc_jacobian(model.split.whole_positions(q), hand)
        jacobians.append(model.split.known_velocities(jacobian))
    twist, jacobian = np.concatenate(twists), np.concatenate(jacobians)
    moving = slice(NUM_BASE_VELOCITIES if capture.servicer == "track_joints" else 0, None)
    weight = np.tile([capture.tracking_length] * 3 + [1.0] * 3, len(twists))
    if capture.servicer == "detumble":
        return _without_spin(
            free_floating(model, q), weight[:, None] * jacobian, weight * twist, cost
        )
    scaled = weight[:, None] * jacobian[:, moving] / cost[moving]
    v[moving] = np.linalg.lstsq(scaled, weight * twist, rcond=None)[0] / cost[moving]
    return v


def grasping_hands(scenario: Scenario, model: PlantModel) -> list[Frame]:
    """The frames of the hands that grasp at once."""
    others = closing_contacts(scenario).values()
    frames = [find_frame(model.plant, each.effector, key="contacts") for each in others]
    return [hand_frame(model.plant, scenario.model), *frames]


def _without_spin(
    stack: FreeFloating, jacobian: np.ndarray, twist: np.ndarray, cost: np.ndarray
) -> np.ndarray:
    """v (nv) with J v = twist (6) and no angular momentum about the centre of mass, of the least
    linear momentum, then of the least rates; arguments and cost (nv) weighted as
    ``servicer_velocity`` says.
    """
    spin = stack.spin_map / np.linalg.norm(stack.spin_map)
    rows = np.vstack([jacobian, spin]) / cost
    v, _, rank, _ = np.linalg.lstsq(rows, np.concatenate([twist, np.zeros(3)]), rcond=None)
    free = np.linalg.svd(rows)[2][rank:].T
    momentum = stack.mass_matrix[3:NUM_BASE_VELOCITIES] / cost
    v -= free @ np.linalg.lstsq(momentum @ free, momentum @ v, rcond=None)[0]
    found: np.ndarray = v / cost
    return found


def contact_at(
    scenario: Scenario,
    model: PlantModel,
    *,
    q: np.ndarray,
    velocity: np.ndarray,
    target_velocity: np.ndarray,
) -> Contact:
    """The grasp of the target by a servicer in configuration q (nq) with velocity v (nv), the
    joints free or braked.

    q and v are the plant's own; its flexible parts are free.

    Args:
      scenario: one with a capture.
      model: the plant that holds the target, with the payload at the grasp.
      target_velocity: [w_WP; v_WP] (6) of the target's frame P before, world axes.
    """
    capture = scenario.capture or Capture()
    plant, context = model.plant, model.context
    mass_matrix = model.calc_mass_matrix(q)  # sets q
    body = payload_body(scenario, model)
    X_WP = body.EvalPoseInWorld(context)
    inertia = body.CalcSpatialInertiaInBodyFrame(context).ReExpress(X_WP.rotation())
    known = model.split.known_velocities(np.arange(velocity.size))
    situation = {
        "mass_matrix": mass_matrix,
        "jacobian": model.calc_jacobian(q, body.body_frame()),
        "target_inertia": inertia.CopyToFullMatrix6(),
        "velocity": velocity,
        "target_velocity": target_velocity,
        "braked": known[NUM_BASE_VELOCITIES:].tolist() if capture.joints == "braked" else (),
    }
    loops = None
    if len(scenario.contacts) > 1:
        _, loops = CLOSED_CHAINS.only("contacts").solve(scenario, model, q, stays=True)
    grasp = plastic_grasp(**situation, constraints=loops)
    hand = hand_frame(plant, scenario.model)
    p_PE_W = hand.CalcPoseInWorld(context).translation() - X_WP.translation()
    p_WB = q[4:7]
    p_BC_W = plant.CalcCenterOfMassPositionInWorld(context) - p_WB
    return Contact(
        q=q,
        velocity=velocity,
        target_velocity=target_velocity,
        grasp=grasp,
        impulse=shift_moment(grasp.impulse, p_PE_W),
        momentum_before=shift_moment(grasp.momentum_before, -p_WB),
        momentum_after=shift_moment(grasp.momentum_after, -p_WB),
        spin_before=shift_moment(grasp.momentum_before, p_BC_W)[:3],
        spin_after=shift_moment(grasp.momentum_after, p_BC_W)[:3],
        compliant=None
        if capture.compliance is None
        else _compliant(situation, capture.compliance, p_PE_W),
        split=model.split,
    )


def _compliant(situation: dict[str, Any], gripper: Compliance, p_PE: np.ndarray) -> CompliantGrasp:
    """The grasp by a compliant gripper at E, ``p_PE`` (3; m, world axes) from the target's P."""
    moved = np.eye(6)  # [w; v_E] = moved [w; v_P]
    moved[3:, :3] = -skew(p_PE)
    back = 2.0 * np.eye(6) - moved
    at_gripper = {
        "jacobian": moved @ situation["jacobian"],
        "target_inertia": back.T @ situation["target_inertia"] @ back,
        "target_velocity": moved @ situation["target_velocity"],
    }
    return compliant_grasp(
        **{**situation, **at_gripper},
        stiffness=np.repeat([gripper.rotational_stiffness, gripper.stiffness], 3),
        damping=np.repeat([gripper.rotational_damping, gripper.damping], 3),
    )


def planned_contact(mission: Mission, model: PlantModel) -> Contact:
    """The grasp of a mission in ``initial_posture``, at the chosen rates, with ``model``'s payload.

    Raises:
      ModelError: the target is not a body of its own.
      ScenarioError: a value is given for an unknown coordinate.
    """
    scenario, capture = mission.scenario, mission.scenario.capture or Capture()
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    whole = model.split.whole_positions(q)
    if len(scenario.contacts) > 1:
        whole, _ = CLOSED_CHAINS.only("contacts").solve(scenario, model, whole)
        q = model.split.known_part(np.concatenate([whole, np.zeros(whole.size - 1)]))[: q.size]
    return contact_at(
        scenario,
        model,
        q=whole,
        velocity=model.split.whole_velocities(servicer_velocity(scenario, capture, model, q)),
        target_velocity=target_twist(scenario, capture, model, q),
    )


def target_path(
    scenario: Scenario, model: PlantModel, planned: Contact
) -> tuple[RigidTransform, np.ndarray]:
    """X_WP of the target at the planned grasp, and its motion before, as ``coast`` returns it.

    What the arm cannot follow turns and moves the target in the gripper while that closes: the
    target is where the arm meets it half way through.
    """
    model.plant.SetPositions(model.context, planned.q)
    body = payload_body(scenario, model)
    X_WP = RigidTransform(body.EvalPoseInWorld(model.context))
    if (closing := scenario.closing) is not None:
        arm = model.calc_jacobian(planned.q, body.body_frame()) @ planned.velocity
        turn, way = np.split(0.5 * closing.duration * (planned.target_velocity - arm), 2)
        rotation = RotationMatrix(Quaternion(quaternion_of(turn))) @ X_WP.rotation()
        X_WP = RigidTransform(rotation, X_WP.translation() + way)
    pose = np.concatenate([X_WP.rotation().ToQuaternion().wxyz(), X_WP.translation()])
    motion = np.concatenate([pose, planned.target_velocity])
    samples = round(scenario.grasp_time / scenario.sample_time)
    return X_WP, coast(scenario, motion, time=scenario.grasp_time, samples=samples)


def coast(
    scenario: Scenario, motion: np.ndarray, *, time: float, samples: int, onward: bool = False
) -> np.ndarray:
    """The motion (samples, 13; quaternion, p_WP, w_WP, v_WP) of a free target before a given one
    (13), or ``onward`` from there; in the orbit of ``environment``, if there is one.

    Args:
      scenario: with the target's true mass properties and the sample time.
      motion: one sample after the last; onward, at the first.
      time: of that, s.
      samples: how many.
    """
    found = path_of(
        Target.from_motion(motion, scenario.payload.truth),
        time,
        period=scenario.sample_time if onward else -scenario.sample_time,
        samples=samples if onward else samples + 1,
        orbit=None if scenario.environment is None else Orbit.of(scenario.environment),
        turn=FINE_TURN,
    )
    return found if onward else found[:0:-1]
