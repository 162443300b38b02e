"""Reading a record: checks that its files belong together, are unchanged, and have the contents of
a run of their scenario. No other code checks a record again.
"""

import hashlib
import json
import re
import shlex
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, RecordError, one_line, some
from ffsm_drake.common.files import check_regular, read_together
from ffsm_drake.common.numbers import LARGEST, usable
from ffsm_drake.common.shapes import misfit
from ffsm_drake.loop.blocks import BLOCKS
from ffsm_drake.runs.ending import COMPLETED, NOT_CAPTURED, OUTCOMES, Outcome
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.runs.input_copies import INPUT_COPIES
from ffsm_drake.runs.recorded_signals import RECORDED_SIGNALS
from ffsm_drake.runs.table import coordinate_columns
from ffsm_drake.runs.tracking import FRAME_COORDINATES, FRAME_UNITS
from ffsm_drake.scenario import MANIFEST_FILE, Scenario, scenario_from_dict
from ffsm_drake.scenario.layers import scenario_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates, StateSplit
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.systems.parts.record import PartRecord
from ffsm_drake.systems.parts.signals import CURVE, ROLES, STEPS, TIMELINE, components_of
from ffsm_drake.systems.registry import section_parts

if TYPE_CHECKING:
    import xarray as xr

DATASET_FILE = "record.nc"
METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"
INPUTS = Path("record.inputs")  # folder with copies of what the run was made from
FORMAT = 4
# hash of record.nc, in the accompanying files; in reports an attribute of their head
IDENTIFIER = "record_sha256"
SEAL = "manifest_sha256"  # hash of the manifest's other entries, in itself
_HEAD = 100_000  # bytes of a report searched for the hash
_MAX_TEXT = 10_000_000  # bytes, of manifest and metrics
_MAX_RECORD = 100_000_000_000  # bytes
_MAX_PER_SAMPLE = 100_000  # bytes, unpacked
_COORDINATES = ("time", "coordinate", "position_name", "axis", "group", "unit")
_REQUIRED = [name for name in RECORDED_SIGNALS if name not in BLOCKS["controller"].optional_outputs]
# Variables that are finite in a run up to its end or the grasp, except outputs of user-supplied
# sensors.
_FINITE = [name for name in _REQUIRED if not name.startswith("measured")]
# Finite in all but the last samples of other runs.
_STATE = ("position", "velocity")
_OF_FRAME = {"frame_error": True, "frame_prescribed": False, "frame_tracked": False}  # along time
_OF_TARGET = {"target_position": "axis", "target_quaternion": "quaternion"}
_NORM_TOLERANCE = 0.5  # quaternion norm: coarse integration causes a remark, not an error

_VECTOR = tuple[float, float, float]


class StaleReportWarning(UserWarning):
    """A report or an input in the folder of a record is from another run."""


def seal_of(manifest: dict[str, Any]) -> str:
    """SHA-256 of a manifest's entries, independent of their order and layout."""
    entries = {key: value for key, value in manifest.items() if key != SEAL}
    return hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_record(directory: Path) -> tuple[str, dict[str, Any]]:
    """Return the SHA-256 of a run's dataset, and the fields of its record.

    Warns (StaleReportWarning) of a report of another run.

    Raises:
      RecordError: a file is missing, was changed, or does not hold what a run writes.
    """
    paths = [directory / name for name in (MANIFEST_FILE, DATASET_FILE, METRICS_FILE)]
    digest, fields = read_together(paths, lambda: _read_record(directory))
    _check_reports(directory, digest)
    return digest, fields


def _read_record(directory: Path) -> tuple[str, dict[str, Any]]:
    identifier, fields = _read_manifest(directory / MANIFEST_FILE)
    path = directory / DATASET_FILE
    try:
        check_regular(path, limit=_MAX_RECORD)
        digest = digest_of(path)
    except OSError as error:
        raise _unread(path, error) from error
    if identifier != digest:
        raise RecordError(
            f"{path}: was changed after the run, or belongs to another run than "
            f"{MANIFEST_FILE}; run "
            "it again"
        )
    fields["dataset"] = _read_dataset(path, fields)
    _check_metrics(directory / METRICS_FILE, digest)
    return digest, fields


