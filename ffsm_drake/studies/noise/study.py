# ruff: noqa: RUF001 (the texts use mathematical signs)
"""What the published gains cost with real sensors: error and effort of every controller against velocity noise.

Each controller flies the mission of ``postcapture`` twice for every noise level: with the published one-sample estimate
and gains, and with the Kalman estimate and gains of ordinary bandwidth. Positions are measured exactly: the published
estimator has no defence against position noise at all, so the sweep is kind to it. One more point for each flies with
the whole sensor set of ``flight_sensors``, and at one noise level estimates and gains are exchanged, to tell which of
the two does it. Actuators are unlimited throughout: saturation would hide the effort that is asked for.
"""

import copy
import csv
import dataclasses
import functools
import io
import math
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ffsm_drake.common.errors import FfsmError, ScenarioError
from ffsm_drake.common.files import write_text, written_whole
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import ESTIMATOR_KINDS, Scenario, load_scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.show.figures.run import LABELS, STYLES, tidy
from ffsm_drake.spacecraft.coordinates import GROUPS

if TYPE_CHECKING:
    from ffsm_drake.design.stability.prediction import Plan

CONTROLLERS = ("tde_aismc", "aismc", "asmc", "tdc")
SIGMAS = (1e-7, 3e-7, 1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)  # rad/s and m/s, half decades
EXCHANGED_AT = 1e-4  # rad/s and m/s; the swept sigma nearest to it is used
SETTLED_AFTER = 5.0  # s; the rms error counts from here on, or from a quarter of a shorter run

# The gains that each estimator is swept with.
GAINS_OF = {"one_sample": "published", "kalman": "bandwidth"}
# Bandwidth gains: natural frequency w of each group, rad/s; and the random walk of N that the filter assumes.
OMEGA = {"base_position": 2.0, "base_rotation": 5.0, "joints": 10.0}
WALK = {"base_position": 1e-3, "base_rotation": 1e-3, "joints": 1e-2}
# What the filter assumes of exact positions, in s times sigma. Told the truth it would differentiate them and look at
# no rate sensor: an advantage that no real sensor gives.
POSITION_NOISE_TIME = 0.1
_SMALLEST_SIGMA = 1e-9  # a filter needs some noise

# Rate sensors: white noise at 100 Hz, rad/s.
FIBRE_GYRO = 1.5e-5  # angle random walk of 0.005 deg/sqrt(h)
MEMS_GYRO = (1e-4, 1e-3)


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseCase:
    """One run of the study."""

    controller: str
    estimator: str  # "one_sample" or "kalman"
    gains: str  # "published" or "bandwidth"
    sigma: float | None  # velocity noise, rad/s and m/s; None: the sensor set of ``flight_sensors``
    seed: int = 0
    duration: float = 20.0  # s

    def scenario(self) -> Scenario:
        """The scenario: ``postcapture`` with this controller, estimator and noise."""
        data = copy.deepcopy(_shipped("postcapture"))
        data |= {"controller": self.controller, "random_seed": self.seed, "duration": self.duration}
        if self.sigma is None:
            data["sensing"] = _shipped("flight_sensors")["sensing"]
        else:
            data["sensing"] |= {"velocity_noise": {"all": self.sigma}, "position_noise": {"all": 0.0}}
        if self.estimator == "kalman":
            data["estimator"] = {"kind": "kalman", "walk": WALK}
            if self.sigma is not None:
                assumed = max(self.sigma, _SMALLEST_SIGMA)
                data["estimator"] |= {"velocity_noise": assumed, "position_noise": POSITION_NOISE_TIME * assumed}
        if self.gains == "bandwidth":
            data["controllers"][self.controller] |= _bandwidth_gains(self.controller)
        return scenario_from_dict(data)

    def __str__(self) -> str:
        return f"{self.controller}, {self.estimator}, {self.gains} gains, {_sensors(self.sigma)}, seed {self.seed}"


@functools.cache
def _shipped(name: str) -> dict[str, Any]:
    """A shipped scenario as plain data; not to be changed."""
    return scenario_to_dict(load_scenario(name))


