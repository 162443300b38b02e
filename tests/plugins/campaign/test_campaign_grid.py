"""A grid of values: its cases and its page, on the shipped campaign ``noise`` made small."""

import itertools
import json
import re

import pytest
import yaml
from campaign_tools import invoke, run_here

from ffsm_drake import load_scenario, simulate
from ffsm_drake.common.errors import CampaignError
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.campaign.cases import make_cases, scenario_of
from ffsm_drake.plugins.campaign.spec import load_spec, shipped_campaigns
from ffsm_drake.plugins.campaign.statistics import find
from ffsm_drake.plugins.campaign.store import open_store
from ffsm_drake.plugins.design.stability.planned_dynamics import make_demand
from ffsm_drake.plugins.design.stability.prediction import predict

SIGMAS = (1e-5, 1e-4)  # rad/s and m/s
DURATION = 1.0  # s
KINDS, GAINS = ("one_sample", "kalman"), ("published", "moderate")


def noise(path, **changes):
    """The shipped campaign with other entries, read from a file."""
    data = yaml.safe_load(shipped_campaigns()["noise"].read_text()) | changes
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return path


def short(path, **changes):
    data = yaml.safe_load(shipped_campaigns()["noise"].read_text())
    data["overrides"]["duration"] = DURATION
    data["parameters"]["sensing.velocity_noise"]["values"] = list(SIGMAS)
    return noise(path, overrides=data["overrides"], parameters=data["parameters"], **changes)


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    folder = tmp_path_factory.mktemp("grid")
    return run_here(short(folder / "noise.yaml"), folder / "noise.db")


@pytest.fixture(scope="module")
def points(database):
    with open_store(database) as store:
        found = find(store).grid
    values = ["estimator.kind", "controllers", "sensing.velocity_noise", "controller"]
    return found.set_index(values).to_dict("index")


@pytest.mark.smoke
def test_a_grid_has_every_combination_once_the_last_value_fastest():
    spec = load_spec("noise")
    cases = list(make_cases(spec))
    sigmas = list(spec.distributions["sensing.velocity_noise"].levels.values())
    assert len(cases) == spec.cases == 2 * 2 * 9
    found = [(case.values["estimator.kind"], case.values["sensing.velocity_noise"])
             for case in cases]  # fmt: skip
    assert found == [(kind, sigma) for kind in KINDS for _ in GAINS for sigma in sigmas]
    names = [spec.level("controllers", case.index) for case in cases]
    assert names == [gains for _ in KINDS for gains in GAINS for _ in sigmas]
    moderate = scenario_of(spec, cases[9], "tdc").controllers["tdc"]
    assert moderate["k_p"]["joints"] == 100.0
    assert scenario_of(spec, cases[9], "tdc").estimator.position_noise == {"all": 1e-8}


def test_further_cases_repeat_the_grid_with_other_seeds(tmp_path):
    spec = load_spec(short(tmp_path / "twice.yaml", cases=16))
    cases = list(make_cases(spec))
    assert [case.values for case in cases[:8]] == [case.values for case in cases[8:]]
    assert len({case.seed for case in cases}) == 16


def test_a_grid_takes_lists_only(tmp_path):
    drawn = {"sample_time": {"distribution": "choice", "values": [0.005, 0.01]}}
    with pytest.raises(
        CampaignError, match="sample_time: must be a list, because sampling is grid"
    ):
        load_spec(noise(tmp_path / "bad.yaml", parameters=drawn, derive={}))


@pytest.mark.long
def test_the_plan_shows_the_names_of_values(tmp_path):
    result = invoke("plan", short(tmp_path / "noise.yaml"))
    assert result.exit_code == 0, result.output
    (line,) = (line for line in result.output.splitlines() if line.startswith("controllers "))
    assert line.split()[1:] == ["published", "published", "moderate", "moderate", "published"]


@pytest.mark.long
def test_a_point_is_what_simulate_gives(database, points):
    with open_store(database) as store:
        seed = store.case(7).seed
    overrides = [
        "controller=tdc", f"duration={DURATION}", f"random_seed={seed}", "estimator.kind=kalman",
        "estimator.walk={base_position: 1e-3, base_rotation: 1e-3, joints: 1e-2}",
        "estimator.velocity_noise=1e-4", "estimator.position_noise=1e-5",
        "sensing.velocity_noise=1e-4",
        "controllers.tdc.k_d={base_position: 4, base_rotation: 10, joints: 20}",
        "controllers.tdc.k_p={base_position: 4, base_rotation: 25, joints: 100}",
    ]  # fmt: skip
    metrics = simulate(load_scenario("postcapture", overrides)).metrics
    means = points["kalman", "moderate", "0.0001", "tdc"]
    for name in ("itae", "isv"):  # compiled runs differ from Drake by rounding
        assert means[name] == pytest.approx(metrics[name], rel=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("controller", ["tde_aismc", "asmc", "tdc"])
def test_effort_of_the_published_estimate_grows_with_the_square_of_the_noise(points, controller):
    overrides = [f"duration={DURATION}", f"controller={controller}", "sensing.velocity_noise=1e-4"]
    scenario = load_scenario("postcapture", overrides)
    ideal = make_demand(make_mission(scenario)).ideal_isv
    small, large = (
        points["one_sample", "published", sigma, controller]["isv"] - ideal
        for sigma in ("1e-05", "0.0001")
    )
    assert large / small == pytest.approx(100.0, rel=0.15)
    # the prediction is that of a long run, and a second of TDC has its first samples in it
    assert large == pytest.approx(predict(scenario, settled_after=0.25).isv - ideal, rel=0.3)


@pytest.mark.parametrize("controller", ["tde_aismc", "asmc", "tdc"])
def test_the_kalman_estimate_is_cheaper_and_takes_its_gains_to_be_so(points, controller):
    isv = {
        way: points[(*way, "0.0001", controller)]["isv"] for way in itertools.product(KINDS, GAINS)
    }
    assert isv["kalman", "moderate"] < isv["one_sample", "moderate"] / 10.0
    assert isv["one_sample", "moderate"] < isv["one_sample", "published"]


def test_the_page_shows_every_point(database, tmp_path):
    result = invoke("report", database, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    page = (tmp_path / "report.html").read_text()
    section = page[page.index("<h2>Over the grid</h2>") :]
    section = section[: section.index("<h2>Controllers compared")]
    assert section.count("<tr>") == 1 + 2 * 2 * 2 * 4
    assert section.count("1 diverged") == 1  # AISMC at the larger noise, as published
    for kind, gains in itertools.product(KINDS, GAINS):
        assert f"{kind}, {gains}</label>" in section
    figures = json.loads(re.search(r'id="figures">(.*?)</script>', page)[1])["figures"]
    assert len([key for key in figures if key.startswith("grid-")]) == 4 * 4
