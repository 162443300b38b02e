"""Logs of any simulator, in CSV, netCDF or MCAP, as the state of a spacecraft."""

import csv
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ffsm_drake.analysis.mcap_log import read_mcap
from ffsm_drake.common.errors import RecordError, did_you_mean, one_line
from ffsm_drake.common.files import check_regular

_MAX_LOG = 2_000_000_000  # bytes
_LEAST = 10  # samples
_LARGEST = 1e50  # a number whose square is one
# What a column is -> names that it may have; {} stands for w, x, y, z or the joint's name. A name
# with a point is a variable of a netCDF file and a label along its second dimension.
_NAMES = {
    "time": ("time", "t"),
    "quaternion": (
        "base_quaternion_{}", "quaternion_{}", "quat_{}", "q{}", "position.base_quaternion_{}",
    ),
    "mrp": ("base_mrp_{}", "mrp_{}", "sigma_{}"),
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
}  # fmt: skip
# Basilisk's names, and how users number what they are of: the label; from 0; from 1. Joints count
# from base to end.
_BASILISK = {
    "mrp": "sigma_BN", "position": "r_BN_N", "angular": "omega_BN_B", "linear": "v_BN_N",
    "angles": "theta", "rates": "thetaDot", "efforts": "motorTorque",
}  # fmt: skip
_NUMBERED = ("{name}_{label}", "{name}_{i}", "{name}[{i}]", "{name}.{i}", "{name}_{n}", "{name}{n}")
_AXES = {"omega_BN_B": "body axes", "v_BN_N": "world axes"}  # that a name states
_OPTIONAL = ("mrp", "efforts", "torque", "force")
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
    stated: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Axes that the log states, of ``angular`` and ``linear``."""
    missing: tuple[str, ...] = ()  # rates that are not logged: NaN until ``with_rates``
    note: str = ""  # on its samples

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
    """Read a log with a column for every coordinate and its rate.

    Args:
      path: CSV with a first line of names, or netCDF; further columns are ignored. Or MCAP, which
        may lack rates.
      joints: the joints' names, from base to end.
      base: in MCAP, the base's frame.
      columns: other names: of what this package calls ``base_quaternion_w``, ``joint_1``,
        ``joint_1_rate`` and so on -> the log's name; ``base`` -> its frame.

    Raises:
      RecordError: it cannot be read, a column is missing, or a value is not a finite number.
      FfsmError: a library is missing.
    """
    columns, note = dict(columns or {}), ""
    is_mcap = path.suffix.lower() == ".mcap"
    try:
        check_regular(path, limit=_MAX_LOG)
        if is_mcap:
            found, note = read_mcap(path, columns.pop("base", base))
        else:
            found = (_read_csv if path.suffix.lower() == ".csv" else _read_netcdf)(path)
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise RecordError(f"{path}: cannot be read: {one_line(error)}") from error
    for name, given in columns.items():
        if given not in found:
            hint = did_you_mean(given, found)
            raise RecordError(f"{path}: has no column '{given}', given for '{name}'{hint}")
        found[name] = found[given]
    if (mrp := _columns(found, "mrp", "xyz", path)) is not None:
        attitude = Rotation.from_mrp(mrp).as_quat(scalar_first=True)
        found |= {f"base_quaternion_{x}": row for x, row in zip("wxyz", attitude.T, strict=True)}
    sets = {
        "time": ("",), "quaternion": "wxyz", "angles": joints, "rates": joints, "efforts": joints,
        **dict.fromkeys(("position", "angular", "linear", "torque", "force"), "xyz"),
    }  # fmt: skip
    missing = tuple(
        what for what in _RATES if is_mcap and set(_taken(found, what, sets[what])) == {None}
    )
    read = {
        what: _columns(found, what, labels, path)
        for what, labels in sets.items()
        if what not in missing
    }
    time, quaternion = read.pop("time"), read["quaternion"]
    assert time is not None
    assert quaternion is not None
    if (later := np.unique(np.maximum.accumulate(time)).size) < _LEAST:
        said = f"at least {_LEAST} are needed, each later than those before"
        raise RecordError(f"{path}: has {later} samples; {said}")
    if (none := np.flatnonzero(~quaternion.any(axis=1))).size:
        raise RecordError(f"{path}: the quaternion is zero in sample {none[0]}")
    read |= {what: np.full((len(time), len(sets[what])), math.nan) for what in missing}
    stated = {}
    for what in ("angular", "linear"):
        if (name := str(_taken(found, what, "xyz")[0])).startswith(_BASILISK[what]):
            stated[what] = _AXES[_BASILISK[what]]
        elif is_mcap and name.startswith("base_") and name not in columns:
            stated[what] = "body axes"  # as nav_msgs/Odometry defines
    return ForeignLog(time=time[:, 0], stated=stated, missing=missing, note=note, **read)  # type: ignore[arg-type]


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
    values = np.stack([found[name] for name in taken if name is not None], axis=1)
    if not (usable := np.abs(values) < _LARGEST).all():
        row, column = np.argwhere(~usable)[0]
        said = f"{values[row, column]:g} in sample {row}, not a finite number"
        raise RecordError(f"{path}: {taken[column]} is {said} below {_LARGEST:g}")
    return values


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file, skipinitialspace=True)
        names = [name.strip().lstrip("# ") for name in next(reader, [])]
        if not names:
            raise ValueError("it is empty")
        if repeated := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"two columns are called {min(repeated)}")
        rows = []
        for row in filter(None, reader):
            if len(row) != len(names):
                raise ValueError(
                    f"line {reader.line_num} has {len(row)} values for {len(names)} columns"
                )
            rows.append([_number(text) for text in row])
    return dict(zip(names, np.array(rows).reshape(-1, len(names)).T, strict=True))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan  # a column of text is nobody's


def _read_netcdf(path: Path) -> dict[str, np.ndarray]:
    """Variables along the first dimension, and along a second one by its labels."""
    import xarray as xr

    found: dict[str, np.ndarray] = {}
    with xr.open_dataset(path, engine="netcdf4", decode_times=False) as data:
        numbers = {str(n): v for n, v in data.variables.items() if v.dtype.kind in "fiu"}
        for name, variable in numbers.items():
            values = np.asarray(variable.values, dtype=float)
            if values.ndim == 1:
                found[name] = values
            elif values.ndim == 2:
                along = variable.dims[1]
                labels = data[along].values if along in data.variables else range(values.shape[1])
                found |= {f"{name}.{x}": values[:, i] for i, x in enumerate(labels)}
    return found
