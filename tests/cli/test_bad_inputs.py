"""Bad input of every kind gets one line that says where, what is wrong and what would be right, and
leaves no files.
"""

import dataclasses
import errno
import io
import json
import os
import resource
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import RecordError, RunRecord, load_scenario, simulate
from ffsm_drake.analysis import analyze
from ffsm_drake.cli import main
from ffsm_drake.common import files
from ffsm_drake.runs.record import StaleReportWarning
from ffsm_drake.show.figures import run as run_figures
from ffsm_drake.show.figures.analysis import plot_analysis
from ffsm_drake.show.report.page import render_report

SHORT = "--set duration=0.05"

SERVICER = """<robot name="mine">
  <link name="base"><inertial><mass value="400"/>
    <inertia ixx="200" iyy="200" izz="200" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0 0 0.5"/><mass value="10"/>
    <inertia ixx="0.9" iyy="0.9" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/></joint>
  <link name="hand"><inertial><mass value="5"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="wrist" type="continuous"><parent link="arm"/><child link="hand"/>
    <origin xyz="0 0 1"/>
    <axis xyz="1 0 0"/></joint>
  <frame name="end_effector" link="hand" xyz="0 0 0.1" rpy="0 0 0"/>
</robot>
"""
DEBRIS = """<robot name="rock"><link name="debris"><inertial><mass value="100"/>
  <inertia ixx="16" iyy="16" izz="16" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <frame name="grasp" link="debris" xyz="0 0 -0.5" rpy="0 0 0"/></robot>
"""
STRAY_LINK = """<link name="stray"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
"""
URDFS = {"servicer.urdf": SERVICER, "debris.urdf": DEBRIS}
MINE = "model: {servicer: servicer.urdf, debris: debris.urdf}\n"

CONTROLLERS = """
import dataclasses
import os
import sys
import threading
import time
import numpy as np
from pydrake.systems.framework import LeafSystem
from ffsm_drake import ControlLaw, PlantModel, gain
from ffsm_drake.systems.controllers.laws.tdc import Tdc

@dataclasses.dataclass(frozen=True)
class Good(ControlLaw):
    k: np.ndarray = gain(1.0)
    def step(self, sample, state):
        return 0.0 * sample.v, {}

class NanForce(Good):
    def step(self, sample, state):
        return np.full(sample.v.size, np.nan), {}

@dataclasses.dataclass(frozen=True)
class NanState(ControlLaw):
    model: PlantModel
    def step(self, sample, state):
        self.model.calc_mass_matrix(sample.q * np.nan)

class WrongSize(Good):
    def step(self, sample, state):
        return np.zeros(3), {}

class ReturnsNone(Good):
    def step(self, sample, state):
        pass

class OnlyForce(Good):
    def step(self, sample, state):
        return 0.0 * sample.v

class TextForce(Good):
    def step(self, sample, state):
        return ["much"] * sample.v.size, {}

class Forgets(Good):
    def initial_state(self):
        return {"integral": np.zeros(3)}

class Invents(Good):
    def step(self, sample, state):
        return 0.0 * sample.v, {"integral": sample.v}

class ListMemory(Good):
    def initial_state(self):
        return [np.zeros(3)]

class Raises(Good):
    def step(self, sample, state):
        return {}["gain"]

class Leaves(Good):
    def step(self, sample, state):
        sys.exit(0)

class Inf(Good):
    def initial_state(self):
        return {"samples": np.zeros(1)}
    def step(self, sample, state):
        force = 0.0 * sample.v
        force[3] = np.inf if state["samples"] == 2 else 0.0
        return force, {"samples": state["samples"] + 1}

class Large(Inf):
    def step(self, sample, state):
        return np.full(sample.v.size, 1e308), {"samples": state["samples"]}

class Mute(Exception):
    def __str__(self):
        raise RuntimeError("not even this")

class RaisesMute(Good):
    def step(self, sample, state):
        raise Mute

class RaisesExit(Good):
    def step(self, sample, state):
        raise GeneratorExit("gone")

class ExitsAtOnce(Good):
    def __init__(self, **gains):
        raise GeneratorExit("gone")

class Elsewhere(Good):
    def step(self, sample, state):
        os.chdir("/")
        return 0.0 * sample.v, {}

class LeavesThread(Good):
    def step(self, sample, state):
        if threading.active_count() == 1:
            threading.Thread(target=time.sleep, args=(300,), name="mine").start()
        return 0.0 * sample.v, {}

def needs_setting(setup):
    return Good(k=setup.settings["gain"])

class SmallMatrix:
    def calc_mass_matrix(self, q):
        return np.eye(3)

def small_matrix(setup):
    return dataclasses.replace(Tdc.from_setup(setup), model=SmallMatrix())

class NoLaw(ControlLaw):
    pass

@dataclasses.dataclass(frozen=True)
class RaisesAtOnce(Good):
    def __post_init__(self):
        raise OSError("no table of gains")

class NoSuperInit(LeafSystem):
    def __init__(self, setup):
        self.table = {}

@dataclasses.dataclass(frozen=True)
class TextGain(Good):
    k: np.ndarray = gain("high")

class ShortGain(Good):
    def initial_state(self):
        return {"switching_gain": np.zeros(3)}

class NoPorts(LeafSystem):
    def __init__(self, setup):
        super().__init__()

class WrongPortSize(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorInputPort("estimated_state", 4)
        self.DeclareVectorInputPort("desired_state", 23)
        self.DeclareVectorInputPort("desired_acceleration", 11)
        self.DeclareVectorOutputPort("generalized_force", 11, lambda context, output: None)

class StrangePort(WrongPortSize):
    def __init__(self, setup):
        super().__init__(setup)
        self.DeclareVectorInputPort("estimate", 4)

class Loop(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorInputPort("estimated_state", 23)
        self.DeclareVectorInputPort("desired_state", 23)
        self.DeclareVectorInputPort("desired_acceleration", 11)
        self.DeclareVectorInputPort("applied_force", 11)
        self.DeclareVectorOutputPort("generalized_force", 11, lambda context, output: None)

def returns_none(setup):
    return None

table = {"k": 1}
"""
MODULES = {"mine_bad.py": CONTROLLERS}


@dataclasses.dataclass(frozen=True)
class Row:
    """One bad input: what to type, what the one line must say, and the files that are there."""

    id: str
    command: str
    expected: tuple[str, ...]
    files: Mapping[str, str | bytes] = dataclasses.field(default_factory=dict)
    prepare: Callable[[Path], object] | None = None


def bad(
    id: str, command: str, *expected: str, prepare: Callable[[Path], object] | None = None
) -> Row:
    return Row(id, command, expected, {}, prepare)


def scenario(id: str, text: str | bytes, *expected: str, command: str = "validate") -> Row:
    """A broken scenario file."""
    return Row(id, f"{command} mine.yaml", ("mine.yaml: ", *expected), {"mine.yaml": text})


def override(id: str, text: str, *expected: str) -> Row:
    return Row(id, f"validate postcapture --set {shlex.quote(text)}", ("override: ", *expected))


def urdf(
    id: str, old: str, new: str, *expected: str, file: str = "servicer.urdf", close: str = ""
) -> Row:
    """The two small URDFs with one fault: the first ``old`` becomes ``new``; ``close`` ends the
    last joint.
    """
    text = URDFS[file]
    assert old in text
    if close:
        at = text.rindex("</joint>")
        text = text[:at] + close + text[at + len("</joint>") :]
    texts = URDFS | {"mine.yaml": MINE, file: text.replace(old, new, 1)}
    return Row(id, "validate mine.yaml", expected, texts)


def visual(
    id: str,
    shape: str,
    *expected: str,
    files: Mapping[str, str] | None = None,
    prepare: Callable[[Path], object] | None = None,
) -> Row:
    """The small servicer with a shape to be drawn."""
    text = SERVICER.replace("</link>", f"<visual><geometry>{shape}</geometry></visual></link>", 1)
    texts = URDFS | {"mine.yaml": MINE, "servicer.urdf": text} | dict(files or {})
    return Row(id, "validate mine.yaml", expected, texts, prepare)


def pipe(name: str) -> Callable[[Path], object]:
    """Makes a FIFO into which nobody writes."""
    return lambda folder: os.mkfifo(folder / name)


def huge(name: str) -> Callable[[Path], object]:
    """Makes a file of a terabyte, which takes no room."""

    def make(folder: Path) -> None:
        (folder / name).touch()
        os.truncate(folder / name, 10**12)

    return make


def replaced(
    name: str, make: Callable[[Path], Callable[[Path], object]]
) -> Callable[[Path], object]:
    """Puts what ``make`` makes in the place of a file of the run's folder."""

    def damage(folder: Path) -> None:
        (folder / "run" / name).unlink()
        make(f"run/{name}")(folder)

    return damage


def model(id: str, text: str, *expected: str) -> Row:
    """A scenario whose model section is at fault; the URDFs are good."""
    return Row(id, "validate mine.yaml", expected, URDFS | {"mine.yaml": text})


def directives(id: str, text: str, *expected: str) -> Row:
    given = {"mine.yaml": "model: {directives: mine.dmd.yaml}\n", "mine.dmd.yaml": text}
    return Row(id, "validate mine.yaml", ("mine.dmd.yaml", *expected), URDFS | given)


def controller(
    id: str, name: str, *expected: str, command: str = "validate", text: str = CONTROLLERS
) -> Row:
    """A controller of one's own; each row has a module of its own name, since modules are imported
    once.
    """
    module = f"bad_{id.replace('-', '_')}"
    words = {
        "run": f"run --no-report {SHORT} -c",
        "validate": "validate postcapture --set",
        "stability": "stability -c",
    }[command]
    value = f"controller={module}:{name}" if command == "validate" else f"{module}:{name}"
    return Row(id, f"{words} {value}", (name, *expected), {f"{module}.py": text})


