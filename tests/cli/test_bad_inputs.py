"""Bad input of every kind gets one line that says where, what is wrong and what would be right, and
leaves no files.

A case is one entry of bad_inputs.yaml, or a row of TABLE.
"""

import dataclasses
import errno
import functools
import io
import json
import os
import re
import resource
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from children import PIPE, CompletedProcess, child, finished
from click.testing import CliRunner
from entry_points import is_there, needs
from record_tools import sealed

from ffsm_drake import RecordError, RunRecord, load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.common import files
from ffsm_drake.common.registrations import VERBS
from ffsm_drake.runs import reading
from ffsm_drake.scenario.strict_yaml import read_yaml
from ffsm_drake.show.figures import run as run_figures

INPUTS = Path(__file__).parent / "inputs"
URDFS = {name: (INPUTS / name).read_text() for name in ("servicer.urdf", "debris.urdf")}
CONTROLLERS = (INPUTS / "controllers.py").read_text()
MODULES = {"mine_bad.py": CONTROLLERS}
MINE = "model: {servicer: servicer.urdf, debris: debris.urdf}\n"
SHORT = "--set duration=0.05"


@dataclasses.dataclass(frozen=True)
class Row:
    """One bad input: what to type, what the one line must say, and the files that are there."""

    id: str
    command: str
    expected: tuple[str, ...]
    files: Mapping[str, str | bytes] = dataclasses.field(default_factory=dict)
    prepare: Callable[[Path], object] | None = None


def command(id: str, text: str, *expected: str) -> Row:
    return Row(id, text, expected)


def taken(id: str, text: str, *expected: str) -> Row:
    return Row(id, text, expected, {"taken": ""})


def scenario(id: str, text: str | bytes, *expected: str, command: str = "validate") -> Row:
    text = text if isinstance(text, bytes) else f"{text}\n"
    return Row(id, f"{command} mine.yaml", ("mine.yaml: ", *expected), {"mine.yaml": text})


def override(id: str, text: str, *expected: str) -> Row:
    return Row(id, f"validate postcapture --set {shlex.quote(text)}", ("--set ", *expected))


def model(id: str, text: str, *expected: str, **files: str | bytes) -> Row:
    """A model section beside the two small URDFs; ``files`` are further or other ones."""
    return Row(id, "validate mine.yaml", expected, {**URDFS, "mine.yaml": f"{text}\n", **files})


def directives(id: str, text: str, *expected: str) -> Row:
    given = {"mine.dmd.yaml": text}
    return model(id, "model: {directives: mine.dmd.yaml}", "mine.dmd.yaml", *expected, **given)


def urdf(id: str, old: str, new: str, *expected: str, file: str = "servicer.urdf") -> Row:
    """A small URDF with one fault: the first ``old`` becomes ``new``."""
    assert old in URDFS[file]
    return model(id, MINE, *expected, **{file: URDFS[file].replace(old, new, 1)})


def visual(id: str, shape: str, *expected: str, **files: str) -> Row:
    """The small servicer with a shape to be drawn."""
    end = f"<visual><geometry>{shape}</geometry></visual></link>"
    row = urdf(id, "</link>", end, *expected)
    return dataclasses.replace(row, files={**row.files, **files})


def controller(
    id: str, name: str, *expected: str, command: str = "validate", text: str = CONTROLLERS
) -> Row:
    """A user-supplied controller; modules are imported once, so that each row has its own."""
    module = f"bad_{id.replace('-', '_')}"
    words = {
        "run": f"run --no-report {SHORT} -c ",
        "validate": "validate postcapture --set controller=",
        "stability": "stability -c ",
    }[command]
    return Row(id, f"{words}{module}:{name}", (name, *expected), {f"{module}.py": text})


def module(id: str, text: str, *expected: str) -> Row:
    return controller(id, "Law", *expected, text=f"{text}\n")


def record(
    id: str, damage: Callable[[Path], object], *expected: str, command: str = "analyze run"
) -> Row:
    """A run's folder ``run`` that was damaged."""
    return Row(id, command, expected, prepare=lambda at: damage(at / "run"))


def put(name: str, place: object, value: object) -> Callable:
    """Change some values of a variable."""

    def change(data):
        values = data[name].values.copy()
        values[place] = value
        return data.assign({name: (data[name].dims, values, data[name].attrs)})

    return change


