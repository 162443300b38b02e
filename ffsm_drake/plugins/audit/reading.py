"""Logs of any simulator, in CSV, netCDF, MATLAB or MCAP files, as the motion of a spacecraft."""

import functools
import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from scipy.spatial.transform import Rotation

from ffsm_drake.common.errors import RecordError, did_you_mean, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.audit.log import (
    RATES,
    Array,
    Log,
    interpolated,
    only,
    resolution,
)  # fmt: skip
from ffsm_drake.plugins.audit.mcap import read_mcap

_MAX_LOG = 2_000_000_000  # bytes
_LEAST = 10  # samples
_LARGEST = 1e50  # its square is still a finite number
_SHORTEST = 1e-9  # s
_TIME = ("time", "t")
# Quantity -> possible column names; {} stands for w, x, y, z or the joint's name. A name with a
# point is a variable of a netCDF file and a label along its second dimension.
_NAMES = {
    "quaternion": (
        "base_quaternion_{}", "quaternion_{}", "quat_{}", "q{}", "position.base_quaternion_{}",
    ),
    "mrp": ("base_mrp_{}", "mrp_{}", "sigma_{}"),
    "rpy": ("base_{}", "{}"),
    "position": ("base_position_{}", "position_{}", "pos_{}", "{}", "position.base_position_{}"),
    "angular": (
        "base_angular_velocity_{}", "angular_velocity_{}", "omega_{}", "w{}",
        "velocity.base_rotation_{}",
    ),
    "linear": (
        "base_velocity_{}", "linear_velocity_{}", "velocity_{}", "vel_{}", "v{}",
        "velocity.base_position_{}",
    ),
    "angles": ("{}", "{}_position", "{}_pos", "q_{}", "position.{}"),
    "rates": ("{}_rate", "{}_velocity", "{}_vel", "dq_{}", "v_{}", "velocity.{}"),
    "efforts": ("{}_effort", "{}_torque", "tau_{}", "applied_force.{}"),
    "torque": ("base_torque_{}", "applied_force.base_rotation_{}"),
    "force": ("base_force_{}", "applied_force.base_position_{}"),
    "disturbance": ("disturbance_force.{}",),
    "chain": ("force_contacts.{}",),
}  # fmt: skip
MEANT = {  # quantities, in words
    "quaternion": "the base's attitude",
    "position": "the base's position",
    "angular": "the base's angular velocity",
    "linear": "the base's velocity",
    "angles": "the joints' positions",
    "rates": "the joints' rates",
    "efforts": "the joints' efforts",
    "torque": "the torque on the base",
    "force": "the force on the base",
    "disturbance": "the disturbance",
    "chain": "the closed chain's force",
}
_BASE = [f"base_{what}_{x}" for what in ("rotation", "position") for x in "xyz"]
# Basilisk's names and the usual numbering of their components: by label, from 0, or from 1. Joints
# are numbered from base to end.
_BASILISK = {
    "mrp": "sigma_BN", "position": "r_BN_N", "angular": "omega_BN_B", "linear": "v_BN_N",
    "angles": "theta", "rates": "thetaDot", "efforts": "motorTorque",
}  # fmt: skip
_NUMBERED = ("{}_{}", "{}[{}]", "{}.{}", "{}{}")
_AXES = {"omega_BN_B": "body axes", "v_BN_N": "world axes"}  # axes implied by a column's name
_NEEDED = ("quaternion", "position", "angles")