def record(
    id: str, damage: Callable[[Path], object], *expected: str, command: str = "analyze run"
) -> Row:
    """A damaged run directory ``run``."""
    return Row(id, command, expected, prepare=damage)


def edit_manifest(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        path = folder / "run" / "manifest.json"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return damage


def edit_dataset(change: Callable) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        import xarray as xr

        path = folder / "run" / "record.nc"
        dataset = change(xr.load_dataset(path))
        path.unlink()
        dataset.to_netcdf(path, unlimited_dims=["time"])

    return damage


def truncate(folder: Path) -> None:
    path = folder / "run" / "record.nc"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def manifest_text(text: str | bytes) -> Callable[[Path], object]:
    data = text if isinstance(text, bytes) else text.encode()
    return lambda folder: (folder / "run" / "manifest.json").write_bytes(data)


BOMB = "_a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"_{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
ADD = "directives:\n- add_model: {name: servicer, file: package://ffsm_drake/urdf/servicer.urdf}\n"
ADD_DEBRIS = "- add_model: {name: debris, file: package://ffsm_drake/urdf/debris.urdf}\n"

TABLE = [
    # Files that are no scenario.
    bad(
        "no-such-name",
        "validate postcaptur",
        "postcaptur: no such scenario",
        "choose one of",
        "did you mean 'postcapture'",
    ),
    bad("no-such-file", "run none.yaml", "none.yaml: no such scenario file"),
    bad("empty-name", "validate ''", "no such scenario", "choose one of"),
    bad("folder", "validate .", ".: is a folder; give a YAML file"),
    bad("parent-folder", "run --no-report ..", "..: is a folder; give a YAML file"),
    bad(
        "escaping-name",
        "stability ../../nowhere/postcapture",
        "../../nowhere/postcapture: no such scenario file",
    ),
    bad("long-name", f"validate {'x' * 300}.yaml", "x.yaml: ", "too long"),
    bad("device", "validate /dev/zero", "/dev/zero: is not a regular file; give a YAML file"),
    bad("print-of-nothing", "scenarios none.yaml", "none.yaml: no such scenario file"),
    scenario("not-utf-8", b"description: caf\xe9\n", "is not UTF-8 text"),
    scenario("binary", b"\x00\x01\x02", "is not valid YAML", "character 1"),
    scenario("huge-file", "# " + "x" * 1_100_000, "larger than 1000000 bytes"),
    # YAML that is broken or dangerous.
    scenario("not-yaml", "duration: [1\n", "is not valid YAML: line 2, column 1"),
    scenario(
        "tabs", "payload:\n\tbody: x\n", "is not valid YAML: line 2, column 1", "indent with spaces"
    ),
    scenario("list", "- 1\n", "must be a mapping with keys description"),
    scenario("text", "postcapture\n", "must be a mapping with keys description", "'postcapture'"),
    scenario(
        "two-documents",
        "duration: 1\n---\nduration: 2\n",
        "is not valid YAML: line 2",
        "single document",
    ),
    scenario(
        "key-twice",
        "duration: 1\nrandom_seed: 2\nduration: 3\n",
        "line 3",
        "'duration' is given twice",
        "line 1",
    ),
    scenario(
        "inner-key-twice",
        "payload:\n  truth: {mass: 1, mass: 2}\n",
        "line 2",
        "'mass' is given twice",
    ),
    scenario(
        "python-object",
        "!!python/object/apply:os.system ['true']\n",
        "line 1",
        "python/object",
        "leave it out",
    ),
    scenario(
        "tag-on-top",
        "!!python/object:os.x\nduration: 1\n",
        "line 1",
        "python/object",
        "leave it out",
    ),
    scenario("own-tag", "payload: !Stone {mass: 3}\n", "line 1", "'!Stone'", "leave it out"),
    scenario("unknown-alias", "duration: *d\n", "line 1", "undefined alias"),
    scenario("alias-bomb", BOMB + "description: *i\n", "aliases (*name) expand to more than"),
    scenario("circular-alias", "payload: &p {truth: *p}\n", "line 1", "contains itself"),
    scenario("deep-nesting", "description: " + "[" * 5000, "nested deeper than 50 levels"),
    scenario(
        "impossible-date",
        "duration: 2020-13-45\n",
        "is not valid YAML: line 1, column 11: month must be in 1..12",
    ),
    # Keys and types.
    scenario(
        "unknown-key",
        "controler: tdc\n",
        "controler: unknown key; valid here",
        "did you mean 'controller'?",
    ),
    scenario(
        "unknown-inner-key",
        "payload: {truth: {masss: 1}}\n",
        "payload.truth.masss",
        "did you mean 'mass'?",
    ),
    scenario("number-key", "3: 4\n", "3: unknown key"),
    scenario(
        "number-as-name",
        "disturbance: {harmonics: {3: {bias: 1}}}\n",
        "harmonics.3: a name must be text",
    ),
    scenario("text-for-number", "duration: long\n", "duration: must be a number, not 'long'"),
    scenario(
        "date-for-number",
        "duration: 2020-01-01\n",
        "duration: must be a number, not datetime.date(2020, 1, 1)",
    ),
    scenario(
        "nothing-for-number", "duration:\n", "duration: must be a number, not null (no value)"
    ),
    scenario("bool-for-number", "duration: true\n", "duration: must be a number, not True"),
    scenario("list-for-number", "duration: [1]\n", "duration: must be a number, not [1]"),
    scenario(
        "fraction-for-whole", "random_seed: 1.5\n", "random_seed: must be a whole number, not 1.5"
    ),
    scenario(
        "text-for-bool",
        "simulator_config: {use_error_control: 'no'}\n",
        "use_error_control: must be true or false",
    ),
    scenario("number-for-text", "description: 3\n", "description: must be text, not 3"),
    scenario(
        "zero-in-text", 'description: "a\\0b"\n', "description: must be text that a file can hold"
    ),
    scenario(
        "number-for-group",
        "payload: 3\n",
        "payload: must be a mapping with keys body, truth, nominal, not 3",
    ),
    scenario(
        "number-for-list", "initial_posture: {base_rpy: 3}\n", "base_rpy: must be a list, not 3"
    ),
    scenario(
        "text-in-list",
        "initial_posture: {base_rpy: [0, x, 0]}\n",
        "base_rpy[1]: must be a number, not 'x'",
    ),
    scenario(
        "gain-as-vector",
        "controllers: {tdc: {k_d: [1, 2]}}\n",
        "controllers.tdc.k_d.all: must be a number",
        "by name",
    ),
    # Values.
    scenario("nan", "duration: .nan\n", "duration: must be finite, not nan"),
    scenario(
        "infinite",
        "payload: {truth: {mass: .inf}}\n",
        "payload.truth.mass: must be finite, not inf",
    ),
    scenario(
        "nan-gain",
        "controllers: {tdc: {k_d: {joints: .nan}}}\n",
        "controllers.tdc.k_d.joints: must be finite",
    ),
    scenario("500-digits", f"duration: {'9' * 500}\n", "duration: must be finite"),
    scenario("5000-digits", f"duration: {'9' * 5000}\n", "line 1, column 11", "4300 digits"),
    scenario(
        "huge-number",
        "initial_posture: {base_position: [1e300, 0, 0]}\n",
        "base_position[0]: must be at most 1e+20",
    ),
    scenario(
        "negative-mass",
        "payload: {truth: {mass: -5}}\n",
        "payload.truth.mass: must be > 0 kg, not -5",
    ),
    scenario(
        "zero-mass",
        "payload: {nominal: {mass: 0}}\n",
        "payload.nominal.mass: must be > 0 kg, not 0",
    ),
    scenario(
        "triangle-inequality",
        "payload: {truth: {inertia: [1, 1, 5]}}\n",
        "payload.truth.inertia",
        "triangle inequality",
    ),
    scenario(
        "indefinite-inertia",
        "payload: {truth: {inertia: [1, 1, 1, 2, 0, 0]}}\n",
        "must be positive definite",
    ),
    scenario(
        "two-moments", "payload: {truth: {inertia: [1, 1]}}\n", "inertia: must hold three moments"
    ),
    scenario(
        "two-coordinates",
        "payload: {truth: {center_of_mass: [1, 1]}}\n",
        "payload.truth.center_of_mass: must hold 3 values, not 2",
    ),
    scenario(
        "negative-gain",
        "controllers: {asmc: {k_s: -1}}\n",
        "controllers.asmc.k_s.all: must be >= 0, not -1",
    ),
    scenario(
        "file-fault-stays-the-file's",
        "controllers: {asmc: {k_s: -1}}\n",
        "k_s.all",
        command="validate --set controller=tdc",
    ),
    scenario(
        "unknown-estimator",
        "estimator: {kind: kalmann}\n",
        "choose one of one_sample, kalman, coupled; did you mean 'kalman'?",
    ),
    # Overrides.
    override("no-equals", "duration", "'duration': must have the form key=value"),
    override("no-key", "=3", "must have the form key=value"),
    override("no-value", "duration=", "duration: must be a number, not null (no value)"),
    override("nan-override", "duration=nan", "duration: must be finite, not 'nan'"),
    override(
        "inf-override",
        "disturbance.amplitude_scale=.inf",
        "disturbance.amplitude_scale: must be finite",
    ),
    override(
        "override-unknown-key",
        "controllers.tdc.kd=3",
        "kd: unknown gain; tdc has k_d, k_p; did you mean 'k_d'?",
    ),
    override(
        "override-in-list",
        "payload.truth.inertia.0=3",
        "payload.truth.inertia holds a list; give it whole",
    ),
    override("override-too-deep", "duration.x=3", "duration holds a single value"),
    override("override-not-yaml", "duration=[1", "duration: value is not valid YAML"),
    override(
        "override-tag",
        "duration=!!python/name:os.system",
        "duration: value is not valid YAML",
        "python/name",
    ),
    override("override-dots", "payload..mass=3", "payload.: unknown key"),
    override(
        "tiny-sample-time",
        "sample_time=1e-9",
        "sample_time: 20 s in samples of 1e-09 s are 2e+10",
        "at most 10000000",
    ),
    override("endless", "duration=1e19", "duration: 1e+19 s", "GB", "shorten duration"),
    override(
        "tiny-steps",
        "simulator_config.max_step_size=1e-15",
        "max_step_size: 1e-15 s gives 2e+16 steps",
    ),
    override("denormal-sample-time", "sample_time=5e-324", "sample_time: ", "at most 10000000"),
    override(
        "sample-longer-than-run", "sample_time=30", "sample_time: must be at most duration (20.0 s)"
    ),
    override(
        "unknown-scheme",
        "simulator_config.integration_scheme=runge_kutta4",
        "choose one of",
        "did you mean 'runge_kutta",
    ),
    override(
        "scheme-of-another-diagram",
        "simulator_config.integration_scheme=cenic",
        "'cenic' is unknown",
    ),
    override(
        "no-error-estimate",
        "simulator_config={integration_scheme: explicit_euler, use_error_control: true}",
        "set false",
    ),
    override(
        "negative-accuracy",
        "simulator_config.accuracy=-1",
        "simulator_config.accuracy: must be > 0",
    ),
    override(
        "late-start", "simulator_config.start_time=5", "simulator_config.start_time: must be 0"
    ),
    override(
        "unknown-coordinate",
        "sensing.velocity_noise.joint_9=1",
        "sensing.velocity_noise.joint_9",
        "did you mean 'joint_",
    ),
    override("sexagesimal", "duration=1:30", "duration: must be a number, not '1:30'"),
    override("octal", "random_seed=017", "random_seed: must be a whole number, not '017'"),
    override("octal-number", "duration=017", "duration: must be a number, not '017'"),
    bad(
        "integrator-fails",
        "run --no-report --set simulator_config.integration_scheme=radau3 --set "
        "simulator_config.accuracy=1e-300 "
        "--set simulator_config.use_error_control=true",
        "Error control wants to select step smaller than minimum",
    ),
    bad(
        "internal-frame",
        "validate postcapture --set model.end_effector=servicer::joint_1_p",
        "servicer::link_5, servicer::end_effector",
    ),
    override(
        "unknown-group",
        "controllers.tde_aismc.k_d.joint=1",
        "k_d.joint: unknown coordinate",
        "did you mean",
    ),
    override(
        "unknown-harmonic",
        "disturbance.harmonics.arm.bias=1",
        "harmonics.arm: unknown coordinate; valid here: all",
    ),
    override(
        "unknown-posture-joint",
        "initial_posture.joints.joint_6=1",
        "initial_posture.joints.joint_6: unknown coordinate",
    ),
    bad(
        "missing-gain",
        "validate flight_sensors --set 'estimator.walk={joints: 1}'",
        "override: estimator.walk: gives no value for base_rotation_x",
        "or 'all'",
    ),
    bad(
        "singular-payload",
        "validate postcapture --set payload.truth.mass=1e19",
        "payload.body: with 1e+19 kg",
        "singular",
    ),
    bad(
        "unknown-body",
        "validate postcapture --set payload.body=debris::debri",
        "payload.body: no body",
        "did you mean 'debris::debris'?",
    ),
    bad(
        "world-as-payload",
        "validate postcapture --set payload.body=WorldModelInstance::world",
        "payload.body",
        "has no mass",
    ),
    bad(
        "unknown-frame",
        "validate postcapture --set model.end_effector=servicer::endeffector",
        "model.end_effector: no frame",
        "did you mean 'servicer::end_effector'?",
    ),
    bad(
        "negative-seed",
        "validate postcapture --set random_seed=-1",
        "random_seed: must be from 0 to 2147483647",
    ),
    bad(
        "seed-option", "stability --seed -1", "override: random_seed: must be from 0 to 2147483647"
    ),
    bad(
        "large-seed",
        "run --seed 99999999999",
        "override: random_seed: must be from 0 to 2147483647",
    ),
    bad("text-seed", "run --seed x", "'x' is not a valid integer"),
    bad("nan-budget", "design flight_sensors --budget nan", "--budget", "not a finite number"),
    bad(
        "infinite-payload",
        "design flight_sensors --payload-range 1 inf",
        "--payload-range",
        "not a finite number",
    ),
    bad(
        "reversed-payload",
        "design flight_sensors --payload-range 9 5",
        "payload range: must be two masses 0 < LOW < HIGH",
    ),
    # Thrusters and wheels.
    override(
        "unknown-layout",
        "actuation.thrusters.layout=12x5",
        "thrusters.layout: '12x5' is unknown",
        "did you mean '12x5N'?",
    ),
    override(
        "unknown-stuck-thruster",
        "actuation.thrusters.failures={a_w: stuck_off}",
        "override: actuation.thrusters.failures.a_w: 'a_w' is unknown; choose one of a_x, a_y, a_z",
    ),
    override(
        "unknown-failure",
        "actuation.thrusters.failures={a_x: stuck}",
        "failures.a_x: 'stuck' is unknown",
    ),
    override(
        "force-that-is-lost",
        "actuation.thrusters.failures={a_x: stuck_off, b_x: stuck_off}",
        "actuation.thrusters.failures: with a_x stuck_off, b_x stuck_off no thrusters give a "
        "force along [-1, 0, 0]",
    ),
    override(
        "stuck-on-too-strong",
        "actuation.thrusters.failures={a_x: stuck_on, d_x: stuck_off}",
        "actuation.thrusters.failures: the others cannot hold against a_x stuck on",
    ),
    scenario(
        "frame-below-on-time",
        "sample_time: 0.005\nactuation: {thrusters: {frame: 3}}\n",
        "actuation.thrusters.frame: 3 control samples are 0.015 s, shorter than minimum_on_time, "
        "0.02 s; take 4",
    ),
    override(
        "negative-on-time",
        "actuation.thrusters.minimum_on_time=-1",
        "minimum_on_time: must be from 0 to 1000 s",
    ),
    override(
        "no-thrust",
        "actuation.thrusters={layout: null, units: {a: {force: 0}}}",
        "units.a.force: must be > 0 N",
    ),
    override(
        "no-wheels",
        "actuation.wheels={}",
        "actuation.wheels.units: give wheels by name, such as {z: ",
    ),
    override(
        "one-wheel",
        "actuation.wheels.units={z: {axis: [0, 0, 1]}}",
        "units: give no torque about some axis",
    ),
    override(
        "misspelt-axis",
        "actuation.wheels.units={z: {axes: [0, 0, 1]}}",
        "units.z.axes",
        "did you mean 'axis'?",
    ),
    override(
        "wheel-too-fast",
        "actuation.wheels.units={z: {initial_momentum: -51}}",
        "z.initial_momentum: must be within inertia * speed_limit, 50.24 N m s, not -51",
    ),
    override(
        "wheel-too-heavy",
        "actuation={thrusters: {}, wheels: {units: {z: {inertia: 300}}}}",
        "actuation.wheels: their inertia is part of the base's, which has less",
    ),
    Row(
        "failure-in-a-campaign",
        "campaign plan c.yaml",
        ("actuation.thrusters.failures.a_w: 'a_w' is unknown",),
        {
            "c.yaml": "scenario: thrusters_and_wheels\ncases: 2\nparameters:\n  "
            "actuation.thrusters: "
            "{distribution: list, values: [{failures: {a_w: stuck_off}}]}\n"
        },
    ),
    # Captures.
    bad(
        "capture-vector",
        "validate tumbling_capture --set capture.rate=[1,2]",
        "capture.rate: must hold 3 values, not 2",
    ),
    bad(
        "fast-capture",
        "validate tumbling_capture --set capture.rate=[0,11,0]",
        "must be within divergence_speed (10)",
    ),
    bad(
        "capture-motion",
        "validate tumbling_capture --set capture.servicer=track",
        "capture.servicer: 'track' is unknown; choose one of rest, track_joints, track_all, given",
    ),
    bad(
        "capture-velocity",
        "validate tumbling_capture --set capture.servicer_velocity.joint_1=0.1",
        "capture.servicer_velocity: has no effect with servicer: track_joints",
    ),
    bad(
        "capture-coordinate",
        "validate tumbling_capture --set capture.tracking_cost.joint_7=1",
        "capture.tracking_cost.joint_7: unknown coordinate",
    ),
    bad(
        "capture-rpy",
        "validate tumbling_capture --set reference.base_rotation=rpy",
        "reference.base_rotation: must be eigenaxis with capture, not rpy",
    ),
    bad(
        "capture-odd-approach",
        "validate tumbling_capture --set capture.approach.duration=19.995",
        "capture.approach.duration: must be a whole number of control samples of 0.01 s, not "
        "19.995 s",
    ),
    bad(
        "capture-long-approach",
        "validate tumbling_capture --set capture.approach.duration=45",
        "capture.approach.duration: must leave time for the stop: the run ends at 45 s",
    ),
    bad(
        "capture-stowed-joint",
        "validate tumbling_capture --set capture.approach.posture.joints.joint_9=1",
        "capture.approach.posture.joints.joint_9: unknown coordinate",
    ),
    bad(
        "capture-of-itself",
        "validate tumbling_capture --set payload.body=servicer::link_5",
        "payload.body: 'servicer::link_5' is a body of the servicer; capture takes a target of "
        "one body",
    ),
    bad(
        "soft-gripper",
        "validate tumbling_capture --set capture.compliance.damping=0",
        "capture.compliance.damping: must be > 0 N s/m, not 0",
    ),
    bad(
        "no-goal",
        "validate tumbling_capture --set reference.goal=rest",
        "reference.goal: 'rest' is unknown",
    ),
    bad(
        "no-reserve",
        "validate tumbling_capture --set reference.reserve=1",
        "reference.reserve: must be from 0 to below",
    ),
    bad(
        "auto-without-limits",
        "validate tumbling_capture --set reference.duration=auto --set actuation.limit=null",
        "reference.duration: auto needs a limit of force or velocity",
    ),
    # The environment.
    bad(
        "low-orbit",
        "validate postcapture --set environment.altitude=-400",
        "override: environment.altitude: must be > 0, at most 1000000000 m, not -400",
    ),
    bad(
        "two-orbits",
        "validate postcapture --set environment.mean_motion=1e-3",
        "set altitude: null",
    ),
    bad(
        "friction-too-stiff",
        "validate postcapture --set actuation.drives.coulomb_friction=0.5",
        "simulator_config.max_step_size: 0.01 s does not resolve the friction of joint_3, which "
        "near rest acts within",
        "take at most 0.0035 s",
    ),
    bad(
        "drive-of-the-base",
        "validate postcapture --set actuation.drives.rotor_inertia.base_rotation=1",
        "actuation.drives.rotor_inertia.base_rotation: is no joint; valid here: all, joints, "
        "joint_1",
    ),
    bad(
        "drive-without-force-limit",
        "run postcapture --set actuation.drives.rate_limit=0.1",
        "actuation.drives.rate_limit: joint_1 has no actuation.limit",
    ),
    # Models.
    model(
        "no-such-servicer",
        "model: {servicer: none.urdf}\n",
        "model.servicer: ",
        "none.urdf: no such file",
    ),
    model(
        "folder-as-servicer",
        "model: {servicer: .}\n",
        "model.servicer: ",
        "is a folder; give a file",
    ),
    model(
        "two-models",
        "model: {servicer: servicer.urdf, directives: x.yaml}\n",
        "model: give either directives or servicer",
    ),
    model("text-as-urdf", "model: {servicer: mine.yaml}\n", "model.servicer: ", "mine.yaml"),
    model(
        "no-such-package",
        "model: {servicer: 'package://nowhere/x.urdf'}\n",
        "model.servicer: package://nowhere/x.urdf",
        "nowhere",
    ),
    model(
        "no-package-folder",
        MINE.replace("}", ", packages: {meshes: none}}"),
        "model.packages.meshes: no such folder",
        "none",
    ),
    model(
        "escaping-package",
        "model: {directives: 'package://ffsm_drake/../none.dmd.yaml'}\n",
        "model.directives: package://ffsm_drake/../none",
    ),
    model(
        "wrong-end-effector",
        MINE.replace("}", ", end_effector: servicer::hnad}"),
        "no frame 'servicer::hnad'",
        "did you mean 'servicer::hand'?",
    ),
    model(
        "wrong-grasp",
        MINE.replace("}", ", grasp: debris::grip}"),
        "model.grasp: no frame 'debris::grip'",
        "choose one of",
    ),
    model(
        "grasp-on-the-servicer",
        MINE.replace("}", ", grasp: servicer::hand}"),
        "model.grasp: 'servicer::hand' is not a frame of the debris",
    ),
    urdf("not-xml", '<link name="arm">', '<link name="arm', "model.servicer", "servicer.urdf"),
    urdf("empty-urdf", SERVICER, "", "model.servicer", "servicer.urdf"),
    urdf(
        "urdf-negative-mass",
        '<mass value="10"/>',
        '<mass value="-10"/>',
        "model.servicer",
        "servicer.urdf:4: ",
        "'mass > 0' failed",
    ),
    urdf(
        "urdf-nan-mass",
        '<mass value="10"/>',
        '<mass value="nan"/>',
        "model.servicer",
        "servicer.urdf",
    ),
    urdf(
        "urdf-text-mass",
        '<mass value="10"/>',
        '<mass value="ten"/>',
        "model.servicer",
        "servicer.urdf",
    ),
    urdf(
        "urdf-zero-mass",
        SERVICER[SERVICER.index('<link name="base">') : SERVICER.index('  <link name="arm">')],
        '<link name="base"/>\n',
        "mass matrix is singular",
        "every link of the URDF",
    ),
    urdf(
        "urdf-triangle-inequality",
        'ixx="0.9" iyy="0.9"',
        'ixx="0.1" iyy="0.9"',
        "model.servicer",
        "servicer.urdf",
    ),
    urdf(
        "urdf-debris-unphysical",
        'ixx="16" iyy="16"',
        'ixx="1" iyy="1"',
        "model.debris",
        "debris.urdf",
        file="debris.urdf",
    ),
    urdf(
        "urdf-unknown-parent",
        '<parent link="base"/>',
        '<parent link="bus"/>',
        "model.servicer",
        "bus",
    ),
    urdf("urdf-joint-twice", 'name="wrist"', 'name="shoulder"', "shoulder"),
    urdf("urdf-link-twice", '<link name="hand">', '<link name="arm">', "arm"),
    urdf(
        "urdf-zero-axis", '<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "servicer.urdf", "shoulder"
    ),
    urdf("urdf-unknown-joint-type", 'type="continuous"', 'type="bendy"', "servicer.urdf", "bendy"),
    urdf(
        "urdf-ball-joint",
        '<joint name="wrist" type="continuous">',
        '<drake:joint xmlns:drake="x" name="wrist" type="ball">',
        "joint 'wrist' has 3 degrees",
        close="</drake:joint>",
    ),
    urdf(
        "urdf-planar-joint",
        '<joint name="wrist" type="continuous">',
        '<joint name="wrist" type="planar">',
        "wrist",
    ),
    urdf(
        "urdf-joint-called-joints",
        'name="wrist"',
        'name="joints"',
        "joint names must not be those of groups",
        "rename joints",
    ),
    urdf(
        "urdf-loose-link",
        '<frame name="end',
        STRAY_LINK + '<frame name="end',
        "one floating base, not 2",
        "stray",
    ),
    urdf(
        "urdf-missing-mesh",
        "</link>",
        '<visual><geometry><mesh filename="none.obj"/></geometry></visual></link>',
        "none.obj",
    ),
    urdf(
        "urdf-reversed-limits",
        '<axis xyz="0 1 0"/>',
        '<axis xyz="0 1 0"/><limit lower="3" upper="-3"/>',
        "servicer.urdf: a joint's lower limit lies above its upper limit",
    ),
    urdf(
        "urdf-negative-velocity-limit",
        '<axis xyz="0 1 0"/>',
        '<axis xyz="0 1 0"/><limit velocity="-3"/>',
        "servicer.urdf: a joint's velocity limit is negative",
    ),
    *(
        visual(f"urdf-{id}", shape, "servicer.urdf:", expected)
        for id, shape, expected in (
            (
                "negative-sphere",
                '<sphere radius="-1"/>',
                "Sphere: condition 'std::isfinite(radius) && radius >= 0'",
            ),
            ("flat-cylinder", '<cylinder radius="0" length="0"/>', "Cylinder: condition"),
            (
                "flat-box",
                '<box size="0 1 1"/>',
                "Box: condition 'std::isfinite(width) && width > 0' failed",
            ),
            ("no-package", '<mesh filename="package:///etc/passwd"/>', "unknown package ''"),
            ("folder-as-mesh", '<mesh filename="."/>', "is a folder; give a file"),
            (
                "device-as-mesh",
                '<mesh filename="/dev/zero"/>',
                "/dev/zero: is not a regular file; give a file",
            ),
            (
                "device-by-address",
                '<mesh filename="file:///dev/zero"/>',
                "/dev/zero: is not a regular file",
            ),
        )
    ),
    *(
        visual(
            f"no-mesh-{kind}",
            f'<mesh filename="m.{kind}"/>',
            f"m.{kind}: is no",
            files={f"m.{kind}": "hello"},
        )
        for kind in ("obj", "gltf", "dae")
    ),
    *(
        visual(
            f"no-mesh-{kind}",
            f'<mesh filename="m.{kind}"/>',
            "is of a kind that is not drawn; convert it to .obj",
            files={f"m.{kind}": "hello"},
        )
        for kind in ("stl", "glb", "txt")
    ),
    visual(
        "mesh-of-a-fifo",
        '<mesh filename="pipe"/>',
        "pipe: is not a regular file",
        prepare=pipe("pipe"),
    ),
    visual(
        "buffer-of-a-fifo",
        '<mesh filename="m.gltf"/>',
        "pipe: is not a regular file",
        files={
            "m.gltf": '{"asset": {"version": "2.0"}, "buffers": [{"uri": "pipe", "byteLength": 4}]}'
        },
        prepare=pipe("pipe"),
    ),
    visual(
        "material-of-a-fifo",
        '<mesh filename="m.obj"/>',
        "pipe: is not a regular file",
        files={"m.obj": "mtllib m.mtl\n", "m.mtl": "newmtl a\nmap_Kd pipe\n"},
        prepare=pipe("pipe"),
    ),
    visual(
        "huge-mesh",
        '<mesh filename="m.obj"/>',
        "m.obj: has 1e+12 bytes; at most 5e+08",
        prepare=huge("m.obj"),
    ),
    urdf(
        "urdf-mimic",
        '<axis xyz="1 0 0"/>',
        '<axis xyz="1 0 0"/><mimic joint="shoulder"/>',
        "servicer.urdf: a joint follows another",
        "<mimic>",
        "take it out",
    ),
    Row(
        "urdf-all-fixed",
        "validate mine.yaml",
        ("servicer.urdf: no joint moves; an arm has revolute, continuous or prismatic joints",),
        URDFS | {"mine.yaml": MINE, "servicer.urdf": SERVICER.replace("continuous", "fixed")},
    ),
    model(
        "empty-package-name",
        "model: {servicer: 'package:///passwd', packages: {'': /etc}}\n",
        "model.packages: a package's name must not be empty",
    ),
    directives(
        "directives-of-a-device",
        ADD.replace("package://ffsm_drake/urdf/servicer.urdf", "/dev/zero"),
        "/dev/zero: is not a regular file",
    ),
    directives("directives-not-yaml", "directives: [", "mine.dmd.yaml"),
    directives("directives-unknown-key", "directives:\n- add_mdl: {name: x}\n", "add_mdl"),
    directives("directives-unknown-model", ADD.replace("servicer.urdf", "none.urdf"), "none.urdf"),
    directives(
        "directives-unknown-frame",
        ADD + ADD_DEBRIS + "- add_weld: {parent: servicer::hand, child: debris::grasp}\n",
        "hand",
    ),
    directives(
        "directives-welded-to-world",
        ADD + "- add_weld: {parent: world, child: servicer::base}\n",
        "no floating base",
    ),
    directives(
        "directives-two-bases",
        ADD + ADD_DEBRIS,
        "must have one floating base, not 2 (base, debris)",
    ),
    directives("directives-name-twice", ADD + ADD.replace("directives:\n", ""), "servicer"),
    # Controllers of one's own.
    bad(
        "controller-typo",
        "validate postcapture --set controller=tde_aimsc",
        "controller: 'tde_aimsc' is unknown",
        "did you mean 'tde_aismc'?",
    ),
    bad(
        "controller-path",
        "run -c ../evil.py",
        "controller: '../evil.py' must be a name or module:attribute",
    ),
    bad(
        "compare-path",
        "compare -c tdc -c ../../x",
        "controller: '../../x' must be a name or module:attribute",
    ),
    bad("compare-twice", "compare -c tdc -c tdc", "--controller: tdc is given more than once"),
    bad(
        "no-such-module",
        "run -c nowhere_at_all:Law",
        "No module named 'nowhere_at_all'",
        "PYTHONPATH",
    ),
    controller("no-such-class", "Goood", "has no 'Goood'", "did you mean 'Good'?"),
    controller("syntax-error", "Law", "SyntaxError", "line 1", text="class Law(\n"),
    controller("module-raises", "Law", "ZeroDivisionError", text="1 / 0\n"),
    controller("module-exits", "Law", "SystemExit", text="raise SystemExit(0)\n"),
    controller("not-callable", "table", "must be a class or function, not dict"),
    controller(
        "factory-of-nothing",
        "returns_none",
        "must be a control law or a Drake system, not NoneType",
    ),
    controller("raises-in-init", "RaisesAtOnce", "cannot be built: OSError: no table of gains"),
    controller("no-super-init", "NoSuperInit", "cannot be built: TypeError", "__init__"),
    controller("text-as-gain", "TextGain", "cannot be built: ValueError", "high"),
    controller("list-as-memory", "ListMemory", "initial_state must return a mapping"),
    controller("no-ports", "NoPorts", "needs an input port 'estimated_state' of size 23"),
    controller(
        "wrong-port-size", "WrongPortSize", "input port 'estimated_state' must have size 23, not 4"
    ),
    controller(
        "strange-port", "StrangePort", "unknown input port 'estimate'; known: estimated_state"
    ),
    controller(
        "feedthrough",
        "Loop",
        "'generalized_force' must not follow an input at once",
        "DeclareStateOutput",
    ),
    controller(
        "short-optional-output",
        "ShortGain",
        "output port 'switching_gain' must have size 11, not 3",
    ),
    controller(
        "wrong-force-size",
        "WrongSize",
        "'generalized_force' of shape (3,); it must be (11,)",
        command="run",
    ),
    controller(
        "returns-none",
        "ReturnsNone",
        "step must return (generalized_force, state)",
        "not NoneType",
        command="run",
    ),
    controller(
        "returns-force-only",
        "OnlyForce",
        "step must return (generalized_force, state)",
        command="run",
    ),
    controller("text-as-force", "TextForce", "not an array of numbers", command="run"),
    controller(
        "forgets-memory",
        "Forgets",
        "step returned no 'integral'; it must return all",
        command="run",
    ),
    controller(
        "invents-memory", "Invents", "'integral', which initial_state does not name", command="run"
    ),
    controller(
        "raises-in-law", "Raises", "failed at t = 0.00 s: KeyError: 'gain'", "line ", command="run"
    ),
    controller("exits-in-law", "Leaves", "step called sys.exit at t = 0.00 s", command="run"),
    controller(
        "raises-linearised", "Raises", "cannot be linearised: KeyError: 'gain'", command="stability"
    ),
    controller(
        "exits-linearised", "Leaves", "step called sys.exit at t = 0.00 s", command="stability"
    ),
    controller(
        "raises-speechless", "RaisesMute", "failed at t = 0.00 s: Mute: Mute", command="run"
    ),
    controller(
        "raises-generator-exit",
        "RaisesExit",
        "step raised GeneratorExit at t = 0.00 s",
        command="run",
    ),
    controller(
        "generator-exit-linearised", "RaisesExit", "step raised GeneratorExit", command="stability"
    ),
    controller("generator-exit-in-init", "ExitsAtOnce", "cannot be built: GeneratorExit: gone"),
    controller("missing-setting", "needs_setting", "no 'gain' in the settings", "there are: none"),
    Row(
        "small-mass-matrix",
        f"run --no-report {SHORT} -c mine_bad:small_matrix",
        ("mass matrix has the shape (3, 3); it must be (11, 11)",),
        MODULES,
    ),
    controller("no-law", "NoLaw", "NoLaw must define step(sample, state)"),
    controller("nan-configuration", "NanState", "the configuration q is not finite", command="run"),
    Row(
        "unknown-own-gain",
        "validate postcapture --set controller=mine_bad:Good --set controllers.Good.kk=1",
        ("controllers.Good.kk: unknown gain; Good has k; did you mean 'k'?",),
        MODULES,
    ),
    # Where results go.
    Row(
        "out-is-a-file",
        f"run --no-report {SHORT} --out taken",
        ("taken: cannot be written", "taken is not a folder"),
        {"taken": ""},
    ),
    Row(
        "out-inside-a-file",
        f"run --no-report {SHORT} --out taken/x",
        ("taken/x: cannot be written", "is not a folder; give another"),
        {"taken": ""},
    ),
    bad(
        "out-read-only",
        f"run --no-report {SHORT} --out /proc/ffsm",
        "/proc/ffsm",
        "cannot be written",
    ),
    bad(
        "out-too-long",
        f"run --no-report {SHORT} --out {'x' * 300}",
        "cannot be written",
        "too long",
    ),
    bad(
        "compare-out-is-a-file",
        f"compare --no-report {SHORT} --out taken",
        "taken: cannot be written",
        prepare=lambda at: (at / "taken").touch(),
    ),
    bad(
        "stability-out-is-a-file",
        "stability --out taken",
        "taken: cannot be written",
        prepare=lambda at: (at / "taken").touch(),
    ),
    bad(
        "design-out-is-a-file",
        "design --out taken",
        "taken: cannot be written",
        prepare=lambda at: (at / "taken").touch(),
    ),
    bad(
        "plot-out-is-a-file",
        "plot run --out taken",
        "taken: cannot be written",
        prepare=lambda at: (at / "taken").touch(),
    ),
    bad(
        "diagram-out-inside-a-file",
        "diagram --out taken/x.svg",
        "taken: cannot be written",
        prepare=lambda at: (at / "taken").touch(),
    ),
    bad(
        "replay-out-inside-a-file",
        "replay run --out taken/x.html",
        "taken: cannot be written",
        prepare=lambda at: (at / "taken").touch(),
    ),
    bad("diagram-out-is-a-folder", "diagram --out .", "is a directory"),
    # Run directories.
    bad(
        "no-run",
        "analyze nothing",
        "nothing/manifest.json: cannot be read",
        "give the folder of a run",
    ),
    bad("no-run-to-plot", "plot nothing", "nothing/manifest.json: cannot be read"),
    Row("run-is-a-file", "plot taken", ("taken", "not a folder"), {"taken": ""}),
    record(
        "no-record",
        lambda at: (at / "run" / "record.nc").unlink(),
        "run/record.nc: cannot be read: no such file; run it again",
    ),
    record(
        "no-manifest",
        lambda at: (at / "run" / "manifest.json").unlink(),
        "run/manifest.json: cannot be read",
    ),
    record("truncated", truncate, "run/record.nc: cannot be read", "run it again"),
    record(
        "empty-record",
        lambda at: (at / "run" / "record.nc").write_bytes(b""),
        "run/record.nc: cannot be read",
    ),
    record(
        "text-as-record",
        lambda at: (at / "run" / "record.nc").write_text("hello"),
        "run/record.nc: cannot be read",
    ),
    record(
        "record-is-a-folder",
        lambda at: ((at / "run" / "record.nc").unlink(), (at / "run" / "record.nc").mkdir()),
        "run/record.nc: cannot be read",
    ),
    *(
        record(
            f"{id}-{name.partition('.')[0]}",
            replaced(name, make),
            f"run/{name}: cannot be read: {fault}",
        )
        for name in ("manifest.json", "record.nc", "metrics.json")
        for id, make, fault in (
            ("pipe-as", pipe, "is not a regular file"),
            ("huge", huge, "has 1e+12 bytes"),
        )
    ),
    record(
        "device-as-record",
        lambda at: (
            (at / "run" / "record.nc").unlink(),
            (at / "run" / "record.nc").symlink_to("/dev/zero"),
        ),
        "run/record.nc: cannot be read: is not a regular file",
    ),
    record(
        "other-record",
        edit_dataset(lambda data: data.assign(error=2.0 * data["error"])),
        "run/record.nc: is not the record that manifest.json goes with, or was changed",
    ),
    record(
        "zero-samples",
        edit_dataset(lambda data: data.isel(time=slice(0, 0))),
        "run/record.nc: holds no samples",
    ),
    record(
        "zero-samples-plot",
        edit_dataset(lambda data: data.isel(time=slice(0, 0))),
        "run/record.nc: holds no samples",
        command="plot run",
    ),
    record(
        "missing-variable",
        edit_dataset(lambda data: data.drop_vars("error")),
        "run/record.nc: lacks error; ",
        "run it again",
    ),
    record(
        "missing-names",
        edit_dataset(lambda data: data.drop_vars("coordinate")),
        "run/record.nc: lacks coordinate",
    ),
    record(
        "wrong-shape",
        edit_dataset(lambda data: data.assign(error=data["error"].T)),
        "error must hold numbers along time, coordinate",
    ),
    record(
        "no-sample-time",
        edit_dataset(lambda data: data.drop_attrs()),
        "run/record.nc: lacks the attribute sample_time",
    ),
    record(
        "manifest-not-json",
        manifest_text("{"),
        "run/manifest.json: is not a run's manifest",
        "JSONDecodeError",
    ),
    record(
        "manifest-not-utf-8", manifest_text(b"\xff"), "run/manifest.json: is not a run's manifest"
    ),
    record(
        "manifest-is-a-list",
        manifest_text("[1]"),
        "is not a run's manifest: must be an object, not list",
    ),
    record(
        "manifest-too-deep",
        manifest_text("[" * 100_000),
        "is not a run's manifest",
        "RecursionError",
    ),
    record("manifest-empty", manifest_text("{}"), "is not a run's manifest: lacks 'format'"),
    record(
        "other-format",
        edit_manifest(lambda data: data.update(format=9)),
        "format 9 is not the supported 3",
    ),
    record(
        "manifest-without-scenario",
        edit_manifest(lambda data: data.pop("scenario")),
        "lacks 'scenario'",
    ),
    record(
        "manifest-bad-scenario",
        edit_manifest(lambda data: data["scenario"].update(duration=-1)),
        "run/manifest.json: duration: must be > 0 s",
    ),
    record(
        "manifest-gain-missing",
        edit_manifest(lambda data: data["scenario"]["controllers"]["tde_aismc"].update(alpha=None)),
        "controllers.tde_aismc.alpha",
    ),
    record(
        "manifest-scenario-list",
        edit_manifest(lambda data: data.update(scenario=[1])),
        "run/manifest.json: must be a mapping",
    ),
    record(
        "manifest-outcome-list",
        edit_manifest(lambda data: data.update(outcome=[1])),
        "is not a run's manifest: TypeError",
    ),
    record(
        "manifest-outcome-status",
        edit_manifest(lambda data: data["outcome"].update(status="fine")),
        "outcome.status must be one of completed",
    ),
    record(
        "manifest-outcome-time",
        edit_manifest(lambda data: data["outcome"].update(time="late")),
        "outcome.time must be a number",
    ),
    record(
        "manifest-wall-time", edit_manifest(lambda data: data.update(wall_time={})), "lacks 'build'"
    ),
]


@pytest.fixture(scope="module")
def good_run(tmp_path_factory, run):
    return run("postcapture", "duration=0.05").save(tmp_path_factory.mktemp("good") / "run")


@pytest.fixture
def unchecked(monkeypatch):
    """Without the check of stability before a run, which costs more than a short one."""
    monkeypatch.setattr("ffsm_drake.control_design.stability.stability_warning", lambda _: "")


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if "__pycache__" not in path.parts}


def check_line(stderr: str, expected: tuple[str, ...]) -> None:
    lines = stderr.splitlines()
    if stderr.startswith("Usage:"):  # click's own
        found = [line for line in lines if line.startswith("Error: ")]
    else:
        found = [line for line in lines if line.startswith("error: ")]
        others = [line for line in lines if line not in found and not line.startswith("warning: ")]
        # progress
        assert all(" of 0.05 s" in line or ": completed" in line for line in others), others
    assert len(found) == 1, stderr
    for fragment in expected:
        assert fragment in found[0]


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row.id)
def test_one_line(row, tmp_path, monkeypatch, capfd, good_run):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    if "run" in shlex.split(row.command)[1:]:
        shutil.copytree(good_run, tmp_path / "run")
    for name, content in row.files.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    if row.prepare is not None:
        row.prepare(tmp_path)
    before = _files(tmp_path)
    result = CliRunner().invoke(main, shlex.split(row.command))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    check_line(result.stderr, row.expected)
    assert "Traceback" not in result.output
    assert result.exit_code == 2
    assert _files(tmp_path) == before
    out, err = capfd.readouterr()
    assert out + err == ""  # nothing past Python's streams either


