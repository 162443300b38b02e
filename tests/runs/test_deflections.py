"""What the metrics tell of hidden coordinates, against signals of known amplitude."""

import numpy as np
import pytest
import xarray as xr

from ffsm_drake.runs.deflections import deflection_metrics, first_at_rest

PERIOD, END = 0.01, 5.0


def dataset(duration):
    """A reference that ends at END, and two hidden coordinates: one swings on, the other has come
    to rest aside.
    """
    time = PERIOD * np.arange(round(duration / PERIOD) + 1)
    moves = time < END - 1e-9
    velocity = np.stack([np.where(moves, 0.1, 0.0), np.zeros_like(time)], axis=1)
    swing = np.where(moves, 0.03, 2e-3) * np.sin(2.0 * np.pi * time)
    aside = np.where(moves, -0.4, 0.1)
    return xr.Dataset(
        {
            "desired_velocity": (("time", "coordinate"), velocity),
            "hidden_position": (("time", "hidden_coordinate"), np.stack([swing, aside], axis=1)),
        },
        coords={"time": time, "hidden_coordinate": ["port", "slosh"]},
    )


@pytest.mark.smoke
def test_what_is_left_after_the_motion_is_measured_about_its_mean():
    found = deflection_metrics(dataset(9.0))
    assert found["peak"] == pytest.approx({"port": 0.03, "slosh": 0.4}, rel=1e-3)
    assert found["residual_since"] == pytest.approx(END)
    assert found["residual_amplitude"] == pytest.approx(
        {"port": 2e-3, "slosh": 0.0}, rel=1e-3, abs=1e-15
    )
    assert found["residual_rms"] == pytest.approx(
        {"port": 2e-3 / np.sqrt(2.0), "slosh": 0.0}, rel=5e-3, abs=1e-15
    )


@pytest.mark.parametrize("duration", [4.0, END])
def test_a_run_that_ends_with_the_motion_leaves_nothing_to_measure(duration):
    found = deflection_metrics(dataset(duration))
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
