"""A run prepared for analysis."""

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.analysis.findings import NotApplicable
from ffsm_drake.runs.metrics import phases_of, usable_start
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.table import Given, Table
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers import gain_vectors
from ffsm_drake.systems.registry import is_shipped_name

if TYPE_CHECKING:
    import xarray as xr


# Series that findings may add: name -> dimensions, unit, meaning.
_RATE, _ACCELERATION = "rad/s, m/s", "rad/s^2, m/s^2"
SERIES = {
    "eta": ("posture_time rank", "1", "eigenvalues of H^-1 Hhat, ascending"),
    "condition_8": ("posture_time", "1", "||E - H^-1 Hhat||_2 (metres and radians)"),
    "condition_8_in_h": ("posture_time", "1", "the same norm in the metric of H"),
    "tde_error": ("period coordinate", _ACCELERATION, "TDE error N - Nhat"),
    "tde_error_bound": ("coordinate", _ACCELERATION, "largest |TDE error| over the run"),
    "tde_error_bound_late": ("coordinate", _ACCELERATION, "largest |TDE error| after the start-up"),
    "sliding_variable": ("time coordinate", _RATE, "s"),
    "reaching_gain": ("time coordinate", "1/s", "K_s"),
    "switching_gain": ("time coordinate", _ACCELERATION, "G"),
    "reaching_law_remainder": (
        "period coordinate",
        _ACCELERATION,
        "ds/dt minus what equation (7) gives",
    ),
    "direct_bound": ("coordinate", _RATE, "bound on |s_i| from equation (7), over the run"),
    "scaled_sliding_variable": ("time", "1/s", "largest beta_i times ||s||_inf"),
    "lyapunov": ("time", "1", "V of equation (12)"),
    "lyapunov_rate": ("period", "1/s", "dV/dt of equation (13), over the period"),
    "lyapunov_rate_of_s": ("period", "1/s", "the part of dV/dt from s"),
    "lyapunov_rate_of_k_s": ("period", "1/s", "the part of dV/dt from K_s"),
    "lyapunov_rate_of_g": ("period", "1/s", "the part of dV/dt from G"),
    "outside": ("time", "1", "coordinates with |s_i| > max(K_si / beta_i, epsilon)"),
    "effort_spectrum": (
        "frequency coordinate",
        "(N m)^2/Hz, N^2/Hz",
        "power spectral density of tau (Welch)",
    ),
    "linear_momentum_residual": ("time", "N s", "norm of the linear momentum's residual"),
    "angular_momentum_residual": ("time", "N m s", "norm of the angular momentum's residual"),
    "energy_residual": (
        "time",
        "J",
        "change of energy since the start minus the work of tau + tau_d and dampers",
    ),
}


