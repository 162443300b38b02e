"""What a run says about the paper's claims: every claim a finding with its figures, every curve behind it a series."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

from ffsm_drake.analysis import balances, chattering, estimation
from ffsm_drake.analysis import lyapunov as proof
from ffsm_drake.analysis.evidence import Evidence, Numbers, largest, ratio, rms
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.systems.controllers.laws.tde_aismc import TdeAismc

if TYPE_CHECKING:
    import xarray as xr

Verdict = Literal["holds", "does not hold", "not applicable", "measured"]

# Key -> title of every finding, in the order of ``Analysis.findings``.
TITLES = {
    "condition_8": "Condition (8): ||E - H^-1 Hhat||_2 < 1",
    "tde_error_bound": "Bound N* on the TDE errors",
    "reaching_law": "Reaching law (7) over a sample",
    "lyapunov_derivative": "dV/dt <= 0 outside the vicinity of the manifold, (12) to (14)",
    "ultimate_bound": "Ultimate bound on ||s||_2, (16)",
    "direct_bound": "Bound on |s_i| from (7) alone",
    "lemma_1_premise": "Lemma 1, premise: beta_i ||s||_inf < N*",
    "lemma_1_conclusion": "Lemma 1, conclusion: K_si < N*",
    "switching_gain_bound": "Switching gain within G_i <= N*",
    "chattering": "Chattering of the control force",
    "momentum_balance": "Momentum balance",
    "energy_balance": "Energy balance",
}
POSTURE_INTERVAL = 0.1  # s, between the postures at which inertias are compared
# A balance holds when its residual is below this share of what went through it: explicit Euler at the control period
# misses by 1e-4 and more, the shipped exact integration by 1e-10.
BALANCE_TOLERANCE = 1e-6
UNITS_OF_LENGTH = {"centimetres": 0.01, "decimetres": 0.1, "metres": 1.0, "decametres": 10.0}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finding:
    """One claim, or one figure of merit, judged on one run."""

    key: str  # stable identifier, a key of TITLES
    title: str
    statement: str  # one sentence, its figures formatted from ``numbers``
    verdict: Verdict  # "measured" where there is nothing to hold
    # Names are flat; ``name.part`` is the value of a group or coordinate. NaN: undefined in this run.
    numbers: Numbers


@dataclasses.dataclass(frozen=True, kw_only=True)
class Analysis:
    """All findings of a run, and the curves behind them.

    ``series`` is an xarray Dataset along ``time`` (samples t_k), ``period`` (the t_k that begin one), ``posture_time``,
    ``frequency`` and ``coordinate``; it holds what applies to the run, each variable with units and meaning.
    """

    findings: tuple[Finding, ...]
    series: "xr.Dataset"

    def __str__(self) -> str:
        """The findings as plain text, one paragraph each."""
        return "\n".join(f"[{item.verdict}] {item.title}\n    {item.statement}" for item in self.findings)

    def finding(self, key: str) -> Finding:
        """The finding of that key. Raises KeyError naming the valid ones."""
        for finding in self.findings:
            if finding.key == key:
                return finding
        raise KeyError(f"no finding '{key}'; choose one of {', '.join(TITLES)}")


def analyze(record: RunRecord) -> Analysis:
    """Judge a run: completed or cut short, of any controller. What does not apply is said to be so, with the reason."""
    run = Evidence(record)
    findings = [
        *_condition_8(run),
        *_tde_error(run),
        *_sliding_mode(run),
        *_proof(run),
        *_chattering(run),
        *_balances(run),
    ]
    by_key = {finding.key: finding for finding in findings}
    return Analysis(findings=tuple(by_key[key] for key in TITLES), series=run.dataset())


def _condition_8(run: Evidence) -> list[Finding]:
    key = "condition_8"
    every = max(1, round(POSTURE_INTERVAL / run.period))
    picked = np.unique([*range(0, len(run.time), every), len(run.time) - 1]) if len(run.time) else np.zeros(0, int)
    run.axes["posture_time"] = run.time[picked]
    if not len(picked):
        return _not_applicable("the record has no finite sample", key)
    true, nominal = (
        estimation.mass_matrices(model, run.values("position")[picked]) for model in (run.true, run.nominal)
    )
    is_length = np.array([unit == "m" for unit in run.coordinates.units])
    by_unit = {
        name: estimation.match_inertia(true, nominal, is_length=is_length, unit_of_length=metres)
        for name, metres in UNITS_OF_LENGTH.items()
    }
    match = by_unit["metres"]
    run.axes["rank"] = np.arange(1, match.eta.shape[1] + 1)
    run.add("eta", ("posture_time", "rank"), match.eta, units="1", meaning="eigenvalues of H^-1 Hhat, ascending")
    run.add("condition_8", "posture_time", match.norm, units="1", meaning="||E - H^-1 Hhat||_2 (metres and radians)")
    run.add("condition_8_in_h", "posture_time", match.norm_in_h, units="1", meaning="the same norm in the metric of H")
    numbers: Numbers = {
        "norm_min": float(match.norm.min()),
        "norm_max": float(match.norm.max()),
        "time_of_norm_max": float(run.axes["posture_time"][match.norm.argmax()]),
        "eta_min": float(match.eta.min()),
        "eta_max": float(match.eta.max()),
        "norm_in_h_max": float(match.norm_in_h.max()),
        "postures": float(len(picked)),
        **{f"norm_max_in.{name}": float(other.norm.max()) for name, other in by_unit.items()},
    }
    statement = (
        "||E - H^-1 Hhat||_2 lies in [{norm_min:.4g}, {norm_max:.4g}] with lengths in metres, where 1 is the limit (it "
        "depends on that unit: at most {norm_max_in.decimetres:.4g} in decimetres, {norm_max_in.decametres:.4g} in "
        "decametres); free of units, the eigenvalues of H^-1 Hhat lie in [{eta_min:.4g}, {eta_max:.4g}], at most "
        "{norm_in_h_max:.4g} from 1."
    )
    return [_finding(key, statement, numbers, holds=bool(match.norm.max() < 1.0))]


def _tde_error(run: Evidence) -> list[Finding]:
    key = "tde_error_bound"
    if run.too_short:
        return _not_applicable(run.too_short, key)
    unit = "rad/s^2, m/s^2"
    run.add(
        "tde_error", ("period", "coordinate"), run.tde_error, units=unit, meaning="TDE error N - Nhat of the period"
    )
    for name, values, when in (
        ("tde_error_bound", run.bound, "over the run"),
        ("tde_error_bound_late", run.late_bound, "after the start-up"),
    ):
        run.add(name, "coordinate", values, units=unit, meaning=f"largest |TDE error| {when}")
    worst = int(run.bound.argmax())
    numbers: Numbers = {
        "start_up_time": estimation.start_up_time(run.period),
        "bound": float(run.bound.max()),
        "bound_late": float(run.late_bound.max()),
        "worst_coordinate": run.coordinates.names[worst],
        "time_of_bound": float(run.time[np.abs(run.tde_error[:, worst]).argmax()]),
        **run.grouped("bound", run.bound),
        **run.grouped("bound_late", run.late_bound),
        **run.named("bound", run.bound),
        **run.named("bound_late", run.late_bound),
    }
    statement = (
        "N* = {bound:.3g} ({worst_coordinate} at {time_of_bound:.3g} s), by group "
        + ", ".join(f"{{bound.{group}:.3g}} ({group})" for group in run.groups)
        + _late(
            run,
            "; without the first {start_up_time:g} s N* = {bound_late:.3g}, by group "
            + ", ".join(f"{{bound_late.{group}:.3g}}" for group in run.groups),
        )
        + " (rad/s^2 or m/s^2)."
    )
    return [_finding(key, statement, numbers)]


def _sliding_mode(run: Evidence) -> list[Finding]:
    """What needs s and the gains, whatever adapts them."""
    keys = ("reaching_law", "direct_bound", "switching_gain_bound")
    if "sliding_variable" not in run.data:
        return _not_applicable(f"the controller {run.scenario.controller} has no sliding variable", *keys)
    if run.too_short:
        return _not_applicable(run.too_short, *keys)
    s, (k_s, g) = run.values("sliding_variable"), run.gains
    run.add("sliding_variable", ("time", "coordinate"), s, units="rad/s, m/s", meaning="s")
    run.add("reaching_gain", ("time", "coordinate"), k_s, units="1/s", meaning="K_s")
    run.add("switching_gain", ("time", "coordinate"), g, units="rad/s^2, m/s^2", meaning="G")
    remainder = proof.reaching_law_remainder(s=s, k_s=k_s, g=g, tde_error=run.tde_error, period=run.period)
    run.add(
        "reaching_law_remainder", ("period", "coordinate"), remainder, units="rad/s^2, m/s^2",
        meaning="ds/dt over the period minus what equation (7) gives",
    )  # fmt: skip
    late = run.after_start_up
    numbers: Numbers = {
        "start_up_time": estimation.start_up_time(run.period),
        "remainder": float(largest(remainder).max()),
        "remainder_late": float(largest(remainder[late[:-1]]).max()),
        "rms_ratio": ratio(rms(remainder), rms(run.tde_error)),
        "rms_ratio_late": ratio(rms(remainder[late[:-1]]), rms(run.tde_error[late[:-1]])),
        "largest_k_d_l": float(run.law.k_d.max() * run.period) if run.law is not None else np.nan,
        "largest_k_s_l": float(k_s.max() * run.period),
        **run.grouped("remainder", largest(remainder)),
    }
    statement = (
        "Over a sample, ds/dt differs from -Ntilde - K_s s - G sgn s by up to {remainder:.3g} rad/s^2 or m/s^2, in "
        "root mean square {rms_ratio:.3g} times Ntilde itself"
        + _late(run, " ({rms_ratio_late:.3g} times after the first {start_up_time:g} s)")
        + ": (7) takes K_D L = {largest_k_d_l:.3g} and K_s L = {largest_k_s_l:.3g} for small."
    )
    findings = [_finding("reaching_law", statement, numbers), _direct_bound(run, s, k_s, g, remainder)]
    if "switching_gain" not in run.data:
        return findings + _not_applicable(
            f"the controller {run.scenario.controller} has no switching gain", "switching_gain_bound"
        )
    numbers = {
        "largest_g": float(g.max()),
        "bound": float(run.bound.max()),
        "bound_late": float(run.late_bound.max()),
        "ratio": ratio(float(g.max()), float(run.bound.max())),
        "coordinates": float(g.shape[1]),
        "coordinates_within_own_bound": float(np.count_nonzero((g <= run.bound).all(axis=0))),
        **run.named("largest_g", g.max(axis=0)),
    }
    statement = (
        "G_i reaches {largest_g:.3g}, N* is {bound:.3g}" + _late(run, " ({bound_late:.3g} after the start-up)") + "; "
        "{coordinates_within_own_bound:g} of {coordinates:g} coordinates stay within their own bound N*_i."
    )
    return [*findings, _finding("switching_gain_bound", statement, numbers, holds=bool(g.max() <= run.bound.max()))]


def _direct_bound(run: Evidence, s: np.ndarray, k_s: np.ndarray, g: np.ndarray, remainder: np.ndarray) -> Finding:
    late = run.after_start_up

    def judge(disturbance: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The bounds (nv), and largest |s_i| over bound (nv), on the samples of ``part`` (n)."""
        if not part[:-1].any():
            return (np.full(s.shape[1], np.nan),) * 2
        bound = proof.direct_bound(
            first=s[part][0],
            bound=largest(disturbance[part[:-1]]),
            k_s_min=k_s[part].min(axis=0),
            g_min=g[part].min(axis=0),
        )
        reached = largest(s[part])
        return bound, np.divide(reached, bound, out=np.where(reached > 0.0, np.inf, 0.0), where=bound > 0.0)

    whole = np.ones_like(late)
    bound, times = judge(run.tde_error, whole)
    _, late_ratio = judge(run.tde_error, late)
    _, full_ratio = judge(run.tde_error - remainder, whole)
    run.add(
        "direct_bound", "coordinate", bound, units="rad/s, m/s", meaning="bound on |s_i| from equation (7), whole run"
    )
    numbers: Numbers = {
        "start_up_time": estimation.start_up_time(run.period),
        "coordinates": float(times.size),
        "coordinates_within": float(np.count_nonzero(times <= 1.0)),
        "worst_ratio": float(times.max()),
        "worst_coordinate": run.coordinates.names[int(times.argmax())],
        "coordinates_within_late": float(np.count_nonzero(late_ratio <= 1.0)) if late[:-1].any() else np.nan,
        "worst_ratio_late": float(late_ratio.max()),
        "worst_ratio_with_remainder": float(full_ratio.max()),
        **run.named("bound", bound),
        **run.named("ratio", times),
    }
    statement = (
        "|s_i| stays within max(|s_i(0)|, (N*_i - G_i)^+ / K_si) in {coordinates_within:g} of {coordinates:g} "
        "coordinates, at worst "
        + ("{worst_ratio:.3g} times it" if np.isfinite(times.max()) else "where that is zero and |s_i| not")
        + " ({worst_coordinate})"
        + _late(
            run,
            "; after the first {start_up_time:g} s, with N* and s(0) from there, in {coordinates_within_late:g} "
            "(largest ratio {worst_ratio_late:.3g})",
        )
        + "; with what (7) leaves out counted as disturbance, the largest ratio is {worst_ratio_with_remainder:.3g}."
    )
    return _finding("direct_bound", statement, numbers, holds=bool((times <= 1.0).all()))