def test_the_table_is_long_and_its_names_differ():
    assert len(TABLE) >= 70
    assert len({row.id for row in TABLE}) == len(TABLE)


# With Ctrl-C as on a terminal: a process that was started in the background inherits that it is
# ignored.
FFSM = (
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from ffsm_drake.__main__ import main; main()",
)
OWN_PROCESS = {
    "env": os.environ
    | {"PYTHONPATH": str(Path(files.__file__).parents[2]), "PYTHONDONTWRITEBYTECODE": "1"},
    "text": True,
    "stderr": subprocess.PIPE,
}


def ffsm(
    *argv: str, cwd: Path, command: tuple[str, ...] = FFSM, **settings
) -> subprocess.CompletedProcess:
    """The command line in a process of its own."""
    settings = {"stdout": subprocess.PIPE} | OWN_PROCESS | settings
    return subprocess.run([*command, *argv], cwd=cwd, check=False, timeout=120, **settings)


@pytest.mark.parametrize(
    "id", [pytest.param("no-super-init", marks=pytest.mark.slow), "nan-configuration"]
)  # before Drake runs, and in mid-run
def test_one_line_from_a_process_of_its_own(id, tmp_path):
    (row,) = (row for row in TABLE if row.id == id)
    for name, content in row.files.items():
        (tmp_path / name).write_text(content)
    finished = ffsm(*shlex.split(row.command), cwd=tmp_path)
    check_line(finished.stderr, row.expected)
    assert finished.returncode == 2
    assert "Traceback" not in finished.stderr + finished.stdout


