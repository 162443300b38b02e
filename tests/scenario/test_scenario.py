"""Scenarios: what ships, how files and overrides combine, and one clear line for every mistake."""

import pytest

from ffsm_drake import (
    ModelError,
    ScenarioError,
    load_scenario,
    make_closed_loop,
    simulate,
)
from ffsm_drake.scenario import scenario_to_dict, shipped_scenarios


@pytest.mark.smoke
def test_shipped_scenarios():
    assert set(shipped_scenarios()) >= {"paper", "postcapture"}
    paper, postcapture = load_scenario("paper"), load_scenario("postcapture")
    assert paper.simulator_config.integration_scheme == "explicit_euler"
    assert postcapture.simulator_config.integration_scheme == "runge_kutta3"
    for scenario in (paper, postcapture):
        assert scenario.simulator_config.max_step_size == 0.01
        assert not scenario.simulator_config.use_error_control
        assert scenario.sensing.velocity_noise == {"all": 1e-6}
        assert (scenario.payload.truth.mass, scenario.payload.nominal.mass) == (100.0, 80.0)
        assert scenario.controllers["aismc"]["k_s_max"] is None
    assert paper.controllers["tde_aismc"]["k_s_max"] is None
    assert postcapture.controllers["tde_aismc"]["k_s_initial"] == {"all": 60.0}
    assert postcapture.controllers["tde_aismc"]["k_s_max"] == {"all": 70.0}


def test_the_two_scenarios_differ_only_where_they_say():
    paper, postcapture = (
        scenario_to_dict(load_scenario(name)) for name in ("paper", "postcapture")
    )

    def differences(a, b, path=""):
        if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
            return {p for key in a for p in differences(a[key], b[key], f"{path}.{key}")}
        return set() if a == b else {path}

    assert differences(paper, postcapture) == {
        ".description",
        ".simulator_config.integration_scheme",
        ".controllers.tde_aismc.k_s_initial.all",
        ".controllers.tde_aismc.k_s_max",
    }


@pytest.mark.smoke
def test_overrides():
    scenario = load_scenario(
        "postcapture",
        [
            "controller=asmc",
            "disturbance.frequency_scale=3",
            "sensing.velocity_noise=0",
            "simulator_config.integration_scheme=explicit_euler",
            "random_seed=3",
            "controllers.tde_aismc.k_s_initial=20",
            "controllers.tde_aismc.k_s_initial.joint_2=25",
            "controllers.tde_aismc.k_s_max=null",
            "controllers.aismc.k_s_max.joint_1=1e1",
            "controllers.tdc.k_p={all: 1, joints: 2}",
            "payload.truth.center_of_mass=[0.1, 0, 0]",
            "disturbance.harmonics.joint_1.bias=1e-3",
        ],
    )
    assert scenario.controller == "asmc"
    assert scenario.disturbance.frequency_scale == 3.0
    assert scenario.sensing.velocity_noise == {"all": 0.0}
    assert scenario.simulator_config.integration_scheme == "explicit_euler"
    assert scenario.random_seed == 3
    assert scenario.controllers["tde_aismc"]["k_s_initial"] == {"all": 20.0, "joint_2": 25.0}
    assert scenario.controllers["tde_aismc"]["k_s_max"] is None
    assert scenario.controllers["aismc"]["k_s_max"] == {"joint_1": 10.0}
    assert scenario.controllers["tdc"]["k_p"] == {"all": 1.0, "joints": 2.0}
    assert scenario.payload.truth.center_of_mass == [0.1, 0.0, 0.0]
    harmonic = scenario.disturbance.harmonics["joint_1"]
    assert (harmonic.bias, harmonic.amplitude) == (1e-3, 0.1)


