"""Filters of the commanded force, around any control law: a low-pass, and a notch at a
vibration.
"""

import dataclasses

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import CommandFilter
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, WrappedLaw
from ffsm_drake.systems.setup import BlockSetup

_KEY = "command_filter"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FilteredLaw(WrappedLaw):
    """A law whose force passes through filters; the law still receives ``applied_force``.

    The low-pass is y_k = y_{k-1} + a (x_k - y_{k-1}). The notch is the bilinear transform, exact at
    its frequency, of (s^2 + w^2) / (s^2 + b w s + w^2), b being its width.
    """

    share: np.ndarray  # (nv) a of the low-pass; 1: none
    numerator: np.ndarray  # (3, nv) the notch's coefficients of powers of 1/z; (1, 0, 0): no notch
    denominator: np.ndarray  # (2, nv) the notch's coefficients of 1/z and 1/z^2

    def initial_state(self) -> State:
        """Return the law's state, and that of filters at rest."""
        zeros = np.zeros_like(self.share)
        return {**self.law.initial_state(), **dict.fromkeys(_MEMORY, zeros)}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """One control sample; see ControlLaw."""
        (low, first, second), (b0, b1, b2), (a1, a2) = (
            (state[name] for name in _MEMORY), self.numerator, self.denominator,
        )  # fmt: skip
        force, memory = self.law.step(
            sample, {name: state[name] for name in state if name not in _MEMORY}
        )
        low = low + self.share * (force - low)
        filtered = b0 * low + first
        filters = (low, b1 * low - a1 * filtered + second, b2 * low - a2 * filtered)
        return filtered, {**memory, **dict(zip(_MEMORY, filters, strict=True))}

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw: the filters continue."""
        law = before.law if isinstance(before, FilteredLaw) else before
        own = {name: state[name] for name in _MEMORY}
        return {
            **self.law.resume(
                {name: state[name] for name in state if name not in own}, law, reference
            ),
            **own,
        }


_MEMORY = ("low_passed_force", "notch_first", "notch_second")


def with_filters(law: ControlLaw, setup: BlockSetup) -> ControlLaw:
    """Return a law with the filters of the scenario of a setup. Raises as ``make_filtered``."""
    settings, period = setup.scenario.command_filter, setup.sample_time
    return make_filtered(law, settings, setup.coordinates, sample_time=period)


def make_filtered(
    law: ControlLaw, settings: CommandFilter, coordinates: Coordinates, *, sample_time: float
) -> ControlLaw:
    """Return a law with the filters of a scenario, if it has any; else the law itself.

    Raises ScenarioError: an unknown coordinate, or a frequency above half the control rate.
    """
    cut, center, width = (
        coordinates.vector(getattr(settings, name), key=f"{_KEY}.{name}", default=0.0)
        for name in ("low_pass", "notch", "notch_width")
    )
    highest = 0.5 / sample_time
    for key, values in (("low_pass", cut), ("notch", center)):
        if (values >= highest).any():
            name = coordinates.names[int(np.argmax(values))]
            problem = f"must be below half the control rate, {highest:g} Hz, not {values.max():g}"
            raise ScenarioError(f"{_KEY}.{key}.{name}", problem)
    if not (cut.any() or center.any()):
        return law
    angle, on = 2.0 * np.pi * center * sample_time, center > 0.0
    half = 0.5 * np.sin(angle) * width
    one, twice = np.ones_like(cut), -2.0 * np.cos(angle)
    numerator = np.where(
        on, np.stack([one, twice, one]) / (1.0 + half), np.stack([one, 0.0 * one, 0.0 * one])
    )
    denominator = np.where(on, np.stack([twice, 1.0 - half]) / (1.0 + half), 0.0)
    return FilteredLaw(
        law=law,
        share=np.where(cut > 0.0, -np.expm1(-2.0 * np.pi * cut * sample_time), 1.0),
        numerator=numerator,
        denominator=denominator,
    )
