"""A gripper that closes over a time (``capture.closing``): its force between servicer and free
target, in the legs of a run before the grasp.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.common.products import times
from ffsm_drake.common.so3 import composed, cross_of, matrix_of, skew, turn_between
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.contact_force import Jaws
from ffsm_drake.plugins.capture.free_body import Target, inverse_inertia
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
    """A free target at an instant, and how it lies in the gripper; or several in rows."""

    motion: np.ndarray  # (13) [quaternion, p_WP; w_WP, v_WP] of the target's frame, world axes
    offset: np.ndarray  # (6) of the target's grasp frame from the gripper, gripper axes
    rate: np.ndarray  # (6) of the offset
    p_WE: np.ndarray  # (3) place of the gripper, m
    R_WE: np.ndarray  # (3, 3) its attitude
    left: float | np.ndarray  # s; when it was beyond the envelope, infinite if it is not


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
        return GripperForce([setup], closes=self._closes)

    def build_wide(self, setups: Sequence[BlockSetup]) -> LeafSystem | None:
        """The force on several copies, see ``systems.side_by_side``; None if they differ in more
        than the friction.
        """
        alike = [
            dataclasses.replace(closing, friction=1.0)
            for setup in setups
            if (closing := setup.scenario.closing) is not None
        ]
        orbits = [setup.scenario.environment for setup in setups]
        if any(each != alike[0] for each in alike) or any(each != orbits[0] for each in orbits):
            return None
        return GripperForce(setups, closes=self._closes)

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
    One that was never begun holds nothing. Of several copies of the spacecraft ports, memory and
    parameter hold copy after copy, and all that close begin at one time.
    """

    def __init__(self, setups: Sequence[BlockSetup], *, closes: Compliance | None) -> None:
        super().__init__()
        scenarios, copies = [setup.scenario for setup in setups], len(setups)
        scenario, captures = scenarios[0], [each.capture for each in scenarios]
        closings = [None if each is None else each.closing for each in captures]
        if closings[0] is None:
            raise ValueError("capture.closing: there is none")
        self._closing, self._copies = closings[0], copies
        self._friction = np.array([each.friction for each in closings if each is not None])
        self._envelope = np.array(
            [
                [np.inf if limit is None else limit for limit in (each.angle, each.position)]
                for each in (capture.envelope for capture in captures if capture is not None)
            ]
        )
        self._compliance, self._sample_time = closes, scenario.sample_time
        self._orbit = None if scenario.environment is None else Orbit(scenario.environment)
        self._models = [make_flexible_plant(each) for each in scenarios]
        model, self._hands = self._models[0], list[Frame]()
        poses = []
        for own, of in zip(self._models, scenarios, strict=True):
            self._hands.append(hand_frame(own.plant, of.model))
            body = payload_body(of, own).body_frame()
            poses.append(body.CalcPose(own.context, self._hands[-1]).inverse())
        self._q_PE = np.array([pose.rotation().ToQuaternion().wxyz() for pose in poses])
        self._p_PE = np.array([pose.translation() for pose in poses])
        split, whole = setups[0].split, model.plant.num_velocities()
        hidden = len(split.names)
        self._state = self.DeclareVectorInputPort(
            "state", copies * (model.plant.num_multibody_states() - 2 * hidden)
        )
        self._hidden = (
            self.DeclareVectorInputPort("hidden_state", copies * 2 * hidden) if hidden else None
        )
        self._groups = {
            name: self.DeclareDiscreteState(np.tile(row, copies)) for name, row in _first().items()
        }
        self._acting = self.DeclareDiscreteState(np.zeros(copies * whole))  # on all coordinates
        known = split.known if hidden else np.arange(whole)
        self._joints = known[NUM_BASE_VELOCITIES:]  # in v of the plant
        # at the contact
        self._rates = self.DeclareDiscreteState(np.zeros(copies * self._joints.size))
        self._payload = self.DeclareNumericParameter(BasicVector(np.tile(_UNIT, copies)))
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
                copies * len(entries),
                functools.partial(weak_callback(self._calc), index, entries),
                {self.discrete_state_ticket(index)},
            )
        # motions of the targets (copies, 13) at the samples since ``begin``
        self.motions: list[np.ndarray] = []
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
        copy: int = 0,
    ) -> None:
        """Begin to close, at the context's time.

        Args:
          context: the system's.
          payload: of the target, in its frame P.
          target: (13) [quaternion, p_WP; w_WP, v_WP].
          state: the plant's own [q; v].
          copy: number of the spacecraft.
        """
        inertia = inertia_matrix(payload)[np.triu_indices(3)]
        packed = np.concatenate([[payload.mass], payload.center_of_mass, inertia])
        parameters = context.get_mutable_numeric_parameter(self._payload)
        payloads = parameters.value().reshape(self._copies, -1).copy()
        payloads[copy] = packed
        parameters.SetFromVector(payloads.ravel())
        memory, time = self._memory(context), context.get_time()
        for name, first in _first().items():
            memory[name][copy] = first
        memory["target"][copy] = Target.from_motion(target, payload).as_row()
        offset = self._met(memory, {copy: state}).offset[0]
        memory["start"][copy] = memory["gripper_offset"][copy] = offset
        memory["times"][copy] = time, time, math.inf
        for name, index in self._groups.items():
            context.SetDiscreteState(index, memory[name].ravel())
        for index, row in (
            (self._acting, np.zeros(self._models[copy].plant.num_velocities())),
            (self._rates, self._joint_rates(state)),
        ):
            rows = self._rows(context, index).copy()
            rows[copy] = row
            context.SetDiscreteState(index, rows.ravel())
        self.motions = []

    def park(self, context: Context, copy: int) -> None:
        """Put a copy's memory to its start (``systems.side_by_side``)."""
        first = {self._groups[name]: row for name, row in _first().items()}
        for index in (*self._groups.values(), self._acting, self._rates):
            rows = self._rows(context, index).copy()
            rows[copy] = first.get(index, 0.0)
            context.SetDiscreteState(index, rows.ravel())

    def met(self, context: Context, state: np.ndarray, *, copy: int = 0) -> Met:
        """The target in the gripper of a copy at the context's time, at the plant's own [q; v]."""
        met = self._met(self._advanced(context), {copy: state})
        return Met(**{name: values[0] for name, values in vars(met).items()})

    def _rows(self, context: Context, index: int) -> np.ndarray:
        values: np.ndarray = context.get_discrete_state(index).value()
        return values.reshape(self._copies, -1)

    def _memory(self, context: Context) -> dict[str, np.ndarray]:
        return {name: self._rows(context, index).copy() for name, index in self._groups.items()}

    def _masses(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """The targets' masses (copies, 1), and the inverses of their inertias in their axes."""
        values = context.get_numeric_parameter(self._payload).value().reshape(self._copies, -1)
        return values[:, :1], np.linalg.inv(values[:, 4 + _SYMMETRIC])

    def _advanced(self, context: Context) -> dict[str, np.ndarray]:
        """The memory at the context's time: the targets move on under the held force."""
        memory, now = self._memory(context), context.get_time()
        before = float(memory["times"][:, 1].max())  # 0 of those that were not begun
        if now > before:
            mass, inverse = self._masses(context)
            spin = 3.0 / np.trace(inverse, axis1=1, axis2=2)[:, None]
            pushed = memory["wrench"] / np.repeat(np.hstack([spin, mass]), 3, axis=1)
            target = Target.from_row(memory["target"])
            # one by one, so that each has the bits that it has alone
            G = np.stack([inverse_inertia(shape) for shape in target.shape])
            moved = target.after(now - before, before, self._orbit, pushed, G=G)
            memory["target"], memory["times"][:, 1] = moved.as_row(), now
        return memory

    def _met(self, memory: dict[str, np.ndarray], states: dict[int, np.ndarray]) -> Met:
        """``met`` of copies by their number, in rows. Leaves their models in these states."""
        poses, twists = [], []
        for copy, state in states.items():
            model, hand = self._models[copy], self._hands[copy]
            model.plant.SetPositionsAndVelocities(model.context, state)
            poses.append(hand.CalcPose(model.context, model.plant.world_frame()))
            moving = hand.CalcSpatialVelocityInWorld(model.context)
            twists.append([moving.rotational(), moving.translational()])
        copies = list(states)
        motion = Target.from_row(memory["target"][copies]).motion
        q_WP, p_WP, w, v = np.split(motion, [4, 7, 10], axis=1)
        p_WE = np.array([pose.translation() for pose in poses])
        q_WE = np.array([pose.rotation().ToQuaternion().wxyz() for pose in poses])
        R_WE = np.array([pose.rotation().matrix() for pose in poses])
        w_E, v_E = np.swapaxes(np.array(twists), 0, 1)
        into = np.swapaxes(R_WE, 1, 2)
        turn = turn_between(q_WE, composed(q_WP, self._q_PE[copies]))
        from_P = times(matrix_of(q_WP), self._p_PE[copies])
        from_E = p_WP + from_P - p_WE  # place of the grasp frame, world axes
        moves = v + cross_of(w, from_P) - v_E - cross_of(w_E, from_E)
        return Met(
            motion=motion,
            offset=np.hstack([turn, times(into, from_E)]),
            rate=np.hstack([times(into, w - w_E), times(into, moves)]),
            p_WE=p_WE,
            R_WE=R_WE,
            left=memory["times"][copies, 2],
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        memory = self._advanced(context)
        rows = (self._copies, -1)
        hidden = None if self._hidden is None else self._hidden.Eval(context).reshape(rows)
        states = self._split.whole(self._state.Eval(context).reshape(rows), hidden)
        met = self._met(memory, dict(enumerate(states)))
        sample = context.get_time() / self._sample_time
        if abs(sample - round(sample)) < 0.1 * self._period:
            self.motions.append(met.motion)
        first, now, left = memory["times"].T
        sizes = np.linalg.norm(met.offset.reshape(self._copies, 2, 3), axis=2)
        left = np.where((left == math.inf) & (sizes > self._envelope).any(axis=1), now, left)
        memory["gripper_offset"], memory["times"][:, 2] = met.offset, left
        plants = [(model.plant, model.context) for model in self._models]
        mobility = np.linalg.inv([plant.CalcMassMatrix(own) for plant, own in plants])
        held = (left == math.inf)[:, None]
        acting = np.where(held, self._act(context, memory, met, now - first, mobility, held), 0.0)
        if self._closing.joints == "limp":
            rates = np.stack([self._joint_rates(state) for state in states])
            rates = rates - self._rows(context, self._rates)
            acting[:, self._joints] -= self._damping(rates, mobility)
        for name, index in self._groups.items():
            values.set_value(index, memory[name].ravel())
        values.set_value(self._acting, acting.ravel())

    def _damping(self, rates: np.ndarray, mobility: np.ndarray) -> np.ndarray:
        """The torques or forces that damp limp joints, by the rates that they leave after a step:
        by those before it, a light wrist would be thrown about.
        """
        if self._closing.joint_damping == 0.0:
            return np.zeros_like(rates)
        of_joints = mobility[:, self._joints[:, None], self._joints]
        resists = np.eye(rates.shape[1]) / self._closing.joint_damping
        damping: np.ndarray = np.linalg.solve(resists + self._period * of_joints, rates[..., None])[
            ..., 0
        ]
        return damping

    def _joint_rates(self, state: np.ndarray) -> np.ndarray:
        rates: np.ndarray = state[self._models[0].plant.num_positions() :][self._joints]
        return rates

    def _act(
        self,
        context: Context,
        memory: dict[str, np.ndarray],
        met: Met,
        time: np.ndarray,
        mobility: np.ndarray,
        held: np.ndarray,
    ) -> np.ndarray:
        """The generalized forces on the plants (copies, nv), with those of the contacts in the
        memory where targets are ``held`` (copies, 1); ``mobility``: inverse mass matrices.
        """
        # J of the point of the hand where the target's grasp frame is: action is reaction there
        jacobian = np.stack(
            [
                model.plant.CalcJacobianSpatialVelocity(
                    model.context, JacobianWrtVariable.kV, hand, point,
                    model.plant.world_frame(), hand,
                )
                for model, hand, point in zip(
                    self._models, self._hands, met.offset[:, 3:], strict=True
                )
            ]
        )  # fmt: skip
        mass, inverse = self._masses(context)
        R, R_WP = met.R_WE, matrix_of(met.motion[:, :4])
        center = Target.from_row(memory["target"]).center
        p_CG = met.p_WE + times(R, met.offset[:, 3:]) - center
        lever = np.zeros((self._copies, 6, 6))  # wrench about C, world axes
        lever[:, :3, :3] = lever[:, 3:, 3:] = R
        lever[:, :3, 3:] = np.matmul(skew(p_CG), R)
        of_target = np.zeros((self._copies, 6, 6))
        of_target[:, :3, :3] = np.matmul(np.matmul(R_WP, inverse), np.swapaxes(R_WP, 1, 2))
        of_target[:, 3:, 3:] = np.eye(3) / mass[..., None]
        back, onto = np.swapaxes(lever, 1, 2), np.swapaxes(jacobian, 1, 2)
        jaws = Jaws(
            closing=self._closing,
            compliance=self._compliance or Compliance(),
            start=memory["start"],
            friction=self._friction,
        )
        force, slid = jaws.act(
            time + self._period,
            self._period,
            offset=met.offset,
            rate=met.rate,
            slid=memory["slid"],
            mobility=np.matmul(np.matmul(back, of_target), lever)
            + np.matmul(np.matmul(jacobian, mobility), onto),
        )
        memory["slid"] = np.where(held, slid, memory["slid"])
        memory["contact_force"] = np.where(held, force, 0.0)
        memory["wrench"] = np.where(held, times(lever, force), 0.0)
        return -times(onto, force)

    def _calc(self, index: int, entries: np.ndarray, context: Context, output: BasicVector) -> None:
        value = self._rows(context, index)[:, entries].ravel()
        output.SetFromVector(value if self._compliance is not None else 0.0 * value)


def _first() -> dict[str, np.ndarray]:
    """The memory before a contact."""
    first = {name: np.zeros(size) for name, size in _MEMORY.items()}
    first["target"][0] = 1.0  # a unit quaternion
    return first