class Evidence:
    """The finite part of a record, quantities shared by findings, and the series they add."""

    def __init__(self, record: RunRecord) -> None:
        self.record = record
        self.scenario = record.scenario
        phases = phases_of(record.dataset)
        if phases and "stop" not in phases:
            raise FfsmError("the run ended before the grasp; there is nothing to analyse")
        data = phases.get("stop", record.dataset)
        self.data = usable_start(data, data.data_vars, least=0)
        self.time = self.data["time"].values
        self.period = float(record.dataset.attrs["sample_time"])
        self.nominal = driven_model(record.mission.craft.nominal())
        self.true = driven_model(record.mission.craft.flexible())
        self.coordinates = self.nominal.coordinates
        # Duration of the start-up transient, s: at the first sample the controller has no past, so
        # Nhat is 0 whatever N is. With the published gains this excites a pole of about -0.74 per
        # sample at the slowest, which decays to 5 % within ten samples.
        self.start_up_time = max(0.1, 10.0 * self.period)
        self.after_start_up = self.time >= self.start_up_time - 1e-9
        self.attributes: dict[str, str | float] = {
            **record.dataset.attrs,
            "outcome": record.outcome.message,
            "start_up_time": self.start_up_time,
        }
        self.table = Table(attrs=self.attributes)
        self.axes: dict[str, np.ndarray] = {"time": self.time, "period": self.time[:-1]}

    @property
    def groups(self) -> dict[str, slice]:
        """The driven groups, without empty ones (an arm may have no joints)."""
        size, groups = len(self.coordinates.names), self.coordinates.driven_groups
        return {name: part for name, part in groups.items() if len(range(*part.indices(size)))}

    @functools.cached_property
    def constants(self) -> Mapping[str, Any]:
        """The controller's declared gains, (nv) or numbers; empty if it does not load."""
        try:
            return gain_vectors(self.scenario, self.coordinates)
        except FfsmError:
            if is_shipped_name("controller", self.scenario.controller):
                raise  # no run had these gains
            return {}  # its module is not available; most findings do not need it

    def require_period(self) -> None:
        """Raise NotApplicable unless there is a complete period."""
        if len(self.time) < 2:
            samples = counted(len(self.time), "finite sample")
            raise NotApplicable(f"the record has {samples}, less than one period")

    @property
    def outlasts_start_up(self) -> bool:
        """True if any period begins after the start-up."""
        return bool(self.after_start_up[:-1].any())

    def values(self, name: str) -> np.ndarray:
        return self.data[name].values

    def add(self, **series: np.ndarray) -> None:
        """Add series, by their names in ``SERIES``."""
        for name, values in series.items():
            dims, units, meaning = SERIES[name]
            column = (tuple(dims.split()), values, meaning, units)
            self.table = self.table.assign({name: column}, {})

    @functools.cached_property
    def inertia(self) -> np.ndarray:
        """Hhat at the measured configurations (n, nv, nv)."""
        return mass_matrices(self.nominal, self.values("measured_position"))

    @functools.cached_property
    def acceleration(self) -> np.ndarray:
        """Mean true acceleration of each period (n - 1, nv)."""
        return np.diff(self.values("velocity"), axis=0) / self.period

    @functools.cached_property
    def tde_error(self) -> np.ndarray:
        """TDE error Ntilde = N - Nhat of each period (n - 1, nv).

        From (2), (5) and (6), N - Nhat = q'' - u, which is what equation (7) calls the disturbance
        of ds/dt. The injected dynamics u_k is that behind the recorded force, equation (6) solved
        for it: u_k = (v_k - v_{k-1}) / L + Hhat_k^-1 (tau_k - tau_{k-1}), with v as the controller
        reads it. As in the controller, the first sample has no past: its acceleration and previous
        force are zero.
        """
        self.require_period()
        effort, velocity = self.values("generalized_force"), self.values("measured_velocity")
        change = np.diff(effort, axis=0, prepend=np.zeros_like(effort[:1]))
        measured = np.diff(velocity, axis=0, prepend=velocity[:1]) / self.period
        commanded = measured + np.linalg.solve(self.inertia, change[..., None])[..., 0]
        return np.where(self.coordinates.is_driven, self.acceleration - commanded[:-1], 0.0)

    @functools.cached_property
    def bound(self) -> np.ndarray:
        """N* of each coordinate over the whole run (nv)."""
        return largest(self.tde_error)

    @functools.cached_property
    def late_bound(self) -> np.ndarray:
        """N* of each coordinate after the start-up (nv); NaN if the run ends before."""
        return largest(self.tde_error[self.after_start_up[:-1]])

    @functools.cached_property
    def gains(self) -> tuple[np.ndarray, np.ndarray]:
        """K_s and G at every sample, both (n, nv).

        Constant gains come from the scenario; a law without them has zeros.
        """
        v = self.values("velocity")
        constant = np.broadcast_to(self.constants.get("k_s", 0.0), v.shape)
        k_s = self.values("reaching_gain") if "reaching_gain" in self.data else constant
        g = self.values("switching_gain") if "switching_gain" in self.data else np.zeros_like(v)
        return k_s, g

    def named(self, prefix: str, values: np.ndarray) -> dict[str, float]:
        """``prefix.coordinate`` -> value, for values (nv)."""
        return {
            f"{prefix}.{name}": float(x)
            for name, x in zip(self.coordinates.names, values, strict=True)
        }

    def grouped(self, prefix: str, values: np.ndarray) -> dict[str, float]:
        """``prefix.group`` -> the largest of the group's coordinates, for values (nv)."""
        return {f"{prefix}.{name}": float(values[part].max()) for name, part in self.groups.items()}

    def dataset(self) -> "xr.Dataset":
        coordinates = self.coordinates
        coords: dict[str, Given] = {name: (name, values) for name, values in self.axes.items()}
        of_coordinates = {
            "coordinate": coordinates.names,
            "group": coordinates.group_of,
            "unit": coordinates.units,
            "driven": coordinates.is_driven,
        }
        coords |= {name: ("coordinate", values) for name, values in of_coordinates.items()}
        return self.table.assign({}, coords).to_dataset()


def mass_matrices(model: PlantModel, positions: np.ndarray) -> np.ndarray:
    """Mass matrices (n, nv, nv), apparent with flexible parts, at configurations (n, nq)."""
    size = len(model.coordinates.names)
    return np.array([model.calc_apparent_mass_matrix(q) for q in positions]).reshape(-1, size, size)


def largest(values: np.ndarray) -> np.ndarray:
    """Return the largest magnitude along the first axis (m, nv) -> (nv); NaN if m is 0."""
    return np.abs(values).max(axis=0) if len(values) else np.full(values.shape[1], np.nan)


def ratio(part: Any, whole: Any) -> Any:
    """part / whole, of each pair of arrays; if whole is 0, then 0 for a part of 0, else
    infinite.
    """
    otherwise = np.where(np.equal(part, 0.0), 0.0, np.inf)
    return np.divide(part, whole, out=otherwise, where=np.not_equal(whole, 0.0))


def rms(values: np.ndarray) -> float:
    """Root mean square of all values; NaN where there are none."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else np.nan
