"""Hidden coordinates in pictures and tables: recording, live view, diagram, report, comparison."""

import dataclasses

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from ffsm_drake import simulate
from ffsm_drake.common.numbers import NONE, number
from ffsm_drake.plugins.diagrams.block_diagram import closed_loop_dot
from ffsm_drake.plugins.flexible.meshcat import Deflections
from ffsm_drake.plugins.meshcat.recording import recording_html
from ffsm_drake.plugins.meshcat.replay_view import ReplayView
from ffsm_drake.plugins.meshcat.stage import start_meshcat
from ffsm_drake.plugins.report.comparison import table
from ffsm_drake.plugins.report.part_panels import part_sections, part_views
from ffsm_drake.show.results import results_of
from ffsm_drake.show.tables import results_table
from ffsm_drake.spacecraft.plant import split_of

OVERRIDES = (
    "controller=tdc",
    "duration=0.6",
    "reference.duration=0.4",
    "target_posture.base_position=[0.1, 0.3, -0.2]",
    "target_posture.base_rpy=[0.12, 0.08, -0.1]",
    "target_posture.joints={joint_1: 0.175, joint_2: 0.349, joint_3: 1.047, joint_4: 0.611, "
    "joint_5: -0.698}",
    "model.flexible.port={position: [0, 1, 0], frequency: 1}",
    "model.flexible.starboard={position: [0, -1, 0], direction: [0, -1, 0], frequency: 0.5, "
    "plates: 2}",
    "model.flexible.fuel={kind: mass, mass: 10, direction: [1, 0, 0], frequency: 0.5}",
)


@pytest.fixture(scope="module")
def meshcat():
    return start_meshcat()


@pytest.fixture
def record(run):
    return run("postcapture", *OVERRIDES)


def scaled(record, **factors):
    """The record with hidden coordinates of given peaks."""
    data = record.dataset.copy(deep=True)
    for name, peak in factors.items():
        column = data["hidden_position"].sel(hidden_coordinate=name)
        data["hidden_position"].loc[{"hidden_coordinate": name}] = column * (
            peak / abs(column).max()
        )
    return dataclasses.replace(record, dataset=data)


@pytest.mark.slow
def test_deflections_are_drawn_larger_by_what_the_caption_says(meshcat, record):
    meshcat.Delete()
    record = scaled(record, port=2e-3, starboard_1=1e-3, starboard_2=5e-4, fuel=0.31)
    view = ReplayView(meshcat, record, ghost=True, path=False, forces=False)
    # 0.1 of at most 0.1745 rad, and the fuel as it is
    assert view.deflections.factors == {"panel": 50}
    assert view.deflections.legend in recording_html(record, ghost=False, path=False)
    assert view.deflections.legend == "deflections drawn larger: panels x 50"
    data = record.dataset
    for sample in (0, 31, 60):
        view.show(data["time"].values[sample])
        X_WB, X_WP = (
            view.spacecraft.plant.GetBodyByName(name).EvalPoseInWorld(
                view.spacecraft._plant_context
            )
            for name in ("base", "port")
        )
        angle = 50.0 * float(data["hidden_position"].sel(hidden_coordinate="port")[sample])
        R_BP = X_WB.rotation().inverse() @ X_WP.rotation()
        assert R_BP.matrix() == pytest.approx(
            RotationMatrix.MakeXRotation(angle).matrix(), abs=1e-12
        )


def test_the_largest_deflection_is_drawn_below_ten_degrees(record):
    plant = record.mission.craft.whole
    for peak in (1e-6, 3e-5, 0.01, 0.08, 0.5):
        one = scaled(record, port=peak, starboard_1=1e-9, starboard_2=1e-9)
        factor = Deflections(one.dataset, one.scenario.model, plant, split_of(plant)).factors.get(
            "panel", 1
        )
        assert factor == 1 or factor * peak <= np.deg2rad(10.0)
        assert factor == 1000 or factor * peak > np.deg2rad(10.0) / 2.5


def test_a_gear_in_the_arm_is_drawn_as_it_is(meshcat, run):
    gear = "model.flexible.elbow={kind: gear, joint: joint_3, frequency: 1}"
    record = run(
        "postcapture",
        "controller=tdc",
        "duration=0.05",
        gear,
        "actuation.drives.rotor_inertia.joint_3=20",
    )
    assert float(abs(record.dataset["hidden_position"]).max()) > 0.0
    meshcat.Delete()
    view = ReplayView(meshcat, record, ghost=False, path=False, forces=False)
    assert view.deflections.legend == ""
    assert (view.deflections.at(5) == record.dataset["hidden_position"].values[5]).all()


def test_a_diverged_run_ends_with_its_last_finite_deflection(meshcat, record):
    meshcat.Delete()
    data = record.dataset.copy(deep=True)
    data["hidden_position"][-3:] = np.inf
    view = ReplayView(
        meshcat, dataclasses.replace(record, dataset=data), ghost=False, path=False, forces=False
    )
    assert view.duration == data["time"].values[-4]


def test_sloshing_masses_show_through_the_base(meshcat, record):
    meshcat.Delete()
    ReplayView(meshcat, record, ghost=False, path=False, forces=False)
    path = "visualizer/flexible/fuel/flexible/fuel_visual/<object>"
    # msgpack's false
    assert meshcat._GetPackedProperty(path, "material.depthTest").endswith(b"\xc2")


def test_a_run_is_shown_as_it_goes(meshcat, record):
    meshcat.Delete()
    shown = simulate(
        dataclasses.replace(record.scenario, duration=0.05), meshcat=meshcat, check_stability=False
    )
    assert shown.outcome.completed
    assert meshcat.HasPath("visualizer/flexible/port")


@pytest.mark.smoke
def test_the_diagram_tells_known_from_hidden_states(record):
    assert "hidden_state" in closed_loop_dot(record.scenario, logged=True)
    rigid = dataclasses.replace(record.scenario.model, flexible={})
    rigid = dataclasses.replace(record.scenario, model=rigid)
    assert "hidden_state" not in closed_loop_dot(rigid, logged=True)


def test_report_and_table_tell_what_is_left(record, run):
    figures = record.metrics["hidden"]
    assert figures["residual_since"] == pytest.approx(0.4)
    assert figures["peak"].keys() == {"port", "starboard_1", "starboard_2", "fuel"}
    line = next(
        line for line in results_table([record]).splitlines() if line.startswith("flexible")
    )
    assert f"fuel {figures['peak']['fuel']:.3g} m" in line
    assert f"port {figures['residual_amplitude']['port']:.3g} rad" in line
    results = results_of([record, run("postcapture", "controller=tdc", "duration=0.3")])
    rows = [row for row in table(results) if row.label == "starboard 2"]
    assert [row.unit for row in rows] == ["rad"] * 3  # peak, amplitude, rms
    assert [row.cells[0].text for row in rows] == [
        number(figures[key]["starboard_2"])
        for key in ("peak", "residual_amplitude", "residual_rms")
    ]
    assert {row.cells[1].text for row in rows} == {NONE}
    views = part_views(results, "Flexible parts")
    assert [view.label for view in views] == ["Deflection", "Rate", "Energy"]
    assert {panel.title for panel in views[0].charts} == {
        "port",
        "starboard 1",
        "starboard 2",
        "fuel",
    }
    (curve,) = next(panel for panel in views[0].charts if panel.title == "fuel").curves
    assert max(map(abs, curve.y)) == pytest.approx(figures["peak"]["fuel"])
    assert part_sections(results[1:]) == {}