def test_a_file_needs_only_what_differs_and_finds_models_beside_it(tmp_path):
    (tmp_path / "mine.dmd.yaml").write_text(
        """
directives:
- add_model: {name: servicer, file: package://ffsm_drake/urdf/servicer.urdf}
- add_model: {name: debris, file: package://ffsm_drake/urdf/debris.urdf}
- add_weld: {parent: servicer::end_effector, child: debris::grasp}
"""
    )
    file = tmp_path / "mine.yaml"
    file.write_text(
        "duration: 0.1\nmodel: {directives: mine.dmd.yaml}\ncontrollers: {tdc: {k_d: "
        "50}}\ncontroller: tdc\n"
    )
    scenario = load_scenario(file)
    assert scenario.controllers["tdc"]["k_d"] == {"all": 50.0}
    assert simulate(scenario).outcome.completed


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "controllers.tdc.k_d=fast",
            "--set controllers.tdc.k_d.all: must be a number, not 'fast'",
        ),
        ("controllers.tde_aismc=3", "--set controllers.tde_aismc: must be a mapping, not 3"),
        (
            "controller=two words",
            "--set controller: 'two words' must be a name or module:attribute",
        ),
        (
            "blocks=3",
            "--set blocks: is a section, not a value; set one of its keys: blocks.reference",
        ),
        ("duration=-1", "--set duration: must be > 0 s"),
        ("sample_time=0", "--set sample_time: must be > 0 s"),
        ("random_seed=-1", "--set random_seed: must be from 0 to 2147483647"),
        (
            "reference.duration=1e15",
            "--set reference.duration: must be at most 1e+07 s",
        ),
        (
            "simulator_config.max_step_size=0",
            "--set simulator_config.max_step_size: must be > 0 s",
        ),
        ("payload.truth.center_of_mass=[1]", "must hold 3 values, not 1"),
        (
            "initial_posture.base_rpy=[0, 0]",
            "--set initial_posture.base_rpy: must hold 3 values, not 2",
        ),
        ("sensing.velocity_noise=-1e-6", "sensing.velocity_noise.all: must be >= 0, not -1e-06"),
        ("disturbance.frequency_scale=-1", "--set disturbance.frequency_scale: must be >= 0"),
        (
            "disturbance.harmonics.joint_1.amp=1",
            "unknown key; valid here: amplitude, frequency, phase, bias",
        ),
        ("reference.duration=0", "--set reference.duration: must be > 0 s"),
        (
            "reference.base_rotation=eigen",
            "reference.base_rotation: 'eigen' is unknown; choose one of eigenaxis, rpy",
        ),
        (
            "reference.kind=best",
            "reference.kind: 'best' is unknown; choose one of quintic, septic, optimal",
        ),
        ("reference.kind=optimal", "reference.plan: name the plan's file"),
        ("clearance=-1", "--set clearance: must be >= 0 m, not -1"),
        (
            "reference.goal=rest",
            "reference.goal: 'rest' is unknown; choose one of target_posture, stop",
        ),
        ("planning.reserve=1", "--set planning.reserve: must be from 0 to below 1, not 1"),
        ("planning.segments=1", "--set planning.segments: must be from 4 to 100, not 1"),
        (
            "planning.impulse_limit.joints=0",
            "--set planning.impulse_limit.joints: must be > 0, not 0",
        ),
        ("planning.end_rate=-1", "--set planning.end_rate: must be >= 0, not -1"),
        (
            "planning={time_weight: 0, effort_weight: 0}",
            "planning.time_weight: must be > 0 where effort_weight is 0",
        ),
        ("divergence_speed=0", "--set divergence_speed: must be > 0"),
        ("tolerance.joints=0", "--set tolerance.joints: must be > 0, not 0"),
    ],
)
@pytest.mark.smoke
def test_wrong_overrides_get_one_clear_line(override, expected):
    with pytest.raises(ScenarioError) as error:
        load_scenario("postcapture", [override])
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "controllers.tde_aimsc.k_d=3",
            "controllers.tde_aimsc: unknown controller; did you mean 'tde_aismc'?",
        ),
        (
            "controller=foo",
            "controller: 'foo' is unknown; give module:attribute, or choose one of tdc, asmc",
        ),
        ("controllers.tdc.k_d=-1", "controllers.tdc.k_d.all: must be >= 0, not -1"),
        ("controllers.aismc.beta=0", "controllers.aismc.beta.all: must be > 0"),
        ("controllers.asmc.epsilon=0", "controllers.asmc.epsilon: must be > 0"),
        (
            "model.directives=package://ffsm_drake/none.yaml",
            "model.directives: package://ffsm_drake/none.yaml: ",
        ),
        (
            "model.directives=package://other/none.yaml",
            "model.directives: package://other/none.yaml: ",
        ),
        ("payload.body=rock", "payload.body: no body 'rock'; choose one of"),
    ],
)
def test_values_that_only_the_model_can_judge(override, expected):
    with pytest.raises((ScenarioError, ModelError)) as error:
        make_closed_loop(load_scenario("postcapture", [override]))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_scenarios():
    with pytest.raises(
        ScenarioError,
        match=r"give a YAML file, or choose one of capture_on_thrusters, envisat.* and \d+ more; "
        "did you mean 'postcapture'",
    ):
        load_scenario("postcaptur")
    with pytest.raises(ScenarioError, match=r"none\.yaml: no such scenario file"):
        load_scenario("none.yaml")


def test_a_controller_that_is_nowhere_near_may_be_a_users():
    make_closed_loop(load_scenario("postcapture", ["controllers.Integral.k_i=3"]))