def _bandwidth_gains(controller: str) -> dict[str, dict[str, float]]:
    if controller == "asmc":
        return {"k_d": OMEGA, "k_s": OMEGA}
    gains = {
        "k_d": {group: 2.0 * omega for group, omega in OMEGA.items()},
        "k_p": {group: omega**2 for group, omega in OMEGA.items()},
    }
    if controller in ("aismc", "tde_aismc"):
        # Real noise drives |s| far past the laws' thresholds: adaptation would run to its bound, so it starts there.
        k_s = {group: 0.3 * omega for group, omega in OMEGA.items()}
        gains |= {"k_s_initial": k_s, "k_s_max": k_s}
    return gains


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseRow:
    """What is kept of one run; the figures of a run that diverged are NaN."""

    controller: str
    estimator: str
    gains: str  # "published" or "bandwidth"
    sigma: float | None  # rad/s and m/s; None: the sensor set of ``flight_sensors``
    seed: int
    diverged: bool
    outcome: str  # one line
    itae: float
    isv: float
    isv_predicted: float  # without simulation, from the linear loop; infinite: unstable
    rms_error: dict[str, float]  # by group, rad or m
    peak_force: dict[str, float]  # by group, N m or N


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseStudy:
    """All runs, and what the linear loop says without them."""

    rows: tuple[NoiseRow, ...]
    ideal_isv: float  # perfect tracking without noise
    sample_time: float  # L, s
    duration: float  # s
    # Rms commanded acceleration of one base attitude axis per unit of velocity noise with the published estimate, 1/s.
    noise_gain: dict[str, float]

    @property
    def sigmas(self) -> tuple[float, ...]:
        """The swept velocity noise, ascending, rad/s and m/s."""
        return tuple(sorted({row.sigma for row in self.rows if row.sigma is not None}))

    def select(
        self, controller: str, estimator: str, sigma: float | None, *, gains: str | None = None
    ) -> tuple[NoiseRow, ...]:
        """The runs of a point, one per seed; ``gains`` defaults to those that the estimator is swept with."""
        key = (controller, estimator, sigma, gains or GAINS_OF[estimator])
        return tuple(row for row in self.rows if (row.controller, row.estimator, row.sigma, row.gains) == key)


def study_noise(
    *,
    seeds: int = 1,
    sigmas: Sequence[float] = SIGMAS,
    duration: float = 20.0,
    controllers: Sequence[str] = CONTROLLERS,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> NoiseStudy:
    """Fly every controller with both estimators at every noise level, and with the sensors of ``flight_sensors``.

    Args:
      seeds: runs per point, with random seeds from 0 on.
      sigmas: velocity noise, one standard deviation for all coordinates, rad/s and m/s.
      duration: of each run, s.
      controllers: those to fly.
      workers: processes at work; beyond one they are spawned, so a script must call this under
        ``if __name__ == "__main__":``. The results do not depend on their number.
      progress: called with (runs done, runs in all, the run just done).

    Raises:
      ScenarioError: an argument cannot be used.
      KeyboardInterrupt: the user stopped the runs.
    """
    if seeds < 1:
        raise ScenarioError("seeds", f"must be at least 1, not {seeds}")
    if not sigmas:
        raise ScenarioError("sigmas", "must not be empty")
    if len(set(sigmas)) < len(sigmas) or not all(0.0 < sigma < math.inf for sigma in sigmas):
        raise ScenarioError("sigmas", f"must be positive and distinct, not {list(sigmas)}")
    if not controllers or not set(controllers) <= set(CONTROLLERS):
        raise ScenarioError("controllers", f"must be some of {', '.join(CONTROLLERS)}, not {list(controllers)}")
    exchanged_at = _nearest(sigmas)
    points = [
        (estimator, controller, sigma, GAINS_OF[estimator])
        for estimator in ESTIMATOR_KINDS
        for controller in controllers
        for sigma in (*sigmas, None)
    ] + [(estimator, controller, exchanged_at, gains) for estimator, gains in _EXCHANGED for controller in controllers]
    cases = [
        NoiseCase(controller=controller, estimator=estimator, gains=gains, sigma=sigma, seed=seed, duration=duration)
        for estimator, controller, sigma, gains in points
        for seed in range(seeds)
    ]
    rows = []
    for row in _rows(cases, workers):
        rows.append(row)
        if progress is not None:
            progress(len(rows), len(cases), str(cases[len(rows) - 1]))
    return NoiseStudy(
        rows=tuple(rows),
        ideal_isv=_plan(duration, 1.0).ideal_isv,
        sample_time=cases[0].scenario().sample_time,
        duration=duration,
        noise_gain={controller: _noise_gain(controller) for controller in controllers},
    )


_EXCHANGED = (("one_sample", "bandwidth"), ("kalman", "published"))


def _nearest(sigmas: Sequence[float]) -> float:
    """The sigma at which estimates and gains are exchanged."""
    return min(sigmas, key=lambda sigma: abs(math.log(sigma / EXCHANGED_AT)))


def _rows(cases: Sequence[NoiseCase], workers: int) -> Iterator[NoiseRow]:
    """The row of each case, in order."""
    if workers <= 1:
        yield from map(fly, cases)
        return
    # Drake's threads do not survive a fork.
    pool = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)
    )
    try:
        for row in pool.map(_fly_apart, cases):
            if isinstance(row, str):
                raise FfsmError(row)
            yield row
    finally:
        pool.shutdown(cancel_futures=True)