def test_standard_output_on_a_full_disk(tmp_path):
    with open("/dev/full", "w") as full:
        finished = ffsm("scenarios", cwd=tmp_path, stdout=full)
    assert "Traceback" not in finished.stderr
    assert finished.stderr.startswith("error: [Errno 28] No space left on device")
    assert finished.returncode != 0


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_scenario(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("duration: 1\n")
    path.chmod(0)
    result = CliRunner().invoke(main, ["validate", str(path)])
    assert result.exit_code == 2
    check_line(result.stderr, ("mine.yaml: cannot be read", "Permission denied"))


def test_empty_scenario_is_the_defaults(tmp_path):
    (tmp_path / "mine.yaml").write_text("")
    assert load_scenario(tmp_path / "mine.yaml").duration == 20.0
    result = CliRunner().invoke(main, ["validate", str(tmp_path / "mine.yaml")])
    assert result.exit_code == 0, result.output


def test_several_scenarios_one_line_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.yaml").write_text("duration: -1\n")
    Path("b.yaml").write_text("sensing: {velocity_noise: {arm: 1}}\n")
    result = CliRunner().invoke(main, ["validate", "a.yaml", "postcapture", "b.yaml"])
    assert result.exit_code == 2
    first, second = result.stderr.splitlines()
    assert first == "error: a.yaml: duration: must be > 0 s, not -1"
    assert second.startswith("error: b.yaml: sensing.velocity_noise.arm: unknown coordinate")
    assert "postcapture: valid" in result.stdout


# A disk that fills up.


def test_full_disk_keeps_the_old_record_whole(tmp_path, good_run, run, monkeypatch):
    """The disk fills up at the last of the three files: all three stay what they were."""
    shutil.copytree(good_run, tmp_path / "run")
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    write_text = Path.write_text

    def full(path, text, **settings):
        if "manifest" in path.name:
            path.touch()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_text(path, text, **settings)

    monkeypatch.setattr(Path, "write_text", full)
    record = run("postcapture", "duration=0.1")
    with pytest.raises(RecordError, match=r"run: cannot be written: .*No space left on device$"):
        record.save(tmp_path / "run")
    assert {path: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before


def test_full_disk_under_the_netcdf_library(tmp_path, monkeypatch):
    """Files may not grow beyond a limit, as on a full disk: the netCDF library meets it in its own
    code.
    """
    monkeypatch.chdir(tmp_path)
    command = shlex.split("run --no-report --set duration=1 --out new")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Python ignores the signal that goes with it
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, limits[1]))
    try:
        finished = CliRunner().invoke(main, command)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert finished.exit_code == 2, finished.stderr
    errors = [line for line in finished.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert "cannot be written" in errors[0]
    assert "Traceback" not in finished.output
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def _contents(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in _files(folder)
    }


@pytest.mark.parametrize("name", ["record.nc", "metrics.json", "manifest.json"])
def test_a_folder_in_the_way_keeps_the_old_record(tmp_path, good_run, run, name):
    shutil.copytree(good_run, tmp_path / "run")
    (tmp_path / "run" / name).unlink()
    (tmp_path / "run" / name).mkdir()
    (tmp_path / "run" / name / "mine.txt").write_text("mine")
    before = _contents(tmp_path)
    with pytest.raises(
        RecordError,
        match=rf"run: cannot be written: .*run/{name} is a folder; "
        r"move it away",
    ):
        run("postcapture", "duration=0.1").save(tmp_path / "run")
    assert _contents(tmp_path) == before


@pytest.mark.parametrize("number", range(8))
def test_a_rename_that_fails_keeps_the_old_record(tmp_path, good_run, run, monkeypatch, number):
    """Of 7 renames, the one of that number fails; other files stay, what tells of the old record
    goes with it.
    """
    shutil.copytree(good_run, tmp_path / "run")
    (tmp_path / "run" / "report.html").write_text("old")
    (tmp_path / "run" / "mine.txt").write_text("mine")
    before, calls, rename = _contents(tmp_path), 0, Path.rename

    def failing(path, target):
        nonlocal calls
        calls += 1
        if calls == number + 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", failing)
    record = run("postcapture", "duration=0.1")
    if number < 7:
        with pytest.raises(RecordError, match=r"run: cannot be written: .*Input/output error"):
            record.save(tmp_path / "run")
        assert _contents(tmp_path) == before
    else:
        record.save(tmp_path / "run")
        assert RunRecord.load(tmp_path / "run").dataset.identical(record.dataset)
        names = {"record.nc", "metrics.json", "manifest.json", "mine.txt"}
        assert {path.name for path in (tmp_path / "run").iterdir()} == names


@pytest.mark.parametrize("name", ["record.nc", "metrics.json", "manifest.json"])
def test_files_of_two_runs_are_refused(tmp_path, good_run, run, name):
    other = run("postcapture", "duration=0.1").save(tmp_path / "run")
    shutil.copyfile(good_run / name, other / name)
    with pytest.raises(RecordError, match="run it again"):
        RunRecord.load(other)


def test_a_report_of_another_run_is_noticed(tmp_path, run, monkeypatch):
    """One in the run's folder that was copied; that of a comparison above, whose runs were made
    anew one by one.
    """
    for section in ("analyze", "stability"):  # which cost most of a report
        monkeypatch.setattr(f"ffsm_drake.show.report.page.{section}", left_out)
    records = [run("postcapture", "duration=0.1", f"controller={name}") for name in ("tdc", "asmc")]
    folders = [record.save(tmp_path / record.scenario.controller) for record in records]
    page = render_report(records[:1])
    assert f"SHA-256 of record.nc</dt><dd>{records[0].identifier}" in page.replace(
        "</dt>\n", "</dt>"
    )
    for folder in (tmp_path, folders[0]):
        (folder / "report.html").write_text(page)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = [RunRecord.load(folder) for folder in folders]
    for folder, record in zip(folders, loaded, strict=True):
        assert (
            record.identifier == json.loads((folder / "metrics.json").read_text())["record_sha256"]
        )
    (folders[1] / "report.html").write_text(page)
    with pytest.warns(
        StaleReportWarning,
        match=r"asmc/report.html shows another run than the "
        r"record.nc of .*asmc",
    ):
        RunRecord.load(folders[1])
    # removes its own report only
    run("postcapture", "duration=0.05", "controller=tdc").save(folders[0])
    with pytest.warns(StaleReportWarning) as told:
        RunRecord.load(folders[0])
    assert [str(item.message).partition(" shows")[0] for item in told] == [
        str(tmp_path / "report.html")
    ]
    CliRunner().invoke(
        main, shlex.split(f"compare -c tdc --no-report {SHORT} --out {shlex.quote(str(tmp_path))}")
    )
    assert not (tmp_path / "report.html").exists()


def left_out(_):
    raise RecordError("left out")


# Runs that end early keep their record.


def check_kept(folder: Path, status: str) -> RunRecord:
    kept = RunRecord.load(folder)
    assert kept.outcome.status == status
    assert kept.dataset.sizes["time"] >= 1
    assert not list(folder.glob(".*partial*"))
    return kept


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-c mine_bad:NanForce", "the force on base_rotation_x is nan"),
        ("-c mine_bad:Inf", "moves at nan rad/s, beyond divergence_speed = 10"),
        ("-c mine_bad:Large", "beyond divergence_speed = 10"),
        ("--set controllers.tde_aismc.k_d=1e20", "beyond divergence_speed = 10"),
        ("--set payload.nominal.mass=1e5", "beyond divergence_speed = 10"),
        ("--set divergence_speed=1e-6", "beyond divergence_speed = 1e-06"),
        ("--set sensing.velocity_noise=1e20", "beyond divergence_speed = 10"),
        ("--set initial_posture.base_position=[1e20,0,0]", "beyond divergence_speed = 10"),
        (
            "--set divergence_speed=1e20 --set payload.nominal.mass=1e10",
            "beyond divergence_speed = 1e+20",
        ),
    ],
)
def test_divergence_exits_with_3_and_keeps_the_record(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("mine_bad.py").write_text(CONTROLLERS)
    result = CliRunner().invoke(
        main, ["run", "--no-report", "--out", "new", *shlex.split(SHORT), *shlex.split(words)]
    )
    assert result.exit_code == 3, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "diverged at t = " in result.stderr
    assert message in result.stderr
    assert "Traceback" not in result.output
    kept = check_kept(tmp_path / "new", "diverged")
    assert message in kept.outcome.message
    analyze(kept)  # what is kept can be looked at


def _started(process: subprocess.Popen) -> None:
    """Wait until the run has begun: its first progress line."""
    for line in process.stderr:
        if "tde_aismc:" in line:
            return
    raise AssertionError("the run never began")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "signals"),
    [
        pytest.param(signal.SIGINT, 1, id="int"),
        pytest.param(signal.SIGTERM, 1, id="term", marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, 2, id="twice", marks=pytest.mark.slow),
    ],
)
def test_interrupted_runs_keep_their_record(tmp_path, number, signals):
    """A signal in mid-run ends with a record; a second one, whenever it comes, leaves a whole
    record or none.
    """
    command = [*FFSM, "run", "--no-report", "--out", "new", "--set", "duration=2000"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, **OWN_PROCESS)
    try:
        _started(process)
        time.sleep(0.3)
        process.send_signal(number)
        if signals == 2:
            time.sleep(0.05)
            process.send_signal(number)
        _, stderr = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 128 + number, stderr
    assert "Traceback" not in stderr
    if signals == 1:
        assert "interrupted" in stderr
        kept = check_kept(tmp_path / "new", "interrupted")
        assert 0.0 < kept.outcome.time < 2000.0
    else:
        assert not list(tmp_path.rglob("*partial*"))
        if (tmp_path / "new" / "manifest.json").exists():
            check_kept(tmp_path / "new", "interrupted")


