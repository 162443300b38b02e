"""FMUs: the loop closed through those of the plant and of the law is the run of ``simulate``."""

import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import FfsmError, load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.plugins.flight.fmu import write_fmu
from ffsm_drake.runs.log import RunLog

pytest.importorskip("fmpy", reason="needs FMPy, to drive FMUs")

from driven_fmu import Driven
from fmpy.fmi1 import FMICallException

from ffsm_drake.mission import Mission

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
pytestmark = needs_compiler
SHORT = ("duration=1.0",)
OUTPUTS = ("position", "velocity", "measured_position", "measured_velocity")


def flown(plant, law, count, step=0.01):
    """The outputs of the plant and the forces of the law over so many samples."""
    shared = [n for n in law.references if n in plant.references]
    shared = [n for n in shared if "." in n and not n.startswith("force.")]
    forces, outputs = [], []
    for k in range(count):
        seen = plant.fmu.getFloat64([plant.references[name] for name in shared])
        outputs.append({name: plant.get(name) for name in (*OUTPUTS, "applied_force", "error")})
        law.fmu.setFloat64([law.references[name] for name in shared], seen)
        law.fmu.doStep(k * step, step)
        forces.append(law.get("force"))
        plant.fmu.setFloat64(plant.of("force"), forces[-1])
        plant.fmu.doStep(k * step, step)
    outputs.append({name: plant.get(name) for name in (*OUTPUTS, "applied_force", "error")})
    for each in (plant, law):
        each.end()
    return {name: np.array([each[name] for each in outputs]) for name in outputs[0]}, forces


@pytest.mark.slow
def test_the_loop_closed_through_fmus_is_the_run(tmp_path):
    scenario = load_scenario("postcapture", SHORT)
    for part in ("plant", "controller"):
        arguments = ["export", str(tmp_path / f"{part}.fmu"), "postcapture", "--part", part]
        result = CliRunner().invoke(main, [*arguments, "--set", *SHORT])
        assert result.exit_code == 0, result.output
    changed = {"payload_mass": 90.0, "seed": 3}
    plant = Driven(tmp_path / "plant.fmu", tmp_path / "p", **changed)
    law = Driven(tmp_path / "controller.fmu", tmp_path / "c")
    count = 100
    outputs, forces = flown(plant, law, count)
    overrides = (*SHORT, "payload.truth.mass=90.0", "random_seed=3")
    data = simulate(load_scenario("postcapture", overrides), engine="drake").dataset
    assert data.sizes["time"] == count + 1
    for name in OUTPUTS:
        expected = data[name].values
        np.testing.assert_allclose(outputs[name], expected, rtol=0.0, atol=1e-9, err_msg=name)
    recorded = data.applied_force.values
    np.testing.assert_allclose(outputs["applied_force"][1:], recorded[:count], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(outputs["error"], data.error.values, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(forces, data.generalized_force.values[:count], rtol=0.0, atol=1e-9)
    other = simulate(scenario).dataset
    assert np.abs(other.velocity - data.velocity).max() > 1e-6  # the parameters count
    assert np.abs(data.velocity - data.measured_velocity).max() > 1e-9  # there is noise
    assert np.abs(data.disturbance_force).max() > 1e-3


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        pytest.param("postcapture", (), marks=pytest.mark.slow),
        ("slow_navigation", ("estimator.kind=kalman",)),
        ("flexible_panels", ()),
        ("flight_sensors", ()),
        ("thrusters_and_wheels", ()),
        ("reaction_null", ("controller=task_time_delay",)),
    ],
)
def test_it_has_the_bits_of_the_compiled_run(name, overrides, tmp_path):
    compiled = pytest.importorskip("ffsm_drake.plugins.compiled.engine")
    pytest.importorskip("llvmlite", reason="needs llvmlite")
    scenario = load_scenario(name, ("duration=0.5", *overrides))
    for part in ("plant", "controller"):
        write_fmu(scenario, tmp_path / f"{part}.fmu", part, table=True)
    (log,) = compiled.Compiled().run_all([Mission(scenario)])
    assert isinstance(log, RunLog)
    plant = Driven(tmp_path / "plant.fmu", tmp_path / "p")
    law = Driven(tmp_path / "controller.fmu", tmp_path / "c")
    count, step = len(log.time) - 1, scenario.sample_time
    outputs, forces = flown(plant, law, count, step)
    size = outputs["position"].shape[1]
    expected = {
        "position": log.series["state"][:, :size],
        "velocity": log.series["state"][:, size:],
        "measured_position": log.series["measurement"][:, :size],
        "measured_velocity": log.series["measurement"][:, size:],
    }
    for signal, values in expected.items():
        np.testing.assert_array_equal(outputs[signal], values, err_msg=signal)
    given = log.series["generalized_force"][:count]
    np.testing.assert_allclose(forces, given, rtol=0.0, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "overrides", "changed"),
    [
        ("two_arms", (), {}),
        ("postcapture", ("controller=mpc",), {}),
        ("postcapture", ("environment={}",), {"payload_mass": 140.0, "seed": 5}),
        ("flight_sensors", (), {"payload_mass": 140.0, "seed": 5}),
        ("thrusters_only", ("faults={}",), {}),
        ("seven_joint", (), {}),
        ("planar_detumble", (), {}),
    ],
)
def test_a_plant_under_the_forces_of_a_run_moves_as_in_the_run(name, overrides, changed, tmp_path):
    """Bit for bit, unless the payload has another mass; also of laws that are no C."""
    compiled = pytest.importorskip("ffsm_drake.plugins.compiled.engine")
    pytest.importorskip("llvmlite", reason="needs llvmlite")
    overrides = ("duration=0.5", *overrides)
    write_fmu(load_scenario(name, overrides), tmp_path / "plant.fmu", table=True)
    values = {"payload_mass": "payload.truth.mass", "seed": "random_seed"}
    overrides += tuple(f"{values[each]}={value}" for each, value in changed.items())
    scenario = load_scenario(name, overrides)
    (log,) = compiled.Compiled().run_all([Mission(scenario)])
    plant = Driven(tmp_path / "plant.fmu", tmp_path / "p", **changed)
    expected = np.hstack([log.series["state"], log.series["measurement"]])
    found = []
    for k, force in enumerate(log.series["generalized_force"]):
        found.append(np.concatenate([plant.get(group) for group in OUTPUTS]))
        if k + 1 < len(expected):
            plant.fmu.setFloat64(plant.of("force"), force)
            plant.fmu.doStep(k * scenario.sample_time, scenario.sample_time)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 if changed else 0.0)
    plant.end()


