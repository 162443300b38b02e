"""simulate: one run of a scenario, and its record."""

import time
import warnings
from collections.abc import Callable

from pydrake.geometry import Meshcat
from pydrake.systems.framework import LeafSystem, System

from ffsm_drake.runs.dataset import make_dataset
from ffsm_drake.runs.record import RunRecord, software_versions
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates


def simulate(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    progress: Callable[[float, float], None] | None = None,
    check_stability: bool = True,
    own_disturbance: Callable[[Coordinates], System] | None = None,
    make_operator: Callable[[Coordinates], LeafSystem] | None = None,
) -> RunRecord:
    """Run a scenario to its end and return the record. ``Rollout`` is cheaper for many runs.

    A run that diverges (a velocity beyond ``divergence_speed``, or not finite) or is interrupted from the keyboard ends
    early with the record up to then; ``record.outcome`` says so.

    Args:
      scenario: what to run.
      meshcat: shows the motion while it is computed (set ``simulator_config.target_realtime_rate`` to pace it).
      progress: called with (simulated time, duration) in s, once per simulated second.
      check_stability: warn (StabilityWarning) when the sampled loop starts unstable or its adaptation may become so.
      own_disturbance: a source in place of the scenario's harmonics, see ``make_closed_loop``; the dataset's attribute
        ``disturbance`` then holds its name.
      make_operator: lets a system add to the disturbance, see ``make_closed_loop``.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
    """
    start = time.perf_counter()
    if check_stability:
        from ffsm_drake.design.stability import StabilityWarning, stability_warning  # SciPy is slow to import

        if remark := stability_warning(scenario):
            warnings.warn(remark, StabilityWarning, stacklevel=2)
    rollout = Rollout(scenario, meshcat=meshcat, own_disturbance=own_disturbance, make_operator=make_operator)
    log = rollout.run(progress=progress)
    dataset = make_dataset(log)
    if own_disturbance is not None:
        dataset.attrs["disturbance"] = rollout.loop.disturbance.get_name()
    return RunRecord(
        scenario=scenario,
        outcome=log.outcome,
        dataset=dataset,
        wall_time=log.wall_time | {"total": time.perf_counter() - start},
        software=software_versions(),
    )