class _Columns:
    """The columns of a file by name; all have the same length."""

    def __init__(self, path: Path, columns: dict[str, Array], given: Mapping[str, str]) -> None:
        self.path, self.found = path, columns
        for name, other in given.items():
            if other not in columns:
                hint = did_you_mean(other, columns)
                raise RecordError(f"{path}: has no column '{other}', given for '{name}'{hint}")
            columns[name] = columns[other]
        self.time = self.number(next((name for name in _TIME if name in columns), None) or
                                self.lacks(_TIME))  # fmt: skip
        self.found = {n: each for n, each in columns.items() if len(each) == len(self.time)}

    def lacks(self, names: Sequence[str]) -> NoReturn:
        raise RecordError(
            f"{self.path}: has no column {names[0]} (or {', '.join(names[1:])}); name it with "
            f"--column {names[0]}=COLUMN; there are {', '.join(list(self.found)[:40])}"
        )

    def number(self, name: str) -> Array:
        """One column; a number that is too large to compute with is refused."""
        column = self.found[name]
        if (beyond := np.flatnonzero(np.abs(column) >= _LARGEST)).size:
            said = f"{column[beyond[0]]:g} in sample {beyond[0]}, not a finite number"
            raise RecordError(f"{self.path}: {name} is {said} below {_LARGEST:g}")
        return column

    def names(self, what: str, labels: Sequence[str]) -> list[str]:
        """The file's names of some columns; empty if all are missing."""
        names = [[pattern.format(label) for pattern in _NAMES[what]] for label in labels]
        taken = [next((name for name in each if name in self.found), None) for each in names]
        if None not in taken:
            return [str(name) for name in taken]
        counts = range(len(labels)), range(1, len(labels) + 1)
        for form, numbers in itertools.product(_NUMBERED, (labels, *counts)):
            whole = [form.format(_BASILISK.get(what), number) for number in numbers]
            if set(whole) <= set(self.found):
                return whole
        if any(taken) or what in _NEEDED:
            self.lacks(names[taken.index(None)])
        return []

    def table(self, what: str, labels: Sequence[str]) -> Array | None:
        """Columns (n, labels); None if all are missing or blank."""
        names = self.names(what, labels)
        values = [self.number(name) for name in names]
        blank = [name for name, column in zip(names, values, strict=True)
                 if np.isnan(column).all()]  # fmt: skip
        if blank and (what in _NEEDED or len(blank) < len(names)):
            raise RecordError(f"{self.path}: {blank[0]} has no number")
        empty = blank or (labels and not names)
        return None if empty else np.array(values).reshape(len(names), len(self.time)).T


def read_log(
    path: Path, joints: Sequence[str], *, base: str = "", columns: Mapping[str, str] | None = None
) -> Log:
    """Read a log with a column for every coordinate, and optionally for its rate.

    Args:
      path: CSV with a first line of names, netCDF, MATLAB's .mat or MCAP. Other columns are
        ignored. Blank cells mean that a message came at another time.
      joints: the names of the joints, from base to end.
      base: the frame of the base in MCAP.
      columns: the log's names by this package's names (``base_quaternion_w``, ``joint_1``,
        ``joint_1_rate``, ...), and the frame of the base by ``base``.

    Raises:
      RecordError: the log cannot be read, a column is missing, or a value is not finite.
      FfsmError: a library is missing.
    """
    given = dict(columns or {})
    found, note, stated = _read(path, given, given.pop("base", base))
    file = _Columns(path, found, given)
    if set(given) & set(found):
        stated = {what: axes for what, axes in stated.items() if what in ("force", "torque")}
    digits, said = _other_attitude(file)
    sets: dict[str, Sequence[str]] = {
        "quaternion": "wxyz", "angles": joints, "rates": joints, "efforts": joints,
        "disturbance": [*_BASE, *joints], "chain": joints,
        **dict.fromkeys(("position", "angular", "linear", "torque", "force"), "xyz"),
    }  # fmt: skip
    log: dict[str, Any] = {}
    missing, note = [], note + said
    for what, labels in sets.items():
        values, names = file.table(what, labels), file.names(what, labels)
        log[what] = np.broadcast_to(0.0, (len(file.time), len(labels)))
        if values is None:
            missing.append(what)
            note += f"; {MEANT[what]}: blank" if names else ""
            continue
        log[what], digits[what] = values, digits.get(what) or resolution(values)
        if axes := [axes for name, axes in _AXES.items() if names and names[0].startswith(name)]:
            stated[what] = axes[0]
    digits["time"] = resolution(file.time[:, None])
    usual = min((each for each in digits.values() if each is not None), default=0.0)
    return _at_poses(path, Log(
        time=file.time, stated=stated, missing=tuple(missing), note=note,
        digits={what: usual if each is None else each for what, each in digits.items()}, **log,
    ))  # fmt: skip