@pytest.mark.slow
def test_a_plant_ends_and_refuses_parameters_that_it_cannot_have(tmp_path):
    write_fmu(load_scenario("postcapture", ("duration=0.03",)), tmp_path / "plant.fmu")
    given = tmp_path / "plant.fmu", tmp_path / "p"
    bad = [("payload_mass", value) for value in (0.0, -1.0, np.nan, np.inf)]
    for name, value in (*bad, ("seed", -1), ("seed", 2**31)):
        plant = Driven(*given, begun=False, **{name: value})
        with pytest.raises(FMICallException):
            plant.begin()
    plant = Driven(*given)
    first = plant.get("measured_velocity")
    assert [plant.fmu.doStep(0.01 * k, 0.01)[1] for k in range(3)] == [False] * 3
    with pytest.raises(FMICallException):
        plant.fmu.doStep(0.03, 0.01)
    assert b"the run has ended" in plant.messages[-1]
    plant.fmu.reset()
    plant.begin()
    np.testing.assert_array_equal(plant.get("measured_velocity"), first)
    plant.fmu.setFloat64(plant.of("force"), [1e9] * len(plant.of("force")))
    # terminateSimulation: it diverges, which the next sample sees, as in the run
    assert [plant.fmu.doStep(0.01 * k, 0.01)[1] for k in range(2)] == [False, True]
    with pytest.raises(FMICallException):
        plant.fmu.doStep(0.02, 0.01)


@pytest.mark.parametrize(
    ("name", "override", "said"),
    [
        ("tumbling_capture", "duration=30", "capture: "),
        ("two_arms", "contacts.right.closes=2", "contacts: hands that close later"),
        ("thrusters_only", "supervisor={}", "cannot be exported as C: the supervisor"),
    ],
)
def test_a_capture_or_a_late_hand_is_refused(name, override, said, tmp_path):
    with pytest.raises(FfsmError, match=said):
        write_fmu(load_scenario(name, [override]), tmp_path / "plant.fmu")


def test_another_part_is_refused(tmp_path):
    with pytest.raises(FfsmError, match="plant, controller"):
        write_fmu(load_scenario("postcapture"), tmp_path / "plant.fmu", "arm")
