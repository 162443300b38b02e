"""The laws of the benchmark on a mission, ranked, and compared with REFERENCE on the same seeds.

The runs of a law on a mission are a campaign whose cases differ in their random seed only, the
same seeds for all laws. Each has its database, so that whatever was run is kept.
"""

import collections
import contextlib
import copy
import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import CampaignError, FfsmError, InterruptedCampaign, one_line
from ffsm_drake.common.files import check_regular, write_text
from ffsm_drake.common.shapes import misfit
from ffsm_drake.plugins.benchmark.law_figures import FIGURES, law_figures
from ffsm_drake.plugins.benchmark.missions import (
    BenchmarkMission,
    Published,
    at_start,
    bounds_of,
    least_propellant,
    planned_time,
)
from ffsm_drake.plugins.benchmark.paired import (
    REFERENCE,
    Compared,
    Rows,
    compared,
    corrected,
    mean,
    share,
)
from ffsm_drake.plugins.campaign.cases import make_cases
from ffsm_drake.plugins.campaign.rows import COMPLETED, ENGINE
from ffsm_drake.plugins.campaign.run import Progress, check_cases, resume_campaign
from ffsm_drake.plugins.campaign.spec import COMPILED, Spec, spec_from_data, why_not_compiled
from ffsm_drake.plugins.campaign.statistics import Interval
from ffsm_drake.plugins.campaign.store import create_store, open_store
from ffsm_drake.plugins.workers.pool import Runs, Stop, WorkerLost, Workers
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.scenario import Scenario, override_scenario, scenario_to_dict, scenario_to_yaml
from ffsm_drake.systems.registry import shipped_names

SEEDS = 20
# Outcomes of a seed: left out by an interruption, and longer than a campaign's time limit.
NOT_RUN, CUT = "not run", "cut by the time limit"
REFUSED = "refused by the mission"  # of a law without an outcome
_MISSING = {
    "outcome": NOT_RUN,
    "message": "interrupted before every run was made; the same command goes on",
}
_MAX_FIGURES = 100_000  # bytes of a file of law_figures
_AT_START, _PLANNED = "angular_momentum", "planned_time"
_OF_RUNS = (
    "itae",
    "isv",
    "peak_error_base_rotation",
    "settled_time",
    "propellant",
    "final_drift_rotation",
)
SHOWN = (*_OF_RUNS, *FIGURES)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Standing:
    """A law's row in the leaderboard of a mission."""

    controller: str
    outcomes: tuple[str, ...]  # outcome of each seed; none: the law does not apply
    # means over ``over`` and ``law_figures``, by column; None: there is none; NaN: cut
    figures: Mapping[str, float | None]
    # of the means; none of the ``law_figures``
    intervals: Mapping[str, Interval] = dataclasses.field(default_factory=dict)
    engines: tuple[str, ...] = ()  # what computed the runs; other than compiled code: why
    message: str = ""  # why it does not apply, or the first failure
    rows: Rows = ()  # the results by seed

    @property
    def settled(self) -> int:
        return self.outcomes.count("settled")

    @property
    def share(self) -> Interval | None:
        """Share of settled runs; None: the law does not apply, or was not run."""
        return share(self.settled, len(self.outcomes)) if self.was_run else None

    @property
    def was_run(self) -> bool:
        """Whether every seed was run."""
        return bool(self.outcomes) and NOT_RUN not in self.outcomes

    @property
    def over(self) -> str:
        """The runs whose means the figures are: settled ones; if there is none, completed ones."""
        if self.settled:
            return "settled"
        return "completed" if {*self.outcomes} & {*COMPLETED} else ""

    @property
    def ended(self) -> str:
        """How runs did not come to their end, and of what runs the figures are, in words."""
        if not self.outcomes:
            return REFUSED
        early = collections.Counter(name for name in self.outcomes if name not in COMPLETED)
        words = [f"{count} {name}" for name, count in early.items()]
        if self.over == "completed":
            unsettled = sum(name in COMPLETED for name in self.outcomes)
            words.append(f"figures of {unsettled} that did not settle")
        return ", ".join(words)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Board:
    """The result of a mission, best law first."""

    mission: BenchmarkMission
    standings: tuple[Standing, ...]
    bounds: Mapping[str, float]  # least times, s, by what they follow from
    motion: float  # s; of the planned motion
    propellant: float | None = None  # kg, the least that thrusters take the momentum out with

    @property
    def ratio(self) -> float | None:
        """Time of the planned motion over the bound of momentum and limits; None without one."""
        bound = self.bounds.get("momentum")
        return self.motion / bound if bound else None


Comparison = dict[tuple[str, str], dict[str, Compared]]


