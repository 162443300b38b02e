"""The record of a run: labelled time series, metrics, and a manifest of how it was made."""

import dataclasses
import functools
import hashlib
import json
import math
import os
import platform
import re
import warnings
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ffsm_drake.common.errors import FfsmError, RecordError, one_line
from ffsm_drake.common.files import check_regular, published
from ffsm_drake.runs.ending import NOT_SETTLED, OUTCOMES, Ending, Outcome, ending_of
from ffsm_drake.runs.metrics import compute_metrics
from ffsm_drake.runs.table import OF_LAWS, VARIABLES, Table
from ffsm_drake.runs.tracking import tracked_of
from ffsm_drake.scenario import MANIFEST_FILE, Scenario, portable_scenario, scenario_from_dict
from ffsm_drake.systems.part import Figure, PartRecord, nested

if TYPE_CHECKING:
    import xarray as xr

    from ffsm_drake.runs.table import Labelled

DATASET_FILE = "record.nc"
METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"
FORMAT = 4
# of record.nc, in the files that go with it; in reports an attribute of their head
IDENTIFIER = "record_sha256"
_HEAD = 100_000  # bytes of a report within which that is
_MAX_TEXT = 10_000_000  # bytes, of manifest and metrics
_MAX_RECORD = 100_000_000_000  # bytes
_MAX_PER_SAMPLE = 100_000  # bytes, unpacked
# Files made from a record, which are outdated with the next one.
OUTPUTS = (
    REPORT_FILE, "recording.html", "analysis.json", "analysis.png",
    *(f"{name}.png" for name in ("trajectories", "errors", "efforts", "gains")),
)  # fmt: skip
_COORDINATES = ("time", "coordinate", "position_name", "axis", "group", "unit")


class StaleReportWarning(UserWarning):
    """A report beside a record shows another run."""


