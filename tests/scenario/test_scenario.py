"""Scenarios: what ships, how files and overrides combine, and one clear line for every mistake."""

import pytest

from ffsm_drake import (
    ModelError,
    ScenarioError,
    load_scenario,
    make_closed_loop,
    override_scenario,
    simulate,
)
from ffsm_drake.scenario import scenario_from_dict, scenario_to_dict, shipped_scenarios


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


@pytest.mark.parametrize("name", ["paper", "postcapture"])
@pytest.mark.smoke
def test_plain_data_round_trip(name):
    data = scenario_to_dict(load_scenario(name, ["controllers.aismc.k_s_max.joint_1=30"]))
    assert scenario_to_dict(scenario_from_dict(data)) == data


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


def test_override_scenario_leaves_the_given_one_alone():
    scenario = load_scenario("postcapture")
    assert override_scenario(scenario, ["duration=5"]).duration == 5.0
    assert scenario.duration == 20.0


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
        ("controler=tdc", "--set controler: unknown key; valid here: description, random_seed"),
        ("duration.x=3", "--set duration.x: unknown key; duration holds a single value"),
        (
            "controllers.tdc.k_d=fast",
            "--set controllers.tdc.k_d.all: must be a number, not 'fast'",
        ),
        (
            "controllers.tdc.k_d=[1, 2]",
            "--set controllers.tdc.k_d.all: must be a number, not [1, 2]",
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
        ("duration=0.001", "0.01 s is longer than duration, 0.001 s"),
        ("duration=nan", "--set duration: must be finite, not 'nan'"),
        ("sample_time=0", "--set sample_time: must be > 0 s"),
        ("random_seed=1.5", "--set random_seed: must be a whole number, not 1.5"),
        ("random_seed=-1", "--set random_seed: must be from 0 to 2147483647"),
        (
            "simulator_config.integration_scheme=rk9",
            "'rk9' is unknown; choose one of bogacki_shampine3",
        ),
        (
            "reference.duration=1e15",
            "--set reference.duration: must be at most 1e+07 s",
        ),
        (
            "simulator_config.max_step_size=0",
            "--set simulator_config.max_step_size: must be > 0 s",
        ),
        ("simulator_config.use_error_control=maybe", "must be true or false, not 'maybe'"),
        ("payload.truth.mass=-5", "--set payload.truth.mass: must be > 0 kg, not -5"),
        ("payload.nominal.inertia=[1, 1, 5]", "violate the triangle inequality"),
        ("payload.nominal.inertia=[1, 1]", "must hold three moments [Ixx, Iyy, Izz]"),
        (
            "payload.nominal.inertia=[1, 1, 1, 2, 0, 0]",
            "--set payload.nominal.inertia: must be positive definite",
        ),
        ("payload.truth.center_of_mass=[1]", "must hold 3 values, not 1"),
        (
            "initial_posture.base_rpy=[0, 0]",
            "--set initial_posture.base_rpy: must hold 3 values, not 2",
        ),
        ("sensing.velocity_noise=-1e-6", "sensing.velocity_noise.all: must be >= 0, not -1e-06"),
        (
            "sensing.velocity_noise",
            "--set sensing.velocity_noise: has no value; write --set sensing.velocity_noise=VALUE",
        ),
        ("=3", "has no value; write --set KEY=VALUE"),
        ("duration=[1", "--set duration: value is not valid YAML"),
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
            "sensing.velocity_noise.joint_9=1",
            "sensing.velocity_noise.joint_9: unknown coordinate; valid here: all,",
        ),
        (
            "controllers.tdc.kd=3",
            "controllers.tdc.kd: unknown gain; tdc has k_d, k_p; did you mean 'k_d'?",
        ),
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
        ("controllers.tdc.k_d.elbow=1", "controllers.tdc.k_d.elbow: unknown coordinate"),
        ("disturbance.harmonics.arm.bias=1", "disturbance.harmonics.arm: unknown coordinate"),
        ("initial_posture.joints.joint_6=1", "initial_posture.joints.joint_6: unknown coordinate"),
        (
            "sensing.position_noise.base_rotation_x=1",
            "must be the same for the three base_rotation coordinates",
        ),
        (
            "model.directives=package://ffsm_drake/none.yaml",
            "model.directives: package://ffsm_drake/none.yaml: ",
        ),
        (
            "model.directives=package://other/none.yaml",
            "model.directives: package://other/none.yaml: ",
        ),
        (
            "model.end_effector=servicer::hand",
            "model.end_effector: no frame 'servicer::hand'; choose one of",
        ),
        ("payload.body=rock", "payload.body: no body 'rock'; choose one of"),
    ],
)
def test_values_that_only_the_model_can_judge(override, expected):
    with pytest.raises((ScenarioError, ModelError)) as error:
        make_closed_loop(load_scenario("postcapture", [override]))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("duration: [", "is not valid YAML"),
        ("- 1", "must be a mapping with keys description"),
        ("payload: {truth: 3}", "payload.truth: must be a mapping with keys mass"),
        ("disturbance: {harmonics: [1]}", "disturbance.harmonics: must be a mapping"),
        (
            "initial_posture: {base_position: 3}",
            "initial_posture.base_position: must be a list, not 3",
        ),
        (
            "initial_posture: {base_position: [1, x, 2]}",
            "initial_posture.base_position[1]: must be a number, not 'x'",
        ),
        ("description: 3", "description: must be text, not 3"),
        ("controler: tdc", "controler: unknown key"),
    ],
)
def test_broken_files_name_the_file_and_the_key(tmp_path, text, expected):
    file = tmp_path / "broken.yaml"
    file.write_text(text)
    with pytest.raises(ScenarioError) as error:
        load_scenario(file)
    assert str(error.value).startswith(str(file))
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


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ('<inertia ixx="16.7" iyy="16.7" izz="16.7"', '<inertia ixx="1" iyy="1" izz="16.7"'),
        ('<link name="debris">', '<link name="debris'),
    ],
)
def test_a_urdf_that_is_not_physical_or_not_xml_is_refused(tmp_path, fault, expected):
    """Without strict parsing Drake would fly a solid sphere instead."""
    from ffsm_drake.spacecraft.plant import models_dir

    text = (models_dir() / "urdf" / "debris.urdf").read_text()
    assert fault in text
    (tmp_path / "debris.urdf").write_text(text.replace(fault, expected))
    (tmp_path / "m.dmd.yaml").write_text(
        (models_dir() / "postcapture.dmd.yaml")
        .read_text()
        .replace("package://ffsm_drake/urdf/debris.urdf", f"file://{tmp_path}/debris.urdf")
    )
    with pytest.raises(ModelError) as error:
        make_closed_loop(load_scenario("postcapture", [f"model.directives={tmp_path}/m.dmd.yaml"]))
    assert "\n" not in str(error.value)


def test_a_welded_base_is_refused(tmp_path):
    (tmp_path / "m.dmd.yaml").write_text(
        """
directives:
- add_model: {name: servicer, file: package://ffsm_drake/urdf/servicer.urdf}
- add_weld: {parent: world, child: servicer::base}
"""
    )
    with pytest.raises(ModelError, match="no floating base"):
        make_closed_loop(load_scenario("postcapture", [f"model.directives={tmp_path}/m.dmd.yaml"]))


def test_a_controller_that_is_nowhere_near_may_be_a_users():
    make_closed_loop(load_scenario("postcapture", ["controllers.Integral.k_i=3"]))


def test_numbers_are_numbers_with_an_exponent_too(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "blocks: {sensing: {system: 'a:b', settings: {x: 1e-5, y: 1.5E3, z: 2e+1}}}\n"
    )
    settings = load_scenario(tmp_path / "mine.yaml").blocks.sensing["own"].settings
    assert settings == {"x": 1e-5, "y": 1500.0, "z": 20.0}
