"""Margins and chosen gains as plain text, and their figures as plain data."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ffsm_drake.common.numbers import NONE, counted, number
from ffsm_drake.plugins.design.gains import INTERRUPT, Design, DesignPoint
from ffsm_drake.plugins.design.rounding import rounded_down
from ffsm_drake.plugins.design.stability.boundaries import (
    LARGEST_DELAY,
    LARGEST_TRIED,
    MASS,
    Boundaries,
    feedback_gains,
)
from ffsm_drake.plugins.design.stability.disk import DiskMargins
from ffsm_drake.plugins.design.stability.linear_loop import radius_told
from ffsm_drake.plugins.design.stability.margins import AxisMargins, Margins
from ffsm_drake.scenario import Scenario
from ffsm_drake.show.style import label_of
from ffsm_drake.show.tables import aligned
from ffsm_drake.systems.controllers import (
    InjectedDynamics,
    complete_gains,
    controller_factory,
)

# parameter -> its name in the table of limits
_PARAMETERS = {
    "gains": "feedback gains",
    "nominal_payload": "nominal payload",
    "sample_time": "sample time",
    f"{MASS}all": "masses of all flexible parts",
    "delay": "further sensor delay",
}


def margins_table(margins: Margins) -> str:
    """Plain text: the modes of the worst posture, and for a law of axes per coordinate the
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
            f"limits of each coordinate alone, plant {plant}; largest L and eta after adaptation:",
            *_axis_lines(margins.axes, data),
        ]
    radii = [
        ("", "spectral_radius"),
        (" at the K_s expected after adaptation", "spectral_radius_expected"),
    ]
    radii.append((" with every K_s at its bound", "spectral_radius_at_bounds"))
    told = "; ".join(
        f"{radius_told(data[key])}{where}" for where, key in radii if not math.isnan(data[key])
    )
    return "\n".join([*lines, "", f"spectral radius at the worst posture: {told}"])


def boundaries_table(boundaries: Boundaries, scenario: Scenario) -> str:
    """Plain text: how far each parameter can change, alone, before the loop is unstable.

    Numbers are rounded down, so that they are stable as printed.
    """
    starting = boundaries.starting
    found, before = (_limit_rows(each, scenario) for each in (boundaries, starting or boundaries))
    if not found:
        where = " that adaptation reaches" if before else ""
        return f"no boundaries: the loop is unstable at the {'K_s' if where else 'given'}" + (
            where or " values"
        )
    heading = (
        "largest stable values at that posture, one parameter at a time; without actuator limits "
        "and noise"
    )
    if found == before:
        return "\n".join([f"{heading}:", *aligned([[*row] for row in found.items()])])
    rows = [[name, value, before[name]] for name, value in found.items()]
    columns = ["", "after adaptation", "at the starting K_s"]
    return "\n".join([f"{heading}:", *aligned([columns, *rows])])


def _limit_rows(boundaries: Boundaries, scenario: Scenario) -> dict[str, str]:
    """Parameter -> its limit; empty for a loop that is unstable at the given values."""
    if math.isnan(boundaries.delay):
        return {}
    period = 1e3 * scenario.sample_time

    def tried(end: str) -> str:
        return f"stable at every value tried, up to {end}"

    def factor(value: float, size: float = 0.0, unit: str = "") -> str:
        if not math.isfinite(value):
            return tried(f"x {LARGEST_TRIED:.3g} at most")
        more = f" ({rounded_down(value * size):.3g} {unit})" if size else ""
        return f"x {rounded_down(value):.3g}{more}"

    found = dict[str, str]()
    for name, value in boundaries.values.items():
        label = _PARAMETERS.get(name, name)
        if name == "gains" and not feedback_gains(scenario):
            found[label] = "the law declares none"
        elif name != "delay":
            found[label] = factor(value, *((period, "ms") if name == "sample_time" else ()))
        elif math.isfinite(value):
            found[label] = f"{counted(int(value), 'sample')} ({value * period:.3g} ms)"
        else:
            found[label] = tried(f"{LARGEST_DELAY} samples at most")
    return found


