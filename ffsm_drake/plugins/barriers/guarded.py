"""Barriers around any law: joints stay within limits of position, rate and force.

A control barrier function h >= 0 limits the acceleration of a joint. High-order barriers, here of
order two with equal rates, are those of Nguyen and Sreenath, "Exponential control barrier functions
for enforcing high relative-degree safety-critical constraints", American Control Conference 2016,
doi:10.1109/ACC.2016.7524935, and of Xiao and Belta, IEEE Transactions on Automatic Control 67
(2022) 3655, doi:10.1109/TAC.2021.3105491. Limits of position, rate and force together with sampling
are the subject of Shaw Cortez and Dimarogonas, "Safe-by-design control for Euler-Lagrange systems",
arXiv 2009.03767. arXiv 2109.07027 could not be read. The sampled form is derived here.

With the distance h = upper - q of a joint, the force held over the period L and a constant
acceleration, psi = h' + a h obeys psi(t + L) >= (1 - a L) psi(t) if

    -q'' (1 + a L / 2) >= 2 a q' - a^2 h.                                                   (1)

For a L <= 1 and h, psi >= 0 at the start, h >= 0 at all times, also between samples. With the
distance h = w - q' to a rate limit, h(t + L) >= (1 - b L) h(t) if -q'' >= -b h (2). The opposite
limits are alike. The bounds (1) and (2) of q'' are tightened by the margin m.

The nominal model predicts q''_0 = (Hhat^-1 (tau - Chat))_joints from the law's force tau. Only the
joints' forces change, by H* x, with H* = Hhat condensed on the joints: the base reacts. The change
x of the joints' accelerations minimises x^T H* x, that is, the change of force in the metric of
Hhat^-1 (Gauss's principle of least constraint).
"""

import dataclasses
from typing import ClassVar

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.products import condensed
from ffsm_drake.plugins.barriers.least_change import least_change
from ffsm_drake.plugins.barriers.recorded import CHANGE, SLACK, BarrierActivity
from ffsm_drake.scenario import Barriers
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, tightest
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, WrappedLaw
from ffsm_drake.systems.mission_limits import limits_of
from ffsm_drake.systems.setup import BlockSetup

_KEY = "command_filter.barriers"
_JOINTS = slice(NUM_BASE_VELOCITIES, None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GuardedLaw(WrappedLaw):
    """A law whose force is changed as little as possible to keep the joints within their limits.

    Arrays of joints have the shape (nj). A limit that does not exist is infinite.
    """

    logged: ClassVar[tuple[str, ...]] = (CHANGE, SLACK)
    model: PlantModel
    sample_time: float  # L, s
    joints: tuple[str, ...]
    decay: np.ndarray  # a (nj), 1/s
    rate_decay: np.ndarray  # b (nj), 1/s
    margin: np.ndarray  # m (nj), rad/s^2 or m/s^2
    lower: np.ndarray  # (nj) rad or m
    upper: np.ndarray  # (nj)
    rate: np.ndarray  # w (nj), rad/s or m/s
    force: np.ndarray  # (nv) N m and N

    @property
    def part(self) -> BarrierActivity:
        """What describes the signals of the barriers."""
        return BarrierActivity(joints=self.joints)

    def initial_state(self) -> State:
        """Return the law's state, and the activity of the barriers."""
        own = {CHANGE: np.zeros(len(self.joints)), SLACK: np.zeros(1)}
        return {**self.law.initial_state(), **own}

    def bounds(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the joints' accelerations (nj), from their q and v (nj)."""
        a, b = self.decay, self.rate_decay
        held = 1.0 + 0.5 * a * self.sample_time
        high = np.minimum(a * (a * (self.upper - q) - 2.0 * v) / held, b * (self.rate - v))
        low = np.maximum(a * (a * (self.lower - q) - 2.0 * v) / held, -b * (self.rate + v))
        return low + self.margin, high - self.margin

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """One control sample; see ControlLaw."""
        others = {name: state[name] for name in state if name not in self.logged}
        wanted, memory = self.law.step(sample, others)
        inertia = self.model.calc_mass_matrix(sample.q)
        base, joints = np.arange(NUM_BASE_VELOCITIES), np.arange(NUM_BASE_VELOCITIES, wanted.size)
        most = self.force[_JOINTS]
        given = np.minimum(np.maximum(wanted, -self.force), self.force)
        given = np.concatenate([given[:NUM_BASE_VELOCITIES], wanted[_JOINTS]])
        bias = self.model.calc_bias(sample.q, sample.v)
        acceleration = np.linalg.solve(inertia, given - bias)[_JOINTS]
        low, high = self.bounds(sample.q[NUM_BASE_POSITIONS:], sample.v[_JOINTS])
        reduced = condensed(inertia, joints, base)
        change, slack = least_change(
            reduced, low - acceleration, high - acceleration,
            -most - wanted[_JOINTS], most - wanted[_JOINTS],
        )  # fmt: skip
        on_joints = reduced @ change
        changed = np.minimum(np.maximum(wanted[_JOINTS] + on_joints, -most), most)
        force = np.concatenate([wanted[:NUM_BASE_VELOCITIES], changed])
        return force, {**memory, CHANGE: changed - wanted[_JOINTS], SLACK: slack}

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw: the barriers have no memory."""
        law = before.law if isinstance(before, GuardedLaw) else before
        own = {name: state[name] for name in self.logged}
        others = {name: state[name] for name in state if name not in own}
        return {**self.law.resume(others, law, reference), **own}


def with_barriers(law: ControlLaw, setup: BlockSetup) -> ControlLaw:
    """Return a law with the barriers of a scenario.

    Raises:
      ScenarioError: an unknown coordinate, a decay that is too fast for the control period, or a
        chain that two hands close.
      ModelError: a URDF cannot be read.
    """
    given, coordinates = setup.scenario.command_filter.barriers, setup.coordinates
    assert isinstance(given, Barriers)
    if len(setup.scenario.contacts) > 1:
        raise ScenarioError(_KEY, "is not for a target that several hands hold; remove it")

    def joints(name: str, default: float | None = None) -> np.ndarray:
        key = f"{_KEY}.{name}"
        return coordinates.vector(getattr(given, name), key=key, default=default)[_JOINTS]

    fastest = 1.0 / setup.sample_time
    for name in ("decay", "rate_decay"):
        if (values := joints(name, 1.0)).max(initial=0.0) > fastest:
            problem = f"must be at most 1/sample_time, {fastest:g} 1/s, not {values.max():g}"
            raise ScenarioError(f"{_KEY}.{name}", problem)
    limits = limits_of(setup.mission)
    position, rate = (tightest(limits, of).joints for of in (POSITION, RATE))
    lower = np.maximum(joints("lower", -np.inf), position[0])
    upper = np.minimum(joints("upper", np.inf), position[1])
    for name, least, most in zip(coordinates.joints, lower, upper, strict=True):
        if least >= most:
            raise ScenarioError(f"{_KEY}.lower.{name}", f"must be below {most:g}, not {least:g}")
    return GuardedLaw(
        law=law,
        model=setup.nominal,
        sample_time=setup.sample_time,
        joints=coordinates.joints,
        decay=joints("decay", 2.0),
        rate_decay=joints("rate_decay", 10.0),
        margin=joints("margin", 0.0),
        lower=lower,
        upper=upper,
        rate=np.minimum(joints("rate", np.inf), rate[1]),
        force=tightest(limits, FORCE).upper,
    )
