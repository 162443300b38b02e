"""The force of grippers that close over a time, and the motion of their target."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame

from ffsm_drake.common.choice import choose
from ffsm_drake.common.numbers import number
from ffsm_drake.common.products import times
from ffsm_drake.common.so3 import composed, cross_of, matrix_of, skew, turn_between
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.contact_force import Jaws, Met, together
from ffsm_drake.plugins.capture.free_body import Target
from ffsm_drake.runs.ending import BOUNCED, SLIPPED
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix
from ffsm_drake.scenario.capture import Closing as Settings
from ffsm_drake.scenario.capture import Compliance
from ffsm_drake.scenario.contacts import Contact
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, halves
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.spacecraft.plant import find_frame, hand_frame
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

STEP = 1e-3  # s; of the contact, at most
MOTION = "target_motion"  # output: [quaternion, p_WP; w_WP, v_WP] (13) at the last sample
_MEMORY = {
    "target": 21,  # ``Target.as_row``
    "wrench": 6,  # on the target, about its centre of mass, world axes
    "times": 2,  # times, s: first contact; this state
    "mass": 1,  # kg, of the target
    "inverse": 9,  # of its inertia in its axes
    "loads": 6,  # to ``Target.after``'s accelerations
    MOTION: 13,
}
_OF_HANDS = {  # in the memory, for each hand
    "slid": 6,  # slip between jaws and target
    "force": 6,  # of the jaws on the target
    "start": 6,  # the offset at the first contact
    "grasp": 7,  # pose of the grasp frame in the target's frame: quaternion, m
    "left": 1,  # time of the target's leaving, s, or infinite
}


def hands_of(scenario: Scenario) -> Mapping[str, Contact]:
    """The contacts, or one without a name."""
    return scenario.contacts or {"": Contact(effector=scenario.model.end_effector)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hand:
    """A hand with a gripper."""

    name: str  # of its contact; "": there are no contacts
    frame: Frame
    pose: np.ndarray  # (7) of its grasp frame in the target's frame P: quaternion, m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Closing(Sampled):
    """The forces of grippers on the servicer, and the motion of a free target under them.

    In the phase in which they close, it steps with a period of at most STEP, and its memory at the
    start is that of ``begun``.
    """

    model: PlantModel  # with all coordinates of the true plant
    hands: tuple[Hand, ...]  # all
    acting: tuple[int, ...]  # those that close
    body: Frame | None  # of a target that other hands hold; None: it is free
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
    def of(cls, setup: BlockSetup, closes: Compliance | None, at: float = 0.0) -> "Closing":
        """Build from a scenario; ``closes``, ``at``: see ``Gripper``."""
        scenario, capture = setup.scenario, setup.scenario.capture
        if capture is None or capture.closing is None:
            raise ValueError("capture.closing: there is none")
        closing, envelope = capture.closing, capture.envelope
        model = setup.craft.flexible(setup.grip)
        body, hands = payload_body(scenario, model).body_frame(), list[Hand]()
        for name, contact in hands_of(scenario).items():
            hand = grasp = hand_frame(model.plant, scenario.model)
            if contact.effector != scenario.model.end_effector:
                hand = find_frame(model.plant, contact.effector, key=f"contacts.{name}.effector")
                grasp = find_frame(model.plant, contact.frame, key=f"contacts.{name}.frame")
            pose = body.CalcPose(model.context, grasp).inverse()
            row = np.array([*pose.rotation().ToQuaternion().wxyz(), *pose.translation()])
            hands.append(Hand(name=name, frame=hand, pose=row))
        known = model.split.known_velocities(np.arange(model.plant.num_velocities()))
        closings = (each.closes for each in hands_of(scenario).values())
        return cls(
            model=model,
            hands=tuple(hands),
            acting=tuple(k for k, each in enumerate(closings) if each == at),
            body=body if at else None,
            jaws=Jaws.of(closing, closes or Compliance()),
            joint_damping=np.array(closing.joint_damping or 1.0),
            envelope=np.array(
                [np.inf if each is None else each for each in (envelope.angle, envelope.position)]
            ),
            orbit=None if scenario.environment is None else Orbit.of(scenario.environment),
            sample_time=scenario.sample_time,
            per_sample=0 if closes is None else math.ceil(scenario.sample_time / STEP - 1e-9),
            is_damped=not at and closing.joints == "limp" and closing.joint_damping > 0.0,
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
        hidden, shown = len(self.model.split.names), 6 * len(self.hands)
        sizes = {"generalized_force": self.known.size, "hidden_force": hidden}
        sizes |= {"gripper_offset": shown, "contact_force": shown, MOTION: 13}
        return {name: size for name, size in sizes.items() if size}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        of_hands = {name: len(self.hands) * size for name, size in _OF_HANDS.items()}
        sizes = {**_MEMORY, **of_hands, "rates": self.joints.size}
        return {name: np.zeros(size) for name, size in sizes.items()}

    def begun(
        self,
        *,
        time: float,
        payload: MassProperties,
        state: np.ndarray,
        target: np.ndarray | None = None,
        lies: RigidTransform | None = None,
    ) -> Arrays:
        """Return the memory with which it begins to close.

        Args:
          time: s.
          payload: of the target, in its frame P.
          state: the plant's own [q; v].
          target: (13) [quaternion, p_WP; w_WP, v_WP]; None: it is held.
          lies: X_QP of a target that is held, from where the model welds it; None: it is there.
        """
        inverse = np.linalg.inv(inertia_matrix(payload))
        grasps = np.array([each.pose for each in self.hands])
        if lies is not None:
            for row in grasps:
                pose = lies @ RigidTransform(Quaternion(row[:4]), row[4:])
                row[:] = [*pose.rotation().ToQuaternion().wxyz(), *pose.translation()]
        memory = {
            **self.start(),
            "times": np.array([time, time]),
            "mass": np.array([payload.mass]),
            "inverse": inverse.ravel(),
            "loads": np.repeat([3.0 / np.trace(inverse), payload.mass], 3),
            "rates": self._joint_rates(state),
            "grasp": grasps.ravel(),
            "left": np.full(len(self.hands), math.inf),
        }
        if target is not None:
            memory["target"] = Target.from_motion(target, payload).as_row()
        start = np.zeros((len(self.hands), 6))
        start[list(self.acting)] = [met.offset for met in self.met(memory, time, state).values()]
        return memory | {"start": start.ravel()}

    def met(self, memory: Arrays, time: float, state: np.ndarray) -> dict[str, Met]:
        """The target in the grippers that close, by their contacts, at a time and the plant's own
        [q; v].
        """
        names = (self.hands[k].name for k in self.acting)
        return dict(zip(names, self._met(memory, self._moved(memory, time), state), strict=True))

    def lost(
        self, memory: Arrays, time: float, state: np.ndarray, settings: Settings
    ) -> tuple[str, str]:
        """Return how the first gripper that does not hold the target at the end of the closing
        failed: the status of the run, and words. Empty: all hold it. Arguments: see ``met``.
        """
        for name, met in self.met(memory, time, state).items():
            turning, moving = met.motion_in
            if math.isinf(met.left) and max(turning, moving) <= settings.rest:
                continue
            bounces = met.left < memory["times"][0] + settings.time
            how = "bounces off the gripper" if bounces else "slips out of the gripper"
            away = float(np.linalg.norm(met.offset[3:]))
            how += f" of contacts.{name}" if name else ""
            motion = f"{number(moving)} m/s and {number(turning)} rad/s"
            how += f": {number(away)} m away, moving at {motion} from it"
            return BOUNCED if bounces else SLIPPED, how
        return "", ""

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        time, period, acting = now.time, self.sample_time / self.per_sample, list(self.acting)
        state = self.model.split.whole(inputs["state"], inputs.get("hidden_state"))
        target, (first, _) = self._moved(memory, time), memory["times"]
        mets, left = self._met(memory, target, state), 1.0 * memory["left"]
        offsets = np.stack([met.offset for met in mets])
        sizes = np.sqrt((offsets.reshape(-1, 2, 3) ** 2).sum(axis=2))
        is_beyond = (sizes > self.envelope).any(axis=1)
        left[acting] = np.where((left[acting] == math.inf) & is_beyond, time, left[acting])
        mobility = np.linalg.inv(self.model.calc_mass_matrix(halves(state)[0]))
        zeros = np.zeros(6 * len(self.hands))
        acts, force, wrench, slid = choose(
            (left[acting] == math.inf).any(),
            lambda: self._act(memory, time - first + period, mets, target, state, mobility, left),
            (np.zeros(len(mobility)), zeros, np.zeros(6), memory["slid"]),
        )
        if self.is_damped:
            acts[self.joints] -= self._damping(
                self._joint_rates(state) - memory["rates"], mobility, period
            )
        sample = time / self.sample_time
        is_sample = abs(sample - np.rint(sample)) < 0.1 * period
        motion = np.where(is_sample, mets[0].motion, memory[MOTION])
        split = self.model.split
        outputs = {"generalized_force": acts[self.known]}
        if split.names:
            outputs["hidden_force"] = acts[split.hidden]
        outputs |= {
            "gripper_offset": self._of_all(offsets), "contact_force": force, MOTION: motion
        }  # fmt: skip
        row = memory["target"] if target is None else target.as_row()
        return outputs, {
            **memory, "target": row, "times": np.stack([first, time]), "left": left,
            "wrench": wrench, "slid": slid, "force": force, MOTION: motion,
        }  # fmt: skip

    def _of_all(self, rows: Any, others: Any = 0.0) -> Any:
        """Rows (m, 6) of the hands that close among those of all, which are ``others``, as one."""
        found = rows[:1] * np.zeros((len(self.hands), 1)) + others
        found[list(self.acting)] = rows
        return found.ravel()

    def _of_acting(self, memory: Arrays, name: str) -> Any:
        """The rows of the hands that close in an entry of the memory."""
        return memory[name].reshape(len(self.hands), -1)[list(self.acting)]

    def _moved(self, memory: Arrays, time: Any) -> Target | None:
        """The target at a time: it moves on under the held force. None: other hands hold it."""
        if self.body is not None:
            return None
        before, row = memory["times"][1], memory["target"]

        def moved() -> Any:
            pushed = memory["wrench"] / memory["loads"]
            return Target.from_row(row).after(time - before, before, self.orbit, pushed).as_row()

        return Target.from_row(choose(time > before, moved, row))

    def _met(self, memory: Arrays, target: Target | None, state: np.ndarray) -> list[Met]:
        """``met``."""
        model, (q, v), body, mets = self.model, halves(state), self.body, list[Met]()
        if target is None:
            parts = model.calc_frame_pose(q, body), model.calc_frame_twist(q, v, body)
            motion = np.concatenate(parts)
        else:
            motion = target.motion
        q_WP, p_WP, w, v_P = np.split(motion, [4, 7, 10])
        for k, grasp in zip(self.acting, self._of_acting(memory, "grasp"), strict=True):
            hand = self.hands[k].frame
            pose, R_WE = model.calc_frame_pose(q, hand), model.calc_frame_rotation(q, hand)
            moving = model.calc_frame_twist(q, v, hand)
            w_E, v_E, p_WE = moving[:3], moving[3:], pose[4:]
            turn = turn_between(pose[:4], composed(q_WP, grasp[:4]))
            from_P = times(matrix_of(q_WP), grasp[4:])
            from_E = p_WP + from_P - p_WE  # place of the grasp frame, world axes
            moves = v_P + cross_of(w, from_P) - v_E - cross_of(w_E, from_E)
            met = Met(
                motion=motion,
                offset=np.concatenate([turn, times(R_WE.T, from_E)]),
                rate=np.concatenate([times(R_WE.T, w - w_E), times(R_WE.T, moves)]),
                p_WE=p_WE,
                R_WE=R_WE,
                left=memory["left"][k],
            )
            mets.append(met)
        return mets

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
        self,
        memory: Arrays,
        time: Any,
        mets: Sequence[Met],
        target: Target | None,
        state: Any,
        mobility: Any,
        left: Any,
    ) -> tuple[Any, Any, Any, Any]:
        """The generalized force (nv) on the plant, the contacts' forces and their wrench on a free
        target (6), and the slips at the end of a step.

        Args: time since the first contact at its end, s; ``mobility``: inverse mass matrix;
        ``left``: see the memory.
        """
        (q, _), zeros = halves(state), np.zeros((3, 3))
        jacobians, levers = list[Any](), list[Any]()
        for k, met in zip(self.acting, mets, strict=True):
            R = met.R_WE
            # J of the point of the hand where the target's grasp frame is: action is reaction there
            jacobian = self.model.calc_point_jacobian(q, self.hands[k].frame, met.offset[3:])
            if target is None:  # from the target
                place = memory["grasp"].reshape(-1, 7)[k, 4:]
                turn = R.T @ matrix_of(met.motion[:4])
                of_target = self.model.calc_point_jacobian(q, self.body, place)
                jacobian = jacobian - _blocks(turn, zeros, zeros, turn) @ of_target
            else:
                p_CG = met.p_WE + times(R, met.offset[3:]) - target.center
                levers.append(_blocks(R, skew(p_CG) @ R, zeros, R))  # wrench about C, world axes
            jacobians.append(jacobian)
        jacobian = _stacked(jacobians)
        inner = jacobian @ mobility @ jacobian.T
        if target is not None:
            R_WP, lever = matrix_of(mets[0].motion[:4]), _stacked([each.T for each in levers]).T
            turning = R_WP @ memory["inverse"].reshape(3, 3) @ R_WP.T
            inner = (
                lever.T @ _blocks(turning, zeros, zeros, np.eye(3) / memory["mass"]) @ lever + inner
            )
        rows = {name: self._of_acting(memory, name) for name in ("start", "slid", "force")}
        rows |= {
            name: np.stack([getattr(met, name) for met in mets]) for name in ("offset", "rate")
        }
        stays = np.where(left[list(self.acting)] == math.inf, 1.0, 0.0)
        force, slid = together(
            self.jaws, time, self.sample_time / self.per_sample,
            {**rows, "stays": stays, "mobility": inner},
        )  # fmt: skip
        flat, others = force.ravel(), memory["slid"].reshape(len(self.hands), 6)
        wrench = np.zeros(6) if target is None else times(lever, flat)
        return -times(jacobian.T, flat), self._of_all(force), wrench, self._of_all(slid, others)


def _stacked(parts: Sequence[Any]) -> Any:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _blocks(a: Any, b: Any, c: Any, d: Any) -> Any:
    """The matrix [[a, b], [c, d]]."""
    rows = np.concatenate([a, b], axis=1), np.concatenate([c, d], axis=1)
    return np.concatenate(rows)
