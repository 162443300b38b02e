"""Laws as a user may bring them: with adapted parameters, or terms that have no derivative."""

import dataclasses

import numpy as np

import ffsm_drake
from ffsm_drake import gain
from ffsm_drake.systems.controllers.laws.aismc import Aismc


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlotineLi(ffsm_drake.ControlLaw):
    """tau = (1 + theta) y + Mhat k_d s, theta' = gamma y s, y = Mhat a_r + hhat."""

    model: ffsm_drake.PlantModel
    sample_time: float
    slope: np.ndarray = gain(4.0, "1/s", "of the surface")
    k_d: np.ndarray = gain(8.0, "1/s", "on s")
    gamma: np.ndarray = gain(1e-2, "", "adaptation", feedback=False)

    def initial_state(self):
        return {"theta": np.zeros_like(self.k_d)}

    def step(self, sample, state):
        s = sample.e_dot + self.slope * sample.e
        mass = self.model.calc_mass_matrix(sample.q)
        wanted = sample.a_d + self.slope * sample.e_dot
        y = mass @ wanted + self.model.calc_bias(sample.q, sample.v)
        theta = state["theta"] + self.sample_time * self.gamma * y * s
        return (1.0 + state["theta"]) * y + mass @ (self.k_d * s), {"theta": theta}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlotineLiHeld(SlotineLi):
    """The same, with its adaptation held in a linearisation."""

    def held(self):
        return {"theta": None}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoMemories(SlotineLi):
    """The same with an integral, which decays."""

    k_i: np.ndarray = gain(4.0, "1/s^3", "on the integral of the error")

    def initial_state(self):
        return {"integral": np.zeros_like(self.k_d), **super().initial_state()}

    def step(self, sample, state):
        force, kept = super().step(sample, state)
        integral = state["integral"] + self.sample_time * sample.e
        force = force + self.model.calc_mass_matrix(sample.q) @ (self.k_i * integral)
        return force, {**kept, "integral": integral}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoMemoriesHeld(TwoMemories):
    """The same, with its adaptation held in a linearisation."""

    def held(self):
        return {"theta": None}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuperTwisting(ffsm_drake.ControlLaw):
    """u = a_d + slope e' + k_1 sqrt|s| sgn s + w, w' = k_2 sgn s."""

    model: ffsm_drake.PlantModel
    sample_time: float
    slope: np.ndarray = gain(4.0, "1/s", "of the surface")
    k_1: np.ndarray = gain(0.3, "", "on the root of s")
    k_2: np.ndarray = gain(0.05, "", "on its sign")

    def initial_state(self):
        return {"twist": np.zeros_like(self.k_1)}

    def root(self, s):
        return np.sqrt(np.abs(s)) * np.sign(s)

    def sign(self, s):
        return np.sign(s)

    def step(self, sample, state):
        s = sample.e_dot + self.slope * sample.e
        u = sample.a_d + self.slope * sample.e_dot + self.k_1 * self.root(s) + state["twist"]
        mass, bias = (
            self.model.calc_mass_matrix(sample.q), self.model.calc_bias(sample.q, sample.v)
        )  # fmt: skip
        twist = state["twist"] + self.sample_time * self.k_2 * self.sign(s)
        return mass @ u + bias, {"twist": twist}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SmoothTwisting(SuperTwisting):
    """The same within a boundary layer."""

    width: float = 1e-3

    def root(self, s):
        return s / np.sqrt(np.abs(s) + self.width)

    def sign(self, s):
        return s / (np.abs(s) + self.width)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fails(SlotineLiHeld):
    """One with a fault of its own."""

    def step(self, sample, state):
        raise ValueError("on purpose")


class WithoutWithReachingGain(Aismc):
    """Aismc whose K_s is known and cannot be set."""

    with_reaching_gain = ffsm_drake.InjectedDynamics.with_reaching_gain
