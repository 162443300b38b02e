"""Logs of any simulator, in CSV, netCDF, MATLAB or MCAP files, as the state of a spacecraft."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ffsm_drake.analysis.mcap_log import Series, at_times, read_mcap
from ffsm_drake.common.errors import RecordError, did_you_mean, one_line
from ffsm_drake.common.files import check_regular

_MAX_LOG = 2_000_000_000  # bytes
_LEAST = 10  # samples
_LARGEST = 1e50  # a number whose square is one
_SHORTEST, _LONGEST = 1e-9, 9e9  # s; the latter in ns is an integer
# What a column is -> names that it may have; {} stands for w, x, y, z or the joint's name. A name
# with a point is a variable of a netCDF file and a label along its second dimension.
_NAMES = {
    "time": ("time", "t"),
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
}  # fmt: skip
_MEANT = {  # what a log lacks, in words
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
}
_BASE = [f"base_{what}_{x}" for what in ("rotation", "position") for x in "xyz"]
# Basilisk's names, and how users number what they are of: the label; from 0; from 1. Joints count
# from base to end.
_BASILISK = {
    "mrp": "sigma_BN", "position": "r_BN_N", "angular": "omega_BN_B", "linear": "v_BN_N",
    "angles": "theta", "rates": "thetaDot", "efforts": "motorTorque",
}  # fmt: skip
_NUMBERED = ("{name}_{label}", "{name}_{i}", "{name}[{i}]", "{name}.{i}", "{name}_{n}", "{name}{n}")
_AXES = {"omega_BN_B": "body axes", "v_BN_N": "world axes"}  # that a name states
_OPTIONAL = ("mrp", "rpy", "efforts", "torque", "force", "disturbance")
_RATES = ("angular", "linear", "rates")  # what a log of poses alone has not


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ForeignLog:
    """Samples of a spacecraft's motion as a log gives them, in whatever axes and units."""

    time: np.ndarray  # (n), s
    quaternion: np.ndarray  # (n, 4) of R_WB, w first
    position: np.ndarray  # (n, 3) p_WB, m
    angular: np.ndarray  # (n, 3) w_WB, rad/s
    linear: np.ndarray  # (n, 3) v_WB, m/s
    angles: np.ndarray  # (n, joints), rad or m
    rates: np.ndarray  # (n, joints)
    efforts: np.ndarray | None  # (n, joints) at the joints, N m or N; None: not logged
    torque: np.ndarray | None  # (n, 3) on the base, world axes, N m
    force: np.ndarray | None  # (n, 3) on the base at its origin, world axes, N
    disturbance: np.ndarray | None = None  # (n, 6 + joints) generalized force beside all these
    stated: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Axes that the log states, of ``angular`` and ``linear``."""
    missing: tuple[str, ...] = ()  # rates that are not logged: NaN until ``with_rates``
    note: str = ""  # on its samples
    digits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Step of the last digit of each array; 0 where it is that of double precision."""

    def replace(self, **changes: np.ndarray) -> "ForeignLog":
        """A copy with other columns."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


def with_rates(log: ForeignLog, *, every: int = 1) -> ForeignLog:
    """The log with the rates that are missing, in world axes: of cubic splines through its poses,
    or through every second one and so on. Times must increase.
    """

    def rate(path: np.ndarray) -> np.ndarray:
        found: np.ndarray = CubicSpline(log.time[::every], path[::every])(log.time, 1)
        return found

    turned = (log.quaternion[1:] * log.quaternion[:-1]).sum(axis=1) < 0.0
    q = log.quaternion * np.cumprod(np.where([False, *turned], -1.0, 1.0))[:, None]
    dq, size = rate(q), (q**2).sum(axis=1, keepdims=True)
    product = q[:, :1] * dq[:, 1:] - dq[:, :1] * q[:, 1:] - np.cross(dq[:, 1:], q[:, 1:])
    found = {
        "angular": 2.0 * product / size,
        "linear": rate(log.position),
        "rates": rate(np.unwrap(log.angles, axis=0)),
    }
    return log.replace(**{what: found[what] for what in log.missing})


def read_log(
    path: Path, joints: Sequence[str], *, base: str = "", columns: Mapping[str, str] | None = None
) -> ForeignLog:
    """Read a log with a column for every coordinate, and for its rate where that is logged.

    Args:
      path: CSV with a first line of names, netCDF, MATLAB's .mat or MCAP; further columns are
        ignored. Blank cells are read as messages that came at other times.
      joints: the joints' names, from base to end.
      base: in MCAP, the base's frame.
      columns: other names: of what this package calls ``base_quaternion_w``, ``joint_1``,
        ``joint_1_rate`` and so on -> the log's name; ``base`` -> its frame.

    Raises:
      RecordError: it cannot be read, a column is missing, or a value is not a finite number.
      FfsmError: a library is missing.
    """
    columns, note, kind = dict(columns or {}), "", path.suffix.lower()
    if kind not in (*_READERS, ".mcap"):
        hint = _CONVERTED.get(kind, f"convert it to {', '.join((*_READERS, '.mcap'))}")
        raise RecordError(f"{path}: logs '{kind}' are not read; {hint}")
    try:
        check_regular(path, limit=_MAX_LOG)
        if kind == ".mcap":
            found, note = read_mcap(path, columns.pop("base", base))
        else:
            found = _READERS[kind](path)
    except (OSError, ValueError, TypeError, KeyError, NotImplementedError) as error:
        raise RecordError(f"{path}: cannot be read: {one_line(error)}") from error
    for name, given in columns.items():
        if given not in found:
            hint = did_you_mean(given, found)
            raise RecordError(f"{path}: has no column '{given}', given for '{name}'{hint}")
        found[name] = found[given]
    time = _columns(found, "time", ("",), path)
    assert time is not None
    found = {name: values for name, values in found.items() if len(values) == len(time)}
    if (mrp := _columns(found, "mrp", "xyz", path)) is not None:
        found |= _quaternion_columns(Rotation.from_mrp, mrp)
    angles = None
    if mrp is None and None in _taken(found, "quaternion", "wxyz"):
        angles = _columns(found, "rpy", ("roll", "pitch", "yaw"), path)
        if angles is not None:
            degrees = bool(np.nanmax(np.abs(angles)) > 2.1 * np.pi)
            note += "; roll, pitch, yaw are read as degrees" if degrees else ""
            found |= _quaternion_columns(
                lambda rows: Rotation.from_euler("xyz", rows, degrees=degrees), angles
            )
    named = [*_BASE, *joints]
    sets = {
        "time": ("",), "quaternion": "wxyz", "angles": joints, "rates": joints, "efforts": joints,
        "disturbance": named,
        **dict.fromkeys(("position", "angular", "linear", "torque", "force"), "xyz"),
    }  # fmt: skip
    read = {
        what: None
        if what in _RATES and set(_taken(found, what, labels)) == {None}
        else _columns(found, what, labels, path)
        for what, labels in sets.items()
    }
    for what in (*_RATES, *_OPTIONAL):
        if (values := read.get(what)) is not None and np.isnan(values).all() and values.size:
            read[what], note = None, f"{note}; {_MEANT[what]}: blank"
    digits = {what: _digit(values) for what, values in read.items() if values is not None}
    attitude = mrp if mrp is not None else angles
    if attitude is not None:
        digits["quaternion"] = _digit(attitude)
    usual = min((each for each in digits.values() if each is not None), default=0.0)
    digits = {what: usual if each is None else each for what, each in digits.items()}
    read, said = _at_poses(read, path)
    missing = tuple(what for what in _RATES if read[what] is None)
    time, quaternion = read.pop("time"), read["quaternion"]
    assert time is not None
    assert quaternion is not None
    if (later := np.unique(np.maximum.accumulate(time)).size) < _LEAST:
        said = f"at least {_LEAST} are needed, each later than those before"
        raise RecordError(f"{path}: has {later} samples; {said}")
    if np.ptp(time) < _SHORTEST:
        raise RecordError(f"{path}: spans {np.ptp(time):g} s; at least {_SHORTEST:g} s are needed")
    if (none := np.flatnonzero(~quaternion.any(axis=1))).size:
        raise RecordError(f"{path}: the quaternion is zero in sample {none[0]}")
    read |= {what: np.full((len(time), len(sets[what])), math.nan) for what in missing}
    stated = {}
    for what in ("angular", "linear"):
        if (name := str(_taken(found, what, "xyz")[0])).startswith(_BASILISK[what]):
            stated[what] = _AXES[_BASILISK[what]]
        elif kind == ".mcap" and name.startswith("base_") and name not in columns:
            stated[what] = "body axes"  # as nav_msgs/Odometry defines
    return ForeignLog(
        time=time[:, 0], stated=stated, missing=missing, note=note + said,
        digits=digits, **read,  # type: ignore[arg-type]
    )  # fmt: skip


def _quaternion_columns(
    read: Callable[[np.ndarray], Rotation], rows: np.ndarray
) -> dict[str, np.ndarray]:
    """Columns of the quaternion, from another parametrisation (n, 3), blank where that is."""
    whole = np.isfinite(rows).all(axis=1)
    quaternions = np.full((len(rows), 4), math.nan)
    quaternions[whole] = read(rows[whole]).as_quat(scalar_first=True)
    return {f"base_quaternion_{x}": row for x, row in zip("wxyz", quaternions.T, strict=True)}


def _at_poses(
    read: dict[str, np.ndarray | None], path: Path
) -> tuple[dict[str, np.ndarray | None], str]:
    """What a log holds at the times of its poses: blank cells are interpolated, as messages are."""
    given = {what: values for what, values in read.items() if values is not None and values.size}
    whole = {what: np.isfinite(values).all(axis=1) for what, values in given.items()}
    if all(each.all() for each in whole.values()):
        return read, ""
    posed = whole["time"] & whole["quaternion"] & whole["position"]
    spans, time = [], given["time"][:, 0]
    if np.nanmax(np.abs(time)) > _LONGEST:
        raise RecordError(f"{path}: has blank cells, and times beyond {_LONGEST:g} s")
    for what, rows in whole.items():
        if not (own := rows & whole["time"]).any():
            raise RecordError(f"{path}: no row has all of {_MEANT.get(what, what)}")
        spans.append(time[own])
    first, last = max(each.min() for each in spans), min(each.max() for each in spans)
    posed &= (time >= first) & (time <= last)
    stamps, changed, found = _stamps(time), [], dict(read)
    for what, values in given.items():
        rows = whole[what] & whole["time"]
        if not whole[what][posed].all():
            changed.append(_MEANT.get(what, what))
            series = Series(stamps[rows], values[rows])
            found[what] = at_times(series, stamps[posed], smooth=what in ("angles", *_RATES))
        else:
            found[what] = values[posed]
    left = len(time) - int(posed.sum())
    note = f"; {left} rows without a pose left out" if left else ""
    note += f"; {', '.join(changed)} interpolated to the poses' times" if changed else ""
    return found, note


def _digit(values: np.ndarray) -> float | None:
    """Step of the last digit (decimal, or of single precision) of columns (n, k) that vary; None:
    none does.
    """
    worst = None
    for column in values[:: -(-len(values) // 2000)].T:
        some = column[np.isfinite(column)]
        if not some.size or not np.ptp(some) or np.ptp(np.diff(some)) < 1e-9 * np.ptp(some):
            continue  # constant, or even as times are
        size, worst = float(np.abs(some).max()), worst or 0.0
        if (some == some.astype(np.float32)).all() and (some != np.round(some)).any():
            worst = max(worst, size * float(np.finfo(np.float32).eps))
        for step in 10.0 ** -np.arange(12.0):
            if size < 1e12 * step and (np.abs(some / step - np.round(some / step)) < 1e-4).all():
                worst = max(worst, float(step))
                break
    return worst


def _stamps(time: np.ndarray) -> np.ndarray:
    """Times in ns (n)."""
    return np.round(1e9 * np.where(np.isfinite(time), time, 0.0)).astype(np.int64)


def _taken(found: Mapping[str, np.ndarray], what: str, labels: Sequence[str]) -> list[str | None]:
    """The names under which a log has some columns; None for each that is missing."""
    names = [[pattern.format(label) for pattern in _NAMES[what]] for label in labels]
    taken = [next((name for name in each if name in found), None) for each in names]
    for form in _NUMBERED if None in taken and what in _BASILISK else ():
        whole = [
            form.format(name=_BASILISK[what], label=label, i=i, n=i + 1)
            for i, label in enumerate(labels)
        ]
        if all(name in found for name in whole):
            return [*whole]
    return taken


def _columns(
    found: Mapping[str, np.ndarray], what: str, labels: Sequence[str], path: Path
) -> np.ndarray | None:
    """Some columns of a log (n, labels); None where optional ones are missing altogether."""
    names = [[pattern.format(label) for pattern in _NAMES[what]] for label in labels]
    taken = _taken(found, what, labels)
    missing = [each for each, name in zip(names, taken, strict=True) if name is None]
    if what in _OPTIONAL and len(missing) == len(names):
        return None
    if missing:
        raise RecordError(
            f"{path}: has no column {missing[0][0]} (or {', '.join(missing[0][1:])}); name it with "
            f"--column {missing[0][0]}=COLUMN; there are {', '.join(list(found)[:40])}"
        )
    if not names:
        return np.zeros((len(next(iter(found.values()))), 0))
    values = np.stack([found[name] for name in taken if name is not None], axis=1)
    if (beyond := np.abs(values) >= _LARGEST).any():
        row, column = np.argwhere(beyond)[0]
        said = f"{values[row, column]:g} in sample {row}, not a finite number"
        raise RecordError(f"{path}: {taken[column]} is {said} below {_LARGEST:g}")
    if what not in (*_RATES, *_OPTIONAL) and len(values) and np.isnan(values).all(axis=0).any():
        column = int(np.flatnonzero(np.isnan(values).all(axis=0))[0])
        raise RecordError(f"{path}: {taken[column]} has no number")
    return values


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    """Separators are commas, semicolons, tabs or blanks; with semicolons, decimals may have a
    comma.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        first, second = "", ""
        skipped = 0
        for line in file:
            if first:
                second = line
                break
            first, skipped = line.strip(), skipped + 1
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
        warnings.simplefilter("ignore", pd.errors.ParserWarning)  # a separator at the lines' ends
        table = pd.read_csv(
            path, sep=separator, header=None, skiprows=skipped, index_col=False, names=names,
            decimal="," if mark == ";" and "," in second else ".", skipinitialspace=True,
            encoding="utf-8-sig", comment="#", low_memory=False,
        )  # fmt: skip
    numbers = table.apply(pd.to_numeric, errors="coerce")  # a column of text is nobody's
    return {str(name): numbers[name].to_numpy(dtype=float) for name in names if name}