@pytest.mark.parametrize("number", range(12))
def test_second_interrupt_at_any_moment_of_saving(tmp_path, good_run, run, monkeypatch, number):
    """Ctrl-C at each call that saving makes into the file system: the old record or the new one,
    never a mixture.
    """
    shutil.copytree(good_run, tmp_path / "run")
    calls = 0

    def interrupting(original):
        def call(*args, **kwargs):
            nonlocal calls
            calls += 1
            if calls == number + 1:
                raise KeyboardInterrupt
            return original(*args, **kwargs)

        return call

    record = run("postcapture", "duration=0.1")
    with monkeypatch.context() as patched:
        for name in ("mkdir", "write_text"):
            patched.setattr(Path, name, interrupting(getattr(Path, name)))
        patched.setattr(
            type(record.dataset), "to_netcdf", interrupting(type(record.dataset).to_netcdf)
        )
        with suppress(KeyboardInterrupt):
            record.save(tmp_path / "run")
    kept = RunRecord.load(tmp_path / "run")
    assert kept.scenario.duration == pytest.approx(kept.outcome.time)
    assert kept.dataset["time"].values[-1] == pytest.approx(kept.outcome.time)
    assert len(list((tmp_path / "run").iterdir())) == 3


# The browser view.


def test_the_browser_view_passes_over_a_port_in_use():
    from ffsm_drake.show.meshcat import quiet_drake, start_meshcat

    with socket.socket() as taken, quiet_drake():
        try:
            taken.bind(("127.0.0.1", 7000))
            taken.listen()
        except OSError:
            pass  # in use already, which serves as well
        meshcat = start_meshcat()
        assert 7000 < meshcat.port() < 8000
        assert "127.0.0.1" in meshcat.web_url() or "localhost" in meshcat.web_url()


