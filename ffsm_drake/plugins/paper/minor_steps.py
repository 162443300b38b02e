"""The published gains in a continuous block diagram: the law in every minor step.

The paper does not say how its simulation coupled law and plant. Here a Runge-Kutta step of one
control period advances plant, error integral and adapted gains together. Equation (5)'s force and
acceleration of a sample ago are always those of the last major step. ``held`` evaluates the law at
the major step only, as a digital controller does.
"""

import dataclasses
import functools
import math

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.paper.runs import PROPOSED, StudyCase
from ffsm_drake.plugins.paper.wording import scientific
from ffsm_drake.runs.metrics import isv, itae
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import error_rate, position_error
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.disturbance import force_at, sines_of
from ffsm_drake.systems.reference import make_motion


@dataclasses.dataclass(frozen=True)
class Scheme:
    """An explicit Runge-Kutta method: the rows below the diagonal of its tableau, and its
    weights.
    """

    title: str
    stages: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]


EULER = Scheme("explicit Euler", ((),), (1.0,))
HEUN = Scheme("Heun (order 2)", ((), (1.0,)), (1 / 2, 1 / 2))
BOGACKI_SHAMPINE = Scheme(
    "Bogacki-Shampine (order 3)", ((), (1 / 2,), (0.0, 3 / 4)), (2 / 9, 3 / 9, 4 / 9)
)
RUNGE_KUTTA = Scheme(
    "Runge-Kutta (order 4)",
    ((), (1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)),
    (1 / 6, 1 / 3, 1 / 3, 1 / 6),
)
_INTEGRATED = ("integral_error", "reaching_gain", "switching_gain")  # entries of the law's memory
# the paper's simulation: Euler has no minor step
MINOR = (EULER, HEUN, BOGACKI_SHAMPINE, RUNGE_KUTTA)


@dataclasses.dataclass(frozen=True)
class MinorStepRun:
    """Outcome of a run."""

    scheme: Scheme
    held: bool
    diverged: float | None  # time of divergence, s
    itae: float  # infinite when it diverged
    isv: float  # ISV of the force at the major steps; infinite when it diverged
    largest_k_s: float  # 1/s

    @property
    def fate(self) -> str:
        return "completes" if self.diverged is None else f"diverges at {self.diverged:.1f} s"


@functools.lru_cache(maxsize=4)
def minor_step_runs(overrides: tuple[str, ...] = ()) -> tuple[MinorStepRun, ...]:
    """Runs of the proposed controller, published gains, under tau_d1; the last holds the force."""
    scenario = StudyCase(setting="euler", controller=PROPOSED).scenario(overrides)
    return (*(run(scenario, scheme) for scheme in MINOR), run(scenario, RUNGE_KUTTA, held=True))


def minor_step_table(overrides: tuple[str, ...] = ()) -> tuple[list[str], list[list[str]]]:
    """Header and rows: place of evaluation, outcome, metrics."""
    header = [
        "integrator, step of a control period",
        "law evaluated",
        "outcome",
        "ITAE",
        "ISV",
        "largest K_s, 1/s",
    ]
    rows = []
    for made in minor_step_runs(overrides):
        where = "once, its force held over the period" if made.held else "in every minor step"
        where = "in its only step" if made.scheme is EULER else where
        figures = [scientific(made.itae), f"{made.isv:.1f}", f"{made.largest_k_s:.1f}"]
        shown = figures if made.diverged is None else [""] * 3
        rows.append([made.scheme.title, where, made.fate, *shown])
    return header, rows