def _fly_apart(case: NoiseCase) -> NoiseRow | str:
    """``fly`` in a worker; an error comes back as its line, because not all of them pickle."""
    try:
        return fly(case)
    except FfsmError as error:
        return str(error)


def fly(case: NoiseCase) -> NoiseRow:
    """Simulate one case. Raises KeyboardInterrupt when the user stopped it."""
    scenario = case.scenario()
    # Some of these loops are known to become unstable: that is what is shown.
    record = simulate(scenario, check_stability=False)
    if record.outcome.status == "interrupted":
        raise KeyboardInterrupt
    completed = record.outcome.completed
    data = record.dataset
    error = data["error"].values[data["time"].values > _settled_after(case.duration)]
    group = data["group"].values
    return NoiseRow(
        controller=case.controller,
        estimator=case.estimator,
        gains=case.gains,
        sigma=case.sigma,
        seed=case.seed,
        diverged=not completed,
        outcome="completed" if completed else f"diverged at {record.outcome.time:.2f} s",
        itae=float(record.metrics["itae"]) if completed else math.nan,
        isv=float(record.metrics["isv"]) if completed else math.nan,
        isv_predicted=_predicted_isv(case, scenario),
        rms_error={
            name: float(np.sqrt(np.mean(error[:, group == name] ** 2))) if completed else math.nan for name in GROUPS
        },
        peak_force={
            name: float(value) if completed else math.nan for name, value in record.metrics["peak_effort"].items()
        },
    )


@functools.cache
def _plan(duration: float, sigma: float | None) -> "Plan":
    """What the mission asks of any controller."""
    from ffsm_drake.design.stability.prediction import make_plan  # SciPy is slow to import

    if sigma is not None and sigma != 1.0:  # costly, and the same for all of the sweep but for the noise
        plan = _plan(duration, 1.0)
        return dataclasses.replace(plan, velocity_noise=np.full_like(plan.velocity_noise, sigma))
    case = NoiseCase(controller="tdc", estimator="one_sample", gains="published", sigma=sigma, duration=duration)
    return make_plan(case.scenario())


def _predicted_isv(case: NoiseCase, scenario: Scenario) -> float:
    """ISV of the linear loop, with K_s at its bound where there is one and at its start otherwise; G left out."""
    from ffsm_drake.design.stability.margins import sampling_of
    from ffsm_drake.design.stability.prediction import predict
    from ffsm_drake.design.stability.sampled_loop import law_gains

    plan = _plan(case.duration, case.sigma)
    law = law_gains(scenario, plan.coordinates)
    gains = law.at(np.where(np.isfinite(law.k_s_max), law.k_s_max, law.k_s))
    settled_after = _settled_after(case.duration)
    return predict(plan, gains, sampling_of(scenario, plan.coordinates), settled_after=settled_after).isv


