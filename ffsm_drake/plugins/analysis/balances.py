"""Momentum and energy balances, which check the integrator."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.common.products import times
from ffsm_drake.plugins.analysis.evidence import Evidence, ratio
from ffsm_drake.plugins.analysis.findings import Evaluated, NotApplicable
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.runs.table import held_force, with_role
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.systems.parts.signals import INTERNAL_TORQUE, INTERNAL_WORK, STORED_ENERGY

if TYPE_CHECKING:
    import xarray as xr

# A balance holds when its residual is below this fraction of the exchanged momentum or energy:
# explicit Euler at the control period misses by 1e-4 and more, the accurate integration of the
# shipped scenarios by 1e-10.
TOLERANCE = 1e-6
_MAX_SAMPLES = 200  # samples of a run, at most


def energy_residual(dataset: "xr.Dataset") -> dict[str, np.ndarray]:
    """Residual of the energy balance, J (n), and the work to compare it with.

    The residual is T(t) - T(0) minus the work of tau, tau_d and friction since the start.

    Hidden coordinates add the energy of their springs and the work of their dampers.

    Keys:
      residual: tau is constant over a period, so its work is tau . displacement; tau_d and v are
        assumed linear within the period; friction's work was integrated with the plant. On an
        exactly integrated run this leaves about 1e-11 J of the paper's 1.2 J.
      trapezoid: the same, with the displacement from the mean v of two samples; the difference
        bounds the quadrature error if positions and velocities belong to one path (not so on a
        plant stepped by explicit Euler).
      absolute_work: |work of tau|, summed over coordinates and up to each sample.
    """
    period = float(dataset.attrs["sample_time"])
    velocity = dataset["velocity"].values
    held = held_force(dataset)[:-1]
    smooth = dataset["disturbance_force"].values
    energy = dataset["kinetic_energy"].values
    energy = energy + _summed(dataset, STORED_ENERGY)
    if "hidden_force" in dataset:
        pull, path = dataset["hidden_force"].values, dataset["hidden_position"].values
        energy = energy - _since_start(0.5 * (pull[1:] + pull[:-1]) * np.diff(path, axis=0))
    mean = held + 0.5 * (smooth[1:] + smooth[:-1])
    # Linear tau_d and v correlate within the period, which the product of means misses; the mean of
    # tau_d is off by L^2/12 times its second derivative, here from neighbouring samples.
    correlation = period / 12.0 * np.diff(velocity, axis=0) * np.diff(smooth, axis=0)
    if len(smooth) >= 3:
        slope = np.gradient(smooth, axis=0)
        mean = mean - np.diff(slope, axis=0) / 12.0
    work = _summed(dataset, INTERNAL_WORK)
    energy = energy - (work - work[0])
    # exact except for the base's rotation, whose rotation vector differs from the integral of w by
    # L^3 |w x dw/dt| / 12
    position = dataset["position"].values
    moved = position_errors(position[1:], position[:-1])
    middle = 0.5 * period * (velocity[1:] + velocity[:-1])
    return {
        "residual": energy - energy[0] - _since_start(mean * moved + correlation),
        "trapezoid": energy - energy[0] - _since_start(mean * middle + correlation),
        "absolute_work": _since_start(np.abs(held * moved)),
    }


def _summed(dataset: "xr.Dataset", role: str) -> np.ndarray:
    """Return the sum (n) of the signals with a role, over their components."""
    samples = dataset.sizes["time"]
    given = [dataset[name].values.reshape(samples, -1) for name in with_role(dataset, role)]
    return sum((each.sum(axis=1) for each in given), np.zeros(samples))


def _since_start(work: np.ndarray) -> np.ndarray:
    """Work since the start (n), J, from the work in each period, by coordinate (n - 1, k)."""
    return np.concatenate([np.zeros(1), np.cumsum(work.sum(axis=1))])


def absolute_impulse(dataset: "xr.Dataset") -> dict[str, float]:
    """Time integral of the norms of the external force and torque (about the world's origin):
    ``linear``, ``angular``.

    The scale for a momentum residual, N s and N m s.
    """
    period = float(dataset.attrs["sample_time"])
    total = dataset["disturbance_force"].values + held_force(dataset)
    torque, force = np.split(total[:, :NUM_BASE_VELOCITIES], 2, axis=1)
    for name in with_role(dataset, INTERNAL_TORQUE):  # which is not external
        torque = torque - dataset[name].values
    arm = dataset["position"].values[:, 4:NUM_BASE_POSITIONS]
    impulses = {"linear": force, "angular": torque + np.cross(arm, force)}
    return {
        name: float(np.linalg.norm(values[:-1], axis=1).sum() * period)
        for name, values in impulses.items()
    }


def exchanged_momentum(run: Evidence) -> dict[str, float]:
    """Return the largest momentum of the joint velocities, exchanged with the base: ``linear``,
    ``angular``.

    About the base's origin, N s and N m s; the scale for a momentum residual when no external
    force acts.
    """
    every = slice(None, None, max(1, len(run.time) // _MAX_SAMPLES))
    velocity = run.values("velocity")[every].copy()
    velocity[:, :NUM_BASE_VELOCITIES] = 0.0
    mass_matrix = run.record.mission.craft.nominal().calc_mass_matrix(run.values("position")[every])
    momentum = times(mass_matrix, velocity)[:, :NUM_BASE_VELOCITIES].reshape(-1, 2, 3)
    sizes = np.linalg.norm(momentum, axis=2).max(axis=0)
    return dict(zip(("angular", "linear"), sizes.tolist(), strict=True))


def _require_samples(run: Evidence) -> None:
    if len(run.time) < 4:
        raise NotApplicable(f"the integrals need 4 samples, the record has {len(run.time)}")


def momentum(run: Evidence) -> Evaluated:
    """The momentum balance, for any controller."""
    _require_samples(run)
    impulse, within = absolute_impulse(run.data), "of the summed impulse"
    if run.coordinates.undriven:
        within = "of the summed impulse and what the arm's motion gives the base"
        impulse = {name: impulse[name] + size for name, size in exchanged_momentum(run).items()}
    numbers: dict[str, Any] = {"tolerance": TOLERANCE}
    for name, residual in momentum_residual(run.data).items():
        size = np.linalg.norm(residual, axis=1)
        run.add(**{f"{name}_momentum_residual": size})
        numbers |= {
            f"{name}_residual": size.max(),
            f"{name}_impulse": impulse[name],
            f"{name}_ratio": ratio(size.max(), impulse[name]),
        }
    statement = (
        "Momentum follows the impulse of the external forces within {linear_residual:.2g} N s and "
        "{angular_residual:.2g} N m s, {linear_ratio:.2g} and {angular_ratio:.2g} " + f"{within}."
    )
    largest = max(numbers["linear_ratio"], numbers["angular_ratio"])
    return bool(largest <= TOLERANCE), statement, numbers


def energy(run: Evidence) -> Evaluated:
    """The energy balance, for any controller."""
    _require_samples(run)
    parts = energy_residual(run.data)
    run.add(energy_residual=parts["residual"])
    missed, work = np.abs(parts["residual"]).max(), parts["absolute_work"][-1]
    numbers = {
        "tolerance": TOLERANCE,
        "residual": missed,
        "residual_by_trapezoid": np.abs(parts["trapezoid"]).max(),
        "absolute_work": work,
        "ratio": ratio(missed, work),
    }
    forces = "tau, tau_d and friction" if with_role(run.data, INTERNAL_WORK) else "tau and tau_d"
    statement = (
        f"Kinetic energy follows the work of {forces} "
        "within {residual:.2g} J, {ratio:.2g} of the "
        "{absolute_work:.3g} J of absolute work of tau."
    )
    return bool(numbers["ratio"] <= TOLERANCE), statement, numbers