def _proof(run: Evidence) -> list[Finding]:
    """Section 3.2, which is about laws (9) and (10) only."""
    keys = ("lyapunov_derivative", "ultimate_bound", "lemma_1_premise", "lemma_1_conclusion")
    law = run.law
    if not isinstance(law, TdeAismc):
        return _not_applicable(
            f"the proof is about gains that adapt by (9) and (10), which those of {run.scenario.controller} do not",
            *keys,
        )
    if run.too_short:
        return _not_applicable(run.too_short, *keys)
    s, k_s = run.values("sliding_variable"), run.gains[0]
    bound = float(run.bound.max())
    peak = np.abs(s).max(axis=1)  # ||s||_inf
    scaled = law.beta.max() * peak
    run.add("scaled_sliding_variable", "time", scaled, units="1/s", meaning="largest beta_i times ||s||_inf")
    norm = np.linalg.norm(s, axis=1)
    ultimate = proof.ultimate_bound(bound=bound, alpha=law.alpha, beta=law.beta, phi=law.phi, epsilon=law.epsilon)
    premise: Numbers = {
        "largest": float(scaled.max()),
        "largest_of_smallest_beta": float(law.beta.min() * peak.max()),
        "bound": bound,
        "ratio": ratio(float(scaled.max()), bound),
        "share_of_samples": float(np.mean(scaled < bound)),
    }
    conclusion: Numbers = {
        "smallest_k_s": float(k_s.min()),
        "largest_k_s": float(k_s.max()),
        "largest_initial_k_s": float(k_s[0].max()),
        "bound": bound,
        "ratio": ratio(float(k_s.max()), bound),
        "share_of_gains": float(np.mean(k_s < bound)),
    }
    limit: Numbers = {
        "bound": bound,
        "ultimate_bound": ultimate,
        "largest_norm": float(norm.max()),
        "ratio": ratio(float(norm.max()), ultimate),
    }
    return [
        _lyapunov_derivative(run, law, bound),
        _finding(
            "ultimate_bound",
            "||s||_2 reaches {largest_norm:.3g}, {ratio:.2g} of the {ultimate_bound:.3g} that (16) gives for "
            "N* = {bound:.3g}.",
            limit,
            holds=bool(norm.max() <= ultimate),
        ),
        _finding(
            "lemma_1_premise",
            "beta_i ||s||_inf reaches {largest:.3g} for the largest beta_i and {largest_of_smallest_beta:.3g} for the "
            "smallest, {ratio:.2g} times N* = {bound:.3g} at most; all beta_i satisfy it in {share_of_samples:.3g} of "
            "the samples.",
            premise,
            holds=bool(scaled.max() < bound),
        ),
        _finding(
            "lemma_1_conclusion",
            "K_si lies in [{smallest_k_s:.4g}, {largest_k_s:.4g}] 1/s, up to {ratio:.2g} times N* = {bound:.3g}, and "
            "starts at {largest_initial_k_s:.4g}.",
            conclusion,
            holds=bool(k_s.max() < bound),
        ),
    ]


