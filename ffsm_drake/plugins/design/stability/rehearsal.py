"""Runs of a mission with other noise sequences, to find whether it diverges under its limits.

The runs have no faults and no supervisor, and a capture begins just after the grasp. The engine
``compiled`` makes them in about the time of one run. If it is not installed, does not cover them or
calls their law, there are only ``FEW``.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.numbers import counted, percent, rounded_up, short
from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission, kept, make_mission
from ffsm_drake.plugins.design.stability.load import saturated_shares
from ffsm_drake.plugins.design.stability.planned_dynamics import from_grasp
from ffsm_drake.runs.batches import run_many, usual_batch
from ffsm_drake.runs.ending import Ending
from ffsm_drake.runs.engine import Engine, find_engine
from ffsm_drake.runs.log import RunLog
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.mission_limits import actuation_limit, base_limits
from ffsm_drake.systems.reference import timed

# noise sequences: with actuators of the base; with ``actuation.limit``; on Drake or with a law
# that is called
SEEDS, MANY, FEW = 16, 64, 4
_OTHERS = 1000  # added to a scenario's seed in the first run
_FURTHER = 1.5  # standard deviations; excess of the largest of 64 runs over one run
_CONFIDENCE = 3.0  # no sequence of n diverges: the chance is below 3 / n, at 95 %
_LIMIT = "actuation.limit"  # name among the saturated limits
_SETTLED_AFTER = 5.0  # s; start of the rms error
FAR = 100.0  # tolerances; a run that ends beyond has not done its task
# signals of a run of which only the end counts
_OF_ENDS = ("state", "hidden_state", "desired_state", "desired_frame", "stored_momentum")
_COMPILED = "compiled"  # the engine


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rehearsal:
    """Outcome of runs of a mission with other seeds. The figures are of the runs that do not
    diverge. If all diverge, they are of one of these.
    """

    scenario: Scenario  # that was run
    coordinates: Coordinates
    noise_force: np.ndarray  # (nv,) standard deviation of the command, N m or N; NaN of one run
    motion_force: np.ndarray  # (nv,) largest mean command, N m or N
    diverged: np.ndarray  # (seeds,) whether it fails, diverges, or ends far from its plan
    when: float = math.nan  # s, when the first of these ends
    # by actuator: (runs,) share of the samples with less than the wanted output
    saturated: Mapping[str, np.ndarray]
    ending: Ending  # of the run in the middle by the size of its last error
    # of the outputs of the law (``Outputs``), after the settling time, over all runs, rad or m
    rms_error: np.ndarray
    hint: str = ""  # what makes more runs possible

    def __str__(self) -> str:
        """One line: the outcome, the actuators' limits, and the commanded forces."""
        when = f" at t = {self.when:.1f} s" if math.isfinite(self.when) else ""
        return f"{self.share}{when}; {self._asked}; {self._saturating}{self.hint}"

    @property
    def noises(self) -> int:
        """Number of noise sequences."""
        return self.diverged.size

    @property
    def sequences(self) -> str:
        """Number of noise sequences, in words."""
        return counted(self.noises, "noise sequence")

    @property
    def share(self) -> str:
        """Share of noise sequences with divergence; if none, the implied bound on its
        probability.
        """
        count = int(self.diverged.sum())
        if self.noises == 1:
            return "diverges" if count else "does not diverge"
        if count:
            return f"diverges with {count} of {self.sequences}"
        return (
            f"diverges with none of {self.sequences} (chance below "
            f"{percent(rounded_up(_CONFIDENCE / self.noises, 3))}, at 95 % confidence)"
        )

    @property
    def _saturating(self) -> str:
        limited = [
            f"{name} in {percent(float(np.median(share)))}"
            for name, share in self.saturated.items()
            if share.any()
        ]
        return f"saturated: {', '.join(limited)} of the samples" if limited else "none saturates"

    @property
    def _asked(self) -> str:
        """The limits and the commanded forces: for the base's actuators or, without these, for the
        group nearest to its limit.
        """
        names, groups = [name for name in self.saturated if name != _LIMIT], self.coordinates.groups
        if names:
            limits = f"{' and '.join(names)} give {_largest_wrench(self.scenario)}"
            motion, noise = (
                f"{short(force[groups['base_rotation']].max(), 2)} N m and "
                f"{short(force[groups['base_position']].max(), 2)} N"
                for force in (self.motion_force, self.noise_force)
            )
        else:
            limit = actuation_limit(self.scenario, self.coordinates).upper
            most = self.motion_force + 3.0 * np.nan_to_num(self.noise_force)
            i = int(np.argmax(most / limit))
            unit = {"rad": "N m", "m": "N"}[self.coordinates.units[i]]
            limits = f"{_LIMIT} allows {limit[i]:.3g} {unit} on {self.coordinates.names[i]}"
            motion, noise = f"{self.motion_force[i]:.2g}", f"{self.noise_force[i]:.2g}"
        if np.isnan(self.noise_force).any():
            return limits
        return (
            f"{limits}; the motion takes up to {motion}, sensor noise {noise} (standard deviation)"
        )

    @property
    def share_diverged(self) -> float:
        """Fraction of seeds that diverged."""
        return float(self.diverged.mean())