@functools.cache
def _noise_gain(controller: str) -> float:
    """Rms of Hhat^-1 tau on a base attitude axis per unit of velocity noise, published gains, 1/s, for H = Hhat."""
    from ffsm_drake.design.stability.sampled_loop import LoopGains, Sampling, coupled_loop, law_gains
    from ffsm_drake.spacecraft.nominal import make_nominal_plant

    scenario = NoiseCase(controller=controller, estimator="one_sample", gains="published", sigma=1.0).scenario()
    gains = law_gains(scenario, make_nominal_plant(scenario).coordinates).at()
    one = np.ones((1, 1))
    loop = coupled_loop(
        LoopGains(k_v=gains.k_v[:1], k_p=gains.k_p[:1], k_i=gains.k_i[:1]),
        true_mass_matrix=one,
        nominal_mass_matrix=one,
        sampling=Sampling(sample_time=scenario.sample_time),
    )
    return float(loop.noise_response(position_noise=np.zeros(1), velocity_noise=np.ones(1))["force"][0])


def write_study(study: NoiseStudy, directory: str | Path) -> Path:
    """Write noise.csv (every run), noise.md (the table), noise.png and noise.svg. Returns the path of noise.md.

    Raises:
      RecordError: a file cannot be written.
    """
    directory = Path(directory)
    write_text(directory / "noise.csv", study_csv(study))
    figure = plot_study(study)
    with written_whole(directory / "noise.png") as temporary:
        figure.savefig(temporary, dpi=130)
    with written_whole(directory / "noise.svg") as temporary:
        figure.savefig(temporary, metadata={"Date": None})
    path = directory / "noise.md"
    write_text(path, study_markdown(study))
    return path


