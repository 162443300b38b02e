"""The record of a run: labelled time series, metrics, and a manifest of how it was made."""

import contextlib
import dataclasses
import functools
import json
import math
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.common.errors import RecordError, one_line, spared
from ffsm_drake.common.files import check_writable, published, stamp
from ffsm_drake.mission import Mission
from ffsm_drake.runs.ending import NOT_SETTLED, Ending, Outcome, ending_of
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.runs.input_copies import INPUT_COPIES
from ffsm_drake.runs.metrics import compute_metrics
from ffsm_drake.runs.reading import (
    DATASET_FILE,
    FORMAT,
    IDENTIFIER,
    INPUTS,
    METRICS_FILE,
    REPORT_FILE,
    SEAL,
    digest_of,
    read_record,
    seal_of,
)
from ffsm_drake.runs.table import Table, Values
from ffsm_drake.scenario import MANIFEST_FILE, Scenario, portable_scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.systems.parts.metrics import Figure, nested
from ffsm_drake.systems.parts.record import PartRecord

if TYPE_CHECKING:
    import xarray as xr

    from ffsm_drake.runs.table import Labelled

# Files made from a record, which are outdated with the next one.
OUTPUTS = (
    REPORT_FILE, "recording.html", "analysis.json", "analysis.png", "remedy.yaml",
    *(f"{name}.png" for name in ("trajectories", "errors", "efforts", "gains")),
)  # fmt: skip


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


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RunRecord:
    """The results of a run: time series, metrics, outcome and scenario.

    ``dataset`` is an xarray Dataset with the dimensions ``time`` (control samples t_k, s),
    ``coordinate`` (generalized velocities by name, with ``group`` and ``unit``), ``position_name``
    (generalized positions by name) and ``axis`` (x, y, z in the world frame). Its variables have
    their units and meanings as attributes. ``list(record.dataset)`` lists the variables.

    Example:
      >>> from ffsm_drake import RunRecord, load_scenario, simulate
      >>> record = simulate(load_scenario("postcapture", ["duration=0.1"]))
      >>> _ = record.save("out/short")
      >>> RunRecord.load("out/short").dataset.sizes["time"]
      11
    """

    scenario: Scenario
    outcome: Outcome
    dataset: _Dataset = _Dataset()
    wall_time: dict[str, float]  # s: build, advance_to, total
    software: dict[str, str]
    # block -> where it comes from: ``system``; for a user-supplied one ``file`` and its ``sha256``
    blocks: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    # for a run with a capture; ``GraspLog.ledger``, ``momentum_budget``
    grasp: dict[str, Any] | None = None
    parts: tuple[PartRecord, ...] = ()
    engine: str = DRAKE  # name of what computed the run
    flown: Mission | None = None  # of ``scenario``; None: it is made when it is needed
    # SHA-256 of record.nc once the record was saved or loaded, which its manifest, metrics and
    # reports carry
    identifier: str = dataclasses.field(default="", init=False)

    def __repr__(self) -> str:
        return f"RunRecord({self.scenario!r}: {self.ending.sentence})"

    def positions(self, of: str = "position") -> "xr.Dataset":
        """Return generalized positions in their parts, each with its unit.

        Args:
          of: the variable of ``dataset``: position, measured_position or desired_position.

        Returns:
          Along ``time``: ``base_quaternion`` (w, x, y, z of R_WB), ``base_position`` (p_WB, m),
          ``joint_position`` (by ``coordinate``, in its ``unit``: rad or m).
        """
        joints = self.dataset.isel(coordinate=slice(NUM_BASE_VELOCITIES, None))
        quaternion, place, angles = np.split(self.dataset[of].values, [4, NUM_BASE_POSITIONS], 1)
        found = joints[["time", "coordinate", "axis", "group", "unit"]].assign_coords(
            quaternion=("quaternion", list("wxyz"))
        )
        return found.assign(
            base_quaternion=(("time", "quaternion"), quaternion, {"units": "1"}),
            base_position=(("time", "axis"), place, {"units": "m"}),
            joint_position=(("time", "coordinate"), angles, {"units": "rad or m, see unit"}),
        )

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Figures of the parts' metrics."""
        return tuple(figure for part in self.parts for figure in part.figures)

    @functools.cached_property
    def mission(self) -> Mission:
        """The scenario with its spacecraft. Raises ModelError: the model does not load any more."""
        return Mission(self.scenario) if self.flown is None else self.flown.of(self.scenario)

    @functools.cached_property
    def metrics(self) -> dict[str, Any]:
        """Metrics: the keys of ``ffsm_drake.runs.metrics.compute_metrics``, ``ending`` (``status``,
        ``excess``: see ``Ending``), and the keys of its parts.
        """
        ending = {"status": self.ending.status, "excess": self.ending.excess}
        return compute_metrics(vars(self)["_given"]) | {"ending": ending} | nested(self.figures)

    @functools.cached_property
    def ending(self) -> Ending:
        """The ending of the run: settled, not settled, growing, missed, diverged, interrupted."""
        data = vars(self)["_given"]
        if self.outcome.completed and "error" not in data:
            sentence = f"Completed {self.outcome.time:g} s; the record holds no errors."
            return Ending(status=NOT_SETTLED, sentence=sentence)
        return ending_of(self.outcome, self.scenario, data, Values(data))

    @property
    def realtime_factor(self) -> float:
        """Simulated seconds per second of wall time inside ``Simulator.AdvanceTo``."""
        return (
            self.outcome.time / self.wall_time["advance_to"]
            if self.wall_time["advance_to"] > 0
            else math.inf
        )

    def save(self, directory: str | Path, *, replacing: Any = Ellipsis) -> Path:
        """Write record.nc (netCDF-4), metrics.json and manifest.json, all or none.

        Report and analysis files of an earlier run (``OUTPUTS``) are removed. If another record was
        written to the folder in the meantime, it is kept, and this record is written to the next
        free folder DIRECTORY_2, DIRECTORY_3, ...

        Args:
          directory: folder for the files.
          replacing: the record to replace (``record_stamp``); default: the present one.

        Returns: the folder that was written.

        Raises:
          RecordError: the directory cannot be written.
        """
        directory, elsewhere = Path(directory), list[Path]()
        replaced = record_stamp(directory) if replacing is Ellipsis else replacing
        metrics = dict[str, Any]()
        with spared(METRICS_FILE):
            metrics = self.metrics
        manifest = self._manifest(directory)
        with published(
            directory,
            outdated=(*OUTPUTS, INPUTS.name),
            is_taken=lambda: record_stamp(directory) != replaced,
            elsewhere=elsewhere,
        ) as folder:
            self._write_dataset(folder / DATASET_FILE)
            if copies := INPUT_COPIES.first():
                with spared(INPUTS.name):
                    if kept := copies.keep(self.scenario, folder):
                        manifest["inputs"] = kept
            identifier = digest_of(folder / DATASET_FILE)
            manifest[IDENTIFIER] = identifier
            manifest[SEAL] = seal_of(json.loads(to_json(manifest)))
            for name, data in (
                (METRICS_FILE, metrics | {IDENTIFIER: identifier}), (MANIFEST_FILE, manifest),
            ):  # fmt: skip
                (folder / name).write_text(to_json(data), encoding="utf-8")
        object.__setattr__(self, "identifier", identifier)
        return elsewhere[0] if elsewhere else directory

    def _manifest(self, directory: Path) -> dict[str, Any]:
        """What the manifest in a folder says of the run, without its files."""
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
        if self.engine != DRAKE:
            manifest["engine"] = self.engine
        if self.grasp is not None:
            manifest["grasp"] = self.grasp
        if self.parts:
            manifest["parts"] = [dataclasses.asdict(part) for part in self.parts]
        return manifest

    def _write_dataset(self, file: Path) -> None:
        """Write record.nc."""
        from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK, NetCDF4DataStore

        # Character arrays rather than netCDF strings: every MATLAB reads them.
        encoding: dict[str, dict[str, Any]] = {
            str(name): {"dtype": "S1"}
            for name, array in self.dataset.coords.items()
            if array.dtype.kind in "UO"
        }
        encoding |= {str(name): {"zlib": True, "complevel": 1} for name in self.dataset.data_vars}
        open_store: Any = NetCDF4DataStore.open  # without types
        try:
            # Same as ``to_netcdf``, without its import of Dask's ``distributed``, if installed.
            store = open_store(file, mode="w", lock=NETCDF4_PYTHON_LOCK)
            with contextlib.closing(store):
                self.dataset.dump_to_store(store, encoding=encoding)
        except RuntimeError as error:  # the netCDF library's error for a full disk
            raise OSError(one_line(error)) from error

    @classmethod
    def load(cls, directory: str | Path) -> "RunRecord":
        """Read a record from the folder given to ``save``.

        Warns (StaleReportWarning) if the folder has a report of another run, or its parent a report
        of another comparison.

        Raises:
          RecordError: a file is missing or cannot be used.
        """
        identifier, fields = read_record(Path(directory))
        record = cls(**fields)
        object.__setattr__(record, "identifier", identifier)
        return record


def check_saving(directory: Path) -> None:
    """Raise RecordError unless a record could be written into a folder, with what that imports."""
    check_writable(directory)
    try:
        import xarray.backends.netCDF4_  # noqa: F401

        Table().assign({"time": ("time", [0.0])}, {}).to_dataset()
    except Exception as error:  # of any package, for a setting that it reads
        first: BaseException = error
        while first.__context__ is not None:
            first = first.__context__
        problem = f"this environment makes no record ({type(first).__name__}: {one_line(first)})"
        raise RecordError(f"{directory}: cannot be written: {problem}") from error


def record_stamp(directory: Path) -> tuple[int, ...] | None:
    """Identification of the record in a folder, different from that of a later one; None: no
    record.
    """
    return stamp(directory / MANIFEST_FILE)


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
