"""The internal force of a closed chain under a law that is not adapted to it: how it grows.

At rest the chain moves as v = S nu, and no motion takes away the error of the calibration. A law
with time-delay estimation adds to the internal force at every sample.
"""

import dataclasses
import math

import numpy as np

from ffsm_drake.common.numbers import counted, short
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.scenario import HELD, Grip, Scenario
from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.systems.controllers.law import ControlLaw, Sample

_EXAMPLE = 1e-3  # rad or m, of every joint of the closing arms, where a scenario has no error
_LONGEST = 20.0  # s
_HUGE = 1e6  # N or N m, where the forecast ends


@dataclasses.dataclass(frozen=True, kw_only=True)
class Growth:
    """The internal force at rest, under the calibration errors of a scenario or an example."""

    is_example: bool  # the scenario has no calibration error
    time: np.ndarray  # s (n)
    wrench: np.ndarray  # (n, 6) N m and N, of the first contact that closes a loop

    @property
    def force(self) -> np.ndarray:
        """Its size (n), N."""
        return np.linalg.norm(self.wrench[:, 3:], axis=1)

    @property
    def moment(self) -> np.ndarray:
        """Its size (n), N m."""
        return np.linalg.norm(self.wrench[:, :3], axis=1)


def growth(mission: Mission, law: ControlLaw, q: np.ndarray, grip: Grip = HELD) -> Growth:
    """The growth of the internal force at rest, without noise and disturbance.

    The chain moves exactly, with its dynamics at q; the law sees its errors and rates.

    Args:
      mission: the mission, with its calibration errors.
      law: the law.
      q: the reference's configuration (nq).
      grip: the hands that hold the target.
    """
    scenario, model = mission.scenario, mission.craft.true()
    period = scenario.sample_time
    chain = ClosedChain(model, scenario, grip, true=True)
    error, is_example = _calibration(scenario, chain, q)
    closed = chain.closed(q)
    A, H = chain.jacobian(closed), model.calc_mass_matrix(closed)
    _, _, rows = np.linalg.svd(A)
    S = rows[len(A) :].T  # v = S nu
    drive = np.linalg.solve(S.T @ H @ S, S.T)
    reaction = np.linalg.solve(A @ np.linalg.solve(H, A.T), np.linalg.solve(H, A.T).T)
    moved, rate, force = np.zeros(S.shape[1]), np.zeros(S.shape[1]), np.zeros(len(q) - 1)
    state, still, wrenches = law.initial_state(), np.zeros(len(q) - 1), list[np.ndarray]()
    for k in range(round(min(scenario.duration, _LONGEST) / period)):
        v = S @ rate
        sample = Sample(q, v, q, still, still, error - S @ moved, -v, force, is_first=k == 0)
        with np.errstate(over="ignore", invalid="ignore"):
            force, state = law.step(sample, state)
        acceleration = drive @ force
        moved = moved + period * rate + 0.5 * period**2 * acceleration
        rate = rate + period * acceleration
        wrenches.append(chain.constraints.wrench(reaction @ force)[:6])
        if not np.abs(wrenches[-1]).max() < _HUGE:
            break
    return Growth(
        is_example=is_example,
        time=period * np.arange(1, len(wrenches) + 1),
        wrench=np.array(wrenches),
    )


def _calibration(scenario: Scenario, chain: ClosedChain, q: np.ndarray) -> tuple[np.ndarray, bool]:
    """The error (nv) that the law sees where base and carrying arm are on the reference, and
    whether it is an example.
    """
    coordinates = chain.model.coordinates
    bias = coordinates.vector(scenario.sensing.position_bias, key="sensing", default=0.0)
    error = position_error(q, chain.closed(q)) - bias
    if np.abs(error).max() > 1e-9:
        return error, False
    for loop in chain.loops:
        error[loop.joints] = _EXAMPLE
    return error, True


def growth_in_words(
    mission: Mission, law: ControlLaw, q: np.ndarray, grip: Grip, poles: int
) -> str:
    """The growth in one sentence; arguments as ``growth``, with the number of poles at one."""
    scenario, remedy, at_one = mission.scenario, "set chain.law: minimal", counted(poles, "pole")
    if scenario.chain.law == "minimal":
        remedy = "set chain.force.gain above 0"
        for name, contact in closing_contacts(scenario, grip).items():
            if contact.kind == "rigid" and not contact.stabilization:
                key = f"contacts.{name}.stabilization"
                return f"a gap of {name} does not decay, {at_one} at one; set {key} above 0"
    found = growth(mission, law, q, grip)
    errors = "calibration errors"
    if found.is_example:
        errors = "calibration errors, such as 1 mrad of each joint of an arm"
    told = (
        f"{short(found.force[-1])} N and {short(found.moment[-1])} N m in {short(found.time[-1])} s"
    )
    if not math.isfinite(found.force[-1]) or found.force[-1] >= _HUGE:
        told = f"more than {_HUGE:g} N in {short(found.time[-1])} s"
    return (
        f"internal force not controlled, {at_one} at one: at rest it grows to {told} because of "
        f"{errors}; {remedy}"
    )
