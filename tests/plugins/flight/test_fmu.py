"""The law as an FMU: its forces are those of the run, and bad calls have no effect."""

import ctypes
import re
import shutil
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
from children import finished

from ffsm_drake import FfsmError, load_scenario
from ffsm_drake.plugins.flight.fmu import PARTS, write_fmu
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.recorded import recorded

fmpy = pytest.importorskip("fmpy", reason="needs FMPy, to drive FMUs")

from driven_fmu import Driven  # noqa: E402
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

SHORT = ("duration=0.5",)
STEP = 0.01
NAMES = ("measured_position", "measured_velocity", "desired_position", "desired_velocity")
NAMES += ("desired_acceleration", "applied_force", "is_new_position", "is_new_velocity")
NAMES += ("desired_frame", "measured_wrench")
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
pytestmark = needs_compiler


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("postcapture", SHORT)


@pytest.fixture(scope="module")
def made(scenario, tmp_path_factory):
    """The FMU, its folder, and the samples of the run."""
    folder = tmp_path_factory.mktemp("fmu")
    write_fmu(scenario, folder / "law.fmu", "controller")
    return folder / "law.fmu", folder / "inside", recorded(scenario, LawFiles.of(scenario).reads)


def inputs_of(law):
    return [r for group in NAMES for r in law.of(group)]


def forces(law, rows, *, first=0):
    """The forces at samples whose inputs are given."""
    references, found = inputs_of(law), []
    for k, row in enumerate(rows, start=first):
        law.fmu.setFloat64(references, row)
        assert law.fmu.doStep(k * STEP, STEP)[1:] == (False, False, pytest.approx((k + 1) * STEP))
        found.append(law.get("force"))
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        pytest.param("postcapture", (), marks=pytest.mark.slow),
        pytest.param("slow_navigation", ("estimator.kind=kalman",), marks=pytest.mark.long),
        pytest.param("reaction_null", ("controller=task_time_delay",), marks=pytest.mark.long),
    ],
)
def test_forces_are_those_of_the_run_bit_for_bit(name, overrides, tmp_path):
    scenario = load_scenario(name, (*SHORT, *overrides))
    write_fmu(scenario, tmp_path / "law.fmu", "controller")
    run = recorded(scenario, LawFiles.of(scenario).reads)
    law = Driven(tmp_path / "law.fmu", tmp_path / "inside")
    rows = run.inputs
    if law.of("is_new_position"):
        start = rows.shape[1] - len(law.of("desired_frame") + law.of("measured_wrench"))
        start -= len(law.of("is_new_position")) * 2 + 1
        rows = np.delete(rows, start, axis=1)  # hidden: the quaternion has one entry more
    assert len(inputs_of(law)) == rows.shape[1]
    assert run.exact
    np.testing.assert_array_equal(forces(law, rows), run.commanded)
    assert np.abs(run.commanded).max() > 1e-3
    law.end()


@pytest.mark.long
def test_a_law_with_a_capture_goes_on_after_the_grasp(tmp_path):
    scenario = load_scenario("tumbling_capture")
    write_fmu(scenario, tmp_path / "law.fmu", "controller")
    run = recorded(scenario, LawFiles.of(scenario).reads)
    law = Driven(tmp_path / "law.fmu", tmp_path / "inside")
    for k, (_, is_first, holds) in enumerate(run.wholes):
        law.set_parameters(is_first=bool(is_first), holds_target=bool(holds))
        (found,) = forces(law, run.inputs[k : k + 1], first=k)
        np.testing.assert_allclose(found, run.commanded[k], rtol=0.0, atol=1e-9)
    assert set(run.wholes[:, 2]) == {0, 1}
    law.end()


@pytest.mark.slow
def test_the_own_reference_is_that_of_the_run(made):
    path, folder, run = made
    law = Driven(path, folder, own_reference=True)
    rows = run.inputs.copy()
    desired = len(law.of("measured_position") + law.of("measured_velocity"))
    desired = slice(desired, 2 * desired + len(law.of("desired_acceleration")))
    rows[:, desired] = np.nan  # not read
    assert forces(law, rows) == pytest.approx(run.commanded, abs=1e-9)