def _read_netcdf(path: Path) -> dict[str, np.ndarray]:
    """Variables along the first dimension, and along a second one by its labels."""
    import xarray as xr

    found: dict[str, np.ndarray] = {}
    with xr.open_dataset(path, engine="netcdf4", decode_times=False) as data:
        for name, variable in data.variables.items():
            if variable.dtype.kind in "fiu" and variable.ndim in (1, 2):
                along = variable.dims[-1]
                labels = data[along].values if along in data.variables else None
                found |= _labelled(str(name), np.asarray(variable.values, dtype=float), labels)
    return found


def _read_mat(path: Path) -> dict[str, np.ndarray]:
    """Arrays, also in structs, as ``struct.name``; exported runs by their labels."""
    from scipy.io import loadmat

    found: dict[str, np.ndarray] = {}

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


def _labelled(name: str, values: np.ndarray, labels: Any) -> dict[str, np.ndarray]:
    """Columns of a variable (n) or (n, k): without labels ``name.0``, and ``name_x`` of three."""
    if values.ndim == 1:
        return {name: values}
    usual = {3: "xyz", 4: "wxyz"}.get(values.shape[1], "") if labels is None else ""
    found = {f"{name}_{x}": values[:, i] for i, x in enumerate(usual)}
    labels = range(values.shape[1]) if labels is None else labels
    return found | {f"{name}.{x}": values[:, i] for i, x in enumerate(labels)}


_READERS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat"), _read_csv),
    **dict.fromkeys((".nc", ".nc4", ".h5"), _read_netcdf),
    ".mat": _read_mat,
}
_CONVERTED = {
    ".bag": "convert it to .mcap: mcap convert LOG.bag LOG.mcap",
    ".db3": "convert it to .mcap: mcap convert LOG.db3 LOG.mcap",
}
