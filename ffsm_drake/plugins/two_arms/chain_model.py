"""The nominal model of a closed chain for its control law.

The law works in velocities nu with v = S nu, A S = 0, with the mass matrix S' H S.
"""

import dataclasses
import functools
from typing import Any, ClassVar

import numpy as np
from pydrake.multibody.tree import Frame
from scipy.linalg.lapack import dgesv, dposv

from ffsm_drake.common.choice import is_known
from ffsm_drake.common.products import applied, product, times
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Constraints
from ffsm_drake.plugins.two_arms.internal import force_limits, squared_limits
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel, stacked
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.reference import make_motion


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChainModel(PlantModel):
    """The nominal plant in minimal velocities nu (n), v = S nu, on numbers or symbols.

    Configurations q (..., nq) are those of the tree; all else is along nu.
    """

    reduced: ClassVar[type]  # with H* and C*, see ``driven_model``
    constraints: Constraints  # of the tree
    free: Any  # indices of nu in v (n)
    following: Any  # indices of the other velocities (m)
    # (nv) squares of the force limits; the force is that of least tau^2 / share, summed
    share: np.ndarray

    @property
    def tree(self) -> PlantModel:
        """The plant without the loops."""
        return self.constraints.model

    @functools.cached_property
    def _kept(self) -> list[tuple[np.ndarray, ...]]:
        """The last configuration, with A, S and H there: used several times per sample."""
        return []

    def calc_map(self, q: np.ndarray) -> tuple[np.ndarray, ...]:
        """A (..., m, nv), S (..., nv, n) and H (..., nv, nv) in configurations q (..., nq)."""
        if not (self._kept and self._kept[0][0] is q):
            constraints = self._calc_constraints(q)
            whole = self.tree.calc_mass_matrix(q)
            self._kept[:] = [(q, constraints, self.map_of(constraints), whole)]
        return self._kept[0][1:]

    @stacked
    def _calc_constraints(self, q: np.ndarray) -> np.ndarray:
        found: np.ndarray = self.constraints.jacobian(q)
        return found

    def map_of(self, constraints: np.ndarray) -> np.ndarray:
        """S (..., nv, n) of A (..., m, nv)."""
        following, free = self.following, self.free
        count = len(self.coordinates.names)
        shape = (*constraints.shape[:-2], constraints.shape[-1], count)
        found = np.zeros_like(constraints, shape=shape)
        found[..., free, :] = np.eye(count)
        found[..., following, :] = -_across(constraints[..., following], constraints[..., free])
        return found

    def calc_tracking_errors(
        self, desired: np.ndarray, actual: np.ndarray, num_positions: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """See PlantModel; of states of the tree."""
        return self.tree.calc_tracking_errors(desired, actual, num_positions)

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """S' H S (..., n, n)."""
        _, whole, tree = self.calc_map(q)
        free, following = self.free, self.following
        # by blocks, S = [1; D]
        rows, across = tree[..., following, :], whole[..., following, :]
        mixed = rows[..., free].mT @ across
        found: np.ndarray = across.mT @ (rows[..., following] @ across)
        found += tree[..., free, :][..., free]
        found += mixed
        found += mixed.mT
        return found

    @stacked
    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """S' (C + H dS/dt nu) (..., n) for minimal velocities v (..., n)."""
        whole = self.calc_map(q)[1]
        return whole.T @ self.tree.calc_inverse_dynamics(q, *self._moved(q, v))

    def calc_jacobian(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel; (..., 6, n), the frame's twist is J nu."""
        return product(self.tree.calc_jacobian(q, frame, seen_from), self.calc_map(q)[1])

    @stacked
    def calc_bias_acceleration(
        self, q: np.ndarray, v: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel; at constant nu (..., n)."""
        (rates, drift), tree = self._moved(q, v), self.tree
        own = tree.calc_bias_acceleration(q, rates, frame, seen_from)
        return own + tree.calc_jacobian(q, frame, seen_from) @ drift

    def calc_frame_pose(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel."""
        return self.tree.calc_frame_pose(q, frame, seen_from)

    def calc_frame_rotation(self, q: np.ndarray, frame: Frame | str) -> np.ndarray:
        """See PlantModel."""
        return self.tree.calc_frame_rotation(q, frame)

    def calc_whole_velocity(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """See PlantModel."""
        return applied(self.calc_map(q)[1], v)

    def calc_force(self, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """The least tau (..., nv) with S' tau = w, of w (..., n)."""
        free, following = self.free, self.following
        # tau_d of the velocities that follow: (1 / W_d + D D' / W_f) tau_d = D w / W_f, S = [1; D]
        across = self.calc_map(q)[1][..., following, :]
        weighted = across / self.share[free]
        inner = weighted @ across.mT + self._softness
        driven = times(weighted, force)
        if driven.ndim == 1 and is_known(driven):
            taken = dposv(inner, driven)[1]  # faster on few numbers
        else:
            taken = np.linalg.solve(inner, driven[..., None])[..., 0]
        least = np.zeros_like(force, shape=(*force.shape[:-1], self.share.size))
        least[..., free] = force - times(across.mT, taken)
        least[..., following] = taken
        return least

    @functools.cached_property
    def _softness(self) -> np.ndarray:
        among = self.share[self.following]
        return np.eye(among.size) / among

    def _moved(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """S nu and dS/dt nu (nv), at q (nq) for nu (n)."""
        constraints, whole, _ = self.calc_map(q)
        rates = whole @ v
        drift = np.zeros_like(rates)
        drift[self.following] = -_across(
            constraints[:, self.following], self.constraints.bias(q, rates)
        )
        return rates, drift


@dataclasses.dataclass(frozen=True, kw_only=True)
class _ReducedChain(ReducedModel, ChainModel):
    """As ChainModel, of an underactuated plant."""


ChainModel.reduced = _ReducedChain


def _across(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """X with M X = B, of M (..., m, m) and B (m) or (..., m, n)."""
    if matrix.ndim > 2:
        return np.linalg.solve(matrix, right)
    if is_known(matrix):
        return dgesv(matrix, right)[2]  # faster on few numbers
    return matrix.T @ np.linalg.solve(matrix @ matrix.T, right)  # symbols are not exchanged


def minimal_model(mission: Mission, chain: ClosedChain) -> ChainModel:
    """The minimal velocities: all but joints of the closing arms, chosen where the hands grasp so
    that the others move them the least.
    """
    scenario, tree = mission.scenario, chain.model
    if tree.grip.closed:  # where the last hand grasps
        time = scenario.grasp_time + tree.grip.closed
        q = make_motion(mission, tree.grip).evaluate(time)[0]
    else:
        q = configuration(tree.coordinates, scenario.initial_posture, key="initial_posture")
    return model_at(scenario, chain, q)


def model_at(scenario: Scenario, chain: ClosedChain, q: np.ndarray) -> ChainModel:
    """The model in minimal velocities that are chosen near a configuration q (nq)."""
    tree = chain.model
    coordinates, chosen = tree.coordinates, np.sort(np.concatenate(chain.followers(q)))
    free = np.setdiff1d(np.arange(len(coordinates.names)), chosen)
    joints = free[NUM_BASE_VELOCITIES:] - NUM_BASE_VELOCITIES
    fewer = Coordinates(
        tuple(coordinates.joints[i] for i in joints),
        tuple(coordinates.joint_units[i] for i in joints),
        coordinates.undriven,
    )
    return ChainModel(
        plant=tree.plant,
        context=tree.context,
        coordinates=fewer,
        split=tree.split,
        grip=tree.grip,
        constraints=chain.constraints,
        free=_as_slice(free),
        following=_as_slice(chosen),
        share=squared_limits(force_limits(scenario, coordinates)),
    )


def _as_slice(indices: np.ndarray) -> Any:
    """Indices in a row as a slice, which takes a view; others unchanged."""
    first, last = int(indices[0]), int(indices[-1])
    return slice(first, last + 1) if last - first == indices.size - 1 else indices
