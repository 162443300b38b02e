"""The benchmark: published missions, every law, three seeds; lower bounds beside the figures.

A mission's runs are a campaign of three cases with different random seeds. It is resumed after an
interruption, and a database holds the laws of one request.
"""

import collections
import contextlib
import dataclasses
import functools
import json
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import (
    CampaignError,
    FfsmError,
    InterruptedCampaign,
    choices,
    one_line,
)
from ffsm_drake.common.files import check_regular, write_text
from ffsm_drake.common.shapes import misfit
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.actuators.thrusters import STANDARD_GRAVITY, ThrusterSet
from ffsm_drake.plugins.benchmark.law_figures import FIGURES, law_figures
from ffsm_drake.plugins.benchmark.least_time import least_times
from ffsm_drake.plugins.campaign.cases import make_cases
from ffsm_drake.plugins.campaign.rows import COMPLETED
from ffsm_drake.plugins.campaign.run import Progress, check_cases, resume_campaign
from ffsm_drake.plugins.campaign.spec import Spec, spec_from_data
from ffsm_drake.plugins.campaign.store import create_store, open_store
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.plugins.workers.pool import Runs, Stop, WorkerLost, Workers
from ffsm_drake.scenario import (
    Scenario,
    load_scenario,
    override_scenario,
    scenario_to_dict,
    scenario_to_yaml,
    thrusters_of,
)
from ffsm_drake.scenario.strict_yaml import read_yaml
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.systems.controllers import controller_names
from ffsm_drake.systems.plan import load_plan
from ffsm_drake.systems.reference import make_motion

SEEDS = 3
# Outcomes of a seed: left out by an interruption, and longer than a campaign's time limit.
NOT_RUN, CUT = "not run", "cut by the time limit"
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
class Published:
    """A published figure."""

    figure: str  # column of a campaign's results, angular_momentum or planned_time
    value: float
    source: str
    controller: str = ""  # controller of a campaign's column
    within: float = 0.0  # share of the value
    at_most: bool = False  # the figure may be anything below


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchmarkMission:
    """A scenario with its source."""

    name: str
    scenario: Scenario
    source: str = ""
    published: str = ""
    assumed: tuple[str, ...] = ()
    checks: tuple[Published, ...] = ()

    @property
    def checked_laws(self) -> tuple[str, ...]:
        """Laws with published figures; without one, the scenario's."""
        laws = dict.fromkeys(filter(None, (each.controller for each in self.checks)))
        return tuple(laws) or (self.scenario.controller,)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Standing:
    """A law's row in the leaderboard of a mission: means over the settled seeds (if none settled,
    over the completed ones), and ``law_figures``.
    """

    controller: str
    outcomes: tuple[str, ...]  # outcome of each seed; none: the law does not apply
    figures: Mapping[str, float | None]  # by column; None: there is none; NaN: cut
    message: str = ""  # why it does not apply, or the first failure

    @property
    def settled(self) -> int:
        return self.outcomes.count("settled")

    @property
    def ended_early(self) -> Mapping[str, int]:
        """Number of runs by outcome, completed runs left out."""
        return collections.Counter(name for name in self.outcomes if name not in COMPLETED)

    @property
    def ended(self) -> str:
        """Runs that did not come to their end, in words."""
        early = (f"{count} {name}" for name, count in self.ended_early.items())
        return ", ".join(early) if self.outcomes else "does not apply"


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


@functools.cache
def _listed() -> dict[str, Any]:
    text = (Path(__file__).parent / "missions.yaml").read_text(encoding="utf-8")
    return read_yaml(text)


def mission_names() -> tuple[str, ...]:
    """The missions of the benchmark."""
    return tuple(_listed())


def load_mission(name: str) -> BenchmarkMission:
    """A mission by name, or one of the user's own by the file of its scenario.

    Raises:
      CampaignError, ScenarioError: there is none of that name, or the scenario cannot be used.
    """
    if name in _listed():
        data = _listed()[name]
        return BenchmarkMission(
            name=name,
            scenario=load_scenario(data.get("scenario", name), data.get("overrides", ())),
            source=data["source"],
            published=data["published"],
            assumed=tuple(data["assumed"]),
            checks=tuple(Published(**each) for each in data.get("checks", ())),
        )
    if Path(name).suffix not in (".yaml", ".yml"):
        raise CampaignError(
            f"{name}: no such mission; give a scenario's file, or choose one of "
            f"{choices(name, mission_names())}"
        )
    return BenchmarkMission(name=Path(name).stem, scenario=load_scenario(name), source=name)


def _spec(scenario: Scenario, controllers: Sequence[str]) -> Spec:
    return spec_from_data(
        {
            "base": scenario_to_dict(scenario),
            "controllers": list(controllers),
            "cases": SEEDS,
            "sampling": "random",
            "predictions": False,  # ``law_figures`` has them, once
            # unchanged: only the seeds differ
            "parameters": {"duration": {"distribution": "list", "values": [scenario.duration]}},
        }
    )


