"""The integrator's errors in a record: violated momentum balance, attitude that is no longer a
rotation.
"""

from collections.abc import Iterator

import numpy as np

from ffsm_drake.common.numbers import number
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario.schema import FIXED_STEP_SCHEMES
from ffsm_drake.spacecraft.plant import configuration

# Explicit Euler at the control period misses the momentum of slow motions by less than 1e-3, the
# accurate integration of the shipped scenarios by 1e-8; their quaternions have norm 1 to 3e-6.
MOMENTUM_TOLERANCE = 1e-2  # share of the momentum equivalent to the kinetic energy
NORM_TOLERANCE = 1e-4


def integration_remarks(record: RunRecord) -> Iterator[str]:
    """A line for the momentum balance and one for the attitude where the integrator broke them.

    The balance is compared with the momentum of the whole spacecraft at the largest kinetic energy.

    Raises ModelError: the scenario's model does not load any more.
    """
    data, config = record.dataset, record.scenario.simulator_config
    better = " or runge_kutta3" if config.integration_scheme in FIXED_STEP_SCHEMES else ""
    key = "accuracy" if config.use_error_control else "max_step_size"
    remedy = f"set a smaller simulator_config.{key}{better}"
    norm = np.linalg.norm(data["position"].values[:, :4], axis=1)
    off = np.abs(norm[np.isfinite(norm)] - 1.0).max(initial=0.0)
    if off > NORM_TOLERANCE:
        yield f"the norm of the base quaternion differs from 1 by {off:.2g}; {remedy}"
    energy = data["kinetic_energy"].values
    largest = float(energy[np.isfinite(energy)].max(initial=0.0))
    if not largest > 0.0:
        return
    model = record.mission.craft.true()
    q = configuration(model.coordinates, record.scenario.initial_posture, key="initial_posture")
    inertia = model.calc_mass_matrix(q)
    scales = {
        "linear": (float(inertia[3, 3]), "N s"),
        "angular": (float(np.linalg.eigvalsh(inertia[:3, :3])[-1]), "N m s"),
    }
    for name, (weight, unit) in scales.items():
        residual = float(record.metrics["momentum_residual"][name])
        share = residual / np.sqrt(2.0 * largest * weight)
        if share > MOMENTUM_TOLERANCE:
            yield (
                f"the integrator is too coarse: it changes the {name} momentum by {residual:.3g} "
                f"{unit}, {number(100.0 * share, 2)} % of the momentum in motion; {remedy}"
            )