def study_csv(study: NoiseStudy) -> str:
    """Every run as comma-separated values in SI units; empty where a run diverged, sigma empty for the sensor set."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "controller",
            "estimator",
            "gains",
            "sensors",
            "sigma",
            "seed",
            "diverged",
            "outcome",
            "itae",
            "isv",
            "isv_predicted",
        ]
        + [f"{kind}_{group}" for kind in ("rms_error", "peak_force") for group in GROUPS]
    )
    for row in study.rows:
        numbers = [row.itae, row.isv, row.isv_predicted]
        numbers += [values[group] for values in (row.rms_error, row.peak_force) for group in GROUPS]
        sensors, sigma = ("flight_sensors", "") if row.sigma is None else ("white", f"{row.sigma:g}")
        writer.writerow(
            [row.controller, row.estimator, row.gains, sensors, sigma, row.seed, int(row.diverged), row.outcome]
            + [f"{number:.8g}" if math.isfinite(number) else "" for number in numbers]
        )
    return text.getvalue()


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Point:
    """Runs of one point that differ in the seed only: means, or NaN when any of them diverged."""

    sigma: float | None
    outcome: str
    diverged: bool
    itae: float
    isv: float
    isv_predicted: float
    rms_error: dict[str, float]
    peak_force: dict[str, float]  # the largest


def _point(rows: Sequence[NoiseRow]) -> _Point:
    ended = [row for row in rows if row.diverged]
    share = f" ({len(ended)} of {len(rows)} runs)" if len(rows) > 1 else ""
    return _Point(
        sigma=rows[0].sigma,
        outcome=f"{ended[0].outcome}{share}" if ended else "completed",
        diverged=bool(ended),
        itae=float(np.mean([row.itae for row in rows])),
        isv=float(np.mean([row.isv for row in rows])),
        isv_predicted=rows[0].isv_predicted,
        rms_error={group: float(np.sqrt(np.mean([row.rms_error[group] ** 2 for row in rows]))) for group in GROUPS},
        peak_force={group: float(np.max([row.peak_force[group] for row in rows])) for group in GROUPS},
    )


def _curves(study: NoiseStudy) -> Iterator[tuple[str, str, list[_Point]]]:
    """(controller, estimator, its points by sigma, the sensor set last)."""
    sigmas = (*study.sigmas, None)
    for estimator in ESTIMATOR_KINDS:
        for controller in study.noise_gain:
            yield controller, estimator, [_point(study.select(controller, estimator, sigma)) for sigma in sigmas]


def study_markdown(study: NoiseStudy) -> str:
    """The study as tables: the slope, which of the two does it, and every point."""
    lines = [
        "# What the published gains cost with real sensors",
        "",
        f"Runs of {study.duration:g} s; perfect tracking without noise costs ISV {study.ideal_isv:.2f}. Positions are "
        "measured exactly but by `flight_sensors`, actuators are unlimited. Units: rad or m, N m or N. Rms errors "
        f"count after {_settled_after(study.duration):g} s.",
        "",
        *_slope_lines(study),
        *_exchange_lines(study),
    ]
    for estimator, title in _ESTIMATOR_TITLES.items():
        lines += [
            "",
            f"## {title}",
            "",
            "| controller | σ [rad/s, m/s] | ITAE | ISV | ISV, predicted | rms attitude | rms position | rms joints "
            "| peak torque | peak force | peak joint torque |",
            "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
        ]
        for controller, kind, points in _curves(study):
            lines += [_markdown_row(controller, point) for point in points if kind == estimator]
    lines += [
        "",
        "Predicted: by the linear loop without simulating it, G left out, K_s at its bound or, without one, at its "
        "start (AISMC). Peaks are over the whole run.",
    ]
    return "\n".join(lines) + "\n"


def _slope_lines(study: NoiseStudy) -> list[str]:
    lines = [
        "## The slope",
        "",
        "The published estimate puts Ĥ Δv/L into the force, so that the effort of the noise grows as σ²/L². Predicted "
        "rms acceleration for a base attitude axis; extra effort (ISV - ideal)/σ² at the largest σ flown to the end:",
        "",
        "| controller | rms acceleration/σ [1/s] | the same in 1/L | extra effort/σ², predicted | measured | at σ |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for controller, estimator, points in _curves(study):
        if estimator != "one_sample":
            continue
        slopes = "– | – | –"
        flown = [(point.sigma, point) for point in points if point.sigma is not None and not point.diverged]
        if flown:
            sigma, last = flown[-1]
            predicted, measured = ((isv - study.ideal_isv) / sigma**2 for isv in (last.isv_predicted, last.isv))
            slopes = f"{predicted:.2e} | {measured:.2e} | {_sensors(sigma)}"
        gain = study.noise_gain[controller]
        lines.append(f"| {LABELS[controller]} | {gain:.0f} | {gain * study.sample_time:.1f} | {slopes} |")
    return lines


def _exchange_lines(study: NoiseStudy) -> list[str]:
    sigma = _nearest(study.sigmas)
    ways = (("one_sample", "published"), *_EXCHANGED, ("kalman", "bandwidth"))
    lines = [
        "",
        f"## Estimate or gains? At σ = {_sensors(sigma)}",
        "",
        "ISV, and the rms error of the base attitude:",
        "",
        "| controller | " + " | ".join(f"{_ESTIMATES[estimator]}, {gains} gains" for estimator, gains in ways) + " |",
        "|---|---:|---:|---:|---:|",
    ]
    for controller in study.noise_gain:
        cells = []
        for estimator, gains in ways:
            point = _point(study.select(controller, estimator, sigma, gains=gains))
            value = f"{_significant(point.isv)}; {point.rms_error['base_rotation']:.1e}"
            cells.append(f"**{point.outcome}**" if point.diverged else value)
        lines.append(f"| {LABELS[controller]} | " + " | ".join(cells) + " |")
    return lines


def _settled_after(duration: float) -> float:
    return min(SETTLED_AFTER, 0.25 * duration)


_ESTIMATES = {"one_sample": "one sample", "kalman": "Kalman"}
_ESTIMATOR_TITLES = {
    "one_sample": "One-sample estimate, published gains",
    "kalman": "Kalman estimate, bandwidth gains",
}


def _markdown_row(controller: str, point: _Point) -> str:
    predicted = _significant(point.isv_predicted) if math.isfinite(point.isv_predicted) else "unstable"
    head = f"| {LABELS[controller]} | {_sensors(point.sigma)} |"
    if point.diverged:
        return f"{head} **{point.outcome}** | – | {predicted} | – | – | – | – | – | – |"
    errors = [f"{point.rms_error[group]:.1e}" for group in GROUPS]
    peaks = [_significant(point.peak_force[group]) for group in GROUPS]
    return " | ".join([f"{head} {point.itae:.2e}", _significant(point.isv), predicted, *errors, *peaks]) + " |"


def _significant(value: float) -> str:
    """Such as 3.8, 418.3 and 2.65e+05."""
    return f"{value:.1f}" if abs(value) < 1e4 else f"{value:.2e}"


def _sensors(sigma: float | None) -> str:
    return "flight_sensors" if sigma is None else f"{sigma:.0e}"


_MARKERS = {"tde_aismc": "o", "aismc": "s", "asmc": "^", "tdc": "D"}
# Several curves agree: the later ones are drawn smaller, over the earlier ones.
_SIZES = {"tde_aismc": 8.5, "aismc": 7.2, "asmc": 6.0, "tdc": 4.4}
_WIDTHS = {"tde_aismc": 2.6, "aismc": 2.0, "asmc": 1.5, "tdc": 1.1}
_DASHES = (0, (4, 2))


def plot_study(study: NoiseStudy) -> Figure:
    """Effort, peak force, attitude error and joint error against the noise of the velocity."""
    figure = Figure(figsize=(12.0, 9.6))
    figure.suptitle("What the published gains cost with real sensors", fontsize=14, fontweight="bold", y=0.985)
    figure.text(
        0.5,
        0.95,
        "White velocity noise on every coordinate, exact positions, unlimited actuators; at the right the sensor set "
        "of flight_sensors",
        ha="center", va="top", fontsize=9.5, color="#444444",
    )  # fmt: skip
    panels = figure.subplots(2, 2, sharex=True)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.885, bottom=0.14, wspace=0.2, hspace=0.16)
    after = f"after {_settled_after(study.duration):g} s"
    quantities: tuple[tuple[str, str, Callable[[_Point], float]], ...] = (
        ("(a) Effort beyond that of perfect tracking", "ISV - ideal ISV", lambda p: p.isv - study.ideal_isv),
        ("(b) Peak force on the base", "force [N]", lambda p: p.peak_force["base_position"]),
        (f"(c) Base attitude error {after}", "rms error [rad]", lambda p: p.rms_error["base_rotation"]),
        (f"(d) Joint error {after}", "rms error [rad]", lambda p: p.rms_error["joints"]),
    )
    for axes, (title, label, quantity) in zip(panels.flat, quantities, strict=True):
        _plot_quantity(axes, study, quantity)
        axes.set_title(title, fontsize=11, loc="left")
        axes.set_ylabel(label)
        tidy(axes)
        _mark_sensors(axes, named=axes is panels[0, 0])
    _draw_slope(panels[0, 0], study)
    limit = load_scenario("flight_sensors").actuation.limit or {}
    if "base_position" in limit:
        panels[0, 1].axhline(limit["base_position"], color="black", linewidth=1.0)
        panels[0, 1].annotate(
            f"thrusters of flight_sensors: {limit['base_position']:g} N",
            (0.015, limit["base_position"]),
            xycoords=("axes fraction", "data"),
            xytext=(0, 3),
            textcoords="offset points",
            fontsize=8.5,
        )
    for axes in panels[1]:
        axes.set_xlabel("velocity noise σ per sample [rad/s, m/s]")
    handles = [Line2D([], [], label=LABELS[name], **_look(name, "one_sample")) for name in study.noise_gain]
    neutral: dict[str, Any] = {"color": "#444444", "marker": "o", "markersize": 6.0, "linewidth": 1.6}
    handles += [
        Line2D([], [], label="filled: one sample, published gains", **neutral),
        Line2D([], [], label="open: Kalman, bandwidth gains", **neutral, markerfacecolor="white", linestyle=_DASHES),
        Line2D([], [], label="diverged", **(neutral | {"marker": "X", "markersize": 8.0, "linestyle": "none"})),
    ]
    figure.legend(
        handles=handles, loc="lower center", ncols=4, fontsize=9.5, frameon=False, handlelength=3.2,
        bbox_to_anchor=(0.5, 0.005),
    )  # fmt: skip
    return figure


def _look(controller: str, estimator: str) -> dict[str, Any]:
    look = {
        "color": STYLES[controller]["color"],
        "marker": _MARKERS[controller],
        "markersize": _SIZES[controller],
        "linewidth": _WIDTHS[controller],
    }
    if estimator == "kalman":
        look |= {"linestyle": _DASHES, "markerfacecolor": "white", "markeredgewidth": 1.3}
    return look


def _place_of_set(study: NoiseStudy) -> float:
    """Where on the axis of sigma the sensor set stands: apart, beyond the largest."""
    return 5.0 * study.sigmas[-1]


def _plot_quantity(axes: Axes, study: NoiseStudy, quantity: Callable[[_Point], float]) -> None:
    place = _place_of_set(study)
    crosses: dict[float, list[str]] = {}
    for curve, (controller, estimator, points) in enumerate(_curves(study)):
        look = _look(controller, estimator) | {"zorder": 3.0 + 0.1 * curve}
        # What a logarithm cannot show is left out: a run may, by the luck of a seed, cost less than the ideal one.
        value = np.array([quantity(point) for point in points])
        value = np.where(value > 0.0, value, np.nan)
        axes.plot(study.sigmas, value[:-1], **look)
        # Side by side, since several of them agree.
        beside = place * 1.25 ** (CONTROLLERS.index(controller) - 1.5)
        axes.plot([beside], value[-1:], **(look | {"linestyle": "none", "markersize": 5.5}))
        for point in points:
            if point.diverged:
                crosses.setdefault(point.sigma or beside, []).append(look["color"])
    axes.set(xscale="log", yscale="log")
    for at, colors in crosses.items():
        for k, color in enumerate(colors):
            axes.plot(
                [at], [0.965 - 0.05 * k], marker="X", markersize=9.0, color=color, markeredgecolor="white",
                markeredgewidth=0.6, transform=axes.get_xaxis_transform(), zorder=6, clip_on=False,
            )  # fmt: skip
    low, high = axes.get_ylim()
    margin = (high / low) ** 0.09
    axes.set_ylim(low / margin, high * margin)  # room for the names of the sensors, and for the crosses
    edge = place / 2.3
    axes.axvline(edge, color="#888888", linewidth=0.8, linestyle=":")
    axes.annotate("flight\nsensors", (place, 0.0), **_AT_THE_FOOT, ha="center")
    axes.set_xlim(study.sigmas[0] / 1.6, place * 2.2)
    axes.set_xticks([10.0**k for k in range(-12, 3) if axes.get_xlim()[0] <= 10.0**k < edge])


_AT_THE_FOOT: dict[str, Any] = {
    "xycoords": ("data", "axes fraction"),
    "xytext": (0, 4),
    "textcoords": "offset points",
    "fontsize": 8.5,
}


def _draw_slope(axes: Axes, study: NoiseStudy) -> None:
    """The predicted growth of effort with the published estimate, for the law that amplifies least."""
    sigma = np.array(study.sigmas)
    if sigma.size < 2:
        return
    if not study.select("tdc", "one_sample", study.sigmas[-1]):
        return
    row = study.select("tdc", "one_sample", study.sigmas[-1])[0]
    slope = (row.isv_predicted - study.ideal_isv) / sigma[-1] ** 2
    axes.plot(
        sigma, slope * sigma**2, color="black", linewidth=1.3, linestyle=":", zorder=5, scalex=False, scaley=False
    )
    at = sigma[max(sigma.size - 3, 0)]
    axes.annotate(
        "dotted: predicted\nfor TDC, ∝ σ²/L²", (at, slope * at**2), xytext=(4, -12), textcoords="offset points",
        fontsize=8.5, va="top",
    )  # fmt: skip


def _mark_sensors(axes: Axes, *, named: bool) -> None:
    axes.axvspan(*MEMS_GYRO, color="#F0E442", alpha=0.22, linewidth=0, zorder=0)
    axes.axvline(FIBRE_GYRO, color="#56B4E9", linewidth=1.4, zorder=1)
    if named:
        axes.annotate("fibre gyro \n0.005°/√h ", (FIBRE_GYRO, 0.0), **_AT_THE_FOOT, ha="right")
        axes.annotate("MEMS gyro", (math.sqrt(MEMS_GYRO[0] * MEMS_GYRO[1]), 0.0), **_AT_THE_FOOT, ha="center")
