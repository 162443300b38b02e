"""Logs with degenerate numbers, several time axes, or blank cells: a right verdict or one line."""

import drawn_logs
import numpy as np
import pytest
import scipy.io
import xarray as xr

from ffsm_drake.common.errors import RecordError
from ffsm_drake.plugins.audit.verdict import audit


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("craft") / "craft.urdf"
    path.write_text(drawn_logs.craft(5, 2).urdf)
    return path


@pytest.fixture(scope="module")
def log():
    return drawn_logs.by_mujoco(drawn_logs.craft(5, 2), 3, duration=2.0, spin=0.2)


def outcome(path, model):
    """The verdict, or the error's one line."""
    try:
        said = audit(path, model).verdict
    except RecordError as error:
        said = str(error)
    assert "\n" not in said
    return said


def put(log, names, value, rows=slice(None)):
    changed = {name: log[name].copy() for name in names}
    for column in changed.values():
        column[rows] = value
    return log | changed


DEGENERATE = {
    "tiny quaternions": (
        lambda log: drawn_logs.scaled(log, 1e-200, drawn_logs.QUATERNION), "no",
    ),
    "no quaternions": (
        lambda log: put(log, drawn_logs.QUATERNION, 0.0), "the quaternion is zero in sample 0",
    ),
    "a zero quaternion": (
        lambda log: put(log, drawn_logs.QUATERNION, 0.0, 7), "the quaternion is zero in sample 7",
    ),
    "an empty angle": (lambda log: put(log, ["hinge_0"], np.nan), "hinge_0 has no number"),
    "an empty rate": (lambda log: put(log, ["hinge_0_rate"], np.nan), "hinge_0_rate has no number"),
    "no efforts": (lambda log: put(log, ["hinge_0_effort", "hinge_1_effort"], np.nan), "yes"),
    "an empty position": (
        lambda log: put(log, drawn_logs.POSITION, np.nan), "base_position_x has no number",
    ),
    "empty times": (lambda log: put(log, ["time"], np.nan), "has 0 samples"),
    "a huge rate": (lambda log: put(log, ["hinge_0_rate"], 1e300, 3), "not a finite number"),
    "an infinite effort": (
        lambda log: put(log, ["hinge_0_effort"], np.inf, 3), "not a finite number",
    ),
    "huge positions": (lambda log: put(log, drawn_logs.POSITION, 1e40, 3), "no"),
    "tiny times": (lambda log: drawn_logs.scaled(log, 1e-300, ["time"]), "spans"),
    "nothing moves": (
        lambda log: {n: np.full_like(v, v[0]) if n != "time" else v for n, v in log.items()}, "no",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("kind", [".mat", ".csv"])
def test_degenerate_numbers(kind, name, log, model, tmp_path):
    change, expected = DEGENERATE[name]
    path = tmp_path / f"log{kind}"
    if kind == ".mat":
        scipy.io.savemat(path, change(log))
    else:
        drawn_logs.write(path, change(log), "%.17g")
    found = outcome(path, model)
    assert expected in found if len(expected) > 3 else expected == found, found


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_cells_of_drawn_degenerate_numbers(seed, log, model, tmp_path):
    """A cell, a column or a row of any: never a traceback."""
    draw = np.random.default_rng(seed)
    for _ in range(8):
        name = draw.choice([*log])
        value = draw.choice([0.0, 1e-200, -1e-310, 1e49, 1e300, np.nan, np.inf, -1.0])
        rows = [slice(None), int(draw.integers(200)), slice(0, 100)][draw.integers(3)]
        scipy.io.savemat(tmp_path / "log.mat", put(log, [name], value, rows))
        outcome(tmp_path / "log.mat", model)


@pytest.mark.slow
@pytest.mark.parametrize("step", [1, 2])
def test_a_netcdf_with_two_time_axes(step, log, model, tmp_path):
    """Of one length or two: what is not along the axis of the time is not that of its samples."""
    late = log["time"][::step] + (0.5 if step == 1 else 0.0)
    data = xr.Dataset(coords={"time": log["time"], "time_of_joints": late})
    for name, values in log.items():
        if name.startswith("hinge"):
            data[name] = "time_of_joints", values[::step]
        elif name != "time":
            data[name] = "time", values
    data.to_netcdf(tmp_path / "log.nc")
    assert "has no column hinge_0 (or" in outcome(tmp_path / "log.nc", model)


@pytest.mark.parametrize("start", [0.0, 1e3, 1e6])
def test_times_of_single_precision(start, log, model, tmp_path):
    """Beyond a day its steps are as long as the samples' period."""
    single = {name: values.astype(np.float32) for name, values in log.items()}
    single["time"] = (log["time"] + start).astype(np.float32)
    data = xr.Dataset({name: ("sample", values) for name, values in single.items()})
    data.to_netcdf(tmp_path / "log.nc")
    assert outcome(tmp_path / "log.nc", model) in ("yes", "cannot tell")


@pytest.mark.parametrize("seed", range(3))
def test_joints_at_every_fifth_row_are_not_accused(seed, tmp_path):
    craft = drawn_logs.craft(seed, 3)
    (tmp_path / "craft.urdf").write_text(craft.urdf)
    log = drawn_logs.by_mujoco(craft, seed, spin=0.2)
    for name in (*craft.names(), *craft.names("_rate"), *craft.names("_effort")):
        log[name][np.arange(len(log[name])) % 5 != 2] = np.nan
    assert outcome(drawn_logs.write(tmp_path / "log.csv", log), tmp_path / "craft.urdf") != "no"
    log = drawn_logs.scaled(log, 1.05, drawn_logs.ANGULAR)
    assert outcome(drawn_logs.write(tmp_path / "log.csv", log), tmp_path / "craft.urdf") == "no"