def _read_manifest(path: Path) -> tuple[str | None, dict[str, Any]]:
    """Return the identifier of the dataset of a manifest, and the other fields of the record.

    Raises: RecordError.
    """
    try:
        manifest = _read_json(path)
        if not isinstance(manifest, dict):
            raise RecordError(
                f"is not a run's manifest: must be an object, not {type(manifest).__name__}"
            )
        if manifest["format"] != FORMAT:
            raise RecordError(
                f"format {manifest['format']!r:.40} is not the supported {FORMAT}; run it again"
            )
        fields = _fields_of(manifest, path)
        if SEAL in manifest and manifest[SEAL] != seal_of(manifest):
            raise RecordError("was changed after the run; run it again")
    except FfsmError as error:
        raise RecordError(f"{path}: {one_line(error).removeprefix(f'{path}: ')}") from error
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RecordError(
            f"{path.parent}: contains no run ({path.name} is missing); give a folder that ffsm run "
            "wrote"
        ) from error
    except OSError as error:
        raise _unread(path, error, remedy="give the folder of a run") from error
    except KeyError as error:
        raise RecordError(f"{path}: is not a run's manifest: lacks {one_line(error)}") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise RecordError(
            f"{path}: is not a run's manifest: {type(error).__name__} {one_line(error)}"
        ) from error
    return manifest.get(IDENTIFIER), fields


