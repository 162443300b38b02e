"""The wrenches of hands and the torques of joints along a motion of the chain."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import matrix_of, skew
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.flow import FRICTION, WELD, WRENCHES
from ffsm_drake.plugins.two_arms.friction import Cone, Hand, least_preload
from ffsm_drake.plugins.two_arms.internal import InternalControl, planned_control
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.scenario.contacts import ALL_HANDS, Contact, closing_contacts, closing_times
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import find_frame
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion

SOON = 1e-9  # s; rounding of times
_INSTANTS = 101  # of a motion, for the least preload
_PRELOAD = "preload"  # (6 for each contact that closes a loop), of a motion


class Loads:
    """What the hands of a chain carry along a motion, as ``chain.force`` has it."""

    def __init__(
        self, scenario: Scenario, nominal: PlantModel, begins: Mapping[float, float]
    ) -> None:
        """Args: the scenario; the plant with the nominal payload; by the time ``closes`` of hands
        the time of the motion at which they close, s, in this order.
        """
        self._scenario, self._nominal = scenario, nominal
        self._closed, self._begins = list(begins), np.array(list(begins.values()))
        self._stages = dict[int, tuple[ClosedChain, InternalControl]]()

    def shared(
        self,
        motion: PlannedMotion,
        times: np.ndarray,
        found: dict[str, np.ndarray],
        state: Sequence[np.ndarray],
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion; at times of the motion (n,), s."""
        scenario, (q, v, a) = self._scenario, state
        names, force = list(closing_contacts(scenario, ALL_HANDS)), found[FORCE].copy()
        cones, weld = cones_of(scenario), weld_of(scenario)
        wrench, preload = np.zeros((2, times.size, 6 * len(names)))
        own_wrench, used = np.zeros((times.size, 6)), np.zeros((times.size, len(cones)))
        begun = np.searchsorted(self._begins, times + SOON, side="right") - 1
        for k in np.unique(begun[begun >= 0]).tolist():
            chain, control = self._stage(k, motion)
            own, of = begun == k, chain.constraints
            if chain.loops:
                jacobians = np.array([of.jacobian(each) for each in q[own]])
                control.check_preload(chain.model, jacobians)
                wanted = control.load(of, q[own], v[own], a[own]) + control.preload
                force[own] += [A.T @ one for A, one in zip(jacobians, wanted, strict=True)]
            for hand in self._hands(chain, control, q[own], v[own], a[own]):
                values = hand.wrench(control.preload)
                if hand.cone is not None:
                    used[own, list(cones).index(hand.name)] = hand.cone.used(values)
                if hand.name == weld:
                    own_wrench[own] = values
                    continue
                places = np.ix_(own, 6 * names.index(hand.name) + np.arange(6))
                wrench[places], preload[places] = values, hand.map @ control.preload
        found = found | {FORCE: force, WRENCHES: wrench}
        if scenario.chain.force is not None and scenario.chain.force.preload is None:
            found |= {_PRELOAD: preload}
        judged = {WELD: own_wrench} if is_judged(scenario.contacts[weld]) else {}
        return found | judged | ({FRICTION: used} if cones else {})

    def _stage(self, k: int, motion: PlannedMotion) -> tuple[ClosedChain, InternalControl]:
        """The chain of the hands that have closed up to the k-th time, and its internal control."""
        if k not in self._stages:
            scenario = self._scenario
            grip = Grip(closed=self._closed[k])
            chain = ClosedChain(self._nominal, scenario, grip, true=False)
            control = planned_control(scenario, chain)
            if chain.loops and control.is_least:
                begin = max(self._begins[k], motion.begin)
                end = min([motion.end, *self._begins[self._begins > begin]])
                preload = self._least(
                    chain, control, motion, np.linspace(begin, max(begin, end), _INSTANTS)
                )
                control = dataclasses.replace(control, preload=preload)
            self._stages[k] = chain, control
        return self._stages[k]

    def _least(
        self, chain: ClosedChain, control: InternalControl, motion: PlannedMotion, times: np.ndarray
    ) -> np.ndarray:
        """The least preload (m) at times (n,), s, of a motion."""
        q, v, a = motion.evaluate(times)
        jacobians = np.array([chain.jacobian(each) for each in q])
        load = control.load(chain.constraints, q, v, a)
        torque = chain.model.calc_tracking_force(q, v, a)
        torque = torque + (load[:, None] @ jacobians)[:, 0]
        return least_preload(
            list(self._hands(chain, control, q, v, a)),
            torque,
            jacobians,
            control.limit,
            share=1.0 - self._scenario.reference.reserve,
        )

    def _hands(
        self,
        chain: ClosedChain,
        control: InternalControl,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
    ) -> list[Hand]:
        """The hands that hold the target in a motion (n, ...)."""
        contacts, of, model = self._scenario.contacts, chain.constraints, chain.model
        hands, cones = list[Hand](), cones_of(self._scenario)
        if chain.loops:
            loads = control.load(of, q, v, a) @ of.wrench_map.T
            for k, loop in enumerate(chain.loops):
                rows = slice(6 * k, 6 * k + 6)
                hands.append(
                    Hand(
                        name=loop.name,
                        load=loads[:, rows],
                        map=of.wrench_map[rows],
                        cone=cones.get(loop.name),
                        limit=_limit(loop.contact),
                    )
                )
        weld = weld_of(self._scenario)
        if not is_judged(contacts[weld]):
            return hands
        place = find_frame(model.plant, contacts[weld].frame, key=f"contacts.{weld}.frame")
        load = np.array(
            [control.whole_load(model, *one, [place]) for one in zip(q, v, a, strict=True)]
        )
        own = np.zeros((6, of.size))
        for hand, loop in zip(hands, chain.loops, strict=True):
            to_weld = moved(model, q[0], loop.closure.grasp, place)
            load, own = load - hand.load @ to_weld.T, own - to_weld @ hand.map
        cone, limit = cones.get(weld), _limit(contacts[weld])
        return [*hands, Hand(name=weld, load=load, map=own, cone=cone, limit=limit)]


