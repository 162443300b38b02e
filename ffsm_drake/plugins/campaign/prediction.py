"""Stability predicted from the wired closed loop: for every run, and as a map.

A map is the predicted boundary over two of a campaign's values, the others at their medians.
"""

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import NearestNDInterpolator

from ffsm_drake.common.errors import CampaignError, FfsmError, LimitError
from ffsm_drake.common.steps import step
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.campaign.cases import make_case, scenario_of
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.plugins.design.stability.adaptation import expected_gains
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.plugins.design.stability.load import predicted_load
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.plugins.design.stability.rehearsal import shares_diverged
from ffsm_drake.runs.batches import all_but_controller
from ffsm_drake.systems.reference import timed

POINTS, FEWEST_POINTS = 11, 4  # along each axis; few where there are few cases to compare with
_UNKNOWN = -1.0  # no predictor is negative
REFINEMENT, LEAST_REFINEMENT = 3, 2  # finer by this near the boundary; the latter with few points


def predict(mission: Mission) -> tuple[float, ...]:
    """Predictors of settling; all below 1: the run is predicted to settle.

    The first two are spectral radii of the wired closed loop, in the posture of the planned motion
    with the most over-estimated inertia: at the starting gains, and with every K_s at its largest
    expected value after adaptation. With a capture ``predicted_load`` follows; with rehearsed
    parts also 1 if a run with another noise sequence diverges, else 0 (``shares_diverged``).

    Raises ModelError, ScenarioError or BlockError: a value cannot be used, or a block cannot be
    linearised.
    """
    (found,) = predict_many([mission])
    if isinstance(found, Exception):
        raise found
    return found


def predict_many(missions: Sequence[Mission]) -> list[tuple[float, ...] | Exception]:
    """``predict`` of several missions, or its error."""
    found: list[tuple[float, ...] | Exception] = []
    cases = list[int]()  # that are rehearsed
    # for all controllers of a case: its planned dynamics, and the posture that is linearised
    planned = dict[Any, tuple[PlannedDynamics, float]]()
    for index, mission in enumerate(missions):
        scenario = mission.scenario
        try:
            with Linearizer(mission) as linearizer:
                if (same := all_but_controller(scenario)) not in planned:
                    planned[same] = linearizer.planned, most_overestimated(linearizer.planned)
                linearizer.planned, time = planned[same]
                own = _radii(linearizer, time)
                is_stable = max(own) < 1.0
                if (load := predicted_load(linearizer)) is not None:
                    own.append(load)
            if is_rehearsed(scenario):
                own.append(1.0)
                if is_stable:
                    cases.append(index)
            found.append(tuple(own))
        except Exception as error:
            found.append(error)
    shares = shares_diverged([missions[index] for index in cases], seeds=1)
    for index, share in zip(cases, shares, strict=True):
        radii = found[index]
        assert isinstance(radii, tuple)
        found[index] = share if isinstance(share, Exception) else (*radii[:-1], share)
    return found


def expected_radius(mission: Mission) -> float:
    """Return the second value of ``predict`` alone. Raises the same errors."""
    with Linearizer(mission) as linearizer:
        return _radii(linearizer, most_overestimated(linearizer.planned))[1]


def _radii(linearizer: Linearizer, time: float) -> list[float]:
    """Return the first two of ``predict``, in the posture at a time, s."""
    loop = linearizer.at(time)
    starting = expected = loop.spectral_radius
    if starting < 1.0 and (held := expected_gains(linearizer, loop)):
        expected = linearizer.at(time, held=held).spectral_radius
    return [starting, expected]


def most_overestimated(planned: PlannedDynamics) -> float:
    """Time (s) of the posture with the largest inertia ratio, of equal ones the earliest."""
    times = [planned.motion.part(share) for share in POSTURES]
    # beyond nine digits: rounding
    return max(times, key=lambda time: round(planned.ratios(time)[-1], 9))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StabilityMap:
    """The largest predictor (``predict``) over a grid; NaN: no prediction.

    ``radius`` is filled between the points ``known`` with the nearest; ``whole`` says whether all
    that the boundary needs are known.
    """

    x_name: str
    y_name: str
    x: np.ndarray  # (m,)
    y: np.ndarray  # (n,)
    x_log: bool
    y_log: bool
    radius: Mapping[str, np.ndarray]  # controller -> (n, m)
    known: Mapping[str, np.ndarray]  # likewise
    whole: bool
    fixed: Mapping[str, object]  # the other sampled values

    def side(self, controller: str) -> np.ndarray:
        """Return the radius (n, m) clipped to 1 +- 0.1: the boundary lies midway between grid
        points.
        """
        radius = self.radius[controller]
        if np.isnan(radius).all():  # no prediction for this controller, so no boundary
            return np.full_like(radius, 0.9)
        return np.clip(np.nan_to_num(radius, nan=np.inf), 0.9, 1.1)


