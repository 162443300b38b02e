"""Campaigns over flexible panels: two by one value, and what is left of their vibration is a
column.
"""

import pytest
from campaign_tools import run_here, sql, write_spec

from ffsm_drake import load_scenario, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.campaign.cases import make_cases, scenario_of
from ffsm_drake.plugins.campaign.prediction import predict
from ffsm_drake.plugins.campaign.rows import metrics_of
from ffsm_drake.plugins.campaign.spec import load_spec, shipped_campaigns

PANELS = [f"model.flexible.{name}" for name in ("port", "starboard")]
SHORT = {"duration": 0.4, "reference.duration": 0.2, "divergence_speed": 100.0}


@pytest.mark.parametrize(
    "name", [name for name in shipped_campaigns() if name.startswith("flexible_panels")]
)
@pytest.mark.smoke
def test_the_shipped_campaigns_give_both_panels_one_value(name):
    spec = load_spec(name)
    for case in list(make_cases(spec))[:5]:
        port, starboard = scenario_of(spec, case, "tdc").model.flexible.values()
        for key in ("frequency", "damping_ratio", "mass"):
            assert getattr(port, key) == getattr(starboard, key) == case.values[key]
    assert {"peak_deflection_angle", "residual_angle"} < set(metrics_of(spec))


def test_deflections_are_columns(tmp_path):
    spec = write_spec(
        tmp_path / "spec.yaml",
        scenario="flexible_panels",
        overrides={
            "duration": 0.4,
            "reference.duration": 0.2,
        },
        controllers=["tdc"],
        cases=3,
        parameters={f"{PANELS[0]}.mass": {"distribution": "uniform", "low": 1, "high": 8}},
        factors={"frequency": {"distribution": "log_uniform", "low": 0.05, "high": 5}},
        derive={f"{panel}.frequency": {"rule": "scale", "of": "frequency"} for panel in PANELS},
        settled={"hold": 0.1},
    )
    database = run_here(spec, tmp_path / "here.sqlite")
    columns = (
        "random_seed, peak_deflection_angle, residual_angle, predicted_radius_starting, frequency"
    )
    rows = sql(database, f'SELECT {columns}, "{PANELS[0]}.mass" FROM runs ORDER BY case_index')
    assert len({row[1] for row in rows}) == 3
    seed, peak, residual, radius, frequency, mass = rows[0]
    values = [f"{panel}.frequency={frequency!r}" for panel in PANELS]
    values += [f"{PANELS[0]}.mass={mass!r}", f"random_seed={seed}", "controller=tdc"]
    scenario = load_scenario(
        "flexible_panels", [*(f"{key}={value}" for key, value in SHORT.items()), *values]
    )
    figures = simulate(scenario, check_stability=False).metrics["hidden"]
    assert peak == pytest.approx(max(figures["peak"].values()))
    assert residual == pytest.approx(max(figures["residual_amplitude"].values()))
    assert radius == pytest.approx(predict(make_mission(scenario))[0])