def _lyapunov_derivative(run: Evidence, law: TdeAismc, bound: float) -> Finding:
    s, (k_s, g) = run.values("sliding_variable"), run.gains
    v = proof.lyapunov(s=s, k_s=k_s, g=g, alpha=law.alpha, phi=law.phi, bound=bound, period=run.period)
    outside = proof.outside(s, k_s, beta=law.beta, epsilon=law.epsilon)
    run.add("lyapunov", "time", v.value, units="1", meaning="V of equation (12)")
    run.add("lyapunov_rate", "period", v.rate, units="1/s", meaning="dV/dt of equation (13), over the period")
    for name, part in (("s", v.rate_of_s), ("k_s", v.rate_of_k_s), ("g", v.rate_of_g)):
        run.add(f"lyapunov_rate_of_{name}", "period", part, units="1/s", meaning=f"the part of dV/dt from {name}")
    meaning = "coordinates with |s_i| > max(K_si / beta_i, epsilon)"
    run.add("outside", "time", outside.sum(axis=1), units="1", meaning=meaning)
    rising, count = v.rate > 0.0, outside[:-1].sum(axis=1)
    left, wholly = count > 0, count == s.shape[1]
    # Which term of (13) is the largest where V rises.
    parts = {"s": v.rate_of_s, "K_s": v.rate_of_k_s, "G": v.rate_of_g}
    driver = list(parts)[int(np.argmax([part[rising].sum() for part in parts.values()]))] if rising.any() else "none"
    numbers: Numbers = {
        "bound": bound,
        "epsilon": float(law.epsilon),
        "samples": float(rising.size),
        "outside_any": float(left.sum()),
        "outside_all": float(wholly.sum()),
        "rising_outside_any": float((rising & left).sum()),
        "rising_outside_all": float((rising & wholly).sum()),
        "inside": float((~left).sum()),
        "rising_inside": float((rising & ~left).sum()),
        "largest_rate_outside": float(v.rate[left].max()) if left.any() else np.nan,
        "largest_rate_inside": float(v.rate[~left].max()) if (~left).any() else np.nan,
        "value_first": float(v.value[0]),
        "value_last": float(v.value[-1]),
        "driver": driver,
    }
    statement = (
        "dV/dt > 0 in {rising_outside_any:g} of the {outside_any:g} samples with some |s_i| > max(K_si/beta_i, "
        "epsilon), in {rising_outside_all:g} of the {outside_all:g} with all of them, and in {rising_inside:g} of the "
        "{inside:g} inside; "
        "V goes from {value_first:.4g} to {value_last:.4g}"
        + ("." if driver == "none" else ", and where it rises the term of {driver} is the largest.")
    )
    if not left.any():
        return dataclasses.replace(
            _finding("lyapunov_derivative", "s never leaves the vicinity, where the paper claims nothing: " + statement,
                     numbers),
            verdict="not applicable",
        )  # fmt: skip
    return _finding("lyapunov_derivative", statement, numbers, holds=not (rising & left).any())