class _Dataset:
    """A dataset field; a table given for it is converted on first access."""

    def __get__(self, record: Any, owner: type) -> "xr.Dataset":
        if record is None:
            raise AttributeError  # the field has no default
        given = vars(record)["_given"]
        if isinstance(given, Table):
            vars(record)["_given"] = given = given.to_dataset()
        return given

    def __set__(self, record: Any, given: "Labelled") -> None:
        vars(record)["_given"] = given


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunRecord:
    """The results of a run.

    ``dataset`` is an xarray Dataset along ``time`` (control samples t_k, s), ``coordinate``
    (generalized velocities by name, with ``group`` and ``unit``), ``position_name`` (generalized
    positions by name) and ``axis`` (x, y, z; world frame). Its variables carry their units and
    meaning as attributes; ``list(record.dataset)`` names them.
    """

    scenario: Scenario
    outcome: Outcome
    dataset: _Dataset = _Dataset()
    wall_time: dict[str, float]  # s: build, advance_to, total
    software: dict[str, str]
    # block -> where it comes from: ``system``; for a user-supplied one ``file`` and its ``sha256``
    blocks: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    # of a run with a capture; ``GraspLog.ledger``, ``momentum_budget``
    grasp: dict[str, Any] | None = None
    parts: tuple[PartRecord, ...] = ()
    # SHA-256 of record.nc once the record was saved or loaded, which its manifest, metrics and
    # reports carry
    identifier: str = dataclasses.field(default="", init=False)

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Figures of the parts' metrics."""
        return tuple(figure for part in self.parts for figure in part.figures)

    @functools.cached_property
    def metrics(self) -> dict[str, Any]:
        """Figures of merit; the keys are those of ``ffsm_drake.runs.metrics.compute_metrics``,
        ``ending`` (``status``, ``excess``: see ``Ending``), and those of its parts.
        """
        ending = {"status": self.ending.status, "excess": self.ending.excess}
        return compute_metrics(vars(self)["_given"]) | {"ending": ending} | nested(self.figures)

    @functools.cached_property
    def ending(self) -> Ending:
        """How the run ended: settled, not settled, growing, missed, diverged, interrupted."""
        data = vars(self)["_given"]
        if self.outcome.completed and "error" not in data:
            sentence = f"Completed {self.outcome.time:g} s; the record holds no errors."
            return Ending(status=NOT_SETTLED, sentence=sentence)
        return ending_of(self.outcome, self.scenario, data["time"].values, lambda: tracked_of(data))

    @property
    def realtime_factor(self) -> float:
        """Simulated seconds per second of wall time inside ``Simulator.AdvanceTo``."""
        return (
            self.outcome.time / self.wall_time["advance_to"]
            if self.wall_time["advance_to"] > 0
            else math.inf
        )

    def save(self, directory: str | Path) -> Path:
        """Write record.nc (netCDF-4), metrics.json and manifest.json, all or none. Returns the
        directory.

        Removes the files that a report or an analysis of an earlier run left there (``OUTPUTS``).

        Raises:
          RecordError: the directory cannot be written.
        """
        directory = Path(directory)
        # Character arrays rather than netCDF strings: every MATLAB reads them.
        encoding: dict[str, dict[str, Any]] = {
            str(name): {"dtype": "S1"}
            for name, array in self.dataset.coords.items()
            if array.dtype.kind in "UO"
        }
        encoding |= {str(name): {"zlib": True, "complevel": 1} for name in self.dataset.data_vars}
        metrics = self.metrics
        manifest = {
            "format": FORMAT,
            "outcome": dataclasses.asdict(self.outcome),
            "random_seed": self.scenario.random_seed,
            "software": self.software,
            "wall_time": self.wall_time,
            "realtime_factor": self.realtime_factor,
            "blocks": {
                name: {
                    key: os.path.relpath(text, directory.resolve()) if key == "file" else text
                    for key, text in source.items()
                }
                for name, source in self.blocks.items()
            },
            "scenario": portable_scenario(self.scenario, directory),
        }
        if self.grasp is not None:
            manifest["grasp"] = self.grasp
        if self.parts:
            manifest["parts"] = [dataclasses.asdict(part) for part in self.parts]
        with published(directory, outdated=OUTPUTS) as folder:
            try:
                self.dataset.to_netcdf(
                    folder / DATASET_FILE, engine="netcdf4", format="NETCDF4", encoding=encoding
                )
            except RuntimeError as error:  # the netCDF library's error for a full disk
                raise OSError(one_line(error)) from error
            identifier = _digest(folder / DATASET_FILE)
            for name, data in ((METRICS_FILE, metrics), (MANIFEST_FILE, manifest)):
                (folder / name).write_text(
                    to_json(data | {IDENTIFIER: identifier}), encoding="utf-8"
                )
        object.__setattr__(self, "identifier", identifier)
        return directory

    @classmethod
    def load(cls, directory: str | Path) -> "RunRecord":
        """Read back what ``save`` wrote.

        Warns (StaleReportWarning) of a report of another run in the folder, or of another
        comparison above it.

        Raises:
          RecordError: a file is missing or cannot be used.
        """
        directory = Path(directory)
        identifier, fields = _read_manifest(directory / MANIFEST_FILE)
        path = directory / DATASET_FILE
        dataset, digest = _read_dataset(path, fields["scenario"])
        if identifier != digest:
            raise RecordError(
                f"{path}: is not the record that {MANIFEST_FILE} belongs to, or was "
                "changed; run it again"
            )
        _check_metrics(directory / METRICS_FILE, digest)
        _check_reports(directory, digest)
        for source in fields["blocks"].values():
            if "file" in source:
                source["file"] = str((directory / source["file"]).resolve())
        record = cls(dataset=dataset, **fields)
        object.__setattr__(record, "identifier", digest)
        return record


