"""TVLQR, a baseline without estimate: time-varying linear-quadratic regulator about the plan.

About the plan the error e = q_d - q and its rate obey, to first order in both, with W = [w_d]x on
the base's rotation,

    e'' = (A_q - A_v W + W') e + (A_v + W) e' - H^-1 u,      tau = tau_d + u,

where tau_d is the inverse dynamics of the plan, and A_q, A_v are derivatives of the acceleration at
constant force, all of the nominal plant. The gains solve the discrete Riccati equation backwards
from its stationary solution at the end of the plan.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import quaternion_rate, skew
from ffsm_drake.mission import Mission, planned
from ffsm_drake.scenario import Grip
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import DRAKE_ERRORS
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Sample,
    State,
    field_values,
    gain,
)
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.setup import BlockSetup

_STEP = 1e-6  # step of finite differences: rad, m, and per s
_INSTANTS = 101  # instants of the plan with a linearisation; the matrices are interpolated between
_UNKNOWN: np.ndarray = np.zeros((1, 0, 0))  # gains of a law without a plan


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tvlqr(ControlLaw):
    """Time-varying linear-quadratic regulator (TVLQR) about the plan.

    tau = tau_d + K_k [e; e']. The cost is the sum of squares of e, e' and tau - tau_d, each divided
    by its size.
    """

    label = "TVLQR"
    by_sample: ClassVar[tuple[str, ...]] = ("gains",)
    model: PlantModel
    sample_time: float
    error_size: np.ndarray = gain(
        {"all": 1e-3, "base_position": 1e-2},
        "rad or m",
        "size of an error with weight 1 in the cost",
        positive=True,
    )
    rate_size: np.ndarray = gain(
        1e-2, "rad/s or m/s", "size of a rate of error with weight 1 in the cost", positive=True
    )
    force_size: np.ndarray = gain(
        {"base_rotation": 10.0, "base_position": 10.0, "joints": 5.0},
        "N m or N",
        "size of a force with weight 1 in the cost",
        positive=True,
    )
    # K_k (samples, nv, 2 nv), the last one stays
    gains: np.ndarray = dataclasses.field(default_factory=lambda: _UNKNOWN)

    def initial_state(self) -> State:
        return {"samples": np.zeros(1)}  # number of samples so far

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        planned = self.model.calc_mass_matrix(sample.q_d).dot(sample.a_d)
        planned = planned + self.model.calc_bias(sample.q_d, sample.v_d)
        gain, error = self._gain_at(state["samples"][0]), (sample.e, sample.e_dot)
        force = planned + gain.dot(np.concatenate(error))
        return force, {"samples": state["samples"] + 1.0}

    def _gain_at(self, samples: Any) -> np.ndarray:
        """K_k (nv, 2 nv) after so many samples."""
        if len(self.gains) == 1:
            return self.gains[0]
        return self.gains[min(int(samples), len(self.gains) - 1)]

    def at_samples(self, q_d: np.ndarray) -> Mapping[str, np.ndarray]:
        """K_k of the samples from the first one, for the compiled engine."""
        return {"gains": self.gains[np.minimum(np.arange(len(q_d)), len(self.gains) - 1)]}

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> "Tvlqr":
        """See ControlLaw. Raises ScenarioError also if the reference is a user-supplied block."""
        if setup.scenario.blocks.reference is not None:
            raise ScenarioError(
                "controller",
                f"{setup.name} needs the planned motion; blocks.reference must be null",
            )
        law = cls(**field_values(cls, setup))
        settings = {**setup.settings}
        if len(setup.coordinates.names) < len(setup.craft.coordinates.names):  # in a chain
            return dataclasses.replace(law, gains=_regulated(law, setup.mission, setup.grip))
        return dataclasses.replace(law, gains=_gains_of(setup.mission, setup.grip, settings))


@planned  # used by a run, its prediction and its stability
def _gains_of(mission: Mission, grip: Grip, settings: Mapping[str, Any]) -> np.ndarray:
    """K_k (samples, nv, 2 nv) until the end of the planned motion."""
    model, name = driven_model(mission.craft.nominal(grip)), mission.scenario.controller
    setup = BlockSetup(name=name, mission=mission, nominal=model, settings=settings)
    return _regulated(Tvlqr(**field_values(Tvlqr, setup)), mission, grip)


def _regulated(law: Tvlqr, mission: Mission, grip: Grip) -> np.ndarray:
    """K_k of a law without them."""
    model, scenario = law.model, mission.scenario
    motion, period = make_motion(mission, grip), scenario.sample_time
    last, nv = max(1, round(motion.end / period)), law.error_size.size
    own = mission.craft.coordinates.indices(model.coordinates.names, key="controller")
    known = []
    for time in np.linspace(0.0, last * period, _INSTANTS):
        q, v, a = motion.evaluate(time)
        known.append(linearized(model, q, v[own], a[own]))
    weight = np.diag(np.concatenate([law.error_size, law.rate_size]) ** -2.0)
    effort = np.diag(law.force_size**-2.0)
    gains = np.empty((last + 1, nv, 2 * nv))
    stationary = discretized(*known[-1], period)
    try:
        _, cost = DiscreteTimeLinearQuadraticRegulator(*stationary, weight, effort)
    except DRAKE_ERRORS:
        raise ScenarioError(
            f"controllers.{scenario.controller}",
            "has no regulator in double precision; error_size, rate_size and force_size must be "
            "nearer to each other",
        ) from None
    for k in range(last, -1, -1):
        place = k * (_INSTANTS - 1) / last
        i = min(int(place), _INSTANTS - 2)
        before, after = i + 1 - place, place - i
        a, b = (
            before * one + after * other for one, other in zip(known[i], known[i + 1], strict=True)
        )
        a, b = discretized(a, b, period)
        gains[k] = -np.linalg.solve(effort + b.T @ cost @ b, b.T @ cost @ a)
        cost = weight + a.T @ cost @ (a + b @ gains[k])
        cost = 0.5 * (cost + cost.T)
    return gains


def linearized(
    model: PlantModel, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a (2 nv, 2 nv) and B (2 nv, nv) of [e; e']' = A [e; e'] + B u about a motion."""
    nv = v.size
    mass_matrix, force = model.calc_mass_matrix(q), model.calc_inverse_dynamics(q, v, a)
    by_q, by_v = np.zeros((nv, nv)), np.zeros((nv, nv))
    for i in range(nv):
        one = _STEP * np.eye(nv)[i]
        by_q[:, i] = (
            model.calc_inverse_dynamics(moved(q, model.calc_whole_velocity(q, one)), v, a) - force
        ) / _STEP
        by_v[:, i] = (model.calc_inverse_dynamics(q, v + one, a) - force) / _STEP
    inverse = np.linalg.inv(mass_matrix)
    a_q, a_v = -inverse @ by_q, -inverse @ by_v
    turn, turn_rate = np.zeros((nv, nv)), np.zeros((nv, nv))
    turn[:3, :3], turn_rate[:3, :3] = skew(v[:3]), skew(a[:3])
    system = np.block(
        [[np.zeros((nv, nv)), np.eye(nv)], [a_q - a_v @ turn + turn_rate, a_v + turn]]
    )
    return system, np.vstack([np.zeros((nv, nv)), -inverse])


def moved(q: np.ndarray, change: np.ndarray) -> np.ndarray:
    """q (nq) changed by a small rotation vector change[:3], world axes, and by change[3:]."""
    turned = q[:4] + quaternion_rate(q[:4], change[:3])
    return np.concatenate([turned / np.linalg.norm(turned), q[4:] + change[3:]])


def discretized(a: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a and B over a period with the input held, to second order."""
    half = 0.5 * period * a
    return np.eye(len(a)) + period * (a + half @ a), period * (b + half @ b)