def manifest(
    id: str,
    change: Callable[[dict], object] | str | bytes,
    *expected: str,
    command: str = "analyze run",
    fits: bool = False,
) -> Row:
    """A run's manifest.json with other contents; ``fits``: with a checksum that fits it."""

    def damage(run: Path) -> None:
        path = run / "manifest.json"
        if callable(change):
            data = json.loads(path.read_text())
            change(data)
            path.write_text(json.dumps(data))
        else:
            path.write_bytes(change if isinstance(change, bytes) else change.encode())
        if fits:
            sealed(run)

    return record(id, damage, *expected, command=command)


def dataset(
    id: str, change: Callable, *expected: str, command: str = "analyze run", fits: bool = True
) -> Row:
    """A run's record.nc with other contents, and checksums that fit it."""

    def damage(run: Path) -> None:
        import xarray as xr

        path = run / "record.nc"
        changed = change(xr.load_dataset(path))
        path.unlink()
        changed.to_netcdf(path, unlimited_dims=["time"])
        if fits:
            sealed(run)

    return record(id, damage, *expected, command=command)


def huge(path: Path) -> None:
    """Make a file of a terabyte, which takes no room."""
    path.touch()
    os.truncate(path, 10**12)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def replaced(name: str, make: Callable[[Path], object]) -> Callable[[Path], object]:
    """Put what ``make`` makes in the place of a file."""
    return lambda run: ((run / name).unlink(), make(run / name))


SECTIONS = {
    "command": command,
    "taken": taken,
    "scenario": scenario,
    "override": override,
    "model": model,
    "urdf": urdf,
    "visual": visual,
    "controller": controller,
    "controller run": functools.partial(controller, command="run"),
    "controller stability": functools.partial(controller, command="stability"),
    "module": module,
    "directives": directives,
    "manifest": manifest,
}


def written_rows() -> Iterator[Row]:
    """The entries of bad_inputs.yaml."""
    sections = read_yaml((Path(__file__).parent / "bad_inputs.yaml").read_text())
    for section, entries in sections.items():
        for id, given in entries.items():
            yield SECTIONS[section](id, *given)


