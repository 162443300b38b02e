"""What the metrics tell of hidden coordinates, against signals of known amplitude."""

import types

import numpy as np
import pytest

from ffsm_drake.plugins.flexible.deflections import Deflections, first_at_rest
from ffsm_drake.systems.parts.metrics import nested
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.placed import PlacedPart, figures_of

PERIOD, END = 0.01, 5.0


class Run(dict):
    """A reference that ends at END, and two hidden coordinates: one swings on, the other has come
    to rest aside.
    """

    def __init__(self, duration):
        time = PERIOD * np.arange(round(duration / PERIOD) + 1)
        moves = time < END - 1e-9
        velocity = np.stack([np.where(moves, 0.1, 0.0), np.zeros_like(time)], axis=1)
        swing = np.where(moves, 0.03, 2e-3) * np.sin(2.0 * np.pi * time)
        hidden = np.stack([swing, np.where(moves, -0.4, 0.1), 0.0 * time, 0.0 * time], axis=1)
        desired = np.concatenate([np.ones((len(time), 1)), velocity], axis=1)
        super().__init__(desired_state=desired, hidden_state=hidden)
        self.time, self.coordinates = time, types.SimpleNamespace(position_names=("q",))
        self.split = types.SimpleNamespace(names=("port", "slosh"), units=("rad", "m"))


def figures(duration):
    part: Part = Deflections(kinds=("panel", "mass"))
    placed = PlacedPart(name="flexible", block="", part=part, signals=())
    return list(figures_of(placed, Run(duration)))


@pytest.mark.smoke
def test_what_is_left_after_the_motion_is_measured_about_its_mean():
    found = nested(figures(9.0))["hidden"]
    assert found["peak"] == pytest.approx({"port": 0.03, "slosh": 0.4}, rel=1e-3)
    assert found["residual_since"] == pytest.approx(END)
    assert found["residual_amplitude"] == pytest.approx(
        {"port": 2e-3, "slosh": 0.0}, rel=1e-3, abs=1e-15
    )
    assert found["residual_rms"] == pytest.approx(
        {"port": 2e-3 / np.sqrt(2.0), "slosh": 0.0}, rel=5e-3, abs=1e-15
    )
    columns = {each.column_name: each.value for each in figures(9.0) if each.column_name}
    assert columns == pytest.approx(
        {
            "peak_deflection_angle": 0.03,
            "residual_angle": 2e-3,
            "peak_deflection_distance": 0.4,
            "residual_distance": 0.0,
        },
        rel=1e-3,
        abs=1e-15,
    )


@pytest.mark.parametrize("duration", [4.0, END])
def test_a_run_that_ends_with_the_motion_leaves_nothing_to_measure(duration):
    found = nested(figures(duration))["hidden"]
    assert found["peak"]["slosh"] == pytest.approx(0.4)
    assert [found[key] for key in ("residual_since", "residual_rms", "residual_amplitude")] == [
        None
    ] * 3


@pytest.mark.smoke
def test_a_reference_that_pauses_is_not_over():
    velocity = np.array([[0.1], [0.0], [0.0], [0.1], [0.0], [0.0]])
    assert first_at_rest(velocity) == 4
    assert first_at_rest(np.zeros((3, 1))) == 0
    assert first_at_rest(velocity[:4]) == 4
