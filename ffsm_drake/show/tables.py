"""Numbers and tables as plain text, and the tables' figures as plain data."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.common.numbers import NONE, number, percent
from ffsm_drake.plugins.capture.momentum import momentum_lines
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.tracking import tracked_of
from ffsm_drake.scenario import Scenario, controller_key
from ffsm_drake.show.style import label_of
from ffsm_drake.systems.controllers import PAPER_LAWS, complete_gains
from ffsm_drake.systems.part import Figure

if TYPE_CHECKING:  # slow to import
    from ffsm_drake.plugins.design.gains import Design, DesignPoint
    from ffsm_drake.plugins.design.stability.boundaries import Boundaries
    from ffsm_drake.plugins.design.stability.disk import DiskMargins
    from ffsm_drake.plugins.design.stability.margins import AxisMargins, Margins
    from ffsm_drake.plugins.planning import PlannedMotionReport


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, all others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def line(first: str, *rest: str) -> str:
        cells = [
            first.ljust(widths[0]),
            *(cell.rjust(w) for cell, w in zip(rest, widths[1:], strict=True)),
        ]
        return "  ".join(cells).rstrip()

    return [line(*row) for row in rows]


def results_table(records: Sequence[RunRecord], distances: Sequence[float] | None = None) -> str:
    """The figures of merit as plain text, a line per run; ``distances`` to the LQG limit, if
    known.
    """
    rows = [
        ["controller", "ITAE", "ISV", *["peak error"] * 2, *["final error"] * 2, "peak force"]
        + ["peak torque"] * 2,
        ["", "", "", "rad", "m", "rad", "m", "base, N", "base, N m", "joints"],
        *map(_result_cells, records),
    ]
    columns = []
    for first in ranked_figures(records):
        sizes = [size_of(record, first) for record in records]
        cells = [NONE if math.isnan(size) else f"{size:.4g}" for size in sizes]
        columns.append((first.label.lower(), first.shown_unit, *cells))
    if distances is not None:
        columns.append(("over LQG", "", *(number(distance, 3) for distance in distances)))
    lines = aligned([[*row, *more] for row, *more in zip(rows, *columns, strict=True)])
    for k, record in enumerate(records, start=2):
        if not record.outcome.completed:
            lines[k] += f"  ({record.outcome.status} at {record.outcome.time:.2f} s)"
    return "\n".join(lines + list(_result_notes(records)))


def _result_cells(record: RunRecord) -> list[str]:
    """The line of a run in the table of results."""
    m, tracked = record.metrics, tracked_of(record.dataset)
    size, units = np.abs(tracked.error), np.array(tracked.units)
    figures = [
        float(errors[units == unit].max(initial=-math.inf)) if unit in tracked.units else math.nan
        for errors in (size.max(axis=0), size[-1])
        for unit in ("rad", "m")
    ]
    figures += [m["peak_effort"][group] for group in ("base_position", "base_rotation", "joints")]
    cells = [NONE if math.isnan(x) else f"{x:.3g}" for x in figures]
    return [record.scenario.controller, f"{m['itae']:.4g}", f"{m['isv']:.5g}", *cells]


def _result_notes(records: Sequence[RunRecord]) -> Iterator[str]:
    """The lines below the table of results."""
    if not all(
        record.dataset["generalized_force"].equals(record.dataset["applied_force"])
        for record in records
    ):
        yield "forces and ISV as commanded; the applied forces differ, see the report"
    yield from (grasp_line(record.grasp) for record in records if record.grasp is not None)
    # momentum of the plan, common to all
    yield from momentum_lines((records[0].grasp or {}).get("momentum_budget"))
    for record in records:
        name = f"{record.scenario.controller}: " if len(records) > 1 else ""
        sentences = (part.sentence for part in record.parts if part.sentence)
        for line in (*frame_lines(record), *drift_lines(record), *sentences):
            yield name + line


def ranked_figures(records: Sequence[RunRecord]) -> list[Figure]:
    """Figures of parts for the ranking of runs, from the first run with each."""
    found = {
        (figure.part, figure.key): figure
        for record in reversed(records)
        for figure in record.figures
        if figure.ranked
    }
    return list(found.values())


def size_of(record: RunRecord, figure: Figure) -> float:
    """A figure of another run in this one, in the unit that it is shown in; NaN if there is
    none.
    """
    same = (each for each in record.figures if (each.part, each.key) == (figure.part, figure.key))
    return next((each.size for each in same), math.nan)


def frame_lines(record: RunRecord) -> list[str]:
    """Distance of the frame from its reference, and time near a singularity; a line each."""
    figures, goal = record.metrics.get("frame"), record.scenario.reference.frame
    if not figures:
        return []
    name = record.scenario.model.end_effector if goal is None or goal.frame is None else goal.frame
    final, largest = _final_and_largest(figures)
    lines = [f"the frame {name} ends {final} from its reference (at most {largest})"]
    gains = record.scenario.controllers.get(controller_key(record.scenario.controller), {})
    smallest, damping = (
        figures.get("smallest_singular_value"),
        (gains.get("damping") or {}).get("all", 0.0),
    )
    if smallest is not None and smallest < damping:
        near = record.dataset["smallest_singular_value"].values < damping
        lines.append(
            f"near a dynamic singularity for {near.sum() * record.scenario.sample_time:.3g} s: "
            "the smallest singular "
            f"value falls to {smallest:.2g}; below {damping:g} joint rates are damped, and the "
            f"frame lags its reference"
        )
    return lines


def drift_lines(record: RunRecord) -> list[str]:
    """Drift of the undriven base, in one line; none where everything is driven."""
    drift = record.metrics.get("drift")
    if not drift:
        return []
    final, largest = _final_and_largest(drift)
    return [f"undriven base: final drift {final} (at most {largest})"]


def _final_and_largest(figures: Mapping[str, Any]) -> Iterator[str]:
    """The final and the largest sizes (rad, m) of figures by part, in words."""
    for moment in ("final", "largest"):
        yield " and ".join(
            f"{180.0 / math.pi * size:.4g} deg" if "rotation" in part else f"{1e3 * size:.4g} mm"
            for part, size in sorted(figures[moment].items())
        )


def grasp_line(grasp: Mapping[str, Any]) -> str:
    """The grasp of a run (``RunRecord.grasp``) in one line."""
    size = {key: math.hypot(*grasp[key]) for key in ("impulse", "angular_impulse")}
    before, after = (grasp[side]["kinetic_energy"] for side in ("before", "after"))
    brakes = max(map(abs, grasp["brake_impulse"].values()), default=0.0)
    miss, compliant = grasp["miss"], grasp["compliant"]
    gripper = (
        f"; the gripper bears at most {compliant['peak_force']:.3g} N and "
        f"{compliant['peak_torque']:.3g} N m, over in "
        f"{1e3 * compliant['time']:.3g} ms"
        if compliant
        else ""
    )
    return (
        f"grasp at t = {grasp['time']:g} s: impulse {size['impulse']:.3g} N s and "
        f"{size['angular_impulse']:.3g} N m s"
        + (f", of a brake at most {brakes:.3g} N m s" if brakes else "")
        + f", kinetic energy {before:.4g} to {after:.4g} J; missed by "
        f"{1e3 * miss['position']:.2g} mm and "
        f"{1e3 * miss['angle']:.2g} mrad, met at {1e3 * miss['velocity']:.2g} mm/s and "
        f"{1e3 * miss['angular_velocity']:.2g} mrad/s{gripper}"
    )


def results_data(
    records: Sequence[RunRecord], distances: Sequence[float] | None = None
) -> list[dict[str, Any]]:
    """The results of the table above as plain data."""
    of_each = (
        [{}] * len(records)
        if distances is None
        else [{"distance_to_lqg": distance} for distance in distances]
    )
    return [
        {
            "controller": record.scenario.controller,
            "status": record.outcome.status,
            "time": record.outcome.time,
            "message": record.outcome.message,
            "ending": dataclasses.asdict(record.ending),
            "metrics": record.metrics,
            **({} if record.grasp is None else {"grasp": record.grasp}),
            **distance,
        }
        for record, distance in zip(records, of_each, strict=True)
    ]


def margins_table(margins: "Margins") -> str:
    """Plain text: the modes of the worst posture, and for the paper's laws per coordinate the
    limits.
    """
    scenario, data, worst = margins.scenario, margins_data(margins), margins.worst
    low, high = data["eta"]
    lines = [
        f"{scenario.description or 'scenario'}: {scenario.controller}, L = "
        f"{scenario.sample_time:g} s",
        f"eigenvalues eta of H^-1 Hhat along the planned motion: {low:.3f} to {high:.3f}",
        *_hidden_lines(margins, data),
        "",
        f"slowest modes of the wired loop, at t = {worst.time:g} s:",
    ]
    rows = [["|z|", "frequency", "damping", "coordinates"], ["", "rad/s", "", ""]]
    for mode in data["modes"]:
        shares = ", ".join(
            f"{name} {100 * share:.0f} %" for name, share in list(mode["coordinates"].items())[:3]
        )
        rows.append(
            [
                f"{mode['magnitude']:.5f}",
                f"{mode['frequency']:.3g}",
                f"{mode['damping']:.3f}",
                shares,
            ]
        )
    lines += aligned(rows)
    if margins.axes is not None:
        plant = (
            "explicit Euler at the control period" if margins.axes.euler else "exactly integrated"
        )
        lines += [
            "",
            f"limits of each coordinate alone, plant {plant}:",
            *_axis_lines(margins.axes, data),
        ]
    radii = [
        ("", "spectral_radius"),
        (" at the K_s expected after adaptation", "spectral_radius_expected"),
    ]
    radii.append((" with every K_s at its bound", "spectral_radius_at_bounds"))
    told = "; ".join(f"{data[key]:.5f}{where}" for where, key in radii if not math.isnan(data[key]))
    return "\n".join([*lines, "", f"spectral radius at the worst posture: {told}"])


def boundaries_table(boundaries: "Boundaries", scenario: Scenario) -> str:
    """Plain text: how far each parameter can change, alone, before the loop is unstable."""

    def factor(value: float, unit: str = "") -> str:
        return (
            f"x {value:.3g}{unit}" if math.isfinite(value) else "stable over the whole search range"
        )

    period = 1e3 * scenario.sample_time
    if math.isnan(boundaries.delay):
        return "no boundaries: the loop is unstable at the given values"
    delay = (
        f"{boundaries.delay:.0f} sample{'s' if boundaries.delay > 1 else ''} "
        f"({boundaries.delay * period:.3g} ms)"
    )
    rows = [
        ["feedback gains", factor(boundaries.gains)],
        ["nominal payload", factor(boundaries.nominal_payload)],
        [
            "sample time",
            factor(boundaries.sample_time, f" ({boundaries.sample_time * period:.3g} ms)"),
        ],
        *(
            [f"mass of {name}" if name != "all" else "masses of all flexible parts", factor(value)]
            for name, value in boundaries.flexible_mass.items()
        ),
        [
            "further sensor delay",
            delay if math.isfinite(boundaries.delay) else factor(boundaries.delay),
        ],
    ]
    return "\n".join(["stability limits at that posture, one parameter at a time:", *aligned(rows)])


def _hidden_lines(margins: "Margins", data: Mapping[str, Any]) -> list[str]:
    """The vibration modes unknown to the controller, and their effect on eta."""
    if not margins.hidden:
        return []
    low, high = margins.locked_eta
    rows = [
        ["hidden mode", "free", "held", "damping", "carries most of"],
        ["", "Hz", "Hz", "", ""],
    ]
    for mode in data["hidden_modes"]:
        moves = ", ".join(f"{name} {value:+.2g}" for name, value in list(mode["shape"].items())[:3])
        carries = ", ".join(
            f"{name} {number(100.0 * share, 2)} %"
            for name, share in list(mode["share"].items())[:2]
        )
        rows.append([
            moves, *(f"{mode[key]:.4g}" for key in ("frequency", "clamped_frequency")),
            f"{mode['damping_ratio']:.2g}", carries,
        ])  # fmt: skip
    locked = (
        f"with the flexible parts locked it is {low:.3f} to {high:.3f}; their springs are slow "
        f"compared with a sample"
    )
    return [
        locked,
        "",
        "vibration modes unknown to the controller, at the start of the motion:",
        *aligned(rows),
    ]


def _axis_lines(axes: "AxisMargins", data: Mapping[str, Any]) -> list[str]:
    rows = [
        [
            "coordinate",
            "K_s start",
            "expected",
            "bound",
            "limit",
            "margin",
            "largest L",
            "tolerated eta",
        ],
        ["", "1/s", "1/s", "1/s", "1/s", "", "ms", ""],
    ]
    for name, item in data["coordinates"].items():
        gains = ["-"] * 5
        if axes.has_k_s:
            expected, limit, bound = (item[f"k_s_{key}"] for key in ("expected", "limit", "bound"))
            gains = [
                f"{item['k_s_start']:.4g}",
                f"{expected:.4g}",
                f"{bound:.4g}" if math.isfinite(bound) else "none",
                f"{limit:.4g}",
                f"{limit / max(expected, 1e-9):.2f}",
            ]
        low, high = item["eta_tolerated"]
        rows.append(
            [name, *gains, f"{1e3 * item['sample_time_limit']:.2f}", f"{low:.2f} .. {high:.2f}"]
        )
    return aligned(rows)


def disk_table(margins: "DiskMargins") -> str:
    """Plain text: disk margins of each force alone, and of all together."""

    def row(name: str, alpha: float, at: str) -> list[str]:
        low, high = margins.gain(alpha)
        phase = f"{math.degrees(margins.phase(alpha)):.0f}"
        return [name, f"{alpha:.3f}", f"{low:.2f} .. {high:.3g}", phase, at]

    rows = [["disk margin", "alpha", "gain", "phase, deg", "critical at, rad/s"]]
    rows += [
        row(name, alpha, f"{w:.3g}")
        for name, alpha, w in zip(margins.names, margins.alone, margins.frequency, strict=True)
    ]
    rows.append(row("all at once", margins.together, NONE))
    return "\n".join([*aligned(rows), "gain and phase may vary at once; no limits, no noise"])


def margins_data(margins: "Margins") -> dict[str, Any]:
    """The table's figures as plain data, by coordinate where they differ (1/s, s, rad/s)."""
    axes = margins.axes
    by_coordinate = {} if axes is None else {
        name: {
            "k_s_start": float(axes.k_s[i]),
            "k_s_expected": float(axes.forecast_k_s[:, i].max()),
            "k_s_bound": float(axes.k_s_max[i]),
            "k_s_limit": float(axes.k_s_limit[i]),
            "sample_time_limit": float(axes.sample_time_limit[i]),
            "eta_tolerated": axes.eta_tolerated[i].tolist(),
        }
        for i, name in enumerate(margins.coordinates.names) if margins.coordinates.is_driven[i]
    }  # fmt: skip
    return {
        "controller": margins.scenario.controller,
        "verdict": margins.verdict,
        "stable": margins.is_stable,
        "spectral_radius": margins.worst.spectral_radius,
        "spectral_radius_expected": max(loop.spectral_radius for loop in margins.loops_expected)
        if margins.loops_expected is not margins.loops
        else math.nan,
        "spectral_radius_at_bounds": margins.radius_at_bounds,
        "eta": [float(margins.eta.min()), float(margins.eta.max())],
        "modes": [
            {
                "magnitude": abs(mode.pole),
                "frequency": mode.frequency,
                "damping": mode.damping,
                "coordinates": dict(mode.coordinates),
            }
            for mode in margins.worst.modes()
        ],
        "locked_eta": list(margins.locked_eta),
        "hidden_modes": [
            {
                "frequency": mode.frequency,
                "clamped_frequency": mode.clamped_frequency,
                "damping_ratio": mode.damping_ratio,
                "shape": _largest_first(margins.hidden, mode.shape, above=0.05),
                "share": _largest_first(margins.coordinates.names, mode.share, above=1e-4),
            }
            for mode in margins.hidden_modes
        ],
        "coordinates": by_coordinate,
    }