BOMB = "_a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"_{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
SERVICER = URDFS["servicer.urdf"]
BASE_LINK = SERVICER[SERVICER.index('<link name="base">') : SERVICER.index('  <link name="arm">')]
STRAY_LINK = """<link name="stray"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
"""
BALL_JOINT = SERVICER.replace(
    '<joint name="wrist" type="continuous">',
    '<drake:joint xmlns:drake="x" name="wrist" type="ball">',
)
BALL_JOINT = "</drake:joint>".join(BALL_JOINT.rsplit("</joint>", 1))
STUCK = {
    "scenario": "thrusters_and_wheels",
    "cases": 2,
    "parameters": {
        "actuation.thrusters": {
            "distribution": "list",
            "values": [{"failures": {"a_w": "stuck_off"}}],
        }
    },
}
BUFFER = '{"asset": {"version": "2.0"}, "buffers": [{"uri": "pipe", "byteLength": 4}]}'


def with_pipe(row: Row) -> Row:
    """The row beside a FIFO into which nobody writes."""
    return dataclasses.replace(row, prepare=lambda at: os.mkfifo(at / "pipe"))


# What bad_inputs.yaml cannot hold: bytes, generated text, several files, damaged records.
TABLE = [
    *written_rows(),
    command("long-name", f"validate {'x' * 300}.yaml", "x.yaml: ", "too long"),
    command(
        "out-too-long",
        f"run --no-report {SHORT} --out {'x' * 300}",
        "cannot be written",
        "too long",
    ),
    scenario("not-utf-8", b"description: caf\xe9\n", "is not UTF-8 text"),
    scenario("binary", b"\x00\x01\x02", "is not valid YAML", "character 1"),
    scenario("huge-file", "# " + "x" * 1_100_000, "larger than 1000000 bytes"),
    scenario("alias-bomb", BOMB + "description: *i", "aliases (*name) expand to more than"),
    scenario("deep-nesting", "description: " + "[" * 5000, "nested deeper than 50 levels"),
    scenario("500-digits", f"duration: {'9' * 500}", "duration: must be finite"),
    scenario("5000-digits", f"duration: {'9' * 5000}", "line 1, column 11", "4300 digits"),
    scenario(
        "file-fault-stays-the-file's",
        "controllers: {asmc: {k_s: -1}}",
        "k_s.all",
        command="validate --set controller=tdc",
    ),
    Row(
        "failure-in-a-campaign",
        "campaign plan c.yaml",
        ("actuation.thrusters.failures.a_w: 'a_w' is unknown",),
        {"c.yaml": yaml.safe_dump(STUCK)},
    ),
    Row(
        "small-mass-matrix",
        f"run --no-report {SHORT} -c mine_bad:small_matrix",
        ("mass matrix has the shape (3, 3); it must be (11, 11)",),
        MODULES,
    ),
    Row(
        "unknown-own-gain",
        "validate postcapture --set controller=mine_bad:Good --set controllers.Good.kk=1",
        ("controllers.Good.kk: unknown gain; Good has k; did you mean 'k'?",),
        MODULES,
    ),
    # Models.
    urdf("empty-urdf", SERVICER, "", "model.servicer", "servicer.urdf"),
    urdf(
        "urdf-zero-mass",
        BASE_LINK,
        '<link name="base"/>\n',
        "mass matrix is singular",
        "use heavier links",
    ),
    urdf(
        "urdf-debris-unphysical",
        'ixx="16" iyy="16"',
        'ixx="1" iyy="1"',
        "model.debris",
        "debris.urdf",
        file="debris.urdf",
    ),
    urdf("urdf-ball-joint", SERVICER, BALL_JOINT, "joint 'wrist' has 3 degrees"),
    urdf(
        "urdf-loose-link",
        '<frame name="end',
        STRAY_LINK + '<frame name="end',
        "one floating base, not 2",
        "stray",
    ),
    urdf(
        "urdf-all-fixed",
        SERVICER,
        SERVICER.replace("continuous", "fixed"),
        "servicer.urdf: no joint moves; an arm has revolute, continuous or prismatic joints",
    ),
    *(
        visual(f"no-mesh-{kind}", f'<mesh filename="m.{kind}"/>', said, **{f"m.{kind}": "hello"})
        for kinds, words in (
            ("obj gltf dae", "m.{}: cannot be drawn"),
            ("stl glb txt", "this format cannot be drawn; convert it to .obj"),
        )
        for kind in kinds.split()
        for said in (words.format(kind),)
    ),
    *(
        with_pipe(visual(id, f'<mesh filename="{mesh}"/>', "pipe: is not a regular file", **files))
        for id, mesh, files in (
            ("mesh-of-a-fifo", "pipe", {}),
            ("buffer-of-a-fifo", "m.gltf", {"m.gltf": BUFFER}),
            (
                "material-of-a-fifo",
                "m.obj",
                {"m.obj": "mtllib m.mtl\n", "m.mtl": "newmtl a\nmap_Kd pipe\n"},
            ),
        )
    ),
    dataclasses.replace(
        visual("huge-mesh", '<mesh filename="m.obj"/>', "m.obj: has 1e+12 bytes; at most 5e+08"),
        prepare=lambda at: huge(at / "m.obj"),
    ),
    # Run directories.
    record(
        "no-record",
        lambda run: (run / "record.nc").unlink(),
        "run/record.nc: cannot be read: no such file; run it again",
    ),
    record(
        "no-manifest",
        lambda run: (run / "manifest.json").unlink(),
        "run: contains no run (manifest.json is missing)",
    ),
    record(
        "truncated",
        lambda run: truncate(run / "record.nc"),
        "run/record.nc: was changed after the run, or belongs to another run than",
        "run it again",
    ),
    record(
        "empty-record",
        lambda run: ((run / "record.nc").write_bytes(b""), sealed(run)),
        "run/record.nc: cannot be read",
    ),
    record(
        "text-as-record",
        lambda run: ((run / "record.nc").write_text("hello"), sealed(run)),
        "run/record.nc: cannot be read",
    ),
    record(
        "record-is-a-folder",
        lambda run: ((run / "record.nc").unlink(), (run / "record.nc").mkdir()),
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
            ("pipe-as", os.mkfifo, "is not a regular file"),
            ("huge", huge, "has 1e+12 bytes"),
        )
    ),
    record(
        "device-as-record",
        lambda run: (
            (run / "record.nc").unlink(),
            (run / "record.nc").symlink_to("/dev/zero"),
        ),
        "run/record.nc: cannot be read: is not a regular file",
    ),
    dataset(
        "other-record",
        lambda data: data.assign(error=2.0 * data["error"]),
        "run/record.nc: was changed after the run, or belongs to another run than",
        fits=False,
    ),
    *(
        dataset(f"{id}-{command}", change, *expected, command=f"{command} run")
        for command in ("analyze", "plot", "replay")
        for id, change, *expected in (
            ("nan", put("position", (1, 7), np.nan), "position must be finite", "at sample 1"),
            ("zero-quaternion", put("position", (2, slice(4)), 0), "unit quaternions", "sample 2"),
            ("huge-quaternion", put("position", (2, slice(4)), 1e80), "unit quatern", "sample 2"),
            ("huge-joint", put("position", (2, 8), 1e160), "finite and below 1e+100", "sample 2"),
            (
                "reversed",
                lambda data: data.assign_coords(time=data.time.values[::-1]),
                "time must hold the control samples from 0, 0.01 s apart",
            ),
            ("constant-time", lambda data: data.assign_coords(time=0 * data.time), "time must"),
            (
                "text-time",
                lambda data: data.assign_coords(time=data.time.astype(str)),
                "time must",
            ),
            (
                "endless",
                lambda data: data.assign_coords(time=[*data.time.values[:-1], 1e9]),
                "time must hold the control samples from 0, 0.01 s apart",
            ),
            (
                "sample-time-zero",
                lambda data: data.assign_attrs(sample_time=0.0),
                "sample_time must be 0.01",
            ),
            (
                "sample-time-text",
                lambda data: data.assign_attrs(sample_time="x"),
                "sample_time must be a number, not ",
            ),
            (
                "fewer-coordinates",
                lambda data: data.isel(coordinate=slice(8)),
                "coordinate must be base_rotation_x, ",
            ),
            (
                "units-that-decode",
                lambda data: data.assign(error=data.error.assign_attrs(units=1.0)),
                "attribute units of error must be text",
            ),
        )
    ),
    dataset(
        "zero-samples",
        lambda data: data.isel(time=slice(0, 0)),
        "run/record.nc: holds no samples",
    ),
    dataset(
        "zero-samples-plot",
        lambda data: data.isel(time=slice(0, 0)),
        "run/record.nc: holds no samples",
        command="plot run",
    ),
    dataset(
        "missing-variable",
        lambda data: data.drop_vars("error"),
        "run/record.nc: lacks error; ",
        "run it again",
    ),
    dataset(
        "missing-names",
        lambda data: data.drop_vars("coordinate"),
        "run/record.nc: lacks coordinate",
    ),
    dataset(
        "wrong-shape",
        lambda data: data.assign(error=data["error"].T),
        "error must hold numbers along time, coordinate",
    ),
    dataset(
        "no-sample-time",
        lambda data: data.drop_attrs(),
        "run/record.nc: lacks the attribute sample_time",
    ),
    manifest("manifest-not-utf-8", b"\xff", "run/manifest.json: is not a run's manifest"),
    manifest(
        "manifest-too-deep",
        "[" * 100_000,
        "is not a run's manifest",
        "RecursionError",
    ),
    manifest(
        "other-format",
        lambda data: data.update(format=9),
        "format 9 is not the supported 4",
    ),
    manifest(
        "manifest-without-scenario",
        lambda data: data.pop("scenario"),
        "lacks 'scenario'",
    ),
    manifest(
        "manifest-bad-scenario",
        lambda data: data["scenario"].update(duration=-1),
        "run/manifest.json: duration: must be > 0 s",
    ),
    manifest(
        "manifest-gain-missing",
        lambda data: data["scenario"]["controllers"]["tde_aismc"].update(alpha=None),
        "controllers.tde_aismc.alpha",
        fits=True,
    ),
    manifest(
        "manifest-scenario-list",
        lambda data: data.update(scenario=[1]),
        "run/manifest.json: must be a mapping",
    ),
    manifest(
        "manifest-outcome-list",
        lambda data: data.update(outcome=[1]),
        "is not a run's manifest: TypeError",
    ),
    manifest(
        "manifest-outcome-status",
        lambda data: data["outcome"].update(status="fine"),
        "outcome.status must be one of completed",
    ),
    manifest(
        "manifest-outcome-time",
        lambda data: data["outcome"].update(time="late"),
        "outcome.time must be a number",
    ),
    *(
        manifest(
            f"manifest-{id}-{command}",
            change,
            *expected,
            command=f"{command} run",
            fits=fits,
        )
        for command in ("analyze", "plot", "replay")
        for id, change, fits, *expected in (
            (
                "another-model",
                lambda data: data["scenario"]["model"].update(
                    directives="package://ffsm_drake/seven_joint.dmd.yaml"
                ),
                True,
                "record.nc: coordinate must be",
                "as in the scenario's model",
            ),
            (
                "another-mass",
                lambda data: data["scenario"]["payload"]["truth"].update(mass=90.0),
                False,
                "run/manifest.json: was changed after the run",
            ),
            (
                "another-end",
                lambda data: data["outcome"].update(time=0.02),
                True,
                "time ends at 0.05 s, but at 0.02 s in manifest.json",
            ),
        )
    ),
    manifest("manifest-wall-time", lambda data: data.update(wall_time={}), "lacks 'build'"),
]