def _fields_of(manifest: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the fields of a record in its manifest. Raises the errors of wrong contents."""
    scenario = scenario_from_dict(scenario_of(manifest), source=str(path))
    copies = INPUT_COPIES.first()
    for line in copies.changed(path.parent, manifest.get("inputs")) if copies else ():
        warnings.warn(line, StaleReportWarning, stacklevel=6)
    blocks = _fitting(manifest["blocks"], dict[str, dict[str, str]], "blocks")
    sources = {
        name: {
            key: str((path.parent / text).resolve()) if key == "file" else text
            for key, text in source.items()
        }
        for name, source in blocks.items()
    }
    parts = manifest.get("parts", [])
    before = manifest.get("dynamics", DRAKE)  # its name until version 0.3
    times = manifest["wall_time"]
    wall_time = {name: times[name] for name in ("build", "advance_to", "total")}
    return {
        "scenario": scenario,
        "outcome": _checked_outcome(manifest["outcome"]),
        "wall_time": _fitting(wall_time, dict[str, float], "wall_time"),
        "software": _fitting(manifest["software"], dict[str, str], "software"),
        "blocks": sources,
        "parts": _fitting(tuple(map(PartRecord.from_dict, parts)), tuple[PartRecord, ...], "parts"),
        "grasp": manifest.get("grasp"),
        "engine": _fitting(manifest.get("engine", before), str, "engine"),
    }


def _fitting(value: Any, shape: Any, place: str) -> Any:
    """Return a value of a manifest. Raises TypeError unless it has a shape; see
    ``shapes.misfit``.
    """
    if problem := misfit(value, shape, place):
        raise TypeError(problem)
    return value


def _checked_outcome(data: Any) -> Outcome:
    """Return the outcome of a manifest. Raises TypeError or ValueError for one that no run
    writes.
    """
    outcome: Outcome = _fitting(Outcome(**data), Outcome, "outcome")
    if outcome.status not in OUTCOMES:
        raise ValueError(
            f"outcome.status must be one of {', '.join(OUTCOMES)}, not {outcome.status!r:.40}"
        )
    return outcome


def _read_dataset(path: Path, fields: dict[str, Any]) -> "xr.Dataset":
    """Return the dataset of a run with the other fields of its record. Raises RecordError."""
    import xarray as xr

    scenario = fields["scenario"]
    try:
        with xr.open_dataset(path, engine="netcdf4") as stored:
            if stored.nbytes > _MAX_PER_SAMPLE * (scenario.num_control_periods + 1):
                raise OSError(f"holds {stored.nbytes:.3g} bytes, more than a run of its scenario")
            dataset = stored.load()
    except Exception as error:  # xarray and HDF5 raise many types for a damaged file
        raise _unread(path, error) from error
    for problem in _problems(dataset, fields):
        raise RecordError(f"{path}: {problem}; run it again, and report this if it returns")
    return dataset


def _problems(dataset: "xr.Dataset", fields: dict[str, Any]) -> Iterator[str]:
    """Problems with a dataset; each check relies on the ones before it."""
    scenario, outcome = fields["scenario"], fields["outcome"]
    yield from _of_columns(dataset)
    yield from _of_times(dataset, scenario, outcome)
    coordinates, split = _coordinates_of(dataset, scenario)
    yield from _of_names(dataset, coordinates, split)
    yield from _of_phases(dataset)
    yield from _of_numbers(dataset, outcome)
    yield from _of_parts(dataset, scenario, fields["parts"])
    if fields["grasp"] is not None:
        shape = _grasp_shape(coordinates.names)
        if not scenario.grasps:
            yield f"the scenario of {MANIFEST_FILE} has no capture, but it holds a grasp"
        if problem := misfit(fields["grasp"], shape, "grasp"):
            yield f"{MANIFEST_FILE} beside it: {problem}"


def _of_columns(dataset: "xr.Dataset") -> Iterator[str]:
    """Check every variable of a run, with its dimensions and types."""
    missing = [name for name in (*_COORDINATES, *_REQUIRED) if name not in dataset.variables]
    if missing:
        yield f"lacks {', '.join(missing)}; it comes from another version or program"
    for name, shape in {"sample_time": float, "title": str, "controller": str}.items():
        if name not in dataset.attrs:
            yield f"lacks the attribute {name}"
        if problem := misfit(np.asarray(dataset.attrs[name])[()], shape, name):
            yield f"the attribute {problem}"
    for name, signal in RECORDED_SIGNALS.items():
        dims, known = signal.dims, name in dataset.data_vars
        if known and (dataset[name].dims != dims or dataset[name].dtype.kind not in "fiu"):
            yield f"{name} must hold numbers along {', '.join(dims)}"
    for variable, column in dataset.variables.items():
        name = str(variable)
        for attribute in {"long_name", "units"} & {*column.attrs}:
            if not isinstance(column.attrs[attribute], str):
                yield f"attribute {attribute} of {name} must be text"
        if column.ndim == 0:
            yield f"{name} must hold values along a dimension"
        if name in dataset.data_vars:
            if column.dims[:1] != ("time",) or column.ndim > 2 or column.dtype.kind not in "fiub":
                yield f"{name} must hold numbers along time"
        elif column.ndim != 1 or column.dtype.kind not in "fiubOSU":
            yield f"{name} must hold numbers or words along one dimension"
        elif column.dtype.kind == "O" and not all(isinstance(each, str) for each in column.values):
            yield f"{name} must hold words"
    if dataset.sizes["time"] == 0:
        yield "holds no samples"


def _coordinates_of(
    dataset: "xr.Dataset", scenario: Scenario
) -> tuple[Coordinates, StateSplit | None]:
    """Return the coordinates of the scenario's model; the dataset's joints without hidden
    coordinates if the model no longer loads, for displays without the model.
    """
    try:
        model = Craft(scenario).flexible()
    except FfsmError:
        names, units = (
            dataset[name].values.astype(str).tolist() for name in ("coordinate", "unit")
        )
        joints = tuple(names[NUM_BASE_VELOCITIES:]), tuple(units[NUM_BASE_VELOCITIES:])
        return Coordinates(*joints, undriven=scenario.undriven), None
    return model.coordinates, model.split


def _of_names(
    dataset: "xr.Dataset", coordinates: Coordinates, split: StateSplit | None
) -> Iterator[str]:
    """Check the names along each dimension, and their coordinates."""
    expected = coordinate_columns(coordinates)
    if split is not None and split.names:
        expected["hidden_coordinate"] = ("hidden_coordinate", split.names)
        if dataset.get("hidden_position", dataset["time"]).dims != ("time", "hidden_coordinate"):
            yield "hidden_position must hold numbers along time, hidden_coordinate"
    if not dataset.keys().isdisjoint(_OF_FRAME):
        expected["frame_coordinate"] = ("frame_coordinate", FRAME_COORDINATES)
        expected["frame_unit"] = ("frame_coordinate", FRAME_UNITS)
        for name, along_time in _OF_FRAME.items():
            dims = ("time",) * along_time + ("frame_coordinate",)
            if name not in dataset or dataset[name].dims != dims:
                yield f"{name} must stand along {', '.join(dims)}"
    if "quaternion" in dataset.dims:
        expected["quaternion"] = ("quaternion", ("w", "x", "y", "z"))
    for name, (along, values) in expected.items():
        column = dataset.variables.get(name)
        given = None if column is None else column.values.tolist()
        if column is None or column.dims != (along,) or given != list(values):
            yield f"{name} must be {some(map(str, values))}, as in the scenario's model"
    for along, labels in dataset.indexes.items():
        if not labels.is_unique:
            yield f"{along} holds a value twice"


def _of_times(dataset: "xr.Dataset", scenario: Scenario, outcome: Outcome) -> Iterator[str]:
    """The control samples, up to the scenario's duration, and the end in the manifest."""
    period, most = scenario.sample_time, scenario.num_control_periods + 1
    if dataset.attrs["sample_time"] != period:
        given = dataset.attrs["sample_time"]
        yield f"the attribute sample_time must be {period:g}, as in {MANIFEST_FILE}, not {given:g}"
    time = dataset["time"].values
    if time.dtype.kind != "f" or not np.allclose(
        time, period * np.arange(time.size), rtol=1e-9, atol=1e-6 * period
    ):
        yield f"time must hold the control samples from 0, {period:g} s apart"
    if time.size > most:
        yield f"holds {time.size} samples, and a run of its scenario at most {most}"
    if outcome.time != time[-1]:
        yield f"time ends at {time[-1]:g} s, but at {outcome.time:g} s in {MANIFEST_FILE}"


def _of_phases(dataset: "xr.Dataset") -> Iterator[str]:
    """The phases, the stop last, and the target's pose."""
    if "phase" not in dataset.variables:
        return
    column = dataset.variables["phase"]
    phases = column.values.tolist()
    held = [phase == "stop" for phase in phases]  # the target is held from then on
    known = all(isinstance(phase, str) and phase.isidentifier() for phase in phases)
    if column.dims != ("time",) or not known or held != sorted(held):
        yield "phase must be the phases' names, and stop to the end, along time"
    for name, along in _OF_TARGET.items():
        if name not in dataset or dataset[name].dims != ("time", along):
            yield f"{name} must hold numbers along time, {along}"


def _of_numbers(dataset: "xr.Dataset", outcome: Outcome) -> Iterator[str]:
    """Numbers that are ``usable``, and quaternions of rotations."""
    whole = outcome.status in (COMPLETED, *NOT_CAPTURED)
    known = [name for name in (*_OF_TARGET, "hidden_position", "frame_error") if name in dataset]
    for name in [*_FINITE, *known] if whole else _STATE:
        good = usable(dataset[name].values)
        first = int(np.argmin(good))
        if not good.all() and (whole or first == 0 or good[first:].any()):
            yield f"{name} must be finite and below {LARGEST:g}, and is not at sample {first}"
    for name in ("position", "desired_position", "target_quaternion"):
        if name in dataset:
            quaternion = dataset[name].values[:, :4]
            norm = np.linalg.norm(quaternion, axis=1)
            # a diverging run may end with any norm but zero
            off = np.abs(norm - 1.0) >= _NORM_TOLERANCE if whole else norm < 1.0 - _NORM_TOLERANCE
            off &= usable(quaternion)
            if off.any():
                first = int(np.argmax(off))
                yield f"{name} must hold unit quaternions, but sample {first} has {norm[first]:g}"


def _of_parts(
    dataset: "xr.Dataset", scenario: Scenario, parts: tuple[PartRecord, ...]
) -> Iterator[str]:
    """Signals of parts, as balances and pictures take them."""

    def lacking(signal: str, names: Any) -> list[str]:
        values = dataset[signal]
        labels = values[values.dims[-1]].values.astype(str).tolist() if values.ndim == 2 else []
        return [name for name in names if name not in labels]

    for role in ROLES:
        number = components_of(role, dataset.sizes["coordinate"])
        for name in str(dataset.attrs.get(role, "")).split():
            if name in dataset and number and dataset[name].shape[1:] != (number,):
                yield f"{name} must have {number} components as {role}"
    for part in section_parts(scenario).values():
        for solid in part.solids():
            if solid.shown_by in dataset and lacking(solid.shown_by, [solid.name]):
                yield f"{solid.shown_by} lacks the component {solid.name}"
    for drawing in (drawing for part in parts for drawing in part.drawings):
        if drawing.chart not in (CURVE, STEPS, TIMELINE):
            yield f"{drawing.signal}: no such chart as {drawing.chart!r:.40} in {MANIFEST_FILE}"
        if drawing.signal not in dataset:
            continue
        if drawing.signal not in dataset.data_vars:
            yield f"{drawing.signal} must hold numbers along time"
        if dataset[drawing.signal].ndim == 2 and (
            missing := lacking(drawing.signal, drawing.panels)
        ):
            yield f"{drawing.signal} lacks the component {missing[0]}"


def _grasp_shape(names: tuple[str, ...]) -> dict[str, Any]:
    """Return the shape of ``RunRecord.grasp`` (``GraspLog.ledger``, ``MomentumBudget``); ``names``
    of the coordinates.
    """
    side = {
        **dict.fromkeys(("linear_momentum", "angular_momentum", "spin"), _VECTOR),
        "kinetic_energy": float,
        "velocity": dict.fromkeys(names, float),
    }
    storage = {
        **dict.fromkeys(("name", "fullest"), str),
        **dict.fromkeys(("capacity", "least_capacity", "least_time"), float),
        **dict.fromkeys(("share", "peak_share"), float),
    }
    return {
        "time": float,
        **dict.fromkeys(("impulse", "angular_impulse", "stored_momentum?"), _VECTOR),
        "brake_impulse": dict[str, float],
        "before": side,
        "after": side,
        "compliant": {
            f"{name}?": float for name in ("peak_force", "peak_torque", "peak_stretch", "time")
        },
        "miss": dict.fromkeys(("position", "angle", "velocity", "angular_velocity"), float),
        "momentum_budget?": {
            **dict.fromkeys(("linear", "angular"), _VECTOR),
            "mass": float,
            "least_time": dict[str, float],
            "storage": [None, storage],
            "arm": [None, {"capacity": float | None, "time": float | None, "ended_by": str}],
            "drift": float | None,
            "rate": float | None,
            "accepted": dict[str, float],
            "used_up": dict[str, float | None],
        },
    }


def _unread(path: Path, error: BaseException, *, remedy: str = "run it again") -> RecordError:
    """Return the error of a file that cannot be read, with what helps."""
    told = "no such file" if isinstance(error, FileNotFoundError) else one_line(error)
    if isinstance(error, PermissionError):
        told, remedy = "no permission", f"chmod u+r {shlex.quote(str(path))}"
    return RecordError(f"{path}: cannot be read: {told}; {remedy}")


def _read_json(path: Path) -> Any:
    check_regular(path, limit=_MAX_TEXT)
    return json.loads(path.read_text(encoding="utf-8"))


def _check_metrics(path: Path, digest: str) -> None:
    """Raise RecordError if the metrics belong to another record."""
    try:
        metrics = _read_json(path)
    except FileNotFoundError:
        return  # nothing here reads them
    except (OSError, ValueError, RecursionError) as error:
        raise _unread(path, error) from error
    if not isinstance(metrics, dict) or metrics.get(IDENTIFIER) != digest:
        raise RecordError(f"{path}: does not belong to {DATASET_FILE} beside it; run it again")


def _check_reports(directory: Path, digest: str) -> None:
    """Warn of a report in a run's folder, or of a comparison in the folder above, that shows
    another run of this name.
    """
    for page, folder in (
        (directory / REPORT_FILE, ""),
        (directory.absolute().parent / REPORT_FILE, directory.name),
    ):
        try:
            check_regular(page, limit=_MAX_RECORD)
            with page.open("rb") as file:
                head = file.read(_HEAD).decode("utf-8", "replace")
        except OSError:
            continue
        found = re.search(f'<meta name="{IDENTIFIER}" content="([^"]*)">', head)
        shown = [word.rpartition("=") for word in found[1].split()] if found else []
        digests = [
            shown_digest for controller, _, shown_digest in shown if folder in ("", controller)
        ]
        if digests and digest not in digests:
            warnings.warn(
                f"{page} shows another run than the {DATASET_FILE} of {directory}; make it anew",
                StaleReportWarning,
                stacklevel=4,
            )
