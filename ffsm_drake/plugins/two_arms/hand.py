"""Hands that grasp after the first one (``contacts.NAME.closes``).

The loop before a closing has no force of the contact, and the law works in the tree. The closing is
a plastic impact on the moving stack,

    A H^-1 A' lambda = -A v,    v+ = v + H^-1 A' lambda,

of all rigid hands on the target from then on; the new one holds where it is. Jammed joints are rows
of A too, and keep their rates. The law goes on with its memory, in the velocities of the chain.

With a supervisor, a hand stays open while rates are damped, up to the end of a new plan. If it
misses its place, the supervisor plans anew from the measured state, and the hand closes where the
plan ends.
"""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Constraints
from ffsm_drake.plugins.two_arms.constraint_solve import solved
from ffsm_drake.plugins.two_arms.flow import (
    CLOSING,
    CLOSING_UNITS,
    GAP,
    LOSS,
    WRENCHES,
    ContactFlow,
)
from ffsm_drake.plugins.two_arms.following import samples_to
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Phase, Phases, Situation, Stop
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.scenario.contacts import ALL_HANDS, Grip, closing_contacts, closing_times
from ffsm_drake.spacecraft.coordinates import halves
from ffsm_drake.spacecraft.grasp import plastic_impact
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import find_body
from ffsm_drake.systems.registry import section_kind

_SUPERVISOR = "supervisor"
_BLOCK, _FORCE, _OTHER = "forces.contacts", "force_contacts", "force_disturbance"


