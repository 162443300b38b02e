"""Control laws in a closed chain.

Every law with time-delay estimation adds Hhat (u - q'') to its last force. In a chain, u has parts
that the constraints A v = 0 exclude, from any error of the kinematics: they add up as an internal
force that no tracking error shows. Here the law, whichever it is, works in velocities nu with v = S
nu, A S = 0, with the mass matrix S' H S; its force w is applied as the least tau with S' tau = w.
To it A' F is added, where F integrates the error of the wrench measured at the contacts.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from pydrake.multibody.tree import Frame
from scipy.linalg.lapack import dgesv, dposv

from ffsm_drake.common.choice import is_known
from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.common.products import applied, product, times
from ffsm_drake.common.so3 import cross_of
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Constraints
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import InternalForce, closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel, stacked
from ffsm_drake.spacecraft.plant import DRAKE_ERRORS, configuration, find_body
from ffsm_drake.systems.controllers.controller import OPTIONAL_OUTPUTS
from ffsm_drake.systems.controllers.law import ControlLaw, ReachingGain, Sample, State, WrappedLaw
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.setup import BlockSetup

_INTERNAL = "internal_force"
# Memory that others read or set for all velocities.
_OF_ALL = (*OPTIONAL_OUTPUTS, "delayed_desired_velocity", "delayed_velocity")
# Sections that give values by coordinate to a law.
_OF_A_LAW = ("controllers", "estimator", "sensing")


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
        # tau_d of the velocities that follow: (1 / W_d + D W_f D') tau_d = D W_f w, S = [1; D]
        across = self.calc_map(q)[1][..., following, :]
        weighted = across * self.share[free]
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class InternalControl:
    """Integral action on the wrenches at the contacts; F (..., m) is its force on the target."""

    gain: float  # times the sample time
    preload: np.ndarray  # (m)
    share: float
    target: Frame  # of its body
    # kg; centre of mass (3), m; inertia (3, 3) about the frame's origin, kg m^2; in its axes
    mass: np.ndarray
    center: np.ndarray
    inertia: np.ndarray

    def step(self, chain: Constraints, sample: Sample, force: np.ndarray) -> np.ndarray:
        """F at the next sample, of the nominal chain."""
        if sample.contact_wrench is None:
            return force
        measured, wanted = sample.contact_wrench, self.preload
        if not chain.is_spatial:
            measured = measured @ chain.wrench_map
        if self.share:
            load = self._load(chain, sample.q_d, sample.v_d, sample.a_d)
            wanted = wanted + self.share * load
        return force + self.gain * (wanted - measured)

    def _load(self, chain: Constraints, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The wrenches (..., m) that each contact alone would need to move the target."""
        if q.ndim > 1:
            return np.stack([self._load(chain, *one) for one in zip(q, v, a, strict=True)])
        model = chain.model
        motion, R = (
            model.calc_frame_motion(q, v, a, self.target),
            model.calc_frame_rotation(q, self.target),
        )
        w, alpha, linear = motion[7:10], motion[13:16], motion[16:19]
        p, inertia = R @ self.center, R @ self.inertia @ R.T
        force = self.mass * (linear + cross_of(alpha, p) + cross_of(w, cross_of(w, p)))
        moment = inertia @ alpha + cross_of(w, inertia @ w) + self.mass * cross_of(p, linear)
        wrenches = []
        for each in chain.closures:
            arm = model.calc_frame_pose(q, each.grasp)[4:] - motion[4:7]
            turn = model.calc_frame_rotation(q, each.grasp).T
            wrenches += [turn @ (moment - cross_of(arm, force)), turn @ force]
        return np.concatenate(wrenches) @ chain.wrench_map