def _read(
    path: Path, given: Mapping[str, str], base: str
) -> tuple[dict[str, Array], str, dict[str, str]]:
    """The columns of a file, a note on them, and their stated axes."""
    kind = path.suffix.lower()
    if kind not in (*_READERS, ".mcap"):
        hint = _CONVERTED.get(kind, f"convert it to {', '.join((*_READERS, '.mcap'))}")
        raise RecordError(f"{path}: logs '{kind}' are not read; {hint}")
    try:
        check_regular(path, limit=_MAX_LOG)
        if kind == ".mcap":
            return read_mcap(path, base)
        return _READERS[kind](path, (given.get("time"), *_TIME)), "", {}
    except (OSError, ValueError, TypeError, KeyError, NotImplementedError) as error:
        raise RecordError(f"{path}: cannot be read: {one_line(error)}") from error


def _other_attitude(file: _Columns) -> tuple[dict[str, float | None], str]:
    """Add the columns of the quaternion from MRPs, or from roll, pitch, yaw. Return their digits
    and a note.
    """
    rows, note = file.table("mrp", "xyz"), ""
    read: Callable[[Array], Rotation] = Rotation.from_mrp
    names = {pattern.format("w") for pattern in _NAMES["quaternion"]}
    if rows is None and not names & set(file.found):
        rows = file.table("rpy", ("roll", "pitch", "yaw"))
        degrees = rows is not None and bool(np.nanmax(np.abs(rows)) > 2.1 * np.pi)
        note = "; roll, pitch, yaw are read as degrees" if degrees else ""
        read = functools.partial(Rotation.from_euler, "xyz", degrees=degrees)
    if rows is None:
        return {}, ""
    whole = np.isfinite(rows).all(axis=1)
    found = np.full((len(rows), 4), np.nan)
    found[whole] = read(rows[whole]).as_quat(scalar_first=True)
    file.found |= {f"base_quaternion_{x}": each for x, each in zip("wxyz", found.T, strict=True)}
    return {"quaternion": resolution(rows)}, note


def _at_poses(path: Path, log: Log) -> Log:
    """The log at the times of its poses, with blank cells interpolated."""
    timed = only(log, np.isfinite(log.time))
    posed = np.isfinite(np.hstack([timed.quaternion, timed.position])).all(axis=1)
    found, unsure, whole = only(timed, posed), {}, np.full(posed.sum(), True)
    for what in MEANT:
        if np.isfinite(getattr(found, what)).all():
            continue
        fine, coarse = (
            interpolated(timed.time, getattr(timed, what), found.time, step=step,
                         smooth=what in ("angles", *RATES))
            for step in (1, 2)
        )  # fmt: skip
        found, unsure[what] = found.replace(**{what: fine}), coarse - fine
        whole &= np.isfinite(fine).all(axis=1)
    found, note = only(found.replace(unsure=unsure), whole), log.note
    if left := len(log.time) - len(found.time):
        note += f"; {counted(left, 'row')} left out: without a pose, or outside other columns"
    if unsure:
        note += f"; {', '.join(MEANT[x] for x in unsure)} interpolated to the poses' times"
    if (later := np.unique(np.maximum.accumulate(found.time)).size) < _LEAST:
        said = f"at least {_LEAST} are needed, each later than those before"
        raise RecordError(f"{path}: has {counted(later, 'sample')}; {said}")
    if (span := np.ptp(found.time)) < _SHORTEST:
        raise RecordError(f"{path}: spans {span:g} s; at least {_SHORTEST:g} s are needed")
    if (none := np.flatnonzero(~found.quaternion.any(axis=1))).size:
        raise RecordError(f"{path}: the quaternion is zero in sample {none[0]}")
    turned = {
        what: found.attitude.apply(getattr(found, what))
        for what in ("force", "torque") if log.stated.get(what) == "body axes"
    }  # fmt: skip
    return found.replace(note=note, **turned)


