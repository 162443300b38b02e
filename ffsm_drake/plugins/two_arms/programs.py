"""A closed chain in many states at once, for optimization: its arms, rates, torques and wrenches.

The joints of the closing arms follow the others by inverse kinematics. Complex arrays carry a
derivative in their imaginary parts through it: one step of Newton from the real solution.
"""

import dataclasses

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.equations import equations, frames
from ffsm_drake.plugins.equations.models import TracedModel
from ffsm_drake.plugins.equations.tree import Place, Reader
from ffsm_drake.plugins.tape.arrays import inputs, traced
from ffsm_drake.plugins.tape.numbers import Tape
from ffsm_drake.plugins.tape.programs import Program
from ffsm_drake.plugins.two_arms.after_closing import from_last_closing
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Closure
from ffsm_drake.plugins.two_arms.closed_motion import ClosedMotion
from ffsm_drake.plugins.two_arms.internal import planned_control
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES as NUM_BASE
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.planned_motion import Path, PathMotion

_AT_ORIGIN = [1.0, *[0.0] * 6]  # pose of a base
_STEPS, _CLOSED, _LONGEST = 30, 1e-12, 0.3  # of Newton: number, gap at the end, largest step


class _Model(TracedModel):
    """A model with fewer operations for its inverse dynamics."""

    def calc_inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """See PlantModel."""
        return traced(equations.inverse_dynamics(self.tree, q, v, a, self.own))