def _hidden_lines(margins: Margins, data: Mapping[str, Any]) -> list[str]:
    """The vibration modes unknown to the controller, and their effect on eta."""
    if not margins.hidden:
        return []
    low, high = margins.locked_eta
    rows = [
        ["flexible mode", "free", "held", "damping", "carries most of"],
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
    nyquist = 0.5 / margins.scenario.sample_time
    fast = [mode["frequency"] for mode in data["hidden_modes"] if mode["frequency"] > nyquist]
    locked = f"with the flexible parts locked it is {low:.3f} to {high:.3f}; their springs "
    locked += (
        f"have modes up to {max(fast):.3g} Hz, above half of the sample rate ({nyquist:.3g} Hz); "
        "the locked eta applies to modes that decay within a sample"
        if fast
        else "are slow compared with a sample"
    )
    return [
        locked,
        "",
        "vibration modes unknown to the controller, at the start of the motion:",
        *aligned(rows),
    ]


def _axis_lines(axes: AxisMargins, data: Mapping[str, Any]) -> list[str]:
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
        tolerated = "none" if math.isnan(low) else f"{low:.2f} .. {high:.2f}"
        rows.append([name, *gains, f"{1e3 * item['sample_time_limit']:.2f}", tolerated])
    return aligned(rows)


def disk_table(margins: DiskMargins) -> str:
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


def margins_data(margins: Margins) -> dict[str, Any]:
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


def design_table(found: Design) -> str:
    """Plain text: the chosen gains, their predicted accuracy against the given ones, and limits."""
    chosen, given = found.chosen, found.given
    scenario, requirement = chosen.scenario, found.requirement
    before, after = given.prediction.by_group(), chosen.prediction.by_group()
    names = list(after)
    rows = [
        ["", *names],
        ["rms error, rad or m", *(f"{after[name]:.3g}" for name in names)],
        ["current gains", *(f"{before[name]:.3g}" for name in names)],
    ]
    for name, gain in scenario.gains.items():
        rows.append([name, *(_gain_cell(gain, name_of_group) for name_of_group in names)])
    law = controller_factory(scenario)
    estimates = isinstance(law, type) and issubclass(law, InjectedDynamics)
    if scenario.estimator.kind != "one_sample" and estimates:
        rows.append(["walk q_N", *(_gain_cell(scenario.estimator.walk, name) for name in names)])
    estimate = f", estimator {scenario.estimator.kind}" if estimates else ""
    where = ", at the starting K_s" if found.adapts else ""
    margins = [[f"margin{where}", "chosen", "current"]]
    for name, (was, now) in found.margins.items():
        margins.append([name, f"{now:.4g}", f"{was:.4g}"])
    masses = [["true payload", "spectral radius", ""]]
    for mass, radius in chosen.radius_by_mass.items():
        masses.append([f"{mass:.0f} kg", radius_told(radius), "" if radius < 1.0 else "unstable"])
    return "\n".join(
        [
            f"{scenario.description}: {label_of(scenario.controller)}{estimate}",
            "",
            *aligned(rows),
            "",
            f"effort ISV {chosen.prediction.isv:.1f} (budget {requirement.budget:.1f}, perfect "
            "tracking "
            f"{found.ideal_isv:.1f}; current gains {given.prediction.isv:.4g})",
            *aligned(masses),
            "",
            *(aligned(margins) if found.margins else [_no_margins(found)]),
            "",
            *found.remarks,
        ]
    )


def _no_margins(found: Design) -> str:
    """The reason for missing margins."""
    if found.given.alarm:
        return "margins: not compared, because the current gains are not expected to go as planned"
    if not found.ended_by:
        return "margins: not evaluated"
    more = "" if found.ended_by == INTERRUPT else "; give a larger --time"
    return f"margins: not evaluated before {found.ended_by}{more}"


def _gain_cell(value: Any, group: str) -> str:
    if not isinstance(value, Mapping):
        return "unbounded" if value is None else f"{value:.3g}"
    if group in value or "all" in value:
        return f"{value.get(group, value.get('all')):.3g}"
    return "by coordinate"


def design_data(found: Design) -> dict[str, Any]:
    """The table's figures as plain data."""

    def figures(point: DesignPoint) -> dict[str, Any]:
        prediction = point.prediction
        return {
            "mean_log_error": prediction.mean_log_error,
            "requirement_not_met": found.requirement.violated(point),
            "spectral_radius": prediction.spectral_radius,
            "isv": prediction.isv,
            "rms_error": prediction.by_group(),
            "peak_effort": prediction.coordinates.by_name(prediction.peak_effort),
            "spectral_radius_by_payload_mass": {
                f"{mass:g}": radius for mass, radius in point.radius_by_mass.items()
            },
        }

    scenario = found.chosen.scenario
    return {
        "controller": scenario.controller,
        "estimator": scenario.estimator.kind,
        "gains": complete_gains(scenario).gains,
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
        "margins_are_at_starting_k_s": found.adapts,
        "found": {kind: figures(point) for kind, point in found.found.items()},
    }