def _largest_first(
    names: Sequence[str], values: Iterable[float], *, above: float
) -> dict[str, float]:
    """Name -> value, the largest first, without those whose size is below ``above``."""
    found = {
        name: float(value) for name, value in zip(names, values, strict=True) if abs(value) >= above
    }
    return dict(sorted(found.items(), key=lambda item: -abs(item[1])))


def design_table(found: "Design") -> str:
    """Plain text: the chosen gains, their predicted accuracy against the given ones, and limits."""
    chosen, given = found.chosen, found.given
    scenario, requirement = chosen.scenario, found.requirement
    before, after = given.prediction.by_group(), chosen.prediction.by_group()
    names = list(after)
    rows = [
        ["", *names],
        ["rms error, rad or m", *(f"{after[name]:.3g}" for name in names)],
        ["given gains", *(f"{before[name]:.3g}" for name in names)],
    ]
    for name, gain in scenario.controllers.get(controller_key(scenario.controller), {}).items():
        rows.append([name, *(_gain_cell(gain, name_of_group) for name_of_group in names)])
    if scenario.estimator.kind != "one_sample" and scenario.controller in PAPER_LAWS:
        rows.append(["walk q_N", *(_gain_cell(scenario.estimator.walk, name) for name in names)])
    estimate = f", estimator {scenario.estimator.kind}" if scenario.controller in PAPER_LAWS else ""
    margins = [["margin", "chosen", "given"]]
    for name, (was, now) in found.margins.items():
        margins.append([name, f"{now:.4g}", f"{was:.4g}"])
    masses = [["true payload", "spectral radius", ""]]
    for mass, radius in chosen.radius_by_mass.items():
        masses.append([f"{mass:.0f} kg", f"{radius:.5f}", "" if radius < 1.0 else "unstable"])
    return "\n".join(
        [
            f"{scenario.description}: {label_of(scenario.controller)}{estimate}",
            "",
            *aligned(rows),
            "",
            f"effort ISV {chosen.prediction.isv:.1f} (budget {requirement.budget:.1f}, perfect "
            "tracking "
            f"{found.ideal_isv:.1f}; given gains {given.prediction.isv:.4g})",
            *aligned(masses),
            "",
            *(aligned(margins) if found.margins else ["margins: not evaluated"]),
            "",
            *found.remarks,
        ]
    )