@pytest.fixture(scope="module")
def good_run(tmp_path_factory, run):
    return run("postcapture", "duration=0.05").save(tmp_path_factory.mktemp("good") / "run")


@pytest.fixture
def unchecked(monkeypatch):
    """Without the check of stability before a run, which costs more than a short one."""
    nothing = SimpleNamespace(warnings=())
    if is_there("design"):
        monkeypatch.setattr("ffsm_drake.plugins.design.verdict.verdict", lambda *_, **__: nothing)


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if "__pycache__" not in path.parts}


def check_line(stderr: str, expected: tuple[str, ...]) -> None:
    lines = stderr.splitlines()
    if stderr.startswith("Usage:"):  # click's own
        found = [line for line in lines if line.startswith("error: ")]
    else:
        found = [line for line in lines if line.startswith("error: ")]
        others = [line for line in lines if line not in found and not line.startswith("warning: ")]
        # progress
        told = r" of [\d.]+ s$|: completed|^ *\d+ s: "
        assert all(re.search(told, line) for line in others), others
    assert len(found) == 1, stderr
    check_prefixes(found[0])
    for fragment in expected:
        assert fragment in found[0]


def check_prefixes(line: str) -> None:
    """No name stands twice before a colon, and no two kinds of exception do."""
    *prefixes, _ = line.split(": ")
    assert len(prefixes) == len({*prefixes}), line
    assert sum(re.fullmatch(r"\w*(Error|Exception)", each) is not None for each in prefixes) <= 1, (
        line
    )


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


