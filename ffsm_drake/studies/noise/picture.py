# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The noise study as a picture: effort, peak force, attitude error and joint error against velocity
noise.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ffsm_drake.scenario import load_scenario
from ffsm_drake.show.figures.axes import tidy
from ffsm_drake.show.style import SKY, label_of, styles_of
from ffsm_drake.studies.noise.cases import CONTROLLERS
from ffsm_drake.studies.noise.study import NoiseRow, NoiseStudy, settled_after

# Rate sensors: white noise at 100 Hz, rad/s.
FIBRE_GYRO = 1.5e-5  # angle random walk of 0.005 deg/sqrt(h)
MEMS_GYRO = (1e-4, 1e-3)

# Marker, its size and the line's width: several curves agree, so each is drawn smaller, over the
# one before.
_LOOKS = {
    "tde_aismc": ("o", 8.5, 2.6),
    "aismc": ("s", 7.2, 2.0),
    "asmc": ("^", 6.0, 1.5),
    "tdc": ("D", 4.4, 1.1),
}
_OPEN: dict[str, Any] = {
    "linestyle": (0, (4, 2)),
    "markerfacecolor": "white",
    "markeredgewidth": 1.3,
}
_NOTE: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8.5}
_AT_THE_FOOT: dict[str, Any] = {**_NOTE, "xycoords": ("data", "axes fraction"), "xytext": (0, 4)}
_DARK = "#444444"


def plot_study(study: NoiseStudy) -> Figure:
    """Four panels over the noise of the velocity; the sensor set of ``flight_sensors`` at the right
    of each.
    """
    figure = Figure(figsize=(12.0, 9.6))
    figure.suptitle(
        "What the published gains cost with real sensors", fontsize=14, fontweight="bold", y=0.985
    )
    figure.text(
        0.5,
        0.95,
        "White velocity noise on every coordinate, exact positions, unlimited actuators; at the "
        "right the sensor set "
        "of flight_sensors",
        ha="center",
        va="top",
        fontsize=9.5,
        color=_DARK,
    )
    panels = figure.subplots(2, 2, sharex=True)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.885, bottom=0.14, wspace=0.2, hspace=0.16)
    after = f"after {settled_after(study.duration):g} s"
    quantities: tuple[tuple[str, str, Callable[[NoiseRow], float]], ...] = (
        (
            "(a) Effort beyond that of perfect tracking",
            "ISV - ideal ISV",
            lambda p: p.isv - study.ideal_isv,
        ),
        ("(b) Peak force on the base", "force [N]", lambda p: p.peak_force["base_position"]),
        (
            f"(c) Base attitude error {after}",
            "rms error [rad]",
            lambda p: p.rms_error["base_rotation"],
        ),
        (f"(d) Joint error {after}", "rms error [rad]", lambda p: p.rms_error["joints"]),
    )
    for axes, (title, label, quantity) in zip(panels.flat, quantities, strict=True):
        _plot_quantity(axes, study, quantity)
        axes.set_title(title, fontsize=11, loc="left")
        axes.set_ylabel(label)
        tidy(axes)
        axes.axvspan(*MEMS_GYRO, color="#F0E442", alpha=0.22, linewidth=0, zorder=0)
        axes.axvline(FIBRE_GYRO, color=SKY, linewidth=1.4, zorder=1)
    (effort, force), below = panels
    effort.annotate("fibre gyro \n0.005°/√h ", (FIBRE_GYRO, 0.0), **_AT_THE_FOOT, ha="right")
    effort.annotate(
        "MEMS gyro", (math.sqrt(math.prod(MEMS_GYRO)), 0.0), **_AT_THE_FOOT, ha="center"
    )
    _draw_slope(effort, study)
    if thrust := (load_scenario("flight_sensors").actuation.limit or {}).get("base_position"):
        force.axhline(thrust, color="black", linewidth=1.0)
        at = {"xycoords": ("axes fraction", "data"), "xytext": (0, 3)}
        force.annotate(f"thrusters of flight_sensors: {thrust:g} N", (0.015, thrust), **at, **_NOTE)
    for axes in below:
        axes.set_xlabel("velocity noise σ per sample [rad/s, m/s]")
    neutral: dict[str, Any] = {"color": _DARK, "marker": "o", "markersize": 6.0, "linewidth": 1.6}
    handles = [
        *[
            Line2D([], [], label=label_of(name), **_look(name, "one_sample"))
            for name in study.noise_gain
        ],
        Line2D([], [], label="filled: one sample, published gains", **neutral),
        Line2D([], [], label="open: Kalman, bandwidth gains", **neutral | _OPEN),
        Line2D(
            [],
            [],
            label="diverged",
            **neutral | {"marker": "X", "markersize": 8.0, "linestyle": "none"},
        ),
    ]
    figure.legend(
        handles=handles, loc="lower center", ncols=4, fontsize=9.5, frameon=False, handlelength=3.2,
        bbox_to_anchor=(0.5, 0.005),
    )  # fmt: skip
    return figure