def _chattering(run: Evidence) -> list[Finding]:
    key, tau = "chattering", run.values("generalized_force")
    if len(tau) < chattering.FEWEST_SAMPLES:
        return _not_applicable(f"a spectrum needs {chattering.FEWEST_SAMPLES} samples, the record has {len(tau)}", key)
    split = chattering.split_frequency(run.period)
    frequency, density = chattering.effort_spectrum(tau, run.period)
    run.axes["frequency"] = frequency
    run.add(
        "effort_spectrum", ("frequency", "coordinate"), density, units="(N m)^2/Hz, N^2/Hz",
        meaning="power spectral density of tau (Welch)",
    )  # fmt: skip
    low, high = chattering.split_variance(tau, run.period, split=split)
    # n samples have n - 1 changes in n - 1 periods.
    turns = chattering.reversals(tau) / (run.period * (len(tau) - 1))
    variation = chattering.total_variation(tau)
    numbers: Numbers = {
        "split_frequency": split,
        "sampling_frequency": 1.0 / run.period,
        "effort_share": ratio(float(high.sum()), float(np.square(tau).sum(axis=1).mean())),
        **run.named("share", np.array([ratio(*pair) for pair in zip(high, low + high, strict=True)])),
        **run.named("rms", np.sqrt(high)),
        **run.named("reversals_per_second", turns),
        **run.named("total_variation", variation),
    }
    for group, part in run.groups.items():
        numbers[f"share.{group}"] = ratio(float(high[part].sum()), float((low + high)[part].sum()))
        numbers[f"rms.{group}"] = float(np.sqrt(high[part].sum()))
        numbers[f"reversals_per_second.{group}"] = float(turns[part].mean())
        numbers[f"total_variation.{group}"] = float(variation[part].sum())
    groups = list(run.groups)
    statement = (
        f"For {', '.join(groups)}: from {{split_frequency:g}} Hz on lie "
        + ", ".join(f"{{share.{group}:.3g}}" for group in groups)
        + " of tau's variance ("
        + ", ".join(f"{{rms.{group}:.2g}}" for group in groups)
        + " N m or N rms), a coordinate's tau turns round "
        + ", ".join(f"{{reversals_per_second.{group}:.3g}}" for group in groups)
        + " times a second (at most {sampling_frequency:g}), and its total variation sums to "
        + ", ".join(f"{{total_variation.{group}:.3g}}" for group in groups)
        + " N m or N; {effort_share:.3g} of the mean |tau|^2, and so of ISV, is chattering."
    )
    return [_finding(key, statement, numbers)]


