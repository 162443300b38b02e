"""The predicted stability boundary over two of a campaign's values, the others at their medians."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from ffsm_drake.campaign.cases import make_case, scenario_of
from ffsm_drake.campaign.distributions import LogUniform
from ffsm_drake.campaign.errors import CampaignError
from ffsm_drake.campaign.prediction import predict_stability
from ffsm_drake.campaign.spec import Spec
from ffsm_drake.errors import FfsmError

POINTS = 11  # along each axis


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StabilityMap:
    """Predicted spectral radius over a grid; below 1 is stable, NaN where nothing can be predicted."""

    x_name: str
    y_name: str
    x: np.ndarray  # (m,)
    y: np.ndarray  # (n,)
    x_log: bool
    y_log: bool
    radius: Mapping[str, np.ndarray]  # controller -> (n, m)
    fixed: Mapping[str, object]  # the other sampled values


def predict_map(
    spec: Spec,
    axes: tuple[str, str],
    values: Mapping[str, np.ndarray],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> StabilityMap:
    """Predict over the range that the cases cover.

    Args:
      spec: the campaign.
      axes: names of two sampled values.
      values: all cases' numbers by name.
      progress: called with (done, total) predictions.

    Raises:
      CampaignError: an axis is not a sampled number, or both are the same.
    """
    for name in axes:
        if name not in values:
            raise CampaignError(f"--map: '{name}' is no sampled number; choose two of {', '.join(values)}")
    if axes[0] == axes[1]:
        raise CampaignError("--map: needs two different values")
    log = [isinstance(spec.distributions[name], LogUniform) for name in axes]
    x, y = (_axis(values[name], is_log) for name, is_log in zip(axes, log, strict=True))
    fixed = {name: distribution.value(0.5, 0) for name, distribution in spec.distributions.items() if name not in axes}
    radius = {name: np.full((y.size, x.size), np.nan) for name in spec.controllers}
    total, done = x.size * y.size * len(spec.controllers), 0
    for i, y_value in enumerate(y):
        for j, x_value in enumerate(x):
            drawn = {**fixed, axes[0]: float(x_value), axes[1]: float(y_value)}
            for controller in spec.controllers:
                try:
                    case = make_case(spec, 0, {name: drawn[name] for name in spec.distributions})
                    radius[controller][i, j] = predict_stability(scenario_of(spec, case, controller)).radius
                except (FfsmError, ArithmeticError, ValueError):
                    pass  # no boundary here
                done += 1
                if progress is not None:
                    progress(done, total)
    return StabilityMap(
        x_name=axes[0], y_name=axes[1], x=x, y=y, x_log=log[0], y_log=log[1], radius=radius, fixed=fixed
    )


def _axis(values: np.ndarray, is_log: bool) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    return np.geomspace(low, high, POINTS) if is_log else np.linspace(low, high, POINTS)
