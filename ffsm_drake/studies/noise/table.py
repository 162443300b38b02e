# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The noise study as tables."""

import math
from typing import Any

from ffsm_drake.show.style import label_of
from ffsm_drake.show.tables import NONE, number
from ffsm_drake.spacecraft.coordinates import GROUPS
from ffsm_drake.studies.noise.cases import EXCHANGED, exchange_point
from ffsm_drake.studies.noise.study import NoiseRow, NoiseStudy, settled_after

_ESTIMATES = {"one_sample": "one sample", "kalman": "Kalman"}
_TITLES = {
    "one_sample": "One-sample estimate, published gains",
    "kalman": "Kalman estimate, bandwidth gains",
}


def study_rows(study: NoiseStudy) -> list[dict[str, Any]]:
    """Every run as the columns of a file, SI units; the sensor set has no sigma, a run that
    diverged no figures.
    """
    columns = (
        "controller",
        "estimator",
        "gains",
        "sigma",
        "seed",
        "outcome",
        "itae",
        "isv",
        "isv_predicted",
    )
    return [
        {name: getattr(row, name) for name in columns}
        | {
            "sensors": "flight_sensors" if row.sigma is None else "white",
            "diverged": int(row.diverged),
        }
        | {
            f"{name}_{group}": getattr(row, name)[group]
            for name in ("rms_error", "peak_force")
            for group in GROUPS
        }
        for row in study.rows
    ]


def study_markdown(study: NoiseStudy) -> str:
    """The study as tables: the slope, whether estimate or gains matter, and every point."""
    parts = [
        "# What the published gains cost with real sensors",
        f"Runs of {study.duration:g} s; perfect tracking without noise costs ISV "
        f"{study.ideal_isv:.2f}. Positions are "
        "measured exactly but by `flight_sensors`, actuators are unlimited. Units: rad or m, N m "
        "or N. Rms errors "
        f"count after {settled_after(study.duration):g} s.",
        "## The slope",
        "The published estimate puts Ĥ Δv/L into the force, so that the effort of the noise grows "
        "as σ²/L². Predicted "
        "rms acceleration for a base attitude axis; extra effort (ISV - ideal)/σ² at the largest "
        "σ without divergence:",
        _slopes(study),
        f"## Estimate or gains? At σ = {exchange_point(study.sigmas):.0e}",
        "ISV, and the rms error of the base attitude:",
        _exchange(study),
    ]
    header = ["controller", "σ [rad/s, m/s]", "ITAE", "ISV", "ISV, predicted"]
    header += [
        "rms attitude",
        "rms position",
        "rms joints",
        "peak torque",
        "peak force",
        "peak joint torque",
    ]
    for estimator, title in _TITLES.items():
        points = [
            point for _, kind, points in study.curves() if kind == estimator for point in points
        ]
        parts += [f"## {title}", _table(header, [_point_cells(point) for point in points])]
    parts.append(
        "Predicted: the run without noise, and the noise's part in the linearised loop; G left "
        "out, K_s where "
        "adaptation is expected to take it. Peaks are over the whole run."
    )
    return "\n\n".join(parts) + "\n"


def _slopes(study: NoiseStudy) -> str:
    rows = []
    for controller, estimator, points in study.curves():
        if estimator != "one_sample":
            continue
        gain = study.noise_gain[controller]
        cells = [NONE] * 3
        for point in points:
            if point.sigma is not None and not point.diverged:  # the last one counts
                slopes = [
                    (isv - study.ideal_isv) / point.sigma**2
                    for isv in (point.isv_predicted, point.isv)
                ]
                cells = [*(number(slope, 3) for slope in slopes), point.sensors]
        rows.append(
            [label_of(controller), f"{gain:.0f}", f"{gain * study.sample_time:.1f}", *cells]
        )
    header = [
        "controller",
        "rms acceleration/σ [1/s]",
        "the same in 1/L",
        "extra effort/σ², predicted",
        "measured",
    ]
    return _table([*header, "at σ"], rows)


def _exchange(study: NoiseStudy) -> str:
    ways = [("one_sample", "published"), *EXCHANGED.items(), ("kalman", "bandwidth")]
    rows = []
    for controller in study.noise_gain:
        points = [
            study.point(controller, kind, exchange_point(study.sigmas), gains=gains)
            for kind, gains in ways
        ]
        figures = [
            f"{number(point.isv)}; {number(point.rms_error['base_rotation'], 2)}"
            for point in points
        ]
        cells = [
            f"**{p.outcome}**" if p.diverged else text
            for p, text in zip(points, figures, strict=True)
        ]
        rows.append([label_of(controller), *cells])
    return _table(
        ["controller", *(f"{_ESTIMATES[estimator]}, {gains} gains" for estimator, gains in ways)],
        rows,
    )


def _point_cells(point: NoiseRow) -> list[str]:
    predicted = number(point.isv_predicted) if math.isfinite(point.isv_predicted) else "unstable"
    head = [label_of(point.controller), point.sensors]
    if point.diverged:
        return [*head, f"**{point.outcome}**", NONE, predicted, *[NONE] * 6]
    errors = [number(point.rms_error[group], 2) for group in GROUPS]
    forces = [number(point.peak_force[group]) for group in GROUPS]
    return [*head, number(point.itae, 3), number(point.isv), predicted, *errors, *forces]


def _table(header: list[str], rows: list[list[str]]) -> str:
    lines = (header, ["---", *["---:"] * (len(header) - 1)], *rows)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
