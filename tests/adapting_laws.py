"""Laws as a user may bring them: with adapted parameters, or terms that have no derivative."""

import dataclasses

import numpy as np

import ffsm_drake
from ffsm_drake import gain
from ffsm_drake.systems.controllers.law import ReachingGain
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
    """Aismc whose K_s is known and cannot be set: it is computed, no field."""

    @property
    def reaching_gain(self):
        gain = super().reaching_gain
        return dataclasses.replace(gain, start=1.0 * gain.start)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnRule(Aismc):
    """Aismc that adapts K_s by a rule of its own, within k_s_max; its hook is that of Aismc."""

    def rule(self, s, k_s):
        """dK_s/dt: the rule of Aismc, written otherwise."""
        return self.alpha * np.where(np.abs(s) > k_s**2 / self.beta, np.abs(s), -np.abs(s))

    def step(self, e, e_dot, a_d, state):
        u, after = super().step(e, e_dot, a_d, state)
        k_s = state["reaching_gain"]
        grown = k_s + self.sample_time * self.rule(after["sliding_variable"], k_s)
        return u, {**after, "reaching_gain": np.clip(grown, 0.0, self.k_s_max)}


class Late(OwnRule):
    """With the sliding variable of the sample before, which is the same equation."""

    def step(self, e, e_dot, a_d, state):
        u, after = super().step(e, e_dot, a_d, state)
        k_s = state["reaching_gain"]
        grown = k_s + self.sample_time * self.rule(state["sliding_variable"], k_s)
        return u, {**after, "reaching_gain": np.clip(grown, 0.0, self.k_s_max)}


class Leaky(OwnRule):
    def rule(self, s, k_s):
        return self.alpha * np.abs(s) - 0.1 * k_s


class Quadratic(OwnRule):
    def rule(self, s, k_s):
        return self.alpha * s * s


class Smooth(OwnRule):
    def rule(self, s, k_s):
        return self.alpha * np.abs(s) * np.tanh(np.abs(s) - k_s**2 / self.beta)


class Faster(OwnRule):
    def rule(self, s, k_s):
        return 1.5 * super().rule(s, k_s)


class OtherThreshold(OwnRule):
    def rule(self, s, k_s):
        return self.alpha * np.abs(s) * np.sign(np.abs(s) - 1e-3)


class Coupled(OwnRule):
    def rule(self, s, k_s):
        return np.ones_like(k_s) * np.max(self.alpha * np.abs(s), axis=-1, keepdims=True)


class BeyondItsBound(OwnRule):
    """Quadratic up to 1.2 times the bound of the hook."""

    def step(self, e, e_dot, a_d, state):
        u, after = super().step(e, e_dot, a_d, state)
        k_s, s = state["reaching_gain"], after["sliding_variable"]
        grown = k_s + self.sample_time * self.alpha * s * s
        return u, {**after, "reaching_gain": np.clip(grown, 0.0, 1.2 * self.k_s_max)}


class SaidConstant(OwnRule):
    """Its hook says that nothing adapts K_s."""

    @property
    def reaching_gain(self):
        return ReachingGain(start=self.k_s_initial, largest=self.k_s_initial)


class Forgotten(OwnRule):
    """Without the hook."""

    reaching_gain = None


class Nameless(OwnRule):
    """Its sliding variable has another name."""

    def initial_state(self):
        return {("surface" if n == "sliding_variable" else n): x
                for n, x in super().initial_state().items()}  # fmt: skip

    def step(self, e, e_dot, a_d, state):
        u, after = super().step(e, e_dot, a_d, {**state, "sliding_variable": state["surface"]})
        return u, {"surface": after.pop("sliding_variable"), **after}
