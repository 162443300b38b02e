"""The force of contacts that close loops, as pure functions on arrays."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.registrations import Registry
from ffsm_drake.loop.blocks import JAM, WRENCH
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Constraints
from ffsm_drake.plugins.two_arms.constraint_solve import solved
from ffsm_drake.scenario import MassProperties
from ffsm_drake.scenario.contacts import Contact
from ffsm_drake.spacecraft.coordinates import halves
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup

WRENCHES, GAP = "contact_wrench", "contact_gap"
WELD, FRICTION = "weld_wrench", "contact_friction"
CLOSING, LOSS = "contact_closing", "contact_loss"  # where late hands grasp
CLOSING_UNITS = {
    "linear_impulse": "N s",
    "angular_impulse": "N m s",
    "linear_momentum_change": "N s",
    "angular_momentum_change": "N m s",
    "angle": "rad",
    "distance": "m",
    "rate": "rad/s",
    "speed": "m/s",
}

# "jam": the joints that jam; None: none does
JAMMED_JOINTS = Registry[Callable[[BlockSetup], Any]]("jammed_joints")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactFlow(Constraints, Continuous):
    """The force of the contacts.

    A rigid contact holds A v = 0: its multipliers solve A H^-1 (f + A' lambda) = -(dA/dt v + c), f
    being all other forces. The correction c of a sample is k_1 gap + k_2 A v at its beginning; both
    decay with exp(-w t), w being its ``stabilization``. A correction of each stage would take the
    stages' own gaps, O(h^2), for errors. A compliant contact gives lambda = -(K gap + D A v).

    Jammed joints are further rows of the same equations, whose multipliers are ``jam_force``. If
    rows depend on each other, since the joints that are left cannot move the loop, the later ones
    of the jams have no force.
    """

    # its model has flexible parts and the true payload
    craft: Craft
    rigid: np.ndarray  # (r) constraints of rigid contacts
    soft: np.ndarray  # (s) and of compliant ones
    gains: np.ndarray  # (2, m) of the correction, on the gap and on its rate
    stiffness: np.ndarray  # (s, m) K
    damping: np.ndarray  # (s, m) D
    jammed: Any  # faults.jam.Jammed; None: no joint jams
    # the latest closing of late hands, as ``CLOSING_UNITS``, and the work of all, J; none: empty
    ledger: np.ndarray

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        nv, hidden = self.model.coordinates.num_velocities, len(self.model.split.names)
        sizes = {"state": 2 * nv + 1, "hidden_state": 2 * hidden, "other_force": nv + hidden}
        sizes |= {"correction": self.rigid.size, "time": int(self.jammed is not None)}
        return {name: size for name, size in sizes.items() if size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        nv, hidden = self.model.coordinates.num_velocities, len(self.model.split.names)
        shown = dict.fromkeys((WRENCHES, GAP, WRENCH), 6 * len(self.closures))
        shown |= {"hidden_force": hidden} if hidden else {}
        late = {CLOSING: self.ledger.size - 1, LOSS: 1} if self.ledger.size else {}
        late |= {} if self.jammed is None else {JAM: nv}
        return {"generalized_force": nv, **shown, **late}

    def with_payload(self, properties: MassProperties) -> "ContactFlow":
        """See InstantSystem."""
        return dataclasses.replace(self, model=self.craft.loaded(self.model, properties))

    def met(self, state: np.ndarray) -> "ContactFlow":
        """The force that holds the hands where they are at the plant's own [q; v]."""
        q = halves(state)[0]
        closures = tuple(each.met(self.model, q) for each in self.closures)
        return dataclasses.replace(self, closures=closures)

    def correct(self, inputs: Arrays) -> Any:
        """See Continuous."""
        q, v = self._split(inputs)
        found = self.gains[0] * self.gap(q) + self.gains[1] * (self.jacobian(q) @ v)
        return found[self.rigid]

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        split, (q, v) = self.model.split, self._split(inputs)
        A, gap = self.jacobian(q), self.gap(q)
        force, multipliers = inputs["other_force"], 0.0 * gap
        if self.soft.size:
            multipliers[self.soft] = -(self.stiffness @ gap + self.damping @ (A @ v))
            force = force + multipliers @ A
        multipliers[self.rigid], jam = self._solved(inputs, A, force)
        wrench = -self.wrench(multipliers)  # on the target
        force = multipliers @ A
        return {
            "generalized_force": split.known_velocities(force), "hidden_force": force[split.hidden],
            WRENCHES: wrench, GAP: self.wrench(gap), WRENCH: wrench,
            CLOSING: self.ledger[:-1], LOSS: self.ledger[-1:], JAM: split.known_velocities(jam),
        }, {}  # fmt: skip

    def _solved(self, inputs: Arrays, A: Any, force: Any) -> tuple[Any, Any]:
        """Multipliers of rigid contacts, and the force (plant's nv) on jammed joints.

        Args: also A (m, nv), and all other forces (nv).
        """
        (q, v), size, wanted = self._split(inputs), self.rigid.size, A[:0, 0]
        if size:
            wanted = -(self.bias(q, v)[self.rigid] + inputs["correction"])
        joints = self.held(inputs.get("time"))
        rows = np.concatenate([A[self.rigid], joints.T])
        if not len(rows):
            return wanted, 0.0 * v
        if len(rows) > size:
            wanted = np.concatenate([wanted, self.jammed.stop(joints.T @ v)])
        wanted = wanted - rows @ self.model.calc_acceleration(q, v, force)
        inner = rows @ np.linalg.solve(self.model.calc_mass_matrix(q), rows.T)
        found = (np.linalg.solve if len(rows) == size else solved)(inner, wanted)
        return found[:size], joints @ found[size:]

    def held(self, time: Any) -> Any:
        """J' (plant's nv, n) of joints that may be jammed at a time (1), s; zero if one is not."""
        if self.jammed is None:
            nv = self.model.coordinates.num_velocities + len(self.model.split.names)
            return np.zeros((nv, 0))
        joints, are_held = self.jammed.at(time)
        return joints * np.where(are_held, 1.0, 0.0)

    def _split(self, inputs: Arrays) -> Any:
        """The plant's own q and v."""
        whole = self.model.split.whole(inputs["state"], inputs.get("hidden_state"))
        return halves(whole)


def contact_flow(setup: BlockSetup) -> ContactFlow:
    """Return the force of the contacts that close loops. Raises the errors of ``ClosedChain``."""
    from scipy.linalg import block_diag  # slow to import

    model, h = setup.craft.flexible(setup.grip), setup.sample_time
    chain = ClosedChain(model, setup.scenario, setup.grip, true=True)
    loops = chain.loops
    rows = [np.array(loop.closure.rows) for loop in loops]

    def along(gains: Callable[[Contact], list[float]]) -> np.ndarray:
        """A diagonal in all directions (6) of each contact, along the constraints (m, m)."""
        pairs = zip(loops, rows, strict=True)
        return block_diag(*(of @ np.diag(gains(loop.contact)) @ of.T for loop, of in pairs))

    def of_constraints(values: list[Any]) -> np.ndarray:
        return np.repeat(values, [len(of) for of in rows])

    # both poles of x'' = -(k_1 x + k_2 x'), held for h
    p = np.exp(-h * of_constraints([loop.contact.stabilization for loop in loops]))
    is_rigid = of_constraints([loop.contact.kind == "rigid" for loop in loops])
    return ContactFlow(
        model=model,
        craft=setup.craft,
        closures=chain.constraints.closures,
        rigid=np.flatnonzero(is_rigid),
        soft=np.flatnonzero(~is_rigid),
        gains=np.array([((1.0 - p) / h) ** 2, (1.0 - p) * (3.0 + p) / (2.0 * h)]),
        stiffness=along(_stiffness)[~is_rigid],
        damping=along(_damping)[~is_rigid],
        jammed=_jammed(setup),
        ledger=np.zeros((len(CLOSING_UNITS) + 1) * any(loop.contact.closes for loop in loops)),
    )


def _jammed(setup: BlockSetup) -> Any:
    """The joints that jam; None if none does."""
    found = JAMMED_JOINTS.find("jam")
    return None if found is None else found(setup)


def _stiffness(contact: Contact) -> list[float]:
    return [contact.rotational_stiffness] * 3 + [contact.stiffness] * 3


def _damping(contact: Contact) -> list[float]:
    return [contact.rotational_damping] * 3 + [contact.damping] * 3