def _read_manifest(path: Path) -> tuple[str | None, dict[str, Any]]:
    """The identifier of the dataset beside a manifest, and the record's other fields. Raises
    RecordError.
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
        grasp, times = manifest.get("grasp"), manifest["wall_time"]
        if not isinstance(grasp, dict | None):
            raise TypeError("grasp must be an object")
        fields = {
            "scenario": scenario_from_dict(manifest["scenario"], source=str(path)),
            "outcome": _checked_outcome(manifest["outcome"]),
            "wall_time": {name: float(times[name]) for name in ("build", "advance_to", "total")},
            "software": _texts(manifest["software"]),
            "blocks": {
                str(name): _texts(source) for name, source in dict(manifest["blocks"]).items()
            },
            "parts": tuple(map(PartRecord.from_dict, manifest.get("parts", ()))),
            "grasp": grasp,
        }
    except FfsmError as error:
        raise RecordError(f"{path}: {one_line(error).removeprefix(f'{path}: ')}") from error
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read: {one_line(error)}; give the folder of a run"
        ) from error
    except KeyError as error:
        raise RecordError(f"{path}: is not a run's manifest: lacks {one_line(error)}") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise RecordError(
            f"{path}: is not a run's manifest: {type(error).__name__} {one_line(error)}"
        ) from error
    return manifest.get(IDENTIFIER), fields


def _texts(given: Any) -> dict[str, str]:
    return {str(name): str(text) for name, text in dict(given).items()}


def _read_dataset(path: Path, scenario: Scenario) -> tuple["xr.Dataset", str]:
    """The dataset of a run and the SHA-256 of its file. Raises RecordError."""
    import xarray as xr

    try:
        check_regular(path, limit=_MAX_RECORD)
        with xr.open_dataset(path, engine="netcdf4") as stored:
            if stored.nbytes > _MAX_PER_SAMPLE * (scenario.num_control_periods + 1):
                raise OSError(f"holds {stored.nbytes:.3g} bytes, more than a run of its scenario")
            dataset = stored.load()
        digest = _digest(path)
    except FileNotFoundError as error:
        raise RecordError(f"{path}: cannot be read: no such file; run it again") from error
    except Exception as error:  # xarray and HDF5 raise many types for a damaged file
        raise RecordError(f"{path}: cannot be read: {one_line(error)}; run it again") from error
    _check_dataset(dataset, path)
    return dataset, digest


def _checked_outcome(data: Any) -> Outcome:
    """The outcome of a manifest. Raises TypeError or ValueError for one that no run writes."""
    outcome = Outcome(**data)
    if outcome.status not in OUTCOMES:
        raise ValueError(
            f"outcome.status must be one of {', '.join(OUTCOMES)}, not {outcome.status!r:.40}"
        )
    if not isinstance(outcome.time, (int, float)) or isinstance(outcome.time, bool):
        raise TypeError(f"outcome.time must be a number, not {outcome.time!r:.40}")
    if not isinstance(outcome.message, str) or not isinstance(outcome.coordinate, str):
        raise TypeError("outcome.message and outcome.coordinate must be text")
    return outcome


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
        raise RecordError(f"{path}: cannot be read: {one_line(error)}; run it again") from error
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
                stacklevel=3,
            )


def _check_dataset(dataset: "xr.Dataset", path: Path) -> None:
    """Raise RecordError unless a dataset holds what every record does."""
    required = [name for name in VARIABLES if name not in OF_LAWS]
    missing = [name for name in (*_COORDINATES, *required) if name not in dataset.variables]
    if missing:
        raise RecordError(
            f"{path}: lacks {', '.join(missing)}; it comes from another version or "
            "program, run it again"
        )
    if "sample_time" not in dataset.attrs:
        raise RecordError(f"{path}: lacks the attribute sample_time; run it again")
    for name in required:
        along, *_ = VARIABLES[name]
        dims = ("time", along) if along else ("time",)
        if dataset[name].dims != dims or dataset[name].dtype.kind not in "fiu":
            raise RecordError(
                f"{path}: {name} must hold numbers along {', '.join(dims)}; run it again"
            )
    if dataset.sizes["time"] == 0:
        raise RecordError(f"{path}: holds no samples; run it again")


def software_versions() -> dict[str, str]:
    """Versions of everything that affects a result."""
    versions = {"python": platform.python_version(), "platform": platform.platform()}
    return versions | {
        package: _version(package)
        for package in ("ffsm-drake", "drake", "numpy", "scipy", "xarray")
    }


@functools.cache  # reads a file each time
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def to_json(data: Any) -> str:
    """JSON text; NaN and infinities become null."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [clean(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(clean(data), indent=2, allow_nan=False) + "\n"
