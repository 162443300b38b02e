"""Control laws in a closed chain.

Every law with time-delay estimation adds Hhat (u - q'') to its last force. In a chain, u has parts
that the constraints A v = 0 exclude, from any error of the kinematics: they add up as an internal
force that no tracking error shows. Here the law, whichever it is, works in velocities nu with v = S
nu, A S = 0, with the mass matrix S' H S; its force w is applied as the least tau with S' tau = w.
To it A' F is added, where F integrates the error of the wrench measured at the contacts.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.common.products import times
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.chain_model import ChainModel, minimal_model
from ffsm_drake.plugins.two_arms.internal import InternalControl, internal_control
from ffsm_drake.plugins.two_arms.loads import preloaded
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.free_floating import driven_model, whole_model
from ffsm_drake.spacecraft.plant import DRAKE_ERRORS
from ffsm_drake.systems.controllers.controller import OPTIONAL_OUTPUTS
from ffsm_drake.systems.controllers.law import ControlLaw, ReachingGain, Sample, State, WrappedLaw
from ffsm_drake.systems.setup import BlockSetup

_INTERNAL = "internal_force"
# Memory that others read or set for all velocities.
_OF_ALL = (*OPTIONAL_OUTPUTS, "delayed_desired_velocity", "delayed_velocity")
# Sections that give values by coordinate to a law.
_OF_A_LAW = ("controllers", "estimator", "sensing")


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
        internal = {_INTERNAL: self.internal.start} if self.internal else {}
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
    chain = ClosedChain(whole_model(nominal), scenario, setup.grip, true=False)
    model = minimal_model(setup.mission, chain)
    following = set(nominal.coordinates.names) - set(model.coordinates.names)
    own = dataclasses.replace(
        setup,
        nominal=driven_model(model),
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
    internal, given = None, scenario.chain.force
    if given is not None:
        control = internal_control(given, scenario, chain)
        internal = preloaded(setup.mission, chain, control)
    return MinimalLaw(law=law, model=model, internal=internal)


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