def _read_csv(path: Path, _: Sequence[str | None]) -> dict[str, Array]:
    """Separators are commas, semicolons, tabs or blanks. With semicolons, a decimal point may be a
    comma.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = enumerate(file, start=1)
        skipped, first = next(((i, line.strip()) for i, line in lines if line.strip()), (0, ""))
        second = next(lines, (0, ""))[1]
    if not first:
        raise ValueError("it is empty")
    first = first.lstrip("# ")
    mark = max(";\t,", key=first.count)
    separator = mark if mark in first else r"\s+"
    split = first.split(mark) if mark in first else first.split()
    names = [name.strip().strip("\"'") for name in split]
    if repeated := {name for name in names if name and names.count(name) > 1}:
        raise ValueError(f"two columns are called {min(repeated)}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a separator at the lines' ends; columns of text
        table = pd.read_csv(
            path, sep=separator, header=None, skiprows=skipped, index_col=False, names=names,
            decimal="," if mark == ";" and "," in second else ".", skipinitialspace=True,
            encoding="utf-8-sig", comment="#",
        )  # fmt: skip
    return {  # a column of text has no numbers
        str(name): pd.to_numeric(table.pop(name), errors="coerce").to_numpy(dtype=float)
        for name in names if name
    }  # fmt: skip


def _read_netcdf(path: Path, times: Sequence[str | None]) -> dict[str, Array]:
    """Variables along the dimension of time; a second dimension has labels."""
    import xarray as xr

    found: dict[str, Array] = {}
    with xr.open_dataset(path, engine="netcdf4", decode_times=False) as data:
        axes = {data[name].dims[:1] for name in times if name in data.variables}
        for name, variable in data.variables.items():
            if variable.dtype.kind not in "fiu" or variable.ndim not in (1, 2):
                continue
            if axes and variable.dims[:1] not in axes:
                continue  # the variable has other times
            along = variable.dims[-1]
            labels = data[along].values if along in data.variables else None
            found |= _labelled(str(name), np.asarray(variable.values, dtype=float), labels)
    return found


def _read_mat(path: Path, _: Sequence[str | None]) -> dict[str, Array]:
    """Arrays; those in structs are called ``struct.name``. Exported runs have labels."""
    from scipy.io import loadmat

    found: dict[str, Array] = {}

    def add(name: str, value: Any, whole: Mapping[str, Any]) -> None:
        if isinstance(value, dict) and {"values", "along"} <= set(value):
            along = str(np.atleast_1d(value["along"])[-1])
            add_array(name.rpartition(".")[2], value["values"], whole[along]["values"])
        elif isinstance(value, dict):
            for key, inner in value.items():
                add(f"{name}.{key}" if name else key, inner, value)
        else:
            add_array(name, value, None)

    def add_array(name: str, value: Any, labels: Any) -> None:
        array = np.asarray(value)
        if array.dtype.kind in "fiu" and array.ndim in (1, 2):
            wide = array.ndim == 2 and array.shape[1] > 10 * array.shape[0]
            found.update(_labelled(name, np.asarray(array.T if wide else array, float), labels))

    loaded = loadmat(str(path), simplify_cells=True)
    add("", {name: v for name, v in loaded.items() if not name.startswith("__")}, {})
    return found


def _labelled(name: str, values: Array, labels: Any) -> dict[str, Array]:
    """Columns of a variable (n) or (n, k). Without labels they are called ``name.0``, and of three
    also ``name_x``.
    """
    if values.ndim == 1:
        return {name: values}
    usual = {3: "xyz", 4: "wxyz"}.get(values.shape[1], "") if labels is None else ""
    found = {f"{name}_{x}": values[:, i] for i, x in enumerate(usual)}
    labels = range(values.shape[1]) if labels is None else labels
    return found | {f"{name}.{x}": values[:, i] for i, x in enumerate(labels)}


_READERS: dict[str, Callable[[Path, Sequence[str | None]], dict[str, Array]]] = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat"), _read_csv),
    **dict.fromkeys((".nc", ".nc4", ".h5"), _read_netcdf),
    ".mat": _read_mat,
}
_CONVERTED = dict.fromkeys((".bag", ".db3"), "convert it to .mcap: mcap convert LOG LOG.mcap")
