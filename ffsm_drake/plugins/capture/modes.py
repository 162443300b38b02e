"""The mode logic of the supervisor, and its plans; see ``supervisor``."""

import dataclasses
import enum
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.approach import approach_posture
from ffsm_drake.plugins.capture.floating import floated
from ffsm_drake.plugins.capture.postures import posture_of
from ffsm_drake.scenario import Reference
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import (
    followed,
    make_frame_motion,
)
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

_SHORTEST, _GROWTH, _LONGEST = 5.0, 1.15, 600.0  # s, of a new plan
_LEAST_ROOM = 0.1  # of a limit, for damping beside the force between hands
# of a plan in rate damping: its place in the memory
_HELD = {"desired_state": "held", "desired_frame": "held_frame"}
_INSTANTS = 41  # number of instants of a plan at which its force is compared with the limits


class Mode(enum.IntEnum):
    """Mode of a loop."""

    APPROACH = 0
    GRASP = 1  # the sample of the grasp
    STOP = 2  # the motion with the target held
    HOLD = 3  # its end posture
    RATE_DAMPING = 4
    RETREAT = 5

    @property
    def words(self) -> str:
        """As the report has it."""
        return self.name.lower().replace("_", " ")


class Cause(enum.IntEnum):
    """Reason for which the plan was abandoned."""

    NONE = 0
    SATURATED = 1
    ERROR = 2
    RATE = 3
    REQUEST = 4
    MISSED = 5  # by a hand that closes later


class SupervisedChain(Protocol):
    """The closed chain of several hands, for a supervisor."""

    def kept(self) -> Any:
        """Return what keeps the internal force of a law that starts anew: it has a ``size`` and
        ``step(q, mass_matrix, commands, wrenches, begins, goes_on)``, which returns wrenches and
        a force (nv). None: the law controls no internal force.
        """

    def follow(self, motion: PlannedMotion, since: float, closed: float) -> PlannedMotion:
        """Return a motion that closes the chain, of one that begins ``since`` s after the grasp,
        when hands with ``closes`` up to ``closed`` (s) hold the target.

        Raises ScenarioError: there is none.
        """