@pytest.mark.smoke
def test_the_table_is_long_and_its_names_differ():
    assert len(TABLE) >= 70
    assert len({row.id for row in TABLE}) == len(TABLE)


FFSM = (sys.executable, "-m", "ffsm_drake")
OWN_PROCESS = {
    "env": os.environ
    | {"PYTHONPATH": str(Path(files.__file__).parents[2]), "PYTHONDONTWRITEBYTECODE": "1"},
    "text": True,
    "stderr": PIPE,
}


def ffsm(*argv: str, cwd: Path, command: tuple[str, ...] = FFSM, **settings) -> CompletedProcess:
    """The command line in a process of its own."""
    return finished([*command, *argv], cwd=cwd, **OWN_PROCESS | settings)


@pytest.mark.parametrize(
    "id",  # before and in the run
    [
        pytest.param("no-super-init", marks=pytest.mark.slow),
        pytest.param("nan-configuration", marks=pytest.mark.long),
    ],
)
def test_one_line_from_a_process_of_its_own(id, tmp_path):
    (row,) = (row for row in TABLE if row.id == id)
    for name, content in row.files.items():
        (tmp_path / name).write_text(content)
    ended = ffsm(*shlex.split(row.command), cwd=tmp_path)
    check_line(ended.stderr, row.expected)
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr + ended.stdout