def run(scenario: Scenario, scheme: Scheme, *, held: bool = False) -> MinorStepRun:
    """Simulate the proposed controller.

    It uses the scenario's model, payloads, postures, reference, gains, disturbance, velocity noise
    (drawn once a period), seed, sample time, duration and ``divergence_speed``, and ignores other
    settings of sensing and actuation.
    """
    loop, period = _Loop(scenario), scenario.sample_time
    times = period * np.arange(round(scenario.duration / period))
    drawn = np.random.default_rng(scenario.random_seed).standard_normal((times.size, loop.nv))
    noise = drawn * loop.noise
    errors, forces = np.zeros_like(noise), np.zeros_like(noise)
    y, largest, before = loop.start, 0.0, noise[0]
    for k, start in enumerate(times):
        measured = loop.parts(y)[1] + noise[k]
        # of a sample ago; the first has no past, and the last force is still zero then
        past = forces[k - 1], (measured - before) / period
        slopes: list[np.ndarray] = []
        for stage in scheme.stages:
            time = start + period * sum(stage)
            at = loop.valid(y + period * _combined(stage, slopes))
            if not (slopes and held):
                force, error, rates = loop.law(time, at, noise[k], *past)
            if not slopes:
                forces[k], errors[k] = force, error
            slopes.append(loop.slope(time, at, force, rates))
        y, before = loop.valid(y + period * _combined(scheme.weights, slopes)), measured
        if not np.abs(loop.parts(y)[1]).max() <= scenario.divergence_speed:
            ended, figures = start + period, (math.inf, math.inf)
            break
        largest = max(largest, float(loop.parts(y)[3].max()))
    else:
        ended, figures = None, (itae(times, errors, period), isv(forces, period))
    return MinorStepRun(scheme, held, ended, *figures, largest)


class _Loop:
    """Plant and law as one differential equation of y = [q, v, integral of the error, K_s, G]."""

    def __init__(self, scenario: Scenario) -> None:
        mission = Mission(scenario)
        self.truth, self.nominal = mission.craft.true(), mission.craft.nominal()
        coordinates = self.nominal.coordinates
        self.nv, self.period = len(coordinates.names), scenario.sample_time
        self.dynamics = make_law(mission, self.nominal).dynamics
        self.motion = make_motion(mission)
        self.sines = sines_of(scenario.disturbance, coordinates)
        self.noise = coordinates.vector(
            scenario.sensing.velocity_noise, key="sensing.velocity_noise", default=0.0
        )
        q = configuration(self.truth.coordinates, scenario.initial_posture, key="initial_posture")
        memory = self.dynamics.initial_state()
        self.start = np.concatenate([q, np.zeros(self.nv), *(memory[name] for name in _INTEGRATED)])

    def parts(self, y: np.ndarray) -> list[np.ndarray]:
        """q, v, integral of the error, K_s, G."""
        return np.split(y, self.nv + 1 + self.nv * np.arange(4))

    def valid(self, y: np.ndarray) -> np.ndarray:
        """y with a unit quaternion and non-negative adapted gains."""
        y = y.copy()
        y[:4] /= np.linalg.norm(y[:4])
        y[-2 * self.nv :] = np.maximum(y[-2 * self.nv :], 0.0)
        return y

    def law(
        self,
        time: float,
        y: np.ndarray,
        noise: np.ndarray,
        delayed_force: np.ndarray,
        delayed_acceleration: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force, tracking error, and the rates of the law's integrated memory."""
        q, v, *memory = self.parts(y)
        q_d, v_d, a_d = self.motion.evaluate(time)
        error = position_error(q_d, q)
        state = self.dynamics.initial_state() | dict(zip(_INTEGRATED, memory, strict=True))
        u, after = self.dynamics.step(error, error_rate(error, v_d, v + noise), a_d, state)
        force = delayed_force + self.nominal.calc_mass_matrix(q).dot(u - delayed_acceleration)
        changes = [after[name] - state[name] for name in _INTEGRATED]
        return force, error, np.concatenate(changes) / self.period

    def slope(self, time: float, y: np.ndarray, force: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """dy/dt under a control force."""
        q, v, *_ = self.parts(y)
        total = force + force_at(time, self.sines)
        acceleration = self.truth.calc_acceleration(q, v, total)
        # at the positions just set
        q_dot = self.truth.plant.MapVelocityToQDot(self.truth.context, v)
        return np.concatenate([q_dot, acceleration, rates])


def _combined(weights: tuple[float, ...], slopes: list[np.ndarray]) -> np.ndarray | float:
    return sum((weight * slope for weight, slope in zip(weights, slopes, strict=True)), 0.0)
