"""A gripper that takes time to close (``capture.closing``): its force between the servicer and the
free target, before the grasp.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.choice import choose
from ffsm_drake.common.products import times
from ffsm_drake.common.so3 import composed, cross_of, matrix_of, skew, turn_between
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.contact_force import Jaws
from ffsm_drake.plugins.capture.free_body import Target
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix
from ffsm_drake.scenario.capture import Compliance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, halves
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.spacecraft.plant import hand_frame
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signal, View
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

STEP = 1e-3  # s; of the contact, at most
MOTION = "target_motion"  # output: [quaternion, p_WP; w_WP, v_WP] (13) at the last sample
AXES = ("rotation_x", "rotation_y", "rotation_z", "position_x", "position_y", "position_z")
_MEMORY = {
    "target": 21,  # ``Target.as_row``
    "slid": 6,  # slip between jaws and target
    "wrench": 6,  # on the target, about its centre of mass, world axes
    "start": 6,  # the offset at the first contact
    "times": 3,  # times, s: first contact; this state; the target's leaving, or infinite
    "mass": 1,  # kg, of the target
    "inverse": 9,  # of its inertia in its axes
    "loads": 6,  # to ``Target.after``'s accelerations
    MOTION: 13,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Met:
    """A free target at an instant, and how it lies in the gripper."""

    motion: np.ndarray  # (13) [quaternion, p_WP; w_WP, v_WP] of the target's frame, world axes
    offset: np.ndarray  # (6) of the target's grasp frame from the gripper, gripper axes
    rate: np.ndarray  # (6) of the offset
    p_WE: np.ndarray  # (3) place of the gripper, m
    R_WE: np.ndarray  # (3, 3) its attitude
    left: Any  # s; when it was beyond the envelope, infinite if it is not


class Gripper(Part):
    """The section ``capture.closing``. It acts only in the phase in which the gripper closes."""

    title = "Gripper"
    about = "Contact of the gripper with the target while it closes; the gripper's axes."

    def __init__(self, closes: Compliance | None = None) -> None:
        """Args: the compliance with which it closes in this phase; None: it does not close."""
        self._closes = closes
        self.logged = () if closes is None else (MOTION,)

    @classmethod
    def of(cls, scenario: Scenario) -> "Gripper | None":
        """The gripper of a scenario with ``capture.closing``; None without it."""
        return None if scenario.closing is None else cls()

    def build(self, setup: BlockSetup) -> Any:
        """The force."""
        return Closing.of(setup, self._closes)

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Closing(Sampled):
    """The force of the gripper on the servicer, and the motion of the target under it.

    In the phase in which the gripper closes, it steps with a period of at most STEP, and its memory
    at the start is that of ``begun``.
    """

    model: PlantModel  # with all coordinates of the true plant
    hand: Frame
    q_PE: np.ndarray  # (4) attitude of the target's grasp frame E in its frame P
    p_PE: np.ndarray  # (3) its place, m
    jaws: Jaws
    joint_damping: np.ndarray  # () of limp joints, N m s/rad or N s/m
    envelope: np.ndarray  # (2) angle and distance at which the target leaves, rad, m, or infinite
    orbit: Orbit | None
    sample_time: float  # s
    per_sample: int
    is_damped: bool  # whether limp joints are damped
    joints: np.ndarray  # (n) in v of the plant
    known: np.ndarray  # (nv) in v of the plant

    @classmethod
    def of(cls, setup: BlockSetup, closes: Compliance | None) -> "Closing":
        """Build from a scenario; ``closes``: see ``Gripper``."""
        scenario, capture = setup.scenario, setup.scenario.capture
        if capture is None or capture.closing is None:
            raise ValueError("capture.closing: there is none")
        closing, envelope = capture.closing, capture.envelope
        model = setup.craft.flexible(setup.grip)
        hand = hand_frame(model.plant, scenario.model)
        pose = payload_body(scenario, model).body_frame().CalcPose(model.context, hand).inverse()
        known = model.split.known_velocities(np.arange(model.plant.num_velocities()))
        return cls(
            model=model,
            hand=hand,
            q_PE=np.array(pose.rotation().ToQuaternion().wxyz()),
            p_PE=np.array(pose.translation()),
            jaws=Jaws.of(closing, closes or Compliance()),
            joint_damping=np.array(closing.joint_damping or 1.0),
            envelope=np.array(
                [np.inf if each is None else each for each in (envelope.angle, envelope.position)]
            ),
            orbit=None if scenario.environment is None else Orbit.of(scenario.environment),
            sample_time=scenario.sample_time,
            per_sample=0 if closes is None else math.ceil(scenario.sample_time / STEP - 1e-9),
            is_damped=closing.joints == "limp" and closing.joint_damping > 0.0,
            joints=known[NUM_BASE_VELOCITIES:],
            known=known,
        )

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        hidden = 2 * len(self.model.split.names)
        size = 2 * self.known.size + 1
        return {"state": size, "hidden_state": hidden} if hidden else {"state": size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled; ``target_motion``: at the last control sample."""
        hidden = len(self.model.split.names)
        forces = {"generalized_force": self.known.size, "hidden_force": hidden}
        shown = {"gripper_offset": 6, "contact_force": 6, MOTION: 13}
        return {name: size for name, size in {**forces, **shown}.items() if size}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        return {name: np.zeros(size) for name, size in _MEMORY.items()} | {
            "rates": np.zeros(self.joints.size)
        }

    def begun(
        self, *, time: float, payload: MassProperties, target: np.ndarray, state: np.ndarray
    ) -> Arrays:
        """Return the memory with which it begins to close.

        Args:
          time: s.
          payload: of the target, in its frame P.
          target: (13) [quaternion, p_WP; w_WP, v_WP].
          state: the plant's own [q; v].
        """
        inverse = np.linalg.inv(inertia_matrix(payload))
        found = Target.from_motion(target, payload)
        memory = {
            **self.start(),
            "target": found.as_row(),
            "times": np.array([time, time, math.inf]),
            "mass": np.array([payload.mass]),
            "inverse": inverse.ravel(),
            "loads": np.repeat([3.0 / np.trace(inverse), payload.mass], 3),
            "rates": self._joint_rates(state),
        }
        return memory | {"start": self._met(found, math.inf, state).offset}

    def met(self, memory: Arrays, time: float, state: np.ndarray) -> Met:
        """The target in the gripper at a time, at the plant's own [q; v]."""
        return self._met(self._moved(memory, time), memory["times"][2].item(), state)

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        time, period = now.time, self.sample_time / self.per_sample
        state = self.model.split.whole(inputs["state"], inputs.get("hidden_state"))
        target, (first, _, left) = self._moved(memory, time), memory["times"]
        met = self._met(target, left, state)
        angle, distance = np.linalg.norm(met.offset.reshape(2, 3), axis=1)
        is_beyond = (angle > self.envelope[0]) | (distance > self.envelope[1])
        left = np.where((left == math.inf) & is_beyond, time, left)
        mobility = np.linalg.inv(self.model.calc_mass_matrix(halves(state)[0]))
        zeros = np.zeros(6)
        acting, force, wrench, slid = choose(
            left == math.inf,
            lambda: self._act(memory, time - first + period, met, target, state, mobility),
            (np.zeros(len(mobility)), zeros, zeros, memory["slid"]),
        )
        if self.is_damped:
            acting[self.joints] -= self._damping(
                self._joint_rates(state) - memory["rates"], mobility, period
            )
        sample = time / self.sample_time
        is_sample = abs(sample - np.rint(sample)) < 0.1 * period
        motion = np.where(is_sample, met.motion, memory[MOTION])
        split = self.model.split
        outputs = {"generalized_force": acting[self.known]}
        if split.names:
            outputs["hidden_force"] = acting[split.hidden]
        outputs |= {"gripper_offset": met.offset, "contact_force": force, MOTION: motion}
        return outputs, {
            **memory, "target": target.as_row(), "times": np.stack([first, time, left]),
            "wrench": wrench, "slid": slid, MOTION: motion,
        }  # fmt: skip

    def _moved(self, memory: Arrays, time: Any) -> Target:
        """The target at a time: it moves on under the held force."""
        before, row = memory["times"][1], memory["target"]

        def moved() -> Any:
            pushed = memory["wrench"] / memory["loads"]
            return Target.from_row(row).after(time - before, before, self.orbit, pushed).as_row()

        return Target.from_row(choose(time > before, moved, row))

    def _met(self, target: Target, left: Any, state: np.ndarray) -> Met:
        """``met``."""
        model, hand, (q, v) = self.model, self.hand, halves(state)
        pose, R_WE = model.calc_frame_pose(q, hand), model.calc_frame_rotation(q, hand)
        moving = model.calc_frame_twist(q, v, hand)
        w_E, v_E, p_WE, motion = moving[:3], moving[3:], pose[4:], target.motion
        q_WP, p_WP, w, v = np.split(motion, [4, 7, 10])
        turn = turn_between(pose[:4], composed(q_WP, self.q_PE))
        from_P = times(matrix_of(q_WP), self.p_PE)
        from_E = p_WP + from_P - p_WE  # place of the grasp frame, world axes
        moves = v + cross_of(w, from_P) - v_E - cross_of(w_E, from_E)
        return Met(
            motion=motion,
            offset=np.concatenate([turn, times(R_WE.T, from_E)]),
            rate=np.concatenate([times(R_WE.T, w - w_E), times(R_WE.T, moves)]),
            p_WE=p_WE,
            R_WE=R_WE,
            left=left,
        )

    def _damping(self, rates: Any, mobility: Any, period: Any) -> Any:
        """The torques or forces that damp limp joints. They follow from the rates after the step,
        because damping by the rates before it is unstable for a wrist with small inertia.
        """
        of_joints = mobility[self.joints[:, None], self.joints]
        resists = np.eye(self.joints.size) / self.joint_damping
        return np.linalg.solve(resists + period * of_joints, rates)

    def _joint_rates(self, state: np.ndarray) -> np.ndarray:
        _, v = halves(state)
        return v[self.joints]

    def _act(
        self, memory: Arrays, time: Any, met: Met, target: Target, state: Any, mobility: Any
    ) -> tuple[Any, Any, Any, Any]:
        """The generalized force (nv) on the plant, the contact's force and its wrench on the
        target (6), and the slip at the end of a step.

        Args: time since the first contact at its end, s; ``mobility``: inverse mass matrix.
        """
        (q, _), R, R_WP = halves(state), met.R_WE, matrix_of(met.motion[:4])
        # J of the point of the hand where the target's grasp frame is: action is reaction there
        jacobian = self.model.calc_point_jacobian(q, self.hand, met.offset[3:])
        p_CG = met.p_WE + times(R, met.offset[3:]) - target.center
        zeros = np.zeros((3, 3))
        lever = _blocks(R, skew(p_CG) @ R, zeros, R)  # wrench about C, world axes
        turning = R_WP @ memory["inverse"].reshape(3, 3) @ R_WP.T
        of_target = _blocks(turning, zeros, zeros, np.eye(3) / memory["mass"])
        force, slid = self.jaws.act(
            time,
            self.sample_time / self.per_sample,
            start=memory["start"],
            offset=met.offset,
            rate=met.rate,
            slid=memory["slid"],
            mobility=lever.T @ of_target @ lever + jacobian @ mobility @ jacobian.T,
        )
        return -times(jacobian.T, force), force, times(lever, force), slid


def _blocks(a: Any, b: Any, c: Any, d: Any) -> Any:
    """The matrix [[a, b], [c, d]]."""
    rows = np.concatenate([a, b], axis=1), np.concatenate([c, d], axis=1)
    return np.concatenate(rows)