@pytest.mark.slow
def test_standard_output_on_a_full_disk(tmp_path):
    with open("/dev/full", "w") as full:
        ended = ffsm("scenarios", cwd=tmp_path, stdout=full)
    assert "Traceback" not in ended.stderr
    assert ended.stderr.startswith("error: [Errno 28] No space left on device")
    assert ended.returncode != 0


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_scenario(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("duration: 1\n")
    path.chmod(0)
    result = CliRunner().invoke(main, ["validate", str(path)])
    assert result.exit_code == 2
    check_line(result.stderr, ("mine.yaml: cannot be read", "Permission denied"))


@pytest.mark.slow
def test_empty_scenario_is_the_defaults(tmp_path):
    (tmp_path / "mine.yaml").write_text("")
    assert load_scenario(tmp_path / "mine.yaml").duration == 20.0
    result = CliRunner().invoke(main, ["validate", str(tmp_path / "mine.yaml")])
    assert result.exit_code == 0, result.output


@pytest.mark.smoke
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


@pytest.mark.parametrize("number", range(4))
def test_a_file_that_cannot_be_replaced_keeps_the_old_record(
    tmp_path, good_run, run, monkeypatch, number
):
    """Of 3 files the one of that number; other files stay, the old report goes with its record."""
    shutil.copytree(good_run, tmp_path / "run")
    (tmp_path / "run" / "report.html").write_text("old")
    (tmp_path / "run" / "mine.txt").write_text("mine")
    before, calls, replace = _contents(tmp_path), 0, Path.replace

    def failing(path, target):
        nonlocal calls
        calls += 1
        if calls == number + 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", failing)
    record = run("postcapture", "duration=0.1")
    if number < 3:
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


@pytest.mark.parametrize("name", ["record.nc", "metrics.json", "manifest.json"])
@pytest.mark.parametrize(
    ("error", "told"),
    [
        (PermissionError(13, "Permission denied"), r"no permission; chmod u\+r \S*{name}$"),
        (OSError("is not a regular file"), "is not a regular file; (run it again|give the folder)"),
    ],
)
def test_a_remedy_can_help(error, told, name, good_run, monkeypatch):
    def check(path, *, limit):
        if path.name == name:
            raise error

    monkeypatch.setattr(reading, "check_regular", check)
    with pytest.raises(RecordError, match=told.format(name=re.escape(name))):
        RunRecord.load(good_run)


# Runs that end early keep their record.


def check_kept(folder: Path, status: str) -> RunRecord:
    kept = RunRecord.load(folder)
    assert kept.outcome.status == status
    assert kept.dataset.sizes["time"] >= 1
    assert not list(folder.glob(".*partial*"))
    return kept


@pytest.mark.slow
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
@pytest.mark.usefixtures("no_remedies")
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
    if analyze := VERBS.find("analyze"):  # what is kept can be looked at
        analyze(kept)


def _started(process) -> None:
    """Wait until the run has begun: its first progress line."""
    for line in process.stderr:
        if "tde_aismc:" in line:
            return
    raise AssertionError("the run never began")


@pytest.mark.parametrize(
    ("number", "signals"),
    [
        pytest.param(signal.SIGINT, 1, id="int", marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 1, id="term", marks=pytest.mark.long),
        pytest.param(signal.SIGINT, 2, id="twice", marks=pytest.mark.long),
    ],
)
def test_interrupted_runs_keep_their_record(tmp_path, number, signals):
    """A signal in mid-run ends with a record; a second one, whenever it comes, leaves a whole
    record or none.
    """
    command = [*FFSM, "run", "--no-report", "--out", "new", "--set", "duration=2000"]
    with child(command, cwd=tmp_path, stdout=PIPE, **OWN_PROCESS) as process:
        _started(process)
        time.sleep(0.3)
        process.send_signal(number)
        if signals == 2:
            time.sleep(0.05)
            process.send_signal(number)
        _, stderr = process.communicate(timeout=120)
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
            type(record.dataset), "dump_to_store", interrupting(type(record.dataset).dump_to_store)
        )
        with suppress(KeyboardInterrupt):
            record.save(tmp_path / "run")
    kept = RunRecord.load(tmp_path / "run")
    assert kept.scenario.duration == pytest.approx(kept.outcome.time)
    assert kept.dataset["time"].values[-1] == pytest.approx(kept.outcome.time)
    assert len(list((tmp_path / "run").iterdir())) == 3


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
            signal.raise_signal(signal.SIGINT)
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
    "payload.truth.mass: 166 kg replaces the 100 kg of debris::debris in the URDF",
    "initial_posture.joints exceeds the URDF's position limits: shoulder 1.5 (limits -1 to 1 rad)",
    "the planned motion exceeds the URDF's velocity limits: shoulder",
    "perfect tracking of the planned motion exceeds the URDF's effort limits: shoulder",
)


def warned(stderr: str) -> list[str]:
    return [line for line in stderr.splitlines() if line.startswith("warning: ")]


