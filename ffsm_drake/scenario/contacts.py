"""The sections ``contacts`` and ``chain``: hands on one target, and the control of their closed
chain.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import ORIGIN, choice_of, sample_problems, unitless, vector_in
from ffsm_drake.scenario.model import NOTHING, Payload

CONTACT_KINDS = ("rigid", "compliant")
CHAIN_LAWS = ("minimal", "plain")
WRENCH = ("moment_x", "moment_y", "moment_z", "force_x", "force_y", "force_z")


@dataclass
class Friction:
    """Pads that hold the target by friction."""

    coefficient: float = setting(0.3, "1", "coefficient of friction", above=0, most=100)
    radius: float = setting(
        0.02, "m", "radius of the pad, a disc of uniform pressure", above=0, most=10
    )
    axis: list[float] = vector_in(
        [0.0, 0.0, 1.0],
        "",
        "direction from the pad into the target, in the axes of the hand's frame, of any length",
        nonzero=True,
    )
    squeeze: float = setting(
        0.0,
        "N",
        "force that closes two opposite pads of a gripper on the target; 0: one pad, which the "
        "hand presses on the target",
        least=0,
        most=1e6,
    )


@dataclass
class Contact:
    """A hand that holds the target.

    The model welds ``model.end_effector`` to the target. Every other contact closes a loop.
    """

    effector: str = unitless("servicer::end_effector", "scoped name of the hand's frame")
    frame: str = unitless(
        "debris::grasp",
        "scoped name of the target frame that coincides with the hand's frame",
    )
    kind: str = choice_of(
        "rigid",
        'kind of contact: "rigid": six constraints; "compliant": a spring and a damper between the '
        "frames",
        *CONTACT_KINDS,
    )
    closes: float = setting(
        0.0,
        "s",
        "time at which the hand grasps, after the start of the run or the grasp, a whole number of "
        "control samples; with capture.closing, its jaws begin to close then; 0: with the first "
        "hand",
        least=0,
    )
    stabilization: float = setting(
        50.0,
        "1/s",
        "rate at which a gap of a rigid contact decays (Baumgarte)",
        least=0,
    )
    stiffness: float = setting(
        2e4, "N/m", "translational stiffness of a compliant contact", above=0
    )
    damping: float = setting(
        200.0, "N s/m", "translational damping of a compliant contact", least=0
    )
    rotational_stiffness: float = setting(
        500.0, "N m/rad", "rotational stiffness of a compliant contact", above=0
    )
    rotational_damping: float = setting(
        5.0, "N m s/rad", "rotational damping of a compliant contact", least=0
    )
    force_noise: float = setting(
        0.0,
        "N",
        "standard deviation per sample of the force measured at the wrist",
        least=0,
    )
    moment_noise: float = setting(
        0.0,
        "N m",
        "standard deviation per sample of the moment measured at the wrist",
        least=0,
    )
    force_limit: float | None = setting(
        None, "N", "largest force along an axis that a run should not exceed; null: none", above=0
    )
    moment_limit: float | None = setting(
        None,
        "N m",
        "largest moment about an axis that a run should not exceed; null: none",
        above=0,
    )
    friction: Friction | None = unitless(
        None, "friction that must hold the hand on the target; null: nothing slips"
    )
    position_error: list[float] = vector_in(
        ORIGIN,
        "m",
        "calibration error: true position of the hand's frame in the target frame; the controller "
        "assumes 0",
    )
    rotation_error: list[float] = vector_in(
        ORIGIN,
        "rad",
        "calibration error: true rotation vector from the target frame to the hand's frame; the "
        "controller assumes 0",
    )


@dataclass(frozen=True)
class Grip:
    """What holds the target in a phase of a mission."""

    holds: bool = True  # whether the target is in the gripper
    # s after the grasp; the hands that closed up to then hold the target. None: as 0, but a planned
    # motion is the motion of the whole mission
    closed: float | None = 0.0

    def carried(self, payload: Payload) -> Payload:
        """The payload in the gripper: the given one, or nothing."""
        return payload if self.holds else replace(payload, truth=NOTHING, nominal=NOTHING)

    def closes(self, contact: Contact) -> bool:
        """Whether a hand has closed on the target."""
        return self.holds and contact.closes <= (self.closed or 0.0)


HELD, EMPTY = Grip(), Grip(holds=False)
WHOLE, ALL_HANDS = Grip(closed=None), Grip(closed=math.inf)


@dataclass
class InternalForce:
    """Integral control of the wrench in contacts that close a loop, measured at their wrists."""

    gain: float = setting(5.0, "1/s", "gain on the integral of the error of the wrench", least=0)
    share: float | None = unitless(
        None,
        "share of the force and moment that move the nominal target, which these contacts carry; "
        "null: by the joints' ``actuation.limit``, or 0 if no joint has one",
        least=0,
        most=1,
    )
    preload: list[float] | None = setting(
        [0.0] * 6,
        "N m, N",
        "desired moment and force on the target in addition to ``share``, in the axes of its "
        "frame; null: the least with which no hand slips (``friction``) in the planned motion",
        size=6,
    )


@dataclass
class Chain:
    """The control law in the closed chain of several ``contacts``."""

    law: str = choice_of(
        "minimal",
        'coordinates of the law: "minimal": the independent velocities of the chain, which the '
        'others follow; "plain": all coordinates, as for an open chain, so the internal force '
        "grows with any calibration error",
        *CHAIN_LAWS,
    )
    force: InternalForce | None = unitless(
        InternalForce(), "control of the internal force, only for minimal; null: none"
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check the contacts and the preload: names, hands and unsupported combinations."""
        if not scenario.contacts:
            return
        preload = [] if self.force is None else self.force.preload
        if preload is None and not any(each.friction for each in scenario.contacts.values()):
            yield f"{key}.force.preload", "null needs contacts.NAME.friction; add it, or give one"
        if self.law == "plain" and (preload is None or any(preload)):
            yield f"{key}.force.preload", "has no effect with chain.law: plain; remove it"
        yield from _of_hands(scenario)
        yield from _of_late_hands(scenario)