def run_mission(
    mission: BenchmarkMission,
    controllers: Sequence[str],
    folder: Path,
    *,
    workers: Workers,
    stop: Stop | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Board:
    """Run laws on a mission, or the rest of it, and rank them with earlier results.

    Args:
      controllers: the laws; none: every law.
      folder: folder of the databases.

    Raises:
      CampaignError, InterruptedCampaign, WorkersError: see ``start_campaign``.
    """
    usable, misfits = _usable(mission, controllers)
    if usable:
        spec = _spec(mission.scenario, usable)
        path = folder / f"{mission.name}-{spec.fingerprint[:12]}.db"
        if not path.exists():
            with create_store(path, spec, make_cases(spec)):
                pass
        resume_campaign(path, workers=workers, stop=stop, progress=progress)
        _find_figures(mission, usable, folder, workers=workers, stop=stop)
    return _board(mission, folder, misfits)


def board_so_far(mission: BenchmarkMission, controllers: Sequence[str], folder: Path) -> Board:
    """The results that an interrupted ``run_mission`` leaves, a row for each law. Arguments and
    errors: see there.
    """
    usable, misfits = _usable(mission, controllers)
    return _board(mission, folder, misfits, usable)


def _usable(
    mission: BenchmarkMission, controllers: Sequence[str]
) -> tuple[list[str], dict[str, str]]:
    """The laws that apply to a mission, and why others do not."""
    misfits, usable = dict[str, str](), list[str]()
    for name in controllers or controller_names():
        try:
            check_cases(_spec(override_scenario(mission.scenario, [f"controller={name}"]), [name]))
            usable.append(name)
        except FfsmError as error:
            if controllers:  # requested by name
                raise
            misfits[name] = one_line(error)
    return usable, misfits


def _figures_of(mission: BenchmarkMission, name: str, folder: Path) -> Path:
    """Path of the file with the ``law_figures`` of a law on a mission."""
    return folder / f"{mission.name}-{_spec(mission.scenario, [name]).fingerprint[:12]}.json"


def _read_figures(path: Path) -> dict[str, float | None] | None:
    """The ``law_figures`` that a file keeps; None: there is none, or it holds something else."""
    try:
        check_regular(path, limit=_MAX_FIGURES)
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return None if misfit(found, {key: [float, None] for key in FIGURES}, "figures") else found


def _find_figures(
    mission: BenchmarkMission,
    laws: Sequence[str],
    folder: Path,
    *,
    workers: Workers,
    stop: Stop | None,
) -> None:
    """Compute the ``law_figures`` missing in the folder. Raises the errors of ``run_mission``."""
    missing = [name for name in laws if _read_figures(_figures_of(mission, name, folder)) is None]

    def arguments(name: str) -> tuple[str]:
        return (scenario_to_yaml(override_scenario(mission.scenario, [f"controller={name}"])),)

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
            write_text(_figures_of(mission, name, folder), json.dumps(given))
            done += 1
    if done < len(missing):
        raise InterruptedCampaign(done, len(missing))


def _board(
    mission: BenchmarkMission, folder: Path, misfits: Mapping[str, str], wanted: Sequence[str] = ()
) -> Board:
    """The results in a folder; laws that are wanted have a row without any, too."""
    rows = {name: [_MISSING] * SEEDS for name in wanted} | _rows(mission, folder)
    standings = [
        _standing(name, found, _figures_of(mission, name, folder)) for name, found in rows.items()
    ]
    standings += [
        Standing(controller=name, outcomes=(), figures=dict.fromkeys(SHOWN), message=why)
        for name, why in misfits.items()
        if name not in rows
    ]

    def place(standing: Standing) -> tuple[Any, ...]:
        itae = standing.figures["itae"]  # None where no run came to its end
        has_run = any(name not in ("error", NOT_RUN, CUT) for name in standing.outcomes)
        return -standing.settled, not has_run, math.inf if itae is None else itae

    try:
        bounds, motion = bounds_of(mission), _planned_time(mission.scenario)
        propellant = least_propellant(mission.scenario)
    except FfsmError:  # the limits allow no motion
        bounds, motion, propellant = {}, math.nan, None
    return Board(
        mission=mission,
        standings=tuple(sorted(standings, key=place)),
        bounds=bounds,
        motion=motion,
        propellant=propellant,
    )


def _rows(mission: BenchmarkMission, folder: Path) -> dict[str, list[dict[str, Any]]]:
    """The runs of each law in a folder's databases of the current version of the mission; of a law
    in several, the most complete.
    """
    found = dict[str, list[dict[str, Any]]]()
    for path in sorted(folder.glob(f"{mission.name}-*.db")):
        with contextlib.suppress(CampaignError), open_store(path) as store:
            if (
                store.spec.fingerprint
                != _spec(mission.scenario, store.spec.controllers).fingerprint
            ):
                continue
            for name in store.spec.controllers:
                rows = [_MISSING] * SEEDS
                for case in range(SEEDS):
                    with contextlib.suppress(CampaignError):  # interrupted
                        rows[case] = store.result(case, name)
                if rows.count(_MISSING) <= found.get(name, rows).count(_MISSING):
                    found[name] = rows
    return found


def _is_cut(row: Mapping[str, Any]) -> bool:
    return row["outcome"] == "error" and "(time_limit)" in row["message"]


def _standing(name: str, rows: Sequence[Mapping[str, Any]], figures: Path) -> Standing:
    settled = [row for row in rows if row["outcome"] == "settled"]
    # one that ended early has had less time to err
    meant = settled or [row for row in rows if row["outcome"] in COMPLETED]

    def mean(column: str) -> float | None:
        values = [row[column] for row in meant if row.get(column) is not None]
        return statistics.fmean(values) if values else None

    of_law = _read_figures(figures) or dict.fromkeys(FIGURES, math.nan)
    return Standing(
        controller=name,
        outcomes=tuple(CUT if _is_cut(row) else row["outcome"] for row in rows),
        figures={column: mean(column) for column in _OF_RUNS} | of_law,
        message=next((row["message"] for row in rows if row["message"]), ""),
    )


def bounds_of(mission: BenchmarkMission) -> dict[str, float]:
    """Least times of a mission, s (``least_times``): the bound from momentum and the actuators'
    limits, the least time at the start's posture, and the duration of an optimal plan, if there is
    one.
    """
    scenario, bounds = mission.scenario, dict[str, float]()
    flown = make_mission(scenario)
    model, start = flown.craft.nominal(), _at_start(scenario)
    least = least_times(
        scenario,
        model,
        start.q,
        spin=start.momenta["base_rotation"],
        linear=start.momenta["base_position"],
    )
    if least.bound > 0.0:
        bounds["momentum"] = least.bound
    if 0.0 < least.held < math.inf:
        bounds["held"] = least.held
    if scenario.reference.kind == "optimal":
        bounds["planner"] = _planned_time(scenario)
    return bounds


def _planned_time(scenario: Scenario) -> float:
    """Time of the planned motion, s; of an optimal one without what its small rates take."""
    mission = make_mission(scenario)
    if scenario.reference.kind == "optimal":
        return load_plan(scenario.reference.plan or "", mission.craft.coordinates).duration
    motion = make_motion(mission)
    return float(motion.end - motion.begin)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Start:
    """Momentum to be removed, at the start or after the planned grasp."""

    # by group of the base: angular about the centre of mass, N m s, and linear, N s
    momenta: Mapping[str, np.ndarray]
    q: np.ndarray  # (nq)
    center_of_mass: np.ndarray  # (3) in the base's frame, m


def _at_start(scenario: Scenario) -> _Start:
    mission = make_mission(scenario)
    model = mission.craft.nominal()
    if scenario.capture is not None:
        contact = planned_contact(mission, model)
        q, spin, linear = contact.q, contact.spin_after, contact.momentum_after[3:]
        base = free_floating(model, q)
    else:
        motion = make_motion(mission)
        q, v, _ = motion.evaluate(0.0)
        base = free_floating(model, q)
        spin, linear = base.spin_map @ v, base.momentum(v)[3:]
    return _Start(
        momenta={"base_rotation": spin, "base_position": linear},
        q=q,
        center_of_mass=in_body_axes(q[None, :4], base.center_of_mass[None])[0],
    )


def least_propellant(scenario: Scenario) -> float | None:
    """Lower bound of the propellant, kg, for thrusters to remove a mission's momentum, each in its
    best direction, about the centre of mass at the start; wheels take the angular momentum at no
    cost. None without thrusters or momentum.
    """
    settings = scenario.actuation.thrusters
    if settings is None:
        return None
    thrusters, start = ThrusterSet(settings, sample_time=scenario.sample_time), _at_start(scenario)
    torques, forces = np.split(thrusters.wrenches, 2)
    torques = torques - np.cross(start.center_of_mass, forces.T).T
    exhaust = STANDARD_GRAVITY * np.array(
        [unit.specific_impulse for unit in thrusters_of(settings).values()]
    )
    least = np.linalg.norm(start.momenta["base_position"]) / exhaust.max()
    if scenario.actuation.wheels is None:
        lever = (np.linalg.norm(torques, axis=0) * exhaust).max()
        least = max(least, np.linalg.norm(start.momenta["base_rotation"]) / lever)
    return float(least) or None


def check_mission(board: Board) -> Iterator[Reproduced]:
    """The published figures of a mission beside those found."""
    mission = board.mission
    figures = {each.controller: each.figures for each in board.standings}
    for published in mission.checks:
        found: float | None
        if published.figure == _AT_START:
            found = float(np.linalg.norm(_at_start(mission.scenario).momenta["base_rotation"]))
        elif published.figure == _PLANNED:
            found = _planned_time(mission.scenario)
        else:
            found = figures.get(published.controller, {}).get(published.figure)
        yield Reproduced(mission=mission.name, published=published, found=found)