@pytest.mark.parametrize("where", ["logging", "update"])
def test_an_interrupted_record_is_the_whole_one_up_to_its_end(where, run, monkeypatch):
    """Ctrl-C between two loggers of one instant, or within a control update: every sample that is
    kept is right.
    """
    from ffsm_drake.systems import reference
    from ffsm_drake.systems.controllers import time_delay as tde

    owner, name = {
        "logging": (reference.PolynomialMotion, "row"),
        "update": (tde, "time_delay_force"),
    }[where]
    original, calls = getattr(owner, name), 0

    def interrupting(*args, **kwargs):
        nonlocal calls
        calls += 1
        if calls == 4:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    whole = run("postcapture", "duration=0.2").dataset
    with monkeypatch.context() as patched:
        patched.setattr(owner, name, interrupting)
        record = simulate(load_scenario("postcapture", ["duration=0.2"]), check_stability=False)
    assert record.outcome.status == "interrupted"
    size = record.dataset.sizes["time"]
    assert 1 <= size < whole.sizes["time"]
    assert record.outcome.time == whole["time"].values[size - 1]
    for variable in whole.data_vars:
        assert (record.dataset[variable].values == whole[variable].values[:size]).all(), variable


# Limits that are left are told.

LIMITED = SERVICER.replace("continuous", "revolute", 1).replace(
    '<axis xyz="0 1 0"/>',
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="0.001" effort="2"/>',
)
PLAN = """model: {servicer: servicer.urdf, debris: debris.urdf}
duration: 0.5
reference: {duration: 8}
initial_posture: {joints: {shoulder: 1.5}}
target_posture: {joints: {shoulder: 0.2, wrist: 1}}
payload: {truth: {mass: 166}}
"""
TOLD = (
    "payload.truth.mass: 166 kg takes the place of the 100 kg that the URDF gives debris::debris",
    "initial_posture.joints: outside the URDF's position limits: shoulder 1.5 (limits -1 to 1 rad)",
    "the planned motion: beyond the URDF's velocity limits: shoulder",
    "tracking the planned motion perfectly takes: beyond the URDF's effort limits: shoulder",
)


