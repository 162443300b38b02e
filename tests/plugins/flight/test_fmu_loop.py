"""FMUs: the loop closed through those of the plant and of the law is the run of ``simulate``."""

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import load_scenario, simulate
from ffsm_drake.cli import main

pytest.importorskip("pythonfmu3", reason="needs pythonfmu3, of the extra fmu")
pytest.importorskip("fmpy", reason="needs FMPy, to drive FMUs")
pytest.importorskip("ffsm_drake.plugins.exports")

from driven_fmu import Driven

SHORT = ("duration=1.0",)
OUTPUTS = ("position", "velocity", "measured_position", "measured_velocity")


@pytest.mark.slow
def test_the_loop_closed_through_fmus_is_the_run(tmp_path):
    scenario = load_scenario("postcapture", SHORT)
    for part in ("plant", "controller"):
        arguments = ["export", str(tmp_path / f"{part}.fmu"), "postcapture", "--part", part]
        result = CliRunner().invoke(main, arguments)
        assert result.exit_code == 0, result.output
    changed = {"payload_mass": 90.0, "seed": 3}
    plant = Driven(tmp_path / "plant.fmu", tmp_path / "p", **changed)
    law = Driven(tmp_path / "controller.fmu", tmp_path / "c")
    shared = [n for n in law.references if n in plant.references]
    shared = [n for n in shared if "." in n and not n.startswith("force.")]
    forces, applied, outputs = [], [], []
    step, count = scenario.sample_time, 100
    for k in range(count):
        seen = plant.fmu.getFloat64([plant.references[name] for name in shared])
        outputs.append({name: plant.get(name) for name in OUTPUTS})
        applied.append(plant.get("applied_force"))  # over the last period
        law.fmu.setFloat64([law.references[name] for name in shared], seen)
        law.fmu.doStep(k * step, step)
        forces.append(law.get("force"))
        plant.fmu.setFloat64(plant.of("force"), forces[-1])
        plant.fmu.doStep(k * step, step)
    outputs.append({name: plant.get(name) for name in OUTPUTS})
    for each in (plant, law):
        each.fmu.terminate()
        each.fmu.freeInstance()
    overrides = (*SHORT, "payload.truth.mass=90.0", "random_seed=3")
    data = simulate(load_scenario("postcapture", overrides)).dataset
    assert data.sizes["time"] == count + 1
    for name in OUTPUTS:
        found = [each[name] for each in outputs]
        np.testing.assert_allclose(found, data[name].values, rtol=0.0, atol=1e-9, err_msg=name)
    recorded = data.applied_force.values
    np.testing.assert_allclose(applied[1:], recorded[: count - 1], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(forces, data.generalized_force.values[:count], rtol=0.0, atol=1e-9)
    other = simulate(scenario).dataset
    assert np.abs(other.velocity - data.velocity).max() > 1e-6  # the parameters count
    assert np.abs(data.velocity - data.measured_velocity).max() > 1e-9  # there is noise
    assert np.abs(data.disturbance_force).max() > 1e-3