class _Figures(NamedTuple):
    """What is kept of a run."""

    force: np.ndarray  # (n, nv) commands, N m or N
    saturated: dict[str, float]  # share of the samples, by actuator
    ending: Ending
    square: np.ndarray  # mean square error of outputs after the settling time, rad^2 or m^2


def rehearse(
    scenario: Scenario | Mission, *, seeds: int = SEEDS, on_drake: bool = True
) -> Rehearsal | None:
    """Run a mission with other noise sequences. A capture begins just after the grasp.

    Args:
      scenario: the scenario, or its mission, which keeps the results.
      seeds: number of noise sequences; at most ``FEW`` if Drake runs them or the law is called.
      on_drake: whether Drake runs what is not compiled.

    Returns: the outcome; None: Drake would have to run it.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
      BlockError: a user-supplied block fails.
    """
    return _rehearsed(make_mission(scenario), seeds, on_drake)


def shares_diverged(
    scenarios: Sequence[Scenario | Mission], *, seeds: int
) -> list[float | Exception]:
    """Return the share of noise sequences with divergence of each scenario, or its error (see
    ``rehearse``).
    """
    found, runs = dict[int, float | Exception](), dict[int, list[Mission]]()
    for index, scenario in enumerate(scenarios):
        try:
            runs[index] = _with_other_noise(_alone(make_mission(scenario)), seeds)
        except Exception as error:
            found[index] = error
    engine, every = _engine(), [run for own in runs.values() for run in own]
    logs = [] if engine is None else list(engine.run_all(every, _OF_ENDS))
    for number, (index, own) in enumerate(runs.items()):
        ends = logs[number * seeds : (number + 1) * seeds]
        try:
            if not ends or any(isinstance(end, FfsmError) for end in ends):
                ends = _on_drake(own[:FEW])
            found[index] = sum(end is None or _is_lost(end.ending) for end in ends) / len(ends)
        except Exception as error:
            found[index] = error
    return [found[index] for index in range(len(scenarios))]


def is_near_limits(scenario: Scenario, coordinates: Coordinates, force: np.ndarray) -> bool:
    """Whether another noise sequence may take commands beyond ``actuation.limit``, from the
    commands of one run (n, nv; N m or N); their changes from sample to sample give the noise.
    """
    if scenario.actuation.limit is None or scenario.blocks.actuation is not None or len(force) < 2:
        return False
    limit = coordinates.vector(scenario.actuation.limit, key=_LIMIT, default=np.inf)
    noise = np.diff(force, axis=0).std(axis=0) / math.sqrt(2.0)
    return bool((np.abs(force).max(axis=0) + _FURTHER * noise > limit).any())


def _is_lost(ending: Ending) -> bool:
    """Whether a run fails or diverges, or ends far from its plan. Errors that grow within their
    tolerance do neither.
    """
    return not ending.excess <= FAR