# "contacts"
SUPERVISED_CHAINS = Registry[Callable[[BlockSetup], SupervisedChain]]("supervised_chains")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Supervising(Sampled):
    """The mode logic. ``Supervisor`` makes its new plans.

    Inputs: ``estimated_state``, ``desired_state``, ``generalized_force`` of the law at the sample
    before, and ``abort_request``. Phase: the mode along the plan, and whether the gripper is empty.

    Outputs are the entries of its memory that ``outputs`` names, and ``asks``: 1 if the sample must
    be repeated with an answer (a plan, or that there is none) in the memory before it, which
    ``Supervisor.answered`` returns.
    """

    model: PlantModel  # the nominal one, reduced to the driven coordinates
    largest: np.ndarray  # limits (nv) of the force that saturates
    limit: np.ndarray  # limits (nv) of the damping force
    error: np.ndarray  # bounds (nv)
    rate: np.ndarray
    is_bounded: bool
    waits: bool
    saturated_time: np.ndarray  # s
    damping: np.ndarray  # (nv) 1/s
    share: np.ndarray  # of the low pass, in a sample
    end_share: np.ndarray
    end_time: np.ndarray  # s
    sample_time: float  # s
    grasp_time: float  # s
    end: float  # s, of the scenario's own motion
    is_empty: bool  # the gripper
    closed: float  # s, see ``Grip``
    internal: Any  # the force between the hands, see ``SupervisedChain.kept``
    frame: Frame | None  # whose pose is prescribed
    in_phase: ClassVar = ("grasp_time", "end", "is_empty", "closed")
    optional: ClassVar = ("abort_request",)

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        nv = len(self.largest)
        return dict.fromkeys(("estimated_state", "desired_state"), 2 * nv + 1) | {
            "generalized_force": nv, "abort_request": 1,
        }  # fmt: skip

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        nv = len(self.largest)
        return {
            "mode": 1, "mode_cause": 1, "restart": 1, "force": nv, "held": 2 * nv + 1,
            "plan": 2 * nv + 5, "asks": 1,
            **({} if self.internal is None else {"internal_force": nv}),
            **({} if self.frame is None else {"held_frame": FRAME_SIZE}),
        }  # fmt: skip

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled. First entry, ``restart``: 1 while the law restarts and ``force`` acts."""
        sizes = {name: size for name, size in self.outputs.items() if name != "asks"}
        # time of saturation and of little force, s; number of plans; request before; answer: 1 a
        # plan, 2 none; whether a hand has just missed
        sizes |= dict.fromkeys(("over", "quiet", "plans", "asked", "answer", "missed"), 1)
        sizes = {"restart": 1, **sizes, "filtered": sizes["force"]}
        if self.internal is not None:
            sizes |= {"wrenches": self.internal.size, "forgot": 1}
        return {name: np.zeros(size) for name, size in sizes.items()}

    def phase(self, sample: Any) -> Sequence[Any]:
        """``modes`` along the scenario's own plan."""
        return self.modes(self.sample_time * np.asarray(sample), np.zeros(3))

    def modes(self, times: np.ndarray, plan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mode at times (s) along a new plan (or zeros), and whether the gripper is empty."""
        half = 0.5 * self.sample_time
        is_empty = self.is_empty | (times < self.grasp_time - half)
        end = plan[0] + plan[1] if plan[1] else self.end
        modes = np.where(times < end - 1e-9, Mode.STOP, Mode.HOLD)
        if plan[1]:
            modes = np.full_like(modes, Mode.RETREAT) if plan[2] else modes
        else:
            is_grasp = (self.grasp_time > 0.0) & (times < self.grasp_time + half)
            modes = np.where(is_grasp, Mode.GRASP, modes)
            modes = np.where(is_empty, Mode.APPROACH, modes)
        return modes, is_empty

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        mode, is_empty = (np.reshape(each, 1) for each in now.phase)
        state, command = inputs["estimated_state"], inputs["generalized_force"]
        was_damping = memory["mode"] == float(Mode.RATE_DAMPING)
        cause, after = self._causes(inputs, memory, was_damping)
        has_missed = memory["missed"] != 0.0
        cause = np.where(has_missed, float(Cause.MISSED), cause)
        acts = cause != 0.0
        after["over"] = np.where(acts, 0.0, after["over"])
        is_planned = memory["answer"] == 1.0
        flees = acts & ((is_empty != 0.0) | has_missed)
        retreats = flees & is_planned
        damps = was_damping | (acts & ~retreats)

        q, v = np.split(state, [len(state) - len(command)])
        mass_matrix = self.model.calc_mass_matrix(q)
        wanted = self.damping * (mass_matrix @ v)
        room = self.limit
        if self.internal is not None:  # which needs some of it
            left = self.limit - np.abs(memory["internal_force"])
            room = np.maximum(left, _LEAST_ROOM * self.limit)
        damping = -(1.0 / np.maximum(1.0, (np.abs(wanted) / room).max())) * wanted
        filtered = np.where(was_damping, memory["filtered"], wanted)
        filtered = filtered + self.share * (wanted - filtered)
        is_quiet = (np.abs(filtered) <= self.end_share * self.limit).all()
        quiet = np.where(acts, 0.0, memory["quiet"])
        quiet = np.where(damps, np.where(is_quiet, quiet + self.sample_time, 0.0), quiet)
        is_over = damps & (quiet >= self.end_time - 1e-9)
        is_planned = is_planned & (is_over | retreats)

        clipped = np.clip(command, -self.limit, self.limit)
        after |= {
            "mode": np.where(damps & ~is_planned, float(Mode.RATE_DAMPING), mode),
            "mode_cause": np.where(acts, cause, memory["mode_cause"]),
            "restart": np.where(damps | retreats, 1.0, 0.0),
            "force": np.where(damps, damping, np.where(retreats, clipped, memory["force"])),
            "held": np.where(damps, state, memory["held"]),
            "filtered": np.where(damps, filtered, memory["filtered"]),
            "quiet": np.where(is_over, 0.0, quiet),  # without a plan damping goes on
            "plans": memory["plans"] + np.where(is_planned, 1.0, 0.0),
            "plan": memory["plan"], **dict.fromkeys(("answer", "missed"), np.zeros_like(quiet)),
        }  # fmt: skip
        if self.internal is not None:
            after |= self._kept((q, mass_matrix), (clipped, command), memory, after["restart"])
        if self.frame is not None:
            moved = self.model.calc_frame_motion(q, v, np.zeros_like(v), self.frame)
            after["held_frame"] = np.where(damps, moved, memory["held_frame"])
        asks = (flees | is_over) & (memory["answer"] == 0.0)
        after = {name: after[name] for name in memory}
        outputs = {name: after[name] for name in self.outputs if name != "asks"}
        return outputs | {"asks": np.where(asks, 1.0, 0.0)}, after

    def _kept(
        self,
        at: tuple[np.ndarray, np.ndarray],
        commands: tuple[np.ndarray, np.ndarray],
        memory: Arrays,
        restart: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """The force between hands after a sample, in the memory.

        Args: configuration and mass matrix; the law's force at the sample before, within the limits
        and without; the memory before; whether the law starts anew at the next sample (1).
        """
        was_anew = memory["restart"] != 0.0  # the law reads it at the sample after
        goes_on, acts = was_anew & (memory["forgot"] != 0.0), restart != 0.0
        begins, wrenches = acts & ~was_anew, memory["wrenches"]
        wrenches, force = self.internal.step(*at, commands, wrenches, begins, goes_on, acts)
        return {"wrenches": wrenches, "internal_force": force, "forgot": memory["restart"]}

    @staticmethod
    def follow(memory: Arrays, plan: Arrays) -> Arrays:
        """Return what the law follows in place of a plan: in rate damping the state last measured.

        Args: the memory before a sample, and the plan then: outputs of a reference.
        """
        damps = memory["mode"] == float(Mode.RATE_DAMPING)
        held = {name: memory[own] for name, own in _HELD.items() if own in memory}
        held["desired_acceleration"] = np.zeros(1)
        return {name: np.where(damps, held[name], each) for name, each in plan.items()}

    @staticmethod
    def give(memory: Arrays, force: np.ndarray) -> np.ndarray:
        """Return the command in place of the law's force. Args: the memory after a sample."""
        given = np.where(memory["restart"] != 0.0, memory["force"], force)
        return given + memory["internal_force"] if "internal_force" in memory else given

    def _causes(
        self, inputs: Arrays, memory: Arrays, was_damping: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The cause (1) to act, and memory after the sample."""
        cause, over, asked = np.zeros_like(memory["over"]), memory["over"], memory["asked"]
        if self.waits:
            return cause, {"over": over, "asked": asked}
        step, is_over = self.sample_time, np.abs(inputs["generalized_force"]) > self.largest
        longer = np.maximum(0.0, over + np.where(is_over.any(), step, -step))
        # a force that was not commanded does not count
        longer = np.where(memory["restart"] != 0.0, over, longer)
        if self.is_bounded:
            errors = self.model.calc_tracking_errors(
                inputs["desired_state"], inputs["estimated_state"], len(self.largest) + 1
            )
            for each, bound, error in zip(
                (Cause.RATE, Cause.ERROR), (self.rate, self.error), errors[::-1], strict=True
            ):
                cause = np.where((np.abs(error) > bound).any(), float(each), cause)
        is_long = longer > self.saturated_time + 1e-9
        cause = np.where(is_long, float(Cause.SATURATED), cause)
        asks = np.where(inputs.get("abort_request", np.zeros(1)) > 0.5, 1.0, 0.0)
        cause = np.where((asks != 0.0) & (asked == 0.0), float(Cause.REQUEST), cause)
        return np.where(was_damping, 0.0, cause), {
            "over": np.where(was_damping, over, longer),
            "asked": np.where(was_damping, asked, asks),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Supervisor(Sampled):
    """The supervisor with its plans."""

    block: Supervising
    mission: Mission
    nominal: PlantModel  # the whole one
    chain: SupervisedChain | None  # of several hands
    shortest: ClassVar = _SHORTEST  # s
    optional: ClassVar = Supervising.optional

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return self.block.inputs

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return self.block.outputs

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        return self.block.start(state)

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        time = np.array([now.time])
        while True:
            now = now._replace(phase=self.block.modes(time, memory["plan"]))
            outputs, after = self.block.step(inputs, memory, now)
            if not outputs["asks"][0]:
                return outputs, after
            memory = self.answered(memory, inputs["estimated_state"], now.time)

    def answered(self, memory: Arrays, state: np.ndarray, time: float) -> dict[str, np.ndarray]:
        """Return the memory before a sample that asks, with the plan from its measured state."""
        found = plan_anew(self, state, time, plans=int(memory["plans"][0]))
        if found is None:
            return {**memory, "answer": np.array([2.0])}
        return {**memory, "answer": np.array([1.0]), "plan": found}

    def motion(self, plan: np.ndarray) -> PlannedMotion:
        """The motion of a new plan [begin; duration; retreats; closed; q; v] from a state to rest,
        as a function of the time since its begin. Raises ScenarioError: no motion closes the chain,
        or no undriven coordinates follow it.
        """
        scenario, coordinates = self.mission.scenario, self.mission.craft.coordinates
        duration = float(plan[1])
        q, v = np.split(plan[4:].copy(), [len(coordinates.position_names)])
        goal = None if scenario.reference.goal == "stop" else scenario.target_posture
        if plan[2] and scenario.grasp_time > 0.0:
            goal = approach_posture(self.mission)
        motion = PolynomialMotion(
            coordinates=coordinates,
            start=posture_of(q, coordinates),
            target=goal,
            blend=Blend(Reference(), duration),
            base_rotation="eigenaxis",
            sample_time=scenario.sample_time,
            velocity=v,
        )
        if plan[2]:
            return floated(motion, self.mission)
        if self.chain is None:
            return followed(self.mission, self.nominal, motion)
        return self.chain.follow(motion, float(plan[0]) - self.block.grasp_time, float(plan[3]))

    def motions(self, plan: np.ndarray) -> list[PlannedMotion]:
        """``motion``, and the motion of a frame whose pose is prescribed."""
        motion = self.motion(plan)
        frame = make_frame_motion(self.mission, self.nominal, motion)
        return [motion] if frame is None else [motion, frame]

    def end(self, memory: Arrays) -> float:
        """The time (s) at which a new plan ends; 0: there is none; infinite: rates are damped."""
        if memory["mode"][0] == Mode.RATE_DAMPING:
            return np.inf
        return float(memory["plan"][:2].sum()) if memory["plan"][1] else 0.0

    def missed(self, memory: Arrays) -> Arrays:
        """Return the memory after a late hand has missed its place, for which it plans anew."""
        return {**memory, "missed": np.ones(1)}

    def share(self, plan: np.ndarray, most: np.ndarray) -> float:
        """The largest share of limits (nv) of force that a new plan takes; infinite: there is no
        such motion.
        """
        times = np.linspace(0.0, float(plan[1]), _INSTANTS)
        try:
            force = self.motion(plan).demand(self.block.model, times)[FORCE]
        except ScenarioError:
            return np.inf
        return float((np.abs(force) / most).max())


def plan_anew(
    supervisor: Supervisor, state: np.ndarray, time: float, *, plans: int
) -> np.ndarray | None:
    """Return a plan from the measured state after a number of others. If no plan is within its
    share of the limits: None, or with an empty gripper the plan with the least use of them, because
    rate damping would not hold joints with small inertia against the disturbance.
    """
    block, settings = supervisor.block, supervisor.mission.scenario.supervisor
    assert settings is not None
    most = settings.plan_share * settings.retry_factor**plans * block.limit
    retreats, duration = bool(block.modes(np.array(time), np.zeros(3))[1]), _SHORTEST
    least, gentlest = np.inf, None
    while duration <= _LONGEST:
        plan = np.concatenate([[time, duration, retreats, block.closed], state])
        share = supervisor.share(plan, most)
        if share <= 1.0:
            return plan
        if retreats and share < least:
            least, gentlest = share, plan
        duration *= _GROWTH
    return gentlest