@dataclasses.dataclass(frozen=True, kw_only=True)
class MinimalLaw(WrappedLaw):
    """A law in minimal velocities; its memory of all coordinates is zero for those that follow."""

    model: ChainModel
    internal: InternalControl | None

    @property
    def contacts_read(self) -> int:  # type: ignore[override]
        """All contacts that close loops, where their wrench is controlled."""
        return len(self.model.constraints.closures) if self.internal is not None else 0

    def initial_state(self) -> State:
        """The law's, and the force of the internal control."""
        internal = {_INTERNAL: np.zeros(self.model.constraints.size)} if self.internal else {}
        return {**self._padded(self.law.initial_state()), **internal}

    @property
    def reaching_gain(self) -> ReachingGain | None:
        """See ControlLaw: zero for velocities that follow."""
        own = self.law.reaching_gain
        if own is None:
            return None
        return ReachingGain(
            start=self._whole(own.start),
            largest=self._whole(own.largest),
            rate=None if own.rate is None else self._whole(own.rate),
            rest=lambda k_s: self._whole(own.rest(k_s[..., self.model.free])),
        )

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """One control sample; see ControlLaw."""
        free = self.model.free
        constraints, whole, _ = self.model.calc_map(sample.q)
        given = Sample(
            sample.q,
            sample.v[..., free],
            sample.q_d,
            sample.v_d[..., free],
            sample.a_d[..., free],
            sample.e[..., free],
            sample.e_dot[..., free],
            times(whole.mT, sample.applied_force),
            sample.is_first,
            None if sample.is_new is None else self._new(sample.is_new),
            sample.desired_frame,
        )
        own = {
            name: value[..., free] if name in _OF_ALL else value
            for name, value in state.items()
            if name != _INTERNAL
        }
        force, memory = self.law.step(given, own)
        least = self.model.calc_force(sample.q, force)
        if self.internal is None:
            return least, self._padded(memory)
        internal = self.internal.step(self.model.constraints, sample, state[_INTERNAL])
        # A' F on the joints takes F from the multipliers, which act on the hand
        force = least + times(constraints.mT, internal)
        return force, {**self._padded(memory), _INTERNAL: internal}

    def _new(self, is_new: np.ndarray) -> np.ndarray:
        positions, velocities = np.split(is_new, 2, axis=-1)
        free = self.model.free
        return np.concatenate([positions[..., free], velocities[..., free]], axis=-1)

    def _padded(self, memory: State) -> dict[str, np.ndarray]:
        found = dict(memory)
        for name in filter(found.__contains__, _OF_ALL):
            found[name] = self._whole(found[name])
        return found

    def _whole(self, values: np.ndarray) -> np.ndarray:
        """Values (..., nv) of all velocities from those of the minimal ones."""
        found = np.zeros_like(values, shape=(*values.shape[:-1], self.model.share.size))
        found[..., self.model.free] = values
        return found


def make_in_chain(setup: BlockSetup, make: Callable[[BlockSetup], Any]) -> ControlLaw:
    """The law of a scenario in its closed chain.

    Args:
      setup: the setup of the controller.
      make: makes the law for a setup.

    Raises:
      BlockError: the controller is not a control law, or needs the velocities of all joints.
      ScenarioError: a contact is compliant; see ClosedChain.
    """
    scenario, nominal = setup.scenario, setup.nominal
    for name, contact in closing_contacts(scenario, setup.grip).items():
        if contact.kind == "compliant":
            raise ScenarioError(
                f"contacts.{name}.kind",
                "compliant does not go with chain.law: minimal, which takes the chain for rigid; "
                "set chain.law: plain",
            )
    chain = ClosedChain(nominal, scenario, setup.grip, true=False)
    model = _minimal_model(setup.mission, chain)
    following = set(nominal.coordinates.names) - set(model.coordinates.names)
    own = dataclasses.replace(
        setup,
        nominal=model,
        mission=setup.mission.of(_without(scenario, following)),
        settings=_pruned(dict(setup.settings), following),
    )
    try:
        law = make(own)
    except BlockError as error:
        if isinstance(error.__cause__, ValueError):  # shapes
            raise _unfit(setup, "needs the velocities of all joints") from error
        raise
    if not (hasattr(law, "initial_state") and hasattr(law, "step")):
        raise _unfit(setup, "is a Drake system")
    _try(law, model, setup)
    given = scenario.chain.force
    return MinimalLaw(
        law=law,
        model=model,
        internal=None if given is None else _internal_control(given, scenario, chain),
    )