def _of_hands(scenario: Any) -> Problems:
    """Check the names and hands of contacts; the model welds one of the hands."""
    contacts: dict[str, Contact] = scenario.contacts
    seen: dict[str, str] = {}  # hand -> contact
    for name, contact in contacts.items():
        key, hand = f"contacts.{name}", contact.effector
        if not name.isidentifier():
            yield key, "must be a name of letters, digits and underscores"
        if hand in seen:
            problem = f"'{hand}' is also the hand of '{seen[hand]}'; name another hand"
            yield f"{key}.effector", problem
        if len(contacts) < 2 and any((contact.friction, contact.force_limit, contact.moment_limit)):
            yield key, "has friction or a limit, which needs a second contact; remove it"
        seen.setdefault(hand, name)
    welded = scenario.model.end_effector
    if welded not in seen:
        problem = f"no contact has model.end_effector, {welded}, as its effector; add one"
        yield "contacts", problem
        return
    carrying = contacts[seen[welded]]
    if carrying.kind != "rigid":
        yield f"contacts.{seen[welded]}.kind", "must be rigid, because the model welds this hand"
    elif scenario.model.servicer and carrying.frame != scenario.model.grasp:
        yield f"contacts.{seen[welded]}.frame", f"must be model.grasp ({scenario.model.grasp})"


def _of_late_hands(scenario: Any) -> Problems:
    """Check the hands that grasp during the run, and what is not compatible with them."""
    contacts: dict[str, Contact] = scenario.contacts
    late = {name: contact for name, contact in contacts.items() if contact.closes}
    for name, contact in (contacts if scenario.approach else late).items():
        for error in ("position_error", "rotation_error"):
            if any(getattr(contact, error)):
                key = f"contacts.{name}.{error}"
                yield key, "has no effect on a hand that grasps during the run; remove it"
    for name, contact in late.items():
        key = f"contacts.{name}.closes"
        yield from sample_problems(contact.closes, scenario.sample_time, key)
        if contact.effector == scenario.model.end_effector:
            yield key, "must be 0, because the model welds this hand"
        lasts = scenario.closing.duration if scenario.closing else 0.0  # of its jaws
        if scenario.grasp_time + contact.closes + lasts > scenario.duration - scenario.sample_time:
            yield key, f"must leave time to grasp before the run ends at {scenario.duration:g} s"
    for key, problem, change in (
        ("blocks.reference", scenario.blocks.reference, "remove it"),
        ("blocks.forces.contacts", "contacts" in scenario.blocks.forces, "rename it"),
    ):
        if late and problem:
            yield key, f"is not compatible with contacts.{next(iter(late))}.closes; {change}"


def closing_times(scenario: Any) -> list[float]:
    """Times after the start or the grasp at which hands grasp, s, in their order; 0 first."""
    return sorted({0.0, *(each.closes for each in scenario.contacts.values())})


def closing_contacts(scenario: Any, grip: Grip = HELD) -> dict[str, Contact]:
    """Return the contacts that close a loop in a phase, without the weld."""
    return {
        name: contact
        for name, contact in scenario.contacts.items()
        if contact.effector != scenario.model.end_effector and grip.closes(contact)
    }