@pytest.mark.slow
@needs("design")
def test_limits_that_are_left(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in {**URDFS, "servicer.urdf": LIMITED, "mine.yaml": PLAN}.items():
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
        "the run exceeds the URDF's position limits: shoulder 1.5 at t = 0.00 s" in line
        for line in lines
    )
    assert any(
        "saturated at actuation.limit: " in line and "shoulder in " in line for line in lines
    )
    assert "forces and ISV as commanded" in run.stdout
    applied = np.abs(RunRecord.load("new").dataset["applied_force"]).max()
    assert applied == 1.5


@needs("design")
def test_a_duration_between_samples_is_told():
    result = CliRunner().invoke(main, ["validate", "postcapture", "--set", "duration=0.0149"])
    assert (
        "duration: the run ends at 0.01 s, because 0.0149 s is not a whole number of samples"
        in result.stderr
    )


# What surrounds a run.


@pytest.mark.long
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


@pytest.mark.parametrize(
    "stderr",
    [
        pytest.param("closed", marks=pytest.mark.long),
        pytest.param("full", marks=pytest.mark.long),
    ],
)
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
    if stderr == "closed":
        command = ["sh", "-c", 'exec "$@" 2>&-', "sh", *command]
    with open("/dev/full", "w") as full:
        ended = finished(command, cwd=tmp_path, **OWN_PROCESS | {"stderr": full})
    assert ended.returncode == 0
    check_kept(tmp_path / "new", "completed")


def test_a_folder_that_is_gone(tmp_path):
    (tmp_path / "gone").mkdir()
    script = f"import os; os.rmdir({str(tmp_path / 'gone')!r}); "
    script += "from ffsm_drake.__main__ import main; main()"
    ended = ffsm(
        "validate", "postcapture", cwd=tmp_path / "gone", command=(sys.executable, "-c", script)
    )
    assert ended.stderr == "error: the current folder has been deleted; change to another one\n"
    assert ended.returncode == 2


@pytest.mark.long
def test_a_home_that_cannot_be_written(tmp_path):
    script = "from ffsm_drake.cli import main; main(['schema'], standalone_mode=False); "
    script += "import matplotlib; matplotlib.get_configdir()"
    settings = OWN_PROCESS | {"env": OWN_PROCESS["env"] | {"HOME": "/dev/null"}}
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        settings["env"].pop(name, None)
    ended = ffsm(cwd=tmp_path, command=(sys.executable, "-c", script), **settings)
    assert (ended.stderr, ended.returncode) == ("", 0)


def test_a_name_that_is_no_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["run", "--out", "a\udcff"])
    assert result.exit_code == 2
    check_line(result.stderr, ("is not UTF-8 text; rename the file or folder",))


@pytest.mark.long
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
    run_figures.plot_errors([RunRecord.load("new")]).savefig(io.BytesIO())
    done = CliRunner().invoke(main, ["analyze", "new"])  # draws too
    assert done.exit_code == 0, done.output


def test_plot_passes_over_what_is_no_run(tmp_path, good_run, monkeypatch):
    shutil.copytree(good_run, tmp_path / "run")
    (tmp_path / "report.html").touch()
    names = [str(tmp_path / name) for name in ("report.html", "run", "nothing")]
    # draws nothing
    result = CliRunner().invoke(main, ["plot", *names, "--out", str(tmp_path / "report.html")])
    assert result.stderr.splitlines()[:2] == [
        f"{names[k]}: contains no run; skipped" for k in (0, 2)
    ]
    assert f"{names[0]}: cannot be written" in result.stderr.splitlines()[2]
    monkeypatch.setattr(
        run_figures,
        "save_figures",
        lambda records, directory, formats, **how: [Path(directory) / str(len(records))],
    )
    result = CliRunner().invoke(main, ["plot", *names])
    assert result.stdout == f"Written to {names[1]}: 1\n"


@pytest.mark.slow
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
    """In the imports, mostly: only the last line is said, nothing is left."""
    command = [*FFSM, "run", "--out", "new"]
    with child(command, cwd=tmp_path, stdout=PIPE, **OWN_PROCESS) as process:
        wait_for_handler(process)
        time.sleep(delay)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 128 + number, stderr
    said = ("tde_aismc:", "interrupted; again: ffsm run --out new", "ending: the present step")
    assert all(any(each in line for each in said) for line in stderr.splitlines()), stderr
    assert not list(tmp_path.rglob("*partial*"))
    for kept in tmp_path.rglob("manifest.json"):
        check_kept(kept.parent, "interrupted")