def warned(stderr: str) -> list[str]:
    return [line for line in stderr.splitlines() if line.startswith("warning: ")]


def test_limits_that_are_left(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in {"servicer.urdf": LIMITED, "debris.urdf": DEBRIS, "mine.yaml": PLAN}.items():
        Path(name).write_text(text)
    within = (
        "--set initial_posture.joints.shoulder=0.2 --set payload.truth.mass=100 --set "
        "target_posture.joints.wrist=0"
    )
    validated = CliRunner().invoke(main, ["validate", "mine.yaml"])
    assert validated.exit_code == 0
    assert all(
        f"warning: mine.yaml: {text}" in line
        for text, line in zip(TOLD, warned(validated.stderr), strict=False)
    )
    quiet = CliRunner().invoke(main, ["validate", "mine.yaml", *shlex.split(within)])
    assert warned(quiet.stderr) == []
    run = CliRunner().invoke(
        main, shlex.split("run --no-report mine.yaml --set actuation.limit=1.5 --out new")
    )
    lines = warned(run.stderr)
    assert all(any(text in line for line in lines) for text in TOLD)
    assert any(
        "the run: outside the URDF's position limits: shoulder 1.5 at t = 0.00 s" in line
        for line in lines
    )
    assert any(
        "saturated at actuation.limit: " in line and "shoulder in " in line for line in lines
    )
    assert "forces and ISV as commanded" in run.stdout
    applied = np.abs(RunRecord.load("new").dataset["applied_force"]).max()
    assert applied == 1.5


def test_a_duration_between_samples_is_told():
    result = CliRunner().invoke(main, ["validate", "postcapture", "--set", "duration=0.0149"])
    assert (
        "duration: 0.0149 s are not a whole number of samples of 0.01 s; the run ends at 0.01 s"
        in result.stderr
    )


# What surrounds a run.


@pytest.mark.usefixtures("unchecked")
def test_a_run_with_other_settings_is_not_replaced_in_silence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def told(words, *more):
        result = CliRunner().invoke(main, [*words.split(), "--no-report", *SHORT.split(), *more])
        assert result.exit_code == 0, result.output
        return [line for line in warned(result.stderr) if "replaced" in line]

    def record():
        return Path("out/postcapture/record.nc").read_bytes()

    assert told("run") == []
    first = record()
    assert told("run") == []
    assert record() == first
    (line,) = told("run", "--seed", "4", "--set", "sensing.delay=1")
    assert "a run with other settings (random_seed, sensing.delay) will be replaced" in line
    assert record() != first
    Path("out/postcapture/manifest.json").write_text("{")
    (line,) = told("run")
    assert "a run that cannot be read will be replaced" in line
    assert record() == first
    assert told("compare -c tdc -c asmc") == []
    (line,) = told("compare -c tdc -c asmc", "--seed", "4")  # for both
    assert (
        "out/compare_postcapture: a run with other settings (random_seed) will be replaced" in line
    )


def test_a_controller_that_leaves_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("mine_bad.py").write_text(CONTROLLERS)
    result = CliRunner().invoke(main, shlex.split(f"run --no-report {SHORT} -c mine_bad:Elsewhere"))
    assert result.exit_code == 0, result.output
    # not where another controller's run would be
    check_kept(tmp_path / "out" / "postcapture_Elsewhere", "completed")


@pytest.mark.slow
@pytest.mark.parametrize("stderr", ["closed", "full"])
def test_standard_error_that_takes_nothing(tmp_path, stderr):
    """A controller that leaves a thread, too: the process ends nevertheless."""
    (tmp_path / "mine_bad.py").write_text(CONTROLLERS)
    command = [
        *FFSM,
        "run",
        "--no-report",
        "-c",
        "mine_bad:LeavesThread",
        *shlex.split(SHORT),
        "--out",
        "new",
    ]
    close = {"preexec_fn": lambda: os.close(2)} if stderr == "closed" else {}
    with open("/dev/full", "w") as full:
        settings = OWN_PROCESS | {"stderr": full} | close
        finished = subprocess.run(command, cwd=tmp_path, check=False, timeout=60, **settings)
    assert finished.returncode == 0
    check_kept(tmp_path / "new", "completed")


def test_a_folder_that_is_gone(tmp_path):
    (tmp_path / "gone").mkdir()
    script = f"import os; os.rmdir({str(tmp_path / 'gone')!r}); {FFSM[2]}"
    finished = ffsm(
        "validate", "postcapture", cwd=tmp_path / "gone", command=(sys.executable, "-c", script)
    )
    assert finished.stderr == "error: the current folder has been deleted; change to another one\n"
    assert finished.returncode == 2


@pytest.mark.slow
def test_a_home_that_cannot_be_written(tmp_path):
    script = "from ffsm_drake.cli import main; main(['schema'], standalone_mode=False); "
    script += "import matplotlib; matplotlib.get_configdir()"
    settings = OWN_PROCESS | {"env": OWN_PROCESS["env"] | {"HOME": "/dev/null"}}
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        settings["env"].pop(name, None)
    finished = ffsm(cwd=tmp_path, command=(sys.executable, "-c", script), **settings)
    assert (finished.stderr, finished.returncode) == ("", 0)


def test_a_name_that_is_no_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["run", "--out", "a\udcff"])
    assert result.exit_code == 2
    check_line(result.stderr, ("is not UTF-8 text; rename the file or folder",))