def _balances(run: Evidence) -> list[Finding]:
    keys = ("momentum_balance", "energy_balance")
    if len(run.time) < 4:
        return _not_applicable(f"the integrals need 4 samples, the record has {len(run.time)}", *keys)
    momentum: Numbers = {"tolerance": BALANCE_TOLERANCE}
    impulse = balances.absolute_impulse(run.data)
    ratios = []
    for name, residual in momentum_residual(run.data).items():
        size = np.linalg.norm(residual, axis=1)
        unit = "N s" if name == "linear" else "N m s"
        run.add(
            f"{name}_momentum_residual", "time", size, units=unit, meaning=f"norm of the {name} momentum's residual"
        )
        ratios.append(ratio(float(size.max()), impulse[name]))
        momentum |= {
            f"{name}_residual": float(size.max()), f"{name}_impulse": impulse[name], f"{name}_ratio": ratios[-1],
        }  # fmt: skip
    parts = balances.energy_residual(run.data)
    run.add(
        "energy_residual", "time", parts["residual"], units="J", meaning="T(t) - T(0) minus the work of tau + tau_d"
    )
    missed, work = float(np.abs(parts["residual"]).max()), float(parts["absolute_work"][-1])
    energy: Numbers = {
        "tolerance": BALANCE_TOLERANCE,
        "residual": missed,
        "residual_by_trapezoid": float(np.abs(parts["trapezoid"]).max()),
        "absolute_work": work,
        "ratio": ratio(missed, work),
    }
    return [
        _finding(
            "momentum_balance",
            "Momentum changes by the impulse of the external forces up to {linear_residual:.2g} N s and "
            "{angular_residual:.2g} N m s, {linear_ratio:.2g} and {angular_ratio:.2g} of the impulse's norm summed "
            "over the run.",
            momentum,
            holds=max(ratios) <= BALANCE_TOLERANCE,
        ),
        _finding(
            "energy_balance",
            "Kinetic energy changes by the work of tau and tau_d up to {residual:.2g} J, {ratio:.2g} of the "
            "{absolute_work:.3g} J that tau puts in and takes out; with the trapezoidal rule for the same work, up to "
            "{residual_by_trapezoid:.2g} J.",
            energy,
            holds=ratio(missed, work) <= BALANCE_TOLERANCE,
        ),
    ]  # fmt: skip


def _finding(key: str, statement: str, numbers: Numbers, *, holds: bool | None = None) -> Finding:
    """A finding whose statement is a format string over ``numbers``; ``holds`` None: measured."""
    verdict: Verdict = "measured" if holds is None else "holds" if holds else "does not hold"
    return Finding(key=key, title=TITLES[key], statement=_fill(statement, numbers), verdict=verdict, numbers=numbers)


def _not_applicable(reason: str, *keys: str) -> list[Finding]:
    statement = f"Not applicable: {reason}."
    return [
        Finding(key=key, title=TITLES[key], statement=statement, verdict="not applicable", numbers={}) for key in keys
    ]


def _fill(statement: str, numbers: Mapping[str, float | str]) -> str:
    """Put the numbers into their places ``{name:format}``. (str.format would take the dots of names for attributes.)"""
    parts = statement.split("{")
    text = parts[0]
    for part in parts[1:]:
        field, _, rest = part.partition("}")
        name, _, form = field.partition(":")
        text += format(numbers[name], form) + rest
    return text


def _late(run: Evidence, text: str) -> str:
    """The text, or nothing where the run ends within the start-up."""
    return text if run.after_start_up[:-1].any() else ""