def _gain_cell(value: Any, group: str) -> str:
    if not isinstance(value, Mapping):
        return "unbounded" if value is None else f"{value:.3g}"
    if group in value or "all" in value:
        return f"{value.get(group, value.get('all')):.3g}"
    return "by coordinate"


def design_data(found: "Design") -> dict[str, Any]:
    """The table's figures as plain data."""

    def figures(point: "DesignPoint") -> dict[str, Any]:
        prediction = point.prediction
        return {
            "mean_log_error": prediction.mean_log_error,
            "requirement_not_met": found.requirement.violated(point),
            "spectral_radius": prediction.spectral_radius,
            "isv": prediction.isv,
            "rms_error": prediction.by_group(),
            "peak_effort": dict(
                zip(prediction.coordinates.names, prediction.peak_effort.tolist(), strict=True)
            ),
            "spectral_radius_by_payload_mass": {
                f"{mass:g}": radius for mass, radius in point.radius_by_mass.items()
            },
        }

    scenario = found.chosen.scenario
    return {
        "controller": scenario.controller,
        "estimator": scenario.estimator.kind,
        "gains": complete_gains(scenario).controllers.get(controller_key(scenario.controller), {}),
        "kept": found.kept,
        "ended_by": found.ended_by,
        "active_constraint": found.active_constraint,
        "distance_to_lqg": found.limit.distance,
        "budget": found.requirement.budget,
        "ideal_isv": found.ideal_isv,
        "chosen": figures(found.chosen),
        "before": figures(found.given),
        "margins": {
            name: {"before": before, "chosen": after}
            for name, (before, after) in found.margins.items()
        },
        "found": {kind: figures(point) for kind, point in found.found.items()},
    }


