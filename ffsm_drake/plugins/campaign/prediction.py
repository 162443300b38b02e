"""Stability predicted from the wired closed loop: for every run, and as a map.

A map is the predicted boundary over two of a campaign's values, the others at their medians.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ffsm_drake.common.errors import CampaignError, FfsmError, LimitError
from ffsm_drake.common.steps import step
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.plugins.campaign.cases import make_case, scenario_of
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.plugins.design.stability.adaptation import expected_gains
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.plugins.design.stability.load import predicted_load
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.plugins.design.stability.rehearsal import Rehearsed, shares_diverged
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.reference import timed

POINTS, FEWEST_POINTS = 11, 4  # along each axis; few where there are few cases to compare with
REFINEMENT, LEAST_REFINEMENT = 3, 2  # finer by this near the boundary; the latter with few points


def predict(scenario: Scenario) -> tuple[float, ...]:
    """Predictors of settling; all below 1: the run is predicted to settle.

    The first two are spectral radii of the wired closed loop, in the posture of the planned motion
    with the most over-estimated inertia: at the starting gains, and with every K_s at its largest
    expected value after adaptation. With a capture ``predicted_load`` follows; with rehearsed
    parts also 1 if the linearised loop diverges under their limits, else 0 (``rehearse``).

    Raises ModelError, ScenarioError or BlockError: a value cannot be used, or a block cannot be
    linearised.
    """
    (found,) = predict_many([scenario])
    if isinstance(found, Exception):
        raise found
    return found


def predict_many(scenarios: Sequence[Scenario]) -> list[tuple[float, ...] | Exception]:
    """``predict`` of several scenarios, or its error; those that are rehearsed go side by side."""
    found: list[tuple[float, ...] | Exception] = []
    cases = dict[int, Rehearsed]()
    for index, scenario in enumerate(scenarios):
        try:
            with Linearizer(scenario) as linearizer:
                own = _radii(linearizer)
                is_stable = max(own) < 1.0
                if (load := predicted_load(linearizer)) is not None:
                    own.append(load)
            if is_rehearsed(scenario):
                own.append(1.0)
                if is_stable:
                    cases[index] = Rehearsed(scenario)
            found.append(tuple(own))
        except Exception as error:
            found.append(error)
    for index, share in zip(cases, shares_diverged(list(cases.values()), seeds=1), strict=True):
        radii = found[index]
        assert isinstance(radii, tuple)
        found[index] = (*radii[:-1], share)
    return found


def expected_radius(scenario: Scenario) -> float:
    """The second value of ``predict`` alone. Raises the same errors."""
    with Linearizer(scenario) as linearizer:
        return _radii(linearizer)[1]


def _radii(linearizer: Linearizer) -> list[float]:
    """The first two of ``predict``."""
    time = most_overestimated(linearizer.planned)
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
    """The largest predictor (``predict``) over a grid; NaN: no prediction."""

    x_name: str
    y_name: str
    x: np.ndarray  # (m,)
    y: np.ndarray  # (n,)
    x_log: bool
    y_log: bool
    radius: Mapping[str, np.ndarray]  # controller -> (n, m)
    fixed: Mapping[str, object]  # the other sampled values

    def side(self, controller: str) -> np.ndarray:
        """The radius (n, m) clipped to 1 +- 0.1: the boundary lies midway between grid points."""
        radius = self.radius[controller]
        if np.isnan(radius).all():  # no prediction for this controller, so no boundary
            return np.full_like(radius, 0.9)
        return np.clip(np.nan_to_num(radius, nan=np.inf), 0.9, 1.1)


def predict_map(
    spec: Spec,
    axes: tuple[str, str],
    values: Mapping[str, np.ndarray],
    *,
    known: Mapping[str, np.ndarray] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> StabilityMap:
    """Predict over the range that the cases cover.

    ``axes`` names two of ``values``, the cases' numbers by name; ``known`` is the radius of an
    earlier map, by controller; ``progress`` is called with (done, total) controllers. Raises
    CampaignError when an axis is not a sampled number, or both are the same.
    """
    for name in axes:
        if name not in values:
            raise CampaignError(
                f"--map: '{name}' is not a sampled number; choose two of {', '.join(values)}"
            )
    if axes[0] == axes[1]:
        raise CampaignError("--map: needs two different values")
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
            return max(predict(timed(scenario_of(spec, case, controller))))
        except LimitError:
            return math.inf
        except (FfsmError, ArithmeticError, ValueError):
            return math.nan  # no boundary here

    known = {name: grid for name, grid in (known or {}).items() if grid.shape == (size, size)}
    radius = {}
    for k, controller in enumerate(spec.controllers):
        if controller in known:
            radius[controller] = known[controller]
        elif math.isnan(predicted(controller, 0, 0)) and math.isnan(
            predicted(controller, size - 1, size - 1)
        ):
            radius[controller] = np.full((size, size), np.nan)
        else:
            with step(f"{controller}, controller {k + 1} of {len(spec.controllers)}"):
                radius[controller] = _refined(functools.partial(predicted, controller), size, finer)
        if progress is not None:
            progress(k + 1, len(spec.controllers))
    return StabilityMap(
        x_name=axes[0], y_name=axes[1], x=x, y=y, x_log=log[0], y_log=log[1],
        radius=radius, fixed=fixed,
    )  # fmt: skip


def _refined(predict: Callable[[int, int], float], size: int, finer: int) -> np.ndarray:
    """The grid (size, size): every ``finer``-th point, and all points of the cells that the
    boundary crosses.

    The other cells lie on one side of the boundary and are filled with the value at their first
    corner.
    """
    grid, known = np.full((size, size), np.nan), np.zeros((size, size), dtype=bool)

    def fill(i: int, j: int) -> None:
        if not known[i, j]:
            with step(lambda: f"point {known.sum() + 1} of at most {known.size}"):
                grid[i, j], known[i, j] = predict(i, j), True

    coarse = range(0, size, finer)
    for i, j in itertools.product(coarse, coarse):
        fill(i, j)
    for i, j in itertools.product(coarse[:-1], coarse[:-1]):
        cell = np.ix_((i, i + finer), (j, j + finer))
        if len({bool(value < 1.0) for value in grid[cell].ravel()}) > 1:
            for m, n in itertools.product(range(finer + 1), repeat=2):
                fill(i + m, j + n)
    nearest = (np.arange(size) // finer) * finer
    return np.where(known, grid, grid[np.ix_(nearest, nearest)])


def _axis(values: np.ndarray, is_log: bool, size: int) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    return np.geomspace(low, high, size) if is_log else np.linspace(low, high, size)
