"""What the supervisor needs of a closed chain: its internal force, and plans that close it.

Rate damping adds no internal force: tau = -sigma kappa Hhat v gives A Hhat^-1 tau = -sigma kappa A
v = 0. But the law starts anew and forgets F, the integral of ``laws.InternalControl``. The
supervisor keeps a wrench K, and adds A' K to the law's command, which has F_0 at its start, and A'
(K + F_0) to its own. Where damping begins, K + F_0 grows by the wrench that the last command tau,
within the limits, brings about at rest,

    (A Hhat^-1 A')^-1 A Hhat^-1 tau.

While the law starts anew at every sample, its command is tau + A' F, with the F of one sample. tau
is the least with S' tau = w, hence A D tau = A S mu = 0 for D = diag(1 / W), and K grows by

    F = (A D A')^-1 A D (tau + A' F).
"""

import dataclasses
from typing import Any

import numpy as np

from ffsm_drake.plugins.two_arms.chain import ClosedChain, Constraints
from ffsm_drake.plugins.two_arms.following import Following
from ffsm_drake.plugins.two_arms.framed import framed_motion
from ffsm_drake.plugins.two_arms.internal import internal_control
from ffsm_drake.plugins.two_arms.loads import preloaded
from ffsm_drake.scenario.contacts import ALL_HANDS, closing_contacts
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import FOLLOWERS
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class KeptForce:
    """The internal force of a law that starts anew, on numbers or symbols."""

    constraints: Constraints  # of the nominal chain
    weights: np.ndarray  # (nv) the diagonal of D
    places: np.ndarray  # (6 for each closed loop) among the wrenches of all contacts
    size: int  # of the wrenches of all contacts
    start: np.ndarray  # (6 for each closed loop) F_0

    def step(
        self,
        q: Any,
        mass_matrix: Any,
        commands: tuple[Any, Any],
        wrenches: Any,
        begins: Any,
        goes_on: Any,
        acts: Any,
    ) -> tuple[Any, Any]:
        """Return the wrenches on the target (``size``) that are kept after a sample, and their
        generalized force (nv).

        Args: the configuration (nq) with the mass matrix (nv, nv); the force of the law at the
          sample before (nv), within its limits and without; the wrenches kept before; whether
          another force takes the place of the law's from now on (1), and whether the law started
          anew at the sample before (1).
        """
        closed, A = self.constraints, self.constraints.jacobian(q)
        if not self.places.size:
            return wrenches, 0.0 * commands[0]
        kept = wrenches[self.places]
        weights = np.linalg.solve(mass_matrix, A.T).T, A * self.weights
        for weighted, command, is_so in zip(weights, commands, (begins, goes_on), strict=True):
            added = closed.wrench(np.linalg.solve(weighted @ A.T, weighted @ command))
            kept = kept + np.where(is_so, added - self.start, 0.0)
        after = 1.0 * wrenches
        after[self.places] = kept
        kept = kept + np.where(acts, self.start, 0.0)
        along = kept if closed.is_spatial else closed.wrench_map.T @ kept
        return after, along @ A


class SupervisedChain:
    """The closed chain of a phase, for its supervisor."""

    def __init__(self, setup: BlockSetup) -> None:
        """Args: the setup of the supervisor. Raises the errors of ``ClosedChain``."""
        self._setup, scenario = setup, setup.scenario
        self._chain = ClosedChain(setup.nominal, scenario, setup.grip, true=False)

    def kept(self) -> KeptForce | None:
        """The internal force that the supervisor keeps; None: the law controls none."""
        scenario, chain = self._setup.scenario, self._chain
        given = scenario.chain.force
        if scenario.chain.law != "minimal" or given is None:
            return None
        control = preloaded(self._setup.mission, chain, internal_control(given, scenario, chain))
        names = [*closing_contacts(scenario, ALL_HANDS)]
        firsts = np.array([6 * names.index(loop.name) for loop in chain.loops], dtype=int)
        return KeptForce(
            constraints=chain.constraints,
            weights=control.weight,
            places=np.add.outer(firsts, np.arange(6)).ravel(),
            size=6 * len(names),
            start=chain.constraints.wrench(control.start),
        )

    def follow(self, motion: PlannedMotion, since: float, closed: float) -> PlannedMotion:
        """Return a motion that closes the chain, of one of all coordinates.

        Args: the motion; its begin after the grasp of the first hand, s; ``closed``: see ``Grip``.

        Raises ScenarioError: a hand does not reach its place, or an arm is singular.
        """
        setup, scenario, key = self._setup, self._setup.scenario, "actuation.driven"
        is_framed = scenario.reference.frame is not None
        follow = framed_motion if is_framed else Following
        made = follow(motion, setup.mission, setup.nominal, since=since, closed=closed)
        if is_framed or not scenario.undriven:
            return made
        return FOLLOWERS.load(key, key)(made, setup.mission, setup.nominal)