@kept
@step("running the mission with other noise sequences")
def _rehearsed(mission: Mission, seeds: int, on_drake: bool) -> Rehearsal | None:
    alone = _alone(mission)
    engine, runs, hint = _engine(), _with_other_noise(alone, seeds), ""
    found = None if engine is None else _compiled(engine, runs)
    logs = list[RunLog]()
    if found is not None and None in found:
        logs = _on_drake([runs[found.index(None)]])  # which shows how it diverges
        if not any(found) and not _is_lost(logs[0].ending):
            found = None
    if found is None:
        if not on_drake:
            return None
        logs = _on_drake(runs[:FEW])
        found = [None if _is_lost(log.ending) else _figures(log) for log in logs]
        if engine is None and len(found) < seeds:
            hint = f"; with pip install 'ffsm-drake[compiled]' there are {seeds} sequences"
    lost = next((log for log in logs if _is_lost(log.ending)), None)
    seen = [each for each in found if each is not None]
    if not seen and lost is not None:
        seen = [_figures(lost)]
    force = np.array([each.force for each in seen])
    endings = sorted((each.ending for each in seen), key=lambda ending: ending.excess)
    return Rehearsal(
        scenario=alone.scenario,
        coordinates=alone.craft.coordinates,
        noise_force=np.sqrt(force.var(axis=0, ddof=1).mean(axis=0))
        if len(seen) > 1
        else np.full(force.shape[-1], np.nan),
        motion_force=np.abs(force.mean(axis=0)).max(axis=0),
        diverged=np.array([each is None for each in found]),
        when=math.nan if lost is None else lost.outcome.time,
        saturated={
            name: np.array([each.saturated[name] for each in seen]) for name in seen[0].saturated
        },
        ending=endings[len(endings) // 2],
        rms_error=np.sqrt(np.mean([each.square for each in seen], axis=0)),
        hint=hint,
    )


def _compiled(engine: Engine, runs: Sequence[Mission]) -> list[_Figures | None] | None:
    """The figures of runs, None of one that diverges; None: they are not covered."""
    found, begin = list[_Figures | None](), 0
    most = usual_batch(engine, samples=runs[0].scenario.num_control_periods)
    while begin < len(runs):
        end, is_called = begin + (most if begin else min(FEW, most)), False
        for log in engine.run_all(runs[begin:end]):
            if isinstance(log, FfsmError):
                return None
            is_called |= log is not None and log.engine != engine.name
            found.append(None if log is None or _is_lost(log.ending) else _figures(log))
        begin = len(runs) if is_called else end
    return found


def _figures(log: RunLog) -> _Figures:
    scenario, force = log.scenario, log.generalized_force
    limit = log.coordinates.vector(scenario.actuation.limit or {}, key=_LIMIT, default=np.inf)
    shares = saturated_shares(scenario, log)
    error, settled = log.error, log.time > _SETTLED_AFTER
    if log.tracks_frame and log.frame_error is not None:
        error = np.hstack([error, log.frame_error])
    settled[-1] = True  # the last error of a shorter run
    return _Figures(
        force=force,
        saturated={**shares, _LIMIT: float((np.abs(force) > limit).any(axis=1).mean())},
        ending=log.ending,
        square=(error[settled] ** 2).mean(axis=0),
    )


def _alone(mission: Mission) -> Mission:
    """The mission without faults and supervisor. A capture begins just after the grasp."""
    return timed(*from_grasp(mission)).flown_by(faults=None, supervisor=None)


def _with_other_noise(mission: Mission, seeds: int) -> list[Mission]:
    first = mission.scenario.random_seed + _OTHERS
    return [mission.flown_by(random_seed=first + k) for k in range(seeds)]


def _engine() -> Engine | None:
    """The engine of compiled runs; None: it is not installed."""
    try:
        return find_engine(_COMPILED)
    except FfsmError:
        return None


def _on_drake(runs: Sequence[Mission]) -> list[RunLog]:
    """The logs of runs. Raises the error of one."""
    found = list[RunLog]()
    for _, log in run_many(runs):
        if isinstance(log, Exception):
            raise log
        found.append(log)
    return found


def _largest_wrench(scenario: Scenario) -> str:
    """The largest torque and force of the base's actuators, in the worst and the best direction."""
    limits = base_limits(scenario)
    spans = []
    for given, unit in ((limits.torque, "N m"), (limits.force, "N")):
        least, most = given.min(), given.max()
        if most < 1.01 * least:
            spans.append(f"{least:.2g} {unit}")
        elif math.isfinite(most):
            spans.append(f"{least:.2g} to {most:.2g} {unit}")
    return " and ".join(spans)