def phases_of_later_hands(mission: Mission, before: Phases) -> Phases:
    """Return the phases of a mission, and one from each closing of a late hand to the next."""
    scenario = mission.scenario
    first, *times = closing_times(scenario)
    ends = [round(time / scenario.sample_time) for time in times]
    kinds = {
        name: dataclasses.replace(kind, until=ends[0], then=_outcome(times[0]))
        if isinstance(kind, Stop)
        else kind
        for name, kind in before.kinds.items()
    }
    following = [*zip(ends[1:], map(_outcome, times[1:]), strict=True), (None, "")]
    for closed_before, time, (until, then) in zip([first, *times], times, following, strict=False):
        kinds[_outcome(time)] = Hand(
            until=until, then=then, time=time, before=closed_before, mission=mission
        )
    complete = functools.partial(_complete, scenario)
    return dataclasses.replace(before, kinds=kinds, complete=complete)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hand(Stop):
    """A hand closes on the target, unless it is too far from its place."""

    time: float  # after the grasp, s
    before: float  # of the hands that have closed before
    mission: Mission

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        scenario, grip = self.mission.scenario, Grip(closed=self.time)
        at = f"t = {now.sample * scenario.sample_time:g} s"
        envelope = Envelope() if scenario.capture is None else scenario.capture.envelope
        if now.names[-1][0] == self._closes:
            memory, time = now.stage.memory(GRIPPER), now.sample * scenario.sample_time
            gripper, settings = now.stage.block(GRIPPER), scenario.closing
            status, how = gripper.lost(memory, time, now.stage.state, settings)
            missed = how and f"at {at} the target {how}"
        elif now.sample >= scenario.num_control_periods:
            return None, now.failing(MISSED, f"the hand of {self._name} is still open at {at}")
        elif (due := self._due(now)) > now.sample:
            return self._open(now, f"{self._name} waits", due), now
        else:
            lies = self._lies(now)
            status, how = MISSED, beyond(self.mission, now.stage.state, grip, envelope, lies)
            missed = how and f"the hand of {self._name} misses its place at {at}: {how}"
            if not missed and (closing := scenario.closing) is not None:
                end = now.sample + round(closing.duration / scenario.sample_time)
                return self._open(now, self._closes, end), now
        if not missed:
            return self._next(now, "stop", self.end(now), grip=grip, afresh=(_BLOCK,)), now
        tries = 1 + sum(name == self._again for name, _ in now.names)
        if scenario.supervisor is not None and tries < scenario.supervisor.tries:
            return self._open(now, self._again, now.sample + self._shortest(now)), now
        return None, now.failing(status, missed if tries == 1 else f"{missed}, in try {tries}")

    def end(self, now: Situation) -> int | None:
        """See Stop; at least one sample later."""
        if self.until is None:
            return None
        grasp = 0 if now.made is None else now.made.sample
        end = max(grasp + self.until, now.sample + 1)
        return min(end, self.mission.scenario.num_control_periods)

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Whether the hand has closed."""
        is_open = now.names[-1][0] in (self._again, f"{self._name} waits", self._closes)
        return (_outcome(self.time) if is_open else self.then), now

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """Close the hands of the phase, if it is not open."""
        payload = self.mission.scenario.payload.truth
        if now.made is not None:
            stage.carry(payload := now.made.payload)
        if phase.grip.closed != self.time:
            return self._enter_open(now, phase, stage)
        series = now.logs[-1].series
        work = series[LOSS][-1].item() if LOSS in series else 0.0
        flow = stage.block(_BLOCK).with_payload(payload)
        time = now.sample * self.mission.scenario.sample_time
        flow = flow.moved(_target(self.mission, flow.model), self._lies(now))
        flow, state = closed(flow, now.stage.state, work=work, time=time)
        stage.exchange(_BLOCK, flow)
        stage.place(state)
        stage.resume(now.stage, now.stage.desired, afresh=phase.afresh)
        return now

    @property
    def _name(self) -> str:
        contacts = self.mission.scenario.contacts.items()
        return next(f"contacts.{name}" for name, each in contacts if each.closes == self.time)

    @staticmethod
    def _lies(now: Situation) -> RigidTransform | None:
        """X_QP of the target that the first hand has met, see ``Constraints.moved``."""
        found: RigidTransform | None = getattr(now.made, "lies", None)
        return found

    @property
    def _again(self) -> str:
        """The name of the phases after a miss."""
        return f"{self._name} again"

    @property
    def _closes(self) -> str:
        """The name of the phases in which its jaws close."""
        return f"{self._name} closes"

    def _due(self, now: Situation) -> int:
        """The sample at which the hand closes, as far as is known."""
        scenario = self.mission.scenario
        if scenario.supervisor is None:
            return now.sample
        end = now.stage.block(_SUPERVISOR).end(now.stage.memory(_SUPERVISOR))
        if math.isinf(end):  # damping: no plan ends earlier
            return now.sample + self._shortest(now)
        return samples_to(end, scenario.sample_time)

    def _shortest(self, now: Situation) -> int:
        """The samples of the shortest plan."""
        shortest: float = now.stage.block(_SUPERVISOR).shortest
        return samples_to(shortest, self.mission.scenario.sample_time)

    def _next(self, now: Situation, name: str, until: int | None, **changes: Any) -> Phase:
        """A phase with the plan and the blocks of the last one, but for a gripper that closed."""
        blocks = {block: made for block, made in now.phase.blocks.items() if block != GRIPPER}
        if name == self._closes:
            part: Any = section_kind(GRIPPER)
            blocks[GRIPPER] = part.closing(self.mission.scenario, self.time)
        return dataclasses.replace(now.phase, names=((name, until),), blocks=blocks, **changes)

    def _open(self, now: Situation, name: str, until: int) -> Phase:
        """A phase with the hand open, up to a sample or the end of the run."""
        until = min(until, self.mission.scenario.num_control_periods)
        return self._next(now, name, until, grip=Grip(closed=self.before), afresh=(GRIPPER,))

    def _enter_open(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """The situation in an open phase; after a miss, the supervisor plans anew."""
        if closing_contacts(self.mission.scenario, phase.grip):
            stage.exchange(_BLOCK, now.stage.block(_BLOCK))
        now = super().enter(now, phase, stage)
        if phase.names[0][0] == self._closes:
            scenario = self.mission.scenario
            memory = stage.block(GRIPPER).begun(
                time=now.sample * scenario.sample_time,
                payload=scenario.payload.truth,
                state=stage.state,
                lies=self._lies(now),
            )
            stage.remember(GRIPPER, memory)
        if phase.names[0][0] == self._again:
            supervisor = stage.block(_SUPERVISOR)
            stage.remember(_SUPERVISOR, supervisor.missed(stage.memory(_SUPERVISOR)))
        return now


def _outcome(time: float) -> str:
    """The outcome that leads to the closing of a hand, ``time`` s after the grasp."""
    return f"hand {time:g}"


def closed(
    flow: ContactFlow, state: np.ndarray, *, work: float, time: float = 0.0
) -> tuple[ContactFlow, np.ndarray]:
    """The force after late hands have closed where they are, and the plant's own [q; v]; rigid ones
    close by a plastic impact.

    Args: the force of the hands, with their places; the state before; work of the closings
      before, J; time, s, at which joints are jammed or not.
    """
    (q, v), model, multipliers = halves(state), flow.model, np.zeros(flow.gains.shape[1])
    rows, H = flow.jacobian(q)[flow.rigid], model.calc_mass_matrix(q)
    joints = flow.held(np.array([time]))
    after, multipliers[flow.rigid] = _impact(H, rows, joints.T, v)
    momenta = list[np.ndarray]()
    for each in (v, after):
        model.plant.SetVelocities(model.context, each)
        momentum = model.plant.CalcSpatialMomentumInWorldAboutPoint(model.context, np.zeros(3))
        momenta.append(momentum.get_coeffs())
    figures = _miss(flow, state)
    for kind, wrench in (
        ("impulse", flow.wrench(multipliers)),
        ("momentum_change", momenta[1] - momenta[0]),
    ):
        angular, linear = _largest_of(wrench)
        figures |= {f"angular_{kind}": angular, f"linear_{kind}": linear}
    loss = 0.5 * float((v - after) @ H @ (v + after))
    ledger = np.array([*(figures[name] for name in CLOSING_UNITS), work - loss])
    return dataclasses.replace(flow.met(state), ledger=ledger), np.concatenate([q, after])


def _impact(
    H: np.ndarray, rows: np.ndarray, joints: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The velocity (nv) after a plastic impact, and the impulses (m) of constraints with ``rows``
    (m, nv); the rates of jammed ``joints`` (n, nv) do not change.
    """
    if not len(joints):
        return plastic_impact(H, rows, v)
    both = np.concatenate([rows, joints])
    inverse = np.linalg.solve(H, both.T)
    impulses = solved(both @ inverse, -np.concatenate([rows @ v, np.zeros(len(joints))]))
    return v + inverse @ impulses, impulses[: len(rows)]