def moved(model: PlantModel, q: np.ndarray, place: Frame, other: Frame) -> np.ndarray:
    """X (6, 6) from a wrench at a place to the same wrench at another one of the body."""
    pose = model.calc_frame_pose(q, place, other)
    R = matrix_of(pose[:4])
    return np.block([[R, skew(pose[4:]) @ R], [np.zeros((3, 3)), R]])


def _limit(contact: Contact) -> np.ndarray:
    """The limits (6) of a contact, N m and N; infinite: none."""
    given = (contact.moment_limit, contact.force_limit)
    return np.repeat([np.inf if each is None else each for each in given], 3)


def cones_of(scenario: Scenario) -> dict[str, Cone]:
    """The friction of the hands that have one."""
    contacts = scenario.contacts.items()
    return {name: Cone.of(each.friction) for name, each in contacts if each.friction is not None}


def weld_of(scenario: Scenario) -> str:
    """The name of the contact that the model welds."""
    closing = closing_contacts(scenario, ALL_HANDS)
    return next(name for name in scenario.contacts if name not in closing)


def is_judged(contact: Contact) -> bool:
    """Whether a contact has a limit or friction."""
    return any((contact.friction, contact.force_limit, contact.moment_limit))


def preloaded(mission: Mission, chain: ClosedChain, control: InternalControl) -> InternalControl:
    """The control with the preload of its mission, in the phase of a chain.

    Raises ScenarioError: with no preload the hands hold the target.
    """
    if not control.is_least or not chain.loops:
        return control
    scenario, motion = mission.scenario, make_motion(mission)
    closed = chain.model.grip.closed or 0.0
    begin = scenario.grasp_time + closed
    later = [scenario.grasp_time + each for each in closing_times(scenario) if each > closed]
    times = np.linspace(begin, max(begin, min([motion.end, *later])), _INSTANTS)
    found = motion.demand(mission.craft.nominal(), times[:-1] if later else times)
    used = found.get(FRICTION, np.zeros((1, 1)))
    k, hand = np.unravel_index(int(used.argmax()), used.shape)
    if used[k, hand] > 1.0:
        raise ScenarioError(
            "chain.force.preload",
            f"null: {list(cones_of(scenario))[hand]} slips with any preload within the limits: "
            f"{used[k, hand]:.3g} times its friction at t = {times[k]:.3g} s; slow the motion, or "
            "give more friction",
        )
    hands = list(closing_contacts(scenario, ALL_HANDS))
    rows = [6 * hands.index(loop.name) + np.arange(6) for loop in chain.loops]
    preload = found[_PRELOAD][0][np.concatenate(rows)] @ chain.constraints.wrench_map
    return dataclasses.replace(control, preload=preload)
