"""Errors and effort of laws that track a frame: predictions against runs, and designs."""

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import load_scenario, make_nominal_plant, simulate_many
from ffsm_drake.cli import main
from ffsm_drake.plugins.design.gains.variation import _scaled, _tunable
from ffsm_drake.plugins.design.limit import _filter
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.prediction import Prediction, predict
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.systems.controllers import complete_gains

LAWS = ("resolved_rate", "task_computed_torque", "task_time_delay")
QUIET = {"position_noise": 1e-4, "velocity_noise": 1e-4}
TARGET = 'reference.frame={frame: "debris::debris", task: pose}'
MISSIONS = {
    "postcapture": ["reference.frame={task: position}"],
    "free_floating": [],
    "two_arms": [TARGET],
    "two_arms, base position free": [
        TARGET, "actuation.driven=[base_rotation, joints]",
        "initial_posture.base_position=[0, 0, 0]", "target_posture.base_position=[0, 0, 0]",
    ],
}  # fmt: skip
GROUPS = {
    "postcapture": {"base_rotation", "base_position", "frame_position"},
    "free_floating": {"frame_rotation", "frame_position"},
    "two_arms": {"base_rotation", "base_position", "frame_rotation", "frame_position"},
}


def mission(name, law, *overrides):
    noise = [f"sensing.{key}={value}" for key, value in QUIET.items()]
    short = ("duration=12", "reference.duration=6")
    fast = [  # many time constants within a run, so that rms errors are well known
        f"controllers.task_time_delay.k_{gain}={value}"
        for part in ("rotation", "position")
        for gain, value in ((f"p_{part}", 16.0), (f"d_{part}", 8.0))
    ]
    given = [*MISSIONS[name], *noise, *short, *fast, f"controller={law}", *overrides]
    return load_scenario(name.split(",")[0], given)


def measured(scenario, groups, seeds=4):
    """Rms errors of groups of outputs after 5 s, and the effort, of runs."""
    runs = simulate_many([scenario.replace(random_seed=seed) for seed in range(seeds)])
    late = runs[0].dataset.time.values > 5.0
    errors = [
        np.hstack([run.dataset.error.values, run.dataset.frame_error.values])[late] for run in runs
    ]
    square = np.square(errors).mean(axis=(0, 1))
    isv = float(np.mean([run.metrics["isv"] for run in runs]))
    return {name: np.sqrt(square[group.errors].mean()) for name, group in groups.items()}, isv


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", MISSIONS)
def test_errors_of_the_frame_are_predicted(name, law):
    # noise counts half at each end of the motion, and runs are mostly at its last posture
    scenario, allowed = mission(name, law), 0.2 if law == "task_time_delay" else 0.05
    predicted = predict(scenario)
    if name in GROUPS:
        assert set(predicted.by_group()) == GROUPS[name]
    errors, isv = measured(scenario, predicted.groups)
    assert predicted.by_group() == pytest.approx(errors, rel=allowed)
    assert predicted.isv == pytest.approx(isv, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["postcapture", "free_floating", "two_arms"])
def test_noise_of_the_frame_is_that_of_runs_at_rest(name, law):
    """Without motion and disturbance, all error is due to noise."""
    rest = ["reference.goal=stop", "disturbance.amplitude_scale=0"]
    if name == "free_floating":
        rest += ["reference.frame.position=null", "reference.frame.rpy=null"]
    scenario = mission(name, law, *rest)
    with Linearizer(scenario) as linearizer:
        loop = linearizer.outputs.seen(linearizer.at(0.0))
        response = loop.noise_response(scenario.num_control_periods)
        groups = linearizer.outputs.groups
    errors, _ = measured(scenario, groups)
    both = np.concatenate([response["error"], response["frame_error"]])
    found = {name: np.sqrt(np.mean(both[group.errors] ** 2)) for name, group in groups.items()}
    assert found == pytest.approx(errors, rel=0.15)


def test_a_gain_of_the_frame_is_varied_as_one_number():
    scenario = complete_gains(mission("postcapture", "task_computed_torque"))
    names = _tunable(scenario)
    assert {"k_p_rotation", "k_d_position", "k_p_plan"} <= {*names}
    assert not {"damping", "speed_limit"} & {*names}
    for name in names:
        changed = _scaled(scenario, name, dict.fromkeys(GROUPS["postcapture"], 1.5))
        (before, *_), (after, *_) = (
            make_nominal_plant(each).coordinates.vector(each.gains[name], key=name)
            for each in (scenario, changed)
        )
        assert after == pytest.approx(1.5 * before, rel=1e-2)


def test_the_shares_of_effort_add_up_to_the_whole():
    ones = np.ones(12)
    for law, name in (("tdc", "postcapture"), ("task_computed_torque", "free_floating")):
        with Linearizer(mission(name, law)) as linearizer:
            outputs = linearizer.outputs
        size = outputs.coordinates.num_velocities
        found = Prediction(
            coordinates=outputs.coordinates, groups=outputs.groups, spectral_radius=0.9,
            rms_error=np.ones(outputs.size), noise_error=np.ones(outputs.size),
            noise_force=ones[:size], isv_by_coordinate=np.arange(size) * 1.0,
            peak_effort=ones[:size],
        )  # fmt: skip
        driven = found.isv_by_coordinate[outputs.coordinates.driven].sum()
        assert sum(map(found.isv_of, found.groups.values())) == pytest.approx(driven)
        assert found.by_group() == pytest.approx(dict.fromkeys(found.groups, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["postcapture", "two_arms"])
def test_gains_of_a_law_that_tracks_a_frame_are_designed(name, tmp_path):
    file = tmp_path / "mission.yaml"
    given = [option for each in MISSIONS[name] for option in ("--set", each)]
    noise = [option for each in QUIET for option in ("--set", f"sensing.{each}={QUIET[each]}")]
    arguments = ["design", name, "--controller", "task_computed_torque", *given, *noise]
    arguments += ["--set", "duration=8", "--set", "reference.duration=5", "--time", "20"]
    found = CliRunner().invoke(main, [*arguments, "--out", str(file.parent / "out")])
    assert found.exit_code == 0, found.output
    assert "frame_position" in found.output
    assert "times the least of any linear controller" in found.output
    assert (tmp_path / "out" / "design.yaml").exists()


def test_a_coordinate_without_noise_and_disturbance_is_known_exactly():
    noise = ["sensing.position_noise=0", "sensing.velocity_noise=0"]
    scenario = load_scenario("postcapture", [*noise, "disturbance.amplitude_scale=0"])
    coordinates = Craft(scenario).coordinates
    before, after = _filter(scenario, coordinates, np.zeros(len(coordinates.names)))
    assert not before.any()
    assert not after.any()