@pytest.mark.slow
def test_a_program_for_fmus_simulates_it(made):
    """FMPy's own master, with inputs at each sample."""
    path, _, run = made
    names = [v.name for v in fmpy.read_model_description(str(path)).modelVariables]
    names = [name for group in NAMES for name in names if name.startswith(f"{group}.")]
    count = len(run.inputs)
    given = np.zeros(count, dtype=[("time", float), *((name, float) for name in names)])
    given["time"] = STEP * np.arange(count)
    for name, column in zip(names, run.inputs.T, strict=True):
        given[name] = column
    found = fmpy.simulate_fmu(
        str(path), stop_time=(count - 1) * STEP, output_interval=STEP, input=given,
        output=["force.joint_1", "status"],
    )  # fmt: skip
    expected = run.commanded[: count - 1, 6]
    np.testing.assert_allclose(found["force.joint_1"][1:], expected, rtol=0.0, atol=1e-9)
    assert not found["status"].any()


@pytest.mark.slow
def test_gains_are_parameters_with_units_that_count(made, tmp_path):
    path, folder, run = made
    law = Driven(path, folder)
    gain = law.variables["gain.k_p.joint_1"]
    assert (gain.causality, gain.variability, gain.unit) == ("parameter", "tunable", "1/s^2")
    assert law.variables["gain.alpha.base_position_x"].unit == "1/(m s)"
    assert law.variables["gain.alpha.joint_1"].unit == "1/(rad s)"
    changed = load_scenario("postcapture", (*SHORT, "controllers.tde_aismc.k_p.joint_1=201"))
    write_fmu(changed, tmp_path / "law.fmu", "controller")
    other = Driven(tmp_path / "law.fmu", tmp_path / "inside")
    assert float(gain.start) != 201.0
    assert float(other.variables["gain.k_p.joint_1"].start) == 201.0
    half = len(run.inputs) // 2
    np.testing.assert_array_equal(forces(law, run.inputs[:half]), run.commanded[:half])
    law.set_parameters(**{"gain.k_p.joint_1": 201.0})  # tunable: also between steps
    after = forces(law, run.inputs[half:], first=half)
    assert np.abs(after - run.commanded[half:]).max() > 1e-3
    law.fmu.reset()
    law.set_parameters(**{"gain.k_p.joint_1": 201.0})
    law.begin()
    np.testing.assert_array_equal(forces(law, run.inputs), forces(other, run.inputs))


@pytest.mark.slow
def test_states_and_resets(made):
    path, folder, run = made
    law, other = Driven(path, folder), Driven(path, folder)
    first = forces(law, run.inputs[:20])
    state = law.fmu.getFMUState()
    rest = forces(law, run.inputs[20:], first=20)
    law.fmu.setFMUState(state)
    np.testing.assert_array_equal(forces(law, run.inputs[20:], first=20), rest)
    text = law.fmu.serializeFMUState(state)
    found = other.fmu.deserializeFMUState(text)
    other.fmu.setFMUState(found)
    np.testing.assert_array_equal(forces(other, run.inputs[20:], first=20), rest)
    for bad in (text[:-1], b"x" + text[1:], b""):
        with pytest.raises(FMICallException):
            other.fmu.deserializeFMUState(bad)
    law.fmu.freeFMUState(state)
    other.fmu.freeFMUState(found)
    law.fmu.reset()
    law.begin()
    np.testing.assert_array_equal(forces(law, run.inputs[:20]), first)
    law.fmu.reset()
    law.begin(start=100.0)
    law.fmu.setFloat64(inputs_of(law), run.inputs[0])
    law.fmu.doStep(100.0, STEP)
    np.testing.assert_array_equal(law.get("force"), first[0])
    assert law.fmu.getFloat64([law.references["time"]]) == [100.0 + STEP]


