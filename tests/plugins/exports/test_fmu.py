"""FMUs: the loop closed through those of the plant and of the law is the run of ``simulate``."""

import numpy as np
import pytest

from ffsm_drake import FfsmError, load_scenario, simulate

pytest.importorskip("pythonfmu3", reason="needs pythonfmu3, of the extra fmu")
fmpy = pytest.importorskip("fmpy", reason="needs FMPy, to drive FMUs")

from fmpy.fmi3 import FMU3Slave  # noqa: E402

from ffsm_drake.plugins.exports.fmu import export  # noqa: E402

SHORT = ("duration=1.0",)
OUTPUTS = ("position", "velocity", "measured_position", "measured_velocity")


class Driven:
    """An instance of an FMU, and its variables by group."""

    def __init__(self, path, folder, **parameters):
        description = fmpy.read_model_description(str(path), validate=True)
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.fmu = FMU3Slave(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), unzipdir=str(folder)),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=path.stem,
        )
        self.fmu.instantiate()
        if "payload_mass" in parameters:
            self.fmu.setFloat64([self.references["payload_mass"]], [parameters["payload_mass"]])
        if "seed" in parameters:
            self.fmu.setInt64([self.references["seed"]], [parameters["seed"]])
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def of(self, group):
        return [r for name, r in self.references.items() if name.startswith(f"{group}.")]

    def get(self, group):
        return np.array(self.fmu.getFloat64(self.of(group)))


@pytest.mark.slow
def test_the_loop_closed_through_fmus_is_the_run(tmp_path):
    scenario = load_scenario("postcapture", SHORT)
    for part in ("plant", "controller"):
        export(scenario, tmp_path / f"{part}.fmu", part)
    changed = {"payload_mass": 90.0, "seed": 3}
    plant = Driven(tmp_path / "plant.fmu", tmp_path / "p", **changed)
    law = Driven(tmp_path / "controller.fmu", tmp_path / "c")
    shared = [n for n in law.references if n in plant.references and not n.startswith("force.")]
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


@pytest.mark.parametrize(
    ("name", "override", "said"),
    [
        ("tumbling_capture", "duration=30", "capture: "),
        ("two_arms", "contacts.right.closes=2", "contacts: hands that close later"),
    ],
)
def test_a_capture_or_a_late_hand_is_refused(tmp_path, name, override, said):
    with pytest.raises(FfsmError, match=said):
        export(load_scenario(name, [override]), tmp_path / "plant.fmu")


def test_another_part_is_refused(tmp_path):
    with pytest.raises(FfsmError, match="plant, controller"):
        export(load_scenario("postcapture"), tmp_path / "plant.fmu", "arm")