def _try(law: ControlLaw, model: ChainModel, setup: BlockSetup) -> None:
    """Raise BlockError for a law that does not work in fewer velocities than the tree has."""
    zero, q = np.zeros(len(model.coordinates.names)), model.plant.GetPositions(model.context)
    sample = Sample(q, zero, q, zero, zero, zero, zero, zero, is_first=True)
    try:
        force, _ = law.step(sample, law.initial_state())
        fits = np.shape(force) == zero.shape
    except (*DRAKE_ERRORS, AttributeError):
        fits = False
    if not fits:
        raise _unfit(setup, "needs the velocities of all joints")


def _unfit(setup: BlockSetup, reason: str) -> BlockError:
    return BlockError(
        f"controller '{setup.name}' {reason}, and cannot work in a closed chain's minimal "
        "velocities; take another one, or set chain.law: plain"
    )


def _internal_control(
    given: InternalForce, scenario: Scenario, chain: ClosedChain
) -> InternalControl:
    model = chain.model
    body = find_body(model.plant, scenario.payload.body, key="payload.body")
    inertia = body.CalcSpatialInertiaInBodyFrame(model.context)
    preload = np.tile(np.array(given.preload), len(chain.loops)) @ chain.constraints.wrench_map
    return InternalControl(
        gain=given.gain * scenario.sample_time,
        preload=preload,
        share=given.share,
        target=body.body_frame(),
        mass=np.array(inertia.get_mass()),
        center=inertia.get_com(),
        inertia=inertia.CalcRotationalInertia().CopyToFullMatrix3(),
    )


def _minimal_model(mission: Mission, chain: ClosedChain) -> ChainModel:
    """The minimal velocities: all but joints of the closing arms, chosen where the hands grasp so
    that the others move them the least.
    """
    scenario, tree = mission.scenario, chain.model
    if tree.grip.closed:  # where the last hand grasps
        time = scenario.grasp_time + tree.grip.closed
        q = make_motion(mission, tree.grip).evaluate(time)[0]
    else:
        q = configuration(tree.coordinates, scenario.initial_posture, key="initial_posture")
    q, following = chain.closed(q), list[int]()
    for loop in chain.loops:
        jacobian = loop.closure.jacobian(tree, q)[:, loop.joints]
        for _ in range(len(jacobian)):  # the longest column, and the rest across it
            longest = int(np.argmax(np.linalg.norm(jacobian, axis=0)))
            along = jacobian[:, longest] / np.linalg.norm(jacobian[:, longest])
            jacobian = jacobian - np.outer(along, along @ jacobian)
            following.append(int(loop.joints[longest]))
    coordinates, chosen = tree.coordinates, np.array(sorted(following))
    free = np.setdiff1d(np.arange(len(coordinates.names)), chosen)
    joints = free[NUM_BASE_VELOCITIES:] - NUM_BASE_VELOCITIES
    fewer = Coordinates(
        tuple(coordinates.joints[i] for i in joints),
        tuple(coordinates.joint_units[i] for i in joints),
        coordinates.undriven,
    )
    limit = coordinates.vector(
        scenario.actuation.limit or {}, key="actuation.limit", default=np.inf
    )
    largest = limit[np.isfinite(limit)].max(initial=1.0)
    return ChainModel(
        plant=tree.plant,
        context=tree.context,
        coordinates=fewer,
        split=tree.split,
        grip=tree.grip,
        constraints=chain.constraints,
        free=_as_slice(free),
        following=_as_slice(chosen),
        share=np.where(np.isfinite(limit), limit / largest, 1.0) ** 2,
    )


def _as_slice(indices: np.ndarray) -> Any:
    """Indices in a row as a slice, which takes a view; others unchanged."""
    first, last = int(indices[0]), int(indices[-1])
    return slice(first, last + 1) if last - first == indices.size - 1 else indices


def _without(scenario: Scenario, names: set[str]) -> Scenario:
    """The scenario without values of some coordinates in the sections of a law."""
    return dataclasses.replace(
        scenario, **{name: _pruned(getattr(scenario, name), names) for name in _OF_A_LAW}
    )


def _pruned(value: Any, names: set[str]) -> Any:
    """Settings without values of some coordinates."""
    if isinstance(value, Mapping):
        return {key: _pruned(each, names) for key, each in value.items() if key not in names}
    if dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value)]
        changes = {name: _pruned(getattr(value, name), names) for name in fields}
        return dataclasses.replace(value, **changes)  # type: ignore[type-var]
    return value