def _look(controller: str, estimator: str) -> dict[str, Any]:
    marker, size, width = _LOOKS[controller]
    look = {
        "color": styles_of([controller])[0].color,
        "marker": marker,
        "markersize": size,
        "linewidth": width,
    }
    return look | _OPEN if estimator == "kalman" else look


def _plot_quantity(axes: Axes, study: NoiseStudy, quantity: Callable[[NoiseRow], float]) -> None:
    # of the sensor set on the axis of sigma: apart, beyond the largest
    place = 5.0 * study.sigmas[-1]
    diverged: dict[float, int] = {}  # crosses drawn so far, by place
    for curve, (controller, estimator, points) in enumerate(study.curves()):
        look = _look(controller, estimator) | {"zorder": 3.0 + 0.1 * curve}
        # What a logarithm cannot show is left out: by chance, a run may cost less than the ideal
        # one.
        value = np.array([quantity(point) for point in points])
        value = np.where(value > 0.0, value, np.nan)
        axes.plot(study.sigmas, value[:-1], **look)
        # side by side, since several of them agree
        beside = place * 1.25 ** (CONTROLLERS.index(controller) - 1.5)
        axes.plot([beside], value[-1:], **look | {"linestyle": "none", "markersize": 5.5})
        for at in [point.sigma or beside for point in points if point.diverged]:
            row = diverged[at] = diverged.get(at, -1) + 1
            axes.plot(
                [at],
                [0.965 - 0.05 * row],
                marker="X",
                markersize=9.0,
                color=look["color"],
                markeredgecolor="white",
                markeredgewidth=0.6,
                transform=axes.get_xaxis_transform(),
                zorder=6,
                clip_on=False,
            )
    axes.set(xscale="log", yscale="log")
    low, high = axes.get_ylim()
    margin = (high / low) ** 0.09
    # room for the names of the sensors, and for the crosses
    axes.set_ylim(low / margin, high * margin)
    edge = place / 2.3
    axes.axvline(edge, color="#888888", linewidth=0.8, linestyle=":")
    axes.annotate("flight\nsensors", (place, 0.0), **_AT_THE_FOOT, ha="center")
    axes.set_xlim(study.sigmas[0] / 1.6, place * 2.2)
    axes.set_xticks([10.0**k for k in range(-12, 3) if axes.get_xlim()[0] <= 10.0**k < edge])


def _draw_slope(axes: Axes, study: NoiseStudy) -> None:
    """The predicted growth of effort with the published estimate, for the law that amplifies noise
    least.
    """
    sigma = np.array(study.sigmas)
    rows = study.select("tdc", "one_sample", study.sigmas[-1])
    if sigma.size < 2 or not rows:
        return
    slope = (rows[0].isv_predicted - study.ideal_isv) / sigma[-1] ** 2
    dotted: dict[str, Any] = {"color": "black", "linewidth": 1.3, "linestyle": ":", "zorder": 5}
    axes.plot(sigma, slope * sigma**2, **dotted, scalex=False, scaley=False)
    at = sigma[max(sigma.size - 3, 0)]
    axes.annotate(
        "dotted: predicted\nfor TDC, ∝ σ²/L²",
        (at, slope * at**2),
        xytext=(4, -12),
        va="top",
        **_NOTE,
    )