class ChainPrograms:
    """The nominal chain of a mission; columns (n) are states, in the axes of the base."""

    begun = staticmethod(from_last_closing)  # the mission of a plan

    def __init__(self, mission: Mission) -> None:
        """Raises ScenarioError: a hand does not reach; NotCovered: parts of the model."""
        scenario, model = mission.scenario, mission.craft.nominal()
        self._mission, self._nominal = mission, model
        chain = ClosedChain(model, scenario, true=False)
        self._reader = reader = Reader(model.plant)
        own = reader.parameters(model.context)
        self._nv = nv = reader.tree.num_velocities
        tape = Tape()
        sizes = {"joints": nv - NUM_BASE, "v": nv, "a": nv}
        joints, v, a = (inputs(tape, name, (size,)) for name, size in sizes.items())
        q = np.concatenate([_AT_ORIGIN, joints])
        posed = tuple(self._placed(each) for each in chain.constraints.closures)
        on_symbols = _Model(
            plant=model.plant, context=model.context, coordinates=model.coordinates,
            own=own, tree=reader.tree.placed(own),
        )  # fmt: skip
        of = dataclasses.replace(chain.constraints, model=on_symbols, closures=posed)
        jacobian, self._size = of.jacobian(q)[:, NUM_BASE:], of.size
        gap = np.concatenate([self._gap(on_symbols, each, q) for each in posed])
        self._loops = Program(tape, [*gap, *jacobian.ravel()])
        self._bias = Program(tape, of.bias(q, v))
        control = planned_control(scenario, chain)
        control = dataclasses.replace(control, target=self._place(control.target))
        wrench = control.load(of, q, v, a) + control.preload
        force = on_symbols.calc_inverse_dynamics(q, v, a)
        force = np.concatenate([force[:NUM_BASE], force[NUM_BASE:] + wrench @ jacobian])
        self._forces = Program(tape, [*force, *of.wrench(wrench)])
        start = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
        self.start = chain.closed(start)
        self.following = np.sort(np.concatenate(chain.followers(self.start)))
        self.free = np.setdiff1d(np.arange(nv), self.following)
        self._known = (np.empty((0, 0)), np.empty((0, 0)))
        self.learn(self.start[NUM_BASE + 1 :, None])

    def along(self, path: Path) -> ClosedMotion:
        """The motion of the chain along a plan."""
        coordinates, period = self._nominal.coordinates, self._mission.scenario.sample_time
        motion = PathMotion(path, coordinates=coordinates, sample_time=period)
        return ClosedMotion(motion, self._mission, self._nominal)

    def follow(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints (nj, n) with the followers where the loops are closed, and the gaps (m, n).

        The followers' own values are ignored. Newton begins at the nearest known state.
        """
        free, own = self.free[NUM_BASE:] - NUM_BASE, self.following - NUM_BASE
        states, back = np.unique(joints[free].real, axis=1, return_inverse=True)
        known, theirs = self._known
        distances = ((states[:, :, None] - known[:, None]) ** 2).sum(axis=0)
        real = np.empty((len(joints), states.shape[1]))
        real[free], real[own] = states, theirs[:, distances.argmin(axis=1)]
        for _ in range(_STEPS):
            gap, jacobian = self._at(real)
            if np.abs(gap).max() < _CLOSED:
                break
            step = _solved(jacobian[:, own], -gap)
            step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=0), 1e-300))
            real[own] += step
        closed = np.abs(gap).max(axis=0) < 1e-9
        self._known = states[:, closed], real[own][:, closed]
        if not closed.any():
            self._known = known, theirs
        found = joints.copy()
        found[own] = real[own][:, back]
        if np.iscomplexobj(joints):
            gap, jacobian = self._at(found)
            found[own] += _solved(jacobian[:, own].real, -gap)
        return found, self._at(found)[0]

    def learn(self, joints: np.ndarray) -> None:
        """Begin Newton at given closed states (nj, n)."""
        free, own = self.free[NUM_BASE:] - NUM_BASE, self.following - NUM_BASE
        self._known = joints[free], joints[own]

    def move(
        self, joints: np.ndarray, v: np.ndarray, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocities and accelerations (nv, n) with those of the followers, which are ignored."""
        (_, jacobian), v, a, own = self._at(joints), v.copy(), a.copy(), self.following
        v[own] = a[own] = 0.0
        among = jacobian[:, own - NUM_BASE]
        v[own] = _solved(among, -np.einsum("mjn,jn->mn", jacobian, v[NUM_BASE:]))
        drift = np.array(
            np.broadcast_arrays(*self._bias.run({"joints": joints, "v": v}), v[0])[:-1]
        )
        a[own] = _solved(among, -np.einsum("mjn,jn->mn", jacobian, a[NUM_BASE:]) - drift)
        return v, a

    def forces(
        self, joints: np.ndarray, v: np.ndarray, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """tau (nv, n) of both arms, and the wrenches of the contacts on the target (6 each, n)."""
        found = self._forces.run({"joints": joints, "v": v, "a": a})
        every = np.array(np.broadcast_arrays(*found, v[0])[:-1])
        return every[: self._nv], every[self._nv :]

    def _at(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The gaps (m, n), and A (m, nj, n) of the joints."""
        made = self._loops.run({"joints": joints})
        every = np.array(np.broadcast_arrays(*made, joints[0])[:-1])
        gap, jacobian = np.split(every, [self._size])
        return gap, jacobian.reshape(self._size, len(joints), -1)

    def _place(self, frame: Frame) -> Place:
        return self._reader.place_of(frame)

    def _placed(self, closure: Closure) -> Closure:
        """A loop with the places of its frames."""
        hand, grasp = self._place(closure.hand), self._place(closure.grasp)
        return dataclasses.replace(closure, hand=hand, grasp=grasp)

    @staticmethod
    def _gap(model: TracedModel, closure: Closure, q: np.ndarray) -> np.ndarray:
        """As ``Closure.gap``, with the sine of the angle, which needs no choice of a sign."""
        (turn, place), (own, origin) = (
            frames.pose(model.tree, each, q) for each in (closure.hand, closure.grasp)
        )
        off = own.T @ turn @ matrix_of(closure.held[:4]).T
        sines = 0.5 * np.stack(
            [off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]
        )
        return closure.along(np.concatenate([sines, own.T @ (place - origin) - closure.held[4:]]))


def _solved(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions (m, n) for matrices (m, m, n)."""
    found: np.ndarray = np.linalg.solve(np.moveaxis(matrices, -1, 0), right.T[..., None])[..., 0].T
    return found