@pytest.mark.slow
def test_instances_are_independent(made):
    """Also at the same time."""
    path, folder, run = made
    laws = [Driven(path, folder) for _ in range(4)]
    scales = (1.0, 1.1, 0.9, 1.0)
    alone = [forces(Driven(path, folder), scaled(law, run.inputs, scale))
             for law, scale in zip(laws, scales, strict=True)]  # fmt: skip
    found = [None] * len(laws)

    def fly(index):
        found[index] = forces(laws[index], scaled(laws[index], run.inputs, scales[index]))

    threads = [threading.Thread(target=fly, args=(index,)) for index in range(len(laws))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_array_equal(found, alone)
    assert np.abs(found[1] - found[0]).max() > 1e-3


def scaled(law, rows, scale):
    """Inputs with other velocities."""
    rows = rows.copy()
    first = len(law.of("measured_position"))
    rows[:, first : first + len(law.of("measured_velocity"))] *= scale
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, 5e-324])
def test_bad_inputs_have_a_defined_force(made, bad):
    """The last force is held, then it is zero; good inputs are followed again."""
    path, folder, run = made
    law = Driven(path, folder)
    last = forces(law, run.inputs[:5])[-1]
    row = run.inputs[5].copy()
    row[: len(law.of("measured_position"))] = bad
    seen = []
    for k in range(5, 20):
        found = forces(law, [row], first=k)[0]
        seen.append(law.wholes()[0])
        np.testing.assert_array_equal(found, last if seen[-1] == 1 else 0.0 * last)
        assert law.wholes()[1] == 1  # LAW_BAD_MEASUREMENT
    assert seen == [1] * 10 + [2] * 5
    assert np.isfinite(forces(law, run.inputs[20:21], first=20)).all()
    assert law.wholes()[:2] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, -STEP, 0.02, 0.005, np.nan, np.inf, 1e-300])
def test_another_step_is_an_error_without_effect(made, size):
    path, folder, run = made
    law = Driven(path, folder)
    found = forces(law, run.inputs[:1])
    for begin, step in ((STEP, size), (0.0, STEP), (np.nan, STEP), (np.inf, STEP), (77.0, STEP)):
        with pytest.raises(FMICallException):
            law.fmu.doStep(begin, step)
        np.testing.assert_array_equal(law.get("force"), found[0])
    assert b"one control sample, 0.01 s" in law.messages[0]
    assert b"must begin at t = 0.01 s, not 77" in law.messages[-1]
    rest = forces(law, run.inputs[1:], first=1)
    np.testing.assert_array_equal(rest, run.commanded[1:])


@pytest.mark.slow
def test_calls_out_of_turn_are_errors(made):
    path, folder, run = made
    law = Driven(path, folder, begun=False)
    with pytest.raises(FMICallException):
        law.fmu.doStep(0.0, STEP)
    with pytest.raises(FMICallException):
        law.fmu.exitInitializationMode()
    with pytest.raises(FMICallException):
        law.fmu.enterInitializationMode(startTime=np.nan)
    law.begin()
    for call in (law.begin, law.fmu.enterEventMode, law.fmu.enterStepMode):
        with pytest.raises(FMICallException):
            call()
    with pytest.raises(FMICallException):
        law.set_parameters(own_reference=True)  # fixed
    np.testing.assert_array_equal(forces(law, run.inputs), run.commanded)
    law.fmu.terminate()
    with pytest.raises(FMICallException):
        law.fmu.doStep(len(run.inputs) * STEP, STEP)
    law.fmu.guid = "another"
    with pytest.raises(Exception, match="instantiate"):
        law.fmu.instantiate(loggingOn=True)


@pytest.mark.slow
def test_hostile_references_and_sizes(made):
    """No call reads or writes outside of the variables, and none that is refused has an effect."""
    path, folder, run = made
    law = Driven(path, folder)
    fmu, instance = law.fmu, law.fmu.component
    last = max(law.references.values())
    output, gain = law.references["force.joint_1"], law.references["gain.k_p.joint_1"]
    measured = law.references["measured_velocity.joint_1"]
    draw = np.random.default_rng(0)
    for _ in range(2000):
        references = draw.choice([last + 1, 2**31, 2**32 - 1, output, gain, measured, 0, 5], size=3)
        size = int(draw.choice([0, 1, 2, 4, 2**31, 2**63]))
        values = (ctypes.c_double * 3)(*draw.choice([np.nan, 1.0, np.inf], size=3))
        given = (ctypes.c_uint * 3)(*references.tolist())
        for call in (fmu.fmi3SetFloat64, fmu.fmi3GetFloat64):
            with pytest.raises(FMICallException):
                call(instance, given, 3, values, size)
    for call in (fmu.setFloat64, fmu.setBoolean, fmu.setInt64, fmu.setUInt32, fmu.setFloat32):
        for reference in (last + 1, 2**32 - 1, output, 0):
            with pytest.raises(FMICallException):
                call([measured, reference] if call == fmu.setFloat64 else [reference], [1, 1][:1])
    with pytest.raises(FMICallException):  # the first one is not set either
        fmu.setFloat64([measured, output], [7.0, 7.0])
    assert fmu.getFloat64([measured]) == [0.0]
    for call in (fmu.fmi3SetFloat64, fmu.fmi3GetFloat64):
        with pytest.raises(FMICallException):
            call(instance, None, 1, None, 1)
        with pytest.raises(FMICallException):
            call(None, None, 0, None, 0)
        call(instance, None, 0, None, 0)
    for reference in (2**32 - 1, measured):
        with pytest.raises(FMICallException):
            fmu.getUInt32([reference])
    np.testing.assert_array_equal(forces(law, run.inputs), run.commanded)


