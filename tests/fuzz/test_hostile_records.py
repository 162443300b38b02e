"""Records that were changed, with checksums that fit again or not: a result, or one line and exit
code 2; never a traceback, an abort or a hang, and no result from nonsense.

Inputs run in children (``forked``), so that an abort in C++ is seen and its input named.
"""

import functools
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from alone import run_alone
from forked import drawn, unclean
from fuzz_inputs import invoke, mutated_bytes, mutated_data
from hypothesis import strategies as st
from record_tools import sealed

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.runs.reading import SEAL, seal_of

FILES = ("manifest.json", "record.nc", "metrics.json")
GOOD = {
    "plain": ("postcapture", "duration=0.05"),
    "grasp": ("tumbling_capture", "capture.approach=null", "duration=0.05"),
    "panels": ("flexible_panels", "duration=0.05"),
    "wheels": ("thrusters_and_wheels", "duration=0.05"),
    "frame": ("free_floating", "duration=0.05"),
    "seven": ("seven_joint", "duration=0.05"),
    "diverged": ("postcapture", "duration=1", "controllers.tde_aismc.k_d=1e20"),
}
COMMANDS = (
    ("analyze", "r", "--out", "out"),
    ("plot", "r", "--out", "out"),
    ("replay", "r", "--out", "out/recording.html"),
    ("replay", "r", "--speed", "0.1", "--no-ghost", "--out", "out/recording.html"),
    ("run", "r", "--no-report", "--out", "out"),
)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Folder of true records, by name."""
    folder = tmp_path_factory.mktemp("good")
    for name, (scenario, *overrides) in GOOD.items():
        record = simulate(load_scenario(scenario, overrides), check_stability=False)
        record.save(folder / name)
    return folder


# What may happen to a variable: its values, and whether a completed run's state may hold them.


def somewhere(value):
    def put(array, at):
        changed = array.astype(float)
        changed[np.unravel_index(at % array.size, array.shape)] = value
        return changed

    return put


VALUES = {
    "nan": somewhere(np.nan),
    "inf": somewhere(np.inf),
    "large": somewhere(1e300),
    "1e9": somewhere(1e9),
    "zero": lambda array, at: 0.0 * array.astype(float),
    "reverse": lambda array, at: array[::-1],
    "constant": lambda array, at: np.broadcast_to(array[at % len(array)], array.shape),
    "negate": lambda array, at: -array.astype(float),
    "scale": lambda array, at: array.astype(float) * (1e3, 1e150, 1e-200, 0.5)[at % 4],
    "roll": lambda array, at: np.roll(array, at % 7 + 1, axis=-1),
    "text": lambda array, at: np.full(array.shape, ("x", "", "1.0")[at % 3]),
    "whole": lambda array, at: np.zeros(array.shape, dtype=(np.int8, np.uint64)[at % 2]),
    "single": lambda array, at: array.astype(np.float32),
    "logical": lambda array, at: array != 0,
}
REFUSED = {"nan", "inf", "large", "zero", "text"}  # in the position of a completed run
REFUSED_TIMES = {*VALUES} - {"roll", "single"}
LAYOUTS = ("drop", "transpose", "fewer columns", "fewer rows", "no rows", "more rows", "scalar")
ATTRIBUTES = ("sample_time", "title", "controller", "random_seed", "long_name", "units",
              "stored_momentum", "internal_torque", "internal_work", "stored_energy",
              "scale_factor", "add_offset", "calendar", "_FillValue", "coordinates")  # fmt: skip
WORDS = st.sampled_from([
    "", "x", "0", "s", "days since 2000-01-01", "nan", "position velocity", "time", "\u202e",
    "noleap", "x" * 2000,
])  # fmt: skip
ATTRIBUTE_VALUES = st.one_of(
    WORDS,
    st.sampled_from([0, -1, 0.0, 0.01, 1e300, 1e-300, float("nan"), float("inf"), 2**40]),
    st.lists(st.floats(width=64), min_size=2, max_size=3),
)
AT = st.integers(0, 500)
CHANGES = st.one_of(
    st.tuples(st.just("values"), st.floats(0, 1), st.sampled_from([*VALUES]), AT),
    st.tuples(st.just("values"), st.floats(0, 1), st.sampled_from([*VALUES]), AT),
    st.tuples(
        st.just("values of"),
        st.sampled_from(["position", "time", "desired_position", "velocity", "error"]),
        st.sampled_from([*VALUES]),
        AT,
    ),
    st.tuples(st.just("layout"), st.floats(0, 1), st.sampled_from(LAYOUTS), AT),
    st.tuples(st.just("labels"), st.floats(0, 1), st.one_of(WORDS, st.just(None)), AT),
    st.tuples(st.just("attribute"), st.floats(0, 1), st.sampled_from(ATTRIBUTES), ATTRIBUTE_VALUES),
    st.tuples(st.just("dimension"), st.floats(0, 1), st.sampled_from(["time", "z", "axis"]), AT),
)


def pick(share, names):
    names = list(names)
    return names[min(int(share * len(names)), len(names) - 1)]


def changed(data, change):
    """A dataset with one change."""
    kind, where, how, at = change
    name = where if kind == "values of" else pick(where, data.variables)
    if kind.startswith("values"):
        column = data[name].variable
        return (
            data.assign({name: (column.dims, VALUES[how](column.values, at), column.attrs)})
            if (column.dtype.kind in "fiub")
            else data
        )
    if kind == "layout":
        column = data[name]
        along = column.dims[-1] if column.dims else "time"
        return {
            "drop": lambda: data.drop_vars(name),
            "transpose": lambda: data.assign({name: column.T}),
            "fewer columns": lambda: data.isel({along: slice(0, at % data.sizes[along])}),
            "fewer rows": lambda: data.isel(time=slice(at % data.sizes["time"], None)),
            "no rows": lambda: data.isel(time=slice(0, 0)),
            "more rows": lambda: xr.concat([data, data], "time", data_vars="minimal"),
            "scalar": lambda: data.drop_vars(name).assign({name: 1.0}),
        }[how]()
    if kind == "labels":
        label = pick(where, [name for name in data.coords if data[name].dtype.kind in "OU"])
        words = data[label].values.astype(str).astype(object)
        words[at % words.size] = words[(at + 1) % words.size] if how is None else how
        return data.assign_coords({label: (data[label].dims, words.astype(str))})
    if kind == "attribute":
        copied = data.copy()
        holder = copied if how in copied.attrs or "_" in how[:-5] else copied[name]
        holder.attrs[how] = at
        return copied
    dimension = pick(where, data.sizes)
    return data if how in data.variables or how == dimension else data.rename_dims({dimension: how})


def write_dataset(data, path):
    text = {
        name: {"dtype": "S1"} for name, each in data.variables.items() if each.dtype.kind in "OU"
    }
    plain = data.drop_encoding()
    plain.to_netcdf(path, engine="netcdf4", encoding=text)


@st.composite
def hostile(draw, good):
    """A base record, what happens to it, whether its checksums are made to fit, and a command."""
    base = draw(st.sampled_from([*GOOD]))
    kind = draw(
        st.sampled_from(
            ["dataset"] * 8 + ["manifest"] * 6 + ["bytes", "bytes", "model", "swap", "missing"]
        )
    )
    detail = None
    if kind == "dataset":
        detail = draw(st.lists(CHANGES, min_size=1, max_size=2))
    elif kind == "manifest":
        detail = draw(mutated_data([json.loads((good / base / "manifest.json").read_text())]))
    elif kind == "bytes":
        name = draw(st.sampled_from(FILES))
        detail = name, draw(mutated_bytes((good / base / name).read_bytes()))
    elif kind in ("model", "swap"):
        detail = draw(st.sampled_from([each for each in GOOD if each != base]))
    else:
        detail = draw(st.sampled_from(FILES)), draw(st.sampled_from(["", "folder", "link", "pipe"]))
    fits = draw(st.booleans()) or draw(st.booleans())
    command = draw(st.sampled_from(COMMANDS[:-1] if kind in ("manifest", "model") else COMMANDS))
    return base, kind, detail, fits, command


def apply(good, base, kind, detail, fits):
    """Make the folder ``r``. Returns True where it must be refused."""
    shutil.rmtree("r", ignore_errors=True)
    folder = Path(shutil.copytree(good / base, "r"))
    before = {name: (folder / name).read_bytes() for name in FILES}
    manifest = json.loads(before["manifest.json"])
    refused = False
    if kind == "dataset":
        refused = write_changed(folder / "record.nc", detail) and base != "diverged"
    elif kind == "manifest":
        (folder / "manifest.json").write_text(json.dumps(detail))
    elif kind == "bytes":
        name, content = detail
        (folder / name).write_bytes(content)
        fits = fits and name != "record.nc"  # what only HDF5 reads then
    elif kind == "model":
        other = json.loads((good / detail / "manifest.json").read_text())
        manifest["scenario"]["model"] = other["scenario"]["model"]
        (folder / "manifest.json").write_text(json.dumps(manifest))
    elif kind == "swap":
        shutil.copyfile(good / detail / "record.nc", folder / "record.nc")
    else:
        leave_out(folder / detail[0], detail[1])
        return detail[0] != "metrics.json"  # which nothing reads
    if fits:
        sealed(folder)
        return refused
    return (folder / "record.nc").read_bytes() != before["record.nc"] or altered(
        folder, good / base
    )


def leave_out(path, instead):
    path.unlink()
    if instead == "folder":
        path.mkdir()
    elif instead == "link":
        path.symlink_to("/dev/zero")
    elif instead == "pipe":
        os.mkfifo(path)


def altered(folder, original):
    """Whether a manifest with its old checksum says something else."""
    old = json.loads((original / "manifest.json").read_text())
    try:
        new = json.loads((folder / "manifest.json").read_bytes())
    except ValueError:
        return True
    return SEAL in new and seal_of(new) != seal_of(old)


def write_changed(path, changes):
    """Change a dataset, unless netCDF cannot hold that. Returns True where it is nonsense now."""
    data = original = xr.load_dataset(path, engine="netcdf4")
    for change in changes:
        # one may not apply to what another left
        with suppress(ValueError, KeyError, TypeError, IndexError, ArithmeticError):
            data = changed(data, change)
    kept = path.read_bytes()
    try:
        write_dataset(data, path)
    except Exception:
        path.write_bytes(kept)
        return False
    (kind, name, how, _), *others = changes
    return (
        not others
        and kind == "values of"
        and not data.identical(original)
        and how in {"position": REFUSED, "time": REFUSED_TIMES}.get(name, ())
    )


def try_record(good, hostile):
    """In a child: a command reads a changed record, or refuses it with exit code 2."""
    base, kind, detail, fits, command = hostile
    refused = apply(good, base, kind, detail, fits)
    code = invoke(*command, good=(0, 3))
    assert code == 2 or not refused, f"{command[0]}: exit code {code} for nonsense"


def fuzz(good, count):
    """Try so many inputs; all unclean ends together are the failure."""
    for name in GOOD:  # so that the children find models and modules
        RunRecord.load(good / name)
    inputs = drawn(hostile(good), count)
    found = unclean(inputs, functools.partial(try_record, good))
    examples = "\n".join(f"{inputs[k]!r:.600}: {text}" for k, text in [*found.items()][:10])
    assert not found, f"{len(found)} of {len(inputs)}:\n{examples}"


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.smoke
def test_some_records_are_read_or_refused(good, place):
    run_alone(fuzz, good, 16)


@pytest.mark.long
def test_records_are_read_or_refused(good, place):
    run_alone(fuzz, good, 200, inputs=200)


@pytest.mark.exhaustive
def test_many_records_are_read_or_refused(good, place):
    run_alone(fuzz, good, 5000, inputs=5000)
