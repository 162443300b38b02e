"""A gripper that closes over a time (``capture.closing``): its force between servicer and free
target, in the legs of a run before the grasp.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.common.products import times
from ffsm_drake.common.so3 import composed, cross_of, matrix_of, skew, turn_between
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
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # entries of an upper triangle
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

    motion: np.ndarray  # (13) [quaternion, p_WP; w_WP, v_WP] of the target's frame, world axes
    offset: np.ndarray  # (6) of the target's grasp frame from the gripper, gripper axes
    rate: np.ndarray  # (6) of the offset
    p_WE: np.ndarray  # (3) place of the gripper, m
    R_WE: np.ndarray  # (3, 3) its attitude
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
        """Pose of the target in the gripper, and the force on it."""
        signal = functools.partial(Signal, components=AXES, dimension="gripper_coordinate")
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
        scenario, capture = setup.scenario, setup.scenario.capture
        if capture is None or capture.closing is None:
            raise ValueError("capture.closing: there is none")
        self._closing, envelope = capture.closing, capture.envelope
        self._envelope = np.array(
            [np.inf if limit is None else limit for limit in (envelope.angle, envelope.position)]
        )
        self._compliance, self._sample_time = closes, scenario.sample_time
        self._orbit = None if scenario.environment is None else Orbit(scenario.environment)
        self._model = model = make_flexible_plant(scenario)
        self._hand = hand_frame(model.plant, scenario.model)
        body = payload_body(scenario, model).body_frame()
        pose = body.CalcPose(model.context, self._hand).inverse()
        self._q_PE = np.array(pose.rotation().ToQuaternion().wxyz())
        self._p_PE = pose.translation()
        split, whole = setup.split, model.plant.num_velocities()
        hidden = len(split.names)
        self._state = self.DeclareVectorInputPort(
            "state", model.plant.num_multibody_states() - 2 * hidden
        )
        self._hidden = self.DeclareVectorInputPort("hidden_state", 2 * hidden) if hidden else None
        self._groups = {name: self.DeclareDiscreteState(row) for name, row in _first().items()}
        self._acting = self.DeclareDiscreteState(whole)  # on all coordinates
        known = split.known if hidden else np.arange(whole)
        self._joints = known[NUM_BASE_VELOCITIES:]  # in v of the plant
        self._rates = self.DeclareDiscreteState(self._joints.size)  # at the contact
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
                functools.partial(weak_callback(self._calc), index, entries),
                {self.discrete_state_ticket(index)},
            )
        self.motions: list[np.ndarray] = []  # of the target (13) at the samples since ``begin``
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
        memory, time = _first(), context.get_time()
        memory["target"] = Target.from_motion(target, payload).as_row()
        memory["start"] = memory["gripper_offset"] = self._met(memory, state).offset
        memory["times"] = np.array([time, time, math.inf])
        for name, index in self._groups.items():
            context.SetDiscreteState(index, memory[name])
        context.SetDiscreteState(self._acting, np.zeros(self._model.plant.num_velocities()))
        context.SetDiscreteState(self._rates, self._joint_rates(state))
        self.motions = []

    def met(self, context: Context, state: np.ndarray) -> Met:
        """The target in the gripper at the context's time, at the plant's own [q; v]."""
        return self._met(self._advanced(context), state)

    def _masses(self, context: Context) -> tuple[float, np.ndarray]:
        """The target's mass, and the inverse of its inertia in its axes."""
        values = context.get_numeric_parameter(self._payload).value()
        return values[0], np.linalg.inv(values[4 + _SYMMETRIC])

    def _advanced(self, context: Context) -> dict[str, np.ndarray]:
        """The memory at the context's time: the target moves on under the held force."""
        now, memory = context.get_time(), dict[str, np.ndarray]()
        for name, index in self._groups.items():
            memory[name] = context.get_discrete_state(index).value().copy()
        before = float(memory["times"][1])  # 0 unless it was begun
        if now > before:
            mass, inverse = self._masses(context)
            pushed = memory["wrench"] / np.repeat([3.0 / np.trace(inverse), mass], 3)
            target = Target.from_row(memory["target"])
            memory["target"] = target.after(now - before, before, self._orbit, pushed).as_row()
            memory["times"][1] = now
        return memory

    def _met(self, memory: dict[str, np.ndarray], state: np.ndarray) -> Met:
        """``met``. Leaves the model in this state."""
        model, hand = self._model, self._hand
        model.plant.SetPositionsAndVelocities(model.context, state)
        pose = hand.CalcPose(model.context, model.plant.world_frame())
        moving = hand.CalcSpatialVelocityInWorld(model.context)
        w_E, v_E = moving.rotational(), moving.translational()
        motion = Target.from_row(memory["target"]).motion
        q_WP, p_WP, w, v = np.split(motion, [4, 7, 10])
        p_WE, R_WE = pose.translation(), np.ascontiguousarray(pose.rotation().matrix())
        turn = turn_between(pose.rotation().ToQuaternion().wxyz(), composed(q_WP, self._q_PE))
        from_P = times(matrix_of(q_WP), self._p_PE)
        from_E = p_WP + from_P - p_WE  # place of the grasp frame, world axes
        moves = v + cross_of(w, from_P) - v_E - cross_of(w_E, from_E)
        return Met(
            motion=motion,
            offset=np.concatenate([turn, times(R_WE.T, from_E)]),
            rate=np.concatenate([times(R_WE.T, w - w_E), times(R_WE.T, moves)]),
            p_WE=p_WE,
            R_WE=R_WE,
            left=memory["times"][2].item(),
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        memory = self._advanced(context)
        hidden = None if self._hidden is None else self._hidden.Eval(context)
        state = self._split.whole(self._state.Eval(context), hidden)
        met = self._met(memory, state)
        sample = context.get_time() / self._sample_time
        if abs(sample - round(sample)) < 0.1 * self._period:
            self.motions.append(met.motion)
        sizes = np.linalg.norm(met.offset.reshape(2, 3), axis=1)
        if met.left == math.inf and (sizes > self._envelope).any():
            memory["times"][2] = memory["times"][1]
        memory["gripper_offset"] = met.offset
        mass_matrix = self._model.plant.CalcMassMatrix(self._model.context)
        mobility = np.linalg.inv(np.ascontiguousarray(mass_matrix))
        if memory["times"][2] == math.inf:
            acting = self._act(context, memory, met, mobility)
        else:
            acting = np.zeros(len(mobility))
            memory["contact_force"], memory["wrench"] = np.zeros(6), np.zeros(6)
        if self._closing.joints == "limp":
            rates = self._joint_rates(state) - context.get_discrete_state(self._rates).value()
            acting[self._joints] -= self._damping(rates, mobility)
        for name, index in self._groups.items():
            values.set_value(index, memory[name])
        values.set_value(self._acting, acting)

    def _damping(self, rates: np.ndarray, mobility: np.ndarray) -> np.ndarray:
        """The torques or forces that damp limp joints, by the rates that they leave after a step:
        by those before it, a light wrist would be thrown about.
        """
        if self._closing.joint_damping == 0.0:
            return np.zeros_like(rates)
        of_joints = mobility[self._joints[:, None], self._joints]
        resists = np.eye(rates.size) / self._closing.joint_damping
        damping: np.ndarray = np.linalg.solve(resists + self._period * of_joints, rates)
        return damping

    def _joint_rates(self, state: np.ndarray) -> np.ndarray:
        rates: np.ndarray = state[self._model.plant.num_positions() :][self._joints]
        return rates

    def _act(
        self, context: Context, memory: dict[str, np.ndarray], met: Met, mobility: np.ndarray
    ) -> np.ndarray:
        """The generalized force (nv) on the plant, with that of the contact in the memory;
        ``mobility``: inverse mass matrix.
        """
        model, hand = self._model, self._hand
        # J of the point of the hand where the target's grasp frame is: action is reaction there
        jacobian = model.plant.CalcJacobianSpatialVelocity(
            model.context, JacobianWrtVariable.kV, hand, met.offset[3:],
            model.plant.world_frame(), hand,
        )  # fmt: skip
        mass, inverse = self._masses(context)
        R, R_WP = met.R_WE, matrix_of(met.motion[:4])
        center = Target.from_row(memory["target"]).center
        p_CG = met.p_WE + times(R, met.offset[3:]) - center
        lever = np.zeros((6, 6))  # wrench about C, world axes
        lever[:3, :3] = lever[3:, 3:] = R
        lever[:3, 3:] = skew(p_CG) @ R
        of_target = np.zeros((6, 6))
        of_target[:3, :3] = R_WP @ inverse @ R_WP.T
        of_target[3:, 3:] = np.eye(3) / mass
        first, now, _ = memory["times"]
        jaws = Jaws(
            closing=self._closing,
            compliance=self._compliance or Compliance(),
            start=memory["start"],
        )
        memory["contact_force"], memory["slid"] = force, _ = jaws.act(
            now - first + self._period,
            self._period,
            offset=met.offset,
            rate=met.rate,
            slid=memory["slid"],
            mobility=lever.T @ of_target @ lever + jacobian @ mobility @ jacobian.T,
        )
        memory["wrench"] = times(lever, force)
        return -times(jacobian.T, force)

    def _calc(self, index: int, entries: np.ndarray, context: Context, output: BasicVector) -> None:
        value = context.get_discrete_state(index).value()[entries]
        output.SetFromVector(value if self._compliance is not None else 0.0 * value)


def _first() -> dict[str, np.ndarray]:
    """The memory before a contact."""
    first = {name: np.zeros(size) for name, size in _MEMORY.items()}
    first["target"][0] = 1.0  # a unit quaternion
    return first
