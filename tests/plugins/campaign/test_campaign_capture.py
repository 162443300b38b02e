"""Campaigns of captures: what the grasp adds to a row, which limit fails first, what is refused,
what is predicted.
"""

import numpy as np
import pytest
from campaign_tools import invoke, run_here, write_spec

from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.campaign.prediction import predict
from ffsm_drake.plugins.campaign.spec import load_spec
from ffsm_drake.plugins.campaign.statistics import agreement, read_table
from ffsm_drake.plugins.campaign.store import open_store
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import load_scenario

# An ordinary case, one whose payload is three times as heavy as it is thought to be, one that
# tumbles too fast to be stopped within the limits, and one with parts nearer to each other than
# they may be.
CASES = {
    "capture.rate": [[0.02, 0.03, 0.01], [0.02, 0.03, 0.01], [0.3, -0.4, 0.2], [0.0, 0.0, 0.0]],
    "payload.truth.mass": [100.0, 300.0, 300.0, 100.0],
    "payload.truth.inertia": [
        [16.7, 16.7, 16.7],
        [50.0, 50.0, 50.0],
        [50.0, 50.0, 50.0],
        [16.7, 16.7, 16.7],
    ],
    "payload.nominal.mass": [100.0, 100.0, 300.0, 100.0],
    "payload.nominal.inertia": [
        [16.7, 16.7, 16.7],
        [16.7, 16.7, 16.7],
        [50.0, 50.0, 50.0],
        [16.7, 16.7, 16.7],
    ],
    "clearance": [0.01, 0.01, 0.01, 0.6],
}


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    changes = {
        "scenario": "tumbling_capture",
        "overrides": {"capture.approach": None, "reference.duration": None, "duration": 2.0},
        "controllers": ["tdc"],
        "cases": 4,
        "parameters": {
            name: {"distribution": "list", "values": values} for name, values in CASES.items()
        },
        "factors": {},
        "derive": {},
        "settled": {"hold": 0.0},
    }
    return run_here(write_spec(folder / "s.yaml", **changes), folder / "x.db")


@pytest.fixture(scope="module")
def rows(database):
    with open_store(database) as store:
        return [store.result(case, "tdc") for case in range(4)]


@pytest.mark.long
def test_a_row_tells_of_the_grasp(rows):
    sets = [f"{name}={values[0]}" for name, values in CASES.items()]
    scenario = load_scenario(
        "tumbling_capture", ["capture.approach=null", "duration=0.02", "controller=tdc", *sets]
    )
    contact = make_rollout(scenario).run().grasp.contact
    assert rows[0]["outcome"] == "settled"
    assert rows[0]["grasp_impulse"] == pytest.approx(np.linalg.norm(contact.impulse[3:]), rel=1e-12)
    assert rows[0]["grasp_angular_impulse"] == pytest.approx(
        np.linalg.norm(contact.impulse[:3]), rel=1e-12
    )
    assert rows[0]["grasp_angular_impulse"] > 0.1
    assert (rows[0]["first_limit"], rows[0]["first_limit_time"]) == ("", None)
    assert rows[0]["predicted_load"] < 1.0


@pytest.mark.slow
def test_the_first_limit_is_named(rows):
    assert rows[1]["first_limit"].startswith("force on base_rotation_")
    assert 0.0 < rows[1]["first_limit_time"] < 2.0
    assert rows[1]["predicted_load"] > 1.0


def test_a_tumble_that_no_motion_stops_is_refused_with_its_limit(rows):
    assert (rows[2]["outcome"], rows[2]["first_limit"]) == ("refused", "force on base_rotation_y")
    assert "no duration up to 1000 s keeps the limits" in rows[2]["message"]
    assert rows[2]["grasp_impulse"] is None


def test_parts_too_near_are_no_success(rows):
    assert (rows[3]["outcome"], rows[3]["first_limit"]) == ("not_settled", "clearance")


@pytest.mark.slow
def test_the_report_counts_them(database, tmp_path, monkeypatch):
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.POINTS", 1)
    with open_store(database) as store:
        runs = read_table(store).runs["tdc"]
    assert runs.first_limit.tolist()[::3] == ["", "clearance"]
    assert agreement(runs).sum() == 3  # not the one that was refused
    result = invoke("report", database, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    page = (tmp_path / "report.html").read_text()
    assert "Which limit fails first" in page
    assert "force on base_rotation_" in page
    assert invoke("rerun", database, "--case", 1, "--out", tmp_path / "r").exit_code == 0


# In three seconds the plan takes most, in thirty the answer to the wrong velocity at the start.
@pytest.mark.parametrize(("duration", "end"), [(3, 2.0), (30, 0.5)])
def test_the_load_is_the_peak_of_a_run_without_limits_and_noise(duration, end):
    sets = [
        "capture.approach=null",
        "controller=tdc",
        "capture.rate=[0.105, 0.084, 0.112]",
        "duration=30",
    ]
    scenario = load_scenario("tumbling_capture", [*sets, f"reference.duration={duration}"])
    free = [
        "actuation.limit=null",
        "sensing.position_noise=0",
        "sensing.velocity_noise=0",
        f"duration={end}",
    ]
    noise = [
        "estimator.position_noise={base_position: 1.0e-3, base_rotation: 5.0e-5, joints: 1.0e-5}"
    ]
    noise += [
        "estimator.velocity_noise={base_position: 1.0e-3, base_rotation: 1.5e-5, joints: 1.0e-4}"
    ]
    log = make_rollout(
        load_scenario("tumbling_capture", [*sets, f"reference.duration={duration}", *free, *noise])
    ).run()
    share = np.abs(log.generalized_force) / np.repeat([10.0, 22.0, 50.0], [3, 3, 5])
    assert predict(make_mission(scenario))[-1] == pytest.approx(share.max(), rel=0.1)


@pytest.mark.smoke
def test_a_campaign_without_a_capture_has_the_columns_it_had():
    from ffsm_drake.plugins.campaign.rows import PREDICTIONS, metrics_of, predictions_of
    from ffsm_drake.runs.metrics import METRICS

    spec = load_spec("payload_uncertainty")
    columns = tuple(each.column_name for each in METRICS if each.column_name)
    assert metrics_of(spec) == (*columns, "settled_time")
    assert predictions_of(spec) == PREDICTIONS