def comparison(boards: Sequence[Board]) -> Comparison:
    """Compare every law that was run on every seed with REFERENCE, by mission and law, with Holm's
    correction over all quantities, laws and missions.
    """
    found = dict[tuple[str, str], Mapping[str, Compared]]()
    for board in boards:
        of_law = {each.controller: each for each in board.standings if each.was_run}
        if (reference := of_law.pop(REFERENCE, None)) is None:
            continue
        for law, standing in of_law.items():
            found[board.mission.name, law] = compared(standing.rows, reference.rows)
    return corrected(found)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduced:
    """A published figure beside the one of this package."""

    mission: str
    published: Published
    found: float | None

    @property
    def holds(self) -> bool:
        if self.found is None:
            return False
        if self.published.at_most:
            return self.found <= self.published.value
        return abs(self.found / self.published.value - 1.0) <= self.published.within


def _spec(scenario: Scenario, law: str, seeds: int) -> Spec:
    return spec_from_data(
        {
            "base": scenario_to_dict(scenario),
            "controllers": [law],
            "cases": seeds,
            "sampling": "random",
            "predictions": False,  # ``law_figures`` has them, once
            "engine": DRAKE if why_not_compiled() else COMPILED,
            # unchanged: only the seeds differ
            "parameters": {"duration": {"distribution": "list", "values": [scenario.duration]}},
        }
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """Where the results of a mission are kept, and with how many seeds."""

    mission: BenchmarkMission
    folder: Path
    seeds: int = SEEDS

    def spec(self, law: str) -> Spec:
        """The campaign of a law."""
        return _spec(self.mission.scenario, law, self.seeds)

    def database(self, law: str) -> Path:
        """The database of a law's runs."""
        spec = self.spec(law)
        return self.folder / f"{self.mission.name}-{spec.fingerprint[:12]}.db"

    def margins(self, law: str) -> Path:
        """The file with the ``law_figures`` of a law, which no seed matters for."""
        spec = _spec(self.mission.scenario, law, 1)
        return self.folder / f"{self.mission.name}-{spec.fingerprint[:12]}.json"

    def rows(self, law: str) -> Rows:
        """The stored results of a law by seed; of those not run, why."""
        rows: list[Mapping[str, Any]] = [_MISSING] * self.seeds
        with contextlib.suppress(CampaignError), open_store(self.database(law)) as store:
            for seed in range(self.seeds):
                with contextlib.suppress(CampaignError):  # interrupted
                    rows[seed] = store.result(seed, law)
        return rows

    def laws(self) -> list[str]:
        """The laws with results of the current version of the mission."""
        found = list[str]()
        for path in sorted(self.folder.glob(f"{self.mission.name}-*.db")):
            with contextlib.suppress(CampaignError), open_store(path) as store:
                law = store.spec.controllers[0]
                if self.database(law) == path:
                    found.append(law)
        return found


def run_mission(
    place: Place,
    controllers: Sequence[str],
    *,
    workers: Workers,
    stop: Stop | None = None,
    progress: Callable[[Progress], None] | None = None,
    margins: bool = False,
) -> Board:
    """Run laws on a mission, or the rest of it, and rank them with earlier results.

    Args:
      controllers: the laws; none: every law of this package.
      margins: whether the ``law_figures`` are computed, too.

    Raises:
      CampaignError, InterruptedCampaign, WorkersError: see ``start_campaign``.
    """
    usable, misfits = _usable(place, controllers)
    total = place.seeds * len(usable)
    stored = sum(row is not _MISSING for law in usable for row in place.rows(law))
    counts = Progress(before=stored, total=total)
    for law in usable:
        path, spec = place.database(law), place.spec(law)
        if not path.exists():
            with create_store(path, spec, make_cases(spec)):
                pass
        if any(row is _MISSING for row in place.rows(law)):
            earlier = copy.copy(counts)
            add = functools.partial(_add, counts, earlier, progress)
            resume_campaign(path, workers=workers, stop=stop, progress=add)
    if margins:
        _find_figures(place, usable, workers=workers, stop=stop)
    return _board(place, misfits)


def _add(
    counts: Progress,
    earlier: Progress,
    progress: Callable[[Progress], None] | None,
    law: Progress,
) -> None:
    """Report the progress of a mission: that of a law, after ``earlier`` ones of this session."""
    counts.elapsed = earlier.elapsed + law.elapsed
    for name in ("session", "failed", "unsettled", "computing"):
        setattr(counts, name, getattr(earlier, name) + getattr(law, name))
    if progress is not None:
        progress(copy.copy(counts))


def board_so_far(place: Place, controllers: Sequence[str]) -> Board:
    """The results that an interrupted ``run_mission`` leaves, a row for each law. Arguments and
    errors: see there.
    """
    usable, misfits = _usable(place, controllers)
    return _board(place, misfits, usable)


def _usable(place: Place, controllers: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """The laws that apply to a mission, and why others do not."""
    misfits, usable = dict[str, str](), list[str]()
    for name in controllers or shipped_names("controller"):
        try:
            scenario = override_scenario(place.mission.scenario, [f"controller={name}"])
            check_cases(_spec(scenario, name, 1))
            usable.append(name)
        except FfsmError as error:
            if controllers:  # requested by name
                raise
            misfits[name] = one_line(error)
    return usable, misfits


def _read_figures(path: Path) -> dict[str, float | None] | None:
    """The ``law_figures`` that a file keeps; None: there is none, or it holds something else."""
    try:
        check_regular(path, limit=_MAX_FIGURES)
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return None if misfit(found, {key: [float, None] for key in FIGURES}, "figures") else found


def _find_figures(
    place: Place, laws: Sequence[str], *, workers: Workers, stop: Stop | None
) -> None:
    """Compute the ``law_figures`` missing in the folder. Raises the errors of ``run_mission``."""
    missing = [name for name in laws if _read_figures(place.margins(name)) is None]

    def arguments(name: str) -> tuple[str]:
        scenario = override_scenario(place.mission.scenario, [f"controller={name}"])
        return (scenario_to_yaml(scenario),)

    found = Runs(
        law_figures,
        missing,
        arguments=arguments,
        workers=workers,
        stop=Stop() if stop is None else stop,
    ).results()
    done = 0
    with contextlib.closing(found):
        for name, figures in found:
            lost = isinstance(figures, WorkerLost)
            given = dict.fromkeys(FIGURES, math.nan) if lost else figures
            write_text(place.margins(name), json.dumps(given))
            done += 1
    if done < len(missing):
        raise InterruptedCampaign(done, len(missing))


def _board(place: Place, misfits: Mapping[str, str], wanted: Sequence[str] = ()) -> Board:
    """The results in a folder; laws that are wanted have a row without any, too."""
    laws = dict.fromkeys([*wanted, *place.laws()])
    standings = [_standing(name, place.rows(name), place.margins(name)) for name in laws]
    standings += [
        Standing(controller=name, outcomes=(), figures=dict.fromkeys(SHOWN), message=why)
        for name, why in misfits.items()
        if name not in laws
    ]

    def rank(standing: Standing) -> tuple[Any, ...]:
        itae = standing.figures["itae"]  # None where no run came to its end
        has_run = any(name not in ("error", NOT_RUN, CUT) for name in standing.outcomes)
        return -standing.settled, not has_run, math.inf if itae is None else itae

    mission = place.mission
    try:
        bounds, motion = bounds_of(mission), planned_time(mission.scenario)
        propellant = least_propellant(mission.scenario)
    except FfsmError:  # the limits allow no motion
        bounds, motion, propellant = {}, math.nan, None
    return Board(
        mission=mission,
        standings=tuple(sorted(standings, key=rank)),
        bounds=bounds,
        motion=motion,
        propellant=propellant,
    )


def _is_cut(row: Mapping[str, Any]) -> bool:
    return row["outcome"] == "error" and "(time_limit)" in row["message"]


def _standing(name: str, rows: Rows, margins: Path) -> Standing:
    settled = [row for row in rows if row["outcome"] == "settled"]
    # one that ended early has had less time to err
    meant = settled or [row for row in rows if row["outcome"] in COMPLETED]
    values = {
        column: [row[column] for row in meant if row.get(column) is not None] for column in _OF_RUNS
    }
    intervals = {column: mean(sample) for column, sample in values.items() if sample}
    figures = {name: intervals[name].value if name in intervals else None for name in values}
    unknown = math.nan if margins.exists() else None  # cut, or not computed
    return Standing(
        controller=name,
        outcomes=tuple(CUT if _is_cut(row) else row["outcome"] for row in rows),
        figures=figures | (_read_figures(margins) or dict.fromkeys(FIGURES, unknown)),
        intervals=intervals,
        engines=tuple(dict.fromkeys(row[ENGINE] for row in rows if row.get(ENGINE))),
        message=next((row["message"] for row in rows if row["message"]), ""),
        rows=rows,
    )


def check_mission(board: Board) -> Iterator[Reproduced]:
    """The published figures of a mission beside those found."""
    mission = board.mission
    figures = {each.controller: each.figures for each in board.standings}
    for published in mission.checks:
        found: float | None
        if published.figure == _AT_START:
            found = float(np.linalg.norm(at_start(mission.scenario).momenta["base_rotation"]))
        elif published.figure == _PLANNED:
            found = planned_time(mission.scenario)
        else:
            found = figures.get(published.controller, {}).get(published.figure)
        yield Reproduced(mission=mission.name, published=published, found=found)
