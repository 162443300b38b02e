"""The study of sensor noise: a reduced sweep, judged against single runs and against the predicted
slope.
"""

import csv
import functools
import math
import os

import numpy as np
import pytest
from matplotlib.image import imread

from ffsm_drake import load_scenario, simulate
from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.studies.noise import NoiseStudy, study_noise, write_study
from ffsm_drake.studies.noise.cases import CONTROLLERS, NoiseCase

SIGMAS = (1e-5, 1e-4)
DURATION = 1.0


@functools.cache
def study() -> NoiseStudy:
    done = []
    found = study_noise(
        sigmas=SIGMAS, duration=DURATION, progress=lambda *call: done.append(call[:2])
    )
    assert done == [(k + 1, len(found.rows)) for k in range(len(found.rows))]
    return found


def only(controller, estimator, sigma, **kwargs):
    (row,) = study().select(controller, estimator, sigma, **kwargs)
    return row


@pytest.mark.slow
def test_there_is_a_row_for_every_point():
    swept = len(CONTROLLERS) * 2 * (len(SIGMAS) + 1)
    exchanged = len(CONTROLLERS) * 2
    assert len(study().rows) == swept + exchanged
    assert study().sigmas == SIGMAS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("estimator", "overrides"),
    [
        ("one_sample", []),
        (
            "kalman",
            [
                "estimator.kind=kalman",
                "estimator.velocity_noise=1e-4",
                "estimator.position_noise=1e-5",
                "controllers.tdc.k_d={base_position: 4, base_rotation: 10, joints: 20}",
                "controllers.tdc.k_p={base_position: 4, base_rotation: 25, joints: 100}",
            ],
        ),
    ],
)
def test_a_row_is_what_simulate_gives(estimator, overrides):
    sensors = ["sensing.velocity_noise=1e-4", "sensing.position_noise=0"]
    chosen = ["controller=tdc", f"duration={DURATION}"]
    record = simulate(load_scenario("postcapture", [*chosen, *sensors, *overrides]))
    row = only("tdc", estimator, 1e-4)
    assert (row.itae, row.isv) == (record.metrics["itae"], record.metrics["isv"])
    assert row.peak_force == record.metrics["peak_effort"]
    error = record.dataset["error"].values[record.dataset["time"].values > 0.25 * DURATION, 6:]
    assert row.rms_error["joints"] == pytest.approx(math.sqrt((error**2).mean()), rel=1e-12)


def test_the_sensor_set_is_that_of_flight_sensors():
    flight = load_scenario("flight_sensors")
    case = NoiseCase(controller="tdc", estimator="kalman", gains="bandwidth", sigma=None).scenario()
    assert case.sensing == flight.sensing
    assert case.estimator.kind == "kalman"
    assert case.estimator.velocity_noise is None  # the filter knows its sensors
    assert case.actuation.limit is None


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["tde_aismc", "asmc", "tdc"])
def test_effort_of_the_published_estimate_grows_with_the_square_of_the_noise(controller):
    # 1e-5 is too little for TDC's noise to drown what else its effort holds, the first samples for
    # instance.
    ideal = study().ideal_isv
    small, large = (only(controller, "one_sample", sigma).isv - ideal for sigma in SIGMAS)
    assert large / small == pytest.approx(100.0, rel=0.15)
    assert only(controller, "one_sample", 1e-4).isv == pytest.approx(
        only(controller, "one_sample", 1e-4).isv_predicted, rel=0.15
    )


@pytest.mark.slow
def test_noise_gains_are_those_of_the_published_gains():
    assert study().noise_gain["tdc"] == pytest.approx(375, rel=0.01)
    assert study().noise_gain["aismc"] == pytest.approx(1330, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["tde_aismc", "asmc", "tdc"])
def test_the_kalman_estimate_is_cheaper_and_takes_its_gains_to_be_so(controller):
    published, exchanged = (
        only(controller, "one_sample", 1e-4, gains=gains).isv
        for gains in ("published", "bandwidth")
    )
    kalman = only(controller, "kalman", 1e-4).isv
    assert kalman < exchanged / 10.0
    assert exchanged < published


@pytest.mark.slow
def test_diverged_rows_are_flagged_and_hold_no_figures():
    row = only("aismc", "one_sample", 1e-4)
    assert row.diverged
    assert row.outcome.startswith("diverged at 0.")
    assert math.isnan(row.isv)
    assert math.isnan(row.rms_error["joints"])
    assert {row.controller for row in study().rows if row.diverged} == {"aismc"}


@pytest.mark.slow
def test_every_file_is_written_whole(tmp_path):
    path = write_study(study(), tmp_path / "new" / "folder")
    assert path.name == "noise.md"
    assert sorted(os.listdir(path.parent)) == ["noise.csv", "noise.md", "noise.png", "noise.svg"]
    rows = list(csv.DictReader((path.parent / "noise.csv").read_text().splitlines()))
    assert len(rows) == len(study().rows)
    assert [float(row["isv"]) for row in rows if row["isv"]] == pytest.approx(
        [row.isv for row in study().rows if not row.diverged], rel=1e-7
    )
    assert {row["isv"] for row in rows if row["diverged"] == "1"} == {""}
    text = path.read_text()
    assert text.count("**diverged at") >= 3
    assert "nan" not in text
    picture = imread(path.parent / "noise.png")[..., :3]
    for panel in (
        picture[:600, :780],
        picture[:600, 780:],
        picture[600:, :780],
        picture[600:, 780:],
    ):
        dark = (panel.max(axis=2) < 0.5).mean()
        coloured = (np.ptp(panel, axis=2) > 0.3).mean()
        assert dark > 0.002
        assert coloured > 0.002


@pytest.mark.slow
@pytest.mark.usefixtures("rough_pictures")
def test_one_sigma_and_several_seeds_can_be_written(tmp_path):
    few = study_noise(sigmas=(1e-5,), seeds=2, duration=0.05, controllers=("tdc",))
    assert {row.controller for row in few.rows} == {"tdc"}
    assert [row.seed for row in few.select("tdc", "kalman", 1e-5)] == [0, 1]
    assert len({row.isv for row in few.select("tdc", "kalman", 1e-5)}) == 2
    assert write_study(few, tmp_path).is_file()


@pytest.mark.slow
def test_same_seeds_same_table_whatever_the_workers():
    there = study_noise(
        sigmas=SIGMAS[1:], duration=DURATION, controllers=("aismc",), workers=2
    ).rows
    here = [row for row in study().rows if row.controller == "aismc" and row.sigma != SIGMAS[0]]
    assert any(row.diverged for row in there)
    # a diverged run's NaN equals nothing
    assert sorted(map(repr, there)) == sorted(map(repr, here))


@pytest.mark.parametrize(
    "wrong",
    [
        {"sigmas": ()},
        {"sigmas": (0.0,)},
        {"sigmas": (1e-5, 1e-5)},
        {"seeds": 0},
        {"controllers": ("pid",)},
    ],
)
def test_bad_arguments_are_refused(wrong):
    with pytest.raises(ScenarioError):
        study_noise(**wrong)
