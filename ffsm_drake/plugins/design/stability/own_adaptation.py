"""Whether the step of a law adapts K_s by the equation that its hook ``reaching_gain`` stands for.

The analyses of K_s read only the hook: its bound, and for the forecast
dK_s/dt = rate |s| sgn(|s| - rest(K_s)). A user's law may adapt in another way, so it is tried.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ffsm_drake.common.guard import guarded
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.checked import checked_step, reaching_gain_of
from ffsm_drake.systems.controllers.law import ControlLaw, ReachingGain, Sample, State
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.planned_motion import PlannedMotion

_TRIALS = 24
_ERRORS = (1e-9, 1e-1)  # smallest and largest error that is tried, rad or m; its rate, per s
_TOLERANCE = 0.01  # of the change of K_s in a sample
_NEEDED = ("reaching_gain", "sliding_variable")


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnAdaptation:
    """How a law's step adapts K_s, against its hook ``reaching_gain``."""

    difference: str = ""  # one clause, where the step differs most; empty: it does as the hook says
    keeps_bound: bool = True  # whether K_s stays within the hook's ``largest``

    @property
    def is_as_stated(self) -> bool:
        """Whether the forecast of K_s is valid for the law."""
        return not self.difference

    @property
    def uncovered(self) -> str:
        """One line: what differs, and which analysis therefore does not cover the law; or empty."""
        if self.is_as_stated:
            return ""
        left = "the course of K_s is not predicted"
        return f"{self.difference}; {left if self.keeps_bound else f'{left}, and has no bound'}"


@guarded
def own_adaptation(
    law: Any, scenario: Scenario, model: PlantModel, motion: PlannedMotion
) -> OwnAdaptation:
    """Try the steps of a law at errors and K_s of many sizes, half way along a planned motion.

    Args:
      law: the control law; without K_s, there is nothing to try.
      scenario: the scenario, for the period and the tracked frame.
      model: the law's own model (nq, nv).
      motion: the planned motion.

    Raises BlockError: the step fails, or returns something else than it should.
    """
    gain = reaching_gain_of(law)
    if gain is None:
        return OwnAdaptation()
    memory, name = law.initial_state(), type(vars(law).get("dynamics", law)).__name__
    missing = [each for each in _NEEDED if each not in memory]
    if missing:
        if gain.rate is None:
            return OwnAdaptation()
        absent = f"the state of {name} lacks {' and '.join(missing)}, which reaching_gain needs"
        return OwnAdaptation(difference=absent, keeps_bound=False)
    trial = _trial(law, scenario, model, motion)
    tried = [trial(*given) for given in _given(gain, scenario.sample_time)]
    k_s, s, found = (np.array(each) for each in zip(*tried, strict=True))  # (trials, nv)
    stated = _stated(gain, s, k_s, scenario.sample_time)
    rounding = 1e-9 * k_s.max(axis=0)
    change = np.maximum(np.abs(stated - k_s), np.abs(found - k_s))
    off = np.abs(found - stated) - _TOLERANCE * change - rounding
    beyond = found - np.maximum(k_s, gain.largest) - rounding
    off[:, ~model.coordinates.is_driven] = beyond[:, ~model.coordinates.is_driven] = 0.0
    if off.max() <= 0.0:
        return OwnAdaptation()
    at = np.unravel_index(np.argmax(off), off.shape)
    coordinate = model.coordinates.names[at[1]]
    difference = (
        f"at |s| = {abs(s[at]):.3g}, {name} changes K_s of {coordinate} from {k_s[at]:.4g} to "
        f"{found[at]:.4g} 1/s in a sample, its reaching_gain to {stated[at]:.4g}"
    )
    return OwnAdaptation(difference=difference, keeps_bound=bool((beyond <= 0.0).all()))


def _given(gain: ReachingGain, period: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """K_s (nv) up to its bound, half of them there, and [e; e'] (2, nv) of many sizes."""
    random, smallest, largest = np.random.default_rng(0), *np.log10(_ERRORS)
    top = np.where(np.isfinite(gain.largest), gain.largest, 2.0 / period)
    low, high = 0.5 * np.minimum(gain.start, top), np.maximum(gain.start, top)
    for trial in range(_TRIALS):
        share = random.random(top.size) if trial < _TRIALS // 2 else 1.0
        yield low + share * (high - low), 10.0 ** random.uniform(smallest, largest, (2, top.size))


def _stated(gain: ReachingGain, s: np.ndarray, k_s: np.ndarray, period: float) -> np.ndarray:
    """K_s (nv) a period after k_s, by the hook."""
    if gain.rate is None:
        return k_s
    size = np.abs(s)
    after = k_s + period * gain.rate * size * np.sign(size - gain.rest(k_s))
    return np.minimum(np.maximum(after, 0.0), gain.largest)


Trial = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]


def _trial(law: ControlLaw, scenario: Scenario, model: PlantModel, motion: PlannedMotion) -> Trial:
    """The function of K_s (nv) and [e; e'] (2, nv) that returns K_s, s and the next K_s (nv)."""
    q_d, v_d, a_d = motion.evaluate(motion.part(0.5))
    frame, contacts = None, getattr(law, "contacts_read", 0)
    if getattr(law, "tracks_frame", False):
        frame = model.calc_frame_motion(q_d, v_d, a_d, goal_frame(scenario, model.plant))
    step = checked_step(law, f"controller '{scenario.controller}'")

    def after(errors: np.ndarray, **changed: np.ndarray) -> State:
        e, e_dot = np.where(model.coordinates.is_driven, errors, 0.0)
        sample = Sample(
            q=q_d, v=v_d - e_dot, q_d=q_d, v_d=v_d, a_d=a_d, e=e, e_dot=e_dot,
            applied_force=np.zeros_like(e), is_first=False, desired_frame=frame,
            contact_wrench=np.zeros(6 * contacts) if contacts else None,
        )  # fmt: skip
        return step(sample, {**law.initial_state(), **changed}, 0.0)[1]

    def trial(k_s: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, ...]:
        s = after(errors, reaching_gain=k_s)["sliding_variable"]
        # a law may adapt with the s of this sample, or with that of the one before
        found = after(errors, reaching_gain=k_s, sliding_variable=s)
        return k_s, found["sliding_variable"], found["reaching_gain"]

    return trial