def beyond(
    mission: Mission,
    state: np.ndarray,
    grip: Grip,
    envelope: Envelope,
    lies: RigidTransform | None = None,
) -> str:
    """See ``ClosedChains``; ``lies``: see ``Constraints.moved``."""
    model = mission.craft.flexible(grip)
    chain = ClosedChain(model, mission.scenario, grip, true=True)
    if not chain.loops:
        return ""
    miss = _miss(chain.constraints.moved(_target(mission, model), lies), state)
    return envelope.beyond(
        position=miss["distance"], angle=miss["angle"], velocity=miss["speed"],
        angular_velocity=miss["rate"],
    )  # fmt: skip


def _target(mission: Mission, model: PlantModel) -> Frame:
    """The frame of the target's body."""
    return find_body(model.plant, mission.scenario.payload.body, key="payload.body").body_frame()


def _miss(hands: Constraints, state: np.ndarray) -> dict[str, float]:
    """The largest distance of a hand from its place, and its motion there, at the plant's own
    [q; v]: ``angle`` (rad), ``distance`` (m), ``rate`` (rad/s), ``speed`` (m/s).
    """
    q, v = halves(state)
    gap, rate = hands.wrench(hands.gap(q)), hands.wrench(hands.jacobian(q) @ v)
    sizes = (*_largest_of(gap), *_largest_of(rate))
    return dict(zip(("angle", "distance", "rate", "speed"), sizes, strict=True))


def _largest_of(pairs: np.ndarray) -> list[float]:
    """The largest sizes of the first and of the second vectors (3) of pairs (6 each)."""
    found: list[float] = np.linalg.norm(pairs.reshape(-1, 2, 3), axis=2).max(axis=0).tolist()
    return found


def _complete(scenario: Scenario, logs: tuple[RunLog, ...]) -> tuple[RunLog, ...]:
    """The logs of the phases with the series of open hands, which are zero."""
    closing = closing_contacts(scenario, ALL_HANDS)
    names, last = list(closing), logs[-1]
    # of the hands that grasp at once, in phases before the first late one
    known = {name for log in logs if CLOSING not in log.series for name in log.series}

    def of_all(values: np.ndarray | None, count: int) -> np.ndarray:
        """Values (count, 6 for each contact) of all contacts, from those of the first to close."""
        found = np.zeros((count, len(closing), 6))
        if values is not None:
            first = sorted(names, key=lambda name: closing[name].closes)[: values.shape[1] // 6]
            found[:, sorted(map(names.index, first))] = values.reshape(count, -1, 6)
        return found.reshape(count, -1)

    def completed(log: RunLog) -> RunLog:
        series, count = dict(log.series), log.time.size
        for name in (WRENCHES, GAP):
            values = series.get(name)
            if values is None and name in known:  # before the grasp
                width = next(each.series[name].shape[1] for each in logs if name in each.series)
                values = np.full((count, width), np.nan)
            series[name] = of_all(values, count)
        for name in (CLOSING, LOSS, _FORCE, _OTHER):
            if name in last.series and name not in {*series, *known}:
                zeros = np.zeros((count, last.series[name].shape[1]))
                series[name] = series["disturbance_force"] if name == _OTHER else zeros
        return dataclasses.replace(log, series=series)

    return tuple(completed(log) for log in logs)
