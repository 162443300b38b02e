"""The record of a run: labelled time series, metrics, and the manifest that says how it came about."""

import dataclasses
import functools
import json
import math
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ffsm_drake.errors import FfsmError, RecordError, one_line
from ffsm_drake.files import write_text, written_whole
from ffsm_drake.metrics import compute_metrics
from ffsm_drake.scenario import Scenario, scenario_from_dict, scenario_to_dict

if TYPE_CHECKING:
    import xarray as xr

DATASET_FILE = "record.nc"
METRICS_FILE = "metrics.json"
MANIFEST_FILE = "manifest.json"
FORMAT = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a run ended."""

    status: str  # "completed", "diverged" or "interrupted"
    time: float  # s, end of the record
    message: str  # one line
    coordinate: str = ""  # the coordinate that diverged

    @property
    def completed(self) -> bool:
        return self.status == "completed"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunRecord:
    """All that a run leaves behind.

    ``dataset`` is an xarray Dataset along ``time`` (control samples t_k, s), ``coordinate`` (generalized velocities by
    name, with ``group`` and ``unit``), ``position_name`` (generalized positions by name) and ``axis`` (x, y, z; world
    frame). Its variables carry their units and meaning as attributes; ``list(record.dataset)`` names them.
    """

    scenario: Scenario
    outcome: Outcome
    dataset: "xr.Dataset"
    wall_time: dict[str, float]  # s: build, advance_to, total
    software: dict[str, str]

    @functools.cached_property
    def metrics(self) -> dict[str, Any]:
        """Figures of merit; the keys are those of ``ffsm_drake.metrics.compute_metrics``."""
        return compute_metrics(self.dataset)

    @property
    def realtime_factor(self) -> float:
        """Simulated seconds per second of wall time inside ``Simulator.AdvanceTo``."""
        return self.outcome.time / self.wall_time["advance_to"] if self.wall_time["advance_to"] > 0 else math.inf

    def save(self, directory: str | Path) -> Path:
        """Write record.nc (netCDF-4), metrics.json and manifest.json, each whole. Returns the directory.

        Raises:
          RecordError: the directory cannot be written.
        """
        directory = Path(directory)
        # Character arrays rather than netCDF strings: every MATLAB reads them.
        encoding: dict[str, dict[str, Any]] = {
            str(name): {"dtype": "S1"} for name, array in self.dataset.coords.items() if array.dtype.kind in "UO"
        }
        encoding |= {str(name): {"zlib": True, "complevel": 1} for name in self.dataset.data_vars}
        with written_whole(directory / DATASET_FILE) as temporary:
            self.dataset.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
        write_text(directory / METRICS_FILE, to_json(self.metrics))
        manifest = {
            "format": FORMAT,
            "outcome": dataclasses.asdict(self.outcome),
            "random_seed": self.scenario.random_seed,
            "software": self.software,
            "wall_time": self.wall_time,
            "realtime_factor": self.realtime_factor,
            "scenario": scenario_to_dict(self.scenario),
        }
        write_text(directory / MANIFEST_FILE, to_json(manifest))
        return directory

    @classmethod
    def load(cls, directory: str | Path) -> "RunRecord":
        """Read back what ``save`` wrote.

        Raises:
          RecordError: a file is missing or cannot be used.
        """
        import xarray as xr

        directory = Path(directory)
        path = directory / MANIFEST_FILE
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            if manifest["format"] != FORMAT:
                raise RecordError(f"{path}: format {manifest['format']} is not the supported {FORMAT}")
            scenario = scenario_from_dict(manifest["scenario"])
            outcome = Outcome(**manifest["outcome"])
            wall_time, software = dict(manifest["wall_time"]), dict(manifest["software"])
        except FfsmError as error:
            raise RecordError(f"{path}: {one_line(error)}") from error
        except OSError as error:
            raise RecordError(f"{path}: cannot be read: {one_line(error)}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise RecordError(f"{path}: is not a run's manifest: {type(error).__name__} {one_line(error)}") from error
        path = directory / DATASET_FILE
        try:
            dataset = xr.load_dataset(path, engine="netcdf4")
        except (OSError, ValueError, RuntimeError) as error:
            raise RecordError(f"{path}: cannot be read: {one_line(error)}") from error
        return cls(scenario=scenario, outcome=outcome, dataset=dataset, wall_time=wall_time, software=software)


def software_versions() -> dict[str, str]:
    """Versions of everything that shapes a result."""
    versions = {"python": platform.python_version(), "platform": platform.platform()}
    return versions | {package: _version(package) for package in ("ffsm-drake", "drake", "numpy", "scipy", "xarray")}


@functools.cache  # reads a file each time
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def to_json(data: Any) -> str:
    """JSON text; numbers that JSON does not know (NaN, infinities) become null."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [clean(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(clean(data), indent=2, allow_nan=False) + "\n"
