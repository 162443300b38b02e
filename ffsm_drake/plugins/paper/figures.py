# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The paper's Figures 2 to 5 redrawn, and two more. Each is written as PNG and SVG."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from matplotlib.figure import Figure

from ffsm_drake.common.numbers import rounded_up
from ffsm_drake.plugins.diagrams.block_diagram import closed_loop_dot, write_diagram
from ffsm_drake.plugins.paper.runs import (
    CONTROLLERS,
    DISTURBANCES,
    PROPOSED,
    SETTINGS,
    Results,
    gain_of,
)
from ffsm_drake.plugins.paper.table import METRICS
from ffsm_drake.plugins.paper.wording import DISTURBANCE_NAMES, NAMES, ending, fixed
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import load_scenario
from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.figures.axes import plot_charts, save_figure
from ffsm_drake.show.figures.run import plot_efforts, plot_errors, plot_trajectories
from ffsm_drake.show.style import BLACK, BLUE, GREEN, GRID, VERMILION, Style

FOLDER = "figures"
# The two settings where every controller completes.
DRAWN = {"euler": "explicit Euler", "bounded": "exact integration"}

_MARKS = {
    "euler": ("ours, explicit Euler", "circle", BLUE),
    "bounded": ("ours, exact integration, Kₛ bounded", "square", VERMILION),
}
_LABELS = {"itae": "ITAE [rad s², m s²], logarithmic", "isv": "ISV [N² s, N² m² s]"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FigureFile:
    """A written figure; if it could not be drawn, the paths are None and ``caption`` says why."""

    key: str
    title: str
    caption: str
    png: Path | None
    svg: Path | None


def write_figure_2(directory: Path) -> FigureFile:
    """The block diagram, by Graphviz."""
    path = directory / FOLDER / "fig2.dot"
    remark = write_diagram(closed_loop_dot(load_scenario("postcapture")), path)
    caption = (
        "Figure 2. The paper draws the inside of its controller; this is the wiring that was "
        "simulated, printed from "
        "the running Drake diagram: reference, controller, disturbance, plant and sensing."
    )
    return FigureFile(
        key="fig2",
        title="Block diagram",
        caption=f"{caption} Not drawn: {remark}" if remark else caption,
        png=None,
        svg=None if remark else path.with_suffix(".svg"),
    )


def write_figure_3(results: Results, directory: Path) -> list[FigureFile]:
    """Planned and tracked motion of the proposed controller."""
    written = []
    for setting, words in DRAWN.items():
        record = results.record(setting, PROPOSED)
        caption = (
            f"Figure 3 with {words}. Motion under the proposed controller, τ_d1: (a) end effector "
            "in task space, "
            "(b) base attitude as roll, pitch, yaw, (c) base position, (d) joints. Dashed: the "
            "planned motion, from "
            f"which the run departs by at most {_largest_departure(record)}."
        )
        title = f"Planned and tracked trajectories, {words}"
        written.append(
            _write(plot_trajectories(record), f"fig3_{setting}", title, caption, directory)
        )
    return written


_OVERLAID = {
    "fig4": (
        plot_errors,
        "Tracking errors",
        "Upper panels: true error e = q_d − q of every control sample, the roughest drawn first. "
        "Lower panels: rms of that error over one second, logarithmic, since the errors differ by "
        "orders of magnitude.",
    ),
    "fig5": (
        plot_efforts,
        "Control forces and torques",
        "Upper panels: force or torque held over every control period, the roughest drawn first. "
        "Lower panels: rms over one second of its change from one sample to the next, logarithmic: "
        "the contribution of measurement noise and switching term beside the motion's own force.",
    ),
}


def write_overlaid(results: Results, directory: Path, key: str) -> list[FigureFile]:
    """Tracking errors (fig4), or control forces and torques (fig5), of the four controllers."""
    (plot, title, caption), written = _OVERLAID[key], []
    for setting, words in DRAWN.items():
        figure = plot([results.record(setting, name) for name in CONTROLLERS])
        text = (
            f"Figure {key[-1]} with {words}, four controllers, τ_d1, seed 0. (a) to (c) base "
            "attitude x, y, z; "
            f"(d) to (f) base position x, y, z; (g) to (k) joints 1 to 5. {caption}"
        )
        written.append(_write(figure, f"{key}_{setting}", f"{title}, {words}", text, directory))
    return written


def write_overview(rows: pd.DataFrame, directory: Path) -> FigureFile:
    """Write Table 2 as a figure."""
    title = "Table 2 as a picture"
    caption = (
        f"{title}: the paper's values and ours, means over the seeds. With exact integration and "
        "the published gains "
        "the proposed controller has no value to show: it diverges."
    )
    return _write(plot_overview(rows), "table2", title, caption, directory)


def write_divergence(results: Results, directory: Path) -> FigureFile:
    """Write the figure of the published gains on an exactly integrated plant."""
    caption = (
        "Not in the paper. The proposed controller, τ_d1, seed 0. Left: the largest K_s of the "
        "eleven coordinates, "
        "which law (9) adapts, and the limit (K_D + K_s) L < 2 of the sampled loop for a "
        "perfectly known mass matrix. "
        "Right: sum of the absolute errors. Explicit Euler at the control period raises the limit "
        "and hides the "
        "divergence."
    )
    title = "The published gains on an exactly integrated plant"
    return _write(plot_divergence(results), "divergence", title, caption, directory)


def plot_overview(rows: pd.DataFrame) -> Figure:
    """ITAE and ISV of every row, the paper's and ours."""
    cases = [(kind, name) for kind in DISTURBANCES for name in ("", *CONTROLLERS)]
    charts = [_overview(rows, metric, cases) for metric in METRICS]
    return plot_charts(
        [[chart] for chart in charts], "Table 2", "the paper's values and ours", columns=2,
        size=(11.0, 5.2), below=True,
    )  # fmt: skip


def _overview(rows: pd.DataFrame, metric: str, cases: list[tuple[str, str]]) -> Chart:
    """A metric of every case (disturbance, controller) in its row, below the disturbance's name."""
    found = rows.set_index("setting")
    places = np.array([k for k, (_, name) in enumerate(cases) if name], dtype=float)
    printed = found.loc["euler", f"{metric}_paper"].to_numpy()
    means = {setting: found.loc[setting, f"{metric}_mean"].to_numpy() for setting in _MARKS}
    every = np.array([printed, *means.values()])
    gaps = np.full(places.size, np.nan)
    spans = np.stack([np.nanmin(every, axis=0), np.nanmax(every, axis=0), gaps], axis=1)
    look: dict[str, Any] = {"line": False, "size": 9.0}
    return Chart(
        title=METRICS[metric], x=_LABELS[metric], margin=0.04,
        log_x="~e" if metric == "itae" else "",
        rows=[NAMES[name] if name else DISTURBANCE_NAMES[kind] for kind, name in cases],
        curves=[
            Curve(spans.ravel(), np.repeat(places, 3), Style(GRID), width=2.0),
            *(
                Curve(means[setting], places, Style(color), label, marker=marker, **look)
                for setting, (label, marker, color) in _MARKS.items()
            ),
            Curve(printed, places, Style(BLACK), "paper", marker="diamond-open", **look),
        ],
    )  # fmt: skip


def plot_divergence(results: Results) -> Figure:
    """K_s and the error of the proposed controller in the three settings."""
    styles = {
        "exact": Style(VERMILION),
        "euler": Style(BLUE, "dash"),
        "bounded": Style(GREEN, "dashdot"),
    }
    gains, errors, top = list[Curve](), list[Curve](), 0.0
    for setting, style in styles.items():
        run, record = results.run(setting, PROPOSED), results.record(setting, PROPOSED)
        data, name = record.dataset, SETTINGS[setting].title.replace("K_s", "Kₛ")
        time, gain = data["time"].values, data["reaching_gain"].values.max(axis=1)
        error = np.abs(data["error"].values).sum(axis=1)
        error = np.where(error > 0.0, error, np.nan)
        if run.outcome.completed:
            top = max(top, float(gain.max()))
        else:
            name = f"{name}: {ending(run)}"
            for curves, y in ((gains, gain), (errors, error)):
                end = Style(style.color)
                curves.append(Curve(time[-1:], y[-1:], end, line=False, marker="x", size=12.0))
        gains.append(Curve(time, gain, style, width=1.8))
        errors.append(Curve(time, error, style, name, width=0.8))
    scenario = results.record("exact", PROPOSED).scenario
    limit = 2.0 / scenario.sample_time - gain_of(scenario, "k_d")
    level = Level(limit, f"limit {fixed(limit)}", style=Style(BLACK, "dot"))
    charts = (
        Chart(
            title="Adapted gain", y="1/s", what="largest Kₛ", curves=gains, levels=[level],
            range=(0.0, 1.15 * max(top, limit)),
        ),
        Chart(title="Tracking error", y="rad, m", what="‖e‖₁", curves=errors, log_y="~e"),
    )  # fmt: skip
    return plot_charts(
        [[chart] for chart in charts], "The proposed controller", scenario.description,
        columns=2, size=(11.0, 4.2), below=True,
    )  # fmt: skip


def _largest_departure(record: RunRecord) -> str:
    peak = record.metrics["peak_error"]
    rotation = max(peak["base_rotation"], peak["joints"])
    sizes = (1e6 * rounded_up(each, 2) for each in (rotation, peak["base_position"]))
    return "{:.2g} µrad and {:.2g} µm".format(*sizes)


def _write(figure: Figure, name: str, title: str, caption: str, directory: Path) -> FigureFile:
    png, svg = (directory / FOLDER / f"{name}{suffix}" for suffix in (".png", ".svg"))
    for path in (png, svg):
        save_figure(figure, path)
    return FigureFile(key=name, title=title, caption=caption, png=png, svg=svg)