@pytest.mark.slow
@pytest.mark.usefixtures("rough_pictures")
def test_a_joint_whose_name_looks_like_mathematics(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    odd = "$\\alpha_{x$"
    for name, text in URDFS.items():
        Path(name).write_text(text.replace('"wrist"', f'"{odd}"'))
    Path("mine.yaml").write_text(MINE + "duration: 0.3\ndescription: cost in $\\beta_{$\n")
    assert (
        CliRunner().invoke(main, ["run", "--no-report", "mine.yaml", "--out", "new"]).exit_code == 0
    )
    record = RunRecord.load("new")
    for figure in (run_figures.plot_errors([record]), plot_analysis(analyze(record))):
        figure.savefig(io.BytesIO())


def test_plot_passes_over_what_is_no_run(tmp_path, good_run, monkeypatch):
    shutil.copytree(good_run, tmp_path / "run")
    (tmp_path / "report.html").touch()
    names = [str(tmp_path / name) for name in ("report.html", "run", "nothing")]
    # draws nothing
    result = CliRunner().invoke(main, ["plot", *names, "--out", str(tmp_path / "report.html")])
    assert result.stderr.splitlines()[:2] == [
        f"{names[k]}: is not the folder of a run; left out" for k in (0, 2)
    ]
    assert f"{names[0]}: cannot be written" in result.stderr.splitlines()[2]
    monkeypatch.setattr(
        run_figures,
        "save_figures",
        lambda records, directory: [Path(directory) / str(len(records))],
    )
    result = CliRunner().invoke(main, ["plot", *names])
    assert result.stdout == f"Written to {names[1]}: 1\n"


@pytest.mark.usefixtures("unchecked")
def test_compare_prints_the_best_first(tmp_path):
    words = (
        "compare postcapture -c computed_torque -c tde_aismc --no-report --set duration=1 "
        f"--out {tmp_path}"
    )
    result = CliRunner().invoke(main, shlex.split(words))
    assert [line.split()[0] for line in result.stdout.splitlines()[2:4]] == [
        "tde_aismc",
        "computed_torque",
    ]


def wait_for_handler(process):
    """Until the command catches SIGTERM (SIGINT Python itself does); without /proc for as long as
    that takes.
    """
    status = Path(f"/proc/{process.pid}/status")
    if not status.exists():
        time.sleep(0.5)
        return
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        caught = next(line for line in status.read_text().splitlines() if line.startswith("SigCgt"))
        if int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.002)


@pytest.mark.parametrize("delay", [0.0, pytest.param(0.3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_at_the_start(tmp_path, number, delay):
    """In the imports, mostly: nothing is said, nothing is left."""
    command = [*FFSM, "run", "--out", "new"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, **OWN_PROCESS)
    wait_for_handler(process)
    time.sleep(delay)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 128 + number, stderr
    assert all("tde_aismc:" in line for line in stderr.splitlines())  # at most its progress
    assert not list(tmp_path.rglob("*partial*"))
    for kept in tmp_path.rglob("manifest.json"):
        check_kept(kept.parent, "interrupted")