def plan_table(found: "PlannedMotionReport") -> str:
    """Duration and effort of a plan, and its margin to each limit, as plain text."""
    plan = found.plan
    after = f", and {plan.settle:g} s more for the remaining rates" if plan.settle > 0.0 else ""
    lines = [
        f"At rest after {plan.duration:.3f} s{after}; {found.evaluations} evaluations in "
        f"{found.solve_time:.1f} s",
        f"Angular momentum about the centre of mass: {number(found.angular_momentum)} N m s at "
        "the start, "
        f"{number(found.momentum_left)} at {plan.duration:.3f} s"
        + (
            f"; base torque alone takes at least {found.least_by_torque:.2f} s"
            if found.least_by_torque > 0.0
            else ""
        ),
        f"Integral of the squared force (ISV): {number(found.effort)}; impulses: base torque "
        f"{number(found.impulse['base_rotation'])} N m s, base force "
        f"{number(found.impulse['base_position'])} N s, "
        f"joints {number(found.impulse['joints'])}",
        *(
            []
            if found.base_turn is None
            else [f"Momentum turns the base by up to {number(found.base_turn)} rad"]
        ),
        "",
    ]
    rows = [["", "nearest to the limit", "limit", "used", "at"]]
    for margin in found.margins:
        share = (
            NONE
            if margin.quantity in ("clearance", "position")
            else percent(abs(margin.value / margin.limit))
        )
        rows.append(
            [
                f"{margin.quantity} {margin.name}", f"{margin.value:.4g} {margin.unit}",
                f"{margin.limit:.4g} {margin.unit}", share, f"{margin.time:.2f} s",
            ]
        )  # fmt: skip
    return "\n".join(lines + aligned(rows))


def plan_data(found: "PlannedMotionReport") -> dict[str, Any]:
    """The text of the plan as plain data."""
    return {
        "duration": found.plan.duration,
        "settle": found.plan.settle,
        "solve_time": found.solve_time,
        "evaluations": found.evaluations,
        "isv": found.effort,
        "impulse": found.impulse,
        "angular_momentum": found.angular_momentum,
        "angular_momentum_left": found.momentum_left,
        "least_by_torque": found.least_by_torque,
        "base_turn": found.base_turn,
        "margins": [dataclasses.asdict(margin) | {"kept": margin.kept} for margin in found.margins],
    }