@pytest.mark.slow
def test_every_function_of_the_standard_is_there(made):
    """Those of FMPy's headers, which are the standard's."""
    path, folder, _ = made
    Driven(path, folder)
    header = Path(fmpy.__file__).parent / "c-code" / "fmi3FunctionTypes.h"
    names = re.findall(r"\b(fmi3\w+?)TYPE\b", header.read_text())
    (library,) = (folder / "binaries").rglob("*.so")
    loaded = ctypes.CDLL(str(library))
    assert len(names) > 70
    assert [name for name in names if not hasattr(loaded, name)] == []
    assert not hasattr(loaded, "law_step")  # two FMUs in one program have two
    with zipfile.ZipFile(path) as archive:
        assert "python" not in "".join(archive.namelist()).lower()


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_its_sources_compile_without_warnings(compiler, part, scenario, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    write_fmu(scenario, tmp_path / "it.fmu", part)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
    assert validate_fmu(str(tmp_path / "it.fmu")) == []
    listed = sources(tmp_path)
    assert listed == ["absent.c", "fmu.c", "law.c" if part == "controller" else "plant.c"]
    command = [compiler, *strict, "-O0", "-c", "-DFMI3_FUNCTION_PREFIX=mine_", *listed]
    done = finished(command, cwd=tmp_path / "sources")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def sources(folder):
    """The C files that the FMU in a folder lists, which are in its folder ``sources``."""
    fmpy.extract(str(folder / "it.fmu"), unzipdir=str(folder))
    told = (folder / "sources" / "buildDescription.xml").read_text()
    return re.findall(r'SourceFile name="(\S+?)"', told)


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_hostile_numbers_and_states_under_sanitizers(part, scenario, tmp_path):
    """No trap, and finite outputs of a law whatever its inputs, gains and memory are."""
    write_fmu(scenario, tmp_path / "it.fmu", part)
    listed = sources(tmp_path)
    shutil.copy(Path(__file__).parent / "hostile_fmu.c", tmp_path / "sources")
    flags = ["-std=c99", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    flags.append(f"-DIS_LAW={int(part == 'controller')}")
    command = ["gcc", *flags, "hostile_fmu.c", *listed, "-o", "hostile", "-lm"]
    built = finished(command, cwd=tmp_path / "sources")
    assert built.returncode == 0, built.stderr
    done = finished([str(tmp_path / "sources" / "hostile")])
    assert done.returncode == 0, done.stderr[:2000]
    assert int(done.stdout.split()[0]) > 5000, done.stdout


@pytest.mark.slow
def test_the_same_scenario_gives_the_same_file(made, scenario, tmp_path):
    write_fmu(scenario, tmp_path / "law.fmu", "controller")
    assert (tmp_path / "law.fmu").read_bytes() == made[0].read_bytes()


@pytest.mark.slow
def test_single_precision(made, tmp_path, scenario):
    *_, run = made
    write_fmu(scenario, tmp_path / "law.fmu", "controller", float32=True)
    law = Driven(tmp_path / "law.fmu", tmp_path / "inside")
    found = forces(law, run.inputs)
    np.testing.assert_array_equal(found, found.astype(np.float32))
    assert 0.0 < np.abs(found[0] - run.commanded[0]).max() < 1e-5


@pytest.mark.smoke
def test_a_missing_compiler_is_one_line(monkeypatch, tmp_path, scenario):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FfsmError, match=r"^an FMU needs a C compiler: none of cc, gcc, clang"):
        write_fmu(scenario, tmp_path / "law.fmu", "controller")
    assert not (tmp_path / "law.fmu").exists()


@pytest.mark.parametrize("name", ["mpc", "nmpc"])
def test_a_law_that_is_no_c_is_refused(name, tmp_path):
    scenario = load_scenario("postcapture", (*SHORT, f"controller={name}"))
    with pytest.raises(FfsmError, match=f"controller '{name}' cannot be exported as C: "):
        write_fmu(scenario, tmp_path / "law.fmu", "controller")
