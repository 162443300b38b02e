"""Rigid contacts that close loops, as pure functions on arrays for compiled runs."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.nominal import PlantModel, make_flexible_plant
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopFlow:
    """A loop; see ``chain.Loop``."""

    hand: Frame
    grasp: Frame
    rows: tuple[tuple[float, ...], ...]  # which are constants of the code
    turn: np.ndarray | None
    place: np.ndarray  # (3)
    gains: np.ndarray  # (2) of the correction, on the gap and on its rate


class _Seen:
    """A loop at a configuration q, and its A (r, nv)."""

    def __init__(self, loop: LoopFlow, model: PlantModel, q: Any) -> None:
        self.loop = loop
        poses = [model.calc_frame_pose(q, frame) for frame in (loop.grasp, loop.hand)]
        (self.grasp, origin), (self.hand, tip) = ((matrix_of(p[:4]), p[4:]) for p in poses)
        self.arm = tip - origin
        self.jacobians = [model.calc_jacobian(q, frame) for frame in (loop.grasp, loop.hand)]
        (turns, moves), (turns_hand, moves_hand) = (np.split(each, 2) for each in self.jacobians)
        across = np.cross(turns.T, self.arm).T
        down = self.grasp.T
        whole = [down @ (turns_hand - turns), down @ (moves_hand - moves - across)]
        jacobian = np.concatenate(whole)
        jacobian[:, :NUM_BASE_VELOCITIES] = 0.0  # was zero except for rounding
        self.jacobian = np.array(loop.rows) @ jacobian

    def bias(self, model: PlantModel, q: Any, v: Any) -> Any:
        """dA/dt v (r)."""
        frames, arm = (self.loop.grasp, self.loop.hand), self.arm
        (alpha, a), (alpha_hand, a_hand) = (
            np.split(model.calc_bias_acceleration(q, v, frame), 2) for frame in frames
        )
        (w, u), (w_hand, u_hand) = (np.split(each @ v, 2) for each in self.jacobians)
        around = np.cross(w, arm)
        turning = alpha_hand - alpha - np.cross(w, w_hand - w)
        moving = a_hand - a - np.cross(alpha, arm) - np.cross(w, around)
        moving = moving - 2.0 * np.cross(w, u_hand - u - around)
        down = self.grasp.T
        return np.array(self.loop.rows) @ np.concatenate([down @ turning, down @ moving])

    def gap(self) -> Any:
        """See ``ClosedChain.gap_of``."""
        down = self.grasp.T
        turn = down @ self.hand
        if self.loop.turn is not None:
            turn = turn @ self.loop.turn.T
        x = 0.5 * (turn.T - turn)[[1, 2, 0], [2, 0, 1]]
        sine = np.sqrt((x * x).sum())
        trace = turn[0, 0] + turn[1, 1] + turn[2, 2]
        factor = np.arctan2(sine, 0.5 * (trace - 1.0)) / np.maximum(sine, 1e-300)
        factor = np.where((sine < 1e-6) & (trace > 0.0), 1.0, factor)
        away = down @ self.arm - self.loop.place
        return np.array(self.loop.rows) @ np.concatenate([factor * x, away])


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactFlow(Continuous):
    """See ``contact.ContactForce``. Its input ``correction`` is held over a control sample."""

    model: PlantModel  # with the true payload
    loops: tuple[LoopFlow, ...]

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        nv = self.model.coordinates.num_velocities
        return {"state": 2 * nv + 1, "other_force": nv, "correction": self.num_corrections}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        shown = ("contact_wrench", "contact_gap", "measured_wrench")
        nv = self.model.coordinates.num_velocities
        return {"generalized_force": nv} | dict.fromkeys(shown, 6 * len(self.loops))

    @property
    def num_corrections(self) -> int:
        """Numbers of the correction."""
        return sum(len(loop.rows) for loop in self.loops)

    def correct(self, inputs: Arrays) -> Any:
        """Return the correction that is held from a control sample on, for the state then."""
        q, v = self._split(inputs)
        found = list[Any]()
        for loop in self.loops:
            seen = _Seen(loop, self.model, q)
            found.append(loop.gains[0] * seen.gap() + loop.gains[1] * (seen.jacobian @ v))
        return np.concatenate(found)

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        q, v = self._split(inputs)
        seen = [_Seen(loop, self.model, q) for loop in self.loops]
        A = np.concatenate([each.jacobian for each in seen])
        wanted = -np.concatenate([each.bias(self.model, q, v) for each in seen])
        free = self.model.calc_acceleration(q, v, inputs["other_force"])
        inner = A @ np.linalg.solve(self.model.calc_mass_matrix(q), A.T)
        found = np.linalg.solve(inner, wanted - inputs["correction"] - A @ free)
        ends = np.cumsum([len(loop.rows) for loop in self.loops])[:-1].tolist()
        each = zip(self.loops, np.split(found, ends), strict=True)
        wrench = np.concatenate([-(np.array(loop.rows).T @ own) for loop, own in each])
        gap = np.concatenate([np.array(own.loop.rows).T @ own.gap() for own in seen])
        return {
            "generalized_force": A.T @ found,
            "contact_wrench": wrench, "contact_gap": gap, "measured_wrench": wrench,
        }, {}  # fmt: skip

    def _split(self, inputs: Arrays) -> Any:
        state = inputs["state"]
        return np.split(state, [self.model.coordinates.num_positions])


def contact_flow(setup: BlockSetup) -> ContactFlow | None:
    """Return the contacts as pure functions. None: the chain has flexible parts, springs, noise or
    hands that close later.
    """
    closing = closing_contacts(setup.scenario, setup.grip)
    is_plain = all(
        each.kind == "rigid" and not (each.closes or each.moment_noise or each.force_noise)
        for each in closing.values()
    )
    model = make_flexible_plant(setup.scenario, setup.grip)
    if not is_plain or model.split.names:
        return None
    chain, h = ClosedChain(model.plant, setup.scenario, setup.grip, true=True), setup.sample_time
    loops = list[LoopFlow]()
    for loop in chain.loops:
        p = np.exp(-loop.contact.stabilization * h)
        loops.append(
            LoopFlow(
                hand=loop.hand,
                grasp=loop.grasp,
                rows=tuple(map(tuple, loop.rows.tolist())),
                turn=loop.turn,
                place=np.array(loop.place),
                gains=np.array([((1.0 - p) / h) ** 2, (1.0 - p) * (3.0 + p) / (2.0 * h)]),
            )
        )
    return ContactFlow(model=model, loops=tuple(loops))
