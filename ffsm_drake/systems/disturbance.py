"""The external disturbance: a harmonic and a constant per coordinate (Table 1), in C++ systems."""

from typing import Any

import numpy as np
from pydrake.systems.framework import System
from pydrake.systems.primitives import Adder, ConstantVectorSource, Sine

from ffsm_drake.scenario import Disturbance
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.selection import make_selector
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock


class HarmonicDisturbance(Part):
    """The section ``disturbance`` of a scenario."""

    title = "Disturbance"

    def build(self, setup: BlockSetup) -> CompositeBlock:
        """Return the force."""
        return make_disturbance(setup.scenario.disturbance, setup.coordinates)


def make_disturbance(settings: Disturbance, coordinates: Coordinates) -> CompositeBlock:
    """Return a source with output ``generalized_force``: amplitude sin(frequency t + phase) + bias,
    N m and N, (nv).

    The scales multiply amplitudes and biases, and frequencies (phases stay), so that the paper's
    tau_d2 is ``frequency_scale: 3`` and tau_d3 is ``amplitude_scale: 3``.

    Raises:
      ScenarioError: a harmonic is given for an unknown coordinate.
    """
    *sines, bias = sines_of(settings, coordinates)
    # An even number of sines: the last bit of a vectorised sine depends on whether it has a
    # neighbour.
    nv, odd = bias.size, bias.size % 2
    amplitude, frequency, phase = (np.append(each, np.zeros(odd)) for each in sines)
    force = "generalized_force"
    systems: dict[str, System] = {"harmonic": Sine(amplitude, frequency, phase)}
    signals = {"harmonic": {"y0": force}}
    if odd:
        kept = {force: [(0, i) for i in range(nv)]}
        systems["taken"] = make_selector({force: nv + odd}, kept)
    if bias.any():
        systems |= {"bias": ConstantVectorSource(bias), "biased": Adder(2, nv)}
        signals |= {"bias": {"y0": "bias"}, "biased": {"u0": force, "u1": "bias", "sum": force}}
    return CompositeBlock("disturbance", systems, inputs=(), outputs=(force,), signals=signals)


def force_at(time: Any, sines: Any) -> Any:
    """Return the force (nv) of ``sines_of`` at a time, s, both of which may be symbols."""
    amplitude, frequency, phase, bias = sines
    return amplitude * np.sin(frequency * time + phase) + bias


def sines_of(settings: Disturbance, coordinates: Coordinates) -> np.ndarray:
    """Amplitude, frequency, phase and constant part of each coordinate's force (4, nv).

    Raises ScenarioError: a harmonic is given for an unknown coordinate.
    """
    amplitude, frequency, phase, bias = (
        coordinates.vector(
            {name: getattr(harmonic, field) for name, harmonic in settings.harmonics.items()},
            key="disturbance.harmonics",
            default=0.0,
        )
        for field in ("amplitude", "frequency", "phase", "bias")
    )
    scale = settings.amplitude_scale
    return np.array([scale * amplitude, settings.frequency_scale * frequency, phase, scale * bias])
