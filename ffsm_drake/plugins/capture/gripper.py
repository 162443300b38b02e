"""A gripper that closes over a time (``capture.closing``): its force between servicer and free
target, in the legs of a run before the grasp.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.common.so3 import skew
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.contact_force import Jaws
from ffsm_drake.plugins.capture.free_body import Target
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix
from ffsm_drake.scenario.capture import Compliance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.nominal import make_flexible_plant
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.spacecraft.plant import hand_frame
from ffsm_drake.systems.part import Metric, Part, Signal, View
from ffsm_drake.systems.setup import BlockSetup

STEP = 1e-3  # s; of the contact, at most
_UNIT = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0])  # mass, centre, inertia
AXES = ("rotation_x", "rotation_y", "rotation_z", "position_x", "position_y", "position_z")
# Discrete state of the contact: its groups and their sizes.
_MEMORY = {
    "target": 21,  # ``Target.as_row``
    "slid": 6,  # slip between jaws and target
    "gripper_offset": 6,
    "contact_force": 6,
    "wrench": 6,  # on the target, about its centre of mass, world axes
    "start": 6,  # the offset at the first contact
    "times": 3,  # times, s: first contact; this state; the target's leaving, or infinite
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Met:
    """A free target at an instant, and how it lies in the gripper."""

    X_WP: RigidTransform  # pose of the target's frame
    twist: np.ndarray  # (6) [w_WP; v_WP], world axes
    offset: np.ndarray  # (6) of the target's grasp frame from the gripper, gripper axes
    rate: np.ndarray  # (6) of the offset
    left: float  # s; when it was beyond the envelope, infinite if it is not


class Gripper(Part):
    """The section ``capture.closing``: without effect, or in the leg in which it closes."""

    title = "Gripper"
    about = "Contact of the gripper with the target while it closes; the gripper's axes."

    def __init__(self, closes: Compliance | None = None) -> None:
        """Args: the compliance with which it closes in this leg; None: it does not."""
        self._closes = closes

    @classmethod
    def of(cls, scenario: Scenario) -> "Gripper | None":
        """The gripper of a run with an approach and ``capture.closing``."""
        return None if scenario.closing is None else cls()

    def build(self, setup: BlockSetup) -> LeafSystem:
        """The force."""
        return GripperForce(setup, closes=self._closes)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Where the target lies in the gripper, and the force on it."""
        signal = partial(Signal, components=AXES, dimension="gripper_coordinate")
        return (
            signal(
                name="gripper_offset",
                unit="rad, m",
                meaning="target's grasp frame from the end effector, in contact",
                panels=_by_axis("rad", "m"),
            ),
            signal(
                name="contact_force",
                unit="N m, N",
                meaning="torque and force of the gripper on the target",
                panels=_by_axis("N m", "N"),
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """How often it closed, and the largest contact force and torque."""

        def peak(part: slice) -> Callable[[View], float]:
            return lambda run: float(
                np.linalg.norm(run["contact_force"][:, part], axis=1).max(initial=0.0)
            )

        return (
            Metric(
                key="gripper.closings",
                unit="1",
                label="Closings of the gripper",
                of=_closings,
            ),
            Metric(
                key="gripper.peak_force",
                unit="N",
                label="Largest contact force",
                of=peak(slice(3, 6)),
            ),
            Metric(
                key="gripper.peak_torque",
                unit="N m",
                label="Largest contact torque",
                of=peak(slice(0, 3)),
            ),
        )


def _closings(run: View) -> int:
    """How often the gripper began to close."""
    closes = run["gripper_offset"].any(axis=1).astype(int)
    return int((np.diff(closes, prepend=0) > 0).sum())


def _by_axis(of_rotation: str, of_position: str) -> dict[str, str]:
    return dict.fromkeys(AXES[:3], of_rotation) | dict.fromkeys(AXES[3:], of_position)


class GripperForce(LeafSystem):
    """The force of the gripper on the servicer, and the motion of the target under it.

    Inputs: state, hidden_state. Outputs: generalized_force, hidden_force, and the signals of
    ``Gripper``. The discrete state is updated every STEP in the leg in which the gripper closes;
    the force is held between. Parameter: the target's mass properties (10).
    One that was never begun holds nothing.
    """

    def __init__(self, setup: BlockSetup, *, closes: Compliance | None) -> None:
        super().__init__()
        scenario = self._scenario = setup.scenario
        capture = scenario.capture
        if capture is None or capture.closing is None:
            raise ValueError("capture.closing: there is none")
        self._closing, self._envelope = capture.closing, capture.envelope
        self._compliance = closes
        self._orbit = None if scenario.environment is None else Orbit(scenario.environment)
        self._model = model = make_flexible_plant(scenario)
        self._hand = hand_frame(model.plant, scenario.model)
        self._body = payload_body(scenario, model).body_frame()
        self._X_PE = self._body.CalcPose(model.context, self._hand).inverse()
        split, whole = setup.split, model.plant.num_velocities()
        hidden = len(split.names)
        self._state = self.DeclareVectorInputPort(
            "state", model.plant.num_multibody_states() - 2 * hidden
        )
        self._hidden = self.DeclareVectorInputPort("hidden_state", 2 * hidden) if hidden else None
        first = {name: np.zeros(size) for name, size in _MEMORY.items()}
        first["target"][0] = 1.0  # a unit quaternion
        self._groups = {name: self.DeclareDiscreteState(each) for name, each in first.items()}
        self._acting = self.DeclareDiscreteState(np.zeros(whole))  # on all coordinates
        known = split.known if hidden else np.arange(whole)
        self._joints = known[NUM_BASE_VELOCITIES:]  # in v of the plant
        self._rates = self.DeclareDiscreteState(np.zeros(self._joints.size))  # at the contact
        self._payload = self.DeclareNumericParameter(BasicVector(_UNIT))
        ports = {
            name: (self._groups[name], np.arange(_MEMORY[name]))
            for name in ("gripper_offset", "contact_force")
        }
        ports["generalized_force"] = self._acting, known
        if hidden:
            ports |= dict.fromkeys(
                ("hidden_force", "next_hidden_force"), (self._acting, split.hidden)
            )
        for name, (index, entries) in ports.items():
            self.DeclareVectorOutputPort(
                name,
                len(entries),
                partial(weak_callback(self._calc), index, entries),
                {self.discrete_state_ticket(index)},
            )
        self.motions: list[np.ndarray] = []  # motion of the target at the samples since ``begin``
        self._split = split
        if closes is not None:
            period = scenario.sample_time / math.ceil(scenario.sample_time / STEP - 1e-9)
            self._period = period
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, weak_callback(self._update))

    def begin(
        self,
        context: Context,
        *,
        payload: MassProperties,
        target: np.ndarray,
        state: np.ndarray,
    ) -> None:
        """Begin to close, at the context's time.

        Args:
          context: the system's.
          payload: of the target, in its frame P.
          target: (13) [quaternion, p_WP; w_WP, v_WP].
          state: the plant's own [q; v].
        """
        inertia = inertia_matrix(payload)[np.triu_indices(3)]
        packed = np.concatenate([[payload.mass], payload.center_of_mass, inertia])
        context.get_mutable_numeric_parameter(self._payload).SetFromVector(packed)
        memory = {name: np.zeros(size) for name, size in _MEMORY.items()}
        memory["target"] = Target.from_motion(target, payload).as_row()
        memory["start"] = memory["gripper_offset"] = self._met(context, memory, state).offset
        memory["times"] = np.array([context.get_time(), context.get_time(), math.inf])
        self._keep(context.get_mutable_discrete_state(), memory)
        context.SetDiscreteState(self._acting, np.zeros(self._model.plant.num_velocities()))
        context.SetDiscreteState(self._rates, self._joint_rates(state))
        self.motions = []

    def met(self, context: Context, state: np.ndarray) -> Met:
        """The target in the gripper at the context's time, at the plant's own [q; v]."""
        return self._met(context, self._advanced(context), state)

    def _memory(self, context: Context) -> dict[str, np.ndarray]:
        values = context.get_discrete_state
        return {name: values(index).value().copy() for name, index in self._groups.items()}

    def _keep(self, values: DiscreteValues, memory: dict[str, np.ndarray]) -> None:
        for name, index in self._groups.items():
            values.set_value(index, memory[name])

    def _masses(self, context: Context) -> tuple[float, np.ndarray]:
        """The target's mass, and the inverse of its inertia in its axes."""
        mass, *rest = context.get_numeric_parameter(self._payload).value()
        xx, xy, xz, yy, yz, zz = rest[3:]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return float(mass), np.linalg.inv(inertia)

    def _advanced(self, context: Context) -> dict[str, np.ndarray]:
        """The memory at the context's time: the target moves on under the held force."""
        memory, now = self._memory(context), context.get_time()
        _, before, _ = memory["times"]
        if now > before:
            mass, inverse = self._masses(context)
            pushed = memory["wrench"] / np.repeat([3.0 / np.trace(inverse), mass], 3)
            target = Target.from_row(memory["target"])
            memory["target"] = target.after(now - before, before, self._orbit, pushed).as_row()
            memory["times"][1] = now
        return memory

    def _met(self, context: Context, memory: dict[str, np.ndarray], state: np.ndarray) -> Met:
        """``met`` of a memory. Leaves the model in the state."""
        model, world = self._model, self._model.plant.world_frame()
        model.plant.SetPositionsAndVelocities(model.context, state)
        motion = Target.from_row(memory["target"]).motion
        R_WP = RotationMatrix(Quaternion(motion[:4]))
        X_WP, (w, v) = RigidTransform(R_WP, motion[4:7]), np.split(motion[7:], 2)
        X_WE = self._hand.CalcPose(model.context, world)
        X_EG = X_WE.inverse() @ X_WP @ self._X_PE
        turn = X_EG.rotation().ToAngleAxis()
        offset = np.concatenate([turn.angle() * turn.axis(), X_EG.translation()])
        moving = self._hand.CalcSpatialVelocityInWorld(model.context)
        p_G = X_WE.rotation() @ X_EG.translation()  # from E, world axes
        v_E = moving.translational() + np.cross(moving.rotational(), p_G)
        v_G = v + np.cross(w, X_WE.translation() + p_G - X_WP.translation())
        R_EW = X_WE.rotation().inverse().matrix()
        rate = np.concatenate([R_EW @ (w - moving.rotational()), R_EW @ (v_G - v_E)])
        return Met(
            X_WP=X_WP,
            twist=motion[7:],
            offset=offset,
            rate=rate,
            left=float(memory["times"][2]),
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        memory = self._advanced(context)
        hidden = None if self._hidden is None else self._hidden.Eval(context)
        state = self._split.whole(self._state.Eval(context), hidden)
        met = self._met(context, memory, state)
        sample = context.get_time() / self._scenario.sample_time
        if abs(sample - round(sample)) < 0.1 * self._period:
            self.motions.append(Target.from_row(memory["target"]).motion)
        first, now, left = memory["times"]
        if left == math.inf and self._is_beyond(met.offset):
            memory["times"][2] = left = now
        memory["gripper_offset"] = met.offset
        acting = np.zeros(self._model.plant.num_velocities())
        memory["contact_force"], memory["wrench"] = np.zeros(6), np.zeros(6)
        if left == math.inf:
            acting = self._act(context, memory, met, now - first)
        if self._closing.joints == "limp":
            rates = self._joint_rates(state) - context.get_discrete_state(self._rates).value()
            acting[self._joints] -= self._damping(rates)
        self._keep(values, memory)
        values.set_value(self._acting, acting)

    def _damping(self, rates: np.ndarray) -> np.ndarray:
        """The torque or force that damps limp joints, by the rates that it leaves after a step: by
        those before it, a light wrist would be thrown about.
        """
        if self._closing.joint_damping == 0.0:
            return np.zeros_like(rates)
        mass = self._model.plant.CalcMassMatrix(self._model.context)
        mobility = np.linalg.inv(mass)[np.ix_(self._joints, self._joints)]
        yielding = np.eye(rates.size) / self._closing.joint_damping + self._period * mobility
        damping: np.ndarray = np.linalg.solve(yielding, rates)
        return damping

    def _joint_rates(self, state: np.ndarray) -> np.ndarray:
        rates: np.ndarray = state[self._model.plant.num_positions() :][self._joints]
        return rates

    def _is_beyond(self, offset: np.ndarray) -> bool:
        """Whether the target is out of the gripper's reach."""
        sizes = np.linalg.norm(offset.reshape(2, 3), axis=1)
        limits = self._envelope.angle, self._envelope.position
        return any(
            limit is not None and size > limit for size, limit in zip(sizes, limits, strict=True)
        )

    def _act(
        self, context: Context, memory: dict[str, np.ndarray], met: Met, time: float
    ) -> np.ndarray:
        """The generalized force on the plant (nv), with the contact's in the memory."""
        model, plant = self._model, self._model.plant
        world = plant.world_frame()
        X_WE = self._hand.CalcPose(model.context, world)
        R = X_WE.rotation().matrix()
        # J of the point of the hand where the target's grasp frame is: action is reaction there
        jacobian = plant.CalcJacobianSpatialVelocity(
            model.context, JacobianWrtVariable.kV, self._hand, met.offset[3:], world,
            self._hand,
        )  # fmt: skip
        mass, inverse = self._masses(context)
        R_WP = met.X_WP.rotation().matrix()
        p_CG = X_WE.translation() + R @ met.offset[3:] - Target.from_row(memory["target"]).center
        lever = np.block([[R, skew(p_CG) @ R], [np.zeros((3, 3)), R]])  # wrench about C, world axes
        of_target = np.zeros((6, 6))
        of_target[:3, :3], of_target[3:, 3:] = R_WP @ inverse @ R_WP.T, np.eye(3) / mass
        of_arm = jacobian @ np.linalg.solve(plant.CalcMassMatrix(model.context), jacobian.T)
        jaws = Jaws(
            closing=self._closing,
            compliance=self._compliance or Compliance(),
            start=memory["start"],
        )
        force, memory["slid"] = jaws.act(
            time + self._period,
            self._period,
            offset=met.offset,
            rate=met.rate,
            slid=memory["slid"],
            mobility=lever.T @ of_target @ lever + of_arm,
        )
        memory["contact_force"], memory["wrench"] = force, lever @ force
        return -jacobian.T @ force

    def _calc(self, index: int, entries: np.ndarray, context: Context, output: BasicVector) -> None:
        value = context.get_discrete_state(index).value()[entries]
        output.SetFromVector(value if self._compliance is not None else 0.0 * value)