def _check_axes(axes: tuple[str, str], values: Mapping[str, np.ndarray]) -> None:
    """Raise CampaignError unless the axes are two numbers of the cases."""
    for name in axes:
        if name not in values:
            raise CampaignError(
                f"--map: '{name}' is not a sampled number; choose two of {', '.join(values)}"
            )
    if axes[0] == axes[1]:
        raise CampaignError("--map: needs two different values")


def predict_map(
    spec: Spec,
    axes: tuple[str, str],
    values: Mapping[str, np.ndarray],
    *,
    known: dict[str, np.ndarray] | None = None,
    until: float = math.inf,
    progress: Callable[[int, int], None] | None = None,
) -> StabilityMap:
    """Predict over the range that the cases cover.

    ``axes`` names two of ``values``, the cases' numbers by name; ``known`` is that of an earlier
    map, and keeps what is found, also before an exception; ``until`` is the end by
    ``time.monotonic``, s; ``progress`` is called with (done, total) controllers. Raises
    CampaignError when an axis is not a sampled number, or both are the same.
    """
    _check_axes(axes, values)
    log = [spec.distributions[name].is_logarithmic for name in axes]
    points = min(POINTS, max(FEWEST_POINTS, math.ceil(math.sqrt(spec.cases))))
    finer = REFINEMENT if points == POINTS else LEAST_REFINEMENT
    size = (points - 1) * finer + 1
    x, y = (_axis(values[name], is_log, size) for name, is_log in zip(axes, log, strict=True))
    fixed = {
        name: distribution.value(0.5, 0)
        for name, distribution in spec.distributions.items()
        if name not in axes
    }

    def predicted(controller: str, i: int, j: int) -> float:
        drawn = {**fixed, axes[0]: float(x[j]), axes[1]: float(y[i])}
        try:
            case = make_case(spec, 0, {name: drawn[name] for name in spec.distributions})
            return max(predict(timed(Mission(scenario_of(spec, case, controller)))))
        except LimitError:
            return math.inf
        except (FfsmError, ArithmeticError, ValueError):
            return math.nan  # no boundary here

    known, whole = {} if known is None else known, True
    for k, controller in enumerate(spec.controllers):
        grid = known.get(controller, np.empty(0))
        if grid.shape != (size, size):
            known[controller] = grid = np.full((size, size), _UNKNOWN)
        find = functools.partial(predicted, controller)
        with step(f"{controller}, controller {k + 1} of {len(spec.controllers)}"):
            whole = _refine(find, grid, finer, until) and whole
        if progress is not None:
            progress(k + 1, len(spec.controllers))
    return StabilityMap(
        x_name=axes[0], y_name=axes[1], x=x, y=y, x_log=log[0], y_log=log[1],
        radius={name: _filled(known[name]) for name in spec.controllers}, known=known,
        whole=whole, fixed=fixed,
    )  # fmt: skip


def _refine(
    predict: Callable[[int, int], float], grid: np.ndarray, finer: int, until: float
) -> bool:
    """Fill in ``_points`` of a grid. Returns False if the time does not suffice."""
    for place in _points(grid, finer):
        if grid[place] == _UNKNOWN:
            if time.monotonic() > until:
                return False
            with step(lambda: f"point {(grid != _UNKNOWN).sum() + 1} of at most {grid.size}"):
                grid[place] = predict(*place)
    return True


def _points(grid: np.ndarray, finer: int) -> Iterator[tuple[int, int]]:
    """Every ``finer``-th point of a grid (size, size), from far apart to near, and all points of
    the cells that the boundary crosses, by what is filled in so far.
    """
    size = len(grid)
    yield 0, 0
    yield size - 1, size - 1
    if np.isnan(grid[0, 0]) and np.isnan(grid[-1, -1]):
        return  # no prediction for this controller
    coarse = range(0, size, finer)
    for k in (k for k in (len(coarse) - 1, 5, 3, 1) if 0 < k < len(coarse)):
        yield from itertools.product(coarse[::k], repeat=2)
    for i, j in itertools.product(coarse[:-1], repeat=2):
        corners = grid[np.ix_((i, i + finer), (j, j + finer))] < 1.0
        if corners.any() and not corners.all():
            yield from itertools.product(range(i, i + finer + 1), range(j, j + finer + 1))


def _filled(grid: np.ndarray) -> np.ndarray:
    """Return the grid with the nearest known value at unknown points; NaN where there is none."""
    known = grid != _UNKNOWN
    if not known.any():
        return np.full_like(grid, np.nan)
    nearest = NearestNDInterpolator(np.argwhere(known), grid[known])
    return nearest(*np.indices(grid.shape))


def _axis(values: np.ndarray, is_log: bool, size: int) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    return np.geomspace(low, high, size) if is_log else np.linspace(low, high, size)
